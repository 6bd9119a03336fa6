"""One run: the I/O node, the master that commands the moves, and the record; the same compiled code on every bus.

A run begins with a prelude at standstill, its :class:`Timeline`: NMT start in the first tick, the tare of the
pressure sensors with the pump off where there is one, RUN, and then time zero of the scenario, when motion starts.
"""

from __future__ import annotations

import hashlib
from typing import NamedTuple

import numpy as np

from sil_plant.bus import protocol
from sil_plant.bus.frames import DATA, E2E_STATES, FRAME_BYTES, frame_id, get, intact, protect, put, quantise, to_row
from sil_plant.compiled import inlined
from sil_plant.inputs.machine import Machine
from sil_plant.inputs.scenario import Scenario, moves
from sil_plant.loop import injection
from sil_plant.loop.injection import Injection
from sil_plant.loop.io_node import (
    COMMAND_NEW,
    SYNC_LAST,
    SYNC_LOST,
    Node,
    NodeErrors,
    NodeLayout,
    NodeTiming,
    advance_one_period,
    make_node,
    node_errors,
    node_frame,
    node_heartbeat,
    node_layout,
    node_sync,
    node_timing,
)
from sil_plant.plant.dynamics import STATES, PlantParameters, plant_parameters, state_at_rest

ARM_AFTER_S = 0.06  # of standstill, until RUN is requested
MOVE_AFTER_S = 0.1  # of standstill, until motion starts
ASK_AGAIN_TICKS = 10  # so long after a request for RUN that did not lead there, until motion starts
TARE_REQUEST_S = 0.05
PARKED_S = 0.25  # with the pump off, where the pressures are tared
CONTROLLERS = ("pid", "diarc-noload", "diarc")

ECU_NODE, IO_NODE = 1, 2
NMT_START, NMT_STOP, NMT_ENTER_PRE_OPERATIONAL, NMT_RESET = 1, 2, 128, 129  # commands
NMT_STOPPED, NMT_OPERATIONAL, NMT_PRE_OPERATIONAL = 4, 5, 127  # states
REQUEST_STANDBY, REQUEST_RUN, REQUEST_MOVE, REQUEST_RESET_FAULT, REQUEST_TARE = 1, 2, 3, 4, 5
REQUEST_COMMISSION = 7
MODE_NAMES = {
    0: "INIT",
    1: "STANDBY",
    2: "RUN",
    3: "TARE",
    4: "COMMISSION",
    5: "HOLD",
    6: "SAFE_STOP",
    15: "FAULT",
}
# Estimated parameters in the order of the PARAMETERS frame: signal, and prior in a machine file.
THETA = (
    ("m_t", "m_t_kg"),
    ("J", "J_kgm2"),
    ("m2", "m2_kg"),
    ("fv1", "fv_swing_Nms_rad"),
    ("fv2", "fv_wrist_Nms_rad"),
    ("fc1", "fc_swing_Nm"),
    ("fc2", "fc_wrist_Nm"),
    ("Om1_swing", "Om1_swing_Nm"),
    ("Om1_wrist", "Om1_wrist_Nm"),
    ("beta_inverse", "beta_inverse_1_Pa"),
    ("Om2_swing", "Om2_swing_m3_s"),
    ("Om3_swing", "Om3_swing_m3_s"),
    ("Om2_wrist", "Om2_wrist_m3_s"),
    ("Om3_wrist", "Om3_wrist_m3_s"),
)
MODE_INIT, MODE_STANDBY, MODE_RUN, MODE_COMMISSION, MODE_HOLD, MODE_FAULT = 0, 1, 2, 4, 5, 15

MASTER_FRAMES_MOST = 4
OUT_ROWS = 64  # three sensor frames, the master's, a heartbeat; and with faults repeated, late and foreign ones
EMERGENCIES_MOST = 64  # recorded in a run
RECOVER_EVERY_TICKS = 20  # the master's pace when it brings the ECU back to RUN
RECOVER_TICKS_MOST = 2000  # then it gives up

# Places in Monitor.whole
(
    MODE,
    HASH_HEARD,
    DBC_HASH,
    FAULT,
    LOST,
    E2E_ERRORS,
    SEND_DROPS,
    REFUSED,
    LAST_REFUSAL,
    EMERGENCY,
    LATE,
    FAULTED,
    EMERGENCIES,
    REBOOTS,
    OUTSIDE,
    NMT_STATE,
) = range(16)


