"""Repeat the paper's results on the simulated arm, and judge them: figures 5 to 8, Table 1, and what goes beyond.

Writes out/paper/report.html (one file, to be opened anywhere), report.json (every run: the keys of run.py --json,
profile, group, bar; see sil_plant/reports/paper_report.py) and the pictures; refreshes docs/img/paper.png and the
README's section when all parts are made. The exit status does not depend on bars: 0 when everything ran.

Examples
--------
  make paper
  python tools/paper.py --only check       one part: paper, realistic, ablation, second, check
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import signal
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path[0] = str(ROOT)

from sil_plant.environment import enter, say  # noqa: E402

enter(__file__)

from matplotlib.figure import Figure  # noqa: E402

from sil_plant.config import ConfigError  # noqa: E402
from sil_plant.experiments.commissioning import COMMISSION_SCENARIO, UNITS, Finding  # noqa: E402
from sil_plant.experiments.experiment import Outcome, Setup, commission, commissioning_setup, setup_for, simulate  # noqa: E402
from sil_plant.inputs.machine import ARMS, JOINT_NAMES, Machine, load_machine, with_changes  # noqa: E402
from sil_plant.inputs.scenario import (  # noqa: E402
    SCENARIOS,
    Profile,
    Scenario,
    Segment,
    check_scenario,
    load_profile,
    load_scenario,
    moves,
    with_load,
)
from sil_plant.loop.results import AFTER_S, LOAD_BAND_KG  # noqa: E402
from sil_plant.loop.session import CONTROLLERS  # noqa: E402
from sil_plant.reports import figures, paper_figures  # noqa: E402
from sil_plant.reports import paper_report as report  # noqa: E402
from sil_plant.reports.paper_report import Bar, Case, ParameterFinding, Report  # noqa: E402

OUT = ROOT / "out" / "paper"
README = ROOT / "README.md"
README_PICTURE = ROOT / "docs" / "img" / "paper.png"
PARTS = ("paper", "realistic", "ablation", "second", "check")
EXIT_WRONG_USE, EXIT_INTERRUPTED = 2, 130

SEEDS = tuple(range(1, 11))
FEW_SEEDS = (1, 2)
COMMISSION_SEED = 100  # plus the seed of the run
TRACKING_LOAD_KG = 3.0
ABLATION_LOADS_KG = (0.0, 5.0, 10.0)

CHECKS = 30
CHECK_SEED = 20240
CHECK_SLACK = 1.5
CHECK_SPREAD = 0.2
CHECK_PLANT = (
    "wrist.mass_kg",
    "oil.bulk_modulus_Pa",
    *(
        f"{joint}.{key}"
        for joint in JOINT_NAMES
        for key in ("viscous_Nms_rad", "coulomb_Nm", "leakage_m3_s_Pa", "valve_frequency_Hz")
    ),
)
CHECK_START_RAD = (-0.6, 0.8)
CHECK_STROKE_RAD = (0.3, 0.9)
CHECK_SPEED_RAD_S = (0.6, 1.1)  # the benchmark's is 0.875
CHECK_DWELL_S = (0.2, 0.6)
CHECK_MARGIN_RAD = 0.1  # to the ends of a joint's range
SEPTIC_PEAK = 35.0 / 16.0  # peak speed of a move of one radian in one second

# The effects of profiles/realistic.toml, by their keys there.
EFFECTS: tuple[tuple[str, tuple[str, ...], bool], ...] = (  # name, keys, with tare
    ("nothing else", (), False),
    ("Stribeck friction", ("effects.stribeck", "effects.stribeck_rate_rad_s"), False),
    ("friction at the cylinders", ("arm.friction_at_cylinder",), False),
    ("valve overlap", ("swing.valve_overlap", "wrist.valve_overlap"), False),
    ("valve hysteresis", ("effects.hysteresis",), False),
    (
        "air in the oil",
        ("effects.air_bulk_low_Pa", "effects.air_bulk_high_Pa", "effects.air_pressure_Pa"),
        False,
    ),
    ("supply sag", ("effects.supply_sag_Pa_s_m3",), False),
    ("encoder bits", ("effects.encoder_bits",), False),
    ("pressure gain", ("effects.pressure_gain_error",), False),
    ("pressure offset, tared", ("effects.pressure_offset_Pa",), True),
    ("pressure offset, not tared", ("effects.pressure_offset_Pa",), False),
    ("jitter", ("effects.sync_jitter_s",), False),
    ("frame loss", ("effects.frame_loss",), False),
    ("viscosity after commissioning", ("effects.viscosity_factor",), False),
)
ALL_TOGETHER = "all together, tared"
SENSOR_SET = "effects.sensor_set"  # of every effect: which signs sensor errors have


@dataclass(frozen=True)
class Limits:
    """The bars of a machine under a profile, SI; None is no bar."""

    load_kg: float
    peak_late_rad: float | None = None
    settle_s: float | None = None
    peak_rad: float | None = None
    pid_rad: tuple[float, float] | None = None
    wrist_better_percent: float | None = None
    parameters_percent: float | None = None
    compressibility_percent: float | None = None
    change_settle_s: float | None = None
    change_peak_rad: float | None = None

    def slackened(self, factor: float) -> Limits:
        """The same, with that much more room, for single runs."""

        def more(value: float | None) -> float | None:
            return None if value is None else factor * value

        return Limits(
            factor * self.load_kg,
            more(self.peak_late_rad),
            more(self.settle_s),
            more(self.peak_rad),
            parameters_percent=more(self.parameters_percent),
            compressibility_percent=more(self.compressibility_percent),
        )


@dataclass(frozen=True)
class ArmPlan:
    """A machine, what it moves, and what is asked of it."""

    path: Path
    scenario: Path
    loads_kg: tuple[float, ...]
    full_scale_kg: float
    limits: dict[str, Limits]
    commission_scenario: Path = COMMISSION_SCENARIO


REFERENCE = ArmPlan(
    path=ARMS / f"{report.REFERENCE}.toml",
    scenario=SCENARIOS / "paper.toml",
    loads_kg=tuple(report.PAPER_LOAD_ERROR_KG),
    full_scale_kg=10.0,
    limits={
        report.PAPER: Limits(
            load_kg=0.003,
            settle_s=0.25,
            peak_late_rad=1e-4,
            peak_rad=1e-3,
            pid_rad=(0.01, 0.1),
            wrist_better_percent=56.0,
            parameters_percent=5.0,
            compressibility_percent=10.0,
            change_settle_s=0.5,
            change_peak_rad=5e-3,
        ),
        report.REALISTIC: Limits(load_kg=0.005 * 10.0, peak_late_rad=1e-3),
    },
)
SECOND = ArmPlan(
    path=ARMS / f"{report.SECOND}.toml",
    scenario=SCENARIOS / f"{report.SECOND}.toml",
    loads_kg=(0.0, 50.0, 100.0, 150.0, 200.0),
    full_scale_kg=200.0,
    limits={name: Limits(load_kg=0.01 * 200.0) for name in (report.PAPER, report.REALISTIC)},
)
CHANGE_SCENARIO = SCENARIOS / "load_change.toml"


@dataclass(frozen=True)
class Extent:
    """How much is run: everything, or less for tests.

    Attributes
    ----------
    parts : tuple
        Of ``PARTS``.
    seeds : tuple
        Of sensor noise, for the reference arm.
    few_seeds : tuple
        For what takes long or stands under no bar: ablation, second machine, controllers on the realistic plant.
    loads_kg : tuple, optional
        In place of the plans' loads.
    checks : int
        Cases of the hold-out on the paper's plant; the first half of them on the realistic one, too.
    """

    parts: tuple[str, ...] = PARTS
    seeds: tuple[int, ...] = SEEDS
    few_seeds: tuple[int, ...] = FEW_SEEDS
    loads_kg: tuple[float, ...] | None = None
    checks: int = CHECKS


@dataclass(frozen=True)
class Operation:
    """One run of a commissioned machine."""

    group: str
    scenario: Scenario
    seed: int
    controller: str = "diarc"
    traced: bool = False


@dataclass(frozen=True)
class Job:
    """A machine on a plant: commissioned once, then operated."""

    machine: Machine
    profile: Profile
    limits: Limits | None
    commission_scenario: Scenario
    seed: int
    operations: tuple[Operation, ...] = ()
    plant: dict[str, float] = field(default_factory=dict)
    report_commissioning: bool = False


# ---- the plan --------------------------------------------------------------------------------------


def plan(extent: Extent) -> list[Job]:
    """Everything that is run."""
    jobs: list[Job] = []
    paper = load_profile(report.PAPER)
    realistic = load_profile(report.REALISTIC)
    if "paper" in extent.parts:
        jobs += _benchmark(REFERENCE, paper, extent.seeds, extent.loads_kg, extent.seeds)
    if "realistic" in extent.parts:
        jobs += _benchmark(REFERENCE, realistic, extent.seeds, extent.loads_kg, extent.few_seeds)
    if "ablation" in extent.parts:
        jobs += _ablation(REFERENCE, paper, realistic, extent.few_seeds)
    if "second" in extent.parts and SECOND.path.exists():
        for profile in (paper, realistic):
            jobs += _benchmark(SECOND, profile, extent.few_seeds, extent.loads_kg, ())
    if "check" in extent.parts:
        jobs += _checks(REFERENCE, paper, extent.checks)
        jobs += _checks(REFERENCE, realistic, (extent.checks + 1) // 2)
    return jobs


def with_sensor_set(profile: Profile, number: int) -> Profile:
    """The profile with other signs of its sensors' errors, where it has such errors."""
    if not any(key.startswith("effects.pressure_") for key in profile.effects):
        return profile
    return replace(profile, effects=profile.effects | {SENSOR_SET: float(number)})


