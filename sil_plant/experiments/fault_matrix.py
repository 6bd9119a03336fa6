"""The fault matrix: every kind of fault at several moments, sizes and profiles, and whether the ECU did right.

What is run and expected is data, `sil_plant/fault_matrix.toml`; the rules that hold for every row are here.
"""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from sil_plant.config import ROOT, ConfigError, TomlFile
from sil_plant.experiments.experiment import Outcome, setup_for, simulate
from sil_plant.inputs.faults import KINDS, SENSORS, Fault, size_range
from sil_plant.inputs.machine import REFERENCE_ARM, Machine, load_machine
from sil_plant.inputs.scenario import PROFILE_NAMES, LoadStep, Scenario, Segment, load_profile
from sil_plant.loop import session
from sil_plant.loop.injection import FIRST, LAST, SPIKE_CHANCE, draw
from sil_plant.loop.results import emergencies
from sil_plant.plant.dynamics import P_SWING, P_WRIST, XV, Q

TABLE = ROOT / "sil_plant" / "fault_matrix.toml"
FAULTS = ROOT / "can_protocol" / "faults.toml"
REACTIONS = ("none", "safe", "shut", "degrade", "node")
CASE_KEYS = {
    "kind", "targets", "sizes", "duration_s", "moments", "faults", "reaction", "after_ticks", "when_moved",
    "when_changed", "when_error", "may_detect", "error_factor",
}  # fmt: skip

# The run: there, a rest, and back, which is the proof that the ECU has recovered.
MOVE_S, REST_S, FAR_RAD, LOAD_KG = 0.8, 1.5, 0.4, 3.0
DURATION_S = 2 * MOVE_S + REST_S + 0.4
MOMENTS = {"top": 0.4, "end": 0.7, "rest": 1.0, "run": 0.0}
FAULT_S = 0.2
RECOVER_AFTER_S = 0.9

# The rules of every row
SAFE_TICKS = 5
REST_LIMIT_S = 0.5  # of a safe stop
HARD_REST_LIMIT_S = 0.9  # of valves that close at once: the arm swings on its oil
# At rest, rad/s. The oil that leaks past the pistons lets an arm whose valves are shut creep: 0.016 were measured on
# the wrist with 10 kg. Nothing above that is allowed.
REST_RAD_S = 0.03
NODE_SLACK_TICKS = 2  # over the node's own timeout
RECOVERED_ERROR_RAD = 5e-3  # at the end of the run
SAFE_MODES = (session.MODE_INIT, session.MODE_STANDBY, 6, session.MODE_FAULT)  # 6: SAFE_STOP
CENTRED = 1e-9
STATE_OF_SENSOR = (Q, Q + 1, P_SWING, P_SWING + 1, P_WRIST, P_WRIST + 1, XV, XV + 1)  # of faults.SENSORS


@dataclass(frozen=True)
class Case:
    """One entry of the table: what is run, and what the ECU must make of it."""

    kind: str
    targets: tuple[str, ...]
    sizes: tuple[float, ...]
    duration_s: float
    moments: tuple[str, ...]
    faults: tuple[str, ...]
    reaction: str
    after_ticks: int
    when_moved: float
    when_changed: float
    when_error: float
    may_detect: tuple[str, ...]
    error_factor: float


@dataclass(frozen=True)
class Cell:
    """One run of the matrix."""

    case: Case
    target: str
    size: float
    moment: str
    profile: str

    @property
    def fault(self) -> Fault:
        """What the scenario gets."""
        whole = self.moment == "run" and self.case.duration_s == FAULT_S
        return Fault(
            kind=self.case.kind,
            target=self.target,
            start_s=MOMENTS[self.moment],
            duration_s=0.0 if KINDS[self.case.kind].once else DURATION_S if whole else self.case.duration_s,
            size=self.size,
            recover_after_s=None if whole else RECOVER_AFTER_S,
        )


@dataclass(frozen=True)
class Row:
    """What one run showed; the keys of build/faults.json, with ``passed`` as ``pass``."""

    kind: str
    target: str
    size: float
    unit: str
    moment: str
    profile: str
    detected: str  # name of the fault, "node", a mode, or empty
    emergency: str  # its code, or empty
    after_ticks: int | None  # from when detection is possible until the valves are safe
    max_speed_rad_s: float  # from then on, until the master acts
    max_command: float
    rest_s: float | None
    recovered_by: str
    error_factor: float | None
    trace: str
    passed: bool
    why: str  # what failed, empty when nothing did


# ---- the table -----------------------------------------------------------------------------------


def load_cases(path: Path = TABLE) -> list[Case]:
    """Read and check the table.

    Raises
    ------
    ConfigError
        Naming the case and what is wrong with it.
    """
    toml = TomlFile(path)
    return [_case(toml, item, n) for n, item in enumerate(toml.data.get("case", []))]


