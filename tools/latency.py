"""Measure from outside how long the ECU takes from the last sensor frame of a tick to its valve frame.

A run of the plant is recorded in this process and replayed to `diarc_ecu` on the bus, so that the ECU is in RUN,
moves the arm and estimates the load while it is measured; its valve frames must be those of the recorded run, bit
for bit. In the pause of every tick the same is done with a bare echo program on the same bus, which reads, looks at
the identifier and writes: as many frames in, one frame out. All times are the kernel's. The ratio of the two says
what the ECU adds to what this bus and this computer cost anybody.

Examples
--------
  python tools/latency.py vcan0
  python tools/latency.py --json build/latency.json             CAN over TCP, which needs no driver
  tools/vcan_vm -- python tools/latency.py vcan0                where the kernel has no CAN
"""

from __future__ import annotations

import argparse
import json
import os
import struct
import subprocess
import sys
import tempfile
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import IO

ROOT = Path(__file__).resolve().parents[1]
sys.path[0] = str(ROOT)

from sil_plant.environment import CommandLine, enter, say, show  # noqa: E402

enter(__file__)

import numpy as np  # noqa: E402

from sil_plant.bus.frames import DATA, FRAME_BYTES, frame_id  # noqa: E402
from sil_plant.bus.ports import BusAddress, BusError, parse_bus  # noqa: E402
from sil_plant.bus.protocol import SYNC_ID  # noqa: E402
from sil_plant.config import ConfigError  # noqa: E402
from sil_plant.inputs.machine import REFERENCE_ARM, load_machine, parameter_image  # noqa: E402
from sil_plant.inputs.scenario import DEFAULT_SCENARIO, load_scenario, with_load  # noqa: E402
from sil_plant.loop import session  # noqa: E402
from sil_plant.loop.execution import ECU_BINARY  # noqa: E402
from sil_plant.loop.inproc import InprocEcu  # noqa: E402

BIN = ROOT / "build" / "bin"
PROBE, ECHO = BIN / "latency_probe", BIN / "latency_echo"
LOAD_KG = 2.5
SENSOR_FRAMES = 3
FEWEST = 100  # samples, for a 99th percentile that is one
START_LIMIT_S = 10.0
SLOWEST = 20.0  # times the nominal time a measurement may take
PERCENTILES = (1, 10, 25, 50, 75, 90, 99, 99.9)
EXIT_FAILED, EXIT_WRONG_USE = 1, 2


class MeasurementError(Exception):
    """The measurement came to nothing; says why."""


def record_run(path: Path, image: bytes, duration_s: float, period_us: int) -> int:
    """Run plant and firmware in this process and write the frames of each tick for the probe; the ticks."""
    scenario = replace(with_load(load_scenario(DEFAULT_SCENARIO), LOAD_KG), duration_s=duration_s)
    run = session.make_session(load_machine(REFERENCE_ARM), scenario, "diarc", scenario.seed, period_us * 1e-6)
    ecu = InprocEcu(image, period_us)
    out = np.zeros((session.OUT_ROWS, FRAME_BYTES), dtype=np.uint8)
    ticks = 0
    with path.open("wb") as file:
        for _ in range(len(run.noise)):
            rows = 0
            for row in ecu.tick_begin():
                if frame_id(row) == SYNC_ID:
                    rows = session.on_sync(run, int(row[DATA]), out)
                else:
                    session.on_frame(run, row)
            valves = np.zeros(FRAME_BYTES, dtype=np.uint8)
            for row in ecu.tick_end(out[:rows]):
                session.on_frame(run, row)
                if frame_id(row) == run.monitor_layout.valves_id:
                    valves = row
            if rows < SENSOR_FRAMES:
                raise MeasurementError(f"the recorded run has {rows} frames for the ECU in a tick, expected 3 or more")
            file.write(struct.pack("=I", rows) + out[:rows].tobytes() + valves.tobytes())
            ticks += 1
    if run.monitor.whole[session.MODE] != session.MODE_RUN:
        raise MeasurementError("the recorded run did not stay in RUN")
    return ticks


