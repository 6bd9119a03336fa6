"""What the numbers of a machine file mean together: whether this arm will hold, move, and be controlled.

Each check looks at one thing and says what it found with its figures; keys, units and ranges come before, in
sil_plant/inputs/machine_keys.py. Nothing is simulated: geometry, statics, quasi-static flow, and the linear loop.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from sil_plant.design.linear_loop import least_margin, loop_gains
from sil_plant.design.proposal import firmware_refusal
from sil_plant.inputs.machine import JOINT_NAMES, Machine
from sil_plant.inputs.machine_keys import ERROR, NOTE, WARNING, Finding
from sil_plant.inputs.scenario import Scenario
from sil_plant.plant.statics import (
    Demand,
    Motion,
    cylinder_of,
    demand,
    fastest_rate,
    gravity_torque,
    heaviest_held,
    inertia,
    motion_of,
    natural_frequency,
    quickest,
    stall_forces,
    stop_from_peak,
)

BAR = 1e5
LITRES_PER_MINUTE = 6e4
# Shares from which on something is only just enough.
OPENING_TIGHT = 0.8
PRESSURE_SPARE_PA = 3e5
LEVER_SPREAD_LEAST = 0.25
MARGIN_TIGHT_UP, MARGIN_TIGHT_DOWN = 1.25, 0.8
VALVE_PER_RESONANCE = 2.0
SPOOL_NOISE_MOST = 0.05


@dataclass(frozen=True)
class Case:
    """What a machine is checked for.

    Attributes
    ----------
    machine : Machine
        Complete.
    scenario : Scenario
        The moves.
    full_load_kg : float
        The heaviest load.
    motion : Motion
        The moves' references.
    demands : tuple of Demand
        Without load, and with the full one.
    """

    machine: Machine
    scenario: Scenario
    full_load_kg: float
    motion: Motion
    demands: tuple[Demand, ...]


def make_case(machine: Machine, scenario: Scenario, full_load_kg: float) -> Case:
    """Work out what the moves ask for."""
    motion = motion_of(scenario)
    loads = (0.0, full_load_kg) if full_load_kg > 0.0 else (0.0,)
    return Case(machine, scenario, full_load_kg, motion, tuple(demand(machine, motion, load) for load in loads))


def check_machine(case: Case) -> list[Finding]:
    """Everything there is to say about a machine whose keys are all right."""
    checks = (geometry, holding, poses, flow, resonance, margins, noise, estimate, limits, safe_stop, bases)
    return [finding for check in checks for finding in check(case)]


# ---- the cylinders ------------------------------------------------------------------------------------


def geometry(case: Case) -> Iterator[Finding]:
    """Lever arms, strokes and volumes over the range of each joint."""
    m = case.machine
    for joint, name in enumerate(JOINT_NAMES):
        c = cylinder_of(m, joint)
        q = c.angles()
        lever = c.lever(q)
        least, most = float(lever.min()), float(lever.max())
        what = (
            f"lever arm {1e3 * least:.1f} to {1e3 * most:.1f} mm/rad over {c.q_min:g} to {c.q_max:g} rad; cylinder "
            f"{1e3 * c.shortest:.0f} mm between pins when retracted, stroke {1e3 * c.stroke:.0f} mm"
        )
        yield Finding(NOTE, name, what)
        if least < LEVER_SPREAD_LEAST * most:
            where = float(q[int(np.argmin(lever))])
            what = (
                f"near a dead point: at {where:.2f} rad the lever arm is {1e3 * least:.1f} mm, "
                f"{least / most:.0%} of its "
                "largest; there the cylinder is weak and every pressure error a large torque error"
            )
            end = "q_min_rad" if where < 0.5 * (c.q_min + c.q_max) else "q_max_rad"
            yield Finding(WARNING, f"{name}.{end}", what, f"move {end} away from it, or turn the crank (crank_q0_rad)")
        if c.shortest <= c.stroke:
            what = (
                f"no such cylinder: retracted it would be {1e3 * c.shortest:.0f} mm between the pins, which is "
                "not more "
                f"than its stroke of {1e3 * c.stroke:.0f} mm"
            )
            advice = (
                "check crank_a_m, crank_b_m and crank_q0_rad (the angle between the two at q = 0) against the drawing"
            )
            yield Finding(ERROR, f"{name}.crank_a_m", what, advice)
        margin = m["supervision.angle_margin_rad"] * float(c.lever(np.array([c.q_min, c.q_max])).max())
        if margin > c.margin:
            what = f"the piston is at its end {1e3 * c.margin:.1f} mm beyond the range, before the fault JOINT_LIMIT is"
            advice = f"at least {1e3 * margin:.1f} mm to spare, or a smaller supervision.angle_margin_rad"
            yield Finding(WARNING, f"{name}.end_margin_m", what, advice)
        yield from _volumes(name, c.dead_volume, c.area1 * c.stroke)
        if c.area1 > 6.0 * c.area2:
            what = f"the rod leaves {c.area2 / c.area1:.0%} of the bore's area on the annulus side"
            yield Finding(WARNING, f"{name}.rod_m", what, "look whether it is the rod's diameter")


def _volumes(name: str, dead: float, swept: float) -> Iterator[Finding]:
    if dead > 5.0 * swept or dead < 2e-3 * swept:
        more = "times as much as" if dead > swept else "of"
        ratio = f"{dead / swept:.0f}" if dead > swept else f"{dead / swept:.2%}"
        what = f"dead volume {1e6 * dead:.4g} cm^3, {ratio} {more} what the piston sweeps ({1e6 * swept:.4g} cm^3)"
        yield Finding(
            WARNING, f"{name}.dead_volume_m3", what, "one chamber with its line to the valve: 1 cm^3 is 1e-6 m^3"
        )


def holding(case: Case) -> Iterator[Finding]:
    """Pressures that hold the loads at rest over the wrist's range."""
    m, c = case.machine, cylinder_of(case.machine, 1)
    supply, tank = m["supply.pressure_Pa"], m["supply.tank_Pa"]
    q = c.angles()
    pull, push = stall_forces(m, 1)
    heaviest, worst = heaviest_held(m)
    for load in dict.fromkeys((0.0, case.full_load_kg)):
        force = gravity_torque(m, q, load) / c.lever(q)
        bore = (force + (supply + tank) * c.area2) / (c.area1 + c.area2)
        if force.max() >= push or force.min() <= pull:
            at = float(q[int(np.argmax(force))])
            needed = math.sqrt(max(float(force.max()), 1.0) / push) * m["wrist.bore_m"]
            what = (
                f"the wrist does not hold {load:g} kg: at {at:.2f} rad it needs {force.max() / 1e3:.1f} kN, the "
                "cylinder "
                f"pushes {push / 1e3:.1f} kN"
            )
            if heaviest > 0.0:
                what += f"; {heaviest:.3g} kg is the most it holds everywhere"
            advice = f"a bore of {1e3 * 1.15 * needed:.0f} mm, more supply pressure, a longer lever arm, or less load"
            yield Finding(ERROR, "wrist.bore_m", what, advice)
            return
        spare = min(float((supply - np.maximum(bore, supply + tank - bore)).min()), float((bore - tank).min()))
        low, high = float(bore.min()) / BAR, float(bore.max()) / BAR
        what = (
            f"holds {load:g} kg with {low:.0f} to {high:.0f} bar on the bore side (tank {tank / BAR:.0f}, "
            f"supply {supply / BAR:.0f})"
        )
        if spare < PRESSURE_SPARE_PA:
            advice = "a larger bore or more supply pressure; the valve needs pressure to move the load, too"
            yield Finding(WARNING, "wrist.bore_m", f"{what}: hardly any left", advice)
        else:
            yield Finding(NOTE, "wrist", what)
    what = f"at rest the wrist holds up to {heaviest:.3g} kg everywhere; {worst:.2f} rad is the worst place"
    yield Finding(NOTE, "wrist", what)


