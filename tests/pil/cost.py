"""What the Cortex-M images cost: memory, and instructions per tick, counted in QEMU while the arm moves.

Example
-------
  python tests/pil/cost.py           2.5 kg, 10 s, both images (about a minute)
"""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path[0] = str(ROOT)
sys.path.insert(1, str(Path(__file__).resolve().parent))

from sil_plant.environment import enter, say  # noqa: E402

enter(__file__)

from emulated_board import IMAGES, STAGES, BoardError, EmulatedBoard, Figures, Image, build  # noqa: E402
from rich.console import Console  # noqa: E402
from rich.table import Table  # noqa: E402

from sil_plant.bus.ports import BusError, parse_bus  # noqa: E402
from sil_plant.config import ConfigError  # noqa: E402
from sil_plant.inputs.machine import REFERENCE_ARM, load_machine  # noqa: E402
from sil_plant.inputs.scenario import DEFAULT_SCENARIO, load_scenario, with_load  # noqa: E402
from sil_plant.loop import execution, session  # noqa: E402
from sil_plant.loop.bus_run import EcuLostError, EcuMissingError  # noqa: E402

LOAD_KG, DURATION_S = 2.5, 10.0


def memory(elf: Path) -> tuple[int, int]:
    """Flash and RAM, bytes; RAM with the room for the stack."""
    done = subprocess.run(["arm-none-eabi-size", str(elf)], capture_output=True, text=True, check=True)
    text, data, bss = (int(word) for word in done.stdout.splitlines()[1].split()[:3])
    return text + data, data + bss


def count(image: Image) -> Figures:
    """Run the loop with an image that counts."""
    elf = build(image, f"pil/{image.preset}-counting", ["-DDIARC_COUNT_INSTRUCTIONS=ON"])
    machine = load_machine(REFERENCE_ARM)
    scenario = replace(with_load(load_scenario(DEFAULT_SCENARIO), LOAD_KG), duration_s=DURATION_S)
    execution.compile_plant(machine, scenario)
    run = session.make_session(machine, scenario, "diarc", scenario.seed, execution.PERIOD_US * 1e-6, False)
    with EmulatedBoard(image, elf, counting=True) as board:
        execution.over_bus(run, parse_bus(board.bus), None, b"", lambda _: board.check(), True)
        return board.figures()


def main() -> int:
    """Print the table."""
    table = Table("bytes, and instructions a tick", *(f"{image.preset}, {image.scalar}" for image in IMAGES))
    try:
        sizes = [memory(build(image)) for image in IMAGES]
        figures = [count(image) for image in IMAGES]
    except (BoardError, BusError, ConfigError, EcuMissingError, EcuLostError) as error:
        say(f"cost.py: {error}")
        return 1
    table.add_row("flash", *(f"{flash}" for flash, _ in sizes))
    table.add_row("RAM (4096 of it stack)", *(f"{ram}" for _, ram in sizes))
    table.add_row("stack used", *(f"{f.stack_bytes}" for f in figures))
    for stage in STAGES[1:]:
        table.add_row(
            f"{stage}: mean, most",
            *(f"{f.instructions[stage][1]}, {f.instructions[stage][2]}" for f in figures),
        )
    Console().print(table)
    return 0


if __name__ == "__main__":
    sys.exit(main())
