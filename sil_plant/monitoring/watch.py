"""From frames to what is going on: the state of ECU, I/O node and bus, for everything that shows it.

`Watch` is given every frame with the time it came, keeps the newest of each kind, counts and checks, and makes a
`Snapshot` on demand. It opens no bus and looks at no clock (`sil_plant.monitoring.listen` does), so that a recording
or a test can drive it. Frames are decoded by cantools, and only when a snapshot asks: the bus brings 5500 a second.
"""

from __future__ import annotations

from collections import deque
from dataclasses import asdict, dataclass, field
from typing import Any, NamedTuple

import numpy as np

from sil_plant.bus import e2e, protocol
from sil_plant.bus.fault_table import FaultText, fault_text

STALE_S = 2.5  # a value older than this is not shown: an ECU that waits for its sensors sends 100 times slower
COUNTERS_STALE_S = 10.0  # TIMING has pages in turn, so that one is 40 ticks old
SILENT_S = 1.0  # nothing heard for so long is silence
TREND_S = 1.0
WORST_S = 2.0
TRACE_S = 30.0
RATE_WINDOW_S = 1.0
_RATE_SHORTEST_S = 0.2
_TREND_POINTS = 8
_DOUBLED_SHARE = 0.25  # of SYNC counters that do not follow on the one before: two nodes count
_DOUBLED_LEAST = 6
_SYNC_LAST = 240
_NMT_OPERATIONAL = 5
_EVENTS = 100
_ESTIMATE_HZ = 100
JOINTS = ("swing", "wrist")
COUNTERS = ("LateTicks", "LostFrames", "E2eErrors", "SendDrops", "RefusedRequests")  # of TIMING; they only rise
ECU, IO_NODE, MASTER = "ECU", "IO", "MASTER"
_CANOPEN_SERVICES = (0x080, 0x580, 0x600, 0x700)  # EMCY, SDO both ways, heartbeat: + node id


class Field(NamedTuple):
    """Where an unsigned little-endian signal stands in a frame."""

    start: int
    length: int

    def of(self, data: bytes) -> int:
        """Its raw value."""
        return (int.from_bytes(data, "little") >> self.start) & ((1 << self.length) - 1)


def _field(message: Any, name: str) -> Field | None:
    signals = {signal.name: signal for signal in message.signals}
    return Field(signals[name].start, signals[name].length) if name in signals else None


# ---- what a snapshot holds -----------------------------------------------------------------------


@dataclass(frozen=True)
class FrameState:
    """One kind of frame.

    Attributes
    ----------
    can_id, sender : int, str
        As the DBC says; the sender is ``ECU``, ``IO`` or ``MASTER``.
    count : int
        How many came since the watch began.
    rate_hz, expected_hz : float or None
        Within the last second, and what the DBC says; None where it cannot be told.
    age_s : float or None
        Since the last one; None: never heard.
    corrupt : int
        Refused here: CRC or length wrong.
    skipped : int
        Sequence counters that did not follow on the one before.
    """

    can_id: int
    sender: str
    count: int
    rate_hz: float | None
    expected_hz: float | None
    age_s: float | None
    corrupt: int
    skipped: int


@dataclass(frozen=True)
class NodeState:
    """A node as its heartbeat and its frames show it.

    Attributes
    ----------
    alive : bool
        Something of it was heard within the last moments.
    nmt : str or None
        State of the last heartbeat, by its name in the DBC.
    heartbeat_age_s : float or None
        Since the last heartbeat.
    boots : int
        Boot-up messages heard.
    doubled : bool
        Two nodes send under this identity.
    """

    alive: bool
    nmt: str | None
    heartbeat_age_s: float | None
    boots: int
    doubled: bool


@dataclass(frozen=True)
class LoadState:
    """The load estimate; None: not told, or no number."""

    kg: float | None = None
    sd_kg: float | None = None
    trend_kg_s: float | None = None
    updating: bool | None = None
    used: bool | None = None
    at_bound: bool | None = None
    held: bool | None = None


