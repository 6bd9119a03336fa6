"""Replay: feed the ECU in this process what it heard in a recording, and compare what it says, bit for bit.

Ticks are aligned by SYNC. A tick's inputs are the frames of others between its SYNC and its valve frame; what
comes after the valve frame waits for the next tick, as in the ECU. Two things a recording does not show, and both
are found by trying: whether a frame that came between the last sensor frame and the valve frame was still read in
that tick, and that the ECU's own program was told to end (a safe stop that nobody asked for on the bus).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numba import njit

from sil_plant.bus import protocol
from sil_plant.bus.frames import DATA, FRAME_BYTES, frame_id, intact_rows
from sil_plant.config import ConfigError
from sil_plant.loop.inproc import TX_ROWS, InprocEcu
from sil_plant.recordings.recording import (
    ECU_NODE,
    Recording,
    RecordingError,
    Ticks,
    find_ticks,
    ids_of,
    raw_signal,
    rows_of,
)

CHUNK_TICKS = 500
LOOK_BACK_TICKS = 50  # a frame read one tick later shows within so many ticks
OUTPUT_ROWS_PER_TICK = 2 * TX_ROWS
CONTENT_BYTES = DATA + 8  # of a row: identifier, length, data; the rest is padding
SENSORS = ("ENCODERS", "PRESSURES_SWING", "PRESSURES_WRIST")
SDO_ANSWER_ID = 0x580 + ECU_NODE
NMT_RESETS = (129, 130)
RESET_TICKS = 3  # an NMT reset is carried out at most so many ticks before the boot-up
DEFAULT_PERIOD_US = 1000
SECOND_ECU_TICKS = 100  # a counter that jumps so far, or back, may be another one's
MODE_SAFE_STOP = 6
# What the ECU sends of a clock's; a replay has none.
WALL_CLOCK_SIGNALS = {"TIMING": ("TickTime", "TickTimeCount")}
WALL_CLOCK_OBJECTS = (0x2009, 0x200D)  # tick time, send drops

NO_START = (
    "holds no start of the ECU (its boot-up message, {boot:X}h with data 00), and a replay has to begin there, because "
    "nothing else fixes its state; start the recorder before the ECU, or send NMT reset while it records: "
    "cansend vcan0 000#8101"
)


# ---- what came out -------------------------------------------------------------------------------


@dataclass
class FrameCount:
    """Frames of one kind: compared, and of these not the same; or on one side only."""

    compared: int = 0
    different: int = 0
    not_recorded: int = 0
    not_replayed: int = 0

    @property
    def wrong(self) -> int:
        """All that is not the same."""
        return self.different + self.not_recorded + self.not_replayed


@dataclass(frozen=True)
class Difference:
    """One frame that is not the same; texts for people."""

    section: int
    tick: int
    time_s: float
    frame: str
    signal: str
    recorded: str
    replayed: str


@dataclass(frozen=True)
class Section:
    """From a start of the ECU to the next, or to the end."""

    number: int
    ticks: int
    time_s: float
    by_reset: bool  # an NMT reset: the ECU's program went on, and so do its parameters
    ends_at_gap: int  # ticks that are missing behind it


@dataclass
class Replay:
    """The result.

    Attributes
    ----------
    sections : list of Section
        What was replayed.
    counts : dict
        By frame name.
    first : Difference, optional
        The first in the order of the recording.
    notes : list of str
        What was found by trying, and what was left out.
    unusable : str
        Why the recording says less than it should; empty when it does not.
    """

    sections: list[Section] = field(default_factory=list)
    counts: dict[str, FrameCount] = field(default_factory=dict)
    first: Difference | None = None
    notes: list[str] = field(default_factory=list)
    unusable: str = ""

    @property
    def is_identical(self) -> bool:
        """Nothing differs."""
        return not any(count.wrong for count in self.counts.values())


# ---- the ECU's frames ----------------------------------------------------------------------------


def ecu_ids() -> dict[int, str]:
    """Identifiers of what the ECU sends, and their names."""
    names = {message.frame_id: message.name for message in protocol.database().messages if "ECU" in message.senders}
    return names | {SDO_ANSWER_ID: names.get(SDO_ANSWER_ID, "SDO answer")}


def comparable(rows: np.ndarray) -> np.ndarray:
    """Frame rows without what depends on a clock: its bits are zero, and the CRC says only whether it was right."""
    plain = rows[:, :CONTENT_BYTES].copy()
    ids = ids_of(rows)
    for name, signals in WALL_CLOCK_SIGNALS.items():
        message = protocol.database().get_message_by_name(name)
        of_it = np.flatnonzero((ids == message.frame_id) & (rows[:, 4] == message.length))
        if not len(of_it):
            continue
        timed = np.zeros(len(of_it), dtype=bool)
        multiplexer = next((s.name for s in message.signals if s.is_multiplexer), None)
        for signal in message.signals:
            if signal.name not in signals:
                continue
            here = np.ones(len(of_it), dtype=bool)
            if multiplexer and signal.multiplexer_ids:
                here = np.isin(raw_signal(rows[of_it], name, multiplexer), signal.multiplexer_ids)
            for bit in range(signal.start, signal.start + signal.length):
                plain[of_it[here], DATA + bit // 8] &= 0xFF ^ (1 << bit % 8)
            timed |= here
        plain[of_it[timed], DATA] = intact_rows(rows[of_it[timed]])
    answers = np.flatnonzero(ids == SDO_ANSWER_ID)
    objects = rows[answers, DATA + 1].astype(int) | rows[answers, DATA + 2].astype(int) << 8
    plain[answers[np.isin(objects, WALL_CLOCK_OBJECTS)], DATA + 4 :] = 0
    return plain


def describe(name: str, recorded: np.ndarray, replayed: np.ndarray) -> tuple[str, str, str]:
    """The first signal in which two frames of one message differ, and its values; the CRC only where it is alone."""
    texts = [row[DATA : DATA + int(row[4])].tobytes().hex(" ") for row in (recorded, replayed)]
    known = {message.name for message in protocol.database().messages}
    if name not in known or recorded[4] != replayed[4]:
        return "data", *texts
    message = protocol.database().get_message_by_name(name)
    found = []
    multiplexer = next((s for s in message.signals if s.is_multiplexer), None)
    page = int(raw_signal(recorded[None], name, multiplexer.name)[0]) if multiplexer else None
    for signal in message.signals:
        if signal.multiplexer_ids and page not in signal.multiplexer_ids:
            continue
        values = [int(raw_signal(row[None], name, signal.name)[0]) for row in (recorded, replayed)]
        if values[0] != values[1]:
            found.append((signal.name == "E2eCrc", signal, values))
    if not found:
        return "data", *texts
    _, signal, values = min(found, key=lambda entry: entry[0])
    shown = []
    for value in values:
        choice = (signal.choices or {}).get(value)
        number = f"{value * signal.scale:.9g}" if signal.scale != 1 else f"{value}"
        shown.append(f"{choice} ({value})" if choice else f"{number} {signal.unit or ''}".rstrip())
    return signal.name, *shown


# ---- a life of the ECU ---------------------------------------------------------------------------


@njit(cache=True)
def run_ticks(
    begin: Any,
    end: Any,
    ecu: int,
    inputs: np.ndarray,
    offset: np.ndarray,
    first: int,
    last: int,
    out: np.ndarray,
    out_tick: np.ndarray,
    tx: np.ndarray,
) -> int:
    """Ticks ``first`` to ``last`` (excluded) on their inputs; the frames written to ``out``.

    What goes before a tick's SYNC counts to the tick before.
    """
    count = 0
    for tick in range(first, last):
        sent = begin(ecu, np.uintp(tx.ctypes.data), np.int32(TX_ROWS))
        belongs = tick - 1
        for k in range(sent):
            if frame_id(tx[k]) == protocol.SYNC_ID:
                belongs = tick
            out[count] = tx[k]
            out_tick[count] = belongs
            count += 1
        rx = inputs[offset[tick] :]
        sent = end(
            ecu,
            np.uintp(rx.ctypes.data),
            np.int32(offset[tick + 1] - offset[tick]),
            np.uintp(tx.ctypes.data),
            np.int32(TX_ROWS),
        )
        for k in range(sent):
            out[count] = tx[k]
            out_tick[count] = tick
            count += 1
    return count


@dataclass
class _Life:
    """The ECU's program from its start to its end, NMT resets included; and what the bus had of it."""

    first: int  # frames of the recording
    end: int
    boots: list[int]
    gap: int  # ticks that are missing behind its end
    ticks: int = 0
    sync_row: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    output: np.ndarray = field(default_factory=lambda: np.zeros((0, FRAME_BYTES), dtype=np.uint8))
    output_tick: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    inputs: np.ndarray = field(default_factory=lambda: np.zeros((0, FRAME_BYTES), dtype=np.uint8))
    offset: np.ndarray = field(default_factory=lambda: np.zeros(1, dtype=np.int64))
    doubtful: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))  # last inputs of each tick


