"""The hydraulic arm in continuous time: two rigid links, two cylinders on cranks, two spool valves.

The state of one arm is a vector of 12 numbers, SI units::

    0, 1    q         swing, wrist angle, rad
    2, 3    w         rates, rad/s
    4, 5    p         swing cylinder: bore, annulus pressure, Pa absolute
    6, 7    p         wrist cylinder
    8, 9    xv        spools, -1..1
    10, 11  xv'       spool rates, 1/s

Equations and symbols: docs/paper.md. All functions here are compiled and free of state.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from sil_plant.compiled import compiled, inlined
from sil_plant.inputs.machine import JOINT_NAMES, Machine

STATES = 12
Q, W, P_SWING, P_WRIST, XV, XV_RATE = 0, 2, 4, 6, 8, 10

# Longest step of the integrator; tests hold the accuracy that follows from it.
LONGEST_STEP_S = 5e-4

# A kink so near to an end of a step, as a share of it, does not divide the step.
_NEAR_THE_END = 0.01
# Of spool travel: so near to an edge of the valve a spool is on it.
_ON_THE_EDGE = 1e-6
# A chamber so near to pressure zero is dry.
_DRY_PA = 1.0
# What decays, friction's bend or a pressure at an open port, is to decay by no more than this exponent in a step.
_DECAY_A_STEP = 1.0
# The shortest step that this asks for is this part of the longest; and so often a step ends at a kink, at most.
_PARTS_MOST = 16
_EVENTS_MOST = 16

# Below this pressure drop the root's slope is held finite (an odd cubic that meets the root with its slope).
_ROOT_BLEND_PA = 1e4
# The joints' stops: this far outside the joint range, as stiff as these are at the cylinder with the arm at q = 0.
STOP_BEYOND_RAD = 0.02
_STOP_STIFFNESS_N_M = 2e7
_STOP_DAMPING_NS_M = 2e4


class PlantParameters(NamedTuple):
    """What the plant's equations need, SI; arrays hold swing, then wrist."""

    g: float
    I1: float
    L1: float
    L2: float
    m2: float
    J: float
    coulomb_slope: float
    fv: np.ndarray
    fc: np.ndarray
    area1: np.ndarray
    area2: np.ndarray
    dead_volume: np.ndarray
    crank_a2_b2: np.ndarray
    crank_ab: np.ndarray
    q0: np.ndarray
    x_offset: np.ndarray
    stroke: np.ndarray
    kv: np.ndarray
    leakage: np.ndarray
    valve_w: np.ndarray
    valve_damping: np.ndarray
    bulk_modulus: float
    p_supply: float
    p_tank: float
    overlap: np.ndarray
    friction_at_cylinder: float
    lever_inverse: np.ndarray
    q_low: np.ndarray
    q_high: np.ndarray
    stribeck: float
    stribeck_rate: float
    air_bulk_low: float
    air_bulk_high: float
    air_pressure: float
    supply_sag: float