@dataclass(frozen=True)
class JointState:
    """One joint; None: not told, or marked invalid by its sender."""

    angle_rad: float | None = None
    reference_rad: float | None = None
    error_rad: float | None = None
    worst_error_rad: float | None = None
    bore_bar: float | None = None
    annulus_bar: float | None = None
    spool_percent: float | None = None
    command_percent: float | None = None
    enabled: bool | None = None
    sensor_status: str | None = None


@dataclass(frozen=True)
class FaultState:
    """An active fault in words."""

    code: int
    name: str
    reaction: str
    when: str
    clear: str


@dataclass(frozen=True)
class Event:
    """Something worth a line; `age_s` before the snapshot."""

    age_s: float
    text: str


@dataclass(frozen=True)
class Snapshot:
    """Everything that can be told at one moment.

    Attributes
    ----------
    silent_s : float or None
        Since the last frame of anybody; None: never heard one.
    frames_per_s, bus_load : float or None
        Within the last second; the load as share of the bit rate with worst-case stuffing.
    receive_drops : int
        Frames this computer threw away before they could be read.
    dbc_hash, dbc_hash_heard, dbc_match : int, int or None, bool or None
        Ours, the ECU's, and whether they are the same.
    ecu, io_node : NodeState
        The two nodes.
    mode : str or None
        Of the ECU; None: not told (it tells none before NMT START).
    moving, valve_saturated : bool or None
        As on ESTIMATE.
    load : LoadState
        The estimate.
    joints : dict
        ``swing`` and ``wrist``.
    faults, faults_complete : tuple of FaultState, bool
        The active ones; False: there may be more than the one told.
    timing : dict
        Every signal of TIMING by its name in the DBC, choices as names.
    timing_rise : dict
        By how much the counters among them have risen since the watch began, or the ECU booted.
    parameters : dict
        Estimated parameters by name: value, standard deviation, unit.
    frames : dict
        Every frame of the DBC by name.
    unknown : dict
        Identifiers that are not in the DBC (``0x123``), and how often they came.
    request : str or None
        The last command of a master.
    events : tuple of Event
        Newest first.
    """

    silent_s: float | None
    frames_per_s: float | None
    bus_load: float | None
    receive_drops: int
    dbc_hash: int
    dbc_hash_heard: int | None
    dbc_match: bool | None
    ecu: NodeState
    io_node: NodeState
    mode: str | None
    moving: bool | None
    valve_saturated: bool | None
    load: LoadState
    joints: dict[str, JointState]
    faults: tuple[FaultState, ...]
    faults_complete: bool
    timing: dict[str, int | float | str]
    timing_rise: dict[str, int]
    parameters: dict[str, tuple[float, float, str]]
    frames: dict[str, FrameState]
    unknown: dict[str, int]
    request: str | None
    events: tuple[Event, ...] = field(default=())

    @property
    def silent(self) -> bool:
        """Nobody is on the bus now."""
        return self.silent_s is None or self.silent_s > SILENT_S

    def as_dict(self) -> dict[str, Any]:
        """The same as plain data, for JSON."""
        return asdict(self)


# ---- taking frames -------------------------------------------------------------------------------


