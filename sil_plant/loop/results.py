"""What a run showed: the figures, the table for people, and the JSON and CSV for programs."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sil_plant.bus import protocol
from sil_plant.config import ConfigError
from sil_plant.inputs.faults import Fault
from sil_plant.loop.session import (
    EMERGENCIES,
    LOST,
    MODE_NAMES,
    TICK,
    Record,
    Session,
    Timeline,
    sync_lost,
    trace_sha256,
)

if TYPE_CHECKING:
    from sil_plant.loop.control_channel import Command

LOAD_BAND_KG = 0.1
AFTER_S = 1.0
CSV_COLUMNS = (
    "t_s,swing_rad,wrist_rad,swing_rad_s,wrist_rad_s,swing_bore_Pa,swing_annulus_Pa,wrist_bore_Pa,"
    "wrist_annulus_Pa,swing_spool,wrist_spool,swing_spool_1_s,wrist_spool_1_s,swing_command,wrist_command,"
    "swing_reference_rad,wrist_reference_rad,load_true_kg,load_est_kg,load_sd_kg,mode"
).split(",")


@dataclass(frozen=True)
class Result:
    """Figures of one run; the JSON's keys. Lists are swing, then wrist; None where a run was too short."""

    load_true_kg: float | None  # and all that follows from it: None where the plant does not say it
    load_est_kg: float
    load_err_kg: float | None
    load_settle_s: float | None
    peak_err_rad: list[float]
    peak_err_after_1s_rad: list[float | None]
    rms_err_rad: list[float]
    rho_s: list[float | None]
    controller: str
    arm: str
    scenario: str
    seed: int
    bus: str
    ticks: int
    lost_frames: int
    wall_s: float
    realtime_factor: float
    trace_sha256: str


@dataclass(frozen=True)
class Run:
    """What was run, how, and how long it took."""

    controller: str
    arm: str
    scenario: str
    seed: int
    bus: str
    timeline: Timeline
    ticks: int
    lost_frames: int
    wall_s: float
    load_est_kg: float


def run_of(session: Session, controller: str, arm: str, scenario: str, seed: int, bus: str, wall_s: float) -> Run:
    """Describe a session that has ended, whole or broken off; what it was called, and its wall time, s."""
    return Run(
        controller=controller,
        arm=arm,
        scenario=scenario,
        seed=seed,
        bus=bus,
        timeline=session.timeline,
        ticks=int(session.progress.index[TICK]),
        lost_frames=int(session.monitor.whole[LOST] + sync_lost(session)),
        wall_s=wall_s,
        load_est_kg=float(session.monitor.load[0]),
    )


def settling_time(record: Record, ticks: int, timeline: Timeline) -> float | None:
    """From the start of motion until the load error stays within 0.1 kg; None if it never does."""
    start = timeline.motion
    error = np.abs(record.load_est[start:ticks] - record.load_true[start:ticks])
    if np.isnan(error).any():
        return None
    outside = np.nonzero(error > LOAD_BAND_KG)[0]
    if error.size == 0 or (outside.size and outside[-1] == error.size - 1):
        return None
    return float((outside[-1] + 1) * timeline.period_s) if outside.size else 0.0


def summarise(record: Record, run: Run) -> Result:
    """The figures of a run, whole or broken off.

    Parameters
    ----------
    record : Record
        Its rows.
    run : Run
        What it was.
    """
    ticks = run.ticks
    timeline = run.timeline
    armed = min(timeline.run_request + 1, ticks)
    late = min(timeline.motion + round(AFTER_S / timeline.period_s), ticks)
    error = record.state[:ticks, :2] - record.reference[:ticks]
    after, whole = np.abs(error[late:]), np.abs(error[armed:])
    speed = np.abs(record.state[late:ticks, 2:4])
    peak_after = [float(v) for v in after.max(axis=0)] if after.size else [None, None]
    rho = [
        float(after[:, j].max() / speed[:, j].max()) if after.size and speed[:, j].max() > 1e-3 else None
        for j in range(2)
    ]
    load_true = float(record.load_true[ticks - 1]) if ticks else 0.0
    is_load_known = not np.isnan(load_true)
    simulated_s = ticks * timeline.period_s
    return Result(
        load_true_kg=load_true if is_load_known else None,
        load_est_kg=run.load_est_kg,
        load_err_kg=run.load_est_kg - load_true if is_load_known else None,
        load_settle_s=settling_time(record, ticks, timeline),
        peak_err_rad=[float(v) for v in whole.max(axis=0)] if whole.size else [0.0, 0.0],
        peak_err_after_1s_rad=peak_after,
        rms_err_rad=[float(v) for v in np.sqrt((whole**2).mean(axis=0))] if whole.size else [0.0, 0.0],
        rho_s=rho,
        controller=run.controller,
        arm=run.arm,
        scenario=run.scenario,
        seed=run.seed,
        bus=run.bus,
        ticks=ticks,
        lost_frames=run.lost_frames,
        wall_s=run.wall_s,
        realtime_factor=simulated_s / run.wall_s if run.wall_s > 0.0 else 0.0,
        trace_sha256=trace_sha256(record, ticks),
    )


