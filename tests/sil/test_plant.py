"""The plant: what would make its numbers wrong by more than the sensors can see, or not the same twice."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from sil_plant.inputs.machine import Machine, with_changes
from sil_plant.loop import session
from sil_plant.plant import dynamics
from sil_plant.plant.dynamics import PlantParameters

CLOSED = np.zeros(2)
TICK_S = 1e-3
POSES = [(0.0, 0.0), (0.6, 0.6), (-0.9, 1.0), (1.1, -0.9)]
# Each state's scale, for the reference integrator's absolute tolerance.
SCALE = np.array([1, 1, 1, 1, 1e6, 1e6, 1e6, 1e6, 1, 1, 1e2, 1e2])


@pytest.fixture(scope="module")
def arm(machine: Machine) -> PlantParameters:
    return dynamics.plant_parameters(machine)


@pytest.fixture(scope="module")
def tight(machine: Machine) -> PlantParameters:
    """The arm with cylinders that do not leak."""
    changes = {f"{joint}.leakage_m3_s_Pa": 0.0 for joint in ("swing", "wrist")}
    return dynamics.plant_parameters(with_changes(machine, changes, "test"))


def scratch() -> np.ndarray:
    return np.zeros((5, dynamics.STATES))


def rhs(u: np.ndarray, load: float, arm: PlantParameters):
    def f(_: float, y: np.ndarray) -> np.ndarray:
        dy = np.empty(dynamics.STATES)
        dynamics.derivative(y, u, load, arm, dy)
        return dy

    return f


def piston(q: np.ndarray, arm: PlantParameters) -> np.ndarray:
    """Piston positions, 0..stroke, by the law of cosines."""
    return np.sqrt(arm.crank_a2_b2 - 2 * arm.crank_ab * np.cos(q + arm.q0)) - arm.x_offset


# ---- accuracy ------------------------------------------------------------------------------------


def test_integrator_is_not_off_by_more_than_a_microradian(simulate, arm: PlantParameters) -> None:
    """GIVEN the spool commands of a real run of 2 s WHEN integrated with LSODA at 1e-10
    THEN angles agree to 1e-6 rad.
    """
    record = simulate(load=3.0, duration=1.9).record
    ticks = len(record.state)
    assert ticks == 2001 and np.ptp(record.state[:, 0]) > 0.5
    ours, exact = record.state[0].copy(), record.state[0].copy()
    worst, work = 0.0, scratch()
    for k in range(ticks - 1):
        # the command recorded at a SYNC is in effect up to the delay, the next one from there on
        for u in (record.command[k], record.command[k + 1]):
            dynamics.integrate(ours, u, 3.0, arm, TICK_S / 2, work)
            f = rhs(u, 3.0, arm)
            solution = solve_ivp(f, (0, TICK_S / 2), exact, method="LSODA", rtol=1e-10, atol=1e-12 * SCALE)
            assert solution.success
            exact = solution.y[:, -1]
        assert np.array_equal(ours, record.state[k + 1]), f"the record is not the plant's own way, tick {k}"
        worst = max(worst, float(np.abs(ours[:2] - exact[:2]).max()))
    # From below too: a difference of exactly nothing would mean that both sides are the same code.
    assert 1e-13 < worst <= 1e-6


def test_integrator_has_not_lost_its_order(arm: PlantParameters) -> None:
    """GIVEN a smooth stretch WHEN the step is halved
    THEN angles, rates and pressures are 16 times as exact.
    """
    u, load, duration = np.array([0.15, 0.12]), 3.0, 0.02
    start = dynamics.state_at_rest(arm, np.zeros(2), load)
    dynamics.integrate(start, u, load, arm, 0.2, scratch())
    assert (start[2:4] > 0.2).all()  # far from the bend of the friction
    exact = solve_ivp(rhs(u, load, arm), (0, duration), start, method="DOP853", rtol=1e-13, atol=1e-13).y[:, -1]
    errors = []
    for steps in (80, 160, 320):
        assert duration / steps <= dynamics.LONGEST_STEP_S
        y, work = start.copy(), scratch()
        for _ in range(steps):
            dynamics.integrate(y, u, load, arm, duration / steps, work)
        difference = np.abs(y - exact)
        errors.append([difference[0:2].max(), difference[2:4].max(), difference[4:8].max()])
    orders = np.log2(np.array(errors)[:-1] / np.array(errors)[1:])
    assert (orders > 3.6).all() and (orders < 4.4).all(), orders


def test_a_long_stretch_is_not_one_long_step(arm: PlantParameters) -> None:
    """GIVEN durations up to 0.1 s WHEN integrated at once THEN it is many steps of at most the longest."""
    u = np.array([0.3, -0.2])
    for duration, steps in ((0.1, 200), (5.1e-4, 2), (5e-4, 1), (2e-3, 4), (1e-3, 2), (1e-6, 1)):
        once = dynamics.state_at_rest(arm, np.zeros(2), 5.0)
        many = once.copy()
        dynamics.integrate(once, u, 5.0, arm, duration, scratch())
        for _ in range(steps):
            dynamics.integrate(many, u, 5.0, arm, duration / steps, scratch())
        assert np.allclose(once, many, rtol=1e-12, atol=1e-12) and not np.array_equal(
            once, dynamics.state_at_rest(arm, np.zeros(2), 5.0)
        )


def test_no_time_does_not_move_the_plant(arm: PlantParameters) -> None:
    """GIVEN a delay of zero WHEN integrated over THEN nothing changes."""
    y = dynamics.state_at_rest(arm, np.zeros(2), 5.0)
    before = y.copy()
    dynamics.integrate(y, np.ones(2), 5.0, arm, 0.0, scratch())
    assert np.array_equal(y, before)


def test_energy_does_not_come_from_nowhere(machine: Machine) -> None:
    """GIVEN the links alone, swinging without friction or oil WHEN integrated
    THEN their energy stays (H' - 2C skew).
    """
    changes = {f"{joint}.{key}": 0.0 for joint in ("swing", "wrist") for key in ("viscous_Nms_rad", "coulomb_Nm")}
    changes |= {f"{joint}.leakage_m3_s_Pa": 0.0 for joint in ("swing", "wrist")}
    arm = dynamics.plant_parameters(with_changes(machine, changes, "test"))
    # pressures that push no piston, and nearly no oil stiffness: what is left is the links
    arm = arm._replace(bulk_modulus=1e-3, kv=np.zeros(2), q_low=np.full(2, -9.0), q_high=np.full(2, 9.0))
    load = 4.0
    y = np.zeros(dynamics.STATES)
    y[:4] = 0.1, 0.3, 1.5, -1.0
    y[4:8] = 1e6, 1e6 * arm.area1[0] / arm.area2[0], 1e6, 1e6 * arm.area1[1] / arm.area2[1]

    def energy(y: np.ndarray) -> float:
        q2, w1, w2 = y[1], y[2], y[3]
        s, c = math.sin(q2), math.cos(q2)
        # kinetic energy from the mass points of a rod and the load, not from the plant's H
        rod = np.linspace(0.0, arm.L2, 20001)
        weight = np.full(rod.size, arm.m2 / (rod.size - 1))
        weight[[0, -1]] /= 2
        radius = arm.L1 + rod * c
        moving = 0.5 * float(weight @ ((radius * w1) ** 2 + (rod * w2) ** 2)) + 0.5 * arm.I1 * w1**2
        moving += 0.5 * load * (((arm.L1 + arm.L2 * c) * w1) ** 2 + (arm.L2 * w2) ** 2)
        return moving + arm.g * arm.L2 * s * (0.5 * arm.m2 + load)

    start = energy(y)
    for _ in range(300):
        dynamics.integrate(y, CLOSED, load, arm, TICK_S, scratch())
        assert energy(y) == pytest.approx(start, rel=1e-6)
    assert abs(y[2] - 1.5) > 0.05 and abs(y[3] + 1.0) > 0.5  # it did swing


# ---- at rest -------------------------------------------------------------------------------------


@pytest.mark.parametrize("pose", POSES)
@pytest.mark.parametrize("load", [0.0, 3.0, 10.0])
def test_arm_at_rest_does_not_move(arm: PlantParameters, tight: PlantParameters, pose, load: float) -> None:
    """GIVEN holding pressures and closed valves WHEN 1 s passes
    THEN a tight arm stays; a leaking one only creeps.
    """
    for parameters, drift in ((tight, 1e-12), (arm, 0.03)):
        y = dynamics.state_at_rest(parameters, np.array(pose), load)
        dy = np.empty(dynamics.STATES)
        dynamics.derivative(y, CLOSED, load, parameters, dy)
        assert np.abs(dy[:4]).max() < 1e-12
        start = y.copy()
        dynamics.integrate(y, CLOSED, load, parameters, 1.0, scratch())
        assert np.abs(y[:2] - start[:2]).max() < drift
    assert np.abs(y[:2] - start[:2]).max() > 1e-4  # the leakage is there


@pytest.mark.parametrize("pose", POSES)
@pytest.mark.parametrize("load", [0.0, 3.0, 10.0])
def test_holding_pressures_do_not_miss_the_load(arm: PlantParameters, pose, load: float) -> None:
    """GIVEN a pose and a load WHEN pressures are found
    THEN force times lever, by differences, is the weight's torque.
    """
    q = np.array(pose)
    pressures = dynamics.holding_pressures(arm, q, load)
    force = pressures[:, 0] * arm.area1 - pressures[:, 1] * arm.area2
    lever = (piston(q + 1e-6, arm) - piston(q - 1e-6, arm)) / 2e-6
    weight = arm.g * arm.L2 * math.cos(q[1]) * (arm.m2 / 2 + load)
    assert force * lever == pytest.approx([0.0, weight], abs=1e-5)
    assert pressures.sum(axis=1) == pytest.approx(arm.p_supply + arm.p_tank)


def test_load_that_cannot_be_held_is_not_started_with(arm: PlantParameters) -> None:
    """GIVEN 1000 kg WHEN pressures are asked for THEN ValueError names the wrist and the load."""
    with pytest.raises(ValueError, match=r"wrist.*1000 kg"):
        dynamics.holding_pressures(arm, np.zeros(2), 1000.0)


@pytest.mark.parametrize("spool", [0.05, -0.05, 1.0])
def test_steady_speed_is_not_other_than_the_valve_gives(tight: PlantParameters, spool: float) -> None:
    """GIVEN a constant spool WHEN the swing joint moves evenly
    THEN both chambers' flows are kv u sqrt(dp).
    """
    y = dynamics.state_at_rest(tight, np.array([0.3, 0.0]), 0.0)
    dynamics.integrate(y, np.array([spool, 0.0]), 0.0, tight, 0.15 if abs(spool) < 1 else 0.05, scratch())
    dy = np.empty(dynamics.STATES)
    dynamics.derivative(y, np.array([spool, 0.0]), 0.0, tight, dy)
    q, w, xv = y[0], y[2], y[dynamics.XV]
    lever = float((piston(y[:2] + 1e-6, tight) - piston(y[:2] - 1e-6, tight))[0] / 2e-6)
    x = float(piston(y[:2], tight)[0])
    supply, tank = tight.p_supply, tight.p_tank
    high, low = (supply - y[4], y[5] - tank) if spool > 0 else (y[4] - tank, supply - y[5])
    flow1 = tight.kv[0] * xv * math.sqrt(high)
    flow2 = tight.kv[0] * xv * math.sqrt(low)
    volume1 = tight.dead_volume[0] + tight.area1[0] * x
    volume2 = tight.dead_volume[0] + tight.area2[0] * (tight.stroke[0] - x)
    assert dy[4] == pytest.approx(
        (flow1 - tight.area1[0] * lever * w) * tight.bulk_modulus / volume1, rel=1e-6, abs=1.0
    )
    assert dy[5] == pytest.approx(
        (tight.area2[0] * lever * w - flow2) * tight.bulk_modulus / volume2, rel=1e-6, abs=1.0
    )
    assert np.sign(w) == np.sign(spool) and abs(w) > 0.03 and -1.0 < q < 1.2


# ---- end stops -----------------------------------------------------------------------------------


@pytest.mark.parametrize("spool", [0.02, 0.3, 1.0, -0.02, -0.3, -1.0])
@pytest.mark.parametrize("joint", [0, 1])
def test_joint_does_not_leave_its_range(arm: PlantParameters, joint: int, spool: float) -> None:
    """GIVEN a valve that stays open WHEN the joint meets its stop
    THEN it stays there, pressed against it, at rest.
    """
    u = np.zeros(2)
    u[joint] = spool
    y, work, deepest = dynamics.state_at_rest(arm, np.zeros(2), 3.0), scratch(), 0.0

    def beyond() -> float:
        return float(max(arm.q_low[joint] - y[joint], y[joint] - arm.q_high[joint]))

    for _ in range(round(3.0 / min(abs(spool), 0.3)) * 20):
        dynamics.integrate(y, u, 3.0, arm, 0.05, work)
        deepest = max(deepest, beyond())
    assert 0.0 < beyond() < 0.02
    assert deepest < 0.05
    assert abs(y[2 + joint]) < 2e-3


@pytest.mark.parametrize("spools", [(1.0, 1.0), (-1.0, -1.0), (1.0, -1.0), (-1.0, 1.0)])
def test_state_does_not_run_away_with_full_valves(arm: PlantParameters, spools) -> None:
    """GIVEN both valves fully open for 5 s WHEN integrated
    THEN all is finite, no chamber below vacuum, nothing spins.
    """
    y, work = dynamics.state_at_rest(arm, np.zeros(2), 10.0), scratch()
    for _ in range(500):
        dynamics.integrate(y, np.array(spools), 10.0, arm, 0.01, work)
        assert np.isfinite(y).all() and (y[4:8] >= 0.0).all() and (y[4:8] < 1e8).all()
        assert (np.abs(y[:2]) < math.pi).all() and (np.abs(y[2:4]) < 50.0).all()
        assert (np.abs(y[8:10]) < 1.2).all()


# ---- noise ---------------------------------------------------------------------------------------


def test_noise_is_not_of_another_kind_than_the_machine_file_says(machine: Machine) -> None:
    """GIVEN 200000 samples WHEN looked at
    THEN angles are uniform, pressures normal, as wide as told, independent.
    """
    ticks = 200_000
    noise = session.sensor_noise(machine, 7, ticks)[:, :6]
    assert noise.shape == (ticks, 6)
    amplitude, rms = machine["sensors.encoder_noise_rad"], machine["sensors.pressure_noise_Pa"]
    angles, pressures = noise[:, :2] / amplitude, noise[:, 2:] / rms
    sigma = 1 / math.sqrt(ticks)
    assert np.abs(angles).max() <= 1.0 and np.abs(angles).max() > 0.9999
    assert np.abs(angles.mean(axis=0)).max() < 5 * sigma * math.sqrt(1 / 3)
    assert (angles**2).mean(axis=0) == pytest.approx([1 / 3] * 2, abs=5 * sigma * math.sqrt(4 / 45))
    assert (angles**4).mean(axis=0) == pytest.approx([1 / 5] * 2, abs=5 * sigma * 0.27)
    assert np.abs(pressures.mean(axis=0)).max() < 5 * sigma
    assert (pressures**2).mean(axis=0) == pytest.approx([1.0] * 4, abs=5 * sigma * math.sqrt(2))
    assert (pressures**4).mean(axis=0) == pytest.approx([3.0] * 4, abs=5 * sigma * math.sqrt(96))
    correlation = np.corrcoef(noise.T) - np.eye(6)
    assert np.abs(correlation).max() < 5 * sigma
    successive = [float(np.corrcoef(column[1:], column[:-1])[0, 1]) for column in noise.T]
    assert np.abs(successive).max() < 5 * sigma


def test_noise_does_not_depend_on_anything_but_the_seed(machine: Machine) -> None:
    """GIVEN the same seed WHEN drawn again, or for a longer run
    THEN the bytes are the same; another seed, others.
    """
    first = session.sensor_noise(machine, 5, 1000)
    assert session.sensor_noise(machine, 5, 1000).tobytes() == first.tobytes()
    assert session.sensor_noise(machine, 5, 5000)[:1000].tobytes() == first.tobytes()
    for other in (0, 6, 2**63 - 1):
        assert not np.any(session.sensor_noise(machine, other, 1000) == first)


def test_noise_of_one_sensor_does_not_change_with_the_other(machine: Machine) -> None:
    """GIVEN a machine with half the pressure noise WHEN drawn
    THEN pressures are exactly half, angles the same.
    """
    quiet = with_changes(machine, {"sensors.pressure_noise_Pa": machine["sensors.pressure_noise_Pa"] / 2}, "test")
    ours, theirs = (session.sensor_noise(m, 5, 100) for m in (machine, quiet))
    assert np.array_equal(ours[:, :2], theirs[:, :2]) and np.array_equal(ours[:, 2:6] / 2, theirs[:, 2:6])