class _Kind:
    """What is kept of one kind of frame."""

    def __init__(self, message: Any) -> None:
        self.message = message
        self.name: str = message.name
        self.sender: str = message.senders[0]
        self.length: int = message.length
        self.cycle_s = (message.cycle_time or 0) * 1e-3
        self.protected = _field(message, "E2eCrc") is not None
        self.counter = _field(message, "E2eCounter")
        self.mode = _field(message, "Mode")
        pages = [signal for signal in message.signals if signal.is_multiplexer]
        self.page = Field(pages[0].start, pages[0].length) if pages else None
        self.signals = {signal.name: signal for signal in message.signals}
        self.count = self.corrupt = self.skipped = 0
        self.last_s: float | None = None
        self.last_counter = -1
        self.newest: dict[int, tuple[float, bytes]] = {}  # by page; 0 where there are none

    def forget(self) -> None:
        """Its sender has begun anew."""
        self.last_counter = -1
        self.newest.clear()

    def decode(self, now_s: float, page: int = 0, stale_s: float = STALE_S) -> dict[str, float | None]:
        """Physical values of the newest good frame; empty when it is stale, None what is marked invalid."""
        when_s, data = self.newest.get(page, (-np.inf, b""))
        if now_s - when_s > max(stale_s, 3.0 * self.cycle_s):
            return {}
        try:
            values = self.message.decode(data, decode_choices=False)
        except Exception:  # cantools: a page that the DBC does not have, of an ECU that follows another one
            return {}
        return {name: self._valid(name, value) for name, value in values.items()}

    def _valid(self, name: str, value: float) -> float | None:
        """None for the raw value that means invalid: the DBC's range leaves it out."""
        signal = self.signals[name]
        margin = 0.5 * abs(signal.scale)
        low = signal.minimum is not None and value < signal.minimum - margin
        high = signal.maximum is not None and value > signal.maximum + margin
        return None if low or high else value

    def choice(self, name: str, value: float | None) -> str | None:
        """The name of a value in the DBC, or its number."""
        if value is None:
            return None
        return str((self.signals[name].choices or {}).get(int(value), int(value)))


@dataclass(frozen=True)
class _Mark:
    """Totals at one moment, for rates."""

    time_s: float
    counts: dict[str, int]
    frames: int
    bits: int
    sync_breaks: int


