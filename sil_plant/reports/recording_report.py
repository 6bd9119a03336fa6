"""The page about a recording: what happened, how good it was, and traces to zoom into; one file, no network.

Traces are drawn by Bokeh, whose script goes into the page (1.3 MB): all of them share one time axis. Of the
libraries on PyPI that can be put into a page, Plotly's is four times as large; uPlot, a small one, is not on PyPI.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from sil_plant.bus import protocol
from sil_plant.inputs.machine import JOINT_NAMES
from sil_plant.recordings.recording import (
    Recording,
    RecordingError,
    Ticks,
    find_ticks,
    ids_of,
    names_of,
    raw_signal,
    rows_of,
    signal,
)
from sil_plant.recordings.replay import DEFAULT_PERIOD_US, period_us
from sil_plant.reports.figures import JOINT_COLOURS, LOAD_COLOUR, REFERENCE_COLOUR
from sil_plant.reports.paper_report import STYLE_SHEET, number, paragraph, table

if TYPE_CHECKING:
    from bokeh.plotting import figure as Figure

POINTS_MOST = 20_000  # of a line; more are thinned to the least and the greatest of each stretch
PLOT_HEIGHT_PX = 230
CHAMBERS = ("bore", "annulus")
CHAMBER_DASHES = ("solid", "dashed")
MODE_COLOUR, FAULT_COLOUR, START_COLOUR = "#56606B", "#C62828", "#8A5A00"
COUNTER_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56606B")
FONT = "Segoe UI, DejaVu Sans, Verdana, Helvetica, Arial, sans-serif"
MODE_RUN_NAMES = ("RUN", "HOLD", "COMMISSION", "SAFE_STOP")


class Series(NamedTuple):
    """A signal over time."""

    time_s: np.ndarray
    value: np.ndarray

    @property
    def is_empty(self) -> bool:
        """No frame had it."""
        return not len(self.time_s)


@dataclass(frozen=True)
class Contents:
    """A recording as series by tick.

    Attributes
    ----------
    recording : Recording
        Where it is from.
    ticks : Ticks
        Its ticks.
    period_s : float
        Of a tick.
    """

    recording: Recording
    ticks: Ticks
    period_s: float

    def time_of(self, index: np.ndarray) -> np.ndarray:
        """When frames were, by the tick they are in, from the first SYNC on."""
        tick = np.maximum(self.ticks.of_row[index], 0)
        return self.ticks.number[tick] * self.period_s

    def series(self, message: str, name: str, scale: float = 1.0) -> Series:
        """A signal, wherever a whole frame had it."""
        index = rows_of(self.recording, message)
        rows = self.recording.rows[index]
        described = protocol.database().get_message_by_name(message)
        pages = described.get_signal_by_name(name).multiplexer_ids
        if pages:
            switch = next(s.name for s in described.signals if s.is_multiplexer)
            here = np.isin(raw_signal(rows, message, switch), pages)
            index, rows = index[here], rows[here]
        return Series(self.time_of(index), signal(rows, message, name) * scale)

    def last(self, message: str, name: str) -> float | None:
        """A signal's last value; None when it never came."""
        series = self.series(message, name)
        return None if series.is_empty else float(series.value[-1])

    def total(self, name: str) -> int | None:
        """A counter of TIMING, which begins anew with every start of the ECU, over all of them."""
        series = self.series("TIMING", name)
        if series.is_empty:
            return None
        ends = np.searchsorted(series.time_s, start_times(self)[1:]) - 1
        ends = np.append(ends[ends >= 0], len(series.value) - 1)
        return int(series.value[np.unique(ends)].sum())


def contents_of(recording: Recording) -> Contents:
    """Find a recording's ticks.

    Raises
    ------
    RecordingError
        When there is no ECU in it.
    """
    ticks = find_ticks(recording.rows)
    if not len(ticks.row):
        raise RecordingError(f"{recording.path}: holds no SYNC: no ECU was on this bus while it was recorded")
    return Contents(recording, ticks, period_us(recording) * 1e-6 or DEFAULT_PERIOD_US * 1e-6)


