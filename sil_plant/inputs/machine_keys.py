"""What is wrong with the keys of a machine file: all of it, not the first only as when it is loaded.

Syntax, unknown and missing keys, types, units, ranges. What the values mean together is in sil_plant/design/check.py.
"""

from __future__ import annotations

import difflib
import math
from collections import defaultdict
from dataclasses import dataclass, field
from pathlib import Path

from sil_plant.config import ConfigError, TomlFile, flatten
from sil_plant.inputs.machine import (
    BASE_KEYS,
    EFFECTS,
    JOINT_NAMES,
    Machine,
    load_parameter_table,
    machine_ranges,
    prior_values,
)

ERROR, WARNING, NOTE = "error", "warning", "note"
SEVERITIES = (ERROR, WARNING, NOTE)
# These are not on a data sheet: check_arm.py proposes them.
PROPOSED_SECTIONS = ("base", "control", "supervision", "estimator")

# What a value may have been meant in, by the end of its key: unit, and its size in the key's unit.
OTHER_UNITS: dict[str, tuple[tuple[str, float], ...]] = {
    "_m": (("mm", 1e-3), ("cm", 1e-2)),
    "_m3": (("cm^3", 1e-6), ("l", 1e-3)),
    "_Pa": (("bar", 1e5), ("MPa", 1e6)),
    "_rad": (("degrees", math.pi / 180.0),),
    "_s": (("ms", 1e-3),),
    "_kg": (("g", 1e-3),),
    "_Hz": (("kHz", 1e3), ("rad/s", 0.5 / math.pi)),
    "valve_kv": (("l/min per sqrt(bar)", 1.0 / 6e4 / math.sqrt(1e5)),),
    "valve_overlap": (("%", 1e-2),),
}
# For the keys that are no parameters of the firmware, and so have no text there.
PLANT_TEXTS = {
    "wrist.mass_kg": "mass of the wrist link",
    "valve_frequency_Hz": "the valve's corner frequency, from its data sheet",
    "valve_damping": "the spool's damping; 0.8 if unknown",
    "viscous_Nms_rad": "viscous friction; commissioning finds it, a guess will do",
    "coulomb_Nm": "Coulomb friction; commissioning finds it, a guess will do",
    "oil.bulk_modulus_Pa": "bulk modulus of oil and hoses; 1.0e9 with hoses, 1.4e9 with steel lines",
    "sensors.encoder_noise_rad": "amplitude of the encoders' noise",
    "sensors.pressure_noise_Pa": "rms of the pressure sensors' noise",
    "io.command_delay_s": "from SYNC to the valve command taking effect",
    "io.valve_timeout_s": "the node closes the valves after this long without a command",
}


@dataclass(frozen=True)
class Finding:
    """One thing about a machine file.

    Attributes
    ----------
    severity : str
        ``error``: will not work; ``warning``: works badly or only just; ``note``: as it should be, with figures.
    key : str
        The key or section it is about.
    what : str
        What was found, and why it matters.
    advice : str
        What to do; empty for notes.
    line : int or None
        Where in the file.
    """

    severity: str
    key: str
    what: str
    advice: str = ""
    line: int | None = None


@dataclass
class MachineKeys:
    """The keys of a machine file, as far as they can be used.

    Attributes
    ----------
    toml : TomlFile or None
        None when it is not TOML.
    name : str
        The machine's.
    base : dict
        Exponents that are there and right.
    values : dict
        Numbers that are there and right.
    missing : list
        Keys that are needed and not there.
    findings : list
        Everything that is wrong.
    """

    toml: TomlFile | None
    name: str
    base: dict[str, int] = field(default_factory=dict)
    values: dict[str, float] = field(default_factory=dict)
    missing: list[str] = field(default_factory=list)
    findings: list[Finding] = field(default_factory=list)

    def line(self, key: str) -> int | None:
        """The line of a key."""
        return self.toml.line_of(key) if self.toml else None

    @property
    def physical_complete(self) -> bool:
        """Whether everything is there and right that is not proposed."""
        wrong = [f.key for f in self.findings if f.severity == ERROR]
        return self.toml is not None and all(is_proposed(key) for key in [*wrong, *self.missing])

    def machine(self, proposed: dict[str, float], path: Path) -> Machine:
        """The machine, completed by proposed values; exponents of the bases have keys ``base...``."""
        base = {key: int(self.base.get(key, proposed.get(f"base.{key}", 0))) for key in BASE_KEYS}
        values = {key: value for key, value in proposed.items() if not key.startswith("base.")} | self.values
        values = {key: default for key, (default, _, _) in EFFECTS.items()} | prior_values(values) | values
        return Machine(self.name, path, base, values)


