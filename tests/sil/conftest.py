"""What the tests of the rig share: an ECU on the test bench, closed loops in this process, run.py as
users run it.
"""

from __future__ import annotations

import functools
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

ROOT_PATH = Path(__file__).resolve().parents[2]
ROOT = str(ROOT_PATH)
if ROOT not in sys.path:
    sys.path.insert(0, ROOT)

import numpy as np  # noqa: E402
import pytest  # noqa: E402

from sil_plant.bus import frames, protocol  # noqa: E402
from sil_plant.experiments import experiment  # noqa: E402
from sil_plant.inputs.machine import REFERENCE_ARM, Machine, load_machine, parameter_image  # noqa: E402
from sil_plant.inputs.scenario import DEFAULT_SCENARIO, Scenario, load_scenario, with_load  # noqa: E402
from sil_plant.loop import inproc, results, session  # noqa: E402
from tests.sil.bounded import run_bounded  # noqa: E402

RUN_PY = ROOT_PATH / "sil_plant" / "run.py"
ECU_BINARY = ROOT_PATH / "firmware" / "diarc_ecu"
PERIOD_S = 1e-3
LIMIT_S = 60.0  # for one run.py; reaching it is a failure

Frame = tuple[int, bytes]


@pytest.fixture(scope="session")
def machine() -> Machine:
    """The reference arm."""
    return load_machine(REFERENCE_ARM)


@pytest.fixture(scope="session")
def image(machine: Machine) -> bytes:
    """The reference arm's parameter image."""
    return parameter_image(machine)


@pytest.fixture(scope="session")
def paper() -> Scenario:
    """The paper's benchmark."""
    return load_scenario(DEFAULT_SCENARIO)


# ---- the ECU on the bench ------------------------------------------------------------------------


# No supervision but that of frames: for tests that show the ECU sensor values no arm could have.
OPEN_LIMITS = {
    "supervision.angle_range_rad": 7.0,
    "supervision.angle_margin_rad": 7.0,
    "supervision.tracking_error_rad": 7.0,
    "supervision.swing.rate_rad_s": 30.0,
    "supervision.wrist.rate_rad_s": 30.0,
    "supervision.pressure_range_Pa": 3.2767e7,
    "supervision.pressure_max_Pa": 3.2767e7,
    "supervision.pressure_step_Pa": 3.3e7,
    "supervision.pressure_min_Pa": 0.0,
    "supervision.stuck_rad": 30.0,
    "supervision.stuck_s": 30.0,
    "supervision.saturation_s": 30.0,
    "supervision.bound_s": 30.0,
    "supervision.mismatch_updates": 30.0,
    "supervision.contradiction_rad_s": 30.0,
    "supervision.spool_error": 2.0,
}
REQUESTS = {
    code: str(name)
    for code, name in protocol.database().get_message_by_name("MOTION").get_signal_by_name("Request").choices.items()
}


@pytest.fixture(scope="session")
def open_limits() -> dict[str, float]:
    """The limits wide open, by their keys in a machine file."""
    return dict(OPEN_LIMITS)


@pytest.fixture(scope="session")
def open_image(machine: Machine) -> Callable[..., bytes]:
    """Parameter images with the limits wide open: ``open_image(changes)``."""

    def image_of(changes: dict[str, float] | None = None) -> bytes:
        return parameter_image(machine, OPEN_LIMITS | (changes or {}))

    return image_of