def _lives(rows: np.ndarray, ticks: Ticks) -> list[_Life]:
    """Every stretch of the recording that can be replayed, in order."""
    ids = ids_of(rows)
    resets = np.flatnonzero(
        (ids == protocol.NMT_ID)
        & (rows[:, 4] == 2)
        & np.isin(rows[:, DATA], NMT_RESETS)
        & np.isin(rows[:, DATA + 1], (0, ECU_NODE))
    )
    gaps = ticks.row[ticks.missing > 0]
    lives: list[_Life] = []
    for boot in ticks.boots.tolist():
        before = resets[np.searchsorted(resets, boot) - 1] if len(resets) and resets[0] < boot else -1
        was_reset = before >= 0 and ticks.of_row[boot] - ticks.of_row[before] <= RESET_TICKS
        if lives and was_reset and not (gaps[(gaps > lives[-1].first) & (gaps < boot)]).size:
            lives[-1].boots.append(boot)
        else:
            lives.append(_Life(boot, 0, [boot], 0))
    ends = [life.first for life in lives[1:]] + [len(rows)] if lives else []
    for life, end in zip(lives, ends, strict=True):
        inside = gaps[(gaps > life.first) & (gaps < end)]
        life.end = int(inside[0]) if inside.size else end
        life.gap = int(ticks.missing[np.searchsorted(ticks.row, inside[0])]) if inside.size else 0
        _divide(life, rows[life.first : life.end])
    return [life for life in lives if life.ticks]


