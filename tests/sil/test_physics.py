"""The plant against something else: MuJoCo's rigid bodies, conservation of energy, conservation of oil.

What is expected comes from MuJoCo, or is worked out here from the machine file's primary numbers (bores,
cranks, masses), not from the plant's own parameters.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import simpson

from sil_plant.inputs.machine import JOINT_NAMES, REFERENCE_ARM, Machine, load_machine
from sil_plant.plant.dynamics import (
    LONGEST_STEP_S,
    P_SWING,
    STATES,
    XV,
    PlantParameters,
    Q,
    W,
    derivative,
    integrate,
    plant_parameters,
    state_at_rest,
)

Array = NDArray[np.float64]
SWING, WRIST = 0, 1


# ---- adapters: all that these tests know of the plant's functions ------------------------------------


def rates(y: Array, u: Array, load_kg: float, parameters: PlantParameters) -> Array:
    """dy/dt of the plant."""
    dy = np.empty(STATES)
    derivative(y, u, load_kg, parameters, dy)
    return dy


def one_step(y: Array, u: Array, load_kg: float, parameters: PlantParameters, step_s: float) -> Array:
    """The state one step of the plant's integrator later."""
    assert step_s <= LONGEST_STEP_S, "the integrator would take more than one step"
    after = y.copy()
    integrate(after, u, load_kg, parameters, step_s, np.zeros((5, STATES)))
    return after


# ---- rigid bodies against MuJoCo ---------------------------------------------------------------------

# Each cylinder is a tendon between two sites, so MuJoCo finds its lever arm by itself from the two points'
# distance. Positions and inertias written here are placeholders that MujocoArm replaces; none that changes is
# zero, because the compiler takes shortcuts for frames that coincide, and they would outlive the change.
ARM_MJCF = """
<mujoco>
  <compiler angle="radian" inertiafromgeom="false"/>
  <option><flag contact="disable" constraint="disable"/></option>
  <worldbody>
    <site name="swing_base" pos="0.3 -0.3 0"/>
    <body name="swing">
      <inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>
      <joint name="swing" type="hinge" axis="0 0 1"/>
      <site name="swing_crank" pos="0.1 0 0"/>
      <site name="wrist_base" pos="0.9 0 -0.3"/>
      <body name="wrist" pos="0.8 0 0">
        <inertial pos="0.2 0 0" mass="1" diaginertia="1 1 1"/>
        <joint name="wrist" type="hinge" axis="0 -1 0"/>
        <site name="wrist_crank" pos="0.1 0 0"/>
        <body name="load" pos="0.4 0 0">
          <inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>
        </body>
      </body>
    </body>
  </worldbody>
  <tendon>
    <spatial name="swing"><site site="swing_base"/><site site="swing_crank"/></spatial>
    <spatial name="wrist"><site site="wrist_base"/><site site="wrist_crank"/></spatial>
  </tendon>
  <actuator>
    <motor name="swing" tendon="swing"/>
    <motor name="wrist" tendon="wrist"/>
  </actuator>
</mujoco>
"""


class RandomArm(NamedTuple):
    """One arm, load and state; arrays hold swing, then wrist."""

    g: float
    I1: float
    L1: float
    L2: float
    m2: float
    J: float
    load_kg: float
    crank_a: Array
    crank_b: Array
    q0: Array
    q: Array
    w: Array
    force: Array  # of the cylinders
    friction: Array  # torque


