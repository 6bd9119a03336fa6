"""What a campaign's rows say, and how surely: shares and quantiles with confidence intervals, and what drives errors.

Intervals assume independent runs. A Latin hypercube or a scrambled Sobol sequence covers the space more evenly than
chance, so that these intervals are, if anything, too wide.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
from scipy import stats

from sil_plant.campaigning.arm_run import OK, SENSOR_NAMES, sensor_column
from sil_plant.campaigning.sampling import problem, unit_sample
from sil_plant.campaigning.spec import FIGURES, Campaign

CONFIDENCE = 0.95
QUANTILES = (0.5, 0.95, 0.99)
BEYOND_LEAST = 5  # runs beyond a quantile, below which it is not given
# Figures whose causes are looked for; the load error with its sign, because what shifts it up shifts it down, too.
DRIVEN = (
    "load_err_kg",
    "load_settle_s",
    "swing_peak_err_after_1s_rad",
    "wrist_peak_err_after_1s_rad",
)
DRIVEN_RUNS_LEAST = 64
CHANCE_RESAMPLES = 20  # of the figure shuffled, for what chance alone gives


@dataclass(frozen=True)
class Share:
    """How many of how many, with the exact (Clopper-Pearson) interval of the share."""

    count: int
    of: int
    low: float
    high: float


@dataclass(frozen=True)
class Quantile:
    """A quantile with its bootstrap interval; infinity where runs never got there."""

    at: float
    value: float
    low: float
    high: float


@dataclass(frozen=True)
class Figure:
    """How a figure's magnitude is distributed over the runs."""

    name: str
    values: np.ndarray  # of every run that was operated; infinity: never
    quantiles: tuple[Quantile, ...]
    worst: float
    worst_run: int
    limit: float | None
    within: Share | None  # of all arms, also those that failed earlier


@dataclass(frozen=True)
class Driver:
    """How much a variable has to do with a figure."""

    variable: str
    rank_correlation: float
    index: float  # first-order Sobol index
    index_half_width: float  # of its 95 % interval; nan where there is none
    total: float | None  # total index, with the sampling saltelli


@dataclass(frozen=True)
class Drivers:
    """All variables' part in a figure, greatest first, and what chance alone gives."""

    figure: str
    runs: int
    drivers: tuple[Driver, ...]
    chance_correlation: float
    chance_index: float


@dataclass(frozen=True)
class Summary:
    """Everything the report tells in numbers."""

    runs: int
    planned: int
    statuses: dict[str, Share]
    faults: dict[str, Share]
    figures: tuple[Figure, ...]
    drivers: tuple[Drivers, ...]
    worst: tuple[int, ...]  # runs, worst first


def share(count: int, of: int) -> Share:
    """A share with its exact interval."""
    if of == 0:
        return Share(0, 0, 0.0, 1.0)
    interval = stats.binomtest(count, of).proportion_ci(CONFIDENCE, method="exact")
    return Share(count, of, float(interval.low), float(interval.high))


def quantile(values: np.ndarray, at: float) -> Quantile | None:
    """A quantile with its bootstrap interval; None where too few runs are beyond it.

    Parameters
    ----------
    values : np.ndarray
        Infinity is a value like any other: the quantile is one of the values, never between two.
    at : float
        In 0 to 1.
    """
    n = len(values)
    if n * min(at, 1.0 - at) < BEYOND_LEAST:
        return None
    ordered = np.sort(values)
    k = max(1, int(np.ceil(n * at - 1e-9)))  # the quantile is the k-th of the ordered values
    # The k-th of n values drawn anew from these n is the j-th or an earlier one with probability I_{j/n}(k, n - k + 1):
    # the bootstrap's distribution itself, as of endlessly many resamples.
    tail = 0.5 * (1.0 - CONFIDENCE)
    ends = stats.beta.ppf([tail, 1.0 - tail], k, n - k + 1)
    low, high = (float(ordered[min(n - 1, max(0, int(np.ceil(n * end)) - 1))]) for end in ends)
    return Quantile(at, float(ordered[k - 1]), low, high)


def magnitude(table: pa.Table, name: str) -> np.ndarray:
    """A figure's magnitude for each run; infinity for a load that never settled, nan where there is no figure."""
    values = np.abs(table[name].to_numpy(zero_copy_only=False).astype(np.float64))
    if name == "load_settle_s":
        operated = ~np.isnan(table["load_true_kg"].to_numpy(zero_copy_only=False).astype(np.float64))
        values[operated & np.isnan(values)] = np.inf
    return values


def badness(table: pa.Table, name: str) -> np.ndarray:
    """What the worst runs are found by: those that did not end well come first, then the figure."""
    values = np.nan_to_num(magnitude(table, name), nan=np.inf, posinf=1e300)
    failed = np.array(table["status"].to_pylist()) != OK
    return np.where(failed, np.inf, values)


def figures(campaign: Campaign, table: pa.Table) -> tuple[Figure, ...]:
    """Every figure of a run over all runs."""
    runs = table["run"].to_numpy()
    good = np.array(table["status"].to_pylist()) == OK
    found = []
    for name in FIGURES:
        values = magnitude(table, name)
        there = ~np.isnan(values)
        if not there.any():
            continue
        limit = campaign.limits.get(name)
        kept = values[there]
        found.append(
            Figure(
                name=name,
                values=kept,
                quantiles=tuple(q for at in QUANTILES if (q := quantile(kept, at)) is not None),
                worst=float(kept.max()),
                worst_run=int(runs[there][kept.argmax()]),
                limit=limit,
                within=None if limit is None else share(int((good & (values <= limit)).sum()), table.num_rows),
            )
        )
    return tuple(found)