def _divide(life: _Life, rows: np.ndarray) -> None:
    """Fill in a life's inputs and outputs, by tick."""
    ids = ids_of(rows)
    is_sync = (ids == protocol.SYNC_ID) & (rows[:, 4] == 1)
    tick = np.cumsum(is_sync) - 1
    life.sync_row = np.flatnonzero(is_sync)
    life.ticks = count = len(life.sync_row)
    is_output = np.isin(ids, list(ecu_ids()))
    life.output, life.output_tick = rows[is_output], tick[is_output]
    if not count:
        return

    never = len(rows)

    def first_of(can_id: int) -> np.ndarray:
        """Where each tick has its first frame of this identifier."""
        at = np.flatnonzero((ids == can_id) & (tick >= 0))
        ticks_there, first = np.unique(tick[at], return_index=True)
        place = np.full(count, never)
        place[ticks_there] = at[first]
        return place

    valves = first_of(protocol.frame_id("VALVES"))
    complete = np.maximum.reduce([first_of(protocol.frame_id(name)) for name in SENSORS])
    at = np.flatnonzero(~is_output)
    heard = np.maximum(tick[at], 0)
    late = at > valves[heard]
    # the last inputs of a tick that may have been read one tick later: those after the last sensor frame
    after = np.where(complete[heard] < never, at > complete[heard], True)
    life.doubtful = np.bincount(heard[after & ~late], minlength=count)[:count]
    life.inputs = np.ascontiguousarray(rows[at])
    life.offset = np.searchsorted(heard + late, np.arange(count + 1)).astype(np.int64)


_NORMAL, _THEN_SHUT, _ONLY_SHUT = range(3)