class MujocoArm:
    """The same arm made of MuJoCo's bodies, joints, tendons and motors."""

    def __init__(self) -> None:
        import mujoco

        self._mujoco: Any = mujoco
        self._model = mujoco.MjModel.from_xml_string(ARM_MJCF)
        self._data = mujoco.MjData(self._model)

    def accelerations(self, arm: RandomArm) -> tuple[Array, Array]:
        """Joint accelerations, and the tendons' lengths.

        The swing link has its inertia about the axis alone and the load none of its own; both are what the
        plant says, exactly. MuJoCo's compiler wants every inertia positive, its dynamics do not, so the rod's
        inertia about its own axis and the point load's are set to zero after compiling: no tiny numbers stand
        in for them and none limits the comparison.
        """
        model, data = self._model, self._data
        swing, wrist, load = (model.body(name).id for name in ("swing", "wrist", "load"))
        model.opt.gravity[:] = [0.0, 0.0, -arm.g]
        model.body_inertia[swing] = arm.I1
        model.body_pos[wrist] = [arm.L1, 0.0, 0.0]
        model.body_ipos[wrist] = [0.5 * arm.L2, 0.0, 0.0]
        model.body_mass[wrist] = arm.m2
        about_centre = arm.J - arm.m2 * (0.5 * arm.L2) ** 2
        model.body_inertia[wrist] = [0.0, about_centre, about_centre]
        model.body_pos[load] = [arm.L2, 0.0, 0.0]
        model.body_mass[load] = arm.load_kg
        model.body_inertia[load] = 0.0
        (a1, a2), (b1, b2), (q01, q02) = arm.crank_a, arm.crank_b, arm.q0
        model.site("swing_base").pos = [a1 * np.cos(q01), -a1 * np.sin(q01), 0.0]
        model.site("swing_crank").pos = [b1, 0.0, 0.0]
        model.site("wrist_base").pos = [arm.L1 + a2 * np.cos(q02), 0.0, -a2 * np.sin(q02)]
        model.site("wrist_crank").pos = [b2, 0.0, 0.0]
        self._mujoco.mj_setConst(model, data)
        data.qpos[:], data.qvel[:] = arm.q, arm.w
        data.ctrl[:] = arm.force
        data.qfrc_applied[:] = -arm.friction
        self._mujoco.mj_forward(model, data)
        return data.qacc.copy(), data.ten_length.copy()


def random_arm(rng: np.random.Generator, reference: PlantParameters) -> tuple[RandomArm, Array, PlantParameters]:
    """A random arm for MuJoCo, and the same as state and parameters of the plant."""
    m2, L2 = rng.uniform(0.5, 30.0), rng.uniform(0.2, 1.5)
    area1, area2 = rng.uniform(4e-4, 2e-3, 2), rng.uniform(2e-4, 4e-4, 2)
    crank_a, crank_b = rng.uniform(0.2, 0.6, 2), rng.uniform(0.05, 0.15, 2)
    fv, fc, slope = rng.uniform(0.0, 30.0, 2), rng.uniform(0.0, 20.0, 2), rng.uniform(10.0, 2000.0)
    q = np.array([rng.uniform(-3.1, 3.1), rng.uniform(-1.55, 1.55)])
    w = rng.uniform(-6.0, 6.0, 2)
    pressure = rng.uniform(1e5, 2e7, (2, 2))
    arm = RandomArm(
        g=rng.uniform(1.0, 20.0),
        I1=rng.uniform(0.1, 20.0),
        L1=rng.uniform(0.2, 1.5),
        L2=L2,
        m2=m2,
        # a thin straight link: a rod has 1/3, the point masses at both ends of it 1/2, one in the middle 1/4
        J=rng.uniform(0.26, 0.5) * m2 * L2**2,
        load_kg=rng.choice([0.0, rng.uniform(0.0, 50.0)]),
        crank_a=crank_a,
        crank_b=crank_b,
        q0=rng.uniform(0.2, 2.9, 2) - q,  # the triangle's angle q + q0 is anything between its dead points
        q=q,
        w=w,
        force=pressure[:, 0] * area1 - pressure[:, 1] * area2,
        friction=fv * w + fc * 2.0 / np.pi * np.arctan(slope * w),
    )
    parameters = reference._replace(
        **{name: getattr(arm, name) for name in ("g", "I1", "L1", "L2", "m2", "J", "q0")},
        coulomb_slope=slope,
        q_low=np.full(2, -9.0),  # no stops: every pose is tried
        q_high=np.full(2, 9.0),
        fv=fv,
        fc=fc,
        area1=area1,
        area2=area2,
        crank_a2_b2=crank_a**2 + crank_b**2,
        crank_ab=crank_a * crank_b,
        x_offset=np.zeros(2),
        stroke=crank_a + crank_b,  # the piston never meets an end
    )
    y = np.zeros(STATES)
    y[Q : Q + 2], y[W : W + 2] = q, w
    y[P_SWING:XV] = pressure.ravel()
    y[XV:] = rng.uniform(-1.0, 1.0, 4)
    return arm, y, parameters


