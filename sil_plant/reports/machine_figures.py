"""A machine drawn from its file: lever arms and holding pressures over the range, and what its moves ask for."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from sil_plant.config import ConfigError
from sil_plant.design.check import BAR, LITRES_PER_MINUTE, Case
from sil_plant.inputs.machine import JOINT_NAMES
from sil_plant.plant.statics import cylinder_of, gravity_torque, natural_frequency
from sil_plant.reports.figures import DPI, JOINT_COLOURS, STYLE, WIDTH_PX

LOADED, EMPTY = "-", (0, (4, 2))
LIMIT_COLOUR = "#8A8A8A"
SIDES = ("bore", "annulus")
SIDE_COLOURS = ("#CC79A7", "#009E73")


def write_plots(case: Case, folder: Path) -> list[str]:
    """Write all pictures of a machine as SVG and PNG; the files.

    Raises
    ------
    ConfigError
        When the folder cannot be written to.
    """
    written = []
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, draw in (("geometry", geometry_figure), ("moves", moves_figure)):
            with matplotlib.rc_context():
                matplotlib.rcdefaults()
                matplotlib.rcParams.update(STYLE | {"svg.hashsalt": "diarc"})
                figure = draw(case)
                for ending in ("svg", "png"):
                    path = folder / f"{case.machine.path.stem}_{name}.{ending}"
                    metadata = {"Software": None} if ending == "png" else {"Date": None, "Creator": None}
                    try:
                        figure.savefig(path, format=ending, dpi=DPI, metadata=metadata)
                    except OSError:
                        with suppress(OSError):
                            path.unlink(missing_ok=True)  # half a picture is none
                        raise
                    written.append(str(path))
    except OSError as error:
        raise ConfigError(f"{folder}: cannot be written to: {error.strerror}") from error
    return written


def _figure(height: float) -> Figure:
    figure = Figure(figsize=(WIDTH_PX / DPI, height * WIDTH_PX / DPI), dpi=DPI, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _finish(axes: Axes, title: str, unit: str, below: str, above: float = 0.25) -> None:
    axes.set_title(title)
    axes.set_ylabel(unit)
    axes.set_xlabel(below)
    axes.margins(x=0.0)
    low, high = axes.get_ylim()
    axes.set_ylim(low, high + above * (high - low))  # room for the legend
    axes.legend(loc="upper right", ncols=2, borderaxespad=0.2, columnspacing=1.0, handlelength=1.5, fontsize=9.0)


def geometry_figure(case: Case) -> Figure:
    """Over the joints' ranges: lever arms, spring rate as resonance, and the wrist's holding pressures."""
    m = case.machine
    figure = _figure(0.42)
    figure.suptitle(
        f"{m.name}: geometry and statics, loads 0 to {case.full_load_kg:g} kg", x=0.012, ha="left", weight="bold"
    )
    levers, resonances, pressures = figure.subplots(1, 3)
    for joint, name in enumerate(JOINT_NAMES):
        c = cylinder_of(m, joint)
        q = c.angles()
        levers.plot(q, 1e3 * c.lever(q), color=JOINT_COLOURS[joint], label=name)
        for load, style in ((0.0, EMPTY), (case.full_load_kg, LOADED)):
            label = f"{name}, {load:g} kg"
            f = natural_frequency(m, joint, q, 0.0, load)
            resonances.plot(q, f, color=JOINT_COLOURS[joint], linestyle=style, label=label)
    levers.set_ylim(bottom=0.0)
    resonances.set_yscale("log")
    ticks = [
        t for t in (0.5, 1, 2, 5, 10, 20, 50, 100, 200) if resonances.get_ylim()[0] <= t <= resonances.get_ylim()[1]
    ]
    resonances.set_yticks(ticks, [f"{t:g}" for t in ticks])
    resonances.minorticks_off()
    c = cylinder_of(m, 1)
    q, total = c.angles(), m["supply.pressure_Pa"] + m["supply.tank_Pa"]
    for load, style in ((0.0, EMPTY), (case.full_load_kg, LOADED)):
        bore = (gravity_torque(m, q, load) / c.lever(q) + total * c.area2) / (c.area1 + c.area2)
        for side, colour, p in zip(SIDES, SIDE_COLOURS, (bore, total - bore), strict=True):
            pressures.plot(q, p / BAR, color=colour, linestyle=style, label=f"{side}, {load:g} kg")
    _limits(pressures, tank=m["supply.tank_Pa"] / BAR, supply=m["supply.pressure_Pa"] / BAR)
    _finish(levers, "Lever arm dX/dq", "mm/rad", "joint angle, rad")
    _finish(resonances, "Hydraulic resonance", "Hz", "joint angle, rad", 1.6)
    _finish(pressures, "Wrist at rest", "bar", "wrist angle, rad", 0.35)
    return figure


def _limits(axes: Axes, **values: float) -> None:
    for name, value in values.items():
        axes.axhline(value, color=LIMIT_COLOUR, linestyle=(0, (1, 2)), linewidth=1.4)
        axes.annotate(
            name, (0.01, value), xycoords=("axes fraction", "data"), xytext=(0, 2), textcoords="offset points",
            fontsize=9.0, color="#5A5A5A",
        )  # fmt: skip


def moves_figure(case: Case) -> Figure:
    """Over the moves: spool openings, pump flow, and both cylinders' pressures with the full load."""
    m, demand, time_s = case.machine, case.demands[-1], case.motion.time_s
    figure = _figure(0.62)
    title = f"{m.name}: what the moves of {case.scenario.name} ask for, with {demand.load_kg:g} kg"
    figure.suptitle(title, x=0.012, ha="left", weight="bold")
    (opening, pump), lower = figure.subplots(2, 2, sharex=True)
    for joint, name in enumerate(JOINT_NAMES):
        size = np.where(np.isinf(demand.opening[:, joint]), np.nan, demand.opening[:, joint])
        signed = np.sign(demand.speed[:, joint]) * size
        opening.plot(time_s, 100.0 * signed, color=JOINT_COLOURS[joint], label=name)
    _limits(opening, **{"full travel": 100.0, "full travel back": -100.0})
    pump.plot(time_s, LITRES_PER_MINUTE * demand.pump_flow, color="#000000", label="both cylinders")
    for joint, (axes, name) in enumerate(zip(lower, JOINT_NAMES, strict=True)):
        for side, colour, p in zip(SIDES, SIDE_COLOURS, demand.pressure[:, joint].T, strict=True):
            axes.plot(time_s, p / BAR, color=colour, label=side)
        _limits(axes, tank=m["supply.tank_Pa"] / BAR, supply=m["supply.pressure_Pa"] / BAR)
        _finish(axes, f"Pressures, {name}", "bar", "time from the start of motion, s")
    _finish(opening, "Spool opening, positive extends", "% of travel", "")
    _finish(pump, "Flow from the pump", "l/min", "")
    return figure
