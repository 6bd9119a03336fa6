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

from sil_plant.compiled import inlined
from sil_plant.machine import JOINT_NAMES, Machine

STATES = 12
Q, W, P_SWING, P_WRIST, XV, XV_RATE = 0, 2, 4, 6, 8, 10

# Longest step of the integrator; tests hold the accuracy that follows from it.
LONGEST_STEP_S = 2.5e-4

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
    lever_squared = 1.0 / (p.lever_inverse[i] * p.lever_inverse[i])
    stiffness, damping = _STOP_STIFFNESS_N_M * lever_squared, _STOP_DAMPING_NS_M * lever_squared
    if q < p.q_low[i]:
        return max(stiffness * (p.q_low[i] - q) - damping * w, 0.0)
    if q > p.q_high[i]:
        return min(stiffness * (p.q_high[i] - q) - damping * w, 0.0)
    return 0.0


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


@inlined
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
    q2, w1, w2 = y[1], y[2], y[3]
    torque_1 = torque_2 = 0.0
    for i in range(2):
        w = y[W + i]
        p1, p2 = y[P_SWING + 2 * i], y[P_SWING + 2 * i + 1]
        xv, xv_rate = y[XV + i], y[XV_RATE + i]
        triangle = y[Q + i] + p.q0[i]
        length = math.sqrt(p.crank_a2_b2[i] - 2.0 * p.crank_ab[i] * math.cos(triangle))
        lever = p.crank_ab[i] * math.sin(triangle) / length
        x = length - p.x_offset[i]
        x_rate = lever * w
        x_inside = min(max(x, 0.0), p.stroke[i])
        volume1 = p.dead_volume[i] + p.area1[i] * x_inside
        volume2 = p.dead_volume[i] + p.area2[i] * (p.stroke[i] - x_inside)
        opening = xv - min(max(xv, -p.overlap[i]), p.overlap[i])
        if opening >= 0.0:
            supply = p.p_supply - p.supply_sag * p.kv[i] * opening * signed_root(p.p_supply - p1)
            flow1 = p.kv[i] * opening * signed_root(supply - p1)
            flow2 = p.kv[i] * opening * signed_root(p2 - p.p_tank)
        else:
            supply = p.p_supply + p.supply_sag * p.kv[i] * opening * signed_root(p.p_supply - p2)
            flow1 = p.kv[i] * opening * signed_root(p1 - p.p_tank)
            flow2 = p.kv[i] * opening * signed_root(supply - p2)
        leak = p.leakage[i] * (p1 - p2)
        dy[P_SWING + 2 * i] = bulk_modulus(p1, p) / volume1 * (-p.area1[i] * x_rate + flow1 - leak)
        dy[P_SWING + 2 * i + 1] = bulk_modulus(p2, p) / volume2 * (p.area2[i] * x_rate - flow2 + leak)
        dy[XV + i] = xv_rate
        dy[XV_RATE + i] = p.valve_w[i] * p.valve_w[i] * (u[i] - xv) - 2.0 * p.valve_damping[i] * p.valve_w[i] * xv_rate
        force = p1 * p.area1[i] - p2 * p.area2[i]
        friction = friction_torque(w, lever, i, p)
        if i == 0:
            torque_1 = lever * force - friction + stop_torque(y[Q], w, i, p)
        else:
            torque_2 = lever * force - friction + stop_torque(y[Q + 1], w, i, p)
    s, c = math.sin(q2), math.cos(q2)
    r = p.L1 + p.L2 * c
    h11 = p.I1 + p.m2 * p.L1 * r + p.J * c * c + load_kg * r * r
    h22 = p.J + load_kg * p.L2 * p.L2
    h = -p.L2 * s * (p.m2 * p.L1 + 2.0 * load_kg * r) - 2.0 * p.J * c * s
    dy[0], dy[1] = w1, w2
    dy[2] = (torque_1 - h * w1 * w2) / h11
    dy[3] = (torque_2 + 0.5 * h * w1 * w1 - p.g * p.L2 * c * (0.5 * p.m2 + load_kg)) / h22


@inlined
def integrate(
    y: np.ndarray, u: np.ndarray, load_kg: float, p: PlantParameters, duration_s: float, scratch: np.ndarray
) -> None:
    """Advance the state with constant inputs by classic Runge-Kutta steps of equal length.

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
        Work space, shape (5, 12).
    """
    steps = math.ceil(duration_s / LONGEST_STEP_S - 1e-9)
    if steps <= 0:
        return
    h = duration_s / steps
    k1, k2, k3, k4, z = scratch[0], scratch[1], scratch[2], scratch[3], scratch[4]
    for _ in range(steps):
        derivative(y, u, load_kg, p, k1)
        for n in range(STATES):
            z[n] = y[n] + 0.5 * h * k1[n]
        derivative(z, u, load_kg, p, k2)
        for n in range(STATES):
            z[n] = y[n] + 0.5 * h * k2[n]
        derivative(z, u, load_kg, p, k3)
        for n in range(STATES):
            z[n] = y[n] + h * k3[n]
        derivative(z, u, load_kg, p, k4)
        for n in range(STATES):
            y[n] += h / 6.0 * (k1[n] + 2.0 * (k2[n] + k3[n]) + k4[n])
        for n in range(P_SWING, XV):  # a chamber that runs dry holds vapour at about 0
            if y[n] < 0.0:
                y[n] = 0.0


def holding_pressures(parameters: PlantParameters, q: np.ndarray, load_kg: float) -> np.ndarray:
    """Pressures that hold the arm at rest, shape (2, 2): joint, then bore and annulus.

    Their sum is supply plus tank, as with a spool centred at rest.

    Raises
    ------
    ValueError
        When a cylinder cannot hold the load between tank and supply pressure; names the joint.
    """
    p = parameters
    triangle = q + p.q0
    lever = p.crank_ab * np.sin(triangle) / np.sqrt(p.crank_a2_b2 - 2.0 * p.crank_ab * np.cos(triangle))
    torque = np.array([0.0, p.g * p.L2 * math.cos(q[1]) * (0.5 * p.m2 + load_kg)])
    force = torque / lever
    total = p.p_supply + p.p_tank
    bore = (force + total * p.area2) / (p.area1 + p.area2)
    pressures = np.column_stack([bore, total - bore])
    for joint, name in enumerate(JOINT_NAMES):
        if not np.all((pressures[joint] > p.p_tank) & (pressures[joint] < p.p_supply)):
            raise ValueError(f"the {name} cylinder cannot hold {load_kg:g} kg at {q[joint]:g} rad")
    return pressures


def state_at_rest(parameters: PlantParameters, q: np.ndarray, load_kg: float) -> np.ndarray:
    """State at rest at angles ``q`` (rad, shape (2,)), spools centred, the load held by pressure."""
    y = np.zeros(STATES)
    y[:2] = q
    y[P_SWING:XV] = holding_pressures(parameters, q, load_kg).ravel()
    return y
