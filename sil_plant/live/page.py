"""The page of tools/live.py: the arm, what the bus tells in words and traces, and the controls; drawn by viser.

Callbacks of the page's controls come in threads of viser's; they only put what is wanted into a queue, which the one
loop of the tool empties. Handles are changed when what they show has changed, and never faster than the rates below.
"""

from __future__ import annotations

import html
import math
import queue
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import viser

from sil_plant.inputs.faults import FRAMES, KINDS, size_range
from sil_plant.live.plant import PlantLink, Truth
from sil_plant.live.scene import Scene
from sil_plant.loop import session
from sil_plant.monitoring.view import Place, milli, mode_words, number, percent, silence, trend_words, warnings
from sil_plant.monitoring.watch import JOINTS, Snapshot
from sil_plant.plant.geometry import Geometry

FRAME_S = 1.0 / 25.0  # the arm
TEXT_EVERY, TRACES_EVERY = 5, 5  # of these
TRACE_S = 20.0
_POINTS = int(TRACE_S / FRAME_S / 2)
_LEFT_PIXELS, _RIGHT_PIXELS, _TRACE_PIXELS = 310, 350, 150
_EVENT_LINES = 4
_HANDS_OFF_S = 1.0
_BLUE, _ORANGE, _RED, _GREEN, _GREY = "#2f6fd0", "#e08a1e", "#c43636", "#14964a", "#8a9099"
_MODE_COLORS = {"RUN": _GREEN, "HOLD": _GREEN, "COMMISSION": _GREEN, "FAULT": _RED, "SAFE_STOP": _RED}
_REQUESTS = ("RUN", "HOLD", "STANDBY", "SAFE_STOP", "RESET_FAULT", "START")
# Sizes to begin with, for kinds that have no default: large enough to be seen.
_FIRST_SIZE = {"delayed": 5.0, "sync_jitter": 2e-4, "angle": 0.05, "bore": 1e6, "annulus": 1e6, "spool": 0.2}


@dataclass(frozen=True)
class Wish:
    """What somebody wants who sits before the page: the name of a control, and its values."""

    what: str
    values: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class View:
    """All that is shown at one moment."""

    state: Snapshot
    place: Place
    truth: Truth
    link: PlantLink
    problem: str = ""  # of a plant of our own


class Traces:
    """The last seconds of what moves, and the charts that show them.

    Parameters
    ----------
    server : viser.ViserServer
        Draws them.
    """

    _BAND_KG = 2.0  # drawn at most: an estimator that knows nothing yet has a wider one, which would hide the rest

    def __init__(self, server: viser.ViserServer) -> None:
        self._rows: deque[tuple[float, ...]] = deque(maxlen=_POINTS)
        panel = server.gui.add_panel()
        with panel.add_tab("last 20 s"):
            self._charts = [
                self._chart(server, "tracking error, mrad", (("swing", _BLUE), ("wrist", _ORANGE))),
                self._chart(
                    server,
                    "load, kg, ± 2 sd up to 2 kg",
                    (("", "transparent"), ("", "transparent"), ("estimate", _RED), ("true", _GREEN)),
                    bands=({"series": [2, 1], "fill": "rgba(196,54,54,0.18)"},),
                ),
                self._chart(
                    server,
                    "pressures, bar",
                    (("swing bore", _BLUE), ("rod", "#8db4ee"), ("wrist bore", _ORANGE), ("rod", "#f2c48c")),
                ),
                self._chart(server, "valve commands, %", (("swing", _BLUE), ("wrist", _ORANGE))),
            ]
        panel.dock_right()
        panel.set_width(_RIGHT_PIXELS)

    def _chart(
        self,
        server: viser.ViserServer,
        title: str,
        lines: tuple[tuple[str, str], ...],
        bands: tuple[dict[str, Any], ...] | None = None,
    ) -> Any:
        series: list[Any] = [{}]
        series += [{"label": name, "stroke": color, "width": 1.6, "points": {"show": False}} for name, color in lines]
        legend = "".join(
            f'<span style="color:{color};margin-left:0.6em">■ {html.escape(name)}</span>'
            for name, color in lines
            if name
        )
        server.gui.add_html(
            '<div style="font-size:0.74em;padding:0 0.4em;margin-bottom:-0.7em;white-space:nowrap">'
            f"<b>{html.escape(title)}</b>{legend}</div>"
        )
        axis = {"size": 28, "font": "11px sans-serif", "grid": {"stroke": "#e6e8eb"}, "ticks": {"show": False}}
        return server.gui.add_uplot(
            data=tuple(np.zeros(2) for _ in range(len(lines) + 1)),
            series=tuple(series),
            bands=bands,  # type: ignore[arg-type]
            scales={"x": {"time": False, "range": (-TRACE_S, 0.0)}, "y": {}},
            axes=({**axis, "size": 24}, {**axis, "size": 46}),
            legend={"show": False},
            height=_TRACE_PIXELS,
            padding=(4, 10, 0, 0),
        )

    def take(self, view: View, now_s: float) -> None:
        """Remember one moment."""
        nan, load = math.nan, view.state.load

        def known(value: float | None, factor: float = 1.0) -> float:
            return nan if value is None else value * factor

        joints = [view.state.joints[name] for name in JOINTS]
        low = high = nan
        if load.kg is not None and load.sd_kg is not None:
            half = min(2.0 * load.sd_kg, self._BAND_KG)
            low, high = load.kg - half, load.kg + half
        self._rows.append(
            (
                now_s,
                *(known(joint.error_rad, 1e3) for joint in joints),
                low,
                high,
                known(load.kg),
                known(view.truth.load_kg),
                *(known(value) for joint in joints for value in (joint.bore_bar, joint.annulus_bar)),
                *(0.0 if joint.enabled is False else known(joint.command_percent) for joint in joints),
            )
        )

    def draw(self, now_s: float) -> None:
        """Give the charts what there is."""
        if len(self._rows) < 2:
            return
        while self._rows[0][0] < now_s - TRACE_S and len(self._rows) > 2:
            self._rows.popleft()
        table = np.array(self._rows).T
        times = table[0] - now_s
        for chart, columns in zip(self._charts, (slice(1, 3), slice(3, 7), slice(7, 11), slice(11, 13)), strict=True):
            chart.data = (times, *table[columns])


