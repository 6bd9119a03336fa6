"""Faults in compiled code: what they do to frames, sensors, bus and plant, tick by tick.

A session without faults never comes here. Chance is a hash of seed, fault, tick and place, so that the same seed
gives the same bytes however many faults there are, and nothing has to be kept.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from sil_plant.bus import protocol
from sil_plant.bus.frames import DATA, E2E_STATES, FRAME_BYTES, frame_id, get, protect, put, quantise, write_header
from sil_plant.compiled import inlined
from sil_plant.inputs.faults import ALL_SENSOR_FRAMES, FRAMES, KINDS, PRIORITIES, SENSORS, Fault
from sil_plant.loop.io_node import NodeTiming
from sil_plant.plant.dynamics import PlantParameters

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
# Columns of Injection.plan
KIND, TARGET, FIRST, LAST, STUCK_AT = range(5)
# Rows and columns of Injection.table
FIRST_SENSOR = len(FRAMES)
VALVES_SYNC = FIRST_SENSOR + len(SENSORS)
MOTION_REQUEST = VALVES_SYNC + 1
ID, START, LENGTH, SIGNED, LOW, HIGH, INVALID_RAW = range(7)
# First rows of each part of Injection.row
RECOVERY_ROWS = 4
_HELD = RECOVERY_ROWS
_FRESH = _HELD + HELD_MOST
_TO_NODE = _FRESH + FRESH_MOST
_ROWS = _TO_NODE + FRESH_MOST
# Places in Injection.number; from STEPS on the sensors' steps
SUPPLY_SHARE, JITTER_S, ALIEN_BITS, ROOM_BITS, STEPS = range(5)
# Places in Injection.count
MOTION_COUNTER, RECOVER_NEXT = range(2)


class Injection(NamedTuple):
    """The faults of a run and their state; no rows in ``plan``: none of this is looked at.

    Few arrays, because compiled code hands all of them on with every call.

    Attributes
    ----------
    plan : np.ndarray
        One row per fault: kind, target (a bit per frame or sensor), first tick, first tick after it, and the raw
        value a stuck sensor is stuck at.
    size : np.ndarray
        In the unit of the kind; times in ticks.
    recover : np.ndarray
        Ticks at which the master begins to bring the ECU back to RUN, in order.
    table : np.ndarray
        What the DBC says: a row per ``faults.FRAMES`` (identifier), then one per ``faults.SENSORS`` (identifier, bit
        field, limits and invalid mark of the raw value), then two bit fields: SYNC counter in VALVES, request in
        MOTION.
    number, count : np.ndarray
        State, named by the constants above; ``number`` ends with the SI value of a raw step of each sensor.
    row : np.ndarray
        Frame rows: the master's four that recover, those held, those of this tick, those for the node.
    held : np.ndarray
        Of each row held: the tick it is due in, and where it goes.
    seed, wrong_hash : int
        Of chance; a DBC hash that is not ours.
    bits_per_tick : float
        What the bus can carry.
    """

    plan: np.ndarray
    size: np.ndarray
    recover: np.ndarray
    table: np.ndarray
    number: np.ndarray
    count: np.ndarray
    row: np.ndarray
    held: np.ndarray
    seed: int
    wrong_hash: int
    bits_per_tick: float


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
    faults: tuple[Fault, ...], motion_tick: int, period_s: float, seed: int, recovery: np.ndarray
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
    recovery : np.ndarray
        The master's frames that bring the ECU back: for INIT, for STANDBY, for FAULT, and the right DBC hash; shape
        (4, 16).
    """
    plan = np.zeros((len(faults), 5), dtype=np.int64)
    recover = []
    for n, fault in enumerate(faults):
        first = motion_tick + round(fault.start_s / period_s)
        last = first + max(1, round(fault.duration_s / period_s))
        plan[n] = KINDS[fault.kind].code, _target_bits(fault.kind, fault.target), first, last, _NOT_SEEN
        if fault.recover_after_s is not None:
            recover.append(last + round(fault.recover_after_s / period_s))
    table = np.zeros((MOTION_REQUEST + 1, 7), dtype=np.int64)
    table[: len(FRAMES), ID] = [protocol.frame_id(name.upper()) for name in FRAMES]
    number = np.zeros(STEPS + len(SENSORS))
    number[SUPPLY_SHARE] = 1.0
    for k, (message, name) in enumerate(_SIGNALS.values()):
        signal = protocol.database().get_message_by_name(message).get_signal_by_name(name)
        start, length, signed = protocol.layout(message, (name,))[0].tolist()
        invalid = -(1 << (length - 1)) if signed else (1 << length) - 1
        low, high = (invalid + 1, -invalid - 1) if signed else (0, invalid - 1)
        table[FIRST_SENSOR + k] = protocol.frame_id(message), start, length, signed, low, high, invalid
        number[STEPS + k] = float(signal.scale) * _SI_OF_UNIT[signal.unit]
    table[VALVES_SYNC, START : SIGNED + 1] = protocol.layout("VALVES", ("SyncCounter",))[0]
    table[MOTION_REQUEST, START : SIGNED + 1] = protocol.layout("MOTION", ("Request",))[0]
    row = np.zeros((_ROWS, FRAME_BYTES), dtype=np.uint8)
    row[:RECOVERY_ROWS] = recovery
    return Injection(
        plan=plan,
        size=np.array([f.size * 1e-3 / period_s if f.kind == "delayed" else f.size for f in faults], dtype=np.float64),
        recover=np.array(sorted(recover), dtype=np.int64),
        table=table,
        number=number,
        count=np.zeros(2, dtype=np.int64),
        row=row,
        held=np.zeros((HELD_MOST, 2), dtype=np.int64),
        seed=seed,
        wrong_hash=protocol.dbc_hash() ^ 1,
        bits_per_tick=protocol.BIT_RATE * period_s,
    )


