"""Runs in this process as functions: for reports, commissioning and tests."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import NamedTuple

from sil_plant.experiments.commissioning import (
    COMMISSION_SCENARIO,
    Finding,
    findings,
    plant_when_commissioned,
)
from sil_plant.inputs.machine import Machine, parameter_image, with_changes
from sil_plant.inputs.scenario import Profile, Scenario, load_scenario
from sil_plant.loop.execution import PERIOD_US
from sil_plant.loop.inproc import InprocEcu, run_inproc
from sil_plant.loop.results import Result, run_of, summarise
from sil_plant.loop.session import FAULTED, REQUEST_COMMISSION, REQUEST_RUN, Session, make_session


@dataclass(frozen=True)
class Setup:
    """One run: what the ECU believes, what the plant is, and what happens."""

    machine: Machine
    plant_machine: Machine
    scenario: Scenario
    controller: str = "diarc"
    seed: int = 1
    tare: bool = False
    scalar: str = "double"
    start_request: int = REQUEST_RUN


class Outcome(NamedTuple):
    """A finished run."""

    session: Session
    result: Result
    faulted: bool


def setup_for(machine: Machine, profile: Profile, scenario: Scenario, **options: object) -> Setup:
    """A run of a machine under a profile.

    Parameters
    ----------
    machine : Machine
        As in its file, or commissioned.
    profile : Profile
        What ECU and plant share, and what the plant alone has.
    scenario : Scenario
        The run; its ``plant`` changes come last.
    **options
        Other fields of :class:`Setup`.
    """
    ecu_machine = with_changes(machine, profile.machine, f"profile {profile.name}")
    plant = with_changes(ecu_machine, profile.effects, f"profile {profile.name}")
    plant = with_changes(plant, scenario.plant, scenario.name)
    return replace(Setup(ecu_machine, plant, scenario, tare=profile.tare), **options)


def simulate(setup: Setup) -> Outcome:
    """Run ECU and plant to the end."""
    session = make_session(
        setup.plant_machine,
        setup.scenario,
        setup.controller,
        setup.seed,
        PERIOD_US * 1e-6,
        setup.tare,
        setup.start_request,
    )
    ecu = InprocEcu(parameter_image(setup.machine), PERIOD_US, setup.scalar)
    start = time.perf_counter()
    run_inproc(session, ecu, len(session.noise) + 1)
    wall_s = time.perf_counter() - start
    run = run_of(
        session,
        setup.controller,
        setup.machine.name,
        setup.scenario.name,
        setup.seed,
        "inproc",
        wall_s,
    )
    return Outcome(session, summarise(session.record, run), bool(session.monitor.whole[FAULTED]))


def commissioning_setup(machine: Machine, profile: Profile, seed: int, move: Scenario) -> Setup:
    """The run that identifies a machine: the ECU in its mode COMMISSION, the plant before it aged."""
    setup = setup_for(machine, profile, move, seed=seed, start_request=REQUEST_COMMISSION)
    return replace(setup, plant_machine=plant_when_commissioned(setup.plant_machine))


def commission(
    machine: Machine, profile: Profile, seed: int = 1, scenario: Scenario | None = None
) -> tuple[Machine, list[Finding]]:
    """Commission a machine in this process, on a plant as it was before it aged.

    Parameters
    ----------
    machine : Machine
        The machine as its file describes it.
    profile : Profile
        The plant's; oil is at its nominal viscosity.
    seed : int
        Of the sensor noise.
    scenario : Scenario, optional
        The identification move.

    Returns
    -------
    Machine
        With the values found, ready to operate.
    list of Finding
        One per parameter.
    """
    move = scenario or load_scenario(COMMISSION_SCENARIO)
    outcome = simulate(commissioning_setup(machine, profile, seed, move))
    found = findings(machine, outcome.session.monitor)
    values = {f"estimator.prior.{f.prior}.value": f.value for f in found}
    return with_changes(machine, values, "commissioned"), found