def _benchmark(
    arm: ArmPlan,
    profile: Profile,
    seeds: Sequence[int],
    loads_kg: tuple[float, ...] | None,
    tracking_seeds: Sequence[int],
) -> list[Job]:
    """Table 1; and for some seeds the three controllers and the changing load."""
    machine = load_machine(arm.path)
    move = load_scenario(arm.scenario)
    jobs = []
    for seed in seeds:
        first = seed == seeds[0]
        operations = [Operation("load", with_load(move, load), seed, traced=first) for load in loads_kg or arm.loads_kg]
        if seed in tracking_seeds:
            tracking = with_load(move, TRACKING_LOAD_KG)
            operations += [Operation("tracking", tracking, seed, c, traced=first) for c in CONTROLLERS]
            operations.append(Operation("change", load_scenario(CHANGE_SCENARIO), seed, traced=first))
        jobs.append(
            Job(
                machine=machine,
                profile=with_sensor_set(profile, seed),
                limits=arm.limits[profile.name],
                commission_scenario=load_scenario(arm.commission_scenario),
                seed=COMMISSION_SEED + seed,
                operations=tuple(operations),
                report_commissioning=arm is REFERENCE and profile.name == report.PAPER,
            )
        )
    return jobs


def ablation_profiles(paper: Profile, realistic: Profile) -> list[Profile]:
    """The paper's plant with each effect of the realistic one on its own, then with all.

    Raises
    ------
    ConfigError
        When the realistic profile has an effect that is not in the table of effects.
    """
    known = {key for _, keys, _ in EFFECTS for key in keys} | {SENSOR_SET}
    forgotten = sorted((set(realistic.machine) | set(realistic.effects)) - known)
    if forgotten:
        raise ConfigError(f"tools/paper.py: EFFECTS lacks {', '.join(forgotten)} of profile {realistic.name}")
    alone = [
        replace(
            paper,
            name=name,
            tare=tare,
            machine=paper.machine | {k: v for k, v in realistic.machine.items() if k in keys},
            effects=paper.effects | {k: v for k, v in realistic.effects.items() if k in keys},
        )
        for name, keys, tare in EFFECTS
    ]
    return [*alone, replace(realistic, name=ALL_TOGETHER)]