def _case(toml: TomlFile, item: dict[str, Any], n: int) -> Case:
    for key in item:
        if key not in CASE_KEYS:
            raise toml.error(f"case.{key}", f"is not a key of a case; known are {', '.join(sorted(CASE_KEYS))}", n)
    kind = item.get("kind", "")
    if kind not in KINDS:
        raise toml.error("case.kind", f"{kind!r} is not a kind of fault; known are {', '.join(KINDS)}", n)
    targets = tuple(item.get("targets", ("",)))
    sizes = tuple(float(size) for size in item.get("sizes", (KINDS[kind].default or 0.0,)))
    for target, size in itertools.product(targets, sizes):
        if target not in (KINDS[kind].targets or ("",)):
            raise toml.error("case.targets", f"{target!r} is not a target of {kind}", n)
        low, high, unit = size_range(kind, target)
        if KINDS[kind].unit and not low <= size <= high:
            raise toml.error("case.sizes", f"{size:g} is outside {low:g} to {high:g} {unit}", n)
    moments = tuple(item.get("moments", ("top", "end", "rest")))
    if not set(moments) <= set(MOMENTS):
        raise toml.error("case.moments", f"known are {', '.join(MOMENTS)}", n)
    reaction = item.get("reaction", "")
    if reaction not in REACTIONS:
        raise toml.error("case.reaction", f"{reaction!r}: one of {', '.join(REACTIONS)} is needed", n)
    return Case(
        kind=kind,
        targets=targets,
        sizes=sizes,
        duration_s=toml.number("case.duration_s", item.get("duration_s", FAULT_S), 0.001, FAULT_S, n),
        moments=moments,
        faults=tuple(item.get("faults", ())),
        reaction=reaction,
        after_ticks=int(item.get("after_ticks", 0)),
        when_moved=float(item.get("when_moved", 0.0)),
        when_changed=float(item.get("when_changed", 0.0)),
        when_error=float(item.get("when_error", 0.0)),
        may_detect=tuple(item.get("may_detect", ())),
        error_factor=float(item.get("error_factor", 0.0)),
    )


def cells(cases: list[Case], only: str | None = None) -> Iterator[Cell]:
    """Every run of the matrix, or those of one kind."""
    for case in cases:
        if only is None or case.kind == only:
            for place in itertools.product(case.targets, case.sizes, case.moments, PROFILE_NAMES):
                yield Cell(case, *place)


# ---- one run -------------------------------------------------------------------------------------


def benchmark(faults: tuple[Fault, ...] = ()) -> Scenario:
    """The matrix's scenario."""
    there, back = Segment(FAR_RAD, MOVE_S, REST_S), Segment(0.0, MOVE_S, REST_S)
    return Scenario(
        name="fault matrix",
        duration_s=DURATION_S,
        seed=1,
        start_pose_rad=(0.0, 0.0),
        segments=((there, back), (there, back)),
        repeat=False,
        load=(LoadStep(0.0, LOAD_KG),),
        faults=faults,
    )


@cache
def error_codes() -> dict[str, int]:
    """The emergency's error code of every fault, by its name."""
    return {entry["name"]: entry["emcy"] for entry in TomlFile(FAULTS).data["fault"]}


@cache
def _machine() -> Machine:
    return load_machine(REFERENCE_ARM)


def run(profile: str, *faults: Fault) -> Outcome:
    """Run the matrix's scenario with these faults."""
    return simulate(setup_for(_machine(), load_profile(profile), benchmark(faults)))


def tracking_error(outcome: Outcome) -> np.ndarray:
    """Tracking error of both joints, rad, by tick; 0 before the ECU is in RUN."""
    record = outcome.session.record
    error = np.abs(record.state[:, :2] - record.reference)
    error[: outcome.session.timeline.run_request + 2] = 0.0
    return error


@cache
def undisturbed_error(profile: str) -> tuple[float, float]:
    """Peak tracking errors of swing and wrist without a fault."""
    swing, wrist = tracking_error(run(profile)).max(axis=0)
    return float(swing), float(wrist)


def digest(outcome: Outcome) -> str:
    """Hash of what happened: true states, valve commands on both sides, modes, emergencies."""
    record = outcome.session.record
    total = hashlib.sha256()
    for array in (record.state, record.command, record.valves, record.mode, record.emergency):
        total.update(np.ascontiguousarray(array).tobytes())
    return total.hexdigest()