# ---- the moves ----------------------------------------------------------------------------------------


def poses(case: Case) -> Iterator[Finding]:
    """Whether the moves stay inside the range and the loads inside the estimate's."""
    m = case.machine
    for joint, name in enumerate(JOINT_NAMES):
        low, high = m[f"{name}.q_min_rad"], m[f"{name}.q_max_rad"]
        asked = [case.scenario.start_pose_rad[joint], *(s.target_rad for s in case.scenario.segments[joint])]
        if min(asked) < low or max(asked) > high:
            what = (
                f"the moves of {case.scenario.name} ask for {min(asked):g} to {max(asked):g} rad; it can "
                f"{low:g} to {high:g}"
            )
            end = "q_min_rad" if min(asked) < low else "q_max_rad"
            yield Finding(ERROR, f"{name}.{end}", what, "give the moves of this machine with --scenario FILE")
    high = m["estimator.prior.m_t_kg.high"]
    if case.full_load_kg > high:
        what = f"{high:g} kg is below the load of {case.full_load_kg:g} kg: the estimate stops at its bound"
        advice = f"about 1.5 times the heaviest load: {1.5 * case.full_load_kg:g}"
        yield Finding(ERROR, "estimator.prior.m_t_kg.high", what, advice)


def flow(case: Case) -> Iterator[Finding]:
    """Spool openings, pressures and pump flow over the moves."""
    for joint, name in enumerate(JOINT_NAMES):
        yield from _opening(case, joint, name)
        yield from _moving_pressures(case, joint, name)
    pump = max(float(d.pump_flow.max()) for d in case.demands)
    if pump > 0.0:
        sag = case.machine["effects.supply_sag_Pa_s_m3"] * pump
        what = (
            f"the pump (or accumulator) must give {pump * LITRES_PER_MINUTE:.1f} l/min at full pressure in these moves"
        )
        if sag > 0.1 * case.machine["supply.pressure_Pa"]:
            what += f"; effects.supply_sag_Pa_s_m3 then takes {sag / BAR:.0f} bar"
            yield Finding(WARNING, "supply.pressure_Pa", what, "slower moves, or a larger pump")
        else:
            yield Finding(NOTE, "supply", what)