def part_of(recording: Recording, from_s: float | None, to_s: float | None) -> Recording:
    """The frames between two times.

    Raises
    ------
    RecordingError
        When there are none.
    """
    low = -np.inf if from_s is None else from_s
    high = np.inf if to_s is None else to_s
    keep = (recording.time_s >= low) & (recording.time_s <= high)
    if not keep.any():
        raise RecordingError(
            f"{recording.path}: nothing is between {low:g} and {high:g} s; it is {recording.duration_s:.3f} s long"
        )
    return Recording(recording.path, recording.time_s[keep], recording.rows[keep], recording.ignored, recording.damage)


# ---- what happened -------------------------------------------------------------------------------


def changes(series: Series) -> Series:
    """A series of states, reduced to where it changes; its end is kept."""
    if series.is_empty:
        return series
    keep = np.flatnonzero(np.diff(series.value, prepend=np.nan) != 0)
    keep = np.union1d(keep, [len(series.value) - 1])
    return Series(series.time_s[keep], series.value[keep])


class Emergency(NamedTuple):
    """An emergency message of the ECU."""

    time_s: float
    code: int
    fault: str
    active: int


def emergencies(contents: Contents) -> list[Emergency]:
    """All of them, in order."""
    index = rows_of(contents.recording, "EMCY_ECU")
    rows = contents.recording.rows[index]
    names = names_of("EMCY_ECU", "FaultCode")
    columns = [raw_signal(rows, "EMCY_ECU", name).tolist() for name in ("ErrorCode", "FaultCode", "FaultDetail")]
    return [
        Emergency(float(time_s), code, names.get(fault, str(fault)), active)
        for time_s, code, fault, active in zip(contents.time_of(index), *columns, strict=True)
    ]


def armed(contents: Contents, times: np.ndarray) -> np.ndarray:
    """Whether the valves were driven at these times."""
    mode = contents.series("VALVES", "Mode")
    if mode.is_empty:
        return np.zeros(len(times), dtype=bool)
    names = names_of("VALVES", "Mode")
    driving = [value for value, name in names.items() if name in MODE_RUN_NAMES]
    at = np.clip(np.searchsorted(mode.time_s, times, side="right") - 1, 0, None)
    return np.isin(mode.value[at].astype(int), driving)


def summary_rows(contents: Contents) -> list[tuple[str, str]]:
    """What a reader wants to know first."""
    recording, ticks = contents.recording, contents.ticks
    rows = [
        ("recording", recording.path.name),
        ("frames", f"{len(recording.rows)} in {recording.duration_s:.3f} s" + _bus_load(recording)),
        (
            "ticks",
            f"{len(ticks.row)} of {contents.period_s * 1e3:g} ms; {int(ticks.missing.sum())} missing in the recording",
        ),
        ("starts of the ECU", _starts(contents)),
        ("DBC", _dbc(contents)),
        ("modes", _modes(contents)),
        ("faults", _faults(contents)),
    ]
    load, sd = contents.last("ESTIMATE", "Load"), contents.last("ESTIMATE", "LoadSd")
    if load is not None and sd is not None:
        rows.append(("load estimate at the end", f"{load:.3f} kg ± {2.0 * sd:.3f} kg (2 sd)"))
    for joint, name in enumerate(JOINT_NAMES):
        error = contents.series("TRACKING", ("SwingError", "WristError")[joint], 1e3)
        error = Series(error.time_s, error.value[armed(contents, error.time_s)])
        if len(error.value):
            rms = float(np.sqrt((error.value**2).mean()))
            peak = float(np.abs(error.value).max())
            rows.append((f"tracking error, {name}", f"peak {number(peak)} mrad, rms {number(rms)} mrad"))
    for message, name in zip(("PRESSURES_SWING", "PRESSURES_WRIST"), JOINT_NAMES, strict=True):
        series = [contents.series(message, f"{chamber}Pressure") for chamber in ("Bore", "Annulus")]
        if not series[0].is_empty:
            spans = [f"{c} {s.value.min():.1f} to {s.value.max():.1f}" for c, s in zip(CHAMBERS, series, strict=True)]
            rows.append((f"pressures, {name}", f"{', '.join(spans)} bar"))
    timing = contents.series("TIMING", "TickTime")
    if not timing.is_empty:
        text = f"mean {timing.value.mean():.0f} µs, largest {timing.value.max():.0f} µs of those told"
        rows.append(("time of a tick", text))
    counters = ("LostFrames", "E2eErrors", "LateTicks", "SendDrops", "RefusedRequests")
    said = [(name, contents.total(name)) for name in counters]
    rows.append(("counted by the ECU", ", ".join(f"{name} {value}" for name, value in said if value is not None)))
    if contents.total("RefusedRequests"):
        reason = names_of("TIMING", "LastRefusal").get(int(contents.last("TIMING", "LastRefusal") or 0), "?")
        rows.append(("last refusal", reason))
    known = [message.frame_id for message in protocol.database().messages]
    foreign = np.unique(recording.ids[~np.isin(recording.ids, known)])
    if len(foreign):
        rows.append(("identifiers not in the DBC", ", ".join(f"{can_id:03X}h" for can_id in foreign[:20].tolist())))
    return [(name, text) for name, text in rows if text]


