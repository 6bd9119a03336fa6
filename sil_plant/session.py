"""One run: the I/O node, the master that commands the moves, and the record; the same compiled code on every bus.

A run begins with a prelude at standstill, its :class:`Timeline`: NMT start in the first tick, the tare of the
pressure sensors with the pump off where there is one, RUN, and then time zero of the scenario, when motion starts.
"""

from __future__ import annotations

import hashlib
from typing import NamedTuple

import numpy as np
from numba import njit

from sil_plant import protocol
from sil_plant.frames import DATA, FRAME_BYTES, frame_id, get, intact, protect, put, quantise, to_row
from sil_plant.io_node import (
    SENSOR_FRAMES,
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
    node_layout,
    node_sample,
    node_timing,
    periods_due,
)
from sil_plant.machine import Machine
from sil_plant.plant import STATES, PlantParameters, plant_parameters, state_at_rest
from sil_plant.scenario import Scenario, moves

ARM_AFTER_S = 0.06  # of standstill, until RUN is requested
MOVE_AFTER_S = 0.1  # of standstill, until motion starts
TARE_REQUEST_S = 0.05
PARKED_S = 0.25  # with the pump off, where the pressures are tared
CONTROLLERS = ("pid", "diarc-noload", "diarc")

ECU_NODE, IO_NODE = 1, 2
NMT_START, NMT_STOP, NMT_RESET = 1, 2, 129
REQUEST_STANDBY, REQUEST_RUN, REQUEST_MOVE, REQUEST_TARE = 1, 2, 3, 5
MODE_NAMES = {0: "INIT", 1: "STANDBY", 2: "RUN", 3: "TARE", 15: "FAULT"}
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
MODE_RUN, MODE_FAULT = 2, 15

MASTER_FRAMES_MOST = 4
OUT_ROWS = SENSOR_FRAMES + MASTER_FRAMES_MOST + 1

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
) = range(12)


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
    theta: np.ndarray  # (14,), SI, nan until heard; order of THETA
    theta_sd: np.ndarray


class Schedule(NamedTuple):
    """What the master does and when, in ticks; rows in order of tick."""

    frame_tick: np.ndarray
    frame_row: np.ndarray
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


TICK, NEXT_FRAME, NEXT_MOVE, NEXT_LOAD = range(4)


def monitor_layout() -> MonitorLayout:
    """Read from the DBC what the master listens to."""
    return MonitorLayout(
        estimate_id=protocol.frame_id("ESTIMATE"),
        tracking_id=protocol.frame_id("TRACKING"),
        timing_id=protocol.frame_id("TIMING"),
        emergency_id=protocol.frame_id("EMCY_ECU"),
        valves_id=protocol.frame_id("VALVES"),
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


def make_schedule(scenario: Scenario, controller: str, timeline: Timeline) -> Schedule:
    """Every frame of the master and every change of the load, by tick."""
    period_s = timeline.period_s
    angle_step = protocol.scale("MOTION", "Target")
    rows = [(0, nmt_frame(NMT_START, node=0))]
    counter = 0
    if timeline.parked:
        rows.append((round(TARE_REQUEST_S / period_s), motion_frame(counter, REQUEST_TARE)))
        counter += 1
    rows.append(
        (
            timeline.run_request,
            motion_frame(counter, REQUEST_RUN, controller=CONTROLLERS.index(controller)),
        )
    )
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
        move_tick=np.array(move_tick, dtype=np.int64),
        move_joint=np.array(move_joint, dtype=np.int64),
        move_target=np.array(move_target, dtype=np.float64),
        move_ticks=np.array(move_ticks, dtype=np.int64),
        load_tick=np.array(load_tick, dtype=np.int64),
        load_kg=np.array([step.load_kg for step in scenario.load]),
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
            whole=np.zeros(12, dtype=np.int64),
            load=np.zeros(2),
            reference=np.zeros(2),
            theta=np.full(len(THETA), np.nan),
            theta_sd=np.full(len(THETA), np.nan),
        ),
        schedule=make_schedule(scenario, controller, timeline),
        progress=Progress(np.zeros(4, dtype=np.int64), np.zeros((2, 4))),
        record=Record(
            state=np.zeros((ticks, STATES)),
            command=np.zeros((ticks, 2)),
            reference=np.zeros((ticks, 2)),
            load_true=np.zeros(ticks),
            load_est=np.zeros(ticks),
            load_sd=np.zeros(ticks),
            mode=np.zeros(ticks, dtype=np.int64),
        ),
        noise=sensor_noise(plant_machine, seed, ticks),
    )


