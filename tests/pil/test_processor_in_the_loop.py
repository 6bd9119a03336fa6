"""The Cortex-M images, run by an emulated processor, against the same law built for this computer."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import can
import numpy as np
import pytest
from emulated_board import IMAGES, ROOT, STAGES, BoardError, EmulatedBoard, Image, build

from sil_plant.bus import protocol
from sil_plant.bus.ports import connect_python_can, parse_bus
from sil_plant.inputs.machine import REFERENCE_ARM, Machine, load_machine, parameter_image
from sil_plant.inputs.scenario import DEFAULT_SCENARIO, load_scenario, with_load
from sil_plant.loop import execution, session

PERIOD_S = execution.PERIOD_US * 1e-6
# One whole run and the first moves of the others: an emulated tick takes 1.5 ms or more.
WHOLE_RUN, FIRST_MOVES = (2.5, 10.0), ((0.0, 2.0), (2.5, 3.0), (10.0, 2.0))
RUNS = [(IMAGES[0], *WHOLE_RUN), *((image, *run) for run in FIRST_MOVES for image in IMAGES)]
RUNS.remove((IMAGES[0], *FIRST_MOVES[1]))
COUNTED_S = 1.0
TICK_INSTRUCTIONS_MOST = {"cortex-m4f": 5_400, "cortex-m3": 11_500}
STACK_BYTES_MOST = 2048  # of 4096
BOOT_UP, SYNC = r"t701100\r", r"t0801[0-9A-F]{2}\r"

ImageFile = Callable[..., Path]
by_image = pytest.mark.parametrize("image", IMAGES, ids=lambda image: image.preset)


@pytest.fixture(scope="module")
def image_file() -> ImageFile:
    """Build an image once."""
    built: dict[tuple[object, ...], Path] = {}

    def build_once(image: Image, folder: str = "", *options: str) -> Path:
        key = (image, folder)
        if key not in built:
            try:
                built[key] = build(image, folder, options)
            except BoardError as error:
                pytest.fail(str(error), pytrace=False)
        return built[key]

    return build_once


def counting_image(image_file: ImageFile, image: Image) -> Path:
    return image_file(image, f"pil/{image.preset}-counting", "-DDIARC_COUNT_INSTRUCTIONS=ON")


def board(image: Image, elf: Path, counting: bool = False) -> EmulatedBoard:
    try:
        return EmulatedBoard(image, elf, counting)
    except BoardError as error:
        pytest.fail(str(error), pytrace=False)


@pytest.fixture(scope="module")
def machine() -> Machine:
    machine = load_machine(REFERENCE_ARM)
    execution.compile_plant(machine, load_scenario(DEFAULT_SCENARIO))
    return machine


def new_run(machine: Machine, load_kg: float, duration_s: float) -> session.Session:
    scenario = replace(with_load(load_scenario(DEFAULT_SCENARIO), load_kg), duration_s=duration_s)
    return session.make_session(machine, scenario, "diarc", scenario.seed, PERIOD_S, False)


def on_board(run: session.Session, emulated: EmulatedBoard) -> None:
    execution.over_bus(run, parse_bus(emulated.bus), None, b"", lambda _: emulated.check(), True)


def ticks(run: session.Session) -> int:
    return int(run.progress.index[session.TICK])


@pytest.mark.parametrize(("image", "load_kg", "duration_s"), RUNS, ids=lambda value: getattr(value, "preset", value))
def test_valve_commands_of_every_tick_are_those_of_the_host(
    image: Image, load_kg: float, duration_s: float, machine: Machine, image_file: ImageFile
) -> None:
    """GIVEN an image in an emulated processor WHEN it closes the loop with the plant THEN valve commands, estimate
    and the arm's motion have the bits of the same law built for this computer, at every tick."""
    emulated_run = new_run(machine, load_kg, duration_s)
    with board(image, image_file(image)) as emulated:
        on_board(emulated_run, emulated)
    host_run = new_run(machine, load_kg, duration_s)
    execution.in_process(host_run, parameter_image(machine), image.scalar, lambda _: None)

    assert execution.outcome(emulated_run) is None
    whole = emulated_run.monitor.whole
    assert (whole[session.LATE], whole[session.LOST], whole[session.SEND_DROPS]) == (0, 0, 0), "frames were lost"
    count = ticks(host_run)
    assert count > duration_s / PERIOD_S and ticks(emulated_run) == count
    for name in ("command", "load_est", "state"):
        ours, theirs = getattr(emulated_run.record, name)[:count], getattr(host_run.record, name)[:count]
        different = np.flatnonzero(np.any(np.atleast_2d((ours != theirs).T), axis=0))
        assert different.size == 0, f"{name} differs first at tick {different[0]}: {ours[different[0]]}"
    assert np.any(host_run.record.command[:count] != 0.0)
    assert session.trace_sha256(emulated_run.record, count) == session.trace_sha256(host_run.record, count)


@by_image
def test_command_line_closes_the_loop_with_an_image(image: Image, image_file: ImageFile, tmp_path: Path) -> None:
    """GIVEN an image in an emulated processor WHEN run.py is given its bus THEN the trace is that of the same law in
    process."""
    hashes = []
    with board(image, image_file(image)) as emulated:
        for bus in (["--bus", emulated.bus], ["--bus", "inproc", "--scalar", image.scalar]):
            path = tmp_path / f"{len(hashes)}.json"
            command = [sys.executable, "sil_plant/run.py", "--load", "2.5", "--duration", "0.3", *bus]
            command += ["--quiet", "--json", str(path)]
            done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=100, check=False)
            assert done.returncode == 0, done.stderr
            hashes.append(json.loads(path.read_text())["trace_sha256"])
    assert hashes[0] == hashes[1]


