"""A machine's geometry, strength and demand without simulation: lever arms, volumes, forces, flow over a move.

All arrays hold one row per instant or angle, and swing, then wrist in the last axis where there are both. Equations
and symbols: docs/paper.md. Compression of the oil is left out of flow and pressures over a move; the spool's lag, too.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from sil_plant.inputs.machine import JOINT_NAMES, Machine
from sil_plant.inputs.scenario import Scenario, Segment, moves

STEP_S = 2e-3
REST_S = 0.1  # before and after the moves, in a motion
# Peaks of the septic point-to-point move: rate over distance/T, acceleration over distance/T^2.
PEAK_RATE, PEAK_ACCELERATION = 2.1875, 7.5132


class Cylinder(NamedTuple):
    """What geometry and oil need of one joint, SI."""

    a: float
    b: float
    q0: float
    q_min: float
    q_max: float
    margin: float
    area1: float
    area2: float
    dead_volume: float
    kv: float

    def length(self, q: np.ndarray | float) -> np.ndarray:
        """Length between the pins at joint angle ``q``."""
        return np.sqrt(self.a**2 + self.b**2 - 2.0 * self.a * self.b * np.cos(np.asarray(q) + self.q0))

    def lever(self, q: np.ndarray | float) -> np.ndarray:
        """Lever arm dX/dq, m/rad."""
        return self.a * self.b * np.sin(np.asarray(q) + self.q0) / self.length(q)

    @property
    def shortest(self) -> float:
        """Length between the pins, retracted."""
        return float(self.length(self.q_min)) - self.margin

    @property
    def stroke(self) -> float:
        """Of the cylinder, margins included."""
        return float(self.length(self.q_max) - self.length(self.q_min)) + 2.0 * self.margin

    def volumes(self, q: np.ndarray | float) -> tuple[np.ndarray, np.ndarray]:
        """Volumes of bore and annulus side, m^3."""
        x = self.length(q) - self.shortest
        return self.dead_volume + self.area1 * x, self.dead_volume + self.area2 * (self.stroke - x)

    def stiffness(self, q: np.ndarray | float) -> np.ndarray:
        """LamA = A1^2/V1 + A2^2/V2, m: spring rate over bulk modulus."""
        volume1, volume2 = self.volumes(q)
        return self.area1**2 / volume1 + self.area2**2 / volume2

    def angles(self, count: int = 121) -> np.ndarray:
        """Angles over the joint's range."""
        return np.linspace(self.q_min, self.q_max, count)


def cylinder_of(machine: Machine, joint: int) -> Cylinder:
    """The cylinder of joint 0 (swing) or 1 (wrist)."""
    name = JOINT_NAMES[joint]
    bore, rod = machine[f"{name}.bore_m"], machine[f"{name}.rod_m"]
    return Cylinder(
        a=machine[f"{name}.crank_a_m"],
        b=machine[f"{name}.crank_b_m"],
        q0=machine[f"{name}.crank_q0_rad"],
        q_min=machine[f"{name}.q_min_rad"],
        q_max=machine[f"{name}.q_max_rad"],
        margin=machine[f"{name}.end_margin_m"],
        area1=math.pi / 4.0 * bore**2,
        area2=math.pi / 4.0 * (bore**2 - rod**2),
        dead_volume=machine[f"{name}.dead_volume_m3"],
        kv=machine[f"{name}.valve_kv"],
    )


def stall_forces(machine: Machine, joint: int) -> tuple[float, float]:
    """Largest pull and push of a cylinder at rest between tank and supply pressure, N."""
    c = cylinder_of(machine, joint)
    supply, tank = machine["supply.pressure_Pa"], machine["supply.tank_Pa"]
    return tank * c.area1 - supply * c.area2, supply * c.area1 - tank * c.area2


def inertia(machine: Machine, joint: int, q2: np.ndarray | float, load_kg: float) -> np.ndarray:
    """H11 or H22 (Eq 2), kg m^2."""
    l1, l2 = machine["swing.link_length_m"], machine["wrist.link_length_m"]
    m2 = machine["wrist.mass_kg"]
    rod = machine["estimator.prior.J_kgm2.value"]
    c = np.cos(np.asarray(q2))
    if joint == 1:
        return rod + load_kg * l2**2 + 0.0 * c
    r = l1 + l2 * c
    return machine["arm.swing_inertia_kgm2"] + m2 * l1 * r + rod * c**2 + load_kg * r**2


def gravity_torque(machine: Machine, q2: np.ndarray | float, load_kg: float) -> np.ndarray:
    """What the wrist's cylinder holds up, N m."""
    arm = machine["arm.gravity_m_s2"] * machine["wrist.link_length_m"] * np.cos(np.asarray(q2))
    return arm * (0.5 * machine["wrist.mass_kg"] + load_kg)