def _ablation(arm: ArmPlan, paper: Profile, realistic: Profile, seeds: Sequence[int]) -> list[Job]:
    machine, move = load_machine(arm.path), load_scenario(arm.scenario)
    return [
        Job(
            machine=machine,
            profile=with_sensor_set(profile, seed),
            limits=None,
            commission_scenario=load_scenario(arm.commission_scenario),
            seed=COMMISSION_SEED + seed,
            operations=tuple(Operation("ablation", with_load(move, load), seed) for load in ABLATION_LOADS_KG),
        )
        for profile in ablation_profiles(paper, realistic)
        for seed in seeds
    ]


def _checks(arm: ArmPlan, profile: Profile, count: int) -> list[Job]:
    """The hold-out: the first cases are the same for every profile."""
    machine, benchmark = load_machine(arm.path), load_scenario(arm.scenario)
    limits = arm.limits[profile.name].slackened(CHECK_SLACK)
    chance = np.random.default_rng(CHECK_SEED)
    jobs = []
    for k in range(count):
        plant = {
            key: machine[key] * float(chance.uniform(1.0 - CHECK_SPREAD, 1.0 + CHECK_SPREAD)) for key in CHECK_PLANT
        }
        seed = int(chance.integers(1000, 1_000_000))
        scenario = replace(
            with_load(random_moves(machine, benchmark, chance), float(chance.uniform(0.0, arm.full_scale_kg))),
            name=f"check-{k + 1:02d}",
            plant=plant,
        )
        check_scenario(scenario, machine)
        identification = load_scenario(arm.commission_scenario)
        jobs.append(
            Job(
                machine=machine,
                profile=with_sensor_set(profile, seed),
                limits=limits,
                commission_scenario=replace(identification, plant=identification.plant | plant),
                seed=seed + 1,
                operations=(Operation("check", scenario, seed),),
                plant=plant,
            )
        )
    return jobs