class Controls:
    """The left panel: what the bus tells in words, and what can be asked for."""

    def __init__(
        self, server: viser.ViserServer, shape: Geometry, wishes: queue.SimpleQueue[Wish], repeat: bool
    ) -> None:
        gui = server.gui
        self._wishes = wishes
        self._told: dict[int, Any] = {}
        self._status = gui.add_html("")
        self._events = gui.add_html("")
        with gui.add_folder("ECU"):
            self._controller = gui.add_dropdown("controller", session.CONTROLLERS, initial_value="diarc")
            self._mode = gui.add_button_group("ask for", _REQUESTS[:3])
            self._stop = gui.add_button_group(" ", _REQUESTS[3:])
            self._repeat = gui.add_checkbox("repeat the moves", repeat)
            with gui.add_folder("one move", expand_by_default=False):
                self._joint = gui.add_dropdown("joint", JOINTS)
                low, high = (round(f(r[k] for r in shape.range_rad), 2) for k, f in ((0, min), (1, max)))
                self._target = gui.add_slider("to, rad", low, high, 0.01, 0.3)
                self._seconds = gui.add_slider("in, s", 0.5, 5.0, 0.1, 2.0)
                self._move = gui.add_button("MOVE")
        with gui.add_folder("plant"):
            self._reason = gui.add_html("")
            self._load = gui.add_slider("load, kg", 0.0, 15.0, 0.1, 2.5)
            with gui.add_folder("fault", expand_by_default=True):
                kinds = [name for name in KINDS if name != "send_queue_full"]  # the in-process driver's
                self._kind = gui.add_dropdown("kind", kinds, initial_value="stuck")
                self._victim = gui.add_dropdown("of", KINDS["stuck"].targets)
                self._size = gui.add_number("size", 0.0, disabled=True)
                self._duration = gui.add_number("for, s", 0.2, min=0.001, max=60.0, step=0.05)
                self._recover = gui.add_checkbox("then recover", True)
                self._kick = gui.add_button("BREAK IT")
        self._of_plant = (
            self._load, self._kind, self._victim, self._duration, self._recover, self._kick,
        )  # fmt: skip
        self._load_told_kg: float | None = None
        self._load_touched_s = -math.inf
        self._connect()

    # ---- in ----

    def _connect(self) -> None:
        def on(handle: Any, wish: Callable[[], Wish], click: bool = False) -> None:
            def asked(event: Any) -> None:
                if event.client is not None:  # a person's doing, not ours
                    self._wishes.put(wish())

            (handle.on_click if click else handle.on_update)(asked)

        on(self._controller, lambda: Wish("controller", {"controller": self._controller.value}))
        on(self._mode, lambda: Wish("request", {"request": self._mode.value}), click=True)
        on(self._stop, lambda: Wish("request", {"request": self._stop.value}), click=True)
        on(self._repeat, lambda: Wish("repeat", {"on": self._repeat.value}))
        on(
            self._move,
            lambda: Wish(
                "move",
                {"joint": self._joint.value, "target_rad": self._target.value, "duration_s": self._seconds.value},
            ),
            click=True,
        )
        on(self._load, lambda: Wish("load", {"kg": round(self._load.value, 3)}))
        on(self._kick, lambda: Wish("fault", self._fault()), click=True)
        on(self._kind, lambda: Wish("kind"))
        on(self._victim, lambda: Wish("victim"))

    def _fault(self) -> dict[str, Any]:
        kind = KINDS[self._kind.value]
        return {
            "kind": self._kind.value,
            "target": self._victim.value if kind.targets else None,
            "size": self._size.value if kind.unit else None,
            "duration_s": None if kind.once else self._duration.value,
            "recover_after_s": 0.3 if self._recover.value else None,
        }

    def kind_chosen(self) -> None:
        """Offer what this kind of fault may strike."""
        targets = KINDS[self._kind.value].targets
        self._victim.options = targets or ("-",)
        self._victim.value = targets[0] if targets else "-"
        self.victim_chosen()

    def victim_chosen(self) -> None:
        """Offer a size that goes with kind and target."""
        name, kind = self._kind.value, KINDS[self._kind.value]
        self._size.disabled = not kind.unit
        if not kind.unit:
            return
        target = self._victim.value if kind.targets else FRAMES[0]
        low, high, unit = size_range(name, target)
        first = kind.default
        if first is None:
            first = _FIRST_SIZE.get(name, _FIRST_SIZE.get(target.rpartition("_")[2], low))
        self._size.hint = f"{low:g} to {high:g} {unit}"
        self._size.label = f"size, {unit.partition(',')[0]}"
        self._size.value = min(max(first, low), high)

    # ---- out ----

    def _set(self, handle: Any, name: str, value: Any) -> None:
        """Change a handle's property when it is another value than the last one given."""
        key = hash((id(handle), name))
        if self._told.get(key) != value:
            self._told[key] = value
            setattr(handle, name, value)

    def load_touched(self, now_s: float) -> None:
        """Somebody moves the slider: it follows the plant again when that is over."""
        self._load_touched_s = now_s
        self._load_told_kg = None

    def show(self, view: View, now_s: float) -> None:
        """Everything in words."""
        self._set(self._status, "content", _status(view))
        self._set(self._events, "content", _events(view))
        offered = view.link.hello is not None
        for handle in self._of_plant:
            self._set(handle, "disabled", not offered)
        self._set(self._reason, "content", "" if offered else _line(f"Not here: {view.link.reason}", _GREY))
        if view.link.hello is not None:
            self._set(self._load, "max", view.link.hello.heaviest_kg)
        true_kg = view.truth.load_kg
        if true_kg is not None and true_kg != self._load_told_kg and now_s - self._load_touched_s > _HANDS_OFF_S:
            self._load_told_kg = true_kg  # others may change it, and faults
            self._load.value = true_kg