def plant_parameters(machine: Machine) -> PlantParameters:
    """Collect a machine's numbers for the compiled equations."""

    def pair(key: str) -> np.ndarray:
        return np.array(machine.pair(key), dtype=np.float64)

    bore, rod = pair("*.bore_m"), pair("*.rod_m")
    a, b, q0 = pair("*.crank_a_m"), pair("*.crank_b_m"), pair("*.crank_q0_rad")

    def length(q: np.ndarray) -> np.ndarray:
        return np.sqrt(a**2 + b**2 - 2.0 * a * b * np.cos(q + q0))

    shortest, longest = length(pair("*.q_min_rad")), length(pair("*.q_max_rad"))
    margin = pair("*.end_margin_m")
    return PlantParameters(
        g=machine["arm.gravity_m_s2"],
        I1=machine["arm.swing_inertia_kgm2"],
        L1=machine["swing.link_length_m"],
        L2=machine["wrist.link_length_m"],
        m2=machine["wrist.mass_kg"],
        J=machine["wrist.mass_kg"] * machine["wrist.link_length_m"] ** 2 / 3.0,
        coulomb_slope=1.0 / machine["arm.coulomb_rate_rad_s"],
        fv=pair("*.viscous_Nms_rad") * machine["effects.viscosity_factor"],
        fc=pair("*.coulomb_Nm"),
        area1=math.pi / 4.0 * bore**2,
        area2=math.pi / 4.0 * (bore**2 - rod**2),
        dead_volume=pair("*.dead_volume_m3"),
        crank_a2_b2=a**2 + b**2,
        crank_ab=a * b,
        q0=q0,
        x_offset=shortest - margin,
        stroke=longest - shortest + 2.0 * margin,
        kv=pair("*.valve_kv"),
        leakage=pair("*.leakage_m3_s_Pa"),
        valve_w=2.0 * math.pi * pair("*.valve_frequency_Hz"),
        valve_damping=pair("*.valve_damping"),
        bulk_modulus=machine["oil.bulk_modulus_Pa"],
        p_supply=machine["supply.pressure_Pa"],
        p_tank=machine["supply.tank_Pa"],
        overlap=pair("*.valve_overlap"),
        friction_at_cylinder=machine["arm.friction_at_cylinder"],
        lever_inverse=length(np.zeros(2)) / (a * b * np.sin(q0)),
        q_low=pair("*.q_min_rad") - STOP_BEYOND_RAD,
        q_high=pair("*.q_max_rad") + STOP_BEYOND_RAD,
        stribeck=machine["effects.stribeck"],
        stribeck_rate=machine["effects.stribeck_rate_rad_s"],
        air_bulk_low=machine["effects.air_bulk_low_Pa"],
        air_bulk_high=machine["effects.air_bulk_high_Pa"],
        air_pressure=machine["effects.air_pressure_Pa"],
        supply_sag=machine["effects.supply_sag_Pa_s_m3"],
    )


@inlined
def signed_root(x: float) -> float:
    """Square root of a pressure drop, odd: flow turns round when the drop does."""
    size = abs(x)
    if size >= _ROOT_BLEND_PA:
        return math.copysign(math.sqrt(size), x)
    ratio = x / _ROOT_BLEND_PA
    return math.sqrt(_ROOT_BLEND_PA) * ratio * (1.25 - 0.25 * ratio * ratio)


@inlined
def stop_torque(q: float, w: float, i: int, p: PlantParameters) -> float:
    """Torque of the stops of joint ``i``, N m; they push, they never hold."""
    if q >= p.q_low[i] and q <= p.q_high[i]:
        return 0.0
    lever_squared = 1.0 / (p.lever_inverse[i] * p.lever_inverse[i])
    stiffness, damping = _STOP_STIFFNESS_N_M * lever_squared, _STOP_DAMPING_NS_M * lever_squared
    if q < p.q_low[i]:
        return max(stiffness * (p.q_low[i] - q) - damping * w, 0.0)
    return min(stiffness * (p.q_high[i] - q) - damping * w, 0.0)


@inlined
def bulk_modulus(pressure: float, p: PlantParameters) -> float:
    """Bulk modulus, Pa: constant, or falling towards low pressure where air is dissolved in the oil."""
    if p.air_bulk_low <= 0.0:
        return p.bulk_modulus
    share = max(pressure, 0.0) / (max(pressure, 0.0) + p.air_pressure)
    return p.air_bulk_low + (p.air_bulk_high - p.air_bulk_low) * share


@inlined
def friction_torque(w: float, lever: float, i: int, p: PlantParameters) -> float:
    """Friction of joint ``i`` at rate ``w``, N m: viscous, Coulomb, and a Stribeck peak at low speed."""
    ratio = lever * p.lever_inverse[i] if p.friction_at_cylinder > 0.5 else 1.0
    coulomb = p.fc[i]
    if p.stribeck > 0.0:
        slow = ratio * w / p.stribeck_rate
        coulomb *= 1.0 + p.stribeck * math.exp(-slow * slow)
    sign = (2.0 / math.pi) * math.atan(p.coulomb_slope * w)
    return ratio * (ratio * p.fv[i] * w + coulomb * sign)


class Crank(NamedTuple):
    """One joint's cylinder at an angle: piston position, m, lever arm, m/rad, and the arm's two derivatives."""

    x: float
    lever: float
    lever1: float
    lever2: float