def with_fault(present: Injection, fault: Fault, motion_tick: int, period_s: float) -> Injection:
    """The injection of a run under way with one more fault; what is held and counted stays.

    Parameters
    ----------
    present : Injection
        As it is.
    fault : Fault
        Its ``start_s`` is from ``motion_tick`` on.
    motion_tick, period_s : int, float
        As of :func:`make_injection`.
    """
    fresh = make_injection((fault,), motion_tick, period_s, present.seed, present.row[:RECOVERY_ROWS])
    count = present.count.copy()
    waiting = present.recover[count[RECOVER_NEXT] :]
    count[RECOVER_NEXT] = 0
    return present._replace(
        plan=np.vstack([present.plan, fresh.plan]),
        size=np.concatenate([present.size, fresh.size]),
        recover=np.sort(np.concatenate([waiting, fresh.recover])),
        count=count,
    )


def rewind(injection: Injection, ticks: int) -> None:
    """Let all times be so many ticks earlier."""
    injection.plan[:, FIRST : LAST + 1] -= ticks
    injection.recover[:] -= ticks
    injection.held[:, 0] -= ticks


# ---- what is active ------------------------------------------------------------------------------


@inlined
def draw(seed: int, fault: int, tick: int, place: int) -> float:
    """A number in 0..1, equally likely, from where it is asked for (splitmix64)."""
    z = np.uint64(seed) * np.uint64(0xD1342543DE82EF95) + np.uint64(fault) * np.uint64(0xA24BAED4963EE407)
    z += np.uint64(tick) * np.uint64(0x9FB21C651E98DF25) + np.uint64(place + 1) * np.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    z = z ^ (z >> np.uint64(31))
    return float(z >> np.uint64(11)) / 9007199254740992.0


@inlined
def under_way(injection: Injection, fault: int, tick: int) -> bool:
    """True while a fault lasts."""
    return injection.plan[fault, FIRST] <= tick < injection.plan[fault, LAST]


@inlined
def any_of(injection: Injection, kind: int, tick: int) -> bool:
    """True while a fault of this kind lasts."""
    for n in range(injection.plan.shape[0]):
        if injection.plan[n, KIND] == kind and under_way(injection, n, tick):
            return True
    return False


@inlined
def starved(injection: Injection, tick: int) -> bool:
    """True while foreign frames of higher priority leave not even SYNC a place."""
    for n in range(injection.plan.shape[0]):
        if (
            injection.plan[n, KIND] == ALIEN_TRAFFIC
            and injection.plan[n, TARGET] == 1
            and under_way(injection, n, tick)
            and (1.0 - injection.size[n]) * injection.bits_per_tick < _SYNC_BITS
        ):
            return True
    return False


@inlined
def nothing_from_ecu(injection: Injection, tick: int) -> bool:
    """True while no frame of the ECU reaches anybody."""
    return any_of(injection, BUS_OFF, tick) or starved(injection, tick)


@inlined
def transmit_room(injection: Injection, tick: int, most: int) -> int:
    """Frames that the ECU's driver takes in this tick, at most ``most``."""
    if nothing_from_ecu(injection, tick):
        return 0
    room = most
    for n in range(injection.plan.shape[0]):
        if injection.plan[n, KIND] == SEND_QUEUE_FULL and under_way(injection, n, tick):
            room = min(room, int(injection.size[n]))
    return room


