"""The joint I/O node as the bus sees it: samples at SYNC, drives the valves, keeps its own watch on the ECU.

The node owns the plant. It integrates from SYNC to SYNC and never looks at a wall clock: a valve command
takes effect at a fixed delay after the SYNC of its tick, wherever it was computed.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from sil_plant.bus import frames, protocol
from sil_plant.bus.frames import E2E_STATES, get, intact, protect, put, quantise, write_header
from sil_plant.compiled import inlined
from sil_plant.inputs.machine import Machine
from sil_plant.plant.dynamics import P_SWING, STATES, XV, PlantParameters, integrate

SENSOR_FRAMES = 3
IO_HEARTBEAT_S = 0.1
_NMT_OPERATIONAL = 5
_ANGLE_LIMIT = 8388607
_PRESSURE_LIMIT = 65534  # 65535 means invalid
_SPOOL_LIMIT = 32767

# Places in Node.count; EXTERNAL: the plant is another one than ours, and its owner moves it on
TICK, SYNC_LAST, SYNC_LOST, COMMAND_AGE, COMMAND_NEW, E2E_REFUSED, VALVE_COUNTER, TIMED_OUT, EXTERNAL = range(9)


class NodeLayout(NamedTuple):
    """Identifiers, bit layouts and scales from the DBC, for compiled code."""

    encoders_id: int
    pressures_id: np.ndarray
    valves_id: int
    angles: np.ndarray
    pressures: np.ndarray
    valves: np.ndarray
    angle_step: float
    pressure_step: float
    spool_step: float
    command_step: float
    heartbeat_id: int


class NodeErrors(NamedTuple):
    """What sensors, valves and frames do wrong; zeros for the paper's plant."""

    encoder_step: float
    pressure_gain: np.ndarray  # (4,)
    pressure_offset: np.ndarray  # (4,), Pa
    hysteresis: float
    jitter_s: float
    frame_loss: float


class NodeTiming(NamedTuple):
    """Times of the node."""

    period_s: float
    delay_s: float
    timeout_ticks: int
    heartbeat_ticks: int


class Node(NamedTuple):
    """State of node and plant; arrays are changed in place.

    Attributes
    ----------
    y : np.ndarray
        Plant state, shape (12,).
    u : np.ndarray
        Set-points in effect, then the ones that wait for their delay, then what hysteresis lets the spools
        follow; shape (3, 2).
    load : np.ndarray
        Load at the tip, kg, shape (1,).
    count : np.ndarray
        Integers named by the constants of this module.
    scratch : np.ndarray
        Work space of the integrator.
    """

    y: np.ndarray
    u: np.ndarray
    load: np.ndarray
    count: np.ndarray
    scratch: np.ndarray


def node_layout() -> NodeLayout:
    """Read what the node needs from the DBC."""
    pressures = ("BorePressure", "AnnulusPressure", "SpoolPosition")
    return NodeLayout(
        encoders_id=protocol.frame_id("ENCODERS"),
        pressures_id=np.array(
            [protocol.frame_id("PRESSURES_SWING"), protocol.frame_id("PRESSURES_WRIST")], dtype=np.int64
        ),
        valves_id=protocol.frame_id("VALVES"),
        angles=protocol.layout("ENCODERS", ("SwingAngle", "WristAngle")),
        pressures=protocol.layout("PRESSURES_SWING", pressures),
        valves=protocol.layout("VALVES", ("SwingSpool", "WristSpool", "SwingControl", "WristControl", "SyncCounter")),
        angle_step=protocol.scale("ENCODERS", "SwingAngle"),
        pressure_step=protocol.scale("PRESSURES_SWING", "BorePressure") * 1e5,
        spool_step=protocol.scale("PRESSURES_SWING", "SpoolPosition") / 100.0,
        command_step=protocol.scale("VALVES", "SwingSpool") / 100.0,
        heartbeat_id=protocol.frame_id("HEARTBEAT_IO"),
    )