class Timeline(NamedTuple):
    """The prelude, in ticks."""

    period_s: float
    parked: int  # pump off until here
    run_request: int
    motion: int  # time zero of the scenario


class MonitorLayout(NamedTuple):
    """Identifiers, layouts and scales of what the ECU sends."""

    estimate_id: int
    tracking_id: int
    timing_id: int
    emergency_id: int
    valves_id: int
    heartbeat_id: int
    estimate: np.ndarray
    tracking: np.ndarray
    timing: np.ndarray
    emergency: np.ndarray
    load_step: float
    sd_step: float
    angle_step: float
    parameters_id: int
    parameters: np.ndarray
    theta_step: np.ndarray
    theta_sd_step: np.ndarray


class Monitor(NamedTuple):
    """What was last heard from the ECU."""

    whole: np.ndarray  # int64, places above
    load: np.ndarray  # estimate and its standard deviation, kg
    reference: np.ndarray  # swing, wrist, rad
    sent: np.ndarray  # spool set-points, 0 when disabled
    theta: np.ndarray  # (14,), SI, nan until heard; order of THETA
    theta_sd: np.ndarray


class Schedule(NamedTuple):
    """What the master does and when, in ticks; rows in order of tick."""

    frame_tick: np.ndarray
    frame_row: np.ndarray
    run_row: np.ndarray  # the request for RUN, with a counter that is neither the last nor the next one
    move_tick: np.ndarray
    move_joint: np.ndarray
    move_target: np.ndarray
    move_ticks: np.ndarray
    load_tick: np.ndarray
    load_kg: np.ndarray


class Record(NamedTuple):
    """One row per tick, as it was at SYNC."""

    state: np.ndarray  # (ticks, 12)
    command: np.ndarray  # (ticks, 2), spool set-points heard last
    reference: np.ndarray  # (ticks, 2), rad
    load_true: np.ndarray
    load_est: np.ndarray
    load_sd: np.ndarray
    mode: np.ndarray
    valves: np.ndarray  # (ticks, 4), spool set-points in effect since the tick before; last sent, 0 when disabled
    emergency: np.ndarray  # (EMERGENCIES_MOST, 3): tick, error code, fault code; whole[EMERGENCIES] of them


class Progress(NamedTuple):
    """Where the run is: indices into the schedule and the reference of each joint."""

    index: np.ndarray  # tick, next frame, next move, next load
    move: np.ndarray  # (2, 4): start, target, tick it began, ticks; 0 ticks = at rest at start


class Session(NamedTuple):
    """All of one run, for compiled code."""

    node: Node
    plant: PlantParameters
    layout: NodeLayout
    timing: NodeTiming
    errors: NodeErrors
    timeline: Timeline
    monitor_layout: MonitorLayout
    monitor: Monitor
    schedule: Schedule
    progress: Progress
    record: Record
    noise: np.ndarray
    injection: Injection
    faulty: bool  # the injection has rows; a scalar, because looking into a tuple of arrays takes time


TICK, NEXT_FRAME, NEXT_MOVE, NEXT_LOAD, ASKED_AGAIN = range(5)
SYNC_COUNTERS = 240  # CiA 301, 1019h
VALVE_ACTIVE = 7  # CiA 408


def monitor_layout() -> MonitorLayout:
    """Read from the DBC what the master listens to."""
    return MonitorLayout(
        estimate_id=protocol.frame_id("ESTIMATE"),
        tracking_id=protocol.frame_id("TRACKING"),
        timing_id=protocol.frame_id("TIMING"),
        emergency_id=protocol.frame_id("EMCY_ECU"),
        valves_id=protocol.frame_id("VALVES"),
        heartbeat_id=protocol.frame_id("HEARTBEAT_ECU"),
        estimate=protocol.layout("ESTIMATE", ("Load", "LoadSd", "Mode")),
        tracking=protocol.layout("TRACKING", ("TrackingJoint", "SwingReference", "WristReference")),
        timing=protocol.layout(
            "TIMING",
            (
                "TimingPage",
                "LateTicks",
                "FaultCode",
                "DbcHash",
                "LostFrames",
                "E2eErrors",
                "SendDrops",
                "RefusedRequests",
                "LastRefusal",
            ),
        ),
        emergency=protocol.layout("EMCY_ECU", ("ErrorCode", "FaultCode")),
        load_step=protocol.scale("ESTIMATE", "Load"),
        sd_step=protocol.scale("ESTIMATE", "LoadSd"),
        angle_step=protocol.scale("TRACKING", "SwingReference"),
        parameters_id=protocol.frame_id("PARAMETERS"),
        parameters=protocol.layout("PARAMETERS", ("Parameter", "theta_m_t", "sd_m_t")),
        theta_step=np.array([protocol.scale("PARAMETERS", f"theta_{name}") for name, _ in THETA]),
        theta_sd_step=np.array([protocol.scale("PARAMETERS", f"sd_{name}") for name, _ in THETA]),
    )


