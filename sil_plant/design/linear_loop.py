"""The closed loop of one joint, linearised at rest: how far it is from ringing.

One tick of plant and law is a linear map of one state vector: angle, rate, cylinder force, spool and its rate, the
observer's two states, gamma1 and gamma2, and the set-points that are still on their way. The loop is stable while no
eigenvalue of that map is outside the unit circle. The margin is how many times more (and less) the valve may pass than
the law believes before one is.

Left out: Coulomb friction and the flow's own damping (they only help), leakage, and the estimator, which is slow beside
the law. The PID baseline lives on just that damping, so that nothing is said about it here: tools/tune_pid.py.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.linalg import expm

from sil_plant.inputs.machine import JOINT_NAMES, Machine
from sil_plant.plant.statics import cylinder_of, inertia

PERIOD_S = 1e-3
MOST = 8.0  # margins beyond this are not looked for
_STEPS = 40  # of the search, each way
_PLANT = 5  # q, w, F, spool, its rate


class LoopGains(NamedTuple):
    """What the law's linear part needs, machine file units."""

    observer: float
    k1: float
    k2: float
    k3: float
    kappa1: float
    kappa2: float
    w1_over_w2: float
    k2s1: float
    k2s2: float
    spool_lead: float


class Joint(NamedTuple):
    """One joint at one place with one load, SI."""

    R: float
    H: float
    lamA: float
    bulk: float
    fv: float
    valve_w: float
    valve_damping: float
    valve_gain: float  # QL per unit opening, m^2/s
    delay: float


@dataclass(frozen=True)
class Margin:
    """How far a loop is from its limit.

    Attributes
    ----------
    up, down : float
        The factors on the valve's flow at which it rings; ``MOST`` and its inverse when not found before.
    stable : bool
        As it is.
    """

    up: float
    down: float
    stable: bool


def loop_gains(machine: Machine, joint: int) -> LoopGains:
    """The gains of a machine file; the robust terms at their bounds, where the loop is tightest."""
    name = JOINT_NAMES[joint]
    return LoopGains(
        machine["control.observer_rad_s"],
        *(
            machine[f"control.{name}.{key}"]
            for key in (
                "k1_1_s",
                "k2_1_s",
                "k3_1_s",
                "kappa1_1_s2",
                "kappa2_1_s2",
                "w1_over_w2_m",
                "k2s1_max_1_s",
                "k2s2_max_1_s",
                "spool_lead",
            )
        ),
    )


def joint_at(machine: Machine, joint: int, q: float, q2: float, load_kg: float) -> Joint:
    """A joint of a machine at one place; the valve's gain is that of pressures half way."""
    name = JOINT_NAMES[joint]
    c = cylinder_of(machine, joint)
    volume1, volume2 = c.volumes(q)
    drop = 0.5 * (machine["supply.pressure_Pa"] - machine["supply.tank_Pa"])
    return Joint(
        R=float(c.lever(q)),
        H=float(inertia(machine, joint, q2, load_kg)),
        lamA=float(c.stiffness(q)),
        bulk=1.0 / machine["estimator.prior.beta_inverse_1_Pa.value"],
        fv=machine[f"{name}.viscous_Nms_rad"],
        valve_w=2.0 * math.pi * machine[f"{name}.valve_frequency_Hz"],
        valve_damping=machine[f"{name}.valve_damping"],
        valve_gain=c.kv * math.sqrt(drop) * float(c.area1 / volume1 + c.area2 / volume2),
        delay=machine["io.command_delay_s"],
    )


def places(machine: Machine, joint: int, loads_kg: tuple[float, ...]) -> list[Joint]:
    """Both ends and the middle of the joint's range, each with each load; the wrist stretched out and raised."""
    q2_low, q2_high = machine["wrist.q_min_rad"], machine["wrist.q_max_rad"]
    c = cylinder_of(machine, joint)
    found = []
    for q in (c.q_min, 0.5 * (c.q_min + c.q_max), c.q_max):
        if joint == 1:
            others = [q]
        else:
            others = [min(max(0.0, q2_low), q2_high), max(q2_low, q2_high, key=abs)]
        found += [joint_at(machine, joint, float(q), q2, load) for q2 in others for load in loads_kg]
    return found


class Held(NamedTuple):
    """The plant over the two parts of a tick, before and after the set-point changes: state matrix, input column."""

    first: tuple[np.ndarray, np.ndarray]
    second: tuple[np.ndarray, np.ndarray]


@functools.lru_cache(maxsize=256)
def _held(joint: Joint) -> Held:
    """The plant with its set-point held; its spool counts in flow that the law knows of, see `tick_map`."""
    whole = np.zeros((_PLANT + 1, _PLANT + 1))
    whole[0, 1] = 1.0
    whole[1, 1], whole[1, 2] = -joint.fv / joint.H, joint.R / joint.H
    whole[2, 1] = -joint.bulk * joint.lamA * joint.R
    whole[2, 3] = joint.bulk * joint.valve_gain
    whole[3, 4] = 1.0
    whole[4, 3], whole[4, 4] = -(joint.valve_w**2), -2.0 * joint.valve_damping * joint.valve_w
    whole[4, _PLANT] = joint.valve_w**2
    rest_s = math.fmod(joint.delay + 1e-12, PERIOD_S)
    first, second = (expm(whole * duration_s) for duration_s in (rest_s, PERIOD_S - rest_s))
    return Held((first[:_PLANT, :_PLANT], first[:_PLANT, _PLANT]), (second[:_PLANT, :_PLANT], second[:_PLANT, _PLANT]))