class Processes:
    """Child processes, none of which outlives this one's `with`."""

    def __init__(self, stack: ExitStack, errors: IO[str]) -> None:
        self._stack = stack
        self._errors = errors

    def start(self, *argv: object, cpu: int, piped: bool = True) -> subprocess.Popen[str]:
        """Start a program on one processor; with `piped` its standard output is read here."""
        process = subprocess.Popen(
            ["taskset", "--cpu-list", str(cpu), *(str(word) for word in argv)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE if piped else subprocess.DEVNULL,
            stderr=self._errors,
            text=True,
        )
        self._stack.callback(self._end, process)
        return process

    @staticmethod
    def _end(process: subprocess.Popen[str]) -> None:
        if process.poll() is None:
            process.terminate()
            try:
                process.wait(START_LIMIT_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        if process.stdout is not None:
            process.stdout.close()


def first_line(process: subprocess.Popen[str], errors: Path) -> list[str]:
    """The words of a program's first line.

    Raises
    ------
    MeasurementError
        When the program has ended without one, with what it has said.
    """
    assert process.stdout is not None
    words = process.stdout.readline().split()
    if not words:
        name = Path(process.args[3]).name
        raise MeasurementError(
            f"{name} has ended with status {process.wait(START_LIMIT_S)}: {errors.read_text('utf-8').strip()}"
        )
    return words


def measure(address: BusAddress, pace: str, period_us: int, duration_s: float) -> np.ndarray:
    """Measure; rows of mode, whether the valve frame was as recorded, time of the ECU and of the echo, ns."""
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="diarc-latency-")))
        image, record, result = folder / "machine.params", folder / "record", folder / "result"
        image.write_bytes(parameter_image(load_machine(REFERENCE_ARM)))
        ticks = record_run(record, image.read_bytes(), duration_s, period_us)
        errors = stack.enter_context((folder / "errors").open("w"))
        processes = Processes(stack, errors)
        bus = address.channel if address.kind == "socketcan" else f"tcp:{address.host}:{address.port}"
        # ECU and echo program on the same one, else one of them may have the shorter way to the probe.
        cpus = sorted(os.sched_getaffinity(0))
        probe = processes.start(PROBE, bus, period_us, record, result, cpu=cpus[0])
        heard = first_line(probe, folder / "errors")
        if address.kind == "tcp":
            bus = f"tcp:{address.host}:{heard[1]}"
        where = [bus] if address.kind == "socketcan" else [address.host, heard[1]]
        first_line(processes.start(ECHO, *where, cpu=cpus[-1]), folder / "errors")
        options = ["--pace", pace, "--period-us", period_us, "--params", image, "--quiet"]
        ecu = processes.start(ECU_BINARY, bus, *options, cpu=cpus[-1], piped=False)
        try:
            status = probe.wait(START_LIMIT_S + SLOWEST * ticks * period_us * 1e-6)
        except subprocess.TimeoutExpired:
            raise MeasurementError("the measurement took 20 times as long as the run; is the computer busy?") from None
        if status != 0:
            said = " | ".join((folder / "errors").read_text("utf-8").splitlines())
            raise MeasurementError(f"the probe has ended with status {status}, the ECU with {ecu.poll()}: {said}")
        return np.loadtxt(result, dtype=np.int64, ndmin=2)


def figures(rows: np.ndarray) -> dict[str, object]:
    """What `--json` has, of the ticks in RUN in which both were measured."""
    in_run = rows[rows[:, 0] == session.MODE_RUN]
    both = in_run[(in_run[:, 2] >= 0) & (in_run[:, 3] >= 0)]
    if len(both) < FEWEST:
        raise MeasurementError(f"{len(both)} ticks were measured, {FEWEST} are needed; a longer --duration?")
    found: dict[str, object] = {}
    for name, column in (("", 2), ("echo_", 3)):
        values = np.percentile(both[:, column] * 1e-3, PERCENTILES).round(3)
        named = dict(zip((f"p{p:g}" for p in PERCENTILES), values.tolist(), strict=True))
        found |= {f"{name}median_us": named["p50"], f"{name}p99_us": named["p99"]}
        found |= {f"{name}count": len(both), f"{name}percentiles_us": named}
    for name in ("median", "p99"):
        found[f"{name}_ratio"] = round(float(found[f"{name}_us"]) / float(found[f"echo_{name}_us"]), 4)
    found["ticks"] = len(in_run)
    found["valve_frames_as_recorded"] = int(in_run[:, 1].sum())
    return found


def parse_arguments(argv: list[str]) -> argparse.Namespace:
    """Read the command line; a wrong one ends the program with status 2."""
    parser = CommandLine(prog="latency.py", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bus", nargs="?", default="tcp:127.0.0.1:0", help="vcan0, can0 or tcp:HOST:PORT (default)")
    parser.add_argument("--pace", choices=("realtime", "strict"), default="realtime", help="of the ECU; realtime")
    parser.add_argument("--period-us", type=int, default=1000, metavar="N", help="of the ECU's tick; 1000")
    parser.add_argument("--duration", type=float, default=5.0, metavar="S", help="of the motion; 5")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures")
    return parser.parse_args(argv)


def main(argv: list[str]) -> int:
    """Run the command line; the exit status."""
    arguments = parse_arguments(argv)
    try:
        address = parse_bus(arguments.bus)
        if address.kind not in ("socketcan", "tcp"):
            raise BusError(f"{arguments.bus}: the latency is measured on vcan0, can0 or tcp:HOST:PORT")
        if not 250 <= arguments.period_us <= 20000:
            raise ConfigError(f"--period-us {arguments.period_us}: expected 250..20000")
        if not 0.2 <= arguments.duration <= 600.0:
            raise ConfigError(f"--duration {arguments.duration:g}: expected 0.2..600 s")
        for program in (ECU_BINARY, PROBE, ECHO):
            if not program.exists():
                raise ConfigError(f"{program.relative_to(ROOT)} is not built; build it: make firmware")
        rows = measure(address, arguments.pace, arguments.period_us, arguments.duration)
        found = {"bus": arguments.bus, "pace": arguments.pace, "period_us": arguments.period_us} | figures(rows)
        if arguments.json is not None:
            arguments.json.write_text(json.dumps(found, indent=2) + "\n", "utf-8")
    except (ConfigError, BusError, OSError) as error:
        say(f"latency.py: {error}")
        return EXIT_WRONG_USE
    except MeasurementError as error:
        say(f"latency.py: {error}")
        return EXIT_FAILED
    show(f"from the last sensor frame to the valve frame on {arguments.bus}, us")
    show("            " + "".join(f"{name:>9}" for name in found["percentiles_us"]))
    for title, name in (("ECU", "percentiles_us"), ("bare echo", "echo_percentiles_us")):
        show(f"  {title:<10}" + "".join(f"{value:9.1f}" for value in found[name].values()))
    show(f"ratio: median {found['median_ratio']:.3f}, 99th percentile {found['p99_ratio']:.3f}")
    show(f"{found['count']} of {found['ticks']} ticks in RUN measured; valve frames as recorded: "
         f"{found['valve_frames_as_recorded']}")  # fmt: skip
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