@inlined
def sync_reaches_node(injection: Injection, tick: int) -> bool:
    """False when the SYNC of this tick gets lost, or nobody is there to hear it."""
    if any_of(injection, NODE_KILLED, tick) or nothing_from_ecu(injection, tick):
        return False
    for n in range(injection.plan.shape[0]):
        if (
            injection.plan[n, KIND] == DROPPED
            and injection.plan[n, TARGET] == 1 << SYNC
            and under_way(injection, n, tick)
        ):
            if draw(injection.seed, n, tick, SYNC) < injection.size[n]:
                return False
    return True


# ---- plant and node ------------------------------------------------------------------------------

_P_SUPPLY = PlantParameters._fields.index("p_supply")
_AFTER_P_SUPPLY = _P_SUPPLY + 1


@inlined
def plant_now(injection: Injection, plant: PlantParameters, tick: int, period_s: float) -> PlantParameters:
    """The plant with the supply pressure it has in this tick; to be called once a tick."""
    share, goal, time_s = injection.number[SUPPLY_SHARE], 1.0, 0.0
    for n in range(injection.plan.shape[0]):
        if injection.plan[n, KIND] == SUPPLY_LOST and injection.plan[n, FIRST] <= tick:
            time_s = injection.size[n]
            goal = plant.p_tank / plant.p_supply if tick < injection.plan[n, LAST] else 1.0
    if time_s > 0.0:
        share += (goal - share) * (1.0 - math.exp(-period_s / time_s))
        injection.number[SUPPLY_SHARE] = share
    return PlantParameters(*(plant[:_P_SUPPLY] + (plant.p_supply * share,) + plant[_AFTER_P_SUPPLY:]))  # noqa: RUF005


@inlined
def load_now(injection: Injection, load_kg: float, tick: int) -> float:
    """The load in this tick."""
    for n in range(injection.plan.shape[0]):
        if injection.plan[n, KIND] == LOAD_DROPPED and under_way(injection, n, tick):
            load_kg = min(load_kg, injection.size[n])
    return load_kg


@inlined
def timing_now(injection: Injection, timing: NodeTiming, tick: int) -> NodeTiming:
    """Times of the node from the last SYNC to this one; to be called once a tick."""
    jitter_s = 0.0
    for n in range(injection.plan.shape[0]):
        if injection.plan[n, KIND] == SYNC_JITTER and under_way(injection, n, tick):
            jitter_s = injection.size[n] * (2.0 * draw(injection.seed, n, tick, 0) - 1.0)
    before_s = injection.number[JITTER_S]
    injection.number[JITTER_S] = jitter_s
    return NodeTiming(
        timing.period_s + jitter_s - before_s, timing.delay_s, timing.timeout_ticks, timing.heartbeat_ticks
    )


# ---- sensors -------------------------------------------------------------------------------------


@inlined
def disturb_sensors(injection: Injection, tick: int, row: np.ndarray) -> None:
    """What is wrong with the sensors in a frame that the node has packed; its protection stays right."""
    can_id = frame_id(row)
    changed = False
    for n in range(injection.plan.shape[0]):
        kind = injection.plan[n, KIND]
        if kind < STUCK or kind > INVALID or not under_way(injection, n, tick):
            continue
        for sensor in range(VALVES_SYNC - FIRST_SENSOR):
            field = injection.table[FIRST_SENSOR + sensor]
            if field[ID] != can_id or not (injection.plan[n, TARGET] >> sensor) & 1:
                continue
            raw = get(row, field[START], field[LENGTH], field[SIGNED])
            step, size = injection.number[STEPS + sensor], injection.size[n]
            if kind == STUCK:
                if injection.plan[n, STUCK_AT] == _NOT_SEEN:
                    injection.plan[n, STUCK_AT] = raw
                raw = injection.plan[n, STUCK_AT]
            elif kind == INVALID:
                raw = field[INVALID_RAW]
            else:
                value = raw * step
                if kind == BIASED:
                    value += size
                elif kind == NOISY:
                    value += size * (2.0 * draw(injection.seed, n, tick, 0) - 1.0)
                elif draw(injection.seed, n, tick, 0) < SPIKE_CHANCE:
                    value += size if draw(injection.seed, n, tick, 1) < 0.5 else -size
                raw = quantise(value, step, field[LOW], field[HIGH])
            put(row, field[START], field[LENGTH], raw)
            changed = True
    if changed:
        protect(row, row[DATA + 1] & 0x0F)


# ---- frames --------------------------------------------------------------------------------------