@inlined
def crank_at(q: float, i: int, p: PlantParameters) -> Crank:
    """The cylinder of joint ``i`` at angle ``q``."""
    triangle = q + p.q0[i]
    sine, cosine = p.crank_ab[i] * math.sin(triangle), p.crank_ab[i] * math.cos(triangle)
    length = math.sqrt(p.crank_a2_b2[i] - 2.0 * cosine)
    inverse = 1.0 / length
    lever = sine * inverse
    lever1 = (cosine - lever * lever) * inverse
    return Crank(length - p.x_offset[i], lever, lever1, -lever * (1.0 + 3.0 * lever1 * inverse))


@inlined
def joint_rates(
    i: int, q: float, w: float, p1: float, p2: float, xv: float, x: float, lever: float, p: PlantParameters
) -> tuple[float, float, float]:
    """Torque of cylinder, friction and stops of joint ``i``, N m, and rates of its two pressures, Pa/s.

    Parameters
    ----------
    i : int
        0 swing, 1 wrist.
    q, w : float
        Angle, rad, and rate, rad/s.
    p1, p2 : float
        Bore and annulus pressure, Pa.
    xv : float
        Spool.
    x, lever : float
        Piston position, m, and lever arm, m/rad, at ``q``.
    p : PlantParameters
        The arm.
    """
    x_rate = lever * w
    x_inside = min(max(x, 0.0), p.stroke[i])
    volume1 = p.dead_volume[i] + p.area1[i] * x_inside
    volume2 = p.dead_volume[i] + p.area2[i] * (p.stroke[i] - x_inside)
    opening = p.kv[i] * (xv - min(max(xv, -p.overlap[i]), p.overlap[i]))
    extends = opening >= 0.0
    into, out_of = (p1, p2) if extends else (p2, p1)
    supply = p.p_supply
    if p.supply_sag > 0.0:
        supply -= p.supply_sag * abs(opening) * signed_root(supply - into)
    root_in, root_out = signed_root(supply - into), signed_root(out_of - p.p_tank)
    flow1, flow2 = opening * (root_in if extends else root_out), opening * (root_out if extends else root_in)
    leak = p.leakage[i] * (p1 - p2)
    p1_rate = bulk_modulus(p1, p) / volume1 * (-p.area1[i] * x_rate + flow1 - leak)
    p2_rate = bulk_modulus(p2, p) / volume2 * (p.area2[i] * x_rate - flow2 + leak)
    if p1 <= 0.0:  # dry: vapour fills what the oil leaves
        p1_rate = max(p1_rate, 0.0)
    if p2 <= 0.0:
        p2_rate = max(p2_rate, 0.0)
    force = p1 * p.area1[i] - p2 * p.area2[i]
    torque = lever * force - friction_torque(w, lever, i, p) + stop_torque(q, w, i, p)
    return torque, p1_rate, p2_rate


@inlined
def link_rates(
    s: float, c: float, w1: float, w2: float, torque_1: float, torque_2: float, load_kg: float, p: PlantParameters
) -> tuple[float, float]:
    """Accelerations of the links, rad/s^2, for sine and cosine of the wrist angle."""
    r = p.L1 + p.L2 * c
    h11 = p.I1 + p.m2 * p.L1 * r + p.J * c * c + load_kg * r * r
    h22 = p.J + load_kg * p.L2 * p.L2
    h = -p.L2 * s * (p.m2 * p.L1 + 2.0 * load_kg * r) - 2.0 * p.J * c * s
    return (
        (torque_1 - h * w1 * w2) / h11,
        (torque_2 + 0.5 * h * w1 * w1 - p.g * p.L2 * c * (0.5 * p.m2 + load_kg)) / h22,
    )


