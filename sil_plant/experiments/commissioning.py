"""Commission, then operate: the same estimator with two priors.

Commissioning moves the arm without load, in the ECU's mode COMMISSION: the load is pinned to zero and everything else
is wide open. What comes out, and how well the move showed it, becomes the prior that operation holds tightly while the
load is wide open.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sil_plant.bus.ecu_parameters import EcuParameters, RefusedError, image_values
from sil_plant.config import ConfigError, TomlFile, flatten
from sil_plant.inputs.machine import Machine, parameter_image, with_changes
from sil_plant.inputs.scenario import SCENARIOS
from sil_plant.loop.session import THETA, Monitor

COMMISSION_SCENARIO = SCENARIOS / "commission.toml"
# The prior in COMMISSION is this share of a parameter's range: WIDE_SD of firmware/control/estimator.c.
WIDE_SHARE = 0.25
# Below this ratio of prior to posterior standard deviation a move has shown nothing of a parameter.
EXCITATION_LEAST = 3.0
# The standard deviation that is left may be this much of what operation assumes, at most.
SD_MOST = 2.0

UNITS = {
    "m_t": "kg",
    "J": "kg m^2",
    "m2": "kg",
    "fv1": "N m s/rad",
    "fv2": "N m s/rad",
    "fc1": "N m",
    "fc2": "N m",
    "Om1_swing": "N m",
    "Om1_wrist": "N m",
    "beta_inverse": "1/Pa",
    "Om2_swing": "m^3/s",
    "Om3_swing": "m^3/s",
    "Om2_wrist": "m^3/s",
    "Om3_wrist": "m^3/s",
}
ADVICE = {
    "swing": "move the swing farther, faster and at more than one speed",
    "wrist": "move the wrist farther, faster and at more than one speed, also where it is not horizontal",
}
PARAMETER_JOINT = {
    "fv1": "swing",
    "fc1": "swing",
    "Om1_swing": "swing",
    "Om2_swing": "swing",
    "Om3_swing": "swing",
}


@dataclass(frozen=True)
class Finding:
    """What commissioning found of one parameter; SI."""

    name: str
    prior: str
    nominal: float
    value: float
    sd: float
    excitation: float
    allowed_sd: float

    @property
    def poor(self) -> bool:
        """Whether the move has not shown this parameter well enough."""
        return self.excitation < EXCITATION_LEAST or self.sd > self.allowed_sd

    @property
    def advice(self) -> str:
        """What to move to see this parameter."""
        return ADVICE[PARAMETER_JOINT.get(self.name, "wrist")]


def plant_when_commissioned(plant_machine: Machine) -> Machine:
    """The plant as it was when it was commissioned: the oil's viscosity changes only afterwards."""
    return with_changes(plant_machine, {"effects.viscosity_factor": 1.0}, "commissioning")


def _wide_sd(machine: Machine, prior: str) -> float:
    return WIDE_SHARE * (machine[f"estimator.prior.{prior}.high"] - machine[f"estimator.prior.{prior}.low"])


def findings(machine: Machine, monitor: Monitor) -> list[Finding]:
    """What the ECU has told of its parameters, against what operation needs.

    Parameters
    ----------
    machine : Machine
        The machine with its operating priors.
    monitor : Monitor
        What was heard in the commissioning run.

    Raises
    ------
    ConfigError
        When the ECU has not told every parameter.
    """
    found = []
    for k, (name, prior) in enumerate(THETA):
        if k == 0:
            continue
        value, sd = float(monitor.theta[k]), float(monitor.theta_sd[k])
        if not np.isfinite(value):
            raise ConfigError(f"the ECU has not sent parameter {name}; was the run too short?")
        low, high = machine[f"estimator.prior.{prior}.low"], machine[f"estimator.prior.{prior}.high"]
        found.append(
            Finding(
                name=name,
                prior=prior,
                nominal=machine[f"estimator.prior.{prior}.value"],
                value=min(max(value, low), high),
                sd=sd,
                excitation=_wide_sd(machine, prior) / sd if sd > 0.0 else float("inf"),
                allowed_sd=SD_MOST * machine[f"estimator.prior.{prior}.sd"],
            )
        )
    return found