def _opening(case: Case, joint: int, name: str) -> Iterator[Finding]:
    m = case.machine
    move = quickest(case.scenario, joint)
    if move is None:
        yield Finding(NOTE, name, f"does not move in {case.scenario.name}")
        return
    segment, rate = move
    worst = max(case.demands, key=lambda d: float(d.opening[:, joint].max()))
    opening = worst.opening[:, joint]
    n = int(np.argmax(opening))
    most, load = float(opening[n]), worst.load_kg
    quick = f"the move to {segment.target_rad:g} rad in {segment.duration_s:g} s ({rate:.2f} rad/s at its peak)"
    if math.isinf(most):
        weak = worst.force[int(np.argmin(worst.room[:, joint])), joint]
        what = (
            f"too weak: with {load:g} kg, {quick} needs {weak / 1e3:.1f} kN, more than the cylinder has between "
            "tank and "
            "supply pressure"
        )
        yield Finding(ERROR, f"{name}.bore_m", what, "slower moves, less load, a larger bore, or more supply pressure")
        return
    overlap = m[f"{name}.valve_overlap"]
    spool, longest = most + overlap, segment.duration_s
    what = f"{quick} opens the valve to {spool:.0%} at most, with {load:g} kg"
    if spool > 1.0:
        needed = most / (OPENING_TIGHT - overlap) * m[f"{name}.valve_kv"]
        slower = longest * most / (OPENING_TIGHT - overlap)
        what = (
            f"saturated: {quick} needs {spool:.0%} of the valve, with {load:g} kg; the arm falls behind its reference"
        )
        advice = (
            f"a valve with kv = {needed:.2g}, or {slower:.2g} s for this move (both leave "
            f"{1 - OPENING_TIGHT:.0%} to spare)"
        )
        yield Finding(ERROR, f"{name}.valve_kv", what, advice)
    elif spool > OPENING_TIGHT:
        advice = "a larger valve or a slower move: what is left is what disturbances are fought with"
        yield Finding(WARNING, f"{name}.valve_kv", f"{what}: {1 - spool:.0%} left", advice)
    else:
        yield Finding(NOTE, name, f"{what}: {1 - spool:.0%} in reserve")


def _moving_pressures(case: Case, joint: int, name: str) -> Iterator[Finding]:
    m = case.machine
    for d in case.demands:
        if np.isinf(d.opening[:, joint]).any():
            continue
        pressure = d.pressure[:, joint]
        low, high = float(pressure.min()), float(pressure.max())
        if low < m["supervision.pressure_min_Pa"]:
            side = ("bore", "annulus")[int(np.argmin(pressure.min(axis=0)))]
            what = (
                f"cavitation: with {d.load_kg:g} kg the {side} side falls to {low / BAR:.1f} bar, because the "
                "load pulls "
                "the piston along faster than the valve fills behind it"
            )
            advice = (
                "slower moves that go with the load; a valve that throttles the outlet more than the inlet is "
                "not modelled"
            )
            yield Finding(WARNING, f"{name}.valve_kv", what, advice)
        if high > m["supervision.pressure_max_Pa"]:
            what = (
                f"over-pressure: with {d.load_kg:g} kg a side of the {name} rises to {high / BAR:.0f} bar in "
                "these moves"
            )
            yield Finding(ERROR, "supervision.pressure_max_Pa", what, "slower moves, a larger bore, or a higher limit")