@compiled
def derivative(y: np.ndarray, u: np.ndarray, load_kg: float, p: PlantParameters, dy: np.ndarray) -> None:
    """Right-hand side of the plant.

    Parameters
    ----------
    y : np.ndarray
        State, shape (12,).
    u : np.ndarray
        Spool set-points, shape (2,), -1..1.
    load_kg : float
        Point load at the wrist's tip.
    p : PlantParameters
        The arm.
    dy : np.ndarray
        Written: dy/dt, shape (12,).
    """
    torques = (0.0, 0.0)
    for i in range(2):
        crank = crank_at(y[Q + i], i, p)
        p1, p2 = y[P_SWING + 2 * i], y[P_SWING + 2 * i + 1]
        torque, dy[P_SWING + 2 * i], dy[P_SWING + 2 * i + 1] = joint_rates(
            i, y[Q + i], y[W + i], p1, p2, y[XV + i], crank.x, crank.lever, p
        )
        torques = (torques[1], torque)
        dy[XV + i] = y[XV_RATE + i]
        dy[XV_RATE + i] = (
            p.valve_w[i] * p.valve_w[i] * (u[i] - y[XV + i]) - 2.0 * p.valve_damping[i] * p.valve_w[i] * y[XV_RATE + i]
        )
    dy[Q], dy[Q + 1] = y[W], y[W + 1]
    dy[W], dy[W + 1] = link_rates(
        math.sin(y[Q + 1]), math.cos(y[Q + 1]), y[W], y[W + 1], torques[0], torques[1], load_kg, p
    )


class Stage(NamedTuple):
    """What changes within a step, or its rates: turned by since its start, rates, pressures; swing, then wrist."""

    d1: float
    d2: float
    w1: float
    w2: float
    bore1: float
    annulus1: float
    bore2: float
    annulus2: float


@inlined
def moved(a: Stage, h: float, k: Stage) -> Stage:
    """``a + h k``."""
    return Stage(
        a.d1 + h * k.d1,
        a.d2 + h * k.d2,
        a.w1 + h * k.w1,
        a.w2 + h * k.w2,
        a.bore1 + h * k.bore1,
        a.annulus1 + h * k.annulus1,
        a.bore2 + h * k.bore2,
        a.annulus2 + h * k.annulus2,
    )


class Pose(NamedTuple):
    """The geometry at a step's start."""

    q1: float
    q2: float
    swing: Crank
    wrist: Crank
    s2: float
    c2: float


@inlined
def pose_at(q1: float, q2: float, p: PlantParameters) -> Pose:
    """The geometry at two angles."""
    return Pose(q1, q2, crank_at(q1, 0, p), crank_at(q2, 1, p), math.sin(q2), math.cos(q2))


@inlined
def turned(crank: Crank, d: float) -> tuple[float, float]:
    """Piston position and lever arm, ``d`` rad on: by Taylor's series, to the third and second power."""
    x = crank.x + d * (crank.lever + d * (0.5 * crank.lever1 + d * (1.0 / 6.0) * crank.lever2))
    return x, crank.lever + d * (crank.lever1 + d * 0.5 * crank.lever2)


@inlined
def stage_rates(a: Stage, xv1: float, xv2: float, pose: Pose, load_kg: float, p: PlantParameters) -> Stage:
    """Rates of all but the spools, near a pose."""
    x1, lever1 = turned(pose.swing, a.d1)
    x2, lever2 = turned(pose.wrist, a.d2)
    torque1, bore1, annulus1 = joint_rates(0, pose.q1 + a.d1, a.w1, a.bore1, a.annulus1, xv1, x1, lever1, p)
    torque2, bore2, annulus2 = joint_rates(1, pose.q2 + a.d2, a.w2, a.bore2, a.annulus2, xv2, x2, lever2, p)
    cosine, sine = 1.0 - 0.5 * a.d2 * a.d2, a.d2 - a.d2 * a.d2 * a.d2 * (1.0 / 6.0)
    w1, w2 = link_rates(
        pose.s2 * cosine + pose.c2 * sine,
        pose.c2 * cosine - pose.s2 * sine,
        a.w1,
        a.w2,
        torque1,
        torque2,
        load_kg,
        p,
    )
    return Stage(a.w1, a.w2, w1, w2, bore1, annulus1, bore2, annulus2)


class Response(NamedTuple):
    """What a spool's distance from its set-point, and its rate, become of both in some time: a matrix."""

    zz: float
    zv: float
    vz: float
    vv: float