def node_errors(machine: Machine) -> NodeErrors:
    """Sensor errors of a machine; their signs follow from the number of the sensor set, not from a run's seed."""
    signs = np.random.default_rng(int(machine["effects.sensor_set"])).choice([-1.0, 1.0], (2, 4))
    bits = machine["effects.encoder_bits"]
    return NodeErrors(
        encoder_step=2.0 * np.pi / 2.0**bits if bits > 0.0 else 0.0,
        pressure_gain=1.0 + machine["effects.pressure_gain_error"] * signs[0],
        pressure_offset=machine["effects.pressure_offset_Pa"] * signs[1],
        hysteresis=machine["effects.hysteresis"],
        jitter_s=machine["effects.sync_jitter_s"],
        frame_loss=machine["effects.frame_loss"],
    )


@inlined
def node_heartbeat(layout: NodeLayout, row: np.ndarray) -> None:
    """Make a row the node's heartbeat."""
    write_header(row, layout.heartbeat_id, 1)
    row[frames.DATA] = _NMT_OPERATIONAL


def node_timing(machine: Machine, period_s: float) -> NodeTiming:
    """Times of the node for a tick of ``period_s``."""
    return NodeTiming(
        period_s=period_s,
        delay_s=min(machine["io.command_delay_s"], period_s),
        timeout_ticks=max(1, round(machine["io.valve_timeout_s"] / period_s)),
        heartbeat_ticks=max(1, round(IO_HEARTBEAT_S / period_s)),
    )


def make_node(y: np.ndarray, load_kg: float) -> Node:
    """A node at rest that has heard nothing yet."""
    count = np.zeros(9, dtype=np.int64)
    count[VALVE_COUNTER] = -1
    return Node(
        y=y.copy(),
        u=np.zeros((3, 2)),
        load=np.array([load_kg]),
        count=count,
        scratch=np.zeros((5, STATES)),
    )


@inlined
def follow(node: Node, hysteresis: float) -> None:
    """Let the spools follow the set-points in effect, with play."""
    for i in range(2):
        low, high = node.u[0, i] - 0.5 * hysteresis, node.u[0, i] + 0.5 * hysteresis
        node.u[2, i] = min(max(node.u[2, i], low), high)


@inlined
def command_delay(timing: NodeTiming, errors: NodeErrors, jitter: float) -> float:
    """From SYNC until a command takes effect, s; ``jitter`` -1..1 says how far it is off in this period."""
    return min(max(timing.delay_s + jitter * errors.jitter_s, 0.0), timing.period_s)


@inlined
def take_command(node: Node, timing: NodeTiming, errors: NodeErrors) -> None:
    """Put the command that waits into effect; without one for too long, close the valves."""
    count = node.count
    if count[COMMAND_NEW]:
        count[COMMAND_NEW] = 0
        count[COMMAND_AGE] = 0
        node.u[0, 0] = node.u[1, 0]
        node.u[0, 1] = node.u[1, 1]
    else:
        count[COMMAND_AGE] += 1
        if count[COMMAND_AGE] > timing.timeout_ticks:
            count[TIMED_OUT] = 1
            node.u[0, 0] = 0.0
            node.u[0, 1] = 0.0
    follow(node, errors.hysteresis)


@inlined
def advance_one_period(
    node: Node, plant: PlantParameters, timing: NodeTiming, errors: NodeErrors, jitter: float
) -> None:
    """Integrate over one period: the old set-points up to the delay, then the new ones.

    Parameters
    ----------
    node, plant, timing, errors
        The node.
    jitter : float
        -1..1, how far the delay is off in this period, in units of the jitter.
    """
    if node.count[EXTERNAL]:
        return  # sil_plant/loop/external_plant.py has done it
    delay_s = command_delay(timing, errors, jitter)
    integrate(node.y, node.u[2], node.load[0], plant, delay_s, node.scratch)
    take_command(node, timing, errors)
    integrate(node.y, node.u[2], node.load[0], plant, timing.period_s - delay_s, node.scratch)