def table(found: list[Finding]) -> str:
    """The findings for people."""
    lines = [
        f"{'parameter':<14}{'nominal':>13}{'found':>13}{'sd':>12}{'excitation':>12}   unit",
    ]
    for f in found:
        lines.append(
            f"{f.name:<14}{f.nominal:>13.5g}{f.value:>13.5g}{f.sd:>12.2g}{f.excitation:>12.0f}   {UNITS[f.name]}"
            + ("   POOR" if f.poor else "")
        )
    return "\n".join(lines)


def check_excitation(found: list[Finding]) -> None:
    """Refuse what the move has not shown.

    Raises
    ------
    ConfigError
        Naming each parameter that suffers, and what to move.
    """
    poor = [f for f in found if f.poor]
    if not poor:
        return
    names = ", ".join(
        f"{f.name} (sd {f.sd:.2g}, at most {f.allowed_sd:.2g} {UNITS[f.name]}; excitation {f.excitation:.1f})"
        for f in poor
    )
    advice = "; ".join(dict.fromkeys(f.advice for f in poor))
    raise ConfigError(f"the move excites too little to know {names}: {advice}. Nothing was stored")


def save_in_ecu(ecu: EcuParameters, machine: Machine, found: list[Finding]) -> None:
    """Put what was found into the ECU that found it, and have it kept over power-off.

    Raises
    ------
    RefusedError
        When it is another machine's ECU, or it refuses; then it has the set of before.
    """
    ours, theirs = image_values(parameter_image(machine)), image_values(ecu.image())
    found_keys = {f"estimator.prior.{f.prior}.value" for f in found}
    for name, value in ours.items():
        if name not in found_keys and theirs[name] != value:
            raise RefusedError(
                f"the ECU is set up for another machine than {machine.path} ({name} is {theirs[name]:.7g}, there "
                f"{value:.7g}), so nothing was saved in it; give it this one (params.py load FILE) and commission again"
            )
    ecu.change({f"estimator.prior.{f.prior}.value": f.value for f in found})
    ecu.save()


def to_toml(machine: Machine, found: list[Finding], profile: str) -> str:
    """The commissioned set as TOML, for ``run.py --params``."""
    lines = [
        f"# Commissioned parameters of {machine.name}, profile {profile}. Made by tools/commission.py.",
        f'machine = "{machine.name}"',
        "",
        "# What operation starts from, by the machine file's keys.",
        "[parameters]",
    ]
    lines += [f'"estimator.prior.{f.prior}.value" = {f.value!r}' for f in found]
    lines += [
        "",
        "# How well it is known: standard deviation, and prior over posterior standard deviation.",
        "[quality]",
    ]
    lines += [f'"{f.prior}" = {{ sd = {f.sd!r}, excitation = {round(f.excitation, 1)!r} }}' for f in found]
    return "\n".join(lines) + "\n"


def load_commissioned(path: Path, machine: Machine) -> Machine:
    """The machine with the values of a commissioned set.

    Raises
    ------
    ConfigError
        When the file is for another machine, or has an unknown key or a value outside its range.
    """
    toml = TomlFile(path)
    if toml.data.get("machine") != machine.name:
        raise toml.error("machine", f'this set is for "{toml.data.get("machine")}", the machine is "{machine.name}"')
    table_ = toml.data.get("parameters", {})
    if not isinstance(table_, dict) or not table_:
        raise toml.error("parameters", "a table of values is needed; make it with tools/commission.py")
    changes = {}
    for key, value in flatten(table_):
        if key not in machine.values:
            raise toml.error(f"parameters.{key}", f"is not a number of {machine.path.name}")
        if not key.startswith("estimator.prior."):
            raise toml.error(f"parameters.{key}", "only estimator.prior.*.value is commissioned")
        stem = key.rsplit(".", 1)[0]
        changes[key] = toml.number(f"parameters.{key}", value, machine[f"{stem}.low"], machine[f"{stem}.high"])
    return with_changes(machine, changes, str(path))