@inlined
def spool_response(t: float, w: float, damping: float) -> Response:
    """The response after ``t`` of a spool of natural frequency ``w``, rad/s: the exponential of its equations."""
    decay = damping * w
    square = w * w * (damping * damping - 1.0)
    if square < 0.0:
        root = math.sqrt(-square)
        c, s = math.cos(root * t), math.sin(root * t) / root
    elif square > 0.0:
        root = math.sqrt(square)
        c, s = math.cosh(root * t), math.sinh(root * t) / root
    else:
        c, s = 1.0, t
    shrink = math.exp(-decay * t)
    c, s = shrink * c, shrink * s
    return Response(c + decay * s, s, -w * w * s, c - decay * s)


class Spool(NamedTuple):
    """One spool at the beginning, in the middle and at the end of a step: position and rate."""

    x0: float
    v0: float
    x1: float
    v1: float
    x2: float
    v2: float


@inlined
def spool_over(x: float, v: float, u: float, half: Response) -> Spool:
    """A spool over two halves of a step, on its way to ``u``."""
    z = x - u
    z1, v1 = half.zz * z + half.zv * v, half.vz * z + half.vv * v
    z2, v2 = half.zz * z1 + half.zv * v1, half.vz * z1 + half.vv * v1
    return Spool(x, v, u + z1, v1, u + z2, v2)


@inlined
def zero_of(a: float, a_rate: float, b: float, b_rate: float, h: float) -> float:
    """When what is ``a`` and then, ``h`` later, ``b`` of the other sign passes 0: the zero of Hermite's cubic."""
    low, high, t = 0.0, 1.0, a / (a - b)
    c1 = h * a_rate
    c2, c3 = 3.0 * (b - a) - h * (2.0 * a_rate + b_rate), h * (a_rate + b_rate) - 2.0 * (b - a)
    for _ in range(4):
        value = a + t * (c1 + t * (c2 + t * c3))
        slope = c1 + t * (2.0 * c2 + t * 3.0 * c3)
        if value * a > 0.0:
            low = t
        else:
            high = t
        t = t - value / slope if slope != 0.0 else low
        if not low < t < high:
            t = 0.5 * (low + high)
    return t * h


@inlined
def spool_passes(spool: Spool, edge: float, h: float) -> float:
    """When the spool passes an edge of its valve within a step ``h``; ``h`` when it does not.

    Passing within a few millionths of the step's ends counts as not passing: there is no kink to speak of.
    """
    a, b, c = spool.x0 - edge, spool.x1 - edge, spool.x2 - edge
    side = a if abs(a) > _ON_THE_EDGE else spool.v0
    if (side * c >= 0.0 and side * b >= 0.0) or (abs(a) <= _ON_THE_EDGE and abs(c) <= _ON_THE_EDGE):
        return h
    if side * b < 0.0:
        return zero_of(a, spool.v0, b, spool.v1, 0.5 * h) if a * b < 0.0 else h
    return 0.5 * h + zero_of(b, spool.v1, c, spool.v2, 0.5 * h) if b * c < 0.0 else h


@inlined
def first_kink(swing: Spool, wrist: Spool, h: float, p: PlantParameters) -> float:
    """When the first spool passes an edge of its valve within a step ``h``; ``h`` when none does."""
    first = (1.0 - _NEAR_THE_END) * h
    for i in range(2):
        spool = swing if i == 0 else wrist
        for side in range(2):
            t = spool_passes(spool, p.overlap[i] if side == 0 else -p.overlap[i], h)
            if _NEAR_THE_END * h < t < first:
                first = t
            if p.overlap[i] == 0.0:
                break
    return first if first < (1.0 - _NEAR_THE_END) * h else h