def random_moves(machine: Machine, benchmark: Scenario, chance: np.random.Generator) -> Scenario:
    """Each joint from some pose to two others and back, at its own pace."""
    poses, segments = [], []
    for joint in JOINT_NAMES:
        low = machine[f"{joint}.q_min_rad"] + CHECK_MARGIN_RAD
        high = machine[f"{joint}.q_max_rad"] - CHECK_MARGIN_RAD
        start = float(chance.uniform(*CHECK_START_RAD))
        there_and_back = []
        for _ in range(2):
            stroke = float(chance.uniform(*CHECK_STROKE_RAD)) * float(chance.choice([-1.0, 1.0]))
            target = min(max(start + stroke, low), high)
            if abs(target - start) < CHECK_STROKE_RAD[0]:
                target = min(max(start - stroke, low), high)
            for goal in (target, start):
                duration = SEPTIC_PEAK * abs(target - start) / float(chance.uniform(*CHECK_SPEED_RAD_S))
                there_and_back.append(Segment(goal, round(duration, 3), float(chance.uniform(*CHECK_DWELL_S))))
        poses.append(start)
        segments.append(tuple(there_and_back))
    return replace(benchmark, start_pose_rad=(poses[0], poses[1]), segments=(segments[0], segments[1]), repeat=True)


# ---- one job ---------------------------------------------------------------------------------------


def run_job(job: Job) -> list[Case]:
    """Commission, operate, judge."""
    machine, found = commission(job.machine, job.profile, job.seed, job.commission_scenario)
    parameters = tuple(parameter_findings(found, with_changes(job.machine, job.plant, "hold-out")))
    cases = []
    if job.report_commissioning:
        cases.append(_commissioning_case(job, parameters))
    for operation in job.operations:
        setup = setup_for(
            machine, job.profile, operation.scenario, controller=operation.controller, seed=operation.seed
        )
        case = measure(job.profile.name, operation, setup, simulate(setup), job.limits)
        if operation.group == "check" and job.limits:
            case = replace(case, bars=case.bars + parameter_bars(parameters, job.limits), parameters=parameters)
        cases.append(case)
    return with_comparison(cases, job.limits)


def _commissioning_case(job: Job, parameters: tuple[ParameterFinding, ...]) -> Case:
    """The commissioning run itself, once more, for its figures."""
    setup = commissioning_setup(job.machine, job.profile, job.seed, job.commission_scenario)
    operation = Operation("commission", job.commission_scenario, job.seed)
    case = measure(job.profile.name, operation, setup, simulate(setup), None)
    bars = parameter_bars(parameters, job.limits) if job.limits else ()
    return replace(case, bars=case.bars + bars, parameters=parameters)