class Bench:
    """The firmware in this process, with hand-made sensors in the place of a plant.

    Frames to the ECU are packed by cantools from raw integers, those from it are taken as they are.
    """

    def __init__(self, image: bytes | None = None, scalar: str = "double", period_us: int = 1000) -> None:
        self.ecu = inproc.InprocEcu(image, period_us, scalar)
        self.sync = 0
        self.ticks = 0
        self.motions = 0
        self.raw = {
            "ENCODERS": {"SwingAngle": 0, "WristAngle": 0},
            "PRESSURES_SWING": {"BorePressure": 8000, "AnnulusPressure": 12000, "SpoolPosition": 0},
            "PRESSURES_WRIST": {"BorePressure": 9000, "AnnulusPressure": 11000, "SpoolPosition": 0},
        }
        self._packed: dict[tuple, bytes] = {}

    def row(self, name: str, raw: dict[str, int], counter: int) -> np.ndarray:
        """A protected frame row from raw integers; signals left out are 0."""
        key = (name, tuple(raw.values()))
        message = protocol.database().get_message_by_name(name)
        if key not in self._packed:
            values = dict.fromkeys((s.name for s in message.signals), 0) | raw
            self._packed[key] = message.encode(values, scaling=False, strict=False)
        row = frames.to_row(message.frame_id, self._packed[key])
        frames.protect(row, counter)
        return row

    def motion(self, request: str, **raw: int) -> np.ndarray:
        """A motion command; request by its name in the DBC."""
        number = {name: code for code, name in REQUESTS.items()}[request]
        self.motions += 1
        return self.row("MOTION", {"Request": number, "Duration": 1} | raw, self.motions % 15)

    def tick(self, extra: Sequence[np.ndarray] = (), sensors: Sequence[np.ndarray] | None = None) -> list[Frame]:
        """One tick on the present raw values; all frames the ECU sent."""
        sent = [frames.from_row(row) for row in self.ecu.tick_begin()]
        self.sync = next(data[0] for can_id, data in sent if can_id == protocol.SYNC_ID)
        if sensors is None:
            sensors = self.sensors()
        rows = np.array([*extra, *sensors], dtype=np.uint8)
        sent += [frames.from_row(row) for row in self.ecu.tick_end(rows)]
        self.ticks += 1
        return sent

    def sensors(self) -> list[np.ndarray]:
        """The sensor frames that answer the last SYNC."""
        return [self.row(name, raw, (self.sync - 1) % 15) for name, raw in self.raw.items()]

    def start(self) -> None:
        """NMT start; in STANDBY afterwards."""
        self.tick([session.nmt_frame(session.NMT_START)])
        assert self.mode() == "STANDBY"

    def run(self, controller: int = 2) -> None:
        """Arm; in RUN afterwards."""
        self.tick([self.motion("RUN", Controller=controller)])

    def to_standby(self) -> None:
        """Back to STANDBY at once: the network stops and starts."""
        self.tick([session.nmt_frame(session.NMT_STOP)])
        self.tick([session.nmt_frame(session.NMT_START)])

    def mode(self) -> str:
        """Mode on the next valve frame."""
        return str(self.until("VALVES")["Mode"])

    def until(self, name: str, mux: tuple[str, int] | None = None, ticks: int = 200) -> dict:
        """Tick until the ECU has sent this frame (and page); its signals, physical."""
        message = protocol.database().get_message_by_name(name)
        for _ in range(ticks):
            for can_id, data in self.tick():
                if can_id != message.frame_id:
                    continue
                if mux is None or message.decode(data, decode_choices=False)[mux[0]] == mux[1]:
                    return message.decode(data)
        raise AssertionError(f"no {name} {mux or ''} within {ticks} ticks")


@pytest.fixture(scope="session")
def bench() -> type[Bench]:
    """The class of ECUs on the bench: ``bench(image, scalar)``."""
    return Bench


@dataclass(frozen=True)
class LoggedFrame:
    """One frame on the in-process bus."""

    tick: int
    from_ecu: bool
    can_id: int
    data: bytes


@pytest.fixture(scope="session")
def bus_log(machine: Machine, image: bytes, paper: Scenario) -> list[LoggedFrame]:
    """Every frame of a closed loop of 1401 ticks, 3 kg, both directions, in order."""
    run = session.make_session(machine, replace(paper, duration_s=1.3), "diarc", 1, PERIOD_S)
    ecu = inproc.InprocEcu(image)
    out = np.zeros((session.OUT_ROWS, frames.FRAME_BYTES), dtype=np.uint8)
    log: list[LoggedFrame] = []
    for tick in range(len(run.noise)):
        rows = 0
        for row in ecu.tick_begin():
            log.append(LoggedFrame(tick, True, *frames.from_row(row)))
            if frames.frame_id(row) == protocol.SYNC_ID:
                rows = session.on_sync(run, int(row[frames.DATA]), out)
        log += [LoggedFrame(tick, False, *frames.from_row(row)) for row in out[:rows]]
        for row in ecu.tick_end(out[:rows]):
            log.append(LoggedFrame(tick, True, *frames.from_row(row)))
            session.on_frame(run, row)
    assert run.monitor.whole[session.MODE] == session.MODE_RUN
    return log


