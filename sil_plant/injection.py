"""Faults in compiled code: what they do to frames, sensors, bus and plant, tick by tick.

A session without faults never comes here. Chance is a hash of seed, fault, tick and place, so that the same seed
gives the same bytes however many faults there are, and nothing has to be kept.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from sil_plant import protocol
from sil_plant.faults import ALL_SENSOR_FRAMES, FRAMES, KINDS, PRIORITIES, SENSORS, Fault
from sil_plant.frames import DATA, E2E_STATES, FRAME_BYTES, frame_id, get, protect, put, quantise, write_header
from sil_plant.io_node import NodeTiming
from sil_plant.plant import PlantParameters

(
    DROPPED,
    DELAYED,
    REPEATED,
    REORDERED,
    CORRUPTED,
    WRONG_LENGTH,
    FOREIGN_ID,
    OLD_COUNTER,
    STUCK,
    BIASED,
    SPIKED,
    NOISY,
    INVALID,
    SYNC_JITTER,
    SEND_QUEUE_FULL,
    BUS_OFF,
    ALIEN_TRAFFIC,
    SECOND_ECU,
    NMT_STOP,
    NMT_RESET,
    DBC_MISMATCH,
    ECU_KILLED,
    NODE_KILLED,
    SUPPLY_LOST,
    LOAD_DROPPED,
) = (kind.code for kind in KINDS.values())
MOTION, VALVES, SYNC = FRAMES.index("motion"), FRAMES.index("valves"), FRAMES.index("sync")
SENSOR_ANSWERS = 3  # the first of FRAMES

HELD_MOST = 128
FRESH_MOST = 24
SPIKE_CHANCE = 0.1
FOREIGN_COUNTER_AHEAD = 7  # of the second ECU's valve frames
HEARTBEAT_TICKS = 100
_NOT_SEEN = -(2**62)
_SYNC_BITS = protocol.worst_case_bits(1)
_FRAME_BITS = protocol.worst_case_bits(8)
# Of the bus, frames of ours that foreign ones of lower priority have to wait for: SYNC, sensors, valves, a slow one.
_OUR_BITS = _SYNC_BITS + 5 * _FRAME_BITS
_HIGH_FIRST, _HIGH_LAST, _LOW_FIRST, _LOW_LAST = 0x001, 0x07F, 0x703, 0x7FF
_SDO_TO_ECU, _HEARTBEAT_ECU, _MASTER_HASH_INDEX = 0x601, 0x701, 0x2002

# Where a held frame goes when it is due
FREE, TO_ECU_FIRST, TO_ECU_LAST, TO_NODE = range(4)
# Places in Injection.state
SUPPLY_SHARE, JITTER_S, ALIEN_BITS, ROOM_BITS = range(4)
# Places in Injection.count
MOTION_COUNTER, RECOVER_NEXT, RECOVER_SINCE = range(3)


class Injection(NamedTuple):
    """The faults of a run, one row each, and their state; no rows: none of this is looked at.

    Attributes
    ----------
    kind, target, first, last : np.ndarray
        Code; one bit per frame or sensor it strikes; the first tick, and the first one after it.
    size : np.ndarray
        In the unit of the kind; times in ticks.
    recover : np.ndarray
        Ticks at which the master begins to bring the ECU back to RUN, in order.
    controller : int
        The law it asks for then.
    seed : int
        Of everything that is left to chance.
    frame_ids : np.ndarray
        Of ``faults.FRAMES``.
    sensor_id, sensor_field, sensor_step, sensor_low, sensor_high, sensor_invalid : np.ndarray
        Of ``faults.SENSORS``: frame, bit field, SI value of a raw step, limits and invalid mark of the raw value.
    valves_sync : np.ndarray
        Bit field of the SYNC counter in VALVES.
    bits_per_tick : float
        What the bus can carry.
    wrong_hash : int
        A DBC hash that is not ours.
    state, count : np.ndarray
        Numbers named by the constants above.
    memory : np.ndarray
        Raw value each stuck sensor is stuck at.
    held, held_due, held_route : np.ndarray
        Frames that wait, the tick they are due in, and where they go.
    fresh, to_node : np.ndarray
        Frames of this tick before the faults, and those for the node after them.
    """

    kind: np.ndarray
    target: np.ndarray
    first: np.ndarray
    last: np.ndarray
    size: np.ndarray
    recover: np.ndarray
    controller: int
    seed: int
    frame_ids: np.ndarray
    sensor_id: np.ndarray
    sensor_field: np.ndarray
    sensor_step: np.ndarray
    sensor_low: np.ndarray
    sensor_high: np.ndarray
    sensor_invalid: np.ndarray
    valves_sync: np.ndarray
    bits_per_tick: float
    wrong_hash: int
    state: np.ndarray
    count: np.ndarray
    memory: np.ndarray
    held: np.ndarray
    held_due: np.ndarray
    held_route: np.ndarray
    fresh: np.ndarray
    to_node: np.ndarray


# frame and signal of each of faults.SENSORS
_SIGNALS = {
    "swing_angle": ("ENCODERS", "SwingAngle"),
    "wrist_angle": ("ENCODERS", "WristAngle"),
    "swing_bore": ("PRESSURES_SWING", "BorePressure"),
    "swing_annulus": ("PRESSURES_SWING", "AnnulusPressure"),
    "wrist_bore": ("PRESSURES_WRIST", "BorePressure"),
    "wrist_annulus": ("PRESSURES_WRIST", "AnnulusPressure"),
    "swing_spool": ("PRESSURES_SWING", "SpoolPosition"),
    "wrist_spool": ("PRESSURES_WRIST", "SpoolPosition"),
}
_SI_OF_UNIT = {"rad": 1.0, "bar": 1e5, "%": 0.01}


def _target_bits(kind: str, target: str) -> int:
    names = SENSORS if KINDS[kind].code in range(STUCK, SYNC_JITTER) else FRAMES
    if kind == "alien_traffic":
        names = PRIORITIES
    if target == ALL_SENSOR_FRAMES:
        return (1 << len(SENSORS)) - 1 if names is SENSORS else (1 << SENSOR_ANSWERS) - 1
    return 1 << names.index(target) if target else 0


def make_injection(
    faults: tuple[Fault, ...], motion_tick: int, period_s: float, seed: int, controller: int
) -> Injection:
    """Faults for compiled code.

    Parameters
    ----------
    faults : tuple of Fault
        The scenario's, checked.
    motion_tick : int
        Time zero of the scenario.
    period_s : float
        The tick.
    seed : int
        Of the run.
    controller : int
        The law that the master asks for when it brings the ECU back to RUN.
    """
    n = len(faults)
    first = np.array([motion_tick + round(f.start_s / period_s) for f in faults], dtype=np.int64)
    ticks = np.array([max(1, round(f.duration_s / period_s)) for f in faults], dtype=np.int64)
    ends = zip(faults, first + ticks, strict=True)
    recover = sorted(int(end) + round(f.recover_after_s / period_s) for f, end in ends if f.recover_after_s is not None)
    size = [f.size * 1e-3 / period_s if f.kind == "delayed" else f.size for f in faults]
    signals = [protocol.database().get_message_by_name(m).get_signal_by_name(s) for m, s in _SIGNALS.values()]
    invalid = [65535 if not s.is_signed else -(1 << (s.length - 1)) for s in signals]
    state = np.zeros(4)
    state[SUPPLY_SHARE] = 1.0
    return Injection(
        kind=np.array([KINDS[f.kind].code for f in faults], dtype=np.int64),
        target=np.array([_target_bits(f.kind, f.target) for f in faults], dtype=np.int64),
        first=first,
        last=first + ticks,
        size=np.array(size, dtype=np.float64),
        recover=np.array(recover, dtype=np.int64),
        controller=controller,
        seed=seed,
        frame_ids=np.array([protocol.frame_id(name.upper()) for name in FRAMES], dtype=np.int64),
        sensor_id=np.array([protocol.frame_id(m) for m, _ in _SIGNALS.values()], dtype=np.int64),
        sensor_field=np.array([protocol.layout(m, (s,))[0] for m, s in _SIGNALS.values()], dtype=np.int64),
        sensor_step=np.array([float(s.scale) * _SI_OF_UNIT[s.unit] for s in signals]),
        sensor_low=np.array([i + 1 if s.is_signed else 0 for s, i in zip(signals, invalid, strict=True)]),
        sensor_high=np.array([-i - 1 if s.is_signed else i - 1 for s, i in zip(signals, invalid, strict=True)]),
        sensor_invalid=np.array(invalid, dtype=np.int64),
        valves_sync=protocol.layout("VALVES", ("SyncCounter",)),
        bits_per_tick=protocol.BIT_RATE * period_s,
        wrong_hash=protocol.dbc_hash() ^ 1,
        state=state,
        count=np.zeros(3, dtype=np.int64),
        memory=np.full(n, _NOT_SEEN, dtype=np.int64),
        held=np.zeros((HELD_MOST, FRAME_BYTES), dtype=np.uint8),
        held_due=np.zeros(HELD_MOST, dtype=np.int64),
        held_route=np.zeros(HELD_MOST, dtype=np.int64),
        fresh=np.zeros((FRESH_MOST, FRAME_BYTES), dtype=np.uint8),
        to_node=np.zeros((FRESH_MOST, FRAME_BYTES), dtype=np.uint8),
    )


# ---- what is active ------------------------------------------------------------------------------


@njit(cache=True)
def draw(seed: int, fault: int, tick: int, place: int) -> float:
    """A number in 0..1, equally likely, from where it is asked for (splitmix64)."""
    z = np.uint64(seed) * np.uint64(0xD1342543DE82EF95) + np.uint64(fault) * np.uint64(0xA24BAED4963EE407)
    z += np.uint64(tick) * np.uint64(0x9FB21C651E98DF25) + np.uint64(place + 1) * np.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    z = z ^ (z >> np.uint64(31))
    return float(z >> np.uint64(11)) / 9007199254740992.0


@njit(cache=True)
def under_way(injection: Injection, fault: int, tick: int) -> bool:
    """True while a fault lasts."""
    return injection.first[fault] <= tick < injection.last[fault]


@njit(cache=True)
def any_of(injection: Injection, kind: int, tick: int) -> bool:
    """True while a fault of this kind lasts."""
    for n in range(injection.kind.size):
        if injection.kind[n] == kind and under_way(injection, n, tick):
            return True
    return False


@njit(cache=True)
def starved(injection: Injection, tick: int) -> bool:
    """True while foreign frames of higher priority leave not even SYNC a place."""
    for n in range(injection.kind.size):
        if (
            injection.kind[n] == ALIEN_TRAFFIC
            and injection.target[n] == 1
            and under_way(injection, n, tick)
            and (1.0 - injection.size[n]) * injection.bits_per_tick < _SYNC_BITS
        ):
            return True
    return False


@njit(cache=True)
def nothing_from_ecu(injection: Injection, tick: int) -> bool:
    """True while no frame of the ECU reaches anybody."""
    return any_of(injection, BUS_OFF, tick) or starved(injection, tick)


@njit(cache=True)
def transmit_room(injection: Injection, tick: int, most: int) -> int:
    """Frames that the ECU's driver takes in this tick, at most ``most``."""
    if nothing_from_ecu(injection, tick):
        return 0
    room = most
    for n in range(injection.kind.size):
        if injection.kind[n] == SEND_QUEUE_FULL and under_way(injection, n, tick):
            room = min(room, int(injection.size[n]))
    return room