def parameter_findings(found: list[Finding], plant: Machine) -> list[ParameterFinding]:
    """What was found beside what the plant has; the plant's offsets are none."""
    mass, length = plant["wrist.mass_kg"], plant["wrist.link_length_m"]
    truth = {
        "J": mass * length**2 / 3.0,
        "m2": mass,
        "beta_inverse": 1.0 / plant["oil.bulk_modulus_Pa"],
        "fv1": plant["swing.viscous_Nms_rad"],
        "fv2": plant["wrist.viscous_Nms_rad"],
        "fc1": plant["swing.coulomb_Nm"],
        "fc2": plant["wrist.coulomb_Nm"],
    }
    return [ParameterFinding(f.name, UNITS[f.name], truth.get(f.name, 0.0), f.value, f.sd, not f.poor) for f in found]


def parameter_bars(parameters: Sequence[ParameterFinding], limits: Limits) -> tuple[Bar, ...]:
    """The bars on what commissioning found; what the move does not show is under none."""
    bars = []
    for name, most in (
        (report.PARAMETERS, limits.parameters_percent),
        (report.COMPRESSIBILITY, limits.compressibility_percent),
    ):
        errors = [
            p.error_percent
            for p in parameters
            if p.identifiable and p.error_percent is not None and report.parameter_bar(p.name) == name
        ]
        if most is not None and errors:
            bars.append(Bar(name, "%", max(errors), most=most))
    return tuple(bars)


def measure(profile: str, operation: Operation, setup: Setup, outcome: Outcome, limits: Limits | None) -> Case:
    """The figures of a run that its Result does not have, and the bars of the run on its own."""
    session, result = outcome.session, outcome.result
    timeline, record, ticks = session.timeline, session.record, result.ticks
    late = min(timeline.motion + round(AFTER_S / timeline.period_s), ticks - 1)
    error = 1e3 * (record.state[late:ticks, :2] - record.reference[late:ticks])
    case = Case(
        result=result,
        profile=profile,
        group=operation.group,
        range_mrad=tuple((float(e.min()), float(e.max())) for e in error.T),
        change_settle_s=change_settling(setup.scenario, outcome),
        trace=figures.trace_of(record, timeline.period_s, timeline.motion, ticks) if operation.traced else None,
    )
    return replace(case, bars=bars_of(case, limits, outcome.faulted))


def bars_of(case: Case, limits: Limits | None, faulted: bool) -> tuple[Bar, ...]:
    """What is asked of a run on its own."""
    result = case.result
    bars = []

    def most(name: str, unit: str, value: float | None, limit: float | None) -> None:
        if limit is not None:
            bars.append(Bar(name, unit, value, most=limit))

    peak_late = None
    if None not in result.peak_err_after_1s_rad:
        peak_late = max(v for v in result.peak_err_after_1s_rad if v is not None)
    peak = max(result.peak_err_rad)
    diarc = result.controller == "diarc"
    if limits is not None:
        if case.group in ("load", "check"):
            most(report.LOAD_ERROR, "kg", abs(result.load_err_kg), limits.load_kg)
            most(report.SETTLE, "s", result.load_settle_s, limits.settle_s)
        # On the paper's plant the bar on tracking is that of its one load; on the others it holds for every load.
        if case.group in ("tracking", "check") and diarc:
            most(report.PEAK_LATE, "rad", peak_late, limits.peak_late_rad)
            most(report.PEAK, "rad", peak, limits.peak_rad)
        elif case.group == "load" and case.profile != report.PAPER:
            most(report.PEAK_LATE, "rad", peak_late, limits.peak_late_rad)
        if case.group == "tracking" and result.controller == "pid" and limits.pid_rad:
            bars.append(Bar(report.PID_PEAK, "rad", peak, *limits.pid_rad))
        if case.group == "change":
            settles = case.change_settle_s
            worst = None if None in settles else max(s for s in settles if s is not None)
            most(report.CHANGE_SETTLE, "s", worst, limits.change_settle_s)
            most(report.PEAK, "rad", peak, limits.change_peak_rad)
    if faulted or (case.group == "change" and limits is not None):
        bars.append(Bar(report.FAULTS, "", float(faulted), most=0.0))
    return tuple(bars)