@inlined
def first_impact(a: Stage, ra: Stage, b: Stage, rb: Stage, q1: float, q2: float, h: float, p: PlantParameters) -> float:
    """When within a step ``h`` a chamber runs dry or a joint meets a stop; ``h`` when nothing does.

    Parameters
    ----------
    a, ra : Stage
        State and rates at the step's start.
    b, rb : Stage
        The same at its end, without the event.
    q1, q2 : float
        Angles at its start.
    h : float
        The step, s.
    p : PlantParameters
        The arm.
    """
    first = h
    before = (a.bore1, a.annulus1, a.bore2, a.annulus2)
    rate_before = (ra.bore1, ra.annulus1, ra.bore2, ra.annulus2)
    after = (b.bore1, b.annulus1, b.bore2, b.annulus2)
    rate_after = (rb.bore1, rb.annulus1, rb.bore2, rb.annulus2)
    for n in range(4):
        if before[n] > 0.0 and after[n] < 0.0:
            first = min(first, zero_of(before[n], rate_before[n], after[n], rate_after[n], h))
    angle, turn, rate, rate_end = (q1, q2), (b.d1, b.d2), (a.w1, a.w2), (b.w1, b.w2)
    for i in range(2):
        for side in range(2):
            room = (angle[i] - p.q_low[i]) if side == 0 else (p.q_high[i] - angle[i])
            sign = 1.0 if side == 0 else -1.0
            if room > 0.0 and room + sign * turn[i] < 0.0:
                first = min(first, zero_of(room, sign * rate[i], room + sign * turn[i], sign * rate_end[i], h))
    return first


@inlined
def outside(b: Stage, q1: float, q2: float, p: PlantParameters) -> bool:
    """True when a chamber has run dry or a joint is beyond a stop."""
    return (
        min(b.bore1, b.annulus1, b.bore2, b.annulus2) < 0.0
        or q1 + b.d1 < p.q_low[0]
        or q1 + b.d1 > p.q_high[0]
        or q2 + b.d2 < p.q_low[1]
        or q2 + b.d2 > p.q_high[1]
    )


@inlined
def nearest_to_zero(a: float, change: float) -> float:
    """The least size of what goes from ``a`` to ``a + change``."""
    b = a + change
    return 0.0 if a * b < 0.0 else min(abs(a), abs(b))


@inlined
def fastest_rate(
    a: Stage, k: Stage, spools: tuple[float, float], pose: Pose, h: float, load_kg: float, p: PlantParameters
) -> float:
    """How fast, 1/s, the fastest of friction's bend, open ports' pressures and their drops changes in the next ``h``.

    Parameters
    ----------
    a, k : Stage
        State and rates.
    spools : tuple of float
        Largest opening of each within ``h``.
    pose : Pose
        The geometry.
    h : float
        How far to look, s.
    load_kg : float
        Load.
    p : PlantParameters
        The arm.
    """
    r = p.L1 + p.L2 * pose.c2
    inertia = (
        p.I1 + p.m2 * p.L1 * r + p.J * pose.c2 * pose.c2 + load_kg * r * r,
        p.J + load_kg * p.L2 * p.L2,
    )
    cranks, w, w_rate = (pose.swing, pose.wrist), (a.w1, a.w2), (k.w1, k.w2)
    bore, bore_rate = (a.bore1, a.bore2), (k.bore1, k.bore2)
    annulus, annulus_rate = (a.annulus1, a.annulus2), (k.annulus1, k.annulus2)
    stiffest = max(p.bulk_modulus, p.air_bulk_high)
    fastest = 0.0
    for i in range(2):
        bend = p.coulomb_slope * nearest_to_zero(w[i], h * w_rate[i])
        friction = p.fv[i] + (2.0 / math.pi) * p.fc[i] * (1.0 + p.stribeck) * p.coulomb_slope / (1.0 + bend * bend)
        fastest = max(fastest, friction / inertia[i])
        x = min(max(cranks[i].x, 0.0), p.stroke[i])
        volume = min(p.dead_volume[i] + p.area1[i] * x, p.dead_volume[i] + p.area2[i] * (p.stroke[i] - x))
        into, into_rate = (bore[i], bore_rate[i]) if spools[i] >= 0.0 else (annulus[i], annulus_rate[i])
        out, out_rate = (annulus[i], annulus_rate[i]) if spools[i] >= 0.0 else (bore[i], bore_rate[i])
        drop = min(nearest_to_zero(p.p_supply - into, -h * into_rate), nearest_to_zero(out - p.p_tank, h * out_rate))
        port = stiffest * p.kv[i] * abs(spools[i]) / (2.0 * volume)
        drop = max(drop, 0.64 * _ROOT_BLEND_PA)
        fastest = max(fastest, port / math.sqrt(drop))
        if abs(spools[i]) > p.overlap[i]:  # the root of a pressure drop that changes by itself is no polynomial
            fastest = max(fastest, max(abs(into_rate), abs(out_rate)) / drop)
    return fastest


