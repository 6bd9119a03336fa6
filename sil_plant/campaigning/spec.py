"""The spec of a campaign, a TOML file: read, checked, completed. docs/campaigns.md has the format."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from sil_plant.campaigning.distributions import Distribution, read_distribution
from sil_plant.campaigning.knobs import Knob, knobs, near, whole
from sil_plant.config import ROOT, ConfigError, TomlFile
from sil_plant.experiments.commissioning import COMMISSION_SCENARIO
from sil_plant.experiments.experiment import setup_for
from sil_plant.inputs.faults import read_faults
from sil_plant.inputs.machine import REFERENCE_ARM, Machine, load_machine
from sil_plant.inputs.scenario import (
    DEFAULT_SCENARIO,
    PROFILE_NAMES,
    PROFILES,
    Profile,
    Scenario,
    check_scenario,
    load_profile,
    load_scenario,
)
from sil_plant.loop.session import CONTROLLERS

CAMPAIGNS = ROOT / "sil_plant" / "campaigns"
SAMPLINGS = ("sobol", "latin-hypercube", "random", "saltelli")
MOST_RUNS = 1_000_000
MOST_BATCH = 1000
DEFAULT_BATCH = 4

# Figures of a run that a spec may hold against a limit; the largest magnitude allowed.
FIGURES: dict[str, tuple[str, str, float]] = {  # text, unit for people, factor to it
    "load_err_kg": ("load error at the end", "kg", 1.0),
    "load_settle_s": ("load within 0.1 kg after motion starts", "s", 1.0),
    "swing_peak_err_after_1s_rad": ("swing, peak error after 1 s", "mrad", 1e3),
    "wrist_peak_err_after_1s_rad": ("wrist, peak error after 1 s", "mrad", 1e3),
    "swing_peak_err_rad": ("swing, peak error", "mrad", 1e3),
    "wrist_peak_err_rad": ("wrist, peak error", "mrad", 1e3),
    "swing_rms_err_rad": ("swing, rms error", "mrad", 1e3),
    "wrist_rms_err_rad": ("wrist, rms error", "mrad", 1e3),
}
TOP_KEYS = {
    "name",
    "text",
    "runs",
    "seed",
    "sampling",
    "batch",
    "arm",
    "profile",
    "controller",
    "scenario",
    "commission",
    "commission_scenario",
    "worst_by",
    "vary",
    "faults",
    "limits",
}
_PRESENTATION = ("name", "text", "limits", "worst_by")  # of a spec; the runs do not depend on them


@dataclass(frozen=True)
class Variable:
    """One thing that differs from run to run.

    Attributes
    ----------
    label : str
        Its column.
    keys : tuple of str
        What it sets; more than one get the same draw.
    distribution : Distribution
        How it is drawn.
    nominal : tuple of float or None
        Per key what the draw is multiplied with; None: the draw is the value.
    """

    label: str
    keys: tuple[str, ...]
    distribution: Distribution
    nominal: tuple[float, ...] | None

    def values(self, draw: float) -> dict[str, float]:
        """The value of each key for a draw."""
        factors = self.nominal or (1.0,) * len(self.keys)
        return {key: factor * draw for key, factor in zip(self.keys, factors, strict=True)}


@dataclass(frozen=True)
class Base:
    """What all runs have in common; all that a worker needs besides the arms themselves."""

    machine: Machine
    profile: Profile
    scenario: Scenario
    commission_scenario: Scenario | None  # None: the ECU starts from the machine file
    controller: str


@dataclass(frozen=True)
class Campaign:
    """A checked spec.

    Attributes
    ----------
    name, text : str
        For the report.
    path : Path
        The file, as it was given.
    runs : int
        How many; with the sampling saltelli the size of its base sample.
    seed : int
        Of the sample and of every run.
    sampling : str
        One of ``SAMPLINGS``.
    batch : int
        Runs that are computed and written together.
    base : Base
        What all runs share.
    variables : tuple
        What differs.
    limits : dict
        Largest magnitudes of figures, SI.
    worst_by : str
        The figure whose worst runs the report shows.
    spec_hash : str
        SHA-256 over everything that a run depends on but the code.
    """

    name: str
    text: str
    path: Path
    runs: int
    seed: int
    sampling: str
    batch: int
    base: Base
    variables: tuple[Variable, ...]
    limits: Mapping[str, float] = field(default_factory=dict)
    worst_by: str = "load_err_kg"
    spec_hash: str = ""

    @property
    def random(self) -> tuple[Variable, ...]:
        """The variables that chance draws; each takes a dimension of the sample."""
        return tuple(v for v in self.variables if v.distribution.random)


def load_campaign(path: Path, runs: int | None = None) -> Campaign:
    """Read and check a spec.

    Parameters
    ----------
    path : Path
        The TOML file.
    runs : int, optional
        In place of its number of runs.

    Raises
    ------
    ConfigError
        Naming file, line, key and range.
    """
    toml = TomlFile(path)
    data = toml.data
    for key in data:
        if key not in TOP_KEYS:
            raise toml.error(key, f"is not a key of a campaign{near(key, TOP_KEYS)}; known are {_list(TOP_KEYS)}")
    if runs is not None:
        data["runs"] = runs
    files = {
        "arm": _file(toml, "arm", REFERENCE_ARM),
        "scenario": _file(toml, "scenario", DEFAULT_SCENARIO),
        "commission_scenario": _file(toml, "commission_scenario", COMMISSION_SCENARIO),
    }
    base = _base(toml, files)
    hashed = files | {"profile": PROFILES / f"{base.profile.name}.toml"}
    return Campaign(
        name=_text(toml, "name", path.stem),
        text=_text(toml, "text", ""),
        path=path,
        runs=_whole(toml, "runs", None, 1, MOST_RUNS),
        seed=_whole(toml, "seed", 1, 0, 2**63 - 1),
        sampling=_one_of(toml, "sampling", SAMPLINGS, "latin-hypercube"),
        batch=_whole(toml, "batch", DEFAULT_BATCH, 1, MOST_BATCH),
        base=base,
        variables=_variables(toml, base),
        limits=_limits(toml),
        worst_by=_one_of(toml, "worst_by", tuple(FIGURES), "load_err_kg"),
        spec_hash=_hash(data, hashed),
    )


def _base(toml: TomlFile, files: Mapping[str, Path]) -> Base:
    machine = load_machine(files["arm"])
    profile = load_profile(_one_of(toml, "profile", PROFILE_NAMES, "paper"))
    scenario = load_scenario(files["scenario"])
    faults = read_faults(toml)
    scenario = replace(scenario, faults=scenario.faults + faults)
    commission = toml.data.get("commission", True)
    if not isinstance(commission, bool):
        raise toml.error("commission", "true or false is needed")
    identification = load_scenario(files["commission_scenario"]) if commission else None
    for one in (scenario, identification):
        if one is not None:
            try:
                check_scenario(one, machine)
            except ConfigError as error:
                raise ConfigError(f"{toml.path}: {error}") from error
    controller = _one_of(toml, "controller", CONTROLLERS, "diarc")
    return Base(machine, profile, scenario, identification, controller)


def _variables(toml: TomlFile, base: Base) -> tuple[Variable, ...]:
    items = toml.data.get("vary", [])
    if not isinstance(items, list) or not items or not all(isinstance(item, dict) for item in items):
        raise toml.error("vary", "a list of tables [[vary]] is needed, with one at least")
    setup = setup_for(base.machine, base.profile, base.scenario)
    known = knobs(setup.machine, setup.plant_machine, base.scenario)
    variables: list[Variable] = []
    taken: set[str] = set()
    for n, item in enumerate(items):
        variable = _variable(toml, item, n, known, base.scenario)
        labels = [v.label for v in variables]
        if variable.label in labels:
            raise toml.error("vary.label", f"{variable.label} is there already; each column needs its own name", n)
        for key in variable.keys:
            if key in taken:
                raise toml.error("vary", f"{key} is varied already, by another entry", n)
        taken |= set(variable.keys)
        variables.append(variable)
    if not any(v.distribution.random for v in variables):
        raise toml.error("vary", "everything is constant: all runs would be the same")
    return tuple(variables)


def _variable(toml: TomlFile, item: dict[str, Any], n: int, known: Mapping[str, Knob], scenario: Scenario) -> Variable:
    if ("key" in item) == ("keys" in item):
        raise toml.error("vary", "either key or keys is needed", n)
    keys = item.get("keys", [item.get("key")])
    where = "vary.keys" if "keys" in item else "vary.key"
    if not isinstance(keys, list) or not keys or not all(isinstance(key, str) for key in keys):
        raise toml.error(where, "a text is needed (keys: a list of texts)", n)
    for key in keys:
        if key not in known:
            raise toml.error(where, f"{key} is nothing that this campaign can vary{near(key, known)}", n)
    relative = item.get("relative", False)
    if not isinstance(relative, bool):
        raise toml.error("vary.relative", "true or false is needed", n)
    distribution = read_distribution(toml, item, n, relative)
    nominal = None
    if relative:
        nominal = tuple(_nominal(toml, where, known[key], n) for key in keys)
    label = item.get("label", keys[0])
    if not isinstance(label, str) or not label:
        raise toml.error("vary.label", "a text is needed", n)
    variable = Variable(label, tuple(keys), distribution, nominal)
    for end in ("least", "greatest"):
        draw = distribution.support[end == "greatest"]
        for key, value in variable.values(draw).items():
            _check_range(toml, where, known[key], value, draw, relative, n)
            if whole(key, scenario) and distribution.kind not in ("integer", "choice", "constant"):
                raise toml.error("vary.distribution", f"{key} is a whole number: integer, choice or constant", n)
    return variable


def _nominal(toml: TomlFile, where: str, knob: Knob, n: int) -> float:
    if not knob.nominal:
        what = "has no nominal value" if knob.nominal is None else "is 0 without the campaign"
        raise toml.error(where, f"{knob.key} {what}: relative has nothing to refer to; give its values themselves", n)
    return knob.nominal


def _check_range(toml: TomlFile, where: str, knob: Knob, value: float, draw: float, relative: bool, n: int) -> None:
    """Refuse a distribution that leaves the range of its key; a hair is rounding."""
    slack = 1e-12 * max(abs(knob.low), abs(knob.high))
    if knob.low - slack <= value <= knob.high + slack:
        return
    beyond = knob.low - value if value < knob.low else value - knob.high
    reached = f"{value:g}" + (f" ({draw:g} times {knob.nominal:g})" if relative else "")
    raise toml.error(
        where,
        f"{knob.key} reaches {reached}, which is {beyond:.3g} outside its range {knob.low:g} to {knob.high:g}; "
        "narrow the distribution (a normal one: with low and high)",
        n,
    )


def _limits(toml: TomlFile) -> dict[str, float]:
    limits = toml.data.get("limits", {})
    if not isinstance(limits, dict):
        raise toml.error("limits", "a table [limits] is needed")
    for key in limits:
        if key not in FIGURES:
            raise toml.error(f"limits.{key}", f"is no figure of a run; known are {_list(FIGURES)}")
    return {key: toml.number(f"limits.{key}", value, 0.0, 1e6) for key, value in limits.items()}


def _file(toml: TomlFile, key: str, default: Path) -> Path:
    """A file that the spec names, relative to the spec's folder."""
    name = toml.data.get(key)
    if name is None:
        return default
    if not isinstance(name, str):
        raise toml.error(key, "a path is needed, relative to this file")
    path = toml.path.resolve().parent / name
    if not path.is_file():
        raise toml.error(key, f"{name} is not there; paths are relative to this file")
    return path


def _text(toml: TomlFile, key: str, default: str) -> str:
    value = toml.data.get(key, default)
    if not isinstance(value, str):
        raise toml.error(key, "a text is needed")
    return value


def _whole(toml: TomlFile, key: str, default: int | None, low: int, high: int) -> int:
    value = toml.data.get(key, default)
    if value is None:
        raise ConfigError(f"{toml.path}: {key} is missing")
    if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
        raise toml.error(key, f"a whole number from {low} to {high} is needed, not {value!r}")
    return value


def _one_of(toml: TomlFile, key: str, names: tuple[str, ...], default: str) -> str:
    value = toml.data.get(key, default)
    if value not in names:
        raise toml.error(key, f"{value!r} is not known; known are {', '.join(names)}")
    return str(value)


def _list(names: Any) -> str:
    return ", ".join(sorted(names))


def _hash(data: Mapping[str, Any], files: Mapping[str, Path]) -> str:
    """Over what the runs depend on: not over comments, order, name and limits."""
    kept = {key: value for key, value in data.items() if key not in (*_PRESENTATION, *files)}
    digest = hashlib.sha256(json.dumps(kept, sort_keys=True).encode())
    for key, path in sorted(files.items()):
        digest.update(key.encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()