@njit(cache=True)
def sync_reaches_node(injection: Injection, tick: int) -> bool:
    """False when the SYNC of this tick gets lost, or nobody is there to hear it."""
    if any_of(injection, NODE_KILLED, tick) or nothing_from_ecu(injection, tick):
        return False
    for n in range(injection.kind.size):
        if injection.kind[n] == DROPPED and injection.target[n] == 1 << SYNC and under_way(injection, n, tick):
            if draw(injection.seed, n, tick, SYNC) < injection.size[n]:
                return False
    return True


# ---- plant and node ------------------------------------------------------------------------------

_P_SUPPLY = PlantParameters._fields.index("p_supply")
_AFTER_P_SUPPLY = _P_SUPPLY + 1


@njit(cache=True)
def plant_now(injection: Injection, plant: PlantParameters, tick: int, period_s: float) -> PlantParameters:
    """The plant with the supply pressure it has in this tick; to be called once a tick."""
    share, goal, time_s = injection.state[SUPPLY_SHARE], 1.0, 0.0
    for n in range(injection.kind.size):
        if injection.kind[n] == SUPPLY_LOST and injection.first[n] <= tick:
            time_s = injection.size[n]
            goal = plant.p_tank / plant.p_supply if tick < injection.last[n] else 1.0
    if time_s > 0.0:
        share += (goal - share) * (1.0 - math.exp(-period_s / time_s))
        injection.state[SUPPLY_SHARE] = share
    return PlantParameters(*(plant[:_P_SUPPLY] + (plant.p_supply * share,) + plant[_AFTER_P_SUPPLY:]))  # noqa: RUF005