def with_comparison(cases: list[Case], limits: Limits | None) -> list[Case]:
    """Put the bar on load compensation on the run that goes without it."""
    if limits is None or limits.wrist_better_percent is None:
        return cases
    wrist = len(JOINT_NAMES) - 1
    judged = []
    for case in cases:
        if case.group == "tracking" and case.result.controller == "diarc-noload":
            with_it = next(c for c in cases if c.group == "tracking" and c.result.controller == "diarc")
            better = report.better_percent(case.range_mrad[wrist], with_it.range_mrad[wrist], report.peak_to_peak)
            bar = Bar(report.WRIST_BETTER, "%", better, least=limits.wrist_better_percent)
            case = replace(case, bars=(*case.bars, bar))
        judged.append(case)
    return judged


def change_settling(scenario: Scenario, outcome: Outcome) -> tuple[float | None, ...]:
    """Per change of the load: from the first motion at or after it, until the error stays within 0.1 kg."""
    session = outcome.session
    timeline, record = session.timeline, session.record
    ticks = outcome.result.ticks
    error = np.abs(record.load_est[:ticks] - record.load_true[:ticks])
    times: list[float | None] = []
    for k, step in enumerate(scenario.load[1:], start=2):
        end_s = scenario.load[k].time_s if k < len(scenario.load) else scenario.duration_s
        shows_s = first_motion(scenario, step.time_s)
        if shows_s is None or shows_s >= end_s:
            continue
        first, last = (timeline.motion + round(t / timeline.period_s) for t in (shows_s, end_s))
        outside = np.nonzero(error[first:last] > LOAD_BAND_KG)[0]
        if outside.size and first + outside[-1] + 1 >= min(last, ticks):
            times.append(None)
        else:
            times.append(float(outside[-1] + 1) * timeline.period_s if outside.size else 0.0)
    return tuple(times)


def first_motion(scenario: Scenario, time_s: float) -> float | None:
    """When a joint first moves, at this time or later; None if none does."""
    later = []
    for start_s, _, segment in moves(scenario):
        if start_s <= time_s < start_s + segment.duration_s:
            return time_s
        if start_s >= time_s:
            later.append(start_s)
    return min(later, default=None)


# ---- the report ------------------------------------------------------------------------------------


def run_all(extent: Extent, workers: int | None = None) -> Report:
    """Run the plan on the processors that are there."""
    jobs = plan(extent)
    workers = workers or min(len(os.sched_getaffinity(0)), max(len(jobs), 1))
    # Compiled code is made once, here, and the workers inherit it.
    short = replace(load_scenario(REFERENCE.scenario), duration_s=0.01)
    simulate(setup_for(load_machine(REFERENCE.path), load_profile(report.PAPER), short))
    runs = sum(len(job.operations) + job.report_commissioning for job in jobs)
    say(f"paper.py: {len(jobs)} machines are commissioned, then {runs} runs are made; this takes a minute or so")
    if workers > 1:
        pool = ProcessPoolExecutor(workers, multiprocessing.get_context("fork"), _leave_ctrl_c_to_the_parent)
        try:
            done = list(pool.map(run_job, jobs))
        finally:
            pool.shutdown(cancel_futures=True)
    else:
        done = [run_job(job) for job in jobs]
    notes = []
    if "second" in extent.parts and not SECOND.path.exists():
        notes.append(f"The second machine is left out: there is no {SECOND.path.relative_to(ROOT)}.")
    left_out = [part for part in PARTS if part not in extent.parts]
    if left_out:
        notes.append(f"Not all parts were made; left out: {', '.join(left_out)}.")
    return Report(
        cases=tuple(case for cases in done for case in cases),
        notes=tuple(notes),
        full_scale_kg={report.REFERENCE: REFERENCE.full_scale_kg, report.SECOND: SECOND.full_scale_kg},
    )


