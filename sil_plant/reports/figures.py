"""Pictures of runs, drawn by matplotlib without a display.

A function draws one set of axes (``draw_...``), another arranges them in a figure, one writes it.
Neither the user's matplotlib settings nor the date has a say: the same run gives the same bytes.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from sil_plant.config import ConfigError
from sil_plant.inputs.machine import JOINT_NAMES

if TYPE_CHECKING:
    from sil_plant.loop.session import Record

WIDTH_PX = 1200
DPI = 120

# The colours of Okabe and Ito, which people with any colour vision can tell apart.
JOINT_COLOURS = ("#0072B2", "#D55E00")
LOAD_COLOUR = "#009E73"
REFERENCE_COLOUR = "#B5B5B5"
TRUTH_COLOUR = "#000000"

STYLE = {
    "font.family": "DejaVu Sans",
    "font.size": 11.0,
    "axes.titlesize": 12.0,
    "axes.titlelocation": "left",
    "axes.labelsize": 11.0,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "grid.color": "#E2E2E2",
    "grid.linewidth": 0.8,
    "legend.fontsize": 10.0,
    "legend.frameon": True,
    "legend.framealpha": 0.9,
    "legend.edgecolor": "none",
    "lines.linewidth": 1.6,
    "figure.titlesize": 13.0,
    "figure.facecolor": "white",
    "savefig.facecolor": "white",
    "path.simplify": True,
}
SETTLED_S = 1.0  # the errors' close-up begins here
CLOSE_UP_WHEN = 4.0  # and is drawn when the errors before it are this much larger


@dataclass(frozen=True)
class Trace:
    """What the axes show of a record, in their units; arrays per joint have shape (ticks, 2)."""

    time_s: np.ndarray
    angle_rad: np.ndarray
    reference_rad: np.ndarray
    error_mrad: np.ndarray
    spool_percent: np.ndarray
    load_true_kg: np.ndarray
    load_est_kg: np.ndarray
    load_sd_kg: np.ndarray


def trace_of(record: Record, period_s: float, motion_tick: int = 0, ticks: int | None = None) -> Trace:
    """Take what the axes show from a run's record.

    Parameters
    ----------
    record : Record
        A run's.
    period_s : float
        Its tick.
    motion_tick : int
        The tick at which motion starts: time zero.
    ticks : int, optional
        How many rows were run, for a run that was broken off; default all.
    """
    n = len(record.load_true) if ticks is None else ticks
    return _trace(
        time_s=(np.arange(n) - motion_tick) * period_s,
        angle_rad=record.state[:n, : len(JOINT_NAMES)],
        reference_rad=record.reference[:n],
        command=record.command[:n],
        load_kg=(record.load_true[:n], record.load_est[:n], record.load_sd[:n]),
    )


def read_trace(path: Path) -> Trace:
    """Take what the axes show from the CSV file that ``run.py --csv`` writes.

    Raises
    ------
    ConfigError
        When the file is not there or is something else.
    """
    try:
        with path.open(encoding="utf-8") as file:
            names = file.readline().strip().split(",")
            shown = [name for name in names if name != "mode"]
            columns = np.loadtxt(
                file, delimiter=",", usecols=[names.index(name) for name in shown], unpack=True, ndmin=2
            )
        column = dict(zip(shown, columns, strict=True))
        return _trace(
            time_s=column["t_s"],
            angle_rad=np.column_stack([column[f"{name}_rad"] for name in JOINT_NAMES]),
            reference_rad=np.column_stack([column[f"{name}_reference_rad"] for name in JOINT_NAMES]),
            command=np.column_stack([column[f"{name}_command"] for name in JOINT_NAMES]),
            load_kg=(column["load_true_kg"], column["load_est_kg"], column["load_sd_kg"]),
        )
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from error
    except (KeyError, ValueError) as error:
        raise ConfigError(f"{path}: is no trace of run.py --csv ({error})") from error


def _trace(
    time_s: np.ndarray,
    angle_rad: np.ndarray,
    reference_rad: np.ndarray,
    command: np.ndarray,
    load_kg: tuple[np.ndarray, np.ndarray, np.ndarray],
) -> Trace:
    return Trace(
        time_s=time_s,
        angle_rad=angle_rad,
        reference_rad=reference_rad,
        error_mrad=(angle_rad - reference_rad) * 1e3,
        spool_percent=command * 100.0,
        load_true_kg=load_kg[0],
        load_est_kg=load_kg[1],
        load_sd_kg=load_kg[2],
    )


def draw_angles(axes: Axes, trace: Trace) -> None:
    """Both joints' angles over their references; the second is dashed, as it may lie on the first."""
    for joint in range(len(JOINT_NAMES)):
        label = "reference" if joint == 0 else None
        axes.plot(trace.time_s, trace.reference_rad[:, joint], color=REFERENCE_COLOUR, linewidth=6.0, label=label)
    for joint, name in enumerate(JOINT_NAMES):
        axes.plot(
            trace.time_s,
            trace.angle_rad[:, joint],
            color=JOINT_COLOURS[joint],
            linestyle=("-", (0, (3, 3)))[joint],
            linewidth=(2.6, 1.8)[joint],
            label=name,
        )
    _widen(axes, 0.25)
    _finish(axes, "Joint angles", "angle, rad")