@pytest.mark.skipif(sys.version_info < (3, 11), reason="MuJoCo's wheels begin with Python 3.11")
def test_no_inertia_coriolis_gravity_or_lever_arm_term_is_wrong() -> None:
    """GIVEN 1,000 random arms, loads and states WHEN both compute accelerations THEN plant and MuJoCo agree.

    Differences are relative to the largest single torque, over the inertia, that makes up the acceleration.
    """
    rng = np.random.default_rng(1)
    reference, mujoco_arm = plant_parameters(load_machine(REFERENCE_ARM)), MujocoArm()
    worst = np.zeros(2)
    for _ in range(1000):
        arm, y, parameters = random_arm(rng, reference)
        expected, length = mujoco_arm.accelerations(arm)

        acceleration = rates(y, rng.uniform(-1.0, 1.0, 2), arm.load_kg, parameters)[W : W + 2]

        lever = arm.crank_a * arm.crank_b * np.sin(arm.q + arm.q0) / length
        own_inertia = np.array([arm.I1 + arm.J * np.cos(arm.q[WRIST]) ** 2, arm.J])
        scale = np.abs(lever * arm.force) / own_inertia + np.abs(expected)
        worst = np.maximum(worst, np.abs(acceleration - expected) / scale)
    # seen: 1.0e-14 and 4.3e-15, rounding alone
    assert np.all(worst < 1e-12), worst


# ---- one arm's figures from the machine file ----------------------------------------------------------


class Cylinder:
    """One joint's cylinder, crank and valve at given states, from the machine file's numbers.

    Parameters
    ----------
    machine : Machine
        The machine.
    joint : int
        ``SWING`` or ``WRIST``.
    y : Array
        States, shape (..., 12). All else has its leading shape; chambers, bore and annulus, come before it.
    """

    def __init__(self, machine: Machine, joint: int, y: Array) -> None:
        def number(key: str) -> float:
            return machine[f"{JOINT_NAMES[joint]}.{key}"]

        a, b, q0 = number("crank_a_m"), number("crank_b_m"), number("crank_q0_rad")

        def length(q: Any) -> Any:
            """Distance of the cylinder's two pins."""
            return np.hypot(a - b * np.cos(q + q0), b * np.sin(q + q0))

        q, w, xv = y[..., Q + joint], y[..., W + joint], y[..., XV + joint]
        retracted = length(number("q_min_rad")) - number("end_margin_m")
        extended = length(number("q_max_rad")) + number("end_margin_m")
        assert np.all((retracted < length(q)) & (length(q) < extended)), "the piston meets an end"
        bore, rod = number("bore_m"), number("rod_m")
        self.area = np.pi / 4.0 * np.array([bore**2, bore**2 - rod**2])
        self.volume = number("dead_volume_m3") + np.stack(
            [self.area[0] * (length(q) - retracted), self.area[1] * (extended - length(q))]
        )
        self.lever = (length(q + 1e-6) - length(q - 1e-6)) / 2e-6

        # the valve: from the supply into one chamber, from the other into the tank
        p1, p2 = y[..., P_SWING + 2 * joint], y[..., P_SWING + 2 * joint + 1]
        self.pressure = np.stack([p1, p2])
        p_supply, p_tank = machine["supply.pressure_Pa"], machine["supply.tank_Pa"]
        extending = xv >= 0.0
        drop_in = p_supply - np.where(extending, p1, p2)
        drop_out = np.where(extending, p2, p1) - p_tank
        assert np.all(np.minimum(drop_in, drop_out) > 2e4), "a port all but runs backwards"
        supplied = number("valve_kv") * np.abs(xv) * np.sqrt(drop_in)
        returned = number("valve_kv") * np.abs(xv) * np.sqrt(drop_out)
        leak = number("leakage_m3_s_Pa") * (p1 - p2)
        valve = np.where(extending, [supplied, -returned], [-returned, supplied])
        self.inflow = valve + np.stack([-leak, leak])

        self.power_in = p_supply * supplied - p_tank * returned
        self.valve_loss = drop_in * supplied + drop_out * returned
        self.leakage_loss = leak * (p1 - p2)
        coulomb = 2.0 / np.pi * np.arctan(1.0 / machine["arm.coulomb_rate_rad_s"] * w)
        self.friction_loss = (number("viscous_Nms_rad") * w + number("coulomb_Nm") * coulomb) * w


def oil_density(pressure: Array, beta: float) -> Array:
    """Density of oil of constant bulk modulus, over that at pressure zero."""
    return np.exp(pressure / beta)


def oil_energy(pressure: Array, beta: float) -> Array:
    """Elastic energy of oil of constant bulk modulus, J per m^3 of the compressed oil.

    It takes p dV/V = p dp/beta per volume at hand to compress oil by dp, and all of it comes back. To first
    order p^2 / (2 beta).
    """
    return beta * (np.expm1(pressure / beta) - pressure / beta)