def nmt_frame(command: int, node: int = ECU_NODE) -> np.ndarray:
    """A network management frame row."""
    return to_row(protocol.NMT_ID, bytes((command, node)))


def motion_frame(
    counter: int,
    request: int,
    joint: int = 0,
    controller: int = 0,
    target_rad: float = 0.0,
    duration_ms: int = 1,
) -> np.ndarray:
    """A motion command frame row with E2E protection."""
    row = to_row(protocol.frame_id("MOTION"), bytes(8))
    layout = protocol.layout("MOTION", ("Request", "Joint", "Controller", "Target", "Duration"))
    raw = quantise(target_rad, protocol.scale("MOTION", "Target"), -8388607, 8388607)
    for (start, length, _), value in zip(layout, (request, joint, controller, raw, duration_ms), strict=True):
        put(row, start, length, value)
    protect(row, counter % 15)
    return row


def make_timeline(period_s: float, tare: bool) -> Timeline:
    """The prelude of a run, with or without the tare."""
    parked_s = PARKED_S if tare else 0.0
    return Timeline(
        period_s=period_s,
        parked=round(parked_s / period_s),
        run_request=round((parked_s + ARM_AFTER_S) / period_s),
        motion=round((parked_s + MOVE_AFTER_S) / period_s),
    )


