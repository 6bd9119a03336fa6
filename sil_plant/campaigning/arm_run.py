"""One arm from beginning to end: commissioned, operated, measured; and the same for a batch, in whatever process."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from sil_plant.campaigning.sampling import Arm, prepared
from sil_plant.campaigning.spec import Base
from sil_plant.config import ROOT, ConfigError
from sil_plant.experiments.commissioning import check_excitation, findings
from sil_plant.experiments.experiment import Outcome, Setup, commissioning_setup, setup_for, simulate
from sil_plant.inputs.machine import JOINT_NAMES, with_changes
from sil_plant.loop.execution import outcome as problem_of
from sil_plant.loop.inproc import LIBRARIES
from sil_plant.loop.io_node import node_errors
from sil_plant.loop.results import emergencies
from sil_plant.loop.session import FAULTED, MODE_COMMISSION

# How an arm can end, in order of how far it came.
CANNOT_START = "cannot start"  # a cylinder cannot hold the load at the start
COMMISSIONING_FAULTED = "commissioning faulted"
NOT_COMMISSIONED = "commissioning refused"
FAULT = "fault"
OK = "ok"
STATUSES = (CANNOT_START, COMMISSIONING_FAULTED, NOT_COMMISSIONED, FAULT, OK)

# Which pressure sensor is how far off follows from the sensor set's number; the report wants it in numbers.
SENSOR_NAMES = tuple(f"{joint}.{chamber}" for joint in JOINT_NAMES for chamber in ("bore", "annulus"))
FIGURE_COLUMNS = (
    "load_true_kg",
    "load_est_kg",
    "load_err_kg",
    "load_settle_s",
    *(f"{joint}_{figure}_rad" for figure in ("peak_err", "peak_err_after_1s", "rms_err") for joint in JOINT_NAMES),
)
SOURCES = (
    *("sil_plant/**/*.py", "can_protocol/diarc.dbc", "can_protocol/parameters.toml"),
    "build/lib/libdiarc_inproc_double.so",
)
LIBRARIES_THAT_COUNT = ("numba", "numpy", "scipy")
MODULE = "sil_plant.campaigning.arm_run"


class OtherCodeError(Exception):
    """A worker whose sources or firmware are not those of the campaign."""


@dataclass(frozen=True)
class ArmRun:
    """What an arm did."""

    status: str
    reason: str
    setup: Setup | None = None  # of the operation
    operation: Outcome | None = None


@cache
def code_hash() -> str:
    """SHA-256 over everything that turns an arm into figures: plant, firmware, frames, and the libraries' releases.

    Raises
    ------
    ConfigError
        When the firmware is not built.
    """
    digest = hashlib.sha256()
    if not (LIBRARIES / "libdiarc_inproc_double.so").exists():
        raise ConfigError("the in-process firmware libdiarc_inproc_double.so is not there; build it: make firmware")
    for pattern in SOURCES:
        for path in sorted(ROOT.glob(pattern)):
            digest.update(str(path.relative_to(ROOT)).encode() + b"\0" + path.read_bytes())
    for name in LIBRARIES_THAT_COUNT:
        digest.update(f"{name} {version(name)}\n".encode())
    return digest.hexdigest()


def run_arm(base: Base, arm: Arm) -> ArmRun:
    """Commission an arm where the campaign asks for it, then operate it.

    Parameters
    ----------
    base : Base
        What all arms share.
    arm : Arm
        This one.
    """
    machine, scenario, move = prepared(base, arm)
    if move is not None:
        identification = commissioning_setup(machine, base.profile, arm.commission_seed, move)
        try:
            done = simulate(identification)
        except ValueError as error:
            return ArmRun(CANNOT_START, f"commissioning: {error}")
        problem = problem_of(done.session, MODE_COMMISSION)
        if problem:
            return ArmRun(COMMISSIONING_FAULTED, problem)
        try:
            found = findings(machine, done.session.monitor)
            check_excitation(found)
        except ConfigError as error:
            return ArmRun(NOT_COMMISSIONED, str(error))
        machine = with_changes(machine, {f"estimator.prior.{f.prior}.value": f.value for f in found}, "commissioned")
    setup = setup_for(machine, base.profile, scenario, controller=base.controller, seed=arm.seed)
    try:
        done = simulate(setup)
    except ValueError as error:
        return ArmRun(CANNOT_START, str(error), setup)
    problem = problem_of(done.session)
    return ArmRun(FAULT if problem else OK, problem or "", setup, done)


def row_of(base: Base, arm: Arm, run: ArmRun) -> dict[str, Any]:
    """An arm and what it did as a row of the results; None where there is no figure."""
    row: dict[str, Any] = {
        "run": arm.run,
        "status": run.status,
        "reason": run.reason,
        "seed": arm.seed,
        "commission_seed": arm.commission_seed,
    }
    row |= arm.draws
    row |= sensor_gains(base, arm)
    row |= dict.fromkeys(FIGURE_COLUMNS)
    row |= {"faulted": run.status in (COMMISSIONING_FAULTED, FAULT), "faults": "", "lost_frames": 0, "ticks": 0}
    row["trace_sha256"] = ""
    if run.operation is None:
        return row
    result = run.operation.result
    row |= {
        "load_true_kg": result.load_true_kg,
        "load_est_kg": result.load_est_kg,
        "load_err_kg": result.load_err_kg,
        "load_settle_s": result.load_settle_s,
        "lost_frames": result.lost_frames,
        "ticks": result.ticks,
        "trace_sha256": result.trace_sha256,
    }
    for joint, name in enumerate(JOINT_NAMES):
        row[f"{name}_peak_err_rad"] = result.peak_err_rad[joint]
        row[f"{name}_peak_err_after_1s_rad"] = result.peak_err_after_1s_rad[joint]
        row[f"{name}_rms_err_rad"] = result.rms_err_rad[joint]
    row["faulted"] = row["faulted"] or bool(run.operation.session.monitor.whole[FAULTED])
    named = [emergency.fault for emergency in emergencies(run.operation.session) if emergency.code]
    row["faults"] = ", ".join(dict.fromkeys(named))
    for name in FIGURE_COLUMNS:  # a plant that has run away has no figures
        if row[name] is not None and not np.isfinite(row[name]):
            row[name] = None
    return row


def sensor_gains(base: Base, arm: Arm) -> dict[str, float]:
    """Gain error of each pressure sensor of an arm, where the campaign varies them."""
    if not has_sensor_gains(arm.values):
        return {}
    machine, scenario, _ = prepared(base, arm)
    gains = node_errors(setup_for(machine, base.profile, scenario).plant_machine).pressure_gain
    return {sensor_column(name): float(gain) - 1.0 for name, gain in zip(SENSOR_NAMES, gains, strict=True)}


def has_sensor_gains(values: Any) -> bool:
    """Whether the pressure sensors differ from arm to arm."""
    return any(key in values for key in ("effects.pressure_gain_error", "effects.sensor_set"))


def sensor_column(name: str) -> str:
    """The column of a sensor's gain error."""
    return f"gain error of {name}"


def run_batch(base: Base, arms: Sequence[Arm], code: str) -> list[dict[str, Any]]:
    """The rows of some arms; refuses to compute them with other code than the campaign's.

    Raises
    ------
    OtherCodeError
        When this process has other sources or another firmware.
    """
    if code_hash() != code:
        raise OtherCodeError("has other sources, another firmware or other releases of numpy, scipy or numba")
    return [row_of(base, arm, run_arm(base, arm)) for arm in arms]


def warm_up(base: Base) -> None:
    """Compile what these arms need, once, before several processes want it at the same time."""
    from sil_plant.loop.execution import compile_plant

    short = replace(base.scenario, plant={})
    compile_plant(base.machine, short)
    if base.scenario.faults:  # commissioning has none
        compile_plant(base.machine, replace(short, faults=()))


def source_root() -> Path:
    """The folder that a worker has to find ``sil_plant`` in."""
    return ROOT