# ---- the loop -----------------------------------------------------------------------------------------


def resonance(case: Case) -> Iterator[Finding]:
    """Hydraulic resonance over the range against valve and gains."""
    m = case.machine
    for joint, name in enumerate(JOINT_NAMES):
        q = cylinder_of(m, joint).angles()
        found = [natural_frequency(m, joint, q, 0.0, load) for load in (0.0, case.full_load_kg)]
        low, high = min(float(f.min()) for f in found), max(float(f.max()) for f in found)
        valve = m[f"{name}.valve_frequency_Hz"]
        k3 = m[f"control.{name}.k3_1_s"] / (2.0 * math.pi)
        what = f"hydraulic resonance {low:.1f} to {high:.1f} Hz; valve {valve:g} Hz, force loop k3 {k3:.1f} Hz"
        if valve < VALVE_PER_RESONANCE * high:
            what += f": the valve is not {VALVE_PER_RESONANCE:g} times as fast as the resonance it has to cancel"
            advice = "a faster valve, or more volume between valve and cylinder; check the lever arm and the inertia"
            yield Finding(WARNING, f"{name}.valve_frequency_Hz", what, advice)
        else:
            yield Finding(NOTE, name, what)
        if high < 0.3:
            yield Finding(
                WARNING, "oil.bulk_modulus_Pa", f"a resonance of {high:.2f} Hz is that of no arm", "check the units"
            )
    observer = m["control.observer_rad_s"]
    fastest = max(m[f"control.{name}.k2_1_s"] for name in JOINT_NAMES)
    if observer < 2.0 * fastest:
        what = f"{observer:g} rad/s is not twice k2 ({fastest:g} 1/s): the rate it gives lags what is done with it"
        yield Finding(WARNING, "control.observer_rad_s", what, f"{4.0 * fastest:.0f} or more, or lower gains")


def margins(case: Case) -> Iterator[Finding]:
    """Stability of the linear loop at both ends and in the middle, with and without load."""
    m = case.machine
    for joint, name in enumerate(JOINT_NAMES):
        gains = loop_gains(m, joint)
        found = least_margin(m, joint, gains, tuple(d.load_kg for d in case.demands))
        valve = 2.0 * math.pi * m[f"{name}.valve_frequency_Hz"]
        figures = (
            f"k1 {gains.k1:g}, k2 {gains.k2:g}, k3 {gains.k3:g} 1/s, valve {valve:.0f} rad/s, delay "
            f"{1e3 * m['io.command_delay_s']:g} ms"
        )
        advice = "--propose shows gains with a margin; k3 at most a third of the valve's rad/s, k2 0.3 and k1 0.2 of k3"
        if not found.stable:
            what = f"unstable: the loop rings up with {figures}, robust terms at their bounds"
            yield Finding(ERROR, f"control.{name}.k3_1_s", what, advice)
        elif found.up < MARGIN_TIGHT_UP or found.down > MARGIN_TIGHT_DOWN:
            what = (
                f"little margin: it rings when the valve passes {found.up:.2f} or {found.down:.2f} times what "
                f"it should ({figures})"
            )
            yield Finding(WARNING, f"control.{name}.k3_1_s", what, advice)
        else:
            what = f"stable while the valve passes {found.down:.2f} to {found.up:.2f} times what it should ({figures})"
            yield Finding(NOTE, name, what)