@inlined
def node_sync(
    node: Node,
    plant: PlantParameters,
    layout: NodeLayout,
    timing: NodeTiming,
    errors: NodeErrors,
    parked: bool,
    sync_counter: int,
    noise: np.ndarray,
    out: np.ndarray,
) -> int:
    """Answer SYNC: bring the plant to this instant, sample, and pack the sensor frames.

    Parameters
    ----------
    node, plant, layout, timing, errors
        The node.
    parked : bool
        The pump is off and the arm rests on its support: nothing moves, all chambers are at tank pressure.
    sync_counter : int
        1..240; missing ones are integrated over and counted.
    noise : np.ndarray
        This tick's noise, shape (12,): two angles (rad), four pressures (Pa), sampling and delay jitter (-1..1),
        and for three sensor frames and the valve frame a number in 0..1 that decides whether it is lost.
    out : np.ndarray
        Written: up to three frame rows, shape (3, 16).

    Returns
    -------
    int
        Rows written: three, less those that the bus loses.
    """
    count = node.count
    if count[SYNC_LAST] > 0:
        periods = (sync_counter - count[SYNC_LAST]) % 240
        count[SYNC_LOST] += periods - 1
        for _ in range(periods):
            if not parked:
                advance_one_period(node, plant, timing, errors, noise[7])
        count[TICK] += periods
    count[SYNC_LAST] = sync_counter

    # The E2E counter of a sensor frame says which SYNC it answers.
    counter = (sync_counter - 1) % E2E_STATES
    y = node.y
    write_header(out[0], layout.encoders_id, 8)
    for i in range(2):
        angle = y[i] + y[2 + i] * noise[6] * errors.jitter_s + noise[i]
        if errors.encoder_step > 0.0:
            angle = errors.encoder_step * math.floor(angle / errors.encoder_step + 0.5)
        raw = quantise(angle, layout.angle_step, -_ANGLE_LIMIT, _ANGLE_LIMIT)
        put(out[0], layout.angles[i, 0], layout.angles[i, 1], raw)
    protect(out[0], counter)
    rows = 0 if noise[8] < errors.frame_loss else 1
    for i in range(2):
        row = out[rows]
        write_header(row, layout.pressures_id[i], 8)
        for k in range(2):
            n = 2 * i + k
            true = plant.p_tank if parked else y[P_SWING + n]
            pressure = true * errors.pressure_gain[n] + errors.pressure_offset[n] + noise[2 + n]
            raw = quantise(pressure, layout.pressure_step, 0, _PRESSURE_LIMIT)
            put(row, layout.pressures[k, 0], layout.pressures[k, 1], raw)
        raw = quantise(y[XV + i], layout.spool_step, -_SPOOL_LIMIT, _SPOOL_LIMIT)
        put(row, layout.pressures[2, 0], layout.pressures[2, 1], raw)
        protect(row, counter)
        if noise[9 + i] >= errors.frame_loss:
            rows += 1
    return rows


@inlined
def node_frame(node: Node, layout: NodeLayout, row: np.ndarray) -> None:
    """Take a frame from the bus: valve commands count, all others are not for the node."""
    if frames.frame_id(row) != layout.valves_id:
        return
    count = node.count
    counter = row[frames.DATA + 1] & 0x0F
    if not intact(row) or counter >= E2E_STATES or counter == count[VALVE_COUNTER]:
        count[E2E_REFUSED] += 1
        return
    count[VALVE_COUNTER] = counter
    fields = layout.valves
    if get(row, fields[4, 0], fields[4, 1], 0) != count[SYNC_LAST]:
        count[E2E_REFUSED] += 1  # an answer to another SYNC
        return
    for i in range(2):
        enabled = get(row, fields[2 + i, 0], fields[2 + i, 1], 0) == 7
        raw = get(row, fields[i, 0], fields[i, 1], 1)
        if raw < -_SPOOL_LIMIT:  # marked invalid
            enabled = False
        node.u[1, i] = min(max(raw * layout.command_step, -1.0), 1.0) if enabled else 0.0
    count[COMMAND_NEW] = 1