@inlined
def copy_row(source: np.ndarray, target: np.ndarray) -> None:
    """Copy a frame."""
    for k in range(FRAME_BYTES):
        target[k] = source[k]


@inlined
def hold(injection: Injection, row: np.ndarray, due: int, route: int) -> None:
    """Keep a frame until it is due."""
    for slot in range(HELD_MOST):
        if injection.held[slot, 1] == FREE:
            copy_row(row, injection.row[_HELD + slot])
            injection.held[slot, 0] = due
            injection.held[slot, 1] = route
            return


@inlined
def release(injection: Injection, tick: int, route: int, out: np.ndarray, rows: int) -> int:
    """Append the frames that are due on a route to ``out``; the rows in it then."""
    for slot in range(HELD_MOST):
        if injection.held[slot, 1] == route and injection.held[slot, 0] <= tick and rows < out.shape[0]:
            copy_row(injection.row[_HELD + slot], out[rows])
            injection.held[slot, 1] = FREE
            rows += 1
    return rows


@inlined
def send_disturbed(injection: Injection, tick: int, row: np.ndarray, out: np.ndarray, rows: int) -> int:
    """Append to ``out`` what arrives of a frame; the rows in it then. Changes ``row``."""
    which = -1
    for k in range(SYNC):
        if injection.table[k, ID] == frame_id(row):
            which = k
    valves = which == VALVES
    copies = 1
    if which >= 0:
        for n in range(injection.plan.shape[0]):
            kind = injection.plan[n, KIND]
            if kind > OLD_COUNTER or not (injection.plan[n, TARGET] >> which) & 1 or not under_way(injection, n, tick):
                continue
            size = int(injection.size[n])
            if kind == DROPPED:
                if draw(injection.seed, n, tick, which) < injection.size[n]:
                    return rows
            elif kind == DELAYED:
                hold(injection, row, tick + size, TO_NODE if valves else TO_ECU_FIRST)
                return rows
            elif kind == REORDERED:
                if (tick - injection.plan[n, FIRST]) % 2 == 0:  # comes after the next one
                    hold(injection, row, tick + 1, TO_NODE if valves else TO_ECU_LAST)
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
                if valves:  # an old answer: to an old SYNC
                    start, length = injection.table[VALVES_SYNC, START], injection.table[VALVES_SYNC, LENGTH]
                    put(row, start, length, (get(row, start, length, 0) - 1 - size) % 240 + 1)
                protect(row, (int(row[DATA + 1] & 0x0F) - size) % E2E_STATES)
    for _ in range(copies):
        if rows < out.shape[0]:
            copy_row(row, out[rows])
            rows += 1
    return rows


@inlined
def foreign_frames(injection: Injection, tick: int, priority: int, out: np.ndarray, rows: int) -> int:
    """Append the foreign frames of this tick, of higher (0) or lower (1) priority than ours; the rows then.

    Those of higher priority take their share of the bus from ours, ``state[ROOM_BITS]``; those of lower priority get
    what ours leave.
    """
    for n in range(injection.plan.shape[0]):
        if (
            injection.plan[n, KIND] != ALIEN_TRAFFIC
            or injection.plan[n, TARGET] != 1 << priority
            or not under_way(injection, n, tick)
        ):
            continue
        bits = injection.size[n] * injection.bits_per_tick
        if priority == 0:
            injection.number[ROOM_BITS] -= bits
        else:
            bits = min(bits, max(injection.bits_per_tick - _OUR_BITS, 0.0))
        injection.number[ALIEN_BITS] += bits
        place = 0
        low, high = (_HIGH_FIRST, _HIGH_LAST) if priority == 0 else (_LOW_FIRST, _LOW_LAST)
        while rows < out.shape[0]:
            length = int(9.0 * draw(injection.seed, n, tick, place))
            needed = 8 * length + 47 + (33 + 8 * length) // 4  # protocol.worst_case_bits
            if injection.number[ALIEN_BITS] < needed:
                break
            injection.number[ALIEN_BITS] -= needed
            can_id = low + int((high - low + 1) * draw(injection.seed, n, tick, place + 1))
            write_header(out[rows], can_id, length)
            for k in range(length):
                out[rows, DATA + k] = int(256.0 * draw(injection.seed, n, tick, place + 2 + k))
            place += 10
            rows += 1
    return rows


@inlined
def write_hash(row: np.ndarray, value: int) -> None:
    """Make a row the master's SDO write of its DBC hash: an expedited download of four bytes."""
    write_header(row, _SDO_TO_ECU, 8)
    row[DATA] = 0x23
    put(row, 8, 16, _MASTER_HASH_INDEX)
    put(row, 32, 32, value)


