"""How a snapshot of the bus looks: a page for a terminal of 80 columns or more, or one line."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

from rich import box
from rich.console import Group, RenderableType
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from sil_plant.monitoring.watch import JointState, LoadState, NodeState, Snapshot

WIDE = 118  # columns from which the estimated parameters stand beside the rest
TRACE_POINTS = 40
EVENT_LINES = 6
_BARS = "▁▂▃▄▅▆▇█"
_STEADY_KG_S = 0.02
_BAD, _ODD, _GOOD, _QUIET = "bold red", "yellow", "green", "dim"
_MODE_STYLES = {
    "RUN": "bold green",
    "HOLD": "bold green",
    "COMMISSION": "bold green",
    "FAULT": "bold white on red",
    "SAFE_STOP": "bold red",
}
NONE = "-"


@dataclass(frozen=True)
class Place:
    """Where and when a snapshot is from.

    Attributes
    ----------
    bus : str
        Its bus string.
    problem : str
        Why the bus is not open, with the next step; empty while it is.
    wall_s : float
        Seconds since the epoch.
    """

    bus: str
    problem: str
    wall_s: float

    def clock(self, age_s: float = 0.0) -> str:
        """Local time of day, `age_s` ago."""
        return time.strftime("%H:%M:%S", time.localtime(self.wall_s - age_s))


def silence(state: Snapshot, place: Place) -> str:
    """What to say when nothing comes; empty when something does."""
    if place.problem:
        since = "" if state.silent_s is None else f"no frames since {place.clock(state.silent_s)}: "
        return since + place.problem
    if state.silent_s is None:
        return f"no frames on {place.bus} yet; python tools/doctor.py {place.bus} says why"
    if state.silent:
        return f"no frames since {place.clock(state.silent_s)}; python tools/doctor.py {place.bus} says why"
    return ""


def number(value: float | None, form: str, unit: str = "") -> str:
    """A value with its unit, or a dash where there is none."""
    return NONE if value is None else f"{value:{form}}{f' {unit}' if unit else ''}"


def trend_words(load: LoadState) -> str:
    """Whether the load estimate rises, falls or rests."""
    if load.trend_kg_s is None:
        return "trend not known yet"
    steady = abs(load.trend_kg_s) < max(_STEADY_KG_S, load.sd_kg or 0.0)
    word = "steady" if steady else "rising" if load.trend_kg_s > 0.0 else "falling"
    return f"{word}, {load.trend_kg_s:+.3f} kg/s"


def one_line(state: Snapshot, place: Place) -> str:
    """A snapshot in one line, for a log."""
    quiet = silence(state, place)
    if quiet:
        return f"{place.clock()} {quiet}"
    load, joints, timing = state.load, state.joints, state.timing
    words = [
        place.clock(),
        mode_words(state),
        f"load {number(load.kg, '.3f')} ± {number(load.sd_kg, '.3f')} kg ({trend_words(load)})",
        "error " + " ".join(f"{name} {milli(joint.error_rad)}" for name, joint in joints.items()) + " mrad",
        f"bus {percent(state.bus_load)}",
        f"late {timing.get('LateTicks', NONE)}",
        f"lost {timing.get('LostFrames', NONE)}",
        f"E2E {timing.get('E2eErrors', NONE)}",
        f"drops {timing.get('SendDrops', NONE)}",
    ]
    words += [f"FAULT {fault.name}" for fault in state.faults]
    words += warnings(state)
    return "  ".join(words)


def mode_words(state: Snapshot) -> str:
    """The mode, or why it is not known."""
    if state.mode is not None:
        return state.mode
    if not state.ecu.alive:
        return "no ECU"
    return f"mode not told: NMT {state.ecu.nmt or 'state unknown'}"


def warnings(state: Snapshot) -> list[str]:
    """What is wrong beside the faults, in a few words each."""
    said = []
    if state.dbc_match is False:
        said.append(f"ANOTHER DBC: the ECU has {state.dbc_hash_heard:08X}, here is {state.dbc_hash:08X}")
    if state.ecu.doubled:
        said.append("TWO ECUs send SYNC")
    if state.io_node.doubled:
        said.append("TWO I/O nodes answer")
    corrupt = sum(kind.corrupt for kind in state.frames.values())
    if corrupt:
        said.append(f"{corrupt} corrupt frames heard")
    if state.receive_drops:
        said.append(f"{state.receive_drops} frames lost by this computer")
    if state.unknown:
        said.append(f"frames of no DBC here: {', '.join(list(state.unknown)[:4])}")
    return said


def milli(value: float | None) -> str:
    """Radians as milliradians."""
    return NONE if value is None else f"{value * 1e3:+.2f}"


def percent(share: float | None) -> str:
    """A share as percent."""
    return NONE if share is None else f"{share * 100.0:.0f} %"


# ---- the page ------------------------------------------------------------------------------------


def page(
    state: Snapshot, trace: Sequence[float | None], place: Place, width: int, *, plain_signs: bool = False
) -> RenderableType:
    """The whole page.

    Parameters
    ----------
    state, place
        What to show, and where it is from.
    trace : sequence of float or None
        The load estimate of the last half minute.
    width : int
        Columns of the terminal.
    plain_signs : bool
        The terminal shows ASCII only.
    """
    parts: list[RenderableType] = [_head(state, place)]
    quiet = silence(state, place)
    if quiet:
        parts.append(Panel(Text(quiet, style=_BAD), box=box.HEAVY, border_style="red"))
    if state.faults or warnings(state):
        parts.append(_faults(state))
    parts.append(_load(state.load, [] if plain_signs else trace))
    columns = Table.grid(padding=(0, 4))
    blocks = [_joints(state), _counters(state)]
    if width >= WIDE:
        blocks.append(_parameters(state))
    for _ in blocks:
        columns.add_column()
    columns.add_row(*blocks)
    parts += [columns, _events(state, place)]
    return Group(*parts)


def _head(state: Snapshot, place: Place) -> RenderableType:
    grid = Table.grid(expand=True)
    grid.add_column()
    grid.add_column(justify="right")
    mode = Text().append(f" {mode_words(state)} ", style=_MODE_STYLES.get(state.mode or "", _ODD))
    if not state.faults and state.ecu.alive:
        known = state.faults_complete
        mode.append("  no faults" if known else "  faults not told", style=_GOOD if known else _QUIET)
    for flag, word in ((state.moving, "moving"), (state.valve_saturated, "valve at its limit")):
        if flag:
            mode.append(f"  {word}")
    load = Text(f"bus load {percent(state.bus_load)}, {number(state.frames_per_s, '.0f')} frames/s")
    grid.add_row(mode, load)
    if state.dbc_match is None:
        dbc = Text("DBC of the ECU not told yet", style=_QUIET)
    elif state.dbc_match:
        dbc = Text(f"DBC {state.dbc_hash:08X} matches", style=_GOOD)
    else:
        dbc = Text(f"DBC differs: ECU {state.dbc_hash_heard:08X}, here {state.dbc_hash:08X}", style=_BAD)
    grid.add_row(_node("ECU", state.ecu), dbc)
    grid.add_row(_node("I/O node", state.io_node), Text(state.request or "no request heard", style=_QUIET))
    title = f"DIARC ECU on {place.bus}   {place.clock()}"
    return Panel(grid, title=title, title_align="left", box=box.ROUNDED)


def _node(name: str, node: NodeState) -> Text:
    if not node.alive:
        heard = "" if node.heartbeat_age_s is None else f", last heartbeat {node.heartbeat_age_s:.0f} s ago"
        return Text(f"{name} silent{heard}", style=_BAD)
    beat = "no heartbeat" if node.heartbeat_age_s is None else f"heartbeat {node.heartbeat_age_s:.1f} s ago"
    good = node.nmt == "OPERATIONAL"
    return Text(f"{name} {node.nmt or 'state not told'}, {beat}", style=_GOOD if good else _ODD)


def _load(load: LoadState, trace: Sequence[float | None]) -> RenderableType:
    text = Text().append("load ", style="bold")
    text.append(f"{number(load.kg, '.4f')} ± {number(load.sd_kg, '.3f')} kg", style="bold cyan")
    text.append(f"  {trend_words(load)}")
    flags = [
        (load.updating is False, "not learning", _QUIET),
        (load.held, "held by a fault", _ODD),
        (load.at_bound, "at its bound", _ODD),
        (load.used is False, "not compensated", _QUIET),
    ]
    shown = Text()
    for on, word, style in flags:
        if on:
            shown.append(("" if not shown else ", ") + word, style=style)
    grid = Table.grid(expand=True)
    grid.add_column()
    grid.add_column(justify="right")
    grid.add_row(text, shown)
    bars = sparkline(trace)
    if bars:
        grid.add_row(*bars)
    return Panel(grid, box=box.ROUNDED)


def sparkline(trace: Sequence[float | None]) -> tuple[Text, Text] | None:
    """The trace as bars from its lowest to its highest value, and what these are; None without any."""
    values = [value for value in trace if value is not None]
    if not values:
        return None
    low, high = min(values), max(values)
    span = max(high - low, 0.01)  # noise of a few grams is no mountain range
    bars = "".join(
        " " if value is None else _BARS[min(int((value - low) / span * len(_BARS)), len(_BARS) - 1)] for value in trace
    )
    return Text(bars, style="cyan"), Text(f"last 30 s: {low:.3f} to {high:.3f} kg", style=_QUIET)


def _table(*columns: str) -> Table:
    table = Table(box=None, padding=(0, 1), pad_edge=False, header_style="bold underline")
    for n, column in enumerate(columns):
        table.add_column(column, justify="left" if n == 0 else "right", no_wrap=True)
    return table


def _joints(state: Snapshot) -> Table:
    table = _table("", *state.joints)
    rows = [
        ("reference, rad", lambda joint: number(joint.reference_rad, "+.4f")),
        ("angle, rad", lambda joint: number(joint.angle_rad, "+.4f")),
        ("error, mrad", lambda joint: milli(joint.error_rad)),
        ("worst 2 s, mrad", lambda joint: milli(joint.worst_error_rad).lstrip("+")),
        ("bore, bar", lambda joint: number(joint.bore_bar, ".2f")),
        ("annulus, bar", lambda joint: number(joint.annulus_bar, ".2f")),
        ("spool, %", lambda joint: number(joint.spool_percent, "+.2f")),
        ("valve set-point, %", _command),
        ("sensors", lambda joint: (joint.sensor_status or NONE).lower()),
    ]
    for name, shown in rows:
        table.add_row(name, *(shown(joint) for joint in state.joints.values()))
    return table


def _command(joint: JointState) -> str:
    return "off" if joint.enabled is False else number(joint.command_percent, "+.2f")


def _counters(state: Snapshot) -> Table:
    table = _table("the ECU counts", "", "rise")
    rows = [
        ("late ticks", "LateTicks"),
        ("lost frames", "LostFrames"),
        ("E2E errors", "E2eErrors"),
        ("send drops", "SendDrops"),
        ("requests refused", "RefusedRequests"),
    ]
    for name, signal in rows:
        rise = state.timing_rise.get(signal)
        table.add_row(
            name,
            _whole(state.timing.get(signal)),
            NONE if rise is None else f"+{rise}",
            style=_BAD if rise else "",
        )
    table.add_row("last refusal", _whole(state.timing.get("LastRefusal")).lower().replace("_", " "))
    table.add_row("tick work, us", _whole(state.timing.get("TickTime")))
    corrupt = sum(kind.corrupt for kind in state.frames.values())
    table.add_row("heard here: corrupt", str(corrupt), style=_BAD if corrupt else "")
    table.add_row("dropped here", str(state.receive_drops), style=_BAD if state.receive_drops else "")
    return table


def _whole(value: int | float | str | None) -> str:
    return NONE if value is None else value if isinstance(value, str) else f"{value:.0f}"


def _parameters(state: Snapshot) -> Table:
    table = _table("parameter", "estimate", "± sd", "unit")
    for name, (value, sd, unit) in state.parameters.items():
        table.add_row(name, f"{value:.4g}", f"{sd:.2g}", unit)
    if not state.parameters:
        table.add_row("not told", NONE, NONE, "")
    return table


def _faults(state: Snapshot) -> RenderableType:
    said = warnings(state)
    body = Table.grid(padding=(0, 1))
    body.add_column()
    for fault in state.faults:
        style = _ODD if fault.reaction == "degrade" else _BAD
        reaction = {"degrade": "estimate held", "safe_stop": "safe stop", "valves_off": "valves off"}
        line = Text().append(
            f"{fault.name} ({fault.code}, {reaction.get(fault.reaction, fault.reaction)}): ", style=style
        )
        line.append(fault.when)
        body.add_row(line)
        body.add_row(Text(f"  do: {fault.clear}"))
    if state.faults and not state.faults_complete:
        body.add_row(Text("  others may be active: only the first was heard", style=_QUIET))
    for line in said:
        body.add_row(Text(line, style=_BAD))
    return Panel(body, title="faults", title_align="left", box=box.ROUNDED, border_style="red")


def _events(state: Snapshot, place: Place) -> RenderableType:
    lines = [f"{place.clock(event.age_s)}  {event.text}" for event in state.events[:EVENT_LINES]]
    return Text("\n".join(lines), style=_QUIET)