# ---- closed loops in this process ----------------------------------------------------------------


@dataclass(frozen=True)
class Outcome:
    """A closed loop that has ended."""

    result: results.Result
    record: session.Record


Simulate = Callable[..., Outcome]


@pytest.fixture(scope="session")
def simulate(machine: Machine, paper: Scenario) -> Simulate:
    """Run the paper's benchmark in process: ``simulate(load, controller, seed, scalar, duration, image)``."""

    @functools.cache
    def run(
        load: float = 3.0,
        controller: str = "diarc",
        seed: int = 1,
        scalar: str = "double",
        duration: float = 10.0,
        built_in: bool = False,
    ) -> Outcome:
        scenario = replace(with_load(paper, load), duration_s=duration, seed=seed)
        setup = experiment.Setup(machine, machine, scenario, controller, seed, scalar=scalar)
        if built_in:
            with pytest.MonkeyPatch.context() as patch:
                patch.setattr(experiment, "parameter_image", lambda _: None)
                outcome = experiment.simulate(setup)
        else:
            outcome = experiment.simulate(setup)
        assert not outcome.faulted and not outcome.session.monitor.whole[session.REFUSED]
        return Outcome(outcome.result, outcome.session.record)

    return run


# ---- run.py as users run it ----------------------------------------------------------------------


def run_py_argv(*arguments: object) -> list[str]:
    """Command line of run.py."""
    return [sys.executable, str(RUN_PY), *map(str, arguments)]


@pytest.fixture(scope="session")
def run_py() -> Callable[..., subprocess.CompletedProcess]:
    """Run run.py to its end: ``run_py(*arguments, timeout_s=..., cwd=...)``."""

    def run(*arguments: object, timeout_s: float = LIMIT_S, **options) -> subprocess.CompletedProcess:
        return run_bounded(run_py_argv(*arguments), timeout_s, **options)

    return run


class Started:
    """A process that a test talks to while it runs; ended with all its children when the test ends."""

    def __init__(self, argv: Sequence[str], folder: Path, name: str) -> None:
        self.out, self.err = folder / f"{name}.out", folder / f"{name}.err"
        with self.out.open("w") as out, self.err.open("w") as err:
            self.process = subprocess.Popen(
                argv, stdin=subprocess.DEVNULL, stdout=out, stderr=err, start_new_session=True
            )

    def wait(self, timeout_s: float = LIMIT_S) -> int:
        """Its exit status; fails at the time limit."""
        try:
            return self.process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            pytest.fail(f"still running after {timeout_s} s: {self.process.args}\n{self.err.read_text()}")

    def kill_group(self) -> None:
        """End it and its children, whatever state they are in."""
        try:
            os.killpg(self.process.pid, signal.SIGKILL)
        except ProcessLookupError:
            pass
        self.process.wait()


@pytest.fixture
def start(tmp_path: Path):
    """Start a process: ``start(argv, name)``; nothing of it outlives the test."""
    started: list[Started] = []

    def begin(argv: Sequence[object], name: str) -> Started:
        started.append(Started([str(word) for word in argv], tmp_path, name))
        return started[-1]

    yield begin
    for process in started:
        process.kill_group()


@pytest.fixture
def start_run_py(start):
    """Start run.py: ``start_run_py(*arguments)``."""
    return lambda *arguments: start(run_py_argv(*arguments), "run")


@pytest.fixture
def start_ecu(start):
    """Start an ECU process: ``start_ecu(bus, *flags)``."""
    return lambda *arguments: start([ECU_BINARY, *arguments], "ecu")