@njit(cache=True)
def load_now(injection: Injection, load_kg: float, tick: int) -> float:
    """The load in this tick."""
    for n in range(injection.kind.size):
        if injection.kind[n] == LOAD_DROPPED and under_way(injection, n, tick):
            load_kg = min(load_kg, injection.size[n])
    return load_kg


@njit(cache=True)
def timing_now(injection: Injection, timing: NodeTiming, tick: int) -> NodeTiming:
    """Times of the node from the last SYNC to this one; to be called once a tick."""
    jitter_s = 0.0
    for n in range(injection.kind.size):
        if injection.kind[n] == SYNC_JITTER and under_way(injection, n, tick):
            jitter_s = injection.size[n] * (2.0 * draw(injection.seed, n, tick, 0) - 1.0)
    before_s = injection.state[JITTER_S]
    injection.state[JITTER_S] = jitter_s
    return NodeTiming(
        timing.period_s + jitter_s - before_s, timing.delay_s, timing.timeout_ticks, timing.heartbeat_ticks
    )


# ---- sensors -------------------------------------------------------------------------------------


@njit(cache=True)
def disturb_sensors(injection: Injection, tick: int, row: np.ndarray) -> None:
    """What is wrong with the sensors in a frame that the node has packed; its protection stays right."""
    can_id = frame_id(row)
    changed = False
    for n in range(injection.kind.size):
        kind = injection.kind[n]
        if kind < STUCK or kind > INVALID or not under_way(injection, n, tick):
            continue
        for sensor in range(injection.sensor_id.size):
            if injection.sensor_id[sensor] != can_id or not (injection.target[n] >> sensor) & 1:
                continue
            start, length = injection.sensor_field[sensor, 0], injection.sensor_field[sensor, 1]
            raw = get(row, start, length, injection.sensor_field[sensor, 2])
            step, size = injection.sensor_step[sensor], injection.size[n]
            if kind == STUCK:
                if injection.memory[n] == _NOT_SEEN:
                    injection.memory[n] = raw
                raw = injection.memory[n]
            elif kind == INVALID:
                raw = injection.sensor_invalid[sensor]
            else:
                value = raw * step
                if kind == BIASED:
                    value += size
                elif kind == NOISY:
                    value += size * (2.0 * draw(injection.seed, n, tick, 0) - 1.0)
                elif draw(injection.seed, n, tick, 0) < SPIKE_CHANCE:
                    value += size if draw(injection.seed, n, tick, 1) < 0.5 else -size
                raw = quantise(value, step, injection.sensor_low[sensor], injection.sensor_high[sensor])
            put(row, start, length, raw)
            changed = True
    if changed:
        protect(row, row[DATA + 1] & 0x0F)