@inlined
def runge_kutta(
    a: Stage, k1: Stage, swing: Spool, wrist: Spool, pose: Pose, load_kg: float, p: PlantParameters, h: float
) -> tuple[Stage, Stage]:
    """The state after a classic Runge-Kutta step from ``a``, whose rates are ``k1``, and rates near its end."""
    k2 = stage_rates(moved(a, 0.5 * h, k1), swing.x1, wrist.x1, pose, load_kg, p)
    k3 = stage_rates(moved(a, 0.5 * h, k2), swing.x1, wrist.x1, pose, load_kg, p)
    k4 = stage_rates(moved(a, h, k3), swing.x2, wrist.x2, pose, load_kg, p)
    return moved(moved(moved(moved(a, h / 6.0, k1), h / 3.0, k2), h / 3.0, k3), h / 6.0, k4), k4


@inlined
def settled(pressure: float) -> float:
    """A pressure after a step: a chamber that has just run dry holds vapour at 0."""
    return pressure if pressure > _DRY_PA else 0.0


@compiled
def integrate(
    y: np.ndarray, u: np.ndarray, load_kg: float, p: PlantParameters, duration_s: float, scratch: np.ndarray
) -> None:
    """Advance the state with constant inputs.

    Classic Runge-Kutta steps, in which the spools move by their exact solution and the cranks' geometry is a
    Taylor series about the step's start. A step ends where a spool passes an edge of its valve, a chamber runs dry
    or a joint meets a stop, so that within a step everything is smooth.

    Parameters
    ----------
    y : np.ndarray
        State, shape (12,); advanced in place.
    u : np.ndarray
        Spool set-points, shape (2,).
    load_kg : float
        Load.
    p : PlantParameters
        The arm.
    duration_s : float
        How far; the step is the longest fraction of it that ``LONGEST_STEP_S`` allows.
    scratch : np.ndarray
        Work space, shape (5, 12), zeros at first: keeps the spools' response of the step before.
    """
    steps = math.ceil(duration_s / LONGEST_STEP_S - 1e-9)
    if steps <= 0:
        return
    h = duration_s / steps
    w1, w2, damping1, damping2 = p.valve_w[0], p.valve_w[1], p.valve_damping[0], p.valve_damping[1]
    m = scratch[0]
    key = scratch[1]
    if key[0] != h or key[1] != w1 or key[2] != w2 or key[3] != damping1 or key[4] != damping2:
        key[0], key[1], key[2], key[3], key[4] = h, w1, w2, damping1, damping2
        m[0], m[1], m[2], m[3] = spool_response(0.5 * h, w1, damping1)
        m[4], m[5], m[6], m[7] = spool_response(0.5 * h, w2, damping2)
    regular1, regular2 = Response(m[0], m[1], m[2], m[3]), Response(m[4], m[5], m[6], m[7])
    for _ in range(steps):
        left, now = h, h
        half1, half2 = regular1, regular2
        may_divide, fresh = _EVENTS_MOST, True
        a = Stage(0.0, 0.0, y[W], y[W + 1], y[4], y[5], y[6], y[7])
        pose = pose_at(y[Q], y[Q + 1], p)
        k1 = stage_rates(a, y[XV], y[XV + 1], pose, load_kg, p)
        while True:
            swing = spool_over(y[XV], y[XV_RATE], u[0], half1)
            wrist = spool_over(y[XV + 1], y[XV_RATE + 1], u[1], half2)
            if fresh:
                fresh = False
                open1 = swing.x0 if abs(swing.x0) > abs(swing.x2) else swing.x2
                open2 = wrist.x0 if abs(wrist.x0) > abs(wrist.x2) else wrist.x2
                fastest = fastest_rate(a, k1, (open1, open2), pose, now, load_kg, p)
                if fastest * now > _DECAY_A_STEP:
                    now = now / min(math.ceil(fastest * now / _DECAY_A_STEP), _PARTS_MOST)
                    half1, half2 = spool_response(0.5 * now, w1, damping1), spool_response(0.5 * now, w2, damping2)
                    continue
            if may_divide > 0:
                may_divide -= 1
                until = first_kink(swing, wrist, now, p)
                if until >= now:
                    b, kb = runge_kutta(a, k1, swing, wrist, pose, load_kg, p, now)
                    if outside(b, y[Q], y[Q + 1], p):
                        until = first_impact(a, k1, b, kb, y[Q], y[Q + 1], now, p)
                        if not _NEAR_THE_END * now < until < (1.0 - _NEAR_THE_END) * now:
                            until = now
                if until < now:
                    now = until
                    half1, half2 = spool_response(0.5 * now, w1, damping1), spool_response(0.5 * now, w2, damping2)
                    continue
            else:
                b, kb = runge_kutta(a, k1, swing, wrist, pose, load_kg, p, now)
            y[Q] += b.d1
            y[Q + 1] += b.d2
            y[W], y[W + 1] = b.w1, b.w2
            y[4], y[5], y[6], y[7] = settled(b.bore1), settled(b.annulus1), settled(b.bore2), settled(b.annulus2)
            y[XV], y[XV + 1], y[XV_RATE], y[XV_RATE + 1] = swing.x2, wrist.x2, swing.v2, wrist.v2
            left -= now
            if left <= 1e-9 * h:
                break
            now, fresh = left, True
            half1, half2 = spool_response(0.5 * now, w1, damping1), spool_response(0.5 * now, w2, damping2)
            a = Stage(0.0, 0.0, y[W], y[W + 1], y[4], y[5], y[6], y[7])
            pose = pose_at(y[Q], y[Q + 1], p)
            k1 = stage_rates(a, y[XV], y[XV + 1], pose, load_kg, p)