def noise(case: Case) -> Iterator[Finding]:
    """What encoder noise does to the spool."""
    m = case.machine
    encoder = m["sensors.encoder_noise_rad"] / math.sqrt(3.0)
    observer = m["control.observer_rad_s"]
    for joint, name in enumerate(JOINT_NAMES):
        c = cylinder_of(m, joint)
        middle = 0.5 * (c.q_min + c.q_max)
        volume1, volume2 = c.volumes(middle)
        drop = 0.5 * (m["supply.pressure_Pa"] - m["supply.tank_Pa"])
        gain = c.kv * math.sqrt(drop) * float(c.area1 / volume1 + c.area2 / volume2)
        g = loop_gains(m, joint)
        H = float(inertia(m, joint, 0.0, case.full_load_kg))
        compliance = m["estimator.prior.beta_inverse_1_Pa.value"]
        rms = g.k3 * compliance * g.k2 * H / float(c.lever(middle)) * observer * encoder / gain
        if rms > SPOOL_NOISE_MOST:
            what = (
                f"encoder noise of {m['sensors.encoder_noise_rad']:g} rad shakes the {name}'s spool by about "
                f"{rms:.0%} of its travel"
            )
            yield Finding(
                WARNING, "sensors.encoder_noise_rad", what, "a better encoder, a slower observer, or lower k2, k3"
            )


def estimate(case: Case) -> Iterator[Finding]:
    """Priors and noise of the estimator against load and friction."""
    m, full = case.machine, case.full_load_kg
    high, sd = m["estimator.prior.m_t_kg.high"], m["estimator.prior.m_t_kg.sd"]
    heaviest, _ = heaviest_held(m)
    if m["estimator.prior.m_t_kg.low"] > 0.0:
        what = "no load at all is outside the estimate's range"
        yield Finding(ERROR, "estimator.prior.m_t_kg.low", what, "a little below 0, for noise")
    if full and sd < full / 3.0:
        what = f"{sd:g} kg says that a load of {full:g} kg is hardly to be expected: it is found slowly"
        yield Finding(WARNING, "estimator.prior.m_t_kg.sd", what, f"about the heaviest load, {full:g}")
    if high > 3.0 * max(heaviest, 0.0) and high > 1.6 * full:
        what = f"{high:g} kg is far beyond what the cylinder holds ({heaviest:.3g} kg)"
        yield Finding(
            WARNING, "estimator.prior.m_t_kg.high", what, "1.5 times the heaviest load; the robust gain grows with it"
        )
    scale = gravity_torque(m, 0.0, full) - gravity_torque(m, 0.0, 0.0)
    torque_noise = m["estimator.wrist.torque_noise_Nm"]
    if full and torque_noise > 0.2 * scale:
        what = (
            f"{torque_noise:g} N m is {torque_noise / scale:.0%} of the torque of {full:g} kg: the load is hardly seen"
        )
        yield Finding(
            WARNING,
            "estimator.wrist.torque_noise_Nm",
            what,
            f"a sixth of the Coulomb friction: {m['wrist.coulomb_Nm'] / 6.0:.2g}",
        )
    gate = m["estimator.gate_rate_rad_s"]
    for joint, name in enumerate(JOINT_NAMES):
        peak = float(np.abs(case.motion.w[:, joint]).max())
        if 0.0 < peak < 2.0 * gate:
            what = (
                f"the {name} moves at {peak:.3f} rad/s at most, the gate opens at {gate:g}: nothing is learned from it"
            )
            yield Finding(
                WARNING, "estimator.gate_rate_rad_s", what, f"a twentieth of the peak rate: {0.05 * peak:.2g}"
            )
    low, high = m["wrist.q_min_rad"], m["wrist.q_max_rad"]
    cosines = np.cos(np.linspace(low, high, 61))
    if float(np.ptp(cosines)) < 0.1:
        what = (
            f"over {low:g} to {high:g} rad cos(q) changes by {np.ptp(cosines):.2f}: gravity looks like a "
            "constant offset"
        )
        yield Finding(WARNING, "wrist.q_max_rad", what, "commissioning needs a wrist that is also raised or lowered")


# ---- limits and numbers -------------------------------------------------------------------------------