@dataclass
class _Trial:
    """One way to read what a recording does not show."""

    offset: np.ndarray
    stops: tuple[int, ...] = ()  # ticks before which the ECU's program was told to end
    end: int = _NORMAL  # what it did in its last tick
    notes: tuple[str, ...] = ()


@dataclass
class _State:
    """Where a replay stands, to go back to."""

    tick: int
    memory: np.ndarray
    pending: np.ndarray
    pending_tick: np.ndarray


class _Comparison:
    """Recorded and replayed frames of some ticks side by side."""

    def __init__(
        self, recorded: np.ndarray, recorded_tick: np.ndarray, replayed: np.ndarray, replayed_tick: np.ndarray
    ) -> None:
        order, self.recorded_key = _by_tick_and_id(recorded, recorded_tick)
        self.recorded = recorded[order]
        order, self.replayed_key = _by_tick_and_id(replayed, replayed_tick)
        self.replayed = replayed[order]
        self._plain = comparable(self.recorded), comparable(self.replayed)
        self.is_equal = (
            len(self.recorded) == len(self.replayed)
            and bool((self.recorded_key == self.replayed_key).all())
            and bool((self._plain[0] == self._plain[1]).all())
        )

    def first_tick(self) -> int:
        """The tick of the first difference; only when there is one."""
        return min(tick for tick, *_ in self.pairs() if _[-1] != "same")

    def pairs(self) -> Iterator[tuple[int, int, int | None, int | None, str]]:
        """Frames that belong together: tick, identifier, place recorded, place replayed, and how they compare."""
        places: dict[tuple[int, int], tuple[list[int], list[int]]] = {}
        for side, keys in enumerate((self.recorded_key, self.replayed_key)):
            for place, (tick, can_id) in enumerate(keys.tolist()):
                places.setdefault((tick, can_id), ([], []))[side].append(place)
        for (tick, can_id), (recorded, replayed) in sorted(places.items()):
            for n in range(max(len(recorded), len(replayed))):
                a = recorded[n] if n < len(recorded) else None
                b = replayed[n] if n < len(replayed) else None
                if a is None or b is None:
                    verdict = "not recorded" if a is None else "not replayed"
                else:
                    verdict = "same" if (self._plain[0][a] == self._plain[1][b]).all() else "different"
                yield tick, can_id, a, b, verdict