def _leave_ctrl_c_to_the_parent() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def draw(made: Report) -> dict[str, Figure]:
    """Every picture that these runs have the traces for, by name."""
    pictures: dict[str, Figure] = {}

    def traces(group: str, profile: str, arm: str = report.REFERENCE, controller: str = "diarc") -> list:
        return [c.trace for c in made.of(group, profile, arm, controller) if c.trace is not None]

    by_controller = {c: traces("tracking", report.PAPER, controller=c) for c in CONTROLLERS}
    if all(by_controller.values()):
        pid, without, with_it = (by_controller[c][0] for c in ("pid", "diarc-noload", "diarc"))
        pictures["fig5"] = paper_figures.trajectory(with_it)
        pictures["fig6"] = paper_figures.tracking(pid, with_it)
        pictures["fig7"] = paper_figures.compensation(without, with_it)
        if loads := traces("load", report.PAPER):
            pictures["overview"] = paper_figures.overview(pid, with_it, loads)
    for name, profile, arm in (
        ("fig8", report.PAPER, report.REFERENCE),
        ("realistic", report.REALISTIC, report.REFERENCE),
        (f"{report.SECOND}-{report.PAPER}", report.PAPER, report.SECOND),
        (f"{report.SECOND}-{report.REALISTIC}", report.REALISTIC, report.SECOND),
    ):
        if shown := traces("load", profile, arm):
            pictures[name] = paper_figures.loads(shown)
    if changed := traces("change", report.PAPER):
        pictures["change"] = paper_figures.change(changed[0])
    if ablation := made.of("ablation"):
        limits = REFERENCE.limits[report.REALISTIC]
        pictures["ablation"] = paper_figures.ablation(
            report.shares(ablation), limits.load_kg, 1e3 * (limits.peak_late_rad or 0.0)
        )
    checks = [
        (
            f"Profile {profile}",
            [paper_figures.Point(c.result.load_true_kg, c.result.load_err_kg) for c in cases],
            CHECK_SLACK * REFERENCE.limits[profile].load_kg,
        )
        for profile in (report.PAPER, report.REALISTIC)
        if (cases := made.of("check", profile))
    ]
    if checks:
        pictures["check"] = paper_figures.check(checks)
    return pictures


def write(made: Report, out: Path) -> dict[str, Figure]:
    """Write page, JSON and pictures to a folder; the pictures.

    Raises
    ------
    ConfigError
        When a file cannot be written.
    """
    pictures = draw(made)
    try:
        out.mkdir(parents=True, exist_ok=True)
        for old in out.glob("*.png"):
            old.unlink()
        (out / "report.html").write_text(report.page(made, pictures), encoding="utf-8")
        (out / "report.json").write_text(report.to_json(made.cases), encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{error.filename}: cannot be written: {error.strerror}") from error
    for name, figure in pictures.items():
        figures.save_png(figure, out / f"{name}.png")
    return pictures


def refresh_readme(made: Report, pictures: dict[str, Figure]) -> None:
    """Make the README's picture and section anew."""
    try:
        README_PICTURE.parent.mkdir(parents=True, exist_ok=True)
        old = README.read_text(encoding="utf-8") if README.exists() else ""
        new = report.replace_section(old, report.readme_section(made))
        if new != old:
            README.write_text(new, encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{error.filename}: cannot be written: {error.strerror}") from error
    figures.save_png(pictures["overview"], README_PICTURE)


def parse_arguments(argv: list[str]) -> argparse.Namespace:
    """Read the command line; a wrong one ends the program with status 2."""
    parser = argparse.ArgumentParser(
        prog="paper.py", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", choices=PARTS, help="one part; README.md stays as it is")
    parser.add_argument("--out", type=Path, default=OUT, metavar="FOLDER", help="default out/paper")
    return parser.parse_args(argv)


def main(argv: list[str]) -> int:
    """Run the command line; the exit status."""
    arguments = parse_arguments(argv)
    start = time.perf_counter()
    extent = Extent(parts=(arguments.only,)) if arguments.only else Extent()
    try:
        made = run_all(extent)
        pictures = write(made, arguments.out)
        if not arguments.only:
            refresh_readme(made, pictures)
    except ConfigError as error:
        say(f"paper.py: {error}")
        return EXIT_WRONG_USE
    except KeyboardInterrupt:
        say("paper.py: interrupted; nothing was written")
        return EXIT_INTERRUPTED
    rows = report.verdicts(made.cases)
    for v in rows:
        if not v.met:
            value, limit = report.shown(v.worst)
            print(
                f"not met: {v.arm}, {v.profile}, {report.GROUPS.get(v.group, v.group)}: {v.worst.name} {value}, "
                f"bar {limit}, {v.met_runs} of {v.runs} runs, worst at {v.where}"
            )
    for note in made.notes:
        print(note)
    print(f"{len(made.cases)} runs in {time.perf_counter() - start:.0f} s: {report.summary_line(rows)}")
    print(f"wrote {arguments.out / 'report.html'}, report.json and {len(pictures)} pictures")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