def mechanical_energy(machine: Machine, load_kg: float, y: Array) -> Array:
    """Kinetic and potential energy of states (..., 12): the swing link, the rod, the load.

    A point of the wrist link at distance l moves at (L1 + l cos q2) q1' around and l q2' up and down. The
    energy is a parabola in l, so that Simpson's rule over the rod is exact: masses m/6, 4m/6, m/6.
    """
    L1, L2, m2 = machine["swing.link_length_m"], machine["wrist.link_length_m"], machine["wrist.mass_kg"]
    q2, w1, w2 = y[..., Q + WRIST], y[..., W + SWING], y[..., W + WRIST]
    energy = 0.5 * machine["arm.swing_inertia_kgm2"] * w1**2
    for distance, mass in ((0.0, m2 / 6.0), (L2 / 2.0, m2 * 4.0 / 6.0), (L2, m2 / 6.0), (L2, load_kg)):
        around, height = (L1 + distance * np.cos(q2)) * w1, distance * np.sin(q2)
        energy += mass * (0.5 * (around**2 + (distance * w2) ** 2) + machine["arm.gravity_m_s2"] * height)
    return energy


# ---- balances over a driven move ---------------------------------------------------------------------

LOAD_KG = 5.0
MOVE_S = 1.0
TICK_S = 5e-3  # the valves' set-points change this often
SPOOL_AMPLITUDE = np.array([0.2, 0.16])

# The one the simulation uses, half of it, and a finer one. What is integrated over time is known at a step's ends only:
# at the longest that costs more than the steps do.
STEPS_S = (LONGEST_STEP_S, LONGEST_STEP_S / 2.0, LONGEST_STEP_S / 16.0)


def drive(machine: Machine, step_s: float) -> Array:
    """Both joints there and back by one period of a sine at the valves: spools cross zero, joints turn round.

    Returns
    -------
    Array
        States, shape (ticks, steps + 1, 12): at every step, each tick's last again as the next one's first.
    """
    parameters = plant_parameters(machine)
    steps = round(TICK_S / step_s)
    y = state_at_rest(parameters, np.array([-0.3, 0.1]), LOAD_KG)
    ticks = []
    for k in range(round(MOVE_S / TICK_S)):
        u = SPOOL_AMPLITUDE * np.sin(2.0 * np.pi * k * TICK_S / MOVE_S)
        states = [y]
        for _ in range(steps):
            states.append(one_step(states[-1], u, LOAD_KG, parameters, TICK_S / steps))
        ticks.append(states)
        y = states[-1]
    return np.array(ticks)


def integral(rate: Array, step_s: float) -> Array:
    """Integral over the move of (..., ticks, steps + 1): Simpson's rule in each tick."""
    return simpson(rate, dx=step_s, axis=-1).sum(axis=-1)


def change(amount: Array) -> Array:
    """Last minus first of (..., ticks, steps + 1)."""
    return amount[..., -1, -1] - amount[..., 0, 0]


@pytest.fixture(scope="module")
def machine() -> Machine:
    return load_machine(REFERENCE_ARM)


@pytest.fixture(scope="module")
def moves(machine: Machine) -> Sequence[Array]:
    """The driven move at the three steps."""
    return [drive(machine, step_s) for step_s in STEPS_S]


def test_the_driven_move_moves_both_ways(moves: Sequence[Array]) -> None:
    """GIVEN the move of the balances WHEN it is looked at THEN it moves enough for them to mean something."""
    for y in moves:
        for joint in (SWING, WRIST):
            assert np.ptp(y[..., Q + joint]) > 0.1
            assert y[..., W + joint].max() > 0.3 and y[..., W + joint].min() < -0.3
            assert y[..., XV + joint].max() > 0.1 and y[..., XV + joint].min() < -0.1