def heaviest_held(machine: Machine) -> tuple[float, float]:
    """The heaviest load that the wrist holds at every angle of its range, kg, and the angle it is limited at.

    Negative where not even the link is held.
    """
    c = cylinder_of(machine, 1)
    q = c.angles()
    _, push = stall_forces(machine, 1)
    reach = machine["arm.gravity_m_s2"] * machine["wrist.link_length_m"] * np.cos(q)
    lifting = reach > 1e-6
    if not lifting.any():
        return math.inf, float(q[0])
    load = c.lever(q[lifting]) * push / reach[lifting] - 0.5 * machine["wrist.mass_kg"]
    worst = int(np.argmin(load))
    return float(load[worst]), float(q[lifting][worst])


def natural_frequency(machine: Machine, joint: int, q: np.ndarray | float, q2: float, load_kg: float) -> np.ndarray:
    """Hydraulic resonance sqrt(lamA R^2 be / H), Hz, with closed valve."""
    c = cylinder_of(machine, joint)
    bulk = 1.0 / machine["estimator.prior.beta_inverse_1_Pa.value"]
    spring = c.stiffness(q) * c.lever(q) ** 2 * bulk
    return np.sqrt(spring / inertia(machine, joint, q2 if joint == 0 else np.asarray(q), load_kg)) / (2.0 * math.pi)


@dataclass(frozen=True)
class Motion:
    """References over a scenario's moves; arrays of shape (n, 2)."""

    time_s: np.ndarray
    q: np.ndarray
    w: np.ndarray
    a: np.ndarray


