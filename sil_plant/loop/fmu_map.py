"""Which variable of another plant's FMU is which signal of the machine: the map file, checked against the FMU.

docs/fmu.md describes the file. Everything that does not fit is found in one go, so that one run tells all of it.
"""

from __future__ import annotations

import difflib
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sil_plant.config import ConfigError, TomlFile, flatten

JOINTS = ("swing", "wrist")
CHAMBERS = ("swing_bore", "swing_annulus", "wrist_bore", "wrist_annulus")
_REAL = ("Real", "Float64", "Float32")
_DIMENSIONS = ("kg", "m", "s", "A", "K", "mol", "cd", "rad")
_PRESSURE = {"kg": 1, "m": -1, "s": -2}
# Units by name, for FMUs that name a unit without defining it: exponents, and what one of it is in SI.
_KNOWN: dict[str, tuple[dict[str, int], float]] = {
    "rad": ({"rad": 1}, 1.0),
    "deg": ({"rad": 1}, math.pi / 180.0),
    "°": ({"rad": 1}, math.pi / 180.0),
    "mrad": ({"rad": 1}, 1e-3),
    "rad/s": ({"rad": 1, "s": -1}, 1.0),
    "deg/s": ({"rad": 1, "s": -1}, math.pi / 180.0),
    "Pa": (_PRESSURE, 1.0),
    "kPa": (_PRESSURE, 1e3),
    "MPa": (_PRESSURE, 1e6),
    "mbar": (_PRESSURE, 1e2),
    "bar": (_PRESSURE, 1e5),
    "psi": (_PRESSURE, 6894.757293168361),
    "1": ({}, 1.0),
    "-": ({}, 1.0),
    "%": ({}, 0.01),
    "1/s": ({"s": -1}, 1.0),
    "Hz": ({"s": -1}, 1.0),
    "kg": ({"kg": 1}, 1.0),
    "g": ({"kg": 1}, 1e-3),
    "t": ({"kg": 1}, 1e3),
}


@dataclass(frozen=True)
class Quantity:
    """What a signal is: its name for people, its SI unit, and whether an FMU may leave the unit out."""

    name: str
    unit: str
    may_be_silent: bool = False


ANGLE = Quantity("an angle", "rad")
RATE = Quantity("an angular rate", "rad/s")
PRESSURE = Quantity("an absolute pressure", "Pa")
SPOOL = Quantity("a spool position of -1 to 1", "1", True)
SPOOL_RATE = Quantity("a spool rate", "1/s", True)
MASS = Quantity("a mass", "kg")

# Every key that names a variable: quantity, direction (in: written by us), needed.
_SIGNALS: dict[str, tuple[Quantity, str, bool]] = (
    {f"commands.{joint}": (SPOOL, "in", True) for joint in JOINTS}
    | {f"angles.{joint}": (ANGLE, "out", True) for joint in JOINTS}
    | {f"pressures.{chamber}": (PRESSURE, "out", True) for chamber in CHAMBERS}
    | {f"rates.{joint}": (RATE, "out", False) for joint in JOINTS}
    | {f"spools.{joint}": (SPOOL, "out", False) for joint in JOINTS}
    | {f"spool_rates.{joint}": (SPOOL_RATE, "out", False) for joint in JOINTS}
    | {f"start.{joint}_angle": (ANGLE, "start", False) for joint in JOINTS}
    | {"load.input": (MASS, "in", False), "load.output": (MASS, "out", False)}
)
_NUMBERS = {"load.constant_kg": (0.0, 1e5), "valve.lag_s": (0.0, 10.0)}
_ENTRY = {"variable", "unit", "scale", "offset"}
# Columns of the plant's state that the outputs fill, sil_plant/plant/dynamics.py.
STATE_KEYS = (
    *(f"angles.{joint}" for joint in JOINTS),
    *(f"rates.{joint}" for joint in JOINTS),
    *(f"pressures.{chamber}" for chamber in CHAMBERS),
    *(f"spools.{joint}" for joint in JOINTS),
    *(f"spool_rates.{joint}" for joint in JOINTS),
)


@dataclass(frozen=True)
class Entry:
    """A variable as the map names it; SI value = FMU's value times ``scale`` plus ``offset``."""

    variable: str
    unit: str | None = None
    scale: float | None = None
    offset: float = 0.0


@dataclass(frozen=True)
class PlantMap:
    """A map file, read but not yet held against an FMU."""

    toml: TomlFile
    entries: dict[str, Entry]
    load_constant_kg: float | None
    valve_lag_s: float
    parameters: dict[str, Any]