def hash_frame(value: int) -> np.ndarray:
    """The same as a row of its own."""
    row = np.zeros(FRAME_BYTES, dtype=np.uint8)
    write_hash(row, value)
    return row


@inlined
def wrong_hash_written(injection: Injection) -> bool:
    """True when a fault of this run tells the ECU another DBC's hash: to recover, it must be told the right one."""
    for n in range(injection.plan.shape[0]):
        if injection.plan[n, KIND] == DBC_MISMATCH:
            return True
    return False


@inlined
def frames_of_others(injection: Injection, tick: int, sync_counter: int, out: np.ndarray, rows: int) -> int:
    """Append what others send in this tick that should not: network management, a second ECU; the rows then."""
    for n in range(injection.plan.shape[0]):
        if not under_way(injection, n, tick):
            continue
        kind = injection.plan[n, KIND]
        if kind in (NMT_STOP, NMT_RESET):
            write_header(out[rows], 0, 2)
            out[rows, DATA] = 2 if kind == NMT_STOP else 129
            out[rows, DATA + 1] = 1
            rows += 1
        elif kind == DBC_MISMATCH:
            write_hash(out[rows], injection.wrong_hash)
            rows += 1
        elif kind == SECOND_ECU:
            write_header(out[rows], injection.table[VALVES, ID], 8)
            put(out[rows], injection.table[VALVES_SYNC, START], injection.table[VALVES_SYNC, LENGTH], sync_counter)
            protect(out[rows], (tick + FOREIGN_COUNTER_AHEAD) % E2E_STATES)
            rows += 1
            since = tick - injection.plan[n, FIRST]
            if since % HEARTBEAT_TICKS == 0:
                write_header(out[rows], _HEARTBEAT_ECU, 1)
                out[rows, DATA] = 0 if since == 0 else 5
                rows += 1
    return rows


@inlined
def disturb_answer(injection: Injection, tick: int, rows: int, out: np.ndarray) -> int:
    """Write to ``out`` what reaches the ECU of the ``rows`` frames in :func:`fresh`; the rows in it."""
    injection.number[ROOM_BITS] = injection.bits_per_tick - _SYNC_BITS
    arrived = foreign_frames(injection, tick, 0, out, 0)
    arrived = release(injection, tick, TO_ECU_FIRST, out, arrived)
    for k in range(rows):
        row = injection.row[_FRESH + k]
        disturb_sensors(injection, tick, row)
        if injection.number[ROOM_BITS] < _FRAME_BITS:  # the next tick, too late for this one
            hold(injection, row, tick + 1, TO_ECU_FIRST)
            continue
        injection.number[ROOM_BITS] -= _FRAME_BITS
        arrived = send_disturbed(injection, tick, row, out, arrived)
    arrived = release(injection, tick, TO_ECU_LAST, out, arrived)
    return foreign_frames(injection, tick, 1, out, arrived)


@njit(inline="always")  # a view cannot be returned otherwise without counting references
def fresh(injection: Injection) -> np.ndarray:
    """Rows for the frames of this tick, before the faults."""
    return injection.row[_FRESH:_TO_NODE]


@njit(inline="always")  # a view cannot be returned otherwise without counting references
def to_node(injection: Injection) -> np.ndarray:
    """Rows for the valve frames that reach the node, after the faults."""
    return injection.row[_TO_NODE:]


@inlined
def disturb_valves(injection: Injection, tick: int, row: np.ndarray) -> int:
    """Write to :func:`to_node` what reaches the node of a valve frame; the rows in it."""
    if any_of(injection, NODE_KILLED, tick):
        return 0
    if injection.number[ROOM_BITS] < _FRAME_BITS and any_of(injection, ALIEN_TRAFFIC, tick):
        hold(injection, row, tick + 1, TO_NODE)
        return 0
    injection.number[ROOM_BITS] -= _FRAME_BITS
    copy_row(row, injection.row[_FRESH])
    return send_disturbed(injection, tick, injection.row[_FRESH], to_node(injection), 0)


@inlined
def late_valves(injection: Injection, tick: int) -> int:
    """Write to :func:`to_node` the valve frames held until this tick; the rows in it."""
    return release(injection, tick, TO_NODE, to_node(injection), 0)


@inlined
def is_motion(injection: Injection, row: np.ndarray) -> bool:
    """True for a command of the master."""
    return frame_id(row) == injection.table[MOTION, ID]


@inlined
def request_of(injection: Injection, row: np.ndarray) -> int:
    """What a command of the master asks for."""
    return get(row, injection.table[MOTION_REQUEST, START], injection.table[MOTION_REQUEST, LENGTH], 0)
