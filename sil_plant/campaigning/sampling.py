"""Which arms a campaign has: its sample, made of a low-discrepancy sequence or of chance, and checked arm by arm."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import qmc

from sil_plant.campaigning.knobs import plant_values, turned
from sil_plant.campaigning.spec import Base, Campaign
from sil_plant.config import ConfigError
from sil_plant.experiments.experiment import setup_for
from sil_plant.inputs.machine import Machine, check_relations, with_changes
from sil_plant.inputs.scenario import Scenario, check_scenario

SOBOL_DIMENSIONS_MOST = qmc.Sobol.MAXDIM


@dataclass(frozen=True)
class Arm:
    """One run of a campaign.

    Attributes
    ----------
    run : int
        Its number, from 1.
    seed : int
        Of the sensor noise.
    commission_seed : int
        Of that while it is commissioned.
    draws : dict
        Per variable, by its label: the value of its key; what several keys share is the draw itself.
    values : dict
        Per key that the draws set.
    """

    run: int
    seed: int
    commission_seed: int
    draws: dict[str, float]
    values: dict[str, float]


def note(campaign: Campaign) -> str | None:
    """What is to be said about the size of the sample, or None."""
    if campaign.sampling in ("sobol", "saltelli") and campaign.runs & (campaign.runs - 1):
        below = 1 << (campaign.runs.bit_length() - 1)
        what = "base sample" if campaign.sampling == "saltelli" else "number of runs"
        return (
            f"a Sobol sequence is balanced only at powers of two, and the {what} is {campaign.runs}; "
            f"take {below} or {2 * below}, or the sampling latin-hypercube"
        )
    return None


def unit_sample(campaign: Campaign) -> np.ndarray:
    """Points in the unit cube, one row per run, one column per random variable.

    Raises
    ------
    ConfigError
        When a Sobol sequence does not have so many dimensions.
    """
    dimensions = len(campaign.random)
    if campaign.sampling in ("sobol", "saltelli") and 2 * dimensions > SOBOL_DIMENSIONS_MOST:
        raise ConfigError(f"{campaign.path}: a Sobol sequence has at most {SOBOL_DIMENSIONS_MOST} dimensions")
    if campaign.sampling == "random":
        return np.random.default_rng(campaign.seed).uniform(size=(campaign.runs, dimensions))
    if campaign.sampling == "latin-hypercube":
        return qmc.LatinHypercube(dimensions, rng=np.random.default_rng(campaign.seed)).random(campaign.runs)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # powers of two: note() says it
        if campaign.sampling == "sobol":
            return qmc.Sobol(dimensions, rng=np.random.default_rng(campaign.seed)).random(campaign.runs)
        return saltelli_problem_sample(campaign)


def problem(names: Sequence[str]) -> dict[str, object]:
    """The variables as SALib takes them: in the unit cube, where each is uniform."""
    return {"num_vars": len(names), "names": list(names), "bounds": [[0.0, 1.0]] * len(names)}


def saltelli_problem_sample(campaign: Campaign) -> np.ndarray:
    """SALib's sample for Sobol indices: ``runs`` base points, each in as many variants as variables and two."""
    from SALib.sample import sobol  # it takes its time to import, and only this sampling needs it

    names = [variable.label for variable in campaign.random]
    return sobol.sample(problem(names), campaign.runs, calc_second_order=False, seed=campaign.seed)


def arms(campaign: Campaign) -> list[Arm]:
    """Every arm of a campaign, the same each time.

    Parameters
    ----------
    campaign : Campaign
        The spec.
    """
    sample = unit_sample(campaign)
    drawn = {v.label: v.distribution.at(sample[:, k]) for k, v in enumerate(campaign.random)}
    for variable in campaign.variables:
        if not variable.distribution.random:
            drawn[variable.label] = variable.distribution.at(np.full(len(sample), 0.5))
    found = []
    for k in range(len(sample)):
        draws = {v.label: float(drawn[v.label][k]) for v in campaign.variables}
        values: dict[str, float] = {}
        for variable in campaign.variables:
            of_it = variable.values(draws[variable.label])
            values |= of_it
            if len(of_it) == 1:
                draws[variable.label] = of_it[variable.keys[0]]
        seed, commission_seed = np.random.SeedSequence((campaign.seed, k + 1)).generate_state(2).tolist()
        found.append(Arm(k + 1, seed, commission_seed, draws, values))
    return found


def prepared(base: Base, arm: Arm) -> tuple[Machine, Scenario, Scenario | None]:
    """What an arm is run with: the ECU's machine, the scenario, and the identification move or None."""
    machine, scenario = turned(base.machine, base.scenario, arm.values)
    move = base.commission_scenario
    if move is not None:
        _, plant = plant_values(arm.values)
        move = _with_plant(move, plant)
    return machine, scenario, move


def _with_plant(scenario: Scenario, plant: dict[str, float]) -> Scenario:
    return replace(scenario, plant=scenario.plant | plant)


def check_arms(campaign: Campaign, found: Sequence[Arm]) -> None:
    """Check every arm before the first is run: relations of its numbers, its moves, its faults.

    Raises
    ------
    ConfigError
        Naming the first run that cannot be, and why.
    """
    base = campaign.base
    for arm in found:
        try:
            machine, scenario, move = prepared(base, arm)
            check_relations(machine)
            setup = setup_for(machine, base.profile, scenario)
            check_relations(setup.plant_machine)
            check_scenario(scenario, machine)
            if move is not None:
                with_changes(setup.plant_machine, move.plant, str(move.name))
        except ConfigError as error:
            raise ConfigError(f"{campaign.path}: run {arm.run} of {len(found)} cannot be: {error}") from error