# ---- frames --------------------------------------------------------------------------------------


@njit(cache=True)
def copy_row(source: np.ndarray, target: np.ndarray) -> None:
    """Copy a frame."""
    for k in range(FRAME_BYTES):
        target[k] = source[k]


@njit(cache=True)
def hold(injection: Injection, row: np.ndarray, due: int, route: int) -> None:
    """Keep a frame until it is due."""
    for slot in range(HELD_MOST):
        if injection.held_route[slot] == FREE:
            copy_row(row, injection.held[slot])
            injection.held_due[slot] = due
            injection.held_route[slot] = route
            return


@njit(cache=True)
def release(injection: Injection, tick: int, route: int, out: np.ndarray, rows: int) -> int:
    """Append the frames that are due on a route to ``out``; the rows in it then."""
    for slot in range(HELD_MOST):
        if injection.held_route[slot] == route and injection.held_due[slot] <= tick and rows < out.shape[0]:
            copy_row(injection.held[slot], out[rows])
            injection.held_route[slot] = FREE
            rows += 1
    return rows


@njit(cache=True)
def send_disturbed(injection: Injection, tick: int, row: np.ndarray, out: np.ndarray, rows: int) -> int:
    """Append to ``out`` what arrives of a frame; the rows in it then. Changes ``row``."""
    which = -1
    for k in range(SYNC):
        if injection.frame_ids[k] == frame_id(row):
            which = k
    to_node = which == VALVES
    copies = 1
    if which >= 0:
        for n in range(injection.kind.size):
            kind = injection.kind[n]
            if kind > OLD_COUNTER or not (injection.target[n] >> which) & 1 or not under_way(injection, n, tick):
                continue
            size = int(injection.size[n])
            if kind == DROPPED:
                if draw(injection.seed, n, tick, which) < injection.size[n]:
                    return rows
            elif kind == DELAYED:
                hold(injection, row, tick + size, TO_NODE if to_node else TO_ECU_FIRST)
                return rows
            elif kind == REORDERED:
                if (tick - injection.first[n]) % 2 == 0:  # comes after the next one
                    hold(injection, row, tick + 1, TO_NODE if to_node else TO_ECU_LAST)
                    return rows
            elif kind == REPEATED:
                copies += size
            elif kind == CORRUPTED:
                place = int(64.0 * draw(injection.seed, n, tick, 2 * which))
                stride = 2 * int(32.0 * draw(injection.seed, n, tick, 2 * which + 1)) + 1  # odd: no bit twice
                for b in range(size):
                    bit = (place + b * stride) % 64
                    row[DATA + (bit >> 3)] ^= np.uint8(1 << (bit & 7))
            elif kind == WRONG_LENGTH:
                row[4] = size
            elif kind == FOREIGN_ID:
                row[0] = size & 0xFF
                row[1] = size >> 8
            elif kind == OLD_COUNTER:
                if to_node:  # an old answer: to an old SYNC
                    start, length = injection.valves_sync[0, 0], injection.valves_sync[0, 1]
                    put(row, start, length, (get(row, start, length, 0) - 1 - size) % 240 + 1)
                protect(row, (int(row[DATA + 1] & 0x0F) - size) % E2E_STATES)
    for _ in range(copies):
        if rows < out.shape[0]:
            copy_row(row, out[rows])
            rows += 1
    return rows