def make_schedule(
    scenario: Scenario, controller: str, timeline: Timeline, start_request: int = REQUEST_RUN
) -> Schedule:
    """Every frame of the master and every change of the load, by tick."""
    period_s = timeline.period_s
    angle_step = protocol.scale("MOTION", "Target")
    rows = [(0, nmt_frame(NMT_START, node=0))]
    counter = 0
    if timeline.parked:
        rows.append((round(TARE_REQUEST_S / period_s), motion_frame(counter, REQUEST_TARE)))
        counter += 1
    which = CONTROLLERS.index(controller)
    rows.append((timeline.run_request, motion_frame(counter, start_request, controller=which)))
    run_row = motion_frame(counter + E2E_STATES // 2, start_request, controller=which)
    move_tick, move_joint, move_target, move_ticks = [], [], [], []
    for time_s, joint, segment in moves(scenario):
        counter += 1
        tick = timeline.motion + round(time_s / period_s)
        duration_ms = round(segment.duration_s * 1e3)
        rows.append(
            (
                tick,
                motion_frame(counter, REQUEST_MOVE, joint, target_rad=segment.target_rad, duration_ms=duration_ms),
            )
        )
        move_tick.append(tick)
        move_joint.append(joint)
        move_target.append(quantise(segment.target_rad, angle_step, -8388607, 8388607) * angle_step)
        move_ticks.append(int(duration_ms * 1e-3 / period_s + 1e-9))
    load_tick = [0] + [timeline.motion + round(step.time_s / period_s) for step in scenario.load[1:]]
    return Schedule(
        frame_tick=np.array([tick for tick, _ in rows], dtype=np.int64),
        frame_row=np.array([row for _, row in rows], dtype=np.uint8),
        run_row=run_row,
        move_tick=np.array(move_tick, dtype=np.int64),
        move_joint=np.array(move_joint, dtype=np.int64),
        move_target=np.array(move_target, dtype=np.float64),
        move_ticks=np.array(move_ticks, dtype=np.int64),
        load_tick=np.array(load_tick, dtype=np.int64),
        load_kg=np.array([step.load_kg for step in scenario.load]),
    )


def recovery_frames(controller: str, start_request: int = REQUEST_RUN) -> np.ndarray:
    """What brings an ECU back to its moves: from INIT, STANDBY or HOLD, FAULT, and the right hash; (4, 16)."""
    return np.array(
        [
            nmt_frame(NMT_START, node=0),
            motion_frame(0, start_request, controller=CONTROLLERS.index(controller)),
            motion_frame(0, REQUEST_RESET_FAULT),
            injection.hash_frame(protocol.dbc_hash()),
        ],
        dtype=np.uint8,
    )


def sensor_noise(machine: Machine, seed: int, ticks: int) -> np.ndarray:
    """What chance does in each tick, shape (ticks, 12); same seed, same bytes, however long the run.

    Columns: two angles (rad), four pressures (Pa), sampling and delay jitter (-1..1), and for three sensor frames
    and the valve frame a number in 0..1 that decides whether it is lost.
    """
    angles, pressures, frames = (np.random.default_rng(s) for s in np.random.SeedSequence(seed).spawn(3))
    amplitude = machine["sensors.encoder_noise_rad"]
    chance = frames.uniform(0.0, 1.0, (ticks, 6))
    chance[:, :2] = 2.0 * chance[:, :2] - 1.0
    return np.hstack(
        [
            angles.uniform(-amplitude, amplitude, (ticks, 2)),
            pressures.normal(0.0, machine["sensors.pressure_noise_Pa"], (ticks, 4)),
            chance,
        ]
    )


def make_session(
    plant_machine: Machine,
    scenario: Scenario,
    controller: str,
    seed: int,
    period_s: float,
    tare: bool = False,
    start_request: int = REQUEST_RUN,
) -> Session:
    """Put a run together.

    Parameters
    ----------
    plant_machine : Machine
        What the plant is.
    scenario : Scenario
        Moves and loads.
    controller : str
        One of ``CONTROLLERS``.
    seed : int
        Of the sensor noise.
    period_s : float
        The ECU's tick.
    tare : bool
        Begin with the pump off and tare the pressure sensors.
    start_request : int
        The request that starts the law: ``REQUEST_RUN``, or ``REQUEST_COMMISSION`` to identify the arm.

    Raises
    ------
    ValueError
        When the arm cannot hold the load at the start.
    """
    timeline = make_timeline(period_s, tare)
    ticks = timeline.motion + round(scenario.duration_s / period_s) + 1
    plant = plant_parameters(plant_machine)
    load = scenario.load[0].load_kg
    y = state_at_rest(plant, np.array(scenario.start_pose_rad), load)
    return Session(
        node=make_node(y, load),
        plant=plant,
        layout=node_layout(),
        timing=node_timing(plant_machine, period_s),
        errors=node_errors(plant_machine),
        timeline=timeline,
        monitor_layout=monitor_layout(),
        monitor=Monitor(
            whole=np.zeros(16, dtype=np.int64),
            load=np.zeros(2),
            reference=np.zeros(2),
            sent=np.zeros(2),
            theta=np.full(len(THETA), np.nan),
            theta_sd=np.full(len(THETA), np.nan),
        ),
        schedule=make_schedule(scenario, controller, timeline, start_request),
        progress=Progress(np.zeros(5, dtype=np.int64), np.zeros((2, 4))),
        record=Record(
            state=np.zeros((ticks, STATES)),
            command=np.zeros((ticks, 2)),
            reference=np.zeros((ticks, 2)),
            load_true=np.zeros(ticks),
            load_est=np.zeros(ticks),
            load_sd=np.zeros(ticks),
            mode=np.zeros(ticks, dtype=np.int64),
            valves=np.zeros((ticks, 4)),
            emergency=np.zeros((EMERGENCIES_MOST, 3), dtype=np.int64),
        ),
        noise=sensor_noise(plant_machine, seed, ticks),
        injection=injection.make_injection(
            scenario.faults, timeline.motion, period_s, seed, recovery_frames(controller, start_request)
        ),
        faulty=bool(scenario.faults),
    )


def motion_frames_sent(session: Session) -> int:
    """How many commands of the master have gone out as scheduled; the next one's counter, modulo 15."""
    sent = session.schedule.frame_row[: session.progress.index[NEXT_FRAME]]
    return sum(frame_id(row) == protocol.frame_id("MOTION") for row in sent) % E2E_STATES


def rewind(session: Session) -> int:
    """Begin the record and the noise anew after the prelude, so that a run can go on after its end.

    Nothing of the plant and of the node changes; the scenario's moves and loads are over. How many ticks it was.
    """
    ticks = len(session.noise) - session.timeline.motion
    session.progress.index[TICK] -= ticks
    session.progress.move[:, 3] = 0.0
    injection.rewind(session.injection, ticks)
    return ticks


@inlined
def reference_at(start: float, target: float, elapsed: float, total: float) -> float:
    """The move's reference: s(tau) = 35 tau^4 - 84 tau^5 + 70 tau^6 - 20 tau^7."""
    if total <= 0.0:
        return start
    if elapsed >= total:
        return target
    tau = elapsed / total
    return start + (target - start) * tau**4 * (35.0 + tau * (-84.0 + tau * (70.0 - 20.0 * tau)))


@inlined
def update_references(session: Session, tick: int) -> None:
    """Start the moves due at this tick and record the references."""
    schedule, index, move = session.schedule, session.progress.index, session.progress.move
    if session.faulty and not drives(session.monitor.whole[MODE]):
        # no move goes out: what comes later starts where the ECU then holds the joint
        move[:, 3] = 0.0
        while index[NEXT_MOVE] < schedule.move_tick.size and schedule.move_tick[index[NEXT_MOVE]] <= tick:
            index[NEXT_MOVE] += 1
    while index[NEXT_MOVE] < schedule.move_tick.size and schedule.move_tick[index[NEXT_MOVE]] <= tick:
        n = index[NEXT_MOVE]
        joint = schedule.move_joint[n]
        # a first move starts where the ECU holds the joint, a later one at the end of the one before
        start = session.monitor.reference[joint] if move[joint, 3] == 0.0 else move[joint, 1]
        move[joint, 0] = start
        move[joint, 1] = schedule.move_target[n]
        move[joint, 2] = schedule.move_tick[n]
        move[joint, 3] = schedule.move_ticks[n]
        index[NEXT_MOVE] += 1
    for joint in range(2):
        if move[joint, 3] == 0.0:
            session.record.reference[tick, joint] = session.monitor.reference[joint]
        else:
            session.record.reference[tick, joint] = reference_at(
                move[joint, 0], move[joint, 1], tick - move[joint, 2], move[joint, 3]
            )


@inlined
def load_due(session: Session, tick: int) -> None:
    """Change the load where the scenario says so."""
    schedule, index = session.schedule, session.progress.index
    if index[NEXT_LOAD] < schedule.load_tick.size and schedule.load_tick[index[NEXT_LOAD]] <= tick:
        session.node.load[0] = schedule.load_kg[index[NEXT_LOAD]]
        index[NEXT_LOAD] += 1


@inlined
def master_frames(session: Session, tick: int, out: np.ndarray) -> int:
    """Write the master's commands of this tick to ``out``; how many. RUN is asked for until the ECU is there."""
    schedule, index = session.schedule, session.progress.index
    rows = 0
    while (
        index[NEXT_FRAME] < schedule.frame_tick.size
        and schedule.frame_tick[index[NEXT_FRAME]] <= tick
        and rows < MASTER_FRAMES_MOST
    ):
        for k in range(FRAME_BYTES):
            out[rows, k] = schedule.frame_row[index[NEXT_FRAME], k]
        rows += 1
        index[NEXT_FRAME] += 1
    since = tick - session.timeline.run_request
    if 0 < since and tick < session.timeline.motion and since % ASK_AGAIN_TICKS == 0:
        if session.monitor.whole[MODE] == MODE_STANDBY:  # a frame was lost when it was asked
            for k in range(FRAME_BYTES):
                out[rows, k] = schedule.run_row[k]
            protect(out[rows], ((schedule.run_row[DATA + 1] & 0x0F) + index[ASKED_AGAIN]) % E2E_STATES)
            rows += 1
            index[ASKED_AGAIN] += 1
    return rows


@inlined
def record_tick(session: Session, tick: int) -> None:
    """The row of this tick."""
    record, node, monitor = session.record, session.node, session.monitor
    for k in range(STATES):
        record.state[tick, k] = node.y[k]
    for i in range(2):
        record.command[tick, i] = node.u[1, i]
        record.valves[tick, i] = node.u[0, i]
        record.valves[tick, 2 + i] = monitor.sent[i]
    record.load_true[tick] = node.load[0]
    record.load_est[tick] = monitor.load[0]
    record.load_sd[tick] = monitor.load[1]
    record.mode[tick] = monitor.whole[MODE]
    update_references(session, tick)
    session.progress.index[TICK] = tick + 1


def on_sync(session: Session, sync_counter: int, out: np.ndarray) -> int:
    """Answer SYNC: the plant moves on, the record gets a row, the answer is written to ``out``.

    Returns
    -------
    int
        Rows of ``out`` to send in this order: the master's commands of this tick, the sensor frames, and the
        node's heartbeat when it is due; whatever faults have made of them.
        -1 when the run is over: nothing was done. 0 for a SYNC that came twice.
    """
    return int((on_sync_with_faults if session.faulty else on_sync_plain)(session, sync_counter, out))


def on_frame(session: Session, row: np.ndarray) -> None:
    """Take any other frame from the bus: valve commands for the node, the rest for the monitor."""
    (on_frame_with_faults if session.faulty else on_frame_plain)(session, row)


@inlined
def on_sync_plain(session: Session, sync_counter: int, out: np.ndarray) -> int:
    """As :func:`on_sync`, for compiled code and a session without faults."""
    tick = session.progress.index[TICK]
    if tick >= session.noise.shape[0]:
        return -1
    load_due(session, tick)
    if sync_counter == session.node.count[SYNC_LAST]:
        return 0  # the same SYNC again: answered already
    rows = master_frames(session, tick, out)
    rows += answer(session, session.plant, session.timing, tick, sync_counter, out[rows:])
    record_tick(session, tick)
    return rows


@inlined
def answer(
    session: Session, plant: PlantParameters, timing: NodeTiming, tick: int, sync_counter: int, out: np.ndarray
) -> int:
    """What the node sends on SYNC; the rows written to ``out``."""
    rows = node_sync(
        session.node,
        plant,
        session.layout,
        timing,
        session.errors,
        tick < session.timeline.parked,
        sync_counter,
        session.noise[tick],
        out,
    )
    if tick % timing.heartbeat_ticks == 0:
        node_heartbeat(session.layout, out[rows])
        rows += 1
    return rows


# ---- with faults ---------------------------------------------------------------------------------


@inlined
def on_sync_with_faults(session: Session, sync_counter: int, out: np.ndarray) -> int:
    """As :func:`on_sync`, with the faults of the scenario."""
    tick = session.progress.index[TICK]
    if tick >= session.noise.shape[0]:
        return -1
    if sync_counter == session.node.count[SYNC_LAST]:
        return 0
    if not injection.sync_reaches_node(session.injection, tick):
        return without_sync(session, out)
    load_due(session, tick)
    plant = injection.plant_now(session.injection, session.plant, tick, session.timeline.period_s)
    timing = injection.timing_now(session.injection, session.timing, tick)
    fresh = injection.fresh(session.injection)
    rows = commands(session, tick, fresh)
    own = rows
    rows = injection.frames_of_others(session.injection, tick, sync_counter, fresh, rows)
    load = session.node.load[0]
    session.node.load[0] = injection.load_now(session.injection, load, tick)
    foreign = rows
    rows += answer(session, plant, timing, tick, sync_counter, fresh[rows:])
    for k in range(own, foreign):
        node_frame(session.node, session.layout, fresh[k])  # the node hears what others send, too
    arrived = injection.disturb_answer(session.injection, tick, rows, out)
    late = injection.to_node(session.injection)
    for k in range(injection.late_valves(session.injection, tick)):
        node_frame(session.node, session.layout, late[k])
    record_tick(session, tick)
    session.node.load[0] = load
    return arrived


@inlined
def without_sync(session: Session, out: np.ndarray) -> int:
    """A tick in which no SYNC reaches the node: it goes on by its own clock and says nothing.

    Returns
    -------
    int
        Rows of ``out``: what others than the node send to the ECU; -1 when the run is over.
    """
    tick = session.progress.index[TICK]
    if tick >= session.noise.shape[0]:
        return -1
    node = session.node
    load_due(session, tick)
    plant = injection.plant_now(session.injection, session.plant, tick, session.timeline.period_s)
    timing = injection.timing_now(session.injection, session.timing, tick)
    if injection.any_of(session.injection, injection.NODE_KILLED, tick):
        for i in range(2):  # springs centre the spools
            node.u[0, i] = node.u[1, i] = 0.0
        node.count[COMMAND_NEW] = 0
    load = node.load[0]
    node.load[0] = injection.load_now(session.injection, load, tick)
    if tick >= session.timeline.parked:
        advance_one_period(node, plant, timing, session.errors, session.noise[tick, 7])
    if node.count[SYNC_LAST] > 0:
        node.count[SYNC_LAST] = node.count[SYNC_LAST] % SYNC_COUNTERS + 1
        node.count[SYNC_LOST] += 1
    rows = commands(session, tick, injection.fresh(session.injection))
    if injection.nothing_from_ecu(session.injection, tick):
        rows = 0  # nor does anything reach it
    arrived = injection.disturb_answer(session.injection, tick, rows, out)
    if injection.any_of(session.injection, injection.BUS_OFF, tick):
        arrived = 0
    record_tick(session, tick)
    node.load[0] = load
    return arrived


@inlined
def commands(session: Session, tick: int, out: np.ndarray) -> int:
    """The master's frames of this tick: as scheduled, without moves the ECU would refuse, and those that recover."""
    mode = session.monitor.whole[MODE]
    count = session.injection.count
    due = master_frames(session, tick, out)
    rows = 0
    for k in range(due):
        if injection.is_motion(session.injection, out[k]) and not drives(mode):
            if injection.request_of(session.injection, out[k]) == REQUEST_MOVE:
                continue
        if k != rows:
            injection.copy_row(out[k], out[rows])
        rows += 1
    recover = session.injection.recover
    n = count[injection.RECOVER_NEXT]
    if n < recover.size and recover[n] <= tick:
        since = tick - recover[n]
        if (drives(mode) and session.monitor.whole[NMT_STATE] == NMT_OPERATIONAL) or since > RECOVER_TICKS_MOST:
            count[injection.RECOVER_NEXT] += 1
        elif since % RECOVER_EVERY_TICKS == 0:
            rows = recovery_frame(session, mode, out, rows)
    for k in range(rows):
        if injection.is_motion(session.injection, out[k]):
            protect(out[k], count[injection.MOTION_COUNTER])
            count[injection.MOTION_COUNTER] = (count[injection.MOTION_COUNTER] + 1) % E2E_STATES
    return rows


@inlined
def recovery_frame(session: Session, mode: int, out: np.ndarray, rows: int) -> int:
    """Append the documented procedure's next request for an ECU in this mode; the rows then."""
    if mode == MODE_INIT or session.monitor.whole[NMT_STATE] in (NMT_STOPPED, NMT_PRE_OPERATIONAL):
        injection.copy_row(session.injection.row[0], out[rows])
    elif mode in (MODE_STANDBY, MODE_HOLD):
        injection.copy_row(session.injection.row[1], out[rows])
    elif mode == MODE_FAULT:
        if injection.wrong_hash_written(session.injection):
            injection.copy_row(session.injection.row[3], out[rows])
            rows += 1
        injection.copy_row(session.injection.row[2], out[rows])
    else:
        return rows  # on its way
    return rows + 1


@inlined
def drives(mode: int) -> bool:
    """Modes in which the ECU takes moves."""
    return mode == MODE_RUN or mode == MODE_COMMISSION


@inlined
def ecu_is_dead(session: Session) -> bool:
    """True in a tick in which the ECU is killed."""
    return injection.any_of(session.injection, injection.ECU_KILLED, session.progress.index[TICK])


@inlined
def transmit_room(session: Session, most: int) -> int:
    """Frames that the ECU's driver takes in the tick that begins, at most ``most``."""
    return injection.transmit_room(session.injection, session.progress.index[TICK], most)


def restarts(session: Session) -> list[int]:
    """Ticks at which a killed ECU starts anew."""
    plan = session.injection.plan
    return sorted(set(plan[plan[:, injection.KIND] == injection.ECU_KILLED, injection.LAST].tolist()))


@inlined
def hear_mode(session: Session, row: np.ndarray) -> None:
    """The mode on an intact valve frame."""
    whole = session.monitor.whole
    whole[MODE] = row[DATA + 1] >> 4
    if whole[MODE] == MODE_FAULT:
        whole[FAULTED] = 1


@inlined
def on_frame_plain(session: Session, row: np.ndarray) -> None:
    """As :func:`on_frame`, for compiled code and a session without faults."""
    if frame_id(row) != session.monitor_layout.valves_id:
        hear(session, row)
        return
    tick = session.progress.index[TICK]
    if tick == 0 or session.noise[tick - 1, 11] >= session.errors.frame_loss:
        node_frame(session.node, session.layout, row)
    if intact(row):
        hear_mode(session, row)


@inlined
def on_frame_with_faults(session: Session, row: np.ndarray) -> None:
    """As :func:`on_frame`, with what the bus and the faults leave of the frame; the record has it as it was sent."""
    tick = max(session.progress.index[TICK] - 1, 0)
    if injection.nothing_from_ecu(session.injection, tick):
        return
    if frame_id(row) != session.monitor_layout.valves_id:
        hear(session, row)
        return
    if session.noise[tick, 11] >= session.errors.frame_loss:
        arrived = injection.to_node(session.injection)
        for k in range(injection.disturb_valves(session.injection, tick, row)):
            node_frame(session.node, session.layout, arrived[k])
    if not intact(row):
        return
    hear_mode(session, row)
    f, whole = session.layout.valves, session.monitor.whole
    for i in range(2):
        command = get(row, f[i, 0], f[i, 1], 1) * session.layout.command_step
        enabled = get(row, f[2 + i, 0], f[2 + i, 1], 0) == VALVE_ACTIVE
        session.monitor.sent[i] = command if enabled else 0.0
        if abs(command) > 1.0 or (command != 0.0 and not enabled):
            whole[OUTSIDE] += 1


@inlined
def hear(session: Session, row: np.ndarray) -> None:
    """What the monitor learns from a frame of the ECU."""
    layout, whole = session.monitor_layout, session.monitor.whole
    can_id = frame_id(row)
    if can_id == layout.emergency_id:
        if row[4] == 8:
            take_emergency(session, row)
    elif can_id == layout.estimate_id and intact(row):
        f = layout.estimate
        session.monitor.load[0] = get(row, f[0, 0], f[0, 1], 1) * layout.load_step
        session.monitor.load[1] = get(row, f[1, 0], f[1, 1], 0) * layout.sd_step
    elif can_id == layout.tracking_id and intact(row):
        f = layout.tracking
        joint = get(row, f[0, 0], f[0, 1], 0)
        if joint < 2:
            session.monitor.reference[joint] = get(row, f[1 + joint, 0], f[1 + joint, 1], 1) * layout.angle_step
    elif can_id == layout.parameters_id and intact(row):
        f = layout.parameters  # all parameters stand at the same place, each with its own scale
        n = get(row, f[0, 0], f[0, 1], 0)
        if n < session.monitor.theta.size:
            session.monitor.theta[n] = get(row, f[1, 0], f[1, 1], 1) * layout.theta_step[n]
            session.monitor.theta_sd[n] = get(row, f[2, 0], f[2, 1], 0) * layout.theta_sd_step[n]
    elif can_id == layout.timing_id and intact(row):
        f = layout.timing
        page = get(row, f[0, 0], f[0, 1], 0)
        if page == 0:
            whole[LATE] = get(row, f[1, 0], f[1, 1], 0)
        elif page == 1:
            whole[DBC_HASH] = get(row, f[3, 0], f[3, 1], 0)
            whole[HASH_HEARD] = 1
        elif page == 2:
            whole[LOST] = get(row, f[4, 0], f[4, 1], 0)
            whole[E2E_ERRORS] = get(row, f[5, 0], f[5, 1], 0)
            whole[SEND_DROPS] = get(row, f[6, 0], f[6, 1], 0)
        elif page == 3:
            whole[REFUSED] = get(row, f[7, 0], f[7, 1], 0)
            whole[LAST_REFUSAL] = get(row, f[8, 0], f[8, 1], 0)
    elif can_id == layout.heartbeat_id and row[4] == 1:
        whole[NMT_STATE] = row[DATA]
        if row[DATA] == 0:  # the ECU begins anew, and counts anew
            whole[MODE] = MODE_INIT
            if session.node.count[SYNC_LAST] > 0:
                session.node.count[SYNC_LAST] = SYNC_COUNTERS
                whole[REBOOTS] += 1


@inlined
def take_emergency(session: Session, row: np.ndarray) -> None:
    """An emergency of the ECU; error code 0 says that it is over."""
    f, whole = session.monitor_layout.emergency, session.monitor.whole
    code, fault = get(row, f[0, 0], f[0, 1], 0), get(row, f[1, 0], f[1, 1], 0)
    if code != 0:
        whole[EMERGENCY] = code
        whole[FAULT] = fault
    n = whole[EMERGENCIES]
    if n < EMERGENCIES_MOST:
        session.record.emergency[n, 0] = max(session.progress.index[TICK] - 1, 0)
        session.record.emergency[n, 1] = code
        session.record.emergency[n, 2] = fault
        whole[EMERGENCIES] = n + 1


def trace_sha256(record: Record, ticks: int) -> str:
    """Hash of the true states and valve commands of every tick, little-endian binary64."""
    digest = hashlib.sha256()
    digest.update(np.ascontiguousarray(record.state[:ticks], dtype="<f8").tobytes())
    digest.update(np.ascontiguousarray(record.command[:ticks], dtype="<f8").tobytes())
    return digest.hexdigest()


def sync_lost(session: Session) -> int:
    """SYNC frames that the node missed."""
    return int(session.node.count[SYNC_LOST])