class Page:
    """All of the page.

    Parameters
    ----------
    port : int
        Of the loopback interface; must be free.
    shape : Geometry
        The arm.
    repeat : bool
        Whether the moves are repeated to begin with.

    Attributes
    ----------
    wishes : queue.SimpleQueue
        What was asked for on the page.
    """

    def __init__(self, server: viser.ViserServer, shape: Geometry, repeat: bool) -> None:
        self.wishes: queue.SimpleQueue[Wish] = queue.SimpleQueue()
        self._server = server
        server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="medium")
        server.gui.set_panel_label("DIARC ECU")
        self.scene = Scene(server, shape)
        self.traces = Traces(server)
        self.controls = Controls(server, shape, self.wishes, repeat)
        server.gui.main_panel.dock_left()
        server.gui.main_panel.set_width(_LEFT_PIXELS)
        self._frames = 0

    def show(self, view: View, now_s: float) -> None:
        """Show one moment; to be called every `FRAME_S`."""
        self._frames += 1
        if self._frames % 2 == 0:
            self.traces.take(view, now_s)
        if not self._server.get_clients():
            return  # nobody looks
        state, load = view.state, view.state.load
        joints = [state.joints[name] for name in JOINTS]
        self.scene.show_arm(_both(joint.angle_rad for joint in joints))
        self.scene.reference.show(_both(joint.reference_rad for joint in joints))
        self.scene.truth.show(view.truth.angles_rad)
        self.scene.show_load(load.kg, load.sd_kg, view.truth.load_kg)
        if self._frames % TEXT_EVERY == 0:
            self.controls.show(view, now_s)
            self.scene.show_label(_load_words(view))
        if self._frames % TRACES_EVERY == TEXT_EVERY // 2:
            self.traces.draw(now_s)