def test_no_energy_comes_from_nowhere(machine: Machine, moves: Sequence[Array]) -> None:
    """GIVEN a driven move WHEN energy is counted THEN it balances, the better the finer the step.

    d/dt (kinetic + potential + elastic energy of the oil) = supply and tank ports
        - valves' throttling - leakage - friction + elastic energy that the flows carry along

    The residual is relative to friction's work, which is a sixtieth of what the supply gives.
    """
    beta = machine["oil.bulk_modulus_Pa"]
    residual = []
    for step_s, y in zip(STEPS_S, moves, strict=True):
        balance = change(mechanical_energy(machine, LOAD_KG, y))
        friction = 0.0
        for joint in (SWING, WRIST):
            cylinder = Cylinder(machine, joint, y)
            elastic = oil_energy(cylinder.pressure, beta)
            balance += change(np.sum(cylinder.volume * elastic, axis=0))
            balance -= integral(cylinder.power_in + np.sum(cylinder.inflow * elastic, axis=0), step_s)
            for loss in (cylinder.valve_loss, cylinder.leakage_loss, cylinder.friction_loss):
                assert np.all(loss >= 0.0)
                balance += integral(loss, step_s)
            friction += integral(cylinder.friction_loss, step_s)
        residual.append(abs(balance) / friction)

    # seen: 5.3e-6, 4.8e-8 and 5.4e-9. Second order: the valve's flow has a kink where the spool crosses zero.
    assert residual[0] < 1e-5
    assert residual[1] < 3e-6
    assert residual[2] < residual[0] / 100.0


def test_no_oil_comes_from_nowhere(machine: Machine, moves: Sequence[Array]) -> None:
    """GIVEN a driven move WHEN each chamber's oil is counted THEN what flowed in is what is there.

    Oil is counted at the density its pressure gives it. By the time's rate and over the density that is
    flow = swept volume + V/beta p', chamber by chamber. The residual is relative to all that went in and out.
    """
    beta = machine["oil.bulk_modulus_Pa"]
    residual = []
    for step_s, y in zip(STEPS_S, moves, strict=True):
        cylinders = [Cylinder(machine, joint, y) for joint in (SWING, WRIST)]
        volume, pressure, inflow = (
            np.stack([getattr(cylinder, name) for cylinder in cylinders]) for name in ("volume", "pressure", "inflow")
        )
        density = oil_density(pressure, beta)
        missing = change(density * volume) - integral(density * inflow, step_s)
        residual.append(np.max(np.abs(missing) / integral(np.abs(inflow), step_s)))

    # seen: 7.8e-8, 8.0e-9 and 2.1e-10 of the worst of the four chambers
    assert residual[0] < 1.5e-7
    assert residual[1] < 3e-8
    assert residual[2] < residual[1] / 10.0


# ---- small motion about rest -------------------------------------------------------------------------


@pytest.mark.parametrize("q", [(0.0, 0.0), (-0.5, -0.5), (0.6, 0.6), (1.0, -0.9)])
def test_the_oil_is_neither_too_stiff_nor_too_soft(machine: Machine, q: tuple[float, float]) -> None:
    """GIVEN an arm at rest with 3 kg, valves shut WHEN it is nudged THEN it rings at its hydraulic frequency.

    The frequency is sqrt(beta (A1^2/V1 + A2^2/V2) R^2 / H). Coulomb friction is off: its slope at rest would
    damp the ringing. Gravity, viscous friction and leakage stay, and make the small difference.
    """
    load_kg = 3.0
    parameters = plant_parameters(machine)._replace(fc=np.zeros(2))
    rest = state_at_rest(parameters, np.array(q), load_kg)
    shut = np.zeros(2)
    assert np.all(np.abs(rates(rest, shut, load_kg, parameters)[Q:P_SWING]) < 1e-10), "it is not at rest"

    # the spools are left out: they do not feel the arm
    nudge = np.diag([1e-5] * 4 + [1e3] * 4 + [0.0] * 4)[:XV]
    up, down = ([rates(rest + sign * n, shut, load_kg, parameters)[:XV] for n in nudge] for sign in (1, -1))
    jacobian = ((np.array(up) - np.array(down)) / (2.0 * nudge.max(axis=1))[:, np.newaxis]).T
    eigenvalues = np.linalg.eigvals(jacobian)
    ringing = np.sort(np.abs(eigenvalues[eigenvalues.imag > 1.0]))

    expected = []
    for joint in (SWING, WRIST):
        cylinder = Cylinder(machine, joint, rest)
        turning = rest.copy()
        turning[W + joint] = 1.0
        energies = [mechanical_energy(machine, load_kg, y) for y in (rest, turning)]
        stiffness = machine["oil.bulk_modulus_Pa"] * np.sum(cylinder.area**2 / cylinder.volume)
        expected.append(np.sqrt(stiffness * cylinder.lever**2 / (2.0 * (energies[1] - energies[0]))))
    # seen: within 1.5e-3
    np.testing.assert_allclose(ringing, np.sort(expected), rtol=3e-3)