def is_proposed(key: str) -> bool:
    """Whether a key is one that check_arm.py can propose."""
    return key.split(".", 1)[0] in PROPOSED_SECTIONS


def needed_keys() -> list[str]:
    """Every key that a machine file must have, in the order of the parameter list."""
    optional = set(EFFECTS)
    optional |= {e.name for e in load_parameter_table().entries if ".prior." in e.name and e.name.endswith(".value")}
    return [*(f"base.{key}" for key in BASE_KEYS), *(key for key in machine_ranges() if key not in optional)]


def meaning(key: str) -> str:
    """What a key stands for, in words; empty if nobody wrote it down."""
    for entry in load_parameter_table().entries:
        if entry.name == key:
            return entry.text
    return PLANT_TEXTS.get(key, PLANT_TEXTS.get(key.rsplit(".", 1)[-1], ""))


def read_keys(path: Path) -> MachineKeys:
    """Read a machine file and look at every key.

    Raises
    ------
    ConfigError
        When there is no such file, or it is no text.
    """
    if path.is_dir():
        raise ConfigError(f"{path}: is a folder; give a machine file, such as sil_plant/arms/reference.toml")
    try:
        toml = TomlFile(path)
    except ConfigError as error:
        if "not valid TOML" not in str(error):
            raise
        what = str(error).split(": ", 1)[1]
        advice = "a line is  key = number , a section  [name] ; a comment begins with #"
        return MachineKeys(None, path.stem, findings=[Finding(ERROR, "(file)", what, advice)])
    keys = MachineKeys(toml, path.stem)
    found = dict(flatten(toml.data))
    name = found.pop("name", path.stem)
    if isinstance(name, str):
        keys.name = name
    else:
        keys.findings.append(_finding(keys, "name", f"a text is needed, not {name!r}", 'for example name = "crane"'))
    ranges = machine_ranges()
    bases = load_parameter_table().bases
    for key, value in found.items():
        if key.startswith("base.") and key[5:] in BASE_KEYS:
            _read_base(keys, key[5:], value, *bases[key[5:]])
        elif key in ranges:
            _read_value(keys, key, value, *ranges[key])
        else:
            keys.findings.append(_unknown(keys, key, value, [*ranges, *(f"base.{k}" for k in BASE_KEYS)]))
    _find_missing(keys, found)
    return keys


def _finding(keys: MachineKeys, key: str, what: str, advice: str, severity: str = ERROR) -> Finding:
    return Finding(severity, key, what, advice, keys.line(key))


def _read_base(keys: MachineKeys, key: str, value: object, low: int, high: int) -> None:
    if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
        what = f"a whole number from {low} to {high} is needed, not {value!r}"
        keys.findings.append(_finding(keys, f"base.{key}", what, "leave [base] out and let --write propose it"))
    elif key != "lever_log2" and value % 2:
        what = f"{value} is odd: some quantities' bases have the square root of this one"
        keys.findings.append(_finding(keys, f"base.{key}", what, f"take {value - 1} or {value + 1}"))
    else:
        keys.base[key] = value


def _read_value(keys: MachineKeys, key: str, value: object, low: float, high: float) -> None:
    if isinstance(value, bool) or not isinstance(value, int | float):
        what = f"a number from {low:g} to {high:g} is needed, not {value!r}"
        advice = "numbers have no quotation marks and no unit; the unit is in the key's name"
        keys.findings.append(_finding(keys, key, what, advice))
    elif not low <= float(value) <= high:
        what = f"{value:g} is outside {low:g} to {high:g}"
        keys.findings.append(_finding(keys, key, what, _unit_advice(key, float(value), low, high)))
    else:
        keys.values[key] = float(value)


def _unit_advice(key: str, value: float, low: float, high: float) -> str:
    for end, units in OTHER_UNITS.items():
        if not key.endswith(end):
            continue
        for unit, factor in units:
            if low <= value * factor <= high:
                wanted = f"is in {end.lstrip('_')}" if end.startswith("_") else "is SI"
                return f"the value {wanted}: write {value * factor:.6g} if {value:g} is in {unit}"
    text = meaning(key)
    return f"correct it ({text})" if text else "correct it"


def _unknown(keys: MachineKeys, key: str, value: object, known: list[str]) -> Finding:
    if any(name.startswith(f"{key}.") for name in known):
        return _finding(keys, key, f"is a section, not a number ({value!r})", f"write [{key}] and its keys below it")
    last = key.rsplit(".", 1)[-1]
    same_end = [name for name in known if name.rsplit(".", 1)[-1] == last]
    section = key.rsplit(".", 1)[0]
    near = same_end or difflib.get_close_matches(key, known, 1, 0.75)
    if not near:
        below = [name for name in known if name.rsplit(".", 1)[0] == section]
        near = difflib.get_close_matches(key, below, 1, 0.5) or difflib.get_close_matches(key, known, 1, 0.6)
    if near:
        text = meaning(near[0])
        advice = f"is it {near[0]}{f' ({text})' if text else ''}? The unit is part of the name"
    else:
        advice = "remove it; sil_plant/arms/reference.toml has every key there is"
    return _finding(keys, key, "is not a key of a machine file", advice)