class Watch:
    """Takes frames, makes snapshots.

    Parameters
    ----------
    start_s : float
        When it begins to listen, on the clock of all later times; any monotonic one.

    Attributes
    ----------
    frames : int
        Frames taken.
    receive_drops : int
        Told by who reads the bus: frames it could not read.
    """

    def __init__(self, start_s: float) -> None:
        self._kinds = {message.frame_id: _Kind(message) for message in protocol.database().messages}
        self._by_name = {kind.name: kind for kind in self._kinds.values()}
        self._bits = [protocol.worst_case_bits(length) for length in range(9)]
        self._ours = protocol.dbc_hash()
        load = self._by_name["ESTIMATE"].signals["Load"]
        self._load_raw, self._load_scale = Field(load.start, load.length), float(load.scale)
        self.frames = self.bits = 0
        self.receive_drops = 0
        self.unknown: dict[int, int] = {}
        self._last_s: float | None = None
        self._loads: deque[tuple[float, float]] = deque(maxlen=int(TRACE_S * _ESTIMATE_HZ))
        self._errors: tuple[deque[tuple[float, float]], ...] = tuple(
            deque(maxlen=int(WORST_S * _ESTIMATE_HZ)) for _ in JOINTS
        )
        self._events: deque[tuple[float, str]] = deque(maxlen=_EVENTS)
        self._sync_last, self._sync_breaks = -1, 0
        self._boots = {ECU: 0, IO_NODE: 0}
        self._was_alive: dict[str, bool | None] = {ECU: None, IO_NODE: None}
        self._mode: int | None = None
        self._emergency: tuple[float, int] | None = None
        self._request: str | None = None
        self._timing_first: dict[str, float] = {}
        self._marks: deque[_Mark] = deque()
        self.reopened(start_s)

    # ---- in ----

    def reopened(self, now_s: float) -> None:
        """Begin to count rates anew: the bus was away, or the watch begins."""
        self._marks.clear()
        self._marks.append(self._mark(now_s))

    def note(self, now_s: float, text: str) -> None:
        """Remember an event."""
        self._events.append((now_s, text))

    def take(self, can_id: int, data: bytes, now_s: float) -> None:
        """Take one frame.

        Parameters
        ----------
        can_id, data : int, bytes
            The frame, with an 11-bit identifier.
        now_s : float
            When it came; never before the last one.
        """
        self.frames += 1
        self.bits += self._bits[len(data)]
        self._last_s = now_s
        kind = self._kinds.get(can_id)
        if kind is None:
            self.unknown[can_id] = self.unknown.get(can_id, 0) + 1
            return
        kind.count += 1
        kind.last_s = now_s
        if len(data) != kind.length or (kind.protected and not e2e.intact(can_id, data)):
            kind.corrupt += 1
            return
        if kind.counter is not None:
            counter = kind.counter.of(data)
            if kind.last_counter >= 0 and counter != (kind.last_counter + 1) % e2e.STATES:
                kind.skipped += 1
            kind.last_counter = counter
        kind.newest[kind.page.of(data) if kind.page else 0] = (now_s, data)
        if kind.sender == ECU and kind.mode is not None:
            self._on_mode(kind, kind.mode.of(data), now_s)
        handler = _HANDLERS.get(kind.name)
        if handler is not None:
            handler(self, kind, data, now_s)

    def _on_mode(self, kind: _Kind, mode: int, now_s: float) -> None:
        if mode != self._mode:
            if self._mode is not None:
                self.note(now_s, f"mode {kind.choice('Mode', self._mode)} -> {kind.choice('Mode', mode)}")
            self._mode = mode

    def _on_sync(self, kind: _Kind, data: bytes, now_s: float) -> None:
        counter = data[0]
        if self._sync_last >= 0 and counter != self._sync_last % _SYNC_LAST + 1:
            self._sync_breaks += 1
        self._sync_last = counter

    def _on_heartbeat(self, kind: _Kind, data: bytes, now_s: float) -> None:
        if data[0] != 0:
            return
        self._boots[kind.sender] += 1
        self.note(now_s, f"{'ECU' if kind.sender == ECU else 'I/O node'} booted")
        for other in self._kinds.values():
            if other.sender == kind.sender and other is not kind:
                other.forget()
        if kind.sender == ECU:
            self._mode = None
            self._emergency = None
            self._timing_first.clear()
            self._loads.clear()
            for errors in self._errors:
                errors.clear()

    def _on_estimate(self, kind: _Kind, data: bytes, now_s: float) -> None:
        raw = self._load_raw.of(data)
        half = 1 << (self._load_raw.length - 1)
        if raw != half:  # the one that means invalid
            self._loads.append((now_s, (raw - 2 * half if raw > half else raw) * self._load_scale))

    def _on_tracking(self, kind: _Kind, data: bytes, now_s: float) -> None:
        joint = kind.page.of(data) if kind.page else 0
        if joint < len(JOINTS):
            values = kind.decode(now_s, joint)
            error = values.get(f"{JOINTS[joint].capitalize()}Error")
            if error is not None:
                self._errors[joint].append((now_s, error))

    def _on_timing(self, kind: _Kind, data: bytes, now_s: float) -> None:
        page = kind.page.of(data) if kind.page else 0
        marker = f"page {page}"
        if marker not in self._timing_first:
            values = kind.decode(now_s, page)
            self._timing_first |= {marker: 0.0} | {k: v for k, v in values.items() if v is not None}

    def _on_emergency(self, kind: _Kind, data: bytes, now_s: float) -> None:
        values = kind.decode(now_s)
        code, active = int(values["FaultCode"] or 0), int(values["FaultDetail"] or 0)
        self._emergency = (now_s, active)
        self.note(now_s, f"fault {fault_text(code).name}" if code else "no fault any more")

    def _on_motion(self, kind: _Kind, data: bytes, now_s: float) -> None:
        values = kind.decode(now_s)
        request = kind.choice("Request", values.get("Request"))
        if request == "MOVE":
            joint = kind.choice("Joint", values.get("Joint"))
            target = values.get("Target")
            where = "an invalid angle" if target is None else f"{target:+.3f} rad"
            request = f"MOVE {joint} to {where} in {(values.get('Duration') or 0.0) * 1e-3:g} s"
        elif request in ("RUN", "HOLD", "COMMISSION"):
            request = f"{request} with {kind.choice('Controller', values.get('Controller'))}"
        self._tell(now_s, f"request {request}")

    def _on_nmt(self, kind: _Kind, data: bytes, now_s: float) -> None:
        values = kind.decode(now_s)
        node = int(values.get("Node") or 0)
        self._tell(now_s, f"NMT {kind.choice('Command', values.get('Command'))} to {f'node {node}' if node else 'all'}")

    def _tell(self, now_s: float, request: str) -> None:
        if request != self._request or not self._events or now_s - self._events[-1][0] > SILENT_S:
            self.note(now_s, request)
        self._request = request

    # ---- out ----

    def _mark(self, now_s: float) -> _Mark:
        counts = {kind.name: kind.count for kind in self._kinds.values()}
        return _Mark(now_s, counts, self.frames, self.bits, self._sync_breaks)

    def load_trace(self, now_s: float, points: int, span_s: float = TRACE_S) -> list[float | None]:
        """The load estimate over the last `span_s`, oldest first: a mean per point, None where nothing came."""
        sums = [[0.0, 0] for _ in range(points)]
        for when_s, value in self._loads:
            place = int((when_s - now_s + span_s) / span_s * points)
            if 0 <= place < points or when_s == now_s:
                sums[min(place, points - 1)][0] += value
                sums[min(place, points - 1)][1] += 1
        return [total / count if count else None for total, count in sums]

    def snapshot(self, now_s: float) -> Snapshot:
        """Everything that can be told now."""
        self._note_life(now_s)
        mark = self._mark(now_s)
        while len(self._marks) > 1 and self._marks[1].time_s <= now_s - RATE_WINDOW_S:
            self._marks.popleft()
        since = self._marks[0]
        if now_s > self._marks[-1].time_s:
            self._marks.append(mark)
        span_s = now_s - since.time_s
        known = span_s >= _RATE_SHORTEST_S

        def rate(total: float, before: float) -> float | None:
            return (total - before) / span_s if known else None

        states = {}
        for kind in self._kinds.values():
            states[kind.name] = FrameState(
                can_id=kind.message.frame_id,
                sender=kind.sender,
                count=kind.count,
                rate_hz=rate(kind.count, since.counts[kind.name]),
                expected_hz=1.0 / kind.cycle_s if kind.cycle_s else None,
                age_s=None if kind.last_s is None else now_s - kind.last_s,
                corrupt=kind.corrupt,
                skipped=kind.skipped,
            )
        bits_per_s = rate(self.bits, since.bits)
        timing = self._timing(now_s)
        heard = timing.get("DbcHash")
        estimate = self._by_name["ESTIMATE"].decode(now_s)
        mode_kind = self._by_name["VALVES"]
        mode = self._mode if self._tells_mode(now_s) else None
        faults, complete = self._faults(now_s)
        return Snapshot(
            silent_s=None if self._last_s is None else now_s - self._last_s,
            frames_per_s=rate(self.frames, since.frames),
            bus_load=None if bits_per_s is None else bits_per_s / protocol.BIT_RATE,
            receive_drops=self.receive_drops,
            dbc_hash=self._ours,
            dbc_hash_heard=None if heard is None else int(heard),
            dbc_match=None if heard is None else int(heard) == self._ours,
            ecu=self._node(ECU, "HEARTBEAT_ECU", now_s, self._two_ecus(mark, since)),
            io_node=self._node(IO_NODE, "HEARTBEAT_IO", now_s, self._two_io_nodes(mark, since)),
            mode=mode_kind.choice("Mode", mode),
            moving=_flag(estimate.get("Moving")),
            valve_saturated=_flag(estimate.get("ValveSaturated")),
            load=self._load(estimate, now_s),
            joints={name: self._joint(n, now_s) for n, name in enumerate(JOINTS)},
            faults=faults,
            faults_complete=complete,
            timing=timing,
            timing_rise=self._timing_rise(timing),
            parameters=self._parameters(now_s),
            frames=states,
            unknown={f"0x{can_id:03X}": count for can_id, count in sorted(self.unknown.items()) if strange(can_id)},
            request=self._request,
            events=tuple(Event(now_s - when_s, text) for when_s, text in reversed(self._events)),
        )

    def _alive(self, sender: str, now_s: float) -> bool:
        return any(
            kind.last_s is not None and now_s - kind.last_s <= STALE_S
            for kind in self._kinds.values()
            if kind.sender == sender
        )

    def _tells_mode(self, now_s: float) -> bool:
        """Whether frames with a mode still come: a stopped node says so in its heartbeat, and sends none."""
        told_s = max(
            (when_s for kind in self._kinds.values() if kind.mode is not None for when_s, _ in kind.newest.values()),
            default=-np.inf,
        )
        beat_s, beat = self._by_name["HEARTBEAT_ECU"].newest.get(0, (-np.inf, b""))
        stopped = beat_s > told_s and beat[0] != _NMT_OPERATIONAL
        return now_s - told_s <= STALE_S and not stopped

    def _note_life(self, now_s: float) -> None:
        for sender, name in ((ECU, "ECU"), (IO_NODE, "I/O node")):
            alive = self._alive(sender, now_s)
            if self._was_alive[sender] is not None and alive != self._was_alive[sender]:
                self.note(now_s, f"{name} {'is heard' if alive else 'fell silent'}")
            self._was_alive[sender] = alive

    def _node(self, sender: str, heartbeat: str, now_s: float, doubled: bool) -> NodeState:
        kind = self._by_name[heartbeat]
        _, data = kind.newest.get(0, (0.0, b""))
        return NodeState(
            alive=self._alive(sender, now_s),
            nmt=kind.choice("NmtState", data[0]) if data else None,
            heartbeat_age_s=None if kind.last_s is None else now_s - kind.last_s,
            boots=self._boots[sender],
            doubled=doubled,
        )

    def _two_ecus(self, mark: _Mark, since: _Mark) -> bool:
        """Two counters of SYNC run into one another."""
        syncs = mark.counts["SYNC"] - since.counts["SYNC"]
        breaks = mark.sync_breaks - since.sync_breaks
        return syncs >= _DOUBLED_LEAST and breaks > _DOUBLED_SHARE * syncs

    def _two_io_nodes(self, mark: _Mark, since: _Mark) -> bool:
        """More than one answer to a SYNC."""
        syncs, answers = (mark.counts[name] - since.counts[name] for name in ("SYNC", "ENCODERS"))
        return answers >= _DOUBLED_LEAST and answers > (1.0 + _DOUBLED_SHARE) * (syncs + 1)

    def _load(self, estimate: dict[str, float | None], now_s: float) -> LoadState:
        if not estimate:
            return LoadState()
        return LoadState(
            kg=estimate["Load"],
            sd_kg=estimate["LoadSd"],
            trend_kg_s=self._trend(now_s),
            updating=_flag(estimate["Updating"]),
            used=_flag(estimate["LoadUsed"]),
            at_bound=_flag(estimate["LoadAtBound"]),
            held=_flag(estimate.get("EstimateHeld")),
        )

    def _trend(self, now_s: float) -> float | None:
        """Slope of the line through the last second's estimates, kg/s."""
        recent = [(when_s, value) for when_s, value in self._loads if now_s - when_s <= TREND_S]
        if len(recent) < _TREND_POINTS or recent[-1][0] - recent[0][0] < 0.3 * TREND_S:
            return None
        times, values = np.array(recent).T
        times -= times.mean()
        return float(times @ values / (times @ times))

    def _joint(self, n: int, now_s: float) -> JointState:
        name = JOINTS[n].capitalize()
        valves_kind, pressures_kind = self._by_name["VALVES"], self._by_name[f"PRESSURES_{name.upper()}"]
        encoders = self._by_name["ENCODERS"].decode(now_s)
        pressures = pressures_kind.decode(now_s)
        tracking = self._by_name["TRACKING"].decode(now_s, n)
        valves = valves_kind.decode(now_s)
        worst = [abs(error) for when_s, error in self._errors[n] if now_s - when_s <= WORST_S]
        control = valves_kind.choice(f"{name}Control", valves.get(f"{name}Control"))
        return JointState(
            angle_rad=encoders.get(f"{name}Angle"),
            reference_rad=tracking.get(f"{name}Reference"),
            error_rad=tracking.get(f"{name}Error"),
            worst_error_rad=max(worst) if worst else None,
            bore_bar=pressures.get("BorePressure"),
            annulus_bar=pressures.get("AnnulusPressure"),
            spool_percent=pressures.get("SpoolPosition"),
            command_percent=valves.get(f"{name}Spool"),
            enabled=None if control is None else control == "ACTIVE",
            sensor_status=pressures_kind.choice("SensorStatus", pressures.get("SensorStatus")),
        )

    def _timing(self, now_s: float) -> dict[str, int | float | str]:
        kind = self._by_name["TIMING"]
        found: dict[str, int | float | str] = {}
        for page in sorted(kind.newest) if self._alive(ECU, now_s) else ():
            for name, value in kind.decode(now_s, page, COUNTERS_STALE_S).items():
                if value is None or name in ("E2eCrc", "E2eCounter", "Mode") or kind.signals[name].is_multiplexer:
                    continue
                choices = kind.signals[name].choices
                found[name] = str(choices[int(value)]) if choices and int(value) in choices else value
        return found

    def _timing_rise(self, timing: dict[str, int | float | str]) -> dict[str, int]:
        return {
            name: int(timing[name] - self._timing_first[name])  # type: ignore[operator]
            for name in COUNTERS
            if name in timing and name in self._timing_first
        }

    def _parameters(self, now_s: float) -> dict[str, tuple[float, float, str]]:
        kind = self._by_name["PARAMETERS"]
        found = {}
        for page in sorted(kind.newest):
            values = kind.decode(now_s, page)
            for name, value in values.items():
                sd = values.get(name.replace("theta_", "sd_"))
                if name.startswith("theta_") and value is not None and sd is not None:
                    found[name.removeprefix("theta_")] = (value, sd, kind.signals[name].unit or "")
        return found

    def _faults(self, now_s: float) -> tuple[tuple[FaultState, ...], bool]:
        """The active faults, and whether these are all: EMCY names all, TIMING the first."""
        kind = self._by_name["TIMING"]
        told = kind.decode(now_s, 0, COUNTERS_STALE_S).get("FaultCode") if self._alive(ECU, now_s) else None
        told_s = kind.newest[0][0] if 0 in kind.newest else -np.inf
        codes: set[int] = set()
        complete = told == 0
        if self._emergency is not None and self._alive(ECU, now_s):
            when_s, active = self._emergency
            if told is None or when_s > told_s or active >> int(told) & 1:
                codes = {code for code in range(1, 32) if active >> code & 1}
                complete = True
        if told and not codes:
            codes = {int(told)}
        return tuple(_fault_state(fault_text(code)) for code in sorted(codes)), complete


def _fault_state(text: FaultText) -> FaultState:
    return FaultState(text.code, text.name, text.reaction, text.when, text.clear)


def _flag(value: float | None) -> bool | None:
    return None if value is None else bool(value)


def strange(can_id: int) -> bool:
    """Whether an identifier that the DBC lacks is not one of CANopen's services either."""
    return not any(base < can_id <= base + 0x7F for base in _CANOPEN_SERVICES)


_HANDLERS = {
    "SYNC": Watch._on_sync,
    "HEARTBEAT_ECU": Watch._on_heartbeat,
    "HEARTBEAT_IO": Watch._on_heartbeat,
    "ESTIMATE": Watch._on_estimate,
    "TRACKING": Watch._on_tracking,
    "TIMING": Watch._on_timing,
    "EMCY_ECU": Watch._on_emergency,
    "MOTION": Watch._on_motion,
    "NMT": Watch._on_nmt,
}