@njit(cache=True)
def foreign_frames(injection: Injection, tick: int, priority: int, out: np.ndarray, rows: int) -> int:
    """Append the foreign frames of this tick, of higher (0) or lower (1) priority than ours; the rows then.

    Those of higher priority take their share of the bus from ours, ``state[ROOM_BITS]``; those of lower priority get
    what ours leave.
    """
    for n in range(injection.kind.size):
        if (
            injection.kind[n] != ALIEN_TRAFFIC
            or injection.target[n] != 1 << priority
            or not under_way(injection, n, tick)
        ):
            continue
        bits = injection.size[n] * injection.bits_per_tick
        if priority == 0:
            injection.state[ROOM_BITS] -= bits
        else:
            bits = min(bits, max(injection.bits_per_tick - _OUR_BITS, 0.0))
        injection.state[ALIEN_BITS] += bits
        place = 0
        low, high = (_HIGH_FIRST, _HIGH_LAST) if priority == 0 else (_LOW_FIRST, _LOW_LAST)
        while rows < out.shape[0]:
            length = int(9.0 * draw(injection.seed, n, tick, place))
            needed = 8 * length + 47 + (33 + 8 * length) // 4  # protocol.worst_case_bits
            if injection.state[ALIEN_BITS] < needed:
                break
            injection.state[ALIEN_BITS] -= needed
            can_id = low + int((high - low + 1) * draw(injection.seed, n, tick, place + 1))
            write_header(out[rows], can_id, length)
            for k in range(length):
                out[rows, DATA + k] = int(256.0 * draw(injection.seed, n, tick, place + 2 + k))
            place += 10
            rows += 1
    return rows