def _find_missing(keys: MachineKeys, found: dict[str, object]) -> None:
    keys.missing = [key for key in needed_keys() if key not in found]
    by_section: dict[str, list[str]] = defaultdict(list)
    for key in keys.missing:
        if is_proposed(key):
            by_section[key.split(".", 1)[0]].append(key)
        else:
            by_section[key.rsplit(".", 1)[0]].append(key)
    for section, names in by_section.items():
        if is_proposed(section):
            few = ", ".join(name.removeprefix(f"{section}.") for name in names[:3])
            what = f"{len(names)} keys are missing ({few}{', ..' if len(names) > 3 else ''})"
            advice = "no data sheet has them: --propose shows values for them, --write FILE fills them in"
            keys.findings.append(Finding(ERROR, section, what, advice, keys.line(section)))
            continue
        for name in names:
            text = meaning(name)
            advice = f"add it below [{section}]" + (f": {text}" if text else "")
            keys.findings.append(Finding(ERROR, name, "is missing", advice, keys.line(section)))


def relation_findings(keys: MachineKeys) -> list[Finding]:
    """What two or three of the values say against one another; only of those that are there."""
    found = []
    v = keys.values
    for joint in JOINT_NAMES:
        bore, rod = v.get(f"{joint}.bore_m"), v.get(f"{joint}.rod_m")
        if bore is not None and rod is not None and rod >= bore:
            what = f"the rod ({1e3 * rod:g} mm) is not thinner than the bore ({1e3 * bore:g} mm)"
            found.append(_finding(keys, f"{joint}.rod_m", what, "look whether the two are swapped"))
        found += _dead_points(keys, joint)
    supply, tank = v.get("supply.pressure_Pa"), v.get("supply.tank_Pa")
    if supply is not None and tank is not None and tank >= supply:
        found.append(_finding(keys, "supply.tank_Pa", "is not below the supply pressure", "both are absolute, in Pa"))
    for key in v:
        if key.startswith("estimator.prior.") and key.endswith(".low"):
            stem = key.removesuffix(".low")
            low, high, value = v[key], v.get(f"{stem}.high"), v.get(f"{stem}.value")
            if high is not None and (not low < high or (value is not None and not low <= value <= high)):
                what = f"the range {low:g} to {high:g} is empty or leaves its value ({value}) out"
                found.append(_finding(keys, key, what, "a prior needs low < high and low <= value <= high"))
    if len(keys.base) == len(BASE_KEYS):
        low, high = load_parameter_table().bases["torque_log2"]
        if not low <= sum(keys.base.values()) <= high:
            what = f"the three exponents add up to {sum(keys.base.values())}; {low} to {high} is possible"
            found.append(_finding(keys, "base.pressure_log2", what, "leave [base] out and let --write propose it"))
    return found


# As the firmware has it: closer to a dead point the lever arm is nothing to steer with.
DEAD_POINT_RAD = (0.05, 3.09)


def _dead_points(keys: MachineKeys, joint: str) -> list[Finding]:
    names = [f"{joint}.{key}" for key in ("q_min_rad", "q_max_rad", "crank_q0_rad")]
    if any(name not in keys.values for name in names):
        return []
    q_min, q_max, q0 = (keys.values[name] for name in names)
    if q_min >= q_max:
        what = f"{q_min:g} rad is not below q_max_rad, {q_max:g} rad"
        return [_finding(keys, names[0], what, "look whether the two are swapped")]
    low, high = math.ceil(1e3 * (DEAD_POINT_RAD[0] - q0)) / 1e3, math.floor(1e3 * (DEAD_POINT_RAD[1] - q0)) / 1e3
    found = []
    if q_min < low:
        what = f"dead point: the lever arm is zero at q = {-q0:.3f} rad, where crank and cylinder are in line"
        advice = f"this crank moves {low:.3f} to {high:.3f} rad: raise q_min_rad to {low:.3f}, or correct crank_q0_rad"
        found.append(_finding(keys, names[0], what, advice))
    if q_max > high:
        what = f"dead point: the lever arm is zero at q = {math.pi - q0:.3f} rad, where crank and cylinder are in line"
        advice = f"this crank moves {low:.3f} to {high:.3f} rad: lower q_max_rad to {high:.3f}, or correct crank_q0_rad"
        found.append(_finding(keys, names[1], what, advice))
    return found