def limits(case: Case) -> Iterator[Finding]:
    """Supervision against what a healthy machine does."""
    m = case.machine
    supply, tank = m["supply.pressure_Pa"], m["supply.tank_Pa"]
    for joint, name in enumerate(JOINT_NAMES):
        key, limit = f"supervision.{name}.rate_rad_s", m[f"supervision.{name}.rate_rad_s"]
        peak = float(np.abs(case.motion.w[:, joint]).max())
        noisy = 2.0 * m["sensors.encoder_noise_rad"] / 1e-3
        if peak + noisy > limit:
            what = (
                f"{limit:g} rad/s trips SENSOR_RATE in these moves: {peak:.2f} rad/s and {noisy:.2f} rad/s of "
                "encoder noise"
            )
            fast = max(1.3 * fastest_rate(m, joint), 3.0 * peak)
            yield Finding(ERROR, key, what, f"what the full valve can do and some more: {fast:.2g}")
        elif peak + noisy > 0.8 * limit:
            yield Finding(
                WARNING, key, f"{limit:g} rad/s is hardly more than the {peak:.2f} rad/s of these moves", "raise it"
            )
    if m["supervision.pressure_max_Pa"] <= supply:
        what = (
            f"{m['supervision.pressure_max_Pa'] / BAR:.0f} bar is not above the supply pressure "
            f"({supply / BAR:.0f} bar)"
        )
        yield Finding(ERROR, "supervision.pressure_max_Pa", what, f"1.5 times the supply pressure: {1.5 * supply:.2g}")
    if m["supervision.pressure_range_Pa"] < m["supervision.pressure_max_Pa"]:
        what = "the sensors end below the over-pressure limit, which is then never seen"
        yield Finding(
            WARNING, "supervision.pressure_range_Pa", what, "the end of the sensors' range, above pressure_max_Pa"
        )
    if m["supervision.pressure_min_Pa"] >= tank > 0.0:
        what = (
            f"the cavitation limit is not below the tank pressure ({tank / BAR:.1f} bar): a chamber that "
            "drains trips it"
        )
        yield Finding(ERROR, "supervision.pressure_min_Pa", what, f"a tenth of the tank pressure: {0.1 * tank:.2g}")
    worst = 0.0
    for joint in range(2):
        c = cylinder_of(m, joint)
        smallest = c.dead_volume + c.area2 * c.margin
        flow = max(float(demand.opening[:, joint].max()) for demand in case.demands) * c.kv * math.sqrt(supply)
        worst = max(worst, flow / smallest / m["estimator.prior.beta_inverse_1_Pa.value"] * 1e-3)
    step = m["supervision.pressure_step_Pa"]
    if step < 0.3 * worst:
        what = (
            f"{step / BAR:.0f} bar in a tick; the valve as open as in these moves makes up to {worst / BAR:.0f} bar "
            "at a piston's end"
        )
        yield Finding(
            WARNING, "supervision.pressure_step_Pa", what, f"{1.2 * worst:.2g}, or SENSOR_RATE stops a healthy arm"
        )


def safe_stop(case: Case) -> Iterator[Finding]:
    """Whether the cylinders can stop the arm in the time that is asked for."""
    m = case.machine
    stop_s = m["supervision.stop_s"]
    for joint, name in enumerate(JOINT_NAMES):
        stop = stop_from_peak(m, joint, case.motion, case.full_load_kg, stop_s)
        if stop.brake > stop.spare:
            what = (
                f"a stop from {stop.rate:.2f} rad/s within {stop_s:g} s takes {stop.brake:.0f} N m with "
                f"{case.full_load_kg:g} kg; the {name}'s cylinder has {stop.spare:.0f} N m to spare where its "
                "lever arm is "
                "shortest: it overshoots"
            )
            advice = f"stop_s = {min(stop.shortest_s, 2.0):.2g}, or slower moves"
            yield Finding(WARNING, "supervision.stop_s", what, advice)


def bases(case: Case) -> Iterator[Finding]:
    """Whether the firmware starts with this machine, in every number type."""
    refusal = firmware_refusal(case.machine)
    if "build it" in refusal:
        yield Finding(NOTE, "base", f"not checked against the firmware: {refusal}")
    elif refusal:
        advice = "--propose finds exponents that fit; a parameter that is named may itself be out of proportion"
        yield Finding(ERROR, "base", f"the firmware does not take these numbers: {refusal}", advice)
    else:
        say = ", ".join(f"{key.split('_')[0]} 2^{value}" for key, value in case.machine.base.items())
        yield Finding(NOTE, "base", f"double, float and fixed all start with these numbers ({say})")


def with_lines(findings: list[Finding], line_of: Callable[[str], int | None]) -> list[Finding]:
    """The findings with the lines of their keys; ``line_of`` tells the line of a key."""
    return [replace(f, line=f.line or line_of(f.key)) for f in findings]