@dataclass(frozen=True)
class Signal:
    """A variable of the FMU, ready for use."""

    name: str
    reference: int
    type: str
    scale: float
    offset: float

    def si(self, value: float) -> float:
        """SI value of a value of the FMU."""
        return value * self.scale + self.offset

    def own(self, value: float) -> float:
        """Value for the FMU of an SI value."""
        return (value - self.offset) / self.scale


def near(name: str, names: list[str]) -> str:
    """Names like the one that is not there, for a message."""
    lower = {candidate.lower(): candidate for candidate in names}
    found = [lower[match] for match in difflib.get_close_matches(name.lower(), list(lower), n=3, cutoff=0.5)]
    found += [candidate for candidate in names if name.lower() in candidate.lower() and candidate not in found][:2]
    return f"; near it: {', '.join(found)}" if found else ""


def load_map(path: Path) -> PlantMap:
    """Read a map file.

    Parameters
    ----------
    path : Path
        TOML as docs/fmu.md describes it.

    Raises
    ------
    ConfigError
        Naming file, line and key.
    """
    toml = TomlFile(path)
    parameters = toml.data.pop("parameters", {})
    if not isinstance(parameters, dict):
        raise toml.error("parameters", "a table of the FMU's parameters and their values is needed")
    parameters = dict(flatten(parameters))
    for name, value in parameters.items():
        if not isinstance(value, bool | int | float | str):
            raise toml.error(f"parameters.{name}", f"a number, true, false or a text is needed, not {value!r}")
    sections = sorted({key.split(".")[0] for key in (*_SIGNALS, *_NUMBERS)} | {"parameters"})
    entries: dict[str, Entry] = {}
    numbers: dict[str, float] = {}
    for section, content in toml.data.items():
        if section not in sections or not isinstance(content, dict):
            raise toml.error(section, f"is not a section of a map; there are {', '.join(sections)}")
        for name, value in content.items():
            key = f"{section}.{name}"
            if key in _NUMBERS:
                numbers[key] = toml.number(key, value, *_NUMBERS[key])
            elif key in _SIGNALS:
                entries[key] = _entry(toml, key, value)
            else:
                keys = [k.split(".")[1] for k in (*_SIGNALS, *_NUMBERS) if k.startswith(f"{section}.")]
                raise toml.error(key, f"is not a key of a map; [{section}] has {', '.join(keys)}")
    for key, (quantity, _, is_needed) in _SIGNALS.items():
        if is_needed and key not in entries:
            raise toml.error(key, f"is missing: name the FMU's variable that is {quantity.name}")
    for section in ("rates", "spools", "spool_rates", "start"):
        given = [key for key in entries if key.startswith(f"{section}.")]
        if len(given) == 1:
            raise toml.error(given[0], f"stands alone: [{section}] needs both joints or none")
    loads = [key for key in ("load.input", "load.output", "load.constant_kg") if key in entries or key in numbers]
    if len(loads) > 1:
        raise toml.error(loads[1], f"contradicts {loads[0]}: the load's truth is one of them")
    if "valve.lag_s" in numbers and "spools.swing" in entries:
        raise toml.error("valve.lag_s", "is for FMUs without spools; [spools] names this FMU's")
    return PlantMap(
        toml=toml,
        entries=entries,
        load_constant_kg=numbers.get("load.constant_kg"),
        valve_lag_s=numbers.get("valve.lag_s", 0.0),
        parameters=parameters,
    )


def _entry(toml: TomlFile, key: str, value: Any) -> Entry:
    if isinstance(value, str):
        return Entry(value)
    if not isinstance(value, dict) or not isinstance(value.get("variable"), str):
        raise toml.error(key, 'a variable is needed: "name", or { variable = "name", unit = "bar" }')
    unknown = set(value) - _ENTRY
    if unknown:
        raise toml.error(key, f"{sorted(unknown)[0]} is not known; there are {', '.join(sorted(_ENTRY))}")
    unit = value.get("unit")
    if unit is not None and not isinstance(unit, str):
        raise toml.error(key, f"unit must be a text, not {unit!r}")
    if unit is not None and "scale" in value:
        raise toml.error(key, "unit and scale contradict one another: scale says what one of the FMU's is in SI")
    scale = toml.number(key, value["scale"], -1e12, 1e12) if "scale" in value else None
    if scale == 0.0:
        raise toml.error(key, "a scale of 0 loses the signal")
    return Entry(value["variable"], unit, scale, toml.number(key, value.get("offset", 0.0), -1e12, 1e12))