def septic(distance: float, duration_s: float, t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Travel, rate and acceleration of one move, as the ECU's trajectory makes it."""
    tau = np.clip(t / duration_s, 0.0, 1.0)
    rest = 1.0 - tau
    s = tau**4 * (1.0 + rest * (4.0 + rest * (10.0 + 20.0 * rest)))
    ds = 140.0 * (tau * rest) ** 3
    dds = 420.0 * (tau * rest) ** 2 * (rest - tau)
    return distance * s, distance * ds / duration_s, distance * dds / duration_s**2


def motion_of(scenario: Scenario, step_s: float = STEP_S) -> Motion:
    """The references of every move of a scenario that starts within its run."""
    planned = moves(scenario)
    end = max((at + segment.duration_s for at, _, segment in planned), default=0.0)
    time_s = np.arange(-REST_S, end + REST_S, step_s)
    q = np.tile(np.array(scenario.start_pose_rad), (len(time_s), 1))
    w, a = np.zeros_like(q), np.zeros_like(q)
    where = list(scenario.start_pose_rad)
    for at, joint, segment in planned:
        travel, rate, acceleration = septic(segment.target_rad - where[joint], segment.duration_s, time_s - at)
        after = time_s >= at
        q[after, joint] = where[joint] + travel[after]
        w[after, joint], a[after, joint] = rate[after], acceleration[after]
        where[joint] = segment.target_rad
    return Motion(time_s, q, w, a)


def quickest(scenario: Scenario, joint: int) -> tuple[Segment, float] | None:
    """The segment of a joint with the highest peak rate, and that rate, rad/s; None if it never moves."""
    where, best = scenario.start_pose_rad[joint], None
    for _, which, segment in moves(scenario):
        if which == joint:
            rate = PEAK_RATE * abs(segment.target_rad - where) / segment.duration_s
            best = max(best or (segment, 0.0), (segment, rate), key=lambda pair: pair[1])
            where = segment.target_rad
    return best if best and best[1] > 0.0 else None


@dataclass(frozen=True)
class Demand:
    """What a motion asks of cylinders and valves with one load; arrays of shape (n, 2)."""

    load_kg: float
    torque: np.ndarray
    force: np.ndarray
    speed: np.ndarray  # of the piston, m/s
    room: np.ndarray  # force left for the flow's pressure drops, N; not positive: the cylinder is too weak
    opening: np.ndarray  # share of the spool's travel beyond the overlap; infinite where there is no room
    pressure: np.ndarray  # (n, 2, 2): joint, then bore and annulus, Pa; static at rest
    pump_flow: np.ndarray  # (n,), both cylinders together, m^3/s


def torques(machine: Machine, motion: Motion, load_kg: float) -> np.ndarray:
    """R F of both joints over a motion (Eq 1), N m."""
    l1, l2, m2 = machine["swing.link_length_m"], machine["wrist.link_length_m"], machine["wrist.mass_kg"]
    rod = machine["estimator.prior.J_kgm2.value"]
    q2 = motion.q[:, 1]
    s, c = np.sin(q2), np.cos(q2)
    h = -l2 * s * (m2 * l1 + 2.0 * load_kg * (l1 + l2 * c)) - 2.0 * rod * c * s
    w1, w2 = motion.w[:, 0], motion.w[:, 1]
    swing = inertia(machine, 0, q2, load_kg) * motion.a[:, 0] + h * w1 * w2
    wrist = inertia(machine, 1, q2, load_kg) * motion.a[:, 1] - 0.5 * h * w1**2 + gravity_torque(machine, q2, load_kg)
    torque = np.column_stack([swing, wrist])
    for joint in range(len(JOINT_NAMES)):
        torque[:, joint] += friction(machine, joint, motion.q[:, joint], motion.w[:, joint])
    return torque


def friction(machine: Machine, joint: int, q: np.ndarray, w: np.ndarray) -> np.ndarray:
    """Viscous and Coulomb friction of a joint, N m."""
    name = JOINT_NAMES[joint]
    c = cylinder_of(machine, joint)
    share = c.lever(q) / c.lever(0.0) if machine["arm.friction_at_cylinder"] > 0.5 else 1.0
    sign = 2.0 / math.pi * np.arctan(w / machine["arm.coulomb_rate_rad_s"])
    return share * (share * machine[f"{name}.viscous_Nms_rad"] * w + machine[f"{name}.coulomb_Nm"] * sign)


def demand(machine: Machine, motion: Motion, load_kg: float) -> Demand:
    """Forces, pressures, spool openings and pump flow that a motion asks for.

    A spool that moves a piston at speed v meters both sides: p1 = ps - (A1 v / kv u)^2 and
    p2 = pt + (A2 v / kv u)^2 when extending. Their force is F, so that

        u = v / kv sqrt((A1^3 + A2^3) / (ps A1 - pt A2 - F))

    and with the signs of retracting the same with F - pt A1 + ps A2 under the root.
    """
    supply, tank = machine["supply.pressure_Pa"], machine["supply.tank_Pa"]
    torque = torques(machine, motion, load_kg)
    force, speed, room = (np.zeros_like(torque) for _ in range(3))
    opening = np.zeros_like(torque)
    pressure = np.zeros((*torque.shape, 2))
    pump_flow = np.zeros(len(torque))
    for joint in range(len(JOINT_NAMES)):
        c = cylinder_of(machine, joint)
        lever = c.lever(motion.q[:, joint])
        pull, push = stall_forces(machine, joint)
        f, v = torque[:, joint] / lever, lever * motion.w[:, joint]
        extends, cubes = v > 0.0, c.area1**3 + c.area2**3
        left = np.where(extends, push - f, f - pull)
        with np.errstate(divide="ignore", invalid="ignore"):
            squared = np.where(left > 0.0, left / cubes, np.nan)  # (v / kv u)^2
            opening[:, joint] = np.where(v == 0.0, 0.0, np.nan_to_num(np.abs(v) / c.kv / np.sqrt(squared), nan=np.inf))
        drop1, drop2 = c.area1**2 * squared, c.area2**2 * squared
        moving = np.column_stack(
            [
                np.where(extends, supply - drop1, tank + drop1),
                np.where(extends, tank + drop2, supply - drop2),
            ]
        )
        # creeping is like rest: leakage past the centred spool then sets the pressures, not the flow
        still = np.abs(v) < 0.02 * max(float(np.abs(v).max()), 1e-9)
        bore = (f + (supply + tank) * c.area2) / (c.area1 + c.area2)
        pressure[:, joint] = np.where(still[:, None], np.column_stack([bore, supply + tank - bore]), moving)
        pump_flow += np.where(extends, c.area1, c.area2) * np.abs(v)
        force[:, joint], speed[:, joint], room[:, joint] = f, v, left
    return Demand(load_kg, torque, force, speed, room, opening, pressure, pump_flow)


def fastest_rate(machine: Machine, joint: int) -> float:
    """Rate of a joint with its valve fully open and nothing to push, at the shortest lever arm, rad/s."""
    c = cylinder_of(machine, joint)
    pull, push = stall_forces(machine, joint)
    speed = c.kv * math.sqrt(max(push, -pull) / (c.area1**3 + c.area2**3))
    return speed / float(c.lever(c.angles()).min())


BRAKE_PEAK = 1.5  # of a smooth stop: largest over mean deceleration


@dataclass(frozen=True)
class Stop:
    """What it takes to stop a joint from its peak rate."""

    rate: float  # rad/s
    brake: float  # torque to stop within the time, N m
    spare: float  # torque that the cylinder has beside what it holds, N m
    shortest_s: float


def stop_from_peak(machine: Machine, joint: int, motion: Motion, load_kg: float, stop_s: float) -> Stop:
    """Torque of a safe stop at the shortest lever arm of the moves, and the shortest time it can be done in."""
    c = cylinder_of(machine, joint)
    pull, push = stall_forces(machine, joint)
    rate = float(np.abs(motion.w[:, joint]).max())
    lever = float(c.lever(motion.q[:, joint]).min())
    held = float(gravity_torque(machine, 0.0, load_kg)) if joint == 1 else 0.0
    momentum = BRAKE_PEAK * rate * float(inertia(machine, joint, 0.0, load_kg))
    spare = max(min(lever * push - held, held - lever * pull), 1e-9)  # stops a fall; stops a rise
    return Stop(rate, momentum / stop_s, spare, momentum / spare)
