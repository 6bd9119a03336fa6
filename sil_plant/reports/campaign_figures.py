"""The pictures of a campaign's report. The same data gives the same bytes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from sil_plant.campaigning import statistics
from sil_plant.campaigning.spec import FIGURES
from sil_plant.inputs.machine import JOINT_NAMES
from sil_plant.reports.figures import (
    DPI,
    JOINT_COLOURS,
    LOAD_COLOUR,
    REFERENCE_COLOUR,
    SETTLED_S,
    STYLE,
    TRUTH_COLOUR,
    WIDTH_PX,
    Trace,
)
from sil_plant.reports.paper_figures import BAR_COLOUR, DIARC_COLOUR, thin

BINS_MOST = 60
DRIVERS_SHOWN = 12


def load_errors(load_kg: np.ndarray, error_kg: np.ndarray, limit_kg: float | None) -> Figure:
    """How the load errors are distributed, and over which load they lie."""
    with _figure(0.34) as figure:
        left, right = figure.subplots(1, 2, width_ratios=(1.0, 1.15))
        left.hist(error_kg, bins=_bins(error_kg), color=DIARC_COLOUR)
        left.set_title("Load error at the end")
        left.set_xlabel("load error, kg")
        left.set_ylabel("arms")
        right.scatter(load_kg, error_kg, s=7.0, color=DIARC_COLOUR, linewidths=0.0, alpha=0.7)
        right.set_title("over the load")
        right.set_xlabel("load, kg")
        right.set_ylabel("load error, kg")
        right.margins(x=0.02)
        _limits(left, (-limit_kg, limit_kg) if limit_kg is not None else (), "v", error_kg)
        _limits(right, (-limit_kg, limit_kg) if limit_kg is not None else (), "h", error_kg)
    return figure


def shares(found: Sequence[statistics.Figure]) -> Figure:
    """For each figure, which share of the arms is at most so large; the limits beside."""
    columns = 3
    rows = -(-len(found) // columns)
    with _figure(0.3 * rows) as figure:
        places = figure.subplots(rows, columns, squeeze=False).ravel()
        for axes, one in zip(places, found, strict=False):
            text, unit, factor = FIGURES[one.name]
            values = np.sort(one.values[np.isfinite(one.values)]) * factor
            heights = 100.0 * np.arange(1, len(values) + 1) / len(one.values)
            axes.step(values, heights, where="post", color=DIARC_COLOUR)
            axes.set_title(text, fontsize=11.0)
            axes.set_xlabel(unit)
            axes.set_ylim(0.0, 103.0)
            axes.set_ylabel("arms at most so, %")
            if one.limit is not None:
                _limits(axes, (one.limit * factor,), "v", values)
        for axes in places[len(found) :]:
            axes.set_axis_off()
    return figure


def drivers(found: statistics.Drivers) -> Figure:
    """Which variables drive a figure: Sobol indices with their intervals, rank correlations, and what chance gives."""
    shown = found.drivers[:DRIVERS_SHOWN]
    places = np.arange(len(shown))[::-1]
    with _figure(0.08 + 0.026 * len(shown)) as figure:
        left, right = figure.subplots(1, 2, sharey=True)
        indices = np.array([d.index for d in shown])
        widths = np.array([d.index_half_width for d in shown])
        left.barh(places, indices, color=DIARC_COLOUR, height=0.62, label="first order")
        left.errorbar(indices, places, xerr=np.nan_to_num(widths), fmt="none", ecolor=TRUTH_COLOUR, elinewidth=1.0)
        totals = [d.total for d in shown]
        if None not in totals:
            left.plot(totals, places, "D", color=JOINT_COLOURS[1], markersize=5.0, label="total")
            left.legend(loc="lower right")
        if np.isfinite(found.chance_index):
            _limits(left, (found.chance_index,), "v", indices)
        left.set_title("Share of the variance (Sobol index)")
        right.barh(places, [d.rank_correlation for d in shown], color=LOAD_COLOUR, height=0.62)
        right.axvline(0.0, color=TRUTH_COLOUR, linewidth=0.8)
        _limits(right, (-found.chance_correlation, found.chance_correlation), "v", np.array([-0.2, 0.2]))
        right.set_title("Rank correlation")
        left.set_yticks(places, [d.variable for d in shown])
        for axes in (left, right):
            axes.grid(visible=False, axis="y")
    return figure


def run(trace: Trace) -> Figure:
    """One run in a row from the start of motion: angles, tracking errors, error of the load's estimate."""
    moving = trace.time_s >= 0.0
    time_s, late = trace.time_s[moving], trace.time_s[moving] >= SETTLED_S
    load_error = (trace.load_est_kg - trace.load_true_kg)[moving]
    with _figure(0.25) as figure:
        angles, errors, load = figure.subplots(1, 3)
        for joint, name in enumerate(JOINT_NAMES):
            wide = {"color": REFERENCE_COLOUR, "linewidth": 4.0}
            _line(angles, time_s, trace.reference_rad[moving, joint], **wide)
            _line(angles, time_s, trace.angle_rad[moving, joint], color=JOINT_COLOURS[joint], label=name)
            _line(errors, time_s, trace.error_mrad[moving, joint], color=JOINT_COLOURS[joint], linewidth=1.0)
        load.axhline(0.0, color=TRUTH_COLOUR, linewidth=0.8)
        _line(load, time_s, load_error, color=LOAD_COLOUR)
        settled = 1.5 * float(np.abs(load_error[late]).max(initial=0.02))  # not what it is before the first motion
        load.set_ylim(-settled, settled)
        for axes, title in ((angles, "angle, rad"), (errors, "tracking error, mrad"), (load, "load error, kg")):
            axes.set_title(title)
            axes.set_xlabel("time, s")
            axes.margins(x=0.01)
        low, high = angles.get_ylim()
        angles.set_ylim(low, high + 0.25 * (high - low))
        angles.legend(loc="upper right", ncols=2, borderaxespad=0.2, handlelength=1.6)
    return figure


def _bins(values: np.ndarray) -> int:
    """As many bins as the values can fill."""
    return int(min(BINS_MOST, max(8, 2.0 * np.sqrt(len(values)))))


def _limits(axes: Axes, limits: Sequence[float], direction: str, values: np.ndarray) -> None:
    """Lines at limits; only where they do not dwarf what is shown."""
    largest = float(np.abs(values).max(initial=0.0))
    for limit in limits:
        if largest > 0.0 and abs(limit) > 4.0 * largest:
            continue
        draw = axes.axvline if direction == "v" else axes.axhline
        draw(limit, color=BAR_COLOUR, linewidth=1.3, linestyle=(0, (4, 2)))


def _line(axes: Axes, time_s: np.ndarray, values: np.ndarray, **style: object) -> None:
    axes.plot(*thin(time_s, values), **style)


@contextmanager
def _figure(height: float) -> Iterator[Figure]:
    """An empty figure of the usual width; height in widths."""
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(STYLE)
        figure = Figure(figsize=(WIDTH_PX / DPI, height * WIDTH_PX / DPI), dpi=DPI, layout="constrained")
        FigureCanvasAgg(figure)
        yield figure