def possible_tick(cell: Cell, outcome: Outcome) -> int | None:
    """The tick from which on the ECU could know; None: it never could."""
    case, run_ = cell.case, outcome.session
    first, last = int(run_.injection.plan[0, FIRST]), int(run_.injection.plan[0, LAST])
    tick = first + case.after_ticks
    if case.kind == "spiked":
        spikes = [t for t in range(first, last) if draw(run_.injection.seed, 0, t, 0) < SPIKE_CHANCE]
        return spikes[0] if spikes else None
    if case.when_moved > 0.0:
        moved = np.abs(run_.record.state[first:last, :2] - run_.record.state[first, :2])
        joints = [SENSORS.index(cell.target) % 2] if cell.target.endswith("angle") else [0, 1]
        if cell.target in SENSORS and not cell.target.endswith("angle"):
            joints = [0 if cell.target.startswith("swing") else 1]
        ticks = np.flatnonzero(moved[:, joints].max(axis=1) > case.when_moved)
        return tick + int(ticks[0]) if ticks.size else None
    if case.when_changed > 0.0:
        value = run_.record.state[first:last, STATE_OF_SENSOR[SENSORS.index(cell.target)]]
        ticks = np.flatnonzero(np.abs(value - value[0]) > case.when_changed)
        return tick + int(ticks[0]) if ticks.size else None
    if case.when_error > 0.0:
        ticks = np.flatnonzero(tracking_error(outcome)[first:last].max(axis=1) > case.when_error)
        return tick + int(ticks[0]) if ticks.size else None
    return tick if tick < last + case.after_ticks else None


def judge(cell: Cell, outcome: Outcome, again: Outcome) -> Row:
    """Hold a run, and its repetition, against the rules."""
    case, run_ = cell.case, outcome.session
    record, whole = run_.record, run_.monitor.whole
    first, last = int(run_.injection.plan[0, FIRST]), int(run_.injection.plan[0, LAST])
    acts = int(run_.injection.recover[0]) if run_.injection.recover.size else len(record.mode)
    wrong: list[str] = []

    heard = [e for e in emergencies(run_) if e.code]
    wrong.extend(
        f"{e.fault} with error code {e.code:04X}h instead of {error_codes().get(e.fault, 0):04X}h"
        for e in heard
        if e.code != error_codes().get(e.fault)
    )
    alarm = heard[0] if heard else None
    left = np.flatnonzero(np.isin(record.mode[first + 1 : acts], SAFE_MODES))
    # the mode stands on the valve frame that ends a tick, and in the next row of the record
    left_tick = first + int(left[0]) if left.size else None
    shut = np.flatnonzero(np.all(np.abs(record.valves[first:acts, :2]) < CENTRED, axis=1))
    shut_tick = first + int(shut[0]) if shut.size else None
    possible = possible_tick(cell, outcome)

    if whole[session.OUTSIDE]:
        wrong.append(f"{whole[session.OUTSIDE]} valve commands outside their limits")
    if alarm and alarm.tick < first:
        wrong.append(f"{alarm.fault} before the fault")
    if digest(outcome) != digest(again):
        wrong.append("not the same when run again")

    safe_tick = left_tick
    due: int | None = None
    if case.reaction == "node":
        timeout = run_.timing.timeout_ticks
        due, safe_tick = first + timeout + NODE_SLACK_TICKS, shut_tick
        if alarm and alarm.fault not in case.may_detect:
            wrong.append(f"{alarm.fault} instead of {' or '.join(case.may_detect) or 'nothing'}")
        possible = first + timeout
    elif case.reaction == "none":
        if alarm and alarm.fault not in case.may_detect:
            wrong.append(f"{alarm.fault} for nothing")
        if left_tick is not None:
            wrong.append(f"left RUN for {_mode(record, left_tick + 1)}")
    elif possible is not None:
        due = possible + SAFE_TICKS
        if case.reaction == "degrade":
            safe_tick = alarm.tick if alarm and (left_tick is None or alarm.tick < left_tick) else left_tick
        if case.faults and (alarm is None or alarm.fault not in case.faults):
            wrong.append(f"{alarm.fault if alarm else 'nothing'} instead of {' or '.join(case.faults)}")
    elif alarm and alarm.fault not in case.faults:
        wrong.append(f"{alarm.fault} for nothing")
    if due is not None and (safe_tick is None or safe_tick > due):
        wrong.append("valves not safe" if safe_tick is None else f"valves safe {safe_tick - due} ticks too late")

    rest_s = None
    stopped = safe_tick if case.reaction == "node" else left_tick
    after = stopped if stopped is not None else max(first, safe_tick or first)
    speed = np.abs(record.state[after:acts, 2:4]).max(axis=1)
    if stopped is not None and case.reaction != "none":
        moving = np.flatnonzero(speed > REST_RAD_S)
        rest_s = float((moving[-1] + 1 if moving.size else 0) * run_.timeline.period_s)
        limit_s = HARD_REST_LIMIT_S if case.reaction in ("node", "shut") else REST_LIMIT_S
        if rest_s > limit_s:
            wrong.append(f"not at rest {limit_s:g} s after the stop")

    recovered_by = _requests(record.mode, acts)
    if whole[session.MODE] != session.MODE_RUN:
        wrong.append(f"in {session.MODE_NAMES.get(int(whole[session.MODE]), '?')} at the end")
    elif float(tracking_error(outcome)[-100:].max()) > RECOVERED_ERROR_RAD and cell.target != "motion":
        wrong.append("does not follow after recovery")
    factor = None
    if case.error_factor > 0.0:
        plain = undisturbed_error(cell.profile)
        peaks = tracking_error(outcome).max(axis=0)
        factor = float(max(peaks[joint] / plain[joint] for joint in range(2)))
        if not factor < case.error_factor:
            wrong.append(f"tracking error {factor:.2f} times that without the fault")

    detected = alarm.fault if alarm else ""
    if not detected and left_tick is not None:
        detected = _mode(record, left_tick + 1)
    elif not detected and case.reaction == "node" and shut_tick is not None:
        detected = "node"
    return Row(
        kind=case.kind,
        target=cell.target,
        size=cell.size,
        unit=size_range(case.kind, cell.target)[2],
        moment=cell.moment,
        profile=cell.profile,
        detected=detected,
        emergency=f"{alarm.code:04X}h" if alarm else "",
        after_ticks=safe_tick - possible if safe_tick is not None and possible is not None else None,
        max_speed_rad_s=float(speed.max()) if speed.size else 0.0,
        max_command=float(np.abs(record.valves[min(after + 2, acts - 1) : acts, :2]).max()),
        rest_s=rest_s,
        recovered_by=recovered_by if last < len(record.mode) else "",
        error_factor=factor,
        trace=digest(outcome),
        passed=not wrong,
        why="; ".join(wrong),
    )