@njit(cache=True)
def frames_of_others(injection: Injection, tick: int, sync_counter: int, out: np.ndarray, rows: int) -> int:
    """Append what others send in this tick that should not: network management, a second ECU; the rows then."""
    for n in range(injection.kind.size):
        if not under_way(injection, n, tick):
            continue
        kind = injection.kind[n]
        if kind in (NMT_STOP, NMT_RESET):
            write_header(out[rows], 0, 2)
            out[rows, DATA] = 2 if kind == NMT_STOP else 129
            out[rows, DATA + 1] = 1
            rows += 1
        elif kind == DBC_MISMATCH:  # SDO: expedited download of four bytes
            write_header(out[rows], _SDO_TO_ECU, 8)
            out[rows, DATA] = 0x23
            put(out[rows], 8, 16, _MASTER_HASH_INDEX)
            put(out[rows], 32, 32, injection.wrong_hash)
            rows += 1
        elif kind == SECOND_ECU:
            write_header(out[rows], injection.frame_ids[VALVES], 8)
            put(out[rows], injection.valves_sync[0, 0], injection.valves_sync[0, 1], sync_counter)
            protect(out[rows], (tick + FOREIGN_COUNTER_AHEAD) % E2E_STATES)
            rows += 1
            since = tick - injection.first[n]
            if since % HEARTBEAT_TICKS == 0:
                write_header(out[rows], _HEARTBEAT_ECU, 1)
                out[rows, DATA] = 0 if since == 0 else 5
                rows += 1
    return rows


@njit(cache=True)
def disturb_answer(injection: Injection, tick: int, rows: int, out: np.ndarray) -> int:
    """Write to ``out`` what reaches the ECU of the ``rows`` frames in ``injection.fresh``; the rows in it."""
    injection.state[ROOM_BITS] = injection.bits_per_tick - _SYNC_BITS
    arrived = foreign_frames(injection, tick, 0, out, 0)
    arrived = release(injection, tick, TO_ECU_FIRST, out, arrived)
    for k in range(rows):
        row = injection.fresh[k]
        disturb_sensors(injection, tick, row)
        if injection.state[ROOM_BITS] < _FRAME_BITS:  # the next tick, too late for this one
            hold(injection, row, tick + 1, TO_ECU_FIRST)
            continue
        injection.state[ROOM_BITS] -= _FRAME_BITS
        arrived = send_disturbed(injection, tick, row, out, arrived)
    arrived = release(injection, tick, TO_ECU_LAST, out, arrived)
    return foreign_frames(injection, tick, 1, out, arrived)


@njit(cache=True)
def disturb_valves(injection: Injection, tick: int, row: np.ndarray) -> int:
    """Write to ``injection.to_node`` what reaches the node of a valve frame; the rows in it."""
    if any_of(injection, NODE_KILLED, tick):
        return 0
    if injection.state[ROOM_BITS] < _FRAME_BITS and any_of(injection, ALIEN_TRAFFIC, tick):
        hold(injection, row, tick + 1, TO_NODE)
        return 0
    injection.state[ROOM_BITS] -= _FRAME_BITS
    copy_row(row, injection.fresh[0])
    return send_disturbed(injection, tick, injection.fresh[0], injection.to_node, 0)