def _by_tick_and_id(rows: np.ndarray, tick: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    ids = ids_of(rows).astype(np.int64)
    order = np.lexsort((ids, tick))
    return order, np.column_stack((tick[order], ids[order]))


class _Player:
    """Replays one life.

    Parameters
    ----------
    life : _Life
        What the bus had.
    ecu : InprocEcu
        Just made.
    """

    def __init__(self, life: _Life, ecu: InprocEcu) -> None:
        self.life = life
        self.ecu = ecu
        self.trial = _Trial(life.offset.copy())
        self.tx = np.zeros((TX_ROWS, FRAME_BYTES), dtype=np.uint8)
        self.is_diverged = False

    def play(self, progress: Callable[[int], None]) -> Iterator[_Comparison]:
        """The whole life, some ticks at a time."""
        nothing = np.zeros((0, FRAME_BYTES), dtype=np.uint8)
        here = before = _State(0, self.ecu.memory.copy(), nothing, np.zeros(0, dtype=np.int64))
        compared = -1
        while here.tick < self.life.ticks:
            last = min(here.tick + CHUNK_TICKS, self.life.ticks)
            comparison, after = self._span(here, last, compared)
            if not comparison.is_equal and not self.is_diverged:
                comparison, after = self._resolve(before, last, compared, comparison, after)
                self.is_diverged = not comparison.is_equal
            yield comparison
            before, here = here, after
            compared = self._whole(last)
            progress(last)

    def _whole(self, last: int) -> int:
        """Up to which tick (excluded) frames are known when ``last`` ticks were run."""
        return last if last == self.life.ticks else last - 1

    def _span(self, state: _State, last: int, compared: int) -> tuple[_Comparison, _State]:
        """Run from a state to tick ``last``, and compare from tick ``compared`` on."""
        self.ecu.memory[:] = state.memory
        rows, tick = self._run(state.tick, last)
        rows, tick = np.concatenate((state.pending, rows)), np.concatenate((state.pending_tick, tick))
        whole = self._whole(last)
        after = _State(last, self.ecu.memory.copy(), rows[tick >= whole], tick[tick >= whole])
        use = (tick >= compared) & (tick < whole)
        recorded = (self.life.output_tick >= compared) & (self.life.output_tick < whole)
        rows, tick = rows[use], tick[use]
        if last == self.life.ticks:
            rows, tick = self._as_far_as_recorded(rows, tick)
        return _Comparison(self.life.output[recorded], self.life.output_tick[recorded], rows, tick), after

    def _run(self, first: int, last: int) -> tuple[np.ndarray, np.ndarray]:
        trial, ecu = self.trial, self.ecu
        out = np.zeros(((last - first) * OUTPUT_ROWS_PER_TICK + TX_ROWS, FRAME_BYTES), dtype=np.uint8)
        out_tick = np.zeros(len(out), dtype=np.int64)
        ends_here = last == self.life.ticks
        open_tick = ends_here and trial.end == _ONLY_SHUT
        count, at = 0, first
        for stop in [*(s for s in trial.stops if first <= s < last), last - open_tick]:
            count += run_ticks(
                ecu.begin, ecu.end, np.uintp(ecu.pointer), self.life.inputs, trial.offset, at, stop,
                out[count:], out_tick[count:], self.tx,
            )  # fmt: skip
            at = stop
            if stop in trial.stops:
                ecu.request_safe_stop()
        extra = [ecu.tick_begin()] if open_tick else []
        if ends_here and trial.end != _NORMAL:
            extra.append(ecu.shutdown())
        for rows in extra:
            out[count : count + len(rows)] = rows
            out_tick[count : count + len(rows)] = last - 1
            count += len(rows)
        return out[:count], out_tick[:count]

    def _as_far_as_recorded(self, rows: np.ndarray, tick: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Without those frames of the last tick that the recorder, or the ECU, did not live to see."""
        final = self.life.ticks - 1
        ids, counts = np.unique(ids_of(self.life.output[self.life.output_tick == final]), return_counts=True)
        left = dict(zip(ids.tolist(), counts.tolist(), strict=True))
        keep = np.ones(len(rows), dtype=bool)
        for k in np.flatnonzero(tick == final):
            can_id = frame_id(rows[k])
            left[can_id] = left.get(can_id, 0) - 1
            keep[k] = left[can_id] >= 0
        return rows[keep], tick[keep]

    def _resolve(
        self, state: _State, last: int, compared: int, comparison: _Comparison, after: _State
    ) -> tuple[_Comparison, _State]:
        """Try the other readings of what is not recorded, until all is equal or none helps."""
        while not comparison.is_equal:
            failed = comparison.first_tick()
            kept = self.trial
            for trial in self._others(failed, max(state.tick, failed - LOOK_BACK_TICKS), last):
                self.trial = trial
                other, other_after = self._span(state, last, compared)
                if other.is_equal or other.first_tick() > failed:
                    comparison, after = other, other_after
                    break
            else:
                self.trial = kept
                self._span(state, last, compared)
                return comparison, after
        return comparison, after

    def _others(self, failed: int, earliest: int, last: int) -> Iterator[_Trial]:
        trial, life = self.trial, self.life
        for tick in range(max(0, failed), max(0, earliest) - 1, -1):
            for moved in range(1, int(life.doubtful[tick]) + 1):
                offset = trial.offset.copy()
                offset[tick + 1] = life.offset[tick + 1] - moved
                if offset[tick] <= offset[tick + 1] and offset[tick + 1] != trial.offset[tick + 1]:
                    yield _Trial(offset, trial.stops, trial.end, trial.notes)
        if self._stops_at(failed):
            note = "its own program told it to stop (SIGTERM or Ctrl-C there), which is on no bus: taken over"
            for tick in (failed, failed - 1):
                if tick >= 0 and tick not in trial.stops:
                    yield _Trial(trial.offset, (*trial.stops, tick), trial.end, (*trial.notes, note))
        if last == life.ticks and failed == life.ticks - 1 and trial.end == _NORMAL:
            for end in (_THEN_SHUT, _ONLY_SHUT):
                yield _Trial(trial.offset, trial.stops, end, (*trial.notes, "its last frame shuts the valves"))

    def _stops_at(self, tick: int) -> bool:
        rows = self.life.output[(self.life.output_tick == tick) | (self.life.output_tick == tick + 1)]
        valves = rows[ids_of(rows) == protocol.frame_id("VALVES")]
        return bool(len(valves)) and bool((raw_signal(valves, "VALVES", "Mode") == MODE_SAFE_STOP).any())


# ---- the whole -----------------------------------------------------------------------------------


def check_hash(recording: Recording) -> bool:
    """Refuse a recording whose frames follow another DBC; False when it does not say which it follows.

    Raises
    ------
    RecordingError
        Naming both hashes.
    """
    timing = recording.rows[rows_of(recording, "TIMING")]
    pages = timing[raw_signal(timing, "TIMING", "TimingPage") == 1]
    if not len(pages):
        return False
    for heard in np.unique(raw_signal(pages, "TIMING", "DbcHash")).tolist():
        if heard != protocol.dbc_hash():
            raise RecordingError(
                f"{recording.path}: its frames follow another DBC: hash {heard:08X}, {protocol.DBC_PATH.name} here has "
                f"{protocol.dbc_hash():08X}; replay it with the version that it was recorded with"
            )
    return True


def period_us(recording: Recording) -> int:
    """The ECU's period, as it says itself."""
    timing = recording.rows[rows_of(recording, "TIMING")]
    pages = timing[raw_signal(timing, "TIMING", "TimingPage") == 3]
    return int(raw_signal(pages[:1], "TIMING", "PeriodUs")[0]) if len(pages) else DEFAULT_PERIOD_US


def replay(
    recording: Recording,
    image: bytes | None,
    scalar: str = "double",
    progress: Callable[[float], None] = lambda _: None,
) -> Replay:
    """Replay a recording.

    Parameters
    ----------
    recording : Recording
        What was heard.
    image : bytes or None
        Parameters that the ECU had; None for those built in.
    scalar : str
        Its number type.
    progress : callable
        Told the share that is done.

    Raises
    ------
    ConfigError
        When nothing of it can be replayed, or the firmware here is not there or refuses the image.
    """
    result = Replay()
    if not check_hash(recording):
        result.notes.append("the recording does not say which DBC the ECU had (no TIMING frame with its hash)")
    ticks = find_ticks(recording.rows)
    lives = _lives(recording.rows, ticks)
    if not lives:
        boot = protocol.frame_id("HEARTBEAT_ECU")
        text = NO_START.format(boot=boot) if len(ticks.row) else "holds no SYNC: no ECU was on this bus"
        raise RecordingError(f"{recording.path}: {text}")
    skipped = int(np.searchsorted(ticks.row, lives[0].first))
    if skipped:
        result.notes.append(f"{skipped} ticks before the first start of the ECU are left out")
    whole = sum(life.ticks for life in lives)
    done = 0
    for life in lives:
        part = slice(life.first, life.end)
        period = period_us(Recording(recording.path, recording.time_s[part], recording.rows[part]))
        ecu = InprocEcu(image, period, scalar)
        player = _Player(life, ecu)
        sections = _sections(life, recording, len(result.sections))
        for comparison in player.play(lambda tick, done=done: progress((done + tick) / whole)):
            _judge(comparison, life, sections, recording, result)
        result.sections += sections
        result.notes += player.trial.notes
        done += life.ticks
        if life.gap and not result.unusable:
            why = "the recorder lost frames" if life.gap < SECOND_ECU_TICKS else "or a second ECU was on the bus"
            place = _time(recording, life.end - 1)
            result.unusable = f"{life.gap} ticks are missing after {place}: {why}; only what is before counts"
    lost = _lost_by_recorder(recording, result, lives)
    if lost:
        result.unusable = lost
    return result


def _sections(life: _Life, recording: Recording, before: int) -> list[Section]:
    starts = np.searchsorted(life.sync_row, np.array(life.boots) - life.first).tolist()
    ends = [*starts[1:], life.ticks]
    return [
        Section(
            number=before + n + 1,
            ticks=end - start,
            time_s=float(recording.time_s[boot]),
            by_reset=n > 0,
            ends_at_gap=life.gap if n == len(starts) - 1 else 0,
        )
        for n, (boot, start, end) in enumerate(zip(life.boots, starts, ends, strict=True))
    ]


def _time(recording: Recording, row: int) -> str:
    return f"{recording.time_s[row]:.3f} s"


def _judge(comparison: _Comparison, life: _Life, sections: list[Section], recording: Recording, result: Replay) -> None:
    """Count what was compared, and keep the first difference."""
    names = ecu_ids()
    if comparison.is_equal:
        ids, counts = np.unique(comparison.recorded_key[:, 1], return_counts=True)
        for can_id, count in zip(ids.tolist(), counts.tolist(), strict=True):
            result.counts.setdefault(names[can_id], FrameCount()).compared += count
        return
    for tick, can_id, a, b, verdict in comparison.pairs():
        name = names.get(can_id, f"{can_id:03X}h")
        count = result.counts.setdefault(name, FrameCount())
        count.compared += a is not None and b is not None
        count.different += verdict == "different"
        count.not_recorded += verdict == "not recorded"
        count.not_replayed += verdict == "not replayed"
        if verdict == "same" or result.first is not None:
            continue
        row = life.first + int(life.sync_row[max(tick, 0)])
        section, since = _place(sections, tick)
        if a is None or b is None:
            side = (comparison.recorded if b is None else comparison.replayed)[b if a is None else a]
            data = side[DATA : DATA + int(side[4])].tobytes().hex(" ")
            texts = ("whole frame", "none" if a is None else data, "none" if b is None else data)
        else:
            texts = describe(name, comparison.recorded[a], comparison.replayed[b])
        result.first = Difference(section, since, float(recording.time_s[row]), name, *texts)


def _place(sections: list[Section], tick: int) -> tuple[int, int]:
    """Section and tick in it, of a tick of a life."""
    for section in sections:
        if tick < section.ticks or section is sections[-1]:
            return section.number, tick
        tick -= section.ticks
    raise AssertionError("a life has a section")


def _lost_by_recorder(recording: Recording, result: Replay, lives: list[_Life]) -> str:
    """Whether the ECU heard sensor frames that the recording lacks."""
    if result.is_identical:
        return ""
    for life in lives:
        rows = recording.rows[life.first : life.end]
        ids = ids_of(rows)
        if len(life.boots) > 1:
            rows = rows[: life.boots[1] - life.first]
            ids = ids[: len(rows)]
        syncs = int((ids == protocol.SYNC_ID).sum())
        heard = [np.flatnonzero(ids == protocol.frame_id(name)) for name in SENSORS]
        if any(len(index) == 0 for index in heard):
            continue
        first = [int((ids[: index[0]] == protocol.SYNC_ID).sum()) for index in heard]
        absent = sum(syncs - start + 1 - len(index) for start, index in zip(first, heard, strict=True))
        piece = Recording(recording.path, recording.time_s[: len(rows)], rows)
        timing = rows[rows_of(piece, "TIMING")]
        pages = timing[raw_signal(timing, "TIMING", "TimingPage") == 2]
        counted = int(raw_signal(pages[-1:], "TIMING", "LostFrames")[0]) if len(pages) else 0
        if absent - len(SENSORS) > counted:  # those of the last tick may not have come yet
            return (
                f"the recording lacks {absent} sensor frames, of which the ECU missed {counted}: the recorder lost the "
                "others, and without them the ECU cannot be expected to say the same"
            )
    return ""


def load_ecu_image(data: bytes, what: str) -> bytes:
    """Check that the firmware takes an image.

    Raises
    ------
    ConfigError
        Naming the file.
    """
    try:
        InprocEcu(data)
    except ConfigError as error:
        raise ConfigError(f"{what}: {error}") from error
    return data