@compiled
def rest(q: np.ndarray, load_kg: float, p: PlantParameters, y: np.ndarray) -> int:
    """Write the state at rest: spools centred, the load held by pressure, bore and annulus adding to supply and tank.

    Parameters
    ----------
    q : np.ndarray
        Angles, rad, shape (2,).
    load_kg : float
        Load.
    p : PlantParameters
        The arm.
    y : np.ndarray
        Written: the state, shape (12,).

    Returns
    -------
    int
        -1, or the joint whose cylinder cannot hold the load between tank and supply pressure.
    """
    y[:] = 0.0
    total = p.p_supply + p.p_tank
    for i in range(2):
        triangle = q[i] + p.q0[i]
        lever = (
            p.crank_ab[i] * math.sin(triangle) / math.sqrt(p.crank_a2_b2[i] - 2.0 * p.crank_ab[i] * math.cos(triangle))
        )
        torque = 0.0 if i == 0 else p.g * p.L2 * math.cos(q[1]) * (0.5 * p.m2 + load_kg)
        bore = (torque / lever + total * p.area2[i]) / (p.area1[i] + p.area2[i])
        y[Q + i] = q[i]
        y[P_SWING + 2 * i] = bore
        y[P_SWING + 2 * i + 1] = total - bore
    for i in range(2):
        for k in range(2):
            if not p.p_tank < y[P_SWING + 2 * i + k] < p.p_supply:
                return i
    return -1


def state_at_rest(parameters: PlantParameters, q: np.ndarray, load_kg: float) -> np.ndarray:
    """State at rest at angles ``q`` (rad, shape (2,)), spools centred, the load held by pressure.

    Raises
    ------
    ValueError
        When a cylinder cannot hold the load between tank and supply pressure; names the joint.
    """
    y = np.zeros(STATES)
    joint = rest(np.asarray(q, dtype=np.float64), float(load_kg), parameters, y)
    if joint >= 0:
        raise ValueError(f"the {JOINT_NAMES[joint]} cylinder cannot hold {load_kg:g} kg at {q[joint]:g} rad")
    return y


def holding_pressures(parameters: PlantParameters, q: np.ndarray, load_kg: float) -> np.ndarray:
    """Pressures of :func:`state_at_rest`, shape (2, 2): joint, then bore and annulus."""
    return state_at_rest(parameters, q, load_kg)[P_SWING:XV].reshape(2, 2)