@njit(cache=True)
def reference_at(start: float, target: float, elapsed: float, total: float) -> float:
    """The move's reference: s(tau) = 35 tau^4 - 84 tau^5 + 70 tau^6 - 20 tau^7."""
    if total <= 0.0:
        return start
    if elapsed >= total:
        return target
    tau = elapsed / total
    return start + (target - start) * tau**4 * (35.0 + tau * (-84.0 + tau * (70.0 - 20.0 * tau)))


@njit(cache=True)
def update_references(session: Session, tick: int) -> None:
    """Start the moves due at this tick and record the references."""
    schedule, index, move = session.schedule, session.progress.index, session.progress.move
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


@njit(cache=True)
def is_parked(session: Session) -> bool:
    """The pump is off and the arm rests on its support: nothing moves, all chambers are at tank pressure."""
    return session.progress.index[TICK] < session.timeline.parked


@njit(cache=True)
def begin_sync(session: Session, sync_counter: int) -> int:
    """First part of :func:`on_sync`: 1 to go on, -1 when the run is over, 0 for a SYNC that came twice."""
    index, schedule = session.progress.index, session.schedule
    tick = index[TICK]
    if tick >= session.noise.shape[0]:
        return -1
    if index[NEXT_LOAD] < schedule.load_tick.size and schedule.load_tick[index[NEXT_LOAD]] <= tick:
        session.node.load[0] = schedule.load_kg[index[NEXT_LOAD]]
        index[NEXT_LOAD] += 1
    return 0 if sync_counter == session.node.count[SYNC_LAST] else 1


@njit(cache=True)
def answer_sync(session: Session, sync_counter: int, out: np.ndarray) -> int:
    """Last part of :func:`on_sync`, once the plant has moved on: record, and write the answer to ``out``."""
    index = session.progress.index
    tick = index[TICK]
    schedule, record, node = session.schedule, session.record, session.node
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
    rows += node_sample(
        node,
        session.plant,
        session.layout,
        session.errors,
        is_parked(session),
        sync_counter,
        session.noise[tick],
        out[rows:],
    )
    for k in range(STATES):
        record.state[tick, k] = node.y[k]
    record.command[tick, 0] = node.u[1, 0]
    record.command[tick, 1] = node.u[1, 1]
    record.load_true[tick] = node.load[0]
    record.load_est[tick] = session.monitor.load[0]
    record.load_sd[tick] = session.monitor.load[1]
    record.mode[tick] = session.monitor.whole[MODE]
    update_references(session, tick)
    index[TICK] = tick + 1
    return rows


@njit(cache=True)
def on_sync(session: Session, sync_counter: int, out: np.ndarray) -> int:
    """Answer SYNC: the plant moves on, the record gets a row, the answer is written to ``out``.

    Returns
    -------
    int
        Rows of ``out`` to send in this order: the master's commands of this tick, then the sensor frames.
        -1 when the run is over: nothing was done. 0 for a SYNC that came twice.
    """
    go_on = begin_sync(session, sync_counter)
    if go_on <= 0:
        return go_on  # over, or the same SYNC again: answered already
    tick = session.progress.index[TICK]
    for _ in range(periods_due(session.node, sync_counter)):
        if not is_parked(session):
            advance_one_period(session.node, session.plant, session.timing, session.errors, session.noise[tick, 7])
    return answer_sync(session, sync_counter, out)


@njit(cache=True)
def on_frame(session: Session, row: np.ndarray) -> None:
    """Take any other frame from the bus: valve commands for the node, the rest for the monitor."""
    layout, whole = session.monitor_layout, session.monitor.whole
    can_id = frame_id(row)
    if can_id == layout.valves_id:
        tick = session.progress.index[TICK]
        if tick == 0 or session.noise[tick - 1, 11] >= session.errors.frame_loss:
            node_frame(session.node, session.layout, row)
        if intact(row):
            whole[MODE] = row[DATA + 1] >> 4
            if whole[MODE] == MODE_FAULT:
                whole[FAULTED] = 1
    elif can_id == layout.emergency_id:
        if row[4] == 8 and get(row, layout.emergency[0, 0], layout.emergency[0, 1], 0) != 0:
            whole[EMERGENCY] = get(row, layout.emergency[0, 0], layout.emergency[0, 1], 0)
            whole[FAULT] = get(row, layout.emergency[1, 0], layout.emergency[1, 1], 0)
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


def trace_sha256(record: Record, ticks: int) -> str:
    """Hash of the true states and valve commands of every tick, little-endian binary64."""
    digest = hashlib.sha256()
    digest.update(np.ascontiguousarray(record.state[:ticks], dtype="<f8").tobytes())
    digest.update(np.ascontiguousarray(record.command[:ticks], dtype="<f8").tobytes())
    return digest.hexdigest()


def sync_lost(session: Session) -> int:
    """SYNC frames that the node missed."""
    return int(session.node.count[SYNC_LOST])