def inputs(campaign: Campaign, table: pa.Table) -> dict[str, np.ndarray]:
    """Everything random that a run was made of, by column: variables, and what sensors got by their set's number."""
    names = [v.label for v in campaign.random if "effects.sensor_set" not in v.keys]
    names += [c for c in (sensor_column(n) for n in SENSOR_NAMES) if c in table.column_names]
    columns = {name: table[name].to_numpy(zero_copy_only=False).astype(np.float64) for name in names}
    return {name: values for name, values in columns.items() if np.ptp(values) > 0.0}


def drivers(campaign: Campaign, table: pa.Table, figure: str) -> Drivers | None:
    """Which variables drive a figure; None where too few runs have it, or it is always the same.

    Rank correlations are Spearman's. First-order Sobol indices are estimated from the runs as they are by RBD-FAST,
    which takes any sample of independent variables; with the sampling ``saltelli`` they are Saltelli's, with total
    indices. What chance gives: correlations at 5 % over all variables together (Bonferroni), and the greatest index
    of any variable with the figure shuffled.
    """
    if campaign.sampling == "saltelli":
        return _saltelli(campaign, table, figure)
    from SALib.analyze import rbd_fast

    y = table[figure].to_numpy(zero_copy_only=False).astype(np.float64)
    columns = inputs(campaign, table)
    there = np.isfinite(y)
    if there.sum() < DRIVEN_RUNS_LEAST or np.ptp(y[there]) == 0.0 or not columns:
        return None
    y = y[there]
    x = np.column_stack([values[there] for values in columns.values()])
    names = list(columns)
    found = rbd_fast.analyze(problem(names), x, y, num_resamples=100, conf_level=CONFIDENCE, seed=1)
    chance = np.random.default_rng(1)
    by_chance = max(
        float(np.max(rbd_fast.analyze(problem(names), x, chance.permutation(y), num_resamples=2, seed=1)["S1"]))
        for _ in range(CHANCE_RESAMPLES)
    )
    rows = [
        Driver(name, _rank_correlation(x[:, k], y), float(found["S1"][k]), float(found["S1_conf"][k]), None)
        for k, name in enumerate(names)
    ]
    return _sorted(figure, len(y), rows, by_chance)


def _saltelli(campaign: Campaign, table: pa.Table, figure: str) -> Drivers | None:
    """Indices by the sample made for them: it has to be whole."""
    from SALib.analyze import sobol

    y = table[figure].to_numpy(zero_copy_only=False).astype(np.float64)
    names = [v.label for v in campaign.random]
    if len(y) != len(unit_sample(campaign)) or not np.isfinite(y).all() or np.ptp(y) == 0.0:
        return None
    found = sobol.analyze(problem(names), y, calc_second_order=False, num_resamples=200, conf_level=CONFIDENCE, seed=1)
    x = {name: table[name].to_numpy() for name in names}
    rows = [
        Driver(
            name,
            _rank_correlation(x[name], y),
            float(found["S1"][k]),
            float(found["S1_conf"][k]),
            float(found["ST"][k]),
        )
        for k, name in enumerate(names)
    ]
    return _sorted(figure, len(y), rows, float("nan"))


def _rank_correlation(x: np.ndarray, y: np.ndarray) -> float:
    return float(stats.spearmanr(x, y).statistic)


def _sorted(figure: str, runs: int, rows: Sequence[Driver], chance_index: float) -> Drivers:
    corrected = (1.0 - CONFIDENCE) / len(rows)
    chance = float(stats.norm.ppf(1.0 - 0.5 * corrected) / np.sqrt(runs - 1.0))
    ordered = sorted(rows, key=lambda d: -max(d.index, d.rank_correlation**2))
    return Drivers(figure, runs, tuple(ordered), chance, chance_index)


def summary(campaign: Campaign, table: pa.Table, planned: int, worst: int = 10) -> Summary:
    """Everything the report tells in numbers.

    Parameters
    ----------
    campaign : Campaign
        The spec.
    table : pa.Table
        Its rows; may lack those of batches that killed their workers.
    planned : int
        How many rows there should be.
    worst : int
        How many of the worst runs are named.
    """
    statuses = table["status"].to_pylist()
    faults = [set(text.split(", ")) - {""} for text in table["faults"].to_pylist()]
    order = np.argsort(-badness(table, campaign.worst_by), kind="stable")
    found = [drivers(campaign, table, figure) for figure in DRIVEN]
    return Summary(
        runs=table.num_rows,
        planned=planned,
        statuses={name: share(statuses.count(name), len(statuses)) for name in dict.fromkeys(["ok", *statuses])},
        faults={
            name: share(sum(name in of_run for of_run in faults), len(faults))
            for name in sorted(set().union(*faults) if faults else ())
        },
        figures=figures(campaign, table),
        drivers=tuple(d for d in found if d is not None),
        worst=tuple(table["run"].to_numpy()[order[:worst]].tolist()),
    )