def _both(angles: Any) -> tuple[float, float] | None:
    found = tuple(angles)
    return None if None in found else found  # type: ignore[return-value]


def _load_words(view: View) -> str:
    load = view.state.load
    if load.kg is None or load.sd_kg is None:
        return ""
    true_kg = view.truth.load_kg
    return f"{load.kg:.2f} ± {2.0 * load.sd_kg:.2f} kg" + ("" if true_kg is None else f"  (true {true_kg:.2f})")


# ---- words ---------------------------------------------------------------------------------------


def _line(text: str, color: str = "inherit", size: str = "0.8em", weight: str = "normal") -> str:
    return f'<div style="color:{color};font-size:{size};font-weight:{weight}">{html.escape(text)}</div>'


def _row(name: str, value: str, mark: str = "") -> str:
    """One line of name and value; the mark is for those who read the page by program."""
    attribute = f' data-diarc="{mark}"' if mark else ""
    return (
        f'<tr><td style="color:{_GREY};padding-right:0.8em;white-space:nowrap">{html.escape(name)}</td>'
        f'<td{attribute} style="font-variant-numeric:tabular-nums">{html.escape(value)}</td></tr>'
    )


def _status(view: View) -> str:
    state, load = view.state, view.state.load
    color = _MODE_COLORS.get(state.mode or "", _ORANGE)
    badge = (
        f'<span data-diarc="mode" style="background:{color};color:white;border-radius:4px;padding:1px 8px;'
        f'font-weight:600">{html.escape(mode_words(state))}</span>'
    )
    quiet = silence(state, view.place)
    said = []
    if view.problem:
        said.append(view.problem)
    elif quiet:
        said.append(quiet)
    for fault in state.faults:
        said.append(f"{fault.name}: {fault.when}. {fault.clear}")
    said += warnings(state)
    flags = [word for on, word in (
        (load.updating is False, "not learning"), (load.held, "held by a fault"), (load.at_bound, "at its bound"),
        (load.used is False, "not compensated"),
    ) if on]  # fmt: skip
    estimate = f"{number(load.kg, '.3f')} ± {number(load.sd_kg, '.3f')} kg"
    rows = [
        _row("load estimate", estimate, "load"),
        _row("", ", ".join([trend_words(load), *flags]), "trend"),
        _row("true load", number(view.truth.load_kg, ".3f", "kg") if view.truth.load_kg is not None else "not told"),
    ]
    for name, joint in state.joints.items():
        angle = number(joint.angle_rad, "+.3f", "rad")
        rows.append(_row(name, f"{angle}, error {milli(joint.error_rad)} mrad", name))
    counters = state.timing
    rows.append(_row("bus", f"{view.place.bus}, {percent(state.bus_load)}", "bus"))
    told = ", ".join(
        f"{name} {counters[key]:.0f}"
        for name, key in (("late", "LateTicks"), ("lost", "LostFrames"))
        if key in counters
    )
    rows.append(_row("ECU counts", told or "-"))
    warning = "".join(_line(text, _RED, weight="600") for text in said)
    return (
        f'<div style="padding:0 0.8em 0.3em 0.8em;font-size:0.84em;line-height:1.45">{badge}{warning}'
        f'<table style="border-collapse:collapse;margin-top:0.3em">{"".join(rows)}</table></div>'
    )


def _events(view: View) -> str:
    lines = [
        _line(f"{view.place.clock(event.age_s)} {event.text}", _GREY, "0.72em")
        for event in view.state.events[:_EVENT_LINES]
    ]
    return f'<div style="padding:0 0.8em;height:{1.3 * _EVENT_LINES}em;overflow:hidden">{"".join(lines)}</div>'