@functools.cache
def _observer(bandwidth: float) -> tuple[float, float]:
    rho = math.exp(-bandwidth * PERIOD_S)
    return 1.0 - rho**2, (1.0 - rho) ** 2 / PERIOD_S


def _law(joint: Joint, gains: LoopGains, size: int, factor: float) -> tuple[np.ndarray, np.ndarray]:
    """The set-point as a row on the state at SYNC, and the law's states after the tick as rows."""
    unit = np.eye(size)
    q, force, spool = unit[0], unit[2], unit[3] / factor
    observed, observed_rate, gamma1, gamma2 = unit[_PLANT : _PLANT + 4]
    correct_error, correct_rate = _observer(gains.observer)
    predicted = observed + PERIOD_S * observed_rate
    innovation = q - predicted
    error_after = predicted + correct_error * innovation
    rate = observed_rate + correct_rate * innovation
    # as diarc.c: two_steps
    e2 = rate + gains.k1 * q
    wanted = -((gains.k2 + gains.k2s1) * joint.H * e2 + gamma1) / joint.R
    e2_rate = joint.R * force + gamma1 + gains.k1 * joint.H * rate
    wanted_rate = -(gains.kappa1 * joint.H * e2 + gains.k2 * e2_rate) / joint.R
    e3 = force - wanted
    flow = (
        joint.lamA * joint.R * rate
        + wanted_rate / joint.bulk
        - gains.w1_over_w2 * joint.R * e2
        - gamma2
        - (gains.k3 + gains.k2s2) / joint.bulk * e3
    )
    opening = flow / joint.valve_gain
    after = np.array(
        [
            error_after,
            rate,
            gamma1 + PERIOD_S * gains.kappa1 * joint.H * e2,
            gamma2 + PERIOD_S * gains.kappa2 / joint.bulk * e3,
        ]
    )
    return opening + gains.spool_lead * (opening - spool), after


def tick_map(joint: Joint, gains: LoopGains, factor: float = 1.0) -> np.ndarray:
    """One tick of the closed loop, from SYNC to SYNC.

    Parameters
    ----------
    joint : Joint
        The joint at its place.
    gains : LoopGains
        The law's.
    factor : float
        How much more the valve passes than the law believes.
    """
    whole_ticks = int((joint.delay + 1e-12) / PERIOD_S)
    old = whole_ticks + 1  # set-points on their way, newest first
    size = _PLANT + 4 + old
    # a valve that passes more is one whose set-point and spool are larger than the law believes
    command, law_after = _law(joint, gains, size, factor)
    (first_a, first_b), (second_a, second_b) = _held(joint)
    unit = np.eye(size)
    sent = [command, *unit[_PLANT + 4 :]]  # set-point of this tick, of the one before, ..
    after = first_a @ unit[:_PLANT] + np.outer(factor * first_b, sent[whole_ticks + 1])
    after = second_a @ after + np.outer(factor * second_b, sent[whole_ticks])
    return np.vstack([after, law_after, np.array(sent[:old])])


def _stable(joint: Joint, gains: LoopGains, factors: np.ndarray) -> np.ndarray:
    maps = np.array([tick_map(joint, gains, factor) for factor in factors])
    # an integrator that is switched off stays where it is, too
    radius = np.abs(np.linalg.eigvals(maps)).max(axis=1)
    return radius <= 1.0 + 1e-9


def margin_at(joint: Joint, gains: LoopGains) -> Margin:
    """The margin of a joint at one place."""
    steps = MOST ** (np.arange(_STEPS + 1) / _STEPS)
    if not _stable(joint, gains, steps[:1])[0]:
        return Margin(1.0, 1.0, False)
    up, down = 0, 0
    while up < _STEPS and _stable(joint, gains, steps[up + 1 : up + 2])[0]:
        up += 1
    while down < _STEPS and _stable(joint, gains, 1.0 / steps[down + 1 : down + 2])[0]:
        down += 1
    return Margin(float(steps[up]), float(1.0 / steps[down]), True)


def has_margin(
    machine: Machine, joint: int, gains: LoopGains, loads_kg: tuple[float, ...], down: float, up: float
) -> bool:
    """Whether a joint is stable everywhere at these factors on the valve's flow, and as it is."""
    factors = np.array([down, math.sqrt(down), 1.0, math.sqrt(up), up])
    return all(bool(_stable(place, gains, factors).all()) for place in places(machine, joint, loads_kg))


def least_margin(machine: Machine, joint: int, gains: LoopGains, loads_kg: tuple[float, ...]) -> Margin:
    """The smallest margins over the joint's places and loads."""
    found = [margin_at(place, gains) for place in places(machine, joint, loads_kg)]
    return Margin(min(m.up for m in found), max(m.down for m in found), all(m.stable for m in found))