def draw_errors(axes: Axes, trace: Trace) -> None:
    """Both joints' tracking errors, with a close-up of the settled part where the start dwarfs it."""
    _plot_joints(axes, trace.time_s, trace.error_mrad)
    settled = _settled(trace)
    largest = _largest(trace.error_mrad)
    if settled.any() and largest > CLOSE_UP_WHEN * _largest(trace.error_mrad[settled]):
        close_up = _close_up(axes, (0.28, 0.42, 0.69, 0.40))
        _plot_joints(close_up, trace.time_s[settled], trace.error_mrad[settled], linewidth=0.9)
    else:
        _widen(axes, 0.2)
    _finish(axes, "Tracking errors", "error, mrad")


def draw_load(axes: Axes, trace: Trace) -> None:
    """The load's estimate with two standard deviations either side, and the truth; close-up if constant."""
    _plot_load(axes, trace, np.ones(trace.time_s.shape, dtype=bool))
    shown = np.concatenate([trace.load_true_kg, trace.load_est_kg, [0.0, 1.0]])
    low, high = float(shown.min()), float(shown.max())
    axes.set_ylim(low - 0.25 * (high - low), high + 0.2 * (high - low))
    settled = _settled(trace)
    spread = [_spread(values[settled]) for values in (trace.load_true_kg, trace.load_est_kg)]
    if settled.any() and (high - low) > CLOSE_UP_WHEN * max(spread):
        _plot_load(_close_up(axes, (0.28, 0.24, 0.69, 0.36)), trace, settled)
    _finish(axes, "Load at the tip", "load, kg", legend="lower right")


def draw_spools(axes: Axes, trace: Trace) -> None:
    """Both valves' set-points."""
    _plot_joints(axes, trace.time_s, trace.spool_percent)
    _widen(axes, 0.25)
    _finish(axes, "Spool commands", "set-point, % of stroke")


def trace_figure(trace: Trace, title: str) -> Figure:
    """One run: angles, tracking errors, load estimate and spool commands."""
    with matplotlib.rc_context():
        _use_style()
        figure = Figure(figsize=(WIDTH_PX / DPI, 0.66 * WIDTH_PX / DPI), dpi=DPI, layout="constrained")
        FigureCanvasAgg(figure)
        figure.suptitle(title, x=0.012, ha="left", weight="bold")
        (angles, errors), (load, spools) = figure.subplots(2, 2, sharex=True)
        draw_angles(angles, trace)
        draw_errors(errors, trace)
        draw_load(load, trace)
        draw_spools(spools, trace)
        figure.align_ylabels()
        angles.set_xlim(trace.time_s[0], max(trace.time_s[-1], trace.time_s[0] + 1e-3))
        for axes in (load, spools):
            axes.set_xlabel("time from the start of motion, s")
    return figure


def run_title(scenario: str, arm: str, load_kg: float, controller: str, seed: int) -> str:
    """The title that says which run it was; the bus is left out, because it does not matter."""
    return f"Scenario {scenario}, {arm} arm, {controller}, load {load_kg:g} kg, seed {seed}"


def save_png(figure: Figure, path: Path) -> None:
    """Write a figure as PNG, without dates or versions in it.

    Raises
    ------
    ConfigError
        When the file cannot be written.
    """
    try:
        with matplotlib.rc_context():
            _use_style()
            figure.savefig(path, format="png", dpi=DPI, metadata={"Software": None})
    except OSError as error:
        with suppress(OSError):
            path.unlink(missing_ok=True)  # half a picture is none
        raise ConfigError(f"{path}: cannot be written: {error.strerror or error}") from error


def _use_style() -> None:
    matplotlib.rcdefaults()
    matplotlib.rcParams.update(STYLE)


def _plot_joints(axes: Axes, time_s: np.ndarray, values: np.ndarray, linewidth: float = 1.2) -> None:
    for joint, name in enumerate(JOINT_NAMES):
        axes.plot(time_s, values[:, joint], color=JOINT_COLOURS[joint], linewidth=linewidth, label=name)


def _plot_load(axes: Axes, trace: Trace, rows: np.ndarray) -> None:
    time_s, estimate, band = trace.time_s[rows], trace.load_est_kg[rows], 2.0 * trace.load_sd_kg[rows]
    axes.fill_between(
        time_s, estimate - band, estimate + band, color=LOAD_COLOUR, alpha=0.25, linewidth=0.0, label="± 2 sd"
    )
    axes.plot(time_s, estimate, color=LOAD_COLOUR, label="estimate")
    axes.plot(
        time_s,
        trace.load_true_kg[rows],
        color=TRUTH_COLOUR,
        linestyle=(0, (5, 3)),
        linewidth=1.2,
        label="true",
    )


def _close_up(axes: Axes, place: tuple[float, float, float, float]) -> Axes:
    """Axes within axes, for the time from ``SETTLED_S`` on."""
    close_up = axes.inset_axes(place)
    close_up.set_title(f"from {SETTLED_S:g} s on", fontsize=10.0, pad=3.0, loc="center")
    close_up.tick_params(labelsize=10.0)
    close_up.margins(x=0.0)
    close_up.locator_params(axis="y", nbins=4)
    return close_up


def _settled(trace: Trace) -> np.ndarray:
    return trace.time_s >= SETTLED_S


def _largest(values: np.ndarray) -> float:
    return float(np.abs(values).max(initial=0.0))


def _spread(values: np.ndarray) -> float:
    return float(values.max() - values.min()) if values.size else 0.0


def _widen(axes: Axes, above: float) -> None:
    """Make room above the lines, for the legend."""
    low, high = axes.get_ylim()
    axes.set_ylim(low, high + above * (high - low))


def _finish(axes: Axes, title: str, unit: str, legend: str = "upper right") -> None:
    axes.set_title(title)
    axes.set_ylabel(unit)
    axes.legend(loc=legend, ncols=3, borderaxespad=0.2, columnspacing=1.2, handlelength=1.8)