def _bus_load(recording: Recording) -> str:
    if recording.duration_s <= 0.0:
        return ""
    bits = sum(
        int(count) * protocol.worst_case_bits(length)
        for length, count in enumerate(np.bincount(recording.rows[:, 4], minlength=9))
    )
    return f"; bus load {100.0 * bits / recording.duration_s / protocol.BIT_RATE:.0f} % of 1 Mbit/s with worst stuffing"


def _starts(contents: Contents) -> str:
    times = start_times(contents)
    if not len(times):
        return "none in the recording"
    return f"{len(times)}, at " + ", ".join(f"{t:.3f}" for t in times[:10]) + (" s" if len(times) <= 10 else " ... s")


def start_times(contents: Contents) -> np.ndarray:
    """When the ECU started: the tick after its boot-up message."""
    ticks = contents.ticks
    following = np.searchsorted(ticks.row, ticks.boots)
    return ticks.number[following[following < len(ticks.row)]] * contents.period_s


def _dbc(contents: Contents) -> str:
    heard = contents.series("TIMING", "DbcHash")
    if heard.is_empty:
        return "the ECU did not tell its hash"
    ours = protocol.dbc_hash()
    hashes = np.unique(heard.value.astype(np.int64)).tolist()
    if hashes == [ours]:
        return f"as {protocol.DBC_PATH.name} here, hash {ours:08X}"
    return f"another: {', '.join(f'{value:08X}' for value in hashes)}, here {ours:08X}; what is below may be wrong"


def _modes(contents: Contents) -> str:
    mode = contents.series("VALVES", "Mode")
    if mode.is_empty:
        return "the ECU never was operational"
    names = names_of("VALVES", "Mode")
    values, counts = np.unique(mode.value.astype(int), return_counts=True)
    spent = [
        f"{names.get(value, value)} {count * contents.period_s:.3f} s"
        for value, count in zip(values.tolist(), counts.tolist(), strict=True)
    ]
    return ", ".join(spent)


def _faults(contents: Contents) -> str:
    seen = dict.fromkeys(e.fault for e in emergencies(contents) if e.code)
    shown = contents.series("TIMING", "FaultCode")
    names = names_of("TIMING", "FaultCode")
    for value in np.unique(shown.value.astype(int)).tolist():
        if value:
            seen.setdefault(names.get(value, str(value)))
    return ", ".join(seen) or "none"


# ---- traces --------------------------------------------------------------------------------------