def bind(plant_map: PlantMap, model: Any, fmu: Path) -> dict[str, Signal]:
    """Hold a map against an FMU's model description.

    Parameters
    ----------
    plant_map : PlantMap
        The map.
    model : ModelDescription
        FMPy's.
    fmu : Path
        The FMU, for messages.

    Returns
    -------
    dict
        Signals by the map's keys.

    Raises
    ------
    ConfigError
        Naming every variable that is missing or does not fit, one a line.
    """
    variables = {variable.name: variable for variable in model.modelVariables}
    units = {unit.name: unit for unit in model.unitDefinitions}
    signals: dict[str, Signal] = {}
    problems: list[str] = []
    taken: dict[str, str] = {}
    for key, entry in plant_map.entries.items():
        quantity, direction, _ = _SIGNALS[key]
        try:
            variable = variables.get(entry.variable)
            if variable is None:
                raise plant_map.toml.error(
                    key, f"{fmu.name} has no variable {entry.variable}{near(entry.variable, list(variables))}"
                )
            what = _misfit(variable, direction)
            if what:
                raise plant_map.toml.error(key, f"{entry.variable} {what}")
            if entry.variable in taken and direction != "start":
                raise plant_map.toml.error(key, f"{entry.variable} is {taken[entry.variable]} already")
            taken[entry.variable] = key
            scale, offset = _conversion(plant_map.toml, key, entry, variable, units, quantity)
            signals[key] = Signal(entry.variable, variable.valueReference, variable.type, scale, offset + entry.offset)
        except ConfigError as error:
            problems.append(str(error))
    for name in plant_map.parameters:
        if name not in variables:
            wrong = f"{fmu.name} has no variable {name}{near(name, list(variables))}"
            problems.append(str(plant_map.toml.error(f"parameters.{name}", wrong)))
        elif variables[name].causality in ("output", "local", "independent", "calculatedParameter"):
            wrong = f"is computed by the FMU ({variables[name].causality}) and cannot be set"
            problems.append(str(plant_map.toml.error(f"parameters.{name}", wrong)))
    if problems:
        raise ConfigError("\n".join(problems))
    return signals


def _misfit(variable: Any, direction: str) -> str | None:
    """Why a variable cannot play its part, or None."""
    if variable.type not in _REAL:
        return f"is of type {variable.type}; a real number is needed"
    if variable.dimensions:
        return "is an array; name a scalar"
    causality, variability = variable.causality, variable.variability
    is_tunable = causality == "parameter" and variability == "tunable"
    if direction == "in" and causality != "input" and not is_tunable:
        return f"is no input of the FMU but its {causality} ({variability})"
    if direction == "start" and causality not in ("input", "parameter") and variable.initial not in ("exact", "approx"):
        return f"cannot be set before the start: it is the FMU's {causality} ({variability})"
    if direction == "out" and causality in ("input", "parameter", "independent"):
        return f"is no result of the FMU but its {causality}"
    return None


def _conversion(
    toml: TomlFile, key: str, entry: Entry, variable: Any, units: dict[str, Any], quantity: Quantity
) -> tuple[float, float]:
    """Scale and offset from the FMU's unit to SI."""
    if entry.scale is not None:
        return entry.scale, 0.0
    declared = variable.unit or (variable.declaredType.unit if variable.declaredType is not None else None)
    if declared and entry.unit and declared != entry.unit:
        raise toml.error(key, f"{entry.variable} is in {declared} by the FMU's own word, not in {entry.unit}")
    name = declared or entry.unit
    if not name:
        if quantity.may_be_silent:
            return 1.0, 0.0
        raise toml.error(
            key,
            f"{entry.variable} has no unit in the FMU; {quantity.name} is needed, so state it: "
            f'{{ variable = "{entry.variable}", unit = "{quantity.unit}" }}',
        )
    needed = _KNOWN[quantity.unit][0]
    base = units[name].baseUnit if name in units else None
    if base is not None:
        found = {dimension: getattr(base, dimension) for dimension in _DIMENSIONS if getattr(base, dimension)}
        scale, offset = float(base.factor), float(base.offset)
        if name in _KNOWN and "rad" in _KNOWN[name][0]:
            found = {**found, "rad": 1}  # some tools do not count rad
    elif name in _KNOWN:
        found, scale = _KNOWN[name]
        offset = 0.0
    else:
        raise toml.error(
            key,
            f"{entry.variable}: its unit {name} is not known and the FMU does not define it; say what one of it is in "
            f'{quantity.unit}: {{ variable = "{entry.variable}", scale = .. }}',
        )
    if found != needed:
        raise toml.error(
            key,
            f"{entry.variable} is in {name}, which is no unit of {quantity.name.split(' ', 1)[1]}; "
            f"{quantity.unit} or the like is needed",
        )
    return scale, offset