def table(result: Result, bus_load: float) -> str:
    """The short table that a run ends with."""

    def both(values: list[float] | list[float | None]) -> str:
        return "  ".join("      -" if v is None else f"{v * 1e3:7.4f}" for v in values)

    load = f"estimated {result.load_est_kg:.3f} kg   true: not told by the plant"
    if result.load_true_kg is not None and result.load_err_kg is not None:
        load = (
            f"true {result.load_true_kg:.3f} kg   estimated {result.load_est_kg:.3f} kg   "
            f"error {result.load_err_kg:+.4f} kg"
        )
    settle = "never" if result.load_settle_s is None else f"{result.load_settle_s:.3f} s"
    return "\n".join(
        [
            f"{result.scenario} on {result.arm}, {result.controller}, seed {result.seed}, bus {result.bus}",
            f"  load              {load}",
            f"  within 0.1 kg     {settle if result.load_true_kg is not None else '-'} after motion starts",
            "  errors, mrad        swing    wrist",
            f"    peak            {both(result.peak_err_rad)}",
            f"    peak after 1 s  {both(result.peak_err_after_1s_rad)}",
            f"    rms             {both(result.rms_err_rad)}",
            f"  frames            {result.lost_frames} lost; bus load {100.0 * bus_load:.0f} % of 1 Mbit/s at worst",
            f"  time              {result.ticks} ticks in {result.wall_s:.2f} s: "
            f"{result.realtime_factor:.1f} times real time",
        ]
    )


@dataclass(frozen=True)
class Emergency:
    """One emergency frame of the ECU."""

    tick: int
    code: int
    fault: str  # its name in the DBC


def _fault_choices() -> dict[int, str]:
    signal = protocol.database().get_message_by_name("TIMING").get_signal_by_name("FaultCode")
    return {int(code): str(name) for code, name in (signal.choices or {}).items()}


def fault_names() -> set[str]:
    """Names of the ECU's faults in the DBC."""
    return set(_fault_choices().values())


def emergencies(session: Session) -> list[Emergency]:
    """Every emergency frame of a run; error code 0: the fault is over."""
    names = _fault_choices()
    rows = session.record.emergency[: session.monitor.whole[EMERGENCIES]].tolist()
    return [Emergency(tick, code, names.get(fault, str(fault))) for tick, code, fault in rows]


def fault_lines(session: Session, faults: tuple[Fault, ...]) -> list[str]:
    """What was broken on purpose and what the ECU said, for the table."""
    zero, period_s = session.timeline.motion, session.timeline.period_s
    lines = [f"  {'fault' if n else 'faults':17} {fault.text()}" for n, fault in enumerate(faults)]
    for emergency in emergencies(session) if faults else []:
        what = f"{emergency.fault}, {emergency.code:04X}h" if emergency.code else "over"
        lines.append(f"  emergency         {(emergency.tick - zero) * period_s:.3f} s: {what}")
    return lines


def check_writable(path: Path) -> None:
    """Make sure, before a run, that its results can be written.

    Raises
    ------
    ConfigError
        Saying why not.
    """
    if not path.resolve().parent.is_dir():
        raise ConfigError(f"{path}: its folder does not exist")
    there = path.exists()
    try:
        path.open("a").close()
        if not there:
            path.unlink()
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written: {error.strerror}; choose another file or folder") from error


def command_lines(commands: Sequence[Command]) -> list[str]:
    """What was asked of the plant while it ran, for the table."""
    return [f"  {'asked for':17} {command.time_s:.3f} s: {command.what}" for command in commands]


def write_json(path: Path, result: Result, commands: Sequence[Command] | None = None) -> None:
    """Write the figures, and what was asked of the plant where that was possible.

    Raises
    ------
    ConfigError
        When the file cannot be written.
    """
    facts = asdict(result)
    if commands is not None:
        facts["commands"] = [asdict(command) for command in commands]
    _write(path, json.dumps(facts, indent=2) + "\n")


def write_csv(path: Path, record: Record, run: Run) -> None:
    """Write the record, one row per tick.

    Raises
    ------
    ConfigError
        When the file cannot be written.
    """
    n = run.ticks
    columns = np.column_stack(
        [
            (np.arange(n) - run.timeline.motion) * run.timeline.period_s,
            record.state[:n],
            record.command[:n],
            record.reference[:n],
            record.load_true[:n],
            record.load_est[:n],
            record.load_sd[:n],
        ]
    )
    try:
        with path.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow(CSV_COLUMNS)
            for row, mode in zip(columns.tolist(), record.mode[:n].tolist(), strict=True):
                numbers = ("" if math.isnan(value) else f"{value:.9g}" for value in row)
                writer.writerow([*numbers, MODE_NAMES.get(mode, str(mode))])
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written: {error.strerror}") from error


def _write(path: Path, text: str) -> None:
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written: {error.strerror}") from error