def thin(series: Series, points: int = POINTS_MOST) -> Series:
    """At most so many points, none of the peaks lost: the least and the greatest of each stretch, in order."""
    n = len(series.value)
    if n <= points:
        return series
    length = -(-n // (points // 2))
    whole = n // length * length
    blocks = series.value[:whole].reshape(-1, length)
    start = np.arange(len(blocks)) * length
    keep = np.concatenate((start + blocks.argmin(axis=1), start + blocks.argmax(axis=1), np.arange(whole, n)))
    keep = np.unique(keep)
    return Series(series.time_s[keep], series.value[keep])


class _Plots:
    """Figures with one time axis."""

    def __init__(self, contents: Contents) -> None:
        from bokeh.models import Range1d

        self.contents = contents
        end = float(contents.ticks.number[-1] * contents.period_s)
        self.x_range = Range1d(0.0, max(end, contents.period_s), bounds=None)
        self.starts = start_times(contents)
        self.all: list[tuple[str, str, Figure]] = []

    def add(self, title: str, unit: str, caption: str = "", height: int = PLOT_HEIGHT_PX) -> Figure:
        """An empty figure."""
        from bokeh.models import BoxZoomTool, PanTool, ResetTool, SaveTool, Span, WheelZoomTool
        from bokeh.plotting import figure

        zoom = BoxZoomTool(dimensions="width")
        plot = figure(
            height=height,
            sizing_mode="stretch_width",
            x_range=self.x_range,
            tools=[zoom, BoxZoomTool(), PanTool(), WheelZoomTool(dimensions="width"), ResetTool(), SaveTool()],
            active_drag=zoom,
            active_scroll=None,
            x_axis_label="time, s",
            y_axis_label=unit,
        )
        plot.toolbar.logo = None
        plot.min_border_left = 186  # the axes of all figures begin at the same place
        plot.outline_line_color = None
        plot.grid.grid_line_color = "#E2E2E2"
        for axis in plot.axis:
            axis.axis_label_text_font = axis.major_label_text_font = FONT
            axis.axis_label_text_font_style = "normal"
            axis.axis_label_text_font_size = axis.major_label_text_font_size = "13px"
            axis.axis_label_text_color = axis.major_label_text_color = "#1b1b1b"
        for time_s in self.starts[:50]:
            plot.add_layout(
                Span(location=float(time_s), dimension="height", line_color=START_COLOUR, line_dash="dotted")
            )
        self.all.append((title, caption, plot))
        return plot

    def line(self, plot: Figure, series: Series, label: str, colour: str, **options: Any) -> None:
        """A line, if there is anything of it."""
        if series.is_empty:
            return
        shown = thin(series)
        plot.line(
            shown.time_s.astype("f4"), shown.value.astype("f4"), legend_label=label, color=colour,
            **{"line_width": 1.4} | options,
        )  # fmt: skip

    def steps(self, plot: Figure, series: Series, label: str, colour: str) -> None:
        """A line of states that last until the next."""
        shown = changes(series)
        if not shown.is_empty:
            plot.step(
                shown.time_s.astype("f4"), shown.value.astype("f4"), mode="after", legend_label=label, color=colour,
                line_width=2.0,
            )  # fmt: skip

    def finish(self) -> None:
        """Legends beside the axes, where they cover nothing."""
        from bokeh.models import Legend

        for _, _, plot in self.all:
            for legend in plot.legend:
                assert isinstance(legend, Legend)
                legend.click_policy = "hide"
                legend.label_text_font = FONT
                legend.label_text_font_size = "13px"
                legend.border_line_color = None
                legend.orientation = "horizontal"
                legend.margin = 0
                legend.padding = 2
                plot.add_layout(legend, "above")


def _draw_motion(plots: _Plots) -> None:
    contents = plots.contents
    plot = plots.add("Joint angles", "angle, rad", "Encoders over references; a legend’s entry hides its line.")
    for name in ("SwingReference", "WristReference"):
        plots.line(plot, contents.series("TRACKING", name), "reference", REFERENCE_COLOUR, line_width=5.0)
    for joint, name in enumerate(JOINT_NAMES):
        series = contents.series("ENCODERS", ("SwingAngle", "WristAngle")[joint])
        # the second is dashed: both joints may do the same
        dash = ("solid", (6, 4))[joint]
        plots.line(plot, series, name, JOINT_COLOURS[joint], line_dash=dash, line_width=(2.2, 1.8)[joint])
    plot = plots.add("Tracking errors", "error, mrad", "As the ECU reports them, one joint every 10 ms.")
    for joint, name in enumerate(JOINT_NAMES):
        series = contents.series("TRACKING", ("SwingError", "WristError")[joint], 1e3)
        plots.line(plot, series, name, JOINT_COLOURS[joint])


def _draw_load(plots: _Plots) -> None:
    contents = plots.contents
    plot = plots.add("Load at the tip", "load, kg", "The estimate, and two standard deviations either side.")
    load, sd = contents.series("ESTIMATE", "Load"), contents.series("ESTIMATE", "LoadSd")
    if load.is_empty:
        return
    step = max(1, -(-len(load.value) // POINTS_MOST))
    x, mean, band = load.time_s[::step], load.value[::step], 2.0 * sd.value[::step]
    plot.varea(
        x=x.astype("f4"), y1=(mean - band).astype("f4"), y2=(mean + band).astype("f4"), color=LOAD_COLOUR, alpha=0.22,
        legend_label="± 2 sd",
    )  # fmt: skip
    plots.line(plot, load, "estimate", LOAD_COLOUR, line_width=1.8)
    # the first band is as wide as the prior; what matters is where the estimate goes
    low, high = float(load.value.min()), float(load.value.max())
    late = band[len(band) // 5 :]
    margin = max(0.15 * (high - low), 2.0 * float(np.median(late)) if len(late) else 0.0, 0.02)
    plot.y_range.start, plot.y_range.end = low - margin, high + margin


def _draw_hydraulics(plots: _Plots) -> None:
    contents = plots.contents
    plot = plots.add("Chamber pressures", "pressure, bar")
    for joint, message in enumerate(("PRESSURES_SWING", "PRESSURES_WRIST")):
        for chamber, signal_name in enumerate(("BorePressure", "AnnulusPressure")):
            label = f"{JOINT_NAMES[joint]} {CHAMBERS[chamber]}"
            series = contents.series(message, signal_name)
            plots.line(plot, series, label, JOINT_COLOURS[joint], line_dash=CHAMBER_DASHES[chamber])
    plot = plots.add("Spools", "% of stroke", "Set-points that the ECU sent, dashed; positions that the valves told.")
    for joint, name in enumerate(JOINT_NAMES):
        command = contents.series("VALVES", ("SwingSpool", "WristSpool")[joint])
        position = contents.series(("PRESSURES_SWING", "PRESSURES_WRIST")[joint], "SpoolPosition")
        plots.line(plot, position, f"{name} position", JOINT_COLOURS[joint])
        plots.line(plot, command, f"{name} set-point", JOINT_COLOURS[joint], line_dash="dashed", alpha=0.75)


def _draw_states(plots: _Plots) -> None:
    contents = plots.contents
    names = names_of("VALVES", "Mode")
    order = sorted(names)
    mode = changes(contents.series("VALVES", "Mode"))
    place = {value: n for n, value in enumerate(order)}
    mode = Series(mode.time_s, np.array([place.get(int(value), -1) for value in mode.value]))
    plot = plots.add("Modes", "", "Dotted: starts of the ECU.", height=210)
    plots.steps(plot, mode, "mode", MODE_COLOUR)
    plot.yaxis.ticker = list(range(len(order)))
    plot.yaxis.major_label_overrides = {n: names[value] for n, value in enumerate(order)}
    plot.y_range.start, plot.y_range.end = -0.5, len(order) - 0.5

    active = emergencies(contents)
    fault_names = names_of("EMCY_ECU", "FaultCode")
    end = float(contents.ticks.number[-1] * contents.period_s)
    spans: dict[int, list[tuple[float, float]]] = {}
    since: dict[int, float] = {}
    marks = [(e.time_s, e.active) for e in active] + [(float(t), 0) for t in plots.starts] + [(end, 0)]
    for time_s, bits in sorted(marks):
        for code in fault_names:
            is_on = bool(bits >> code & 1) and code > 0
            if is_on and code not in since:
                since[code] = time_s
            elif not is_on and code in since:
                spans.setdefault(code, []).append((since.pop(code), time_s))
    if not spans:
        return
    plot = plots.add("Faults", "", "From becoming active to being cleared.", height=150 + 26 * len(spans))
    for n, (code, stretches) in enumerate(sorted(spans.items())):
        left, right = zip(*stretches, strict=True)
        plot.hbar(y=[n] * len(left), left=left, right=right, height=0.55, color=FAULT_COLOUR, line_width=2)
        plot.yaxis.major_label_overrides[n] = fault_names[code]
    plot.yaxis.ticker = list(range(len(spans)))
    plot.y_range.start, plot.y_range.end = -0.7, len(spans) - 0.3


def _draw_bus(plots: _Plots) -> None:
    contents = plots.contents
    plot = plots.add("Time of a tick", "µs", "From the last sensor frame to the valve frame, as the ECU tells it.")
    plots.line(plot, contents.series("TIMING", "TickTime"), "tick", MODE_COLOUR)
    plot = plots.add(
        "From SYNC to SYNC", "ms", "By the recorder’s clock; the period of the ECU and the delays of both together."
    )
    row = contents.ticks.row
    if len(row) > 1:
        interval = Series(contents.time_of(row[1:]), np.diff(contents.recording.time_s[row]) * 1e3)
        plots.line(plot, interval, "interval", MODE_COLOUR)
        # while the ECU waits for its sensors a tick is long: such ticks would flatten the others
        most = max(2e3 * contents.period_s, 1.5 * float(np.quantile(interval.value, 0.995)))
        plot.y_range.start, plot.y_range.end = 0.0, most
    plot = plots.add("Lost and refused", "count", "Counted by the ECU since its start; and SYNCs the recording lacks.")
    for name, colour in zip(("LostFrames", "E2eErrors", "LateTicks", "SendDrops"), COUNTER_COLOURS, strict=False):
        plots.steps(plot, contents.series("TIMING", name), name, colour)
    missing = Series(contents.time_of(row), np.cumsum(contents.ticks.missing).astype(float))
    plots.steps(plot, missing, "SYNC missing", COUNTER_COLOURS[-1])
    told = [float(r.data_source.data["y"].max()) for r in plot.renderers]
    plot.y_range.start, plot.y_range.end = -0.1, 1.1 * max([1.0, *told])


# ---- the page ------------------------------------------------------------------------------------

MORE_STYLE = """
.plot { margin: .3rem 0 1.1rem; }
h3 { margin-bottom: .1rem; }
.caption { color: #4a4a4a; font-size: .92rem; margin: 0 0 .3rem; }
"""


def parameter_rows(contents: Contents) -> list[Sequence[str]]:
    """The estimated parameters as they were told last."""
    message = protocol.database().get_message_by_name("PARAMETERS")
    rows = []
    for described in message.signals:
        if not described.name.startswith("theta_"):
            continue
        stem = described.name.removeprefix("theta_")
        value, sd = contents.last("PARAMETERS", described.name), contents.last("PARAMETERS", f"sd_{stem}")
        if value is not None and sd is not None:
            relative = f"{100.0 * sd / abs(value):.2g} %" if sd < abs(value) else "over 100 %"
            rows.append((stem, f"{value:.6g}", f"{sd:.3g}", relative, described.unit or ""))
    return rows


def page(contents: Contents, notes: Sequence[str] = ()) -> str:
    """The report as one HTML file that needs no other.

    Parameters
    ----------
    contents : Contents
        The recording.
    notes : sequence of str
        What the reader has to know before anything else.
    """
    from bokeh.embed import components
    from bokeh.resources import Resources

    plots = _Plots(contents)
    for draw in (_draw_motion, _draw_load, _draw_hydraulics, _draw_states, _draw_bus):
        draw(plots)
    plots.finish()
    script, places = components([plot for _, _, plot in plots.all])
    library = Resources(mode="inline", components=["bokeh"]).render_js()
    damage = contents.recording.damage
    if damage:
        notes = [f"The file is damaged: {damage}. This is what could be read of it.", *notes]
    parts = [
        f"<h1>{escape(contents.recording.path.name)}</h1>",
        *(f'<p class="note">{escape(note)}</p>' for note in notes),
        table(["", ""], summary_rows(contents)),
        "<h2>Traces</h2>",
        paragraph(
            "Drag across a trace to zoom into a time; all others follow. The arrows beside it bring the whole back. "
            "Time counts ticks from the recording’s first SYNC."
        ),
    ]
    for (title, caption, _), place in zip(plots.all, places, strict=True):
        parts += [f"<h3>{escape(title)}</h3>", f'<p class="caption">{escape(caption)}</p>' if caption else ""]
        parts.append(f'<div class="plot">{place}</div>')
    events = emergencies(contents)
    if events:
        rows = [(f"{e.time_s:.3f}", f"{e.code:04X}h", e.fault if e.code else "all cleared") for e in events[:200]]
        parts += ["<h2>Emergency messages</h2>", table(["time, s", "code", "fault"], rows)]
    parameters = parameter_rows(contents)
    if parameters:
        head = ["parameter", "value", "standard deviation", "relative", "unit"]
        parts += ["<h2>Estimated parameters at the end</h2>", table(head, parameters)]
    parts += ["<h2>Frames</h2>", table(["identifier", "name", "frames"], _frame_rows(contents.recording))]
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(contents.recording.path.name)}</title>\n<style>{STYLE_SHEET}{MORE_STYLE}</style>\n{library}\n"
        "</head>\n<body>\n" + "\n".join(part for part in parts if part) + f"\n{script}\n</body>\n</html>\n"
    )


def _frame_rows(recording: Recording) -> list[Sequence[str]]:
    names = {message.frame_id: message.name for message in protocol.database().messages}
    ids, counts = np.unique(ids_of(recording.rows), return_counts=True)
    return [
        (f"{can_id:03X}h", names.get(can_id, "-"), str(count))
        for can_id, count in zip(ids.tolist(), counts.tolist(), strict=True)
    ]
