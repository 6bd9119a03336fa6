"""Faults on purpose: the kinds there are, and the scenario's list, checked. docs/scenario.md has the format.

What the kinds do to frames, sensors and plant is in `sil_plant.loop.injection`, compiled.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sil_plant.config import TomlFile

# Frames and sensors by number; the order is that of the tables in sil_plant.loop.injection.
FRAMES = ("encoders", "pressures_swing", "pressures_wrist", "motion", "valves", "sync")
SENSORS = (
    "swing_angle",
    "wrist_angle",
    "swing_bore",
    "swing_annulus",
    "wrist_bore",
    "wrist_annulus",
    "swing_spool",
    "wrist_spool",
)
ALL_SENSOR_FRAMES = "sensors"
PRIORITIES = ("higher_priority", "lower_priority")
# Largest size of a sensor's bias, spike or noise, and its unit, by what the sensor measures.
_SENSOR_SIZE = {"angle": (3.0, "rad"), "bore": (3e7, "Pa"), "annulus": (3e7, "Pa"), "spool": (2.0, "of full travel")}

_PROTECTED = FRAMES[:5]
LONGEST_FAULT_S = 3600.0


@dataclass(frozen=True)
class Kind:
    """One kind of fault.

    Attributes
    ----------
    code : int
        For compiled code.
    targets : tuple of str
        What it may strike; empty where there is nothing to choose.
    unit : str
        Of the size; empty when the kind has none.
    low, high : float
        Range of the size; of sensors the unit's own.
    default : float or None
        Size when none is given; None: one must be.
    once : bool
        It happens at its start and has no duration.
    whole : bool
        The size is a whole number.
    """

    code: int
    targets: tuple[str, ...] = ()
    unit: str = ""
    low: float = 0.0
    high: float = 0.0
    default: float | None = 0.0
    once: bool = False
    whole: bool = False


_FRAME_TARGETS = (*_PROTECTED, ALL_SENSOR_FRAMES)
KINDS: dict[str, Kind] = {
    # frames
    "dropped": Kind(0, (*FRAMES, ALL_SENSOR_FRAMES), "share of the frames", 0.0, 1.0, 1.0),
    "delayed": Kind(1, _FRAME_TARGETS, "ms", 1.0, 20.0, None, whole=True),
    "repeated": Kind(2, _FRAME_TARGETS, "copies", 1.0, 4.0, 1.0, whole=True),
    "reordered": Kind(3, _FRAME_TARGETS),
    "corrupted": Kind(4, _FRAME_TARGETS, "bits", 1.0, 64.0, 1.0, whole=True),
    "wrong_length": Kind(5, _FRAME_TARGETS, "bytes", 0.0, 7.0, 7.0, whole=True),
    "foreign_id": Kind(6, _FRAME_TARGETS, "identifier", 1.0, 2047.0, 1365.0, whole=True),
    "old_counter": Kind(7, _FRAME_TARGETS, "frames back", 1.0, 14.0, 1.0, whole=True),
    # sensors
    "stuck": Kind(8, SENSORS),
    "biased": Kind(9, SENSORS, "of the sensor", default=None),
    "spiked": Kind(10, SENSORS, "of the sensor", default=None),
    "noisy": Kind(11, SENSORS, "of the sensor", default=None),
    "invalid": Kind(12, (*SENSORS, ALL_SENSOR_FRAMES)),
    # bus
    "sync_jitter": Kind(13, (), "s", 1e-6, 4e-4, None),
    "send_queue_full": Kind(14, (), "frames a tick that still go", 0.0, 15.0, 0.0, whole=True),
    "bus_off": Kind(15),
    "alien_traffic": Kind(16, PRIORITIES, "share of the bus", 0.01, 1.0, 1.0),
    "second_ecu": Kind(17),
    "nmt_stop": Kind(18, once=True),
    "nmt_reset": Kind(19, once=True),
    "dbc_mismatch": Kind(20, once=True),
    # machines
    "ecu_killed": Kind(21),
    "node_killed": Kind(22),
    "supply_lost": Kind(23, (), "s, time constant", 0.001, 10.0, 0.05),
    "load_dropped": Kind(24, (), "kg that stay", 0.0, 1e4, 0.0),
}
KEYS = {"kind", "target", "start_s", "duration_s", "size", "recover_after_s"}


@dataclass(frozen=True)
class Fault:
    """One fault of a scenario, checked.

    Attributes
    ----------
    kind, target : str
        What, and to whom; the target is empty where the kind has none.
    start_s, duration_s : float
        From the start of motion; a duration of 0 is one tick.
    size : float
        In the unit of the kind.
    recover_after_s : float or None
        So long after its end the master brings the ECU back to RUN; None: it does not.
    """

    kind: str
    target: str
    start_s: float
    duration_s: float
    size: float
    recover_after_s: float | None = None

    def text(self) -> str:
        """The fault in a few words."""
        kind = KINDS[self.kind]
        words = [self.kind, *([self.target] if self.target else [])]
        if kind.unit:
            words.append(f"{self.size:g} {size_range(self.kind, self.target)[2]}")
        when = f"at {self.start_s:.3f} s" + ("" if kind.once else f" for {self.duration_s:.3f} s")
        return f"{' '.join(words)}, {when}"


def size_range(kind: str, target: str) -> tuple[float, float, str]:
    """Smallest and largest size of a fault, and its unit."""
    entry = KINDS[kind]
    if entry.unit != "of the sensor":
        return entry.low, entry.high, entry.unit
    high, unit = _SENSOR_SIZE[target.rpartition("_")[2]]
    return (-high if kind == "biased" else 0.0), high, unit


def read_faults(toml: TomlFile) -> tuple[Fault, ...]:
    """Read and check the list ``[[faults]]`` of a scenario.

    Raises
    ------
    ConfigError
        Naming file, line, key and what there is to choose from.
    """
    items = toml.data.get("faults", [])
    if not isinstance(items, list) or not all(isinstance(item, dict) for item in items):
        raise toml.error("faults", "a list of tables [[faults]] is needed")
    return tuple(read_fault(toml, item, n) for n, item in enumerate(items))


def read_fault(toml: TomlFile, item: dict[str, Any], n: int) -> Fault:
    """Read and check one fault.

    Parameters
    ----------
    toml : TomlFile
        Makes the messages.
    item : dict
        The table.
    n : int
        Which of the list it is.

    Raises
    ------
    ConfigError
        Naming the key and what there is to choose from.
    """
    for key in item:
        if key not in KEYS:
            raise toml.error(f"faults.{key}", f"is not a key of a fault; known are {', '.join(sorted(KEYS))}", n)
    for key in ("kind", "start_s"):
        if key not in item:
            raise toml.error("faults", f"{key} is missing", n)
    name = item["kind"]
    if not isinstance(name, str) or name not in KINDS:
        raise toml.error("faults.kind", f"{name!r} is not a kind of fault; known are {', '.join(KINDS)}", n)
    kind = KINDS[name]
    target = item.get("target", "")
    if not kind.targets and target:
        raise toml.error("faults.target", f"{name} has no target; leave it out", n)
    if kind.targets and target not in kind.targets:
        what = f"{target!r} is not a target" if target else "the target is missing"
        raise toml.error("faults.target" if target else "faults", f"{what}; {name} has {', '.join(kind.targets)}", n)
    if kind.once and "duration_s" in item:
        raise toml.error("faults.duration_s", f"{name} happens once, at start_s; leave the duration out", n)
    if not kind.once and "duration_s" not in item:
        raise toml.error("faults", "duration_s is missing", n)
    duration_s = 0.0
    if not kind.once:
        duration_s = toml.number("faults.duration_s", item["duration_s"], 0.001, LONGEST_FAULT_S, n)
    recover = item.get("recover_after_s")
    return Fault(
        kind=name,
        target=target,
        start_s=toml.number("faults.start_s", item["start_s"], 0.0, LONGEST_FAULT_S, n),
        duration_s=duration_s,
        size=_size(toml, item, n, name, target),
        recover_after_s=(
            None if recover is None else toml.number("faults.recover_after_s", recover, 0.0, LONGEST_FAULT_S, n)
        ),
    )


def _size(toml: TomlFile, item: dict[str, Any], n: int, name: str, target: str) -> float:
    kind = KINDS[name]
    if not kind.unit:
        if "size" in item:
            raise toml.error("faults.size", f"{name} has no size; leave it out", n)
        return 0.0
    low, high, unit = size_range(name, target)
    if "size" not in item:
        if kind.default is None:
            raise toml.error("faults", f"size is missing: {low:g} to {high:g} {unit}", n)
        return kind.default
    value = item["size"]
    wrong = isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high
    if wrong or (kind.whole and value != round(value)):
        what = "a whole number" if kind.whole else "a number"
        raise toml.error("faults.size", f"{what} from {low:g} to {high:g} is needed, not {value!r} (unit: {unit})", n)
    return float(value)


def outside_run(faults: tuple[Fault, ...], duration_s: float) -> tuple[int, str] | None:
    """The first fault whose times are outside a run of this length: its number, and what is wrong."""
    for n, fault in enumerate(faults):
        end_s = fault.start_s + fault.duration_s
        if end_s > duration_s:
            return n, f"{fault.kind} from {fault.start_s:g} to {end_s:g} s is outside the run, 0 to {duration_s:g} s"
    return None
