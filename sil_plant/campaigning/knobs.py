"""What a campaign can turn: every key by name, its range, its nominal value, and how a value of it gets into a run.

Four kinds of keys: numbers of the machine file and effects, which the plant gets (those of ``control``, ``estimator``
and ``supervision`` the ECU); the load; poses and moves; the faults of the scenario. docs/campaigns.md lists them.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

from sil_plant.config import ConfigError
from sil_plant.inputs.faults import KINDS, LONGEST_FAULT_S, size_range
from sil_plant.inputs.machine import JOINT_NAMES, Machine, key_ranges, with_changes
from sil_plant.inputs.scenario import (
    LONGEST_MOVE_S,
    LONGEST_RUN_S,
    SHORTEST_MOVE_S,
    LoadStep,
    Scenario,
    Segment,
    with_load,
)

ECU_SECTIONS = ("control.", "estimator.", "supervision.")
LOAD = "load_kg"
SPEED_RAD_S = (1e-3, 10.0)
SEPTIC_PEAK = 35.0 / 16.0  # peak speed of a move of one radian in one second
WHOLE = ("effects.encoder_bits", "effects.sensor_set", "arm.friction_at_cylinder")
_START = re.compile(r"start_pose\.(swing|wrist)_rad")
_SEGMENT = re.compile(r"(swing|wrist)\.segment\.(\d+|\*)\.(target_rad|duration_s|dwell_s)")
_SPEED = re.compile(r"(swing|wrist)\.speed_rad_s")
_STEP = re.compile(r"load\.(\d+)\.(time_s|load_kg)")
_FAULT = re.compile(r"faults\.(\d+)\.(present|start_s|duration_s|size|recover_after_s)")


@dataclass(frozen=True)
class Knob:
    """A key that can be varied.

    Attributes
    ----------
    key : str
        Its name.
    low, high : float
        Both allowed.
    nominal : float or None
        The value without the campaign; None where there is none.
    """

    key: str
    low: float
    high: float
    nominal: float | None


def is_ecu_key(key: str) -> bool:
    """Whether a number of the machine file is the ECU's, not the plant's."""
    return key.startswith(ECU_SECTIONS)


def knobs(ecu_machine: Machine, plant_machine: Machine, scenario: Scenario) -> dict[str, Knob]:
    """Everything that can be varied in a run of this machine and scenario.

    Parameters
    ----------
    ecu_machine, plant_machine : Machine
        As the run has them without the campaign; they give the nominal values.
    scenario : Scenario
        The run.
    """
    found = []
    for key, (low, high) in key_ranges().items():
        machine = ecu_machine if is_ecu_key(key) else plant_machine
        found.append(Knob(key, low, high, machine.values.get(key)))
    heaviest = ecu_machine["estimator.prior.m_t_kg.high"]
    found.append(Knob(LOAD, 0.0, heaviest, scenario.load[0].load_kg if len(scenario.load) == 1 else None))
    for n, step in enumerate(scenario.load, start=1):
        found.append(Knob(f"load.{n}.load_kg", 0.0, heaviest, step.load_kg))
        if n > 1:
            found.append(Knob(f"load.{n}.time_s", 0.0, scenario.duration_s, step.time_s))
    for joint, name in enumerate(JOINT_NAMES):
        low, high = ecu_machine[f"{name}.q_min_rad"], ecu_machine[f"{name}.q_max_rad"]
        found.append(Knob(f"start_pose.{name}_rad", low, high, scenario.start_pose_rad[joint]))
        ends = {
            "target_rad": (low, high),
            "duration_s": (SHORTEST_MOVE_S, LONGEST_MOVE_S),
            "dwell_s": (0.0, LONGEST_RUN_S),
        }
        for n, segment in enumerate(scenario.segments[joint], start=1):
            found += [Knob(f"{name}.segment.{n}.{part}", *ends[part], getattr(segment, part)) for part in ends]
        if scenario.segments[joint]:
            found += [Knob(f"{name}.segment.*.{part}", *ends[part], None) for part in ends]
            found.append(Knob(f"{name}.speed_rad_s", *SPEED_RAD_S, None))
    for n, fault in enumerate(scenario.faults, start=1):
        stem, kind = f"faults.{n}", KINDS[fault.kind]
        found.append(Knob(f"{stem}.present", 0.0, 1.0, 1.0))
        found.append(Knob(f"{stem}.start_s", 0.0, scenario.duration_s, fault.start_s))
        if not kind.once:
            found.append(Knob(f"{stem}.duration_s", 0.001, scenario.duration_s, fault.duration_s))
        if kind.unit:
            found.append(Knob(f"{stem}.size", *size_range(fault.kind, fault.target)[:2], fault.size))
        found.append(Knob(f"{stem}.recover_after_s", 0.0, LONGEST_FAULT_S, fault.recover_after_s))
    return {knob.key: knob for knob in found}


def whole(key: str, scenario: Scenario) -> bool:
    """Whether only whole numbers make sense for a key."""
    match = _FAULT.fullmatch(key)
    if match and match[2] == "size":
        return KINDS[scenario.faults[int(match[1]) - 1].kind].whole
    return key in WHOLE or bool(match and match[2] == "present")


def near(key: str, known: Iterable[str]) -> str:
    """Names that an unknown one may have meant, for a message."""
    names = list(known)
    last = key.rsplit(".", 1)[-1]
    close = difflib.get_close_matches(key, names, 4, 0.6)
    close += [name for name in names if name.rsplit(".", 1)[-1] == last and name not in close][:4]
    return f"; near it: {', '.join(close[:4])}" if close else ""


def turned(machine: Machine, scenario: Scenario, values: Mapping[str, float]) -> tuple[Machine, Scenario]:
    """The machine as the ECU believes it and the scenario, with values of knobs in them.

    Parameters
    ----------
    machine : Machine
        The ECU's; numbers of the plant go into the scenario's ``plant``.
    scenario : Scenario
        The run.
    values : dict
        By key; checked against the knobs' ranges already.
    """
    ecu, plant = plant_values(values)
    machine = with_changes(machine, ecu, "campaign")
    scenario = replace(scenario, plant=scenario.plant | plant)
    if LOAD in values:
        scenario = with_load(scenario, values[LOAD])
    steps = list(scenario.load)
    pose = list(scenario.start_pose_rad)
    segments = [list(of_joint) for of_joint in scenario.segments]
    for key, value in values.items():
        if match := _STEP.fullmatch(key):
            n = int(match[1]) - 1
            steps[n] = replace(steps[n], **{match[2]: value})
        elif match := _START.fullmatch(key):
            pose[JOINT_NAMES.index(match[1])] = value
        elif match := _SEGMENT.fullmatch(key):
            of_joint = segments[JOINT_NAMES.index(match[1])]
            for n in range(len(of_joint)) if match[2] == "*" else [int(match[2]) - 1]:
                of_joint[n] = replace(of_joint[n], **{match[3]: value})
    for key, value in values.items():  # last: the speed makes durations of poses
        if match := _SPEED.fullmatch(key):
            joint = JOINT_NAMES.index(match[1])
            segments[joint] = _at_speed(segments[joint], pose[joint], value, scenario.repeat)
    _check_steps(steps)
    scenario = replace(
        scenario,
        load=tuple(steps),
        start_pose_rad=(pose[0], pose[1]),
        segments=(tuple(segments[0]), tuple(segments[1])),
    )
    return machine, _with_faults(scenario, values)


def plant_values(values: Mapping[str, float]) -> tuple[dict[str, float], dict[str, float]]:
    """Those of the values that are the machine's: the ECU's, and the plant's."""
    known = key_ranges()
    of_machine = {key: value for key, value in values.items() if key in known}
    ecu = {key: value for key, value in of_machine.items() if is_ecu_key(key)}
    return ecu, {key: value for key, value in of_machine.items() if key not in ecu}


