"""The paper's figures, drawn from our runs, and the others of its report.

The same data gives the same bytes, as PNG and as SVG: no dates, no versions, no chance.
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import pairwise
from typing import NamedTuple

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from sil_plant.inputs.machine import JOINT_NAMES
from sil_plant.reports.figures import (
    DPI,
    JOINT_COLOURS,
    REFERENCE_COLOUR,
    SETTLED_S,
    STYLE,
    TRUTH_COLOUR,
    WIDTH_PX,
    Trace,
)

POINTS_MOST = 2000  # of one line
PID_COLOUR, DIARC_COLOUR, NOLOAD_COLOUR, BAR_COLOUR = "#CC79A7", "#0072B2", "#D55E00", "#C62828"
LOADS_COLOURS = "viridis"
TIME_LABEL = "time from the start of motion, s"
NOTHING = {"Date": None, "Creator": None, "Format": None, "Type": None}
PREFIXED = re.compile(r'(\bid="|\burl\(#|\bhref="#)')


class Share(NamedTuple):
    """What one effect of a plant costs."""

    name: str
    load_kg: float
    peak_mrad: float


class Point(NamedTuple):
    """A load and the error of its estimate, kg."""

    load_kg: float
    error_kg: float


def trajectory(trace: Trace) -> Figure:
    """Fig. 5: the references of both joints and their rates."""
    with _figure(0.36) as figure:
        angle, rate = figure.subplots(1, 2)
        shown = trace.time_s >= 0.0
        time_s, reference = trace.time_s[shown], trace.reference_rad[shown]
        for joint, name in enumerate(JOINT_NAMES):
            style = {
                "color": JOINT_COLOURS[joint],
                "linestyle": ("-", (0, (3, 3)))[joint],
                "linewidth": (2.6, 1.8)[joint],
                "label": name,
            }
            _line(angle, time_s, reference[:, joint], **style)
            _line(rate, time_s, np.gradient(reference[:, joint], time_s), **style)
        _finish(angle, "Desired angle", "rad", legend=True)
        _finish(rate, "Desired rate", "rad/s", legend=True)
    return figure


def tracking(pid: Trace, diarc: Trace) -> Figure:
    """Fig. 6: tracking errors of PID and DIARC, together and, as it is too small to be seen there, DIARC alone."""
    with _figure(0.58) as figure:
        both, alone = figure.subplots(2, len(JOINT_NAMES), sharex=True)
        for joint, name in enumerate(JOINT_NAMES):
            _line(both[joint], pid.time_s, pid.error_mrad[:, joint], color=PID_COLOUR, label="PID")
            _line(both[joint], diarc.time_s, diarc.error_mrad[:, joint], color=DIARC_COLOUR, label="DIARC")
            _line(
                alone[joint],
                diarc.time_s,
                diarc.error_mrad[:, joint],
                color=DIARC_COLOUR,
                linewidth=1.0,
                label="DIARC",
            )
            _finish(both[joint], f"{name.capitalize()}", "error, mrad", legend=True, time=False)
            _finish(alone[joint], f"{name.capitalize()}, DIARC on its own scale", "error, mrad")
        figure.align_ylabels()
    return figure


def compensation(without: Trace, with_it: Trace) -> Figure:
    """Fig. 7: tracking errors of DIARC without and with compensation of the load."""
    with _figure(0.36) as figure:
        for joint, (axes, name) in enumerate(zip(figure.subplots(1, 2), JOINT_NAMES, strict=True)):
            _line(
                axes,
                without.time_s,
                without.error_mrad[:, joint],
                color=NOLOAD_COLOUR,
                linewidth=1.0,
                label="without",
            )
            _line(
                axes,
                with_it.time_s,
                with_it.error_mrad[:, joint],
                color=DIARC_COLOUR,
                linewidth=1.0,
                label="with",
            )
            axes.axvline(SETTLED_S, color=REFERENCE_COLOUR, linewidth=1.2, zorder=0.5)
            _finish(axes, f"{name.capitalize()}: load compensation", "error, mrad", legend=True)
    return figure


def loads(traces: Sequence[Trace], start_s: float = 1.0) -> Figure:
    """Fig. 8: load estimates over time, their start, and their errors once settled.

    Parameters
    ----------
    traces : sequence of Trace
        One per load.
    start_s : float
        How much the picture of the start shows.
    """
    with _figure(0.4) as figure:
        start, late = figure.subplots(1, 2)
        colours = _load_colours(len(traces))
        for colour, trace in zip(colours, traces, strict=True):
            load = float(trace.load_true_kg[-1])
            early = (trace.time_s >= -0.05 * start_s) & (trace.time_s <= start_s)
            start.axhline(load, color=colour, linewidth=0.9, linestyle=(0, (5, 3)))
            _line(start, trace.time_s[early], trace.load_est_kg[early], color=colour, label=f"{load:g} kg")
            settled = trace.time_s >= SETTLED_S
            _line(
                late,
                trace.time_s[settled],
                (trace.load_est_kg - trace.load_true_kg)[settled],
                color=colour,
                linewidth=1.2,
            )
        late.axhline(0.0, color=TRUTH_COLOUR, linewidth=0.8, linestyle=(0, (5, 3)))
        _finish(start, "Load estimates (dashed: true)", "kg", time=True)
        _finish(late, f"Their errors from {SETTLED_S:g} s on", "kg")
        figure.legend(*start.get_legend_handles_labels(), loc="outside lower center", ncols=len(traces))
    return figure


def change(trace: Trace) -> Figure:
    """A load that changes: estimate and truth, and the tracking errors."""
    with _figure(0.36) as figure:
        load, errors = figure.subplots(1, 2)
        _line(load, trace.time_s, trace.load_est_kg, color=DIARC_COLOUR, label="estimate")
        _line(
            load,
            trace.time_s,
            trace.load_true_kg,
            color=TRUTH_COLOUR,
            linewidth=1.2,
            linestyle=(0, (5, 3)),
            label="true",
        )
        for joint, name in enumerate(JOINT_NAMES):
            _line(
                errors,
                trace.time_s,
                trace.error_mrad[:, joint],
                color=JOINT_COLOURS[joint],
                linewidth=1.0,
                label=name,
            )
        _finish(load, "Load", "kg", legend=True)
        _finish(errors, "Tracking errors", "mrad", legend=True)
    return figure


def ablation(shares: Sequence[Share], load_bar_kg: float, peak_bar_mrad: float) -> Figure:
    """What each effect costs on its own, and all together."""
    with _figure(0.5) as figure:
        axes_pair = figure.subplots(1, 2, sharey=True)
        places = np.arange(len(shares))[::-1]
        columns = (
            ("Worst load error", "kg", [s.load_kg for s in shares], load_bar_kg),
            (f"Peak error after {SETTLED_S:g} s", "mrad", [s.peak_mrad for s in shares], peak_bar_mrad),
        )
        for axes, (title, unit, values, limit) in zip(axes_pair, columns, strict=True):
            axes.barh(places, values, color=DIARC_COLOUR, height=0.65)
            axes.axvline(limit, color=BAR_COLOUR, linewidth=1.4)
            axes.annotate(
                f" bar {limit:g}",
                (limit, 0.0),
                xycoords=("data", "axes fraction"),
                xytext=(0, 4),
                textcoords="offset points",
                color=BAR_COLOUR,
                fontsize=10.0,
            )
            axes.set_xlim(0.0, 1.25 * max(limit, *values))
            axes.set_xlabel(unit)
            axes.set_title(title)
            axes.grid(visible=False, axis="y")
        axes_pair[0].set_yticks(places, [s.name for s in shares])
    return figure


def check(series: Sequence[tuple[str, Sequence[Point], float]]) -> Figure:
    """Load errors of runs that no number was chosen on; title, points and limit per set of axes."""
    with _figure(0.34) as figure:
        for axes, (title, points, limit) in zip(np.atleast_1d(figure.subplots(1, len(series))), series, strict=True):
            axes.axhspan(-limit, limit, color=REFERENCE_COLOUR, alpha=0.35, linewidth=0.0)
            outside = [abs(p.error_kg) > limit for p in points]
            axes.scatter(
                [p.load_kg for p in points],
                [p.error_kg for p in points],
                color=[BAR_COLOUR if bad else DIARC_COLOUR for bad in outside],
                s=22.0,
            )
            axes.set_title(f"{title} (grey: the bar)")
            axes.set_xlabel("load, kg")
            axes.set_ylabel("load error, kg")
    return figure


def overview(pid: Trace, diarc: Trace, load_traces: Sequence[Trace], start_s: float = 0.6) -> Figure:
    """One picture of it all: tracking errors of PID and DIARC, and the load estimates."""
    with _figure(0.5) as figure:
        layout = figure.add_gridspec(2, 2, width_ratios=(1.0, 1.0))
        both, alone = figure.add_subplot(layout[0, 0]), figure.add_subplot(layout[1, 0])
        wrist = len(JOINT_NAMES) - 1
        _line(both, pid.time_s, pid.error_mrad[:, 0], color=PID_COLOUR, label="PID, swing")
        _line(both, pid.time_s, pid.error_mrad[:, wrist], color=PID_COLOUR, linestyle=(0, (4, 2)), label="wrist")
        for joint, name in enumerate(JOINT_NAMES):
            style = {"color": JOINT_COLOURS[joint], "linewidth": 1.0}
            _line(both, diarc.time_s, diarc.error_mrad[:, joint], **style)
            _line(alone, diarc.time_s, diarc.error_mrad[:, joint], **style, label=f"DIARC, {name}")
        _finish(both, f"Tracking errors, {diarc.load_true_kg[-1]:g} kg: PID and DIARC", "mrad", legend=True, time=False)
        _finish(alone, "DIARC on its own scale", "mrad", legend=True)
        right = figure.add_subplot(layout[:, 1])
        for colour, trace in zip(_load_colours(len(load_traces)), load_traces, strict=True):
            load = float(trace.load_true_kg[-1])
            shown = (trace.time_s >= -0.05) & (trace.time_s <= start_s)
            right.axhline(load, color=colour, linewidth=0.9, linestyle=(0, (5, 3)))
            error_g = 1e3 * float(trace.load_est_kg[-1] - load)
            _line(right, trace.time_s[shown], trace.load_est_kg[shown], color=colour, linewidth=2.0)
            right.annotate(
                f"{load:g} kg, {error_g:+.1f} g at {trace.time_s[-1]:.0f} s",
                (start_s, load),
                xytext=(0, 4),
                textcoords="offset points",
                ha="right",
                fontsize=10.5,
            )
        _widen(right, 0.05)
        _finish(right, "Load estimates (dashed: true) and their final errors", "kg")
        figure.align_ylabels([both, alone])
    return figure


def svg(figure: Figure, name: str) -> str:
    """A figure as an SVG element for a page; its identifiers begin with ``name``, so that no two pictures share one."""
    text = io.StringIO()
    with _style():
        matplotlib.rcParams["svg.hashsalt"] = name
        figure.savefig(text, format="svg", metadata=NOTHING)
    element = text.getvalue()
    element = element[element.index("<svg") :]
    element = re.sub(r"\s*<metadata>.*?</metadata>", "", element, flags=re.DOTALL)
    element = re.sub(r' xmlns(:xlink)?="[^"]*"', "", element).replace("xlink:href", "href")
    return PREFIXED.sub(rf"\g<1>{name}-", element).strip()


def thin(time_s: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """At most ``POINTS_MOST`` points of a line, none of its peaks lost: least and greatest of each stretch."""
    n = len(values)
    if n <= POINTS_MOST:
        return time_s, values
    edges = np.linspace(0, n, POINTS_MOST // 2 + 1).astype(int)
    keep = []
    for first, last in pairwise(edges):
        stretch = values[first:last]
        keep += sorted({first + int(stretch.argmin()), first + int(stretch.argmax())})
    return time_s[keep], values[keep]


@contextmanager
def _style() -> Iterator[None]:
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(STYLE)
        yield


@contextmanager
def _figure(height: float) -> Iterator[Figure]:
    """An empty figure of the usual width; height in widths."""
    with _style():
        figure = Figure(figsize=(WIDTH_PX / DPI, height * WIDTH_PX / DPI), dpi=DPI, layout="constrained")
        FigureCanvasAgg(figure)
        yield figure


def _line(axes: Axes, time_s: np.ndarray, values: np.ndarray, **style: object) -> None:
    axes.plot(*thin(time_s, values), **style)


def _load_colours(count: int) -> list[tuple[float, ...]]:
    return [tuple(c) for c in matplotlib.colormaps[LOADS_COLOURS](np.linspace(0.85, 0.0, max(count, 1)))]


def _widen(axes: Axes, above: float) -> None:
    """Make room above the lines, for the legend."""
    low, high = axes.get_ylim()
    axes.set_ylim(low, high + above * (high - low))


def _finish(axes: Axes, title: str, unit: str, legend: bool = False, time: bool = True) -> None:
    axes.set_title(title)
    axes.set_ylabel(unit)
    axes.margins(x=0.01)
    if legend:
        _widen(axes, 0.2)
    if time:
        axes.set_xlabel(TIME_LABEL)
    if legend:
        axes.legend(loc="upper right", ncols=3, borderaxespad=0.2, columnspacing=1.2, handlelength=1.8)