@by_image
def test_cost_of_a_tick_stays_within_its_bounds(image: Image, machine: Machine, image_file: ImageFile) -> None:
    """GIVEN a processor whose instructions take the same time each WHEN the loop is closed THEN a tick
    takes no more of them than it may, each of its stages takes some, and the stack stays within half of its room."""
    run = new_run(machine, 2.5, COUNTED_S)
    with board(image, counting_image(image_file, image), counting=True) as emulated:
        on_board(run, emulated)
        figures = emulated.figures()
    assert figures.ticks > COUNTED_S / PERIOD_S
    least, mean, most = figures.instructions["tick"]
    assert 0 < least <= mean <= most <= TICK_INSTRUCTIONS_MOST[image.preset], figures
    assert all(figures.instructions[stage][1] > 0 for stage in STAGES), figures
    assert figures.stack_bytes <= STACK_BYTES_MOST, figures


@pytest.fixture
def quiet_board(image_file: ImageFile) -> Iterator[EmulatedBoard]:
    """A board with nobody at the far end who answers SYNC."""
    with board(IMAGES[0], image_file(IMAGES[0])) as emulated:
        yield emulated


def test_ecu_starts_when_the_channel_opens_and_anew_each_time(quiet_board: EmulatedBoard) -> None:
    """GIVEN an image WHEN its channel is opened, closed, and opened again THEN it is silent until opened, boots each
    time with SYNC counter 1, and says nothing after the answer to the close."""
    with quiet_board.connect() as wire:
        assert wire.ask("V\rN\r", r"ND1AC\r") == "V1010\rND1AC\r"
        for _ in range(2):
            assert wire.ask("O\r", SYNC).startswith("\rt701100\rt080101\r")
            wire.read_until(r"t080104\r")
            wire.ask("C\r", r"(^|\r)\r")
            assert wire.ask("V\r", r"V1010\r") == "V1010\r"


def test_text_that_is_no_command_is_refused_and_harms_nothing(quiet_board: EmulatedBoard) -> None:
    """GIVEN lines that are too long, too short, no hexadecimal or out of range WHEN they are sent to a closed and to
    an open channel THEN each is refused with BEL, other kinds of frames are passed over, and the ECU goes on."""
    wrong = [
        "t",
        "t08",
        "t0801",
        "t080",
        "t0801zz",
        "t8000",
        "t0809" + 18 * "0",
        "t08011122",
        "x" * 600,
        "S9",
        "O1",
        "M",
    ]
    with quiet_board.connect() as wire:
        for line in [*wrong, "t0800", "T000000000"]:
            assert wire.ask(line + "\r", r"[\r\a]") == "\a", line
        wire.ask("O\r", SYNC)
        for line in [*wrong, "S8", "O"]:
            wire.ask(line + "\r", r"\a")
        before = wire.ask("T000000000\rr0800\rR000000000\rt0800\rV\r", r"V1010\r")
        assert "\a" not in before
        wire.read_until(SYNC)


def test_node_restarts_on_nmt_reset(quiet_board: EmulatedBoard) -> None:
    """GIVEN an open channel WHEN NMT reset is sent to node 1 THEN the ECU boots, and counts SYNC from 1."""
    with quiet_board.connect() as wire:
        wire.ask("O\r", r"t080103\r")
        wire.ask("t00028101\r", BOOT_UP)
        assert wire.read_until(SYNC) == "t080101\r"


def test_python_can_opens_the_image_as_an_adapter(quiet_board: EmulatedBoard) -> None:
    """GIVEN an image WHEN python-can opens it as a serial adapter THEN SYNC comes as CAN frames, and the version is
    told."""
    with connect_python_can(quiet_board.bus) as bus:
        end = time.monotonic() + 5.0
        messages: list[can.Message] = []
        while len(messages) < 3 and time.monotonic() < end:
            message = bus.recv(0.5)
            messages += [message] if message is not None and message.arbitration_id == protocol.SYNC_ID else []
        assert bus.get_version(5.0) == (10, 10)  # type: ignore[attr-defined]
        assert [bytes(message.data) for message in messages] == [b"\1", b"\2", b"\3"]


def test_strict_pace_ticks_by_the_timer_alone(image_file: ImageFile) -> None:
    """GIVEN an image of strict pace WHEN nobody answers SYNC THEN SYNC comes every period all the same, and never
    faster."""
    elf = image_file(IMAGES[0], "pil/strict", "-DDIARC_PACE=strict")
    with board(IMAGES[0], elf) as emulated, emulated.connect() as wire:
        wire.ask("O\r", r"t080101\r")
        start = time.monotonic()
        wire.read_until(r"t0801C9\r")
        took_s = time.monotonic() - start
    assert 0.15 < took_s < 4.0  # 200 periods; each would take 250 ms if it waited for the sensors


def test_missing_programs_are_named_with_their_packages(monkeypatch: pytest.MonkeyPatch) -> None:
    """GIVEN a machine without emulator or compiler WHEN they are needed THEN the message has the package."""
    monkeypatch.setenv("PATH", "/nonexistent")
    with pytest.raises(BoardError, match="apt-get install qemu-system-arm"):
        EmulatedBoard(IMAGES[0], Path("none"))
    with pytest.raises(BoardError, match="apt-get install gcc-arm-none-eabi"):
        build(IMAGES[0])