def _at_speed(segments: list[Segment], start_rad: float, speed_rad_s: float, repeat: bool) -> list[Segment]:
    """The same moves, each as long as this peak speed needs; the first of a repeated motion for both its starts."""
    timed = []
    before = start_rad
    for n, segment in enumerate(segments):
        stroke = abs(segment.target_rad - before)
        if n == 0 and repeat:
            stroke = max(stroke, abs(segment.target_rad - segments[-1].target_rad))
        duration = round(SEPTIC_PEAK * stroke / speed_rad_s, 3)
        timed.append(replace(segment, duration_s=min(max(duration, SHORTEST_MOVE_S), LONGEST_MOVE_S)))
        before = segment.target_rad
    return timed


def _check_steps(steps: list[LoadStep]) -> None:
    times = [step.time_s for step in steps]
    if times != sorted(set(times)):
        raise ConfigError(f"the load's steps are not in order of time: {', '.join(f'{t:g}' for t in times)} s")


def _with_faults(scenario: Scenario, values: Mapping[str, float]) -> Scenario:
    faults = []
    for n, fault in enumerate(scenario.faults, start=1):
        stem = f"faults.{n}."
        changes = {key.removeprefix(stem): value for key, value in values.items() if key.startswith(stem)}
        if changes.pop("present", 1.0) >= 0.5:
            faults.append(replace(fault, **changes))
    return replace(scenario, faults=tuple(faults))