def _mode(record: session.Record, tick: int) -> str:
    return session.MODE_NAMES.get(int(record.mode[tick]), "?")


def _requests(modes: np.ndarray, acts: int) -> str:
    """The master's requests that brought the ECU back to RUN, from the modes it went through."""
    names = {session.MODE_INIT: "NMT start", session.MODE_STANDBY: "RUN", session.MODE_HOLD: "RUN"}
    names[session.MODE_FAULT] = "RESET_FAULT"
    said: list[str] = []
    for mode in modes[acts:].tolist():
        request = names.get(mode)
        if request and (not said or said[-1] != request):
            said.append(request)
    return ", ".join(said)


def measure(cell: Cell) -> Row:
    """Run a cell twice and judge it."""
    return judge(cell, run(cell.profile, cell.fault), run(cell.profile, cell.fault))


# ---- what people read ----------------------------------------------------------------------------

_COLUMNS = (
    "kind", "target", "size", "moment", "profile", "detected as", "EMCY", "ticks", "rad/s", "valve", "rest s",
    "recovered by", "",
)  # fmt: skip


def table(rows: list[Row]) -> str:
    """The matrix for people; what failed stands below its row."""
    cells_ = [_COLUMNS, *(_texts(row) for row in rows)]
    widths = [max(len(line[k]) for line in cells_) for k in range(len(_COLUMNS))]
    lines = []
    for n, line in enumerate(cells_):
        lines.append("  ".join(text.ljust(width) for text, width in zip(line, widths, strict=True)).rstrip())
        if n and rows[n - 1].why:
            lines.append(f"    {rows[n - 1].why}")
    return "\n".join(lines)


def _texts(row: Row) -> tuple[str, ...]:
    return (
        row.kind,
        row.target,
        f"{row.size:g}" if row.unit else "",
        row.moment,
        row.profile,
        row.detected or "-",
        row.emergency or "-",
        "-" if row.after_ticks is None else str(row.after_ticks),
        f"{row.max_speed_rad_s:.3f}",
        f"{row.max_command:.3f}",
        "-" if row.rest_s is None else f"{row.rest_s:.3f}",
        row.recovered_by or "-",
        "pass" if row.passed else "FAIL",
    )


def unknown_names(cases: list[Case], known: set[str]) -> list[str]:
    """Names of faults in the table that the DBC does not have."""
    named = {name for case in cases for name in (*case.faults, *case.may_detect)}
    return sorted(named - known)


def one_cell(kind: str, target: str = "", moment: str = "top", profile: str = "paper", **keys: Any) -> Cell:
    """The cell of the table with these places, for tests.

    Raises
    ------
    ConfigError
        When the table has none.
    """
    for cell in cells(load_cases(), kind):
        if (cell.target, cell.moment, cell.profile) == (target, moment, profile) and all(
            getattr(cell, key, getattr(cell.case, key, None)) == value for key, value in keys.items()
        ):
            return cell
    raise ConfigError(f"the table has no {kind} {target} {moment} {profile} {keys}")
