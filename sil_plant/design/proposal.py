"""What no data sheet says, proposed from what one does: per-unit bases, gains, limits and priors, each with its reason.

The rules are scaling laws. Their factors are those of two machines tuned by hand, the reference arm (10 kg, 100 bar,
120 Hz valves) and the loader (200 kg, 180 bar, 60 Hz): what the two have in common when it is put in terms of valve
bandwidth, load, friction and full flow. tests/sil/test_check_arm.py holds how well machines run with them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import product

import numpy as np

from sil_plant.config import ConfigError
from sil_plant.design.linear_loop import LoopGains, has_margin, least_margin
from sil_plant.inputs.machine import BASE_KEYS, JOINT_NAMES, Machine, load_parameter_table, parameter_image
from sil_plant.inputs.scenario import Scenario
from sil_plant.loop.inproc import SCALARS, InprocEcu
from sil_plant.plant.statics import (
    Motion,
    cylinder_of,
    fastest_rate,
    inertia,
    motion_of,
    natural_frequency,
    stop_from_peak,
)

# Gains as shares of the valve's corner frequency, and of one another.
K3_PER_VALVE = 1.0 / 3.0
K2_PER_K3, K1_PER_K3, OBSERVER_PER_VALVE = 0.3, 0.2, 0.53
ROBUST_1_PER_K2, ROBUST_2_PER_K3 = 0.12, 0.1
KAPPA1_PER_K2_SQUARED, KAPPA2_PER_K3_SQUARED = 0.2, 0.01
MU_PER_SPRING = 0.5
# All gains are lowered together until the loop has these margins (linear_loop.py).
MARGIN_UP, MARGIN_DOWN = 1.5, 0.6
SMALLEST_SCALE = 0.2

HIGHEST_PRESSURE_PA = 320e5  # of the frames
PRESSURE_BASE_SHARE = (1.2, 4.8)
AREA_BASE_SHARE = (0.9, 3.6)
LEVER_BASE_SHARE = (0.45, 0.9)


@dataclass(frozen=True)
class Proposal:
    """One value, and why."""

    key: str
    value: float
    reason: str


def two_digits(value: float) -> float:
    """Rounded to two significant digits: what is proposed is not known better."""
    return float(f"{value:.2g}")


class Proposer:
    """Collects the proposals for one machine.

    Parameters
    ----------
    machine : Machine
        Its physical part is all that is looked at.
    scenario : Scenario
        The moves it is to make.
    full_load_kg : float
        The heaviest load it is to carry.
    """

    def __init__(self, machine: Machine, scenario: Scenario, full_load_kg: float) -> None:
        self.machine = machine
        self.full_load_kg = full_load_kg
        self.found: dict[str, Proposal] = {}
        motion = motion_of(scenario)
        self.motion: Motion = motion
        self.peak_rate = [max(float(np.abs(motion.w[:, j]).max()), 0.05) for j in range(2)]
        self.peak_acceleration = [max(float(np.abs(motion.a[:, j]).max()), 0.1) for j in range(2)]

    def add(self, key: str, value: float, reason: str) -> float:
        """Note a value, inside what the firmware accepts."""
        entry = next((e for e in load_parameter_table().entries if e.name == key), None)
        if entry is not None:
            value = min(max(value, entry.low), entry.high)
        self.found[key] = Proposal(key, value, reason)
        return value

    # ---- priors of the estimator -----------------------------------------------------------------

    def priors(self) -> None:
        """Ranges and standard deviations of what is estimated."""
        m, full = self.machine, max(self.full_load_kg, 0.1)
        self.prior("m_t_kg", full, -0.1 * full, 1.5 * full, "wide open: sd the full load, range -10 % to 150 % of it")
        rod = m["estimator.prior.J_kgm2.value"]
        self.prior("J_kgm2", 0.01 * rod, 0.2 * rod, 3.0 * rod, "held: sd 1 % of m2 L2^2 / 3; range 0.2 to 3 times it")
        mass = m["wrist.mass_kg"]
        self.prior("m2_kg", 0.004 * mass, 0.2 * mass, 2.5 * mass, "held: sd 0.4 % of wrist.mass_kg; 0.2 to 2.5 times")
        for joint in JOINT_NAMES:
            viscous, coulomb = m[f"{joint}.viscous_Nms_rad"], m[f"{joint}.coulomb_Nm"]
            floor = 1e-3 * self.torque_scale(JOINT_NAMES.index(joint))
            viscous, coulomb = max(viscous, floor), max(coulomb, floor)
            self.prior(f"fv_{joint}_Nms_rad", 0.03 * viscous, 0.0, 5.0 * viscous, "held: sd 3 % of viscous_Nms_rad")
            self.prior(f"fc_{joint}_Nm", 0.04 * coulomb, 0.0, 6.0 * coulomb, "held: sd 4 % of coulomb_Nm")
            share = 0.03 if joint == "swing" else 0.01
            why = f"sd {100 * share:g} % of coulomb_Nm" + (
                ": no more, or it passes for gravity" if joint == "wrist" else ""
            )
            self.prior(f"Om1_{joint}_Nm", share * coulomb, -5.0 * coulomb, 5.0 * coulomb, why)
        compliance = m["estimator.prior.beta_inverse_1_Pa.value"]
        self.prior(
            "beta_inverse_1_Pa", 0.1 * compliance, 0.6 * compliance, 2.5 * compliance, "sd 10 %, range 0.6 to 2.5 times"
        )
        for joint in range(2):
            flow = self.full_flow(joint)
            for name in ("Om2", "Om3"):
                why = "sd 0.07 %, range 1.5 % of the flow at full opening and half the supply pressure"
                self.prior(f"{name}_{JOINT_NAMES[joint]}_m3_s", 7e-4 * flow, -0.015 * flow, 0.015 * flow, why)

    def prior(self, name: str, sd: float, low: float, high: float, reason: str) -> None:
        """One prior; its value follows from the other sections of the file."""
        stem = f"estimator.prior.{name}"
        self.add(f"{stem}.sd", two_digits(sd), reason)
        self.add(f"{stem}.low", two_digits(low), "")
        self.add(f"{stem}.high", two_digits(high), "")

    def full_flow(self, joint: int) -> float:
        """Flow at full opening over half the supply pressure, m^3/s."""
        m = self.machine
        return m[f"{JOINT_NAMES[joint]}.valve_kv"] * math.sqrt(0.5 * m["supply.pressure_Pa"])

    def full_QL(self, joint: int) -> float:
        """QL at full opening in the middle of the range, m^2/s."""
        c = cylinder_of(self.machine, joint)
        volume1, volume2 = c.volumes(0.5 * (c.q_min + c.q_max))
        return self.full_flow(joint) * float(c.area1 / volume1 + c.area2 / volume2)

    def torque_scale(self, joint: int) -> float:
        """Torque of the full load: to be held by the wrist, to be accelerated by the swing, N m."""
        m, load = self.machine, max(self.full_load_kg, 0.1)
        l1, l2 = m["swing.link_length_m"], m["wrist.link_length_m"]
        if joint == 1:
            return m["arm.gravity_m_s2"] * l2 * load + load * l2**2 * self.peak_acceleration[1]
        return load * (l1 + l2) ** 2 * self.peak_acceleration[0]

    def estimator(self) -> None:
        """Filter, gate and noise."""
        m = self.machine
        slowest = min(2.0 * math.pi * f for f in m.pair("*.valve_frequency_Hz"))
        self.add(
            "estimator.filter_time_s",
            two_digits(min(max(22.0 / slowest, 0.01), 0.2)),
            f"22 over the slower valve's {slowest:.0f} rad/s: what the valve does is inside the filter's band",
        )
        rate = min(self.peak_rate)
        self.add(
            "estimator.gate_rate_rad_s",
            two_digits(min(max(0.05 * rate, 0.01), 0.1)),
            f"5 % of the slower joint's peak rate, {rate:.2f} rad/s: below, friction at rest looks like load",
        )
        self.add(
            "estimator.load_walk_kg",
            two_digits(3e-4 * max(self.full_load_kg, 0.1)),
            "3e-4 of the full load in a second of motion",
        )
        self.add("estimator.rate_limit_1_s", 20.0, "a range in 50 ms; the same for every machine so far")
        self.add("estimator.innovation_limit_sd", 3.0, "the same for every machine so far")
        self.add("estimator.flow_error", 0.03, "what a valve's data sheet is good to")
        for joint, name in enumerate(JOINT_NAMES):
            c = cylinder_of(m, joint)
            friction = max(m[f"{name}.coulomb_Nm"], 1e-2 * self.torque_scale(joint)) / 6.0
            noise = float(c.lever(c.angles()).max()) * m["sensors.pressure_noise_Pa"] * math.hypot(c.area1, c.area2)
            self.add(
                f"estimator.{name}.torque_noise_Nm",
                two_digits(math.hypot(friction, noise)),
                f"a sixth of the Coulomb friction and the pressure noise's {noise:.2g} N m, squares added",
            )
            self.add(
                f"estimator.{name}.flow_noise_m2_s",
                two_digits(self.full_QL(joint) / 3000.0),
                "QL at full opening / 3000",
            )

    # ---- the law -------------------------------------------------------------------------------------

    def control(self) -> None:
        """Gains that the valve, the delay and the resonance leave room for."""
        m = self.machine
        loads = (0.0, self.full_load_kg)
        scales = [self.scale_for_margin(joint, loads) for joint in range(2)]
        slowest = min(2.0 * math.pi * f for f in m.pair("*.valve_frequency_Hz"))
        self.add(
            "control.observer_rad_s",
            two_digits(OBSERVER_PER_VALVE * slowest),
            f"{OBSERVER_PER_VALVE} of the slower valve's corner, {slowest:.0f} rad/s",
        )
        for joint, name in enumerate(JOINT_NAMES):
            self.joint_gains(joint, name, scales[joint])

    def linear_gains(self, joint: int, scale: float) -> LoopGains:
        """The gains of a joint at a share of what the valve alone would allow."""
        m, name = self.machine, JOINT_NAMES[joint]
        valve = 2.0 * math.pi * m[f"{name}.valve_frequency_Hz"]
        k3 = two_digits(scale * K3_PER_VALVE * valve)
        k2, k1 = two_digits(K2_PER_K3 * k3), two_digits(K1_PER_K3 * k3)
        c = cylinder_of(m, joint)
        middle = 0.5 * (c.q_min + c.q_max)
        return LoopGains(
            observer=two_digits(OBSERVER_PER_VALVE * valve),
            k1=k1,
            k2=k2,
            k3=k3,
            kappa1=two_digits(KAPPA1_PER_K2_SQUARED * k2**2),
            kappa2=two_digits(KAPPA2_PER_K3_SQUARED * k3**2),
            w1_over_w2=two_digits(min(MU_PER_SPRING * float(c.stiffness(middle)), 0.05)),
            k2s1=two_digits(ROBUST_1_PER_K2 * k2),
            k2s2=two_digits(ROBUST_2_PER_K3 * k3),
            spool_lead=0.4,
        )

    def scale_for_margin(self, joint: int, loads: tuple[float, ...]) -> float:
        """The largest share, at most 1, at which the loop has its margins everywhere."""
        scale = 1.0
        while scale > SMALLEST_SCALE:
            if has_margin(self.machine, joint, self.linear_gains(joint, scale), loads, MARGIN_DOWN, MARGIN_UP):
                break
            scale *= 0.93
        return scale

    def joint_gains(self, joint: int, name: str, scale: float) -> None:
        """The law's gains and bounds of one joint."""
        m, key = self.machine, f"control.{name}"
        g = self.linear_gains(joint, scale)
        valve = 2.0 * math.pi * m[f"{name}.valve_frequency_Hz"]
        found = least_margin(m, joint, g, (0.0, self.full_load_kg))
        self.add(f"{key}.k1_1_s", g.k1, f"{K1_PER_K3} k3: angle slower than rate, rate slower than force")
        self.add(f"{key}.k2_1_s", g.k2, f"{K2_PER_K3} k3")
        self.add(
            f"{key}.k3_1_s",
            g.k3,
            f"{scale * K3_PER_VALVE:.2f} of the valve's {valve:.0f} rad/s (at most 1/3); rings at "
            f"{found.up:.2g} times the flow (wanted {MARGIN_UP:g})",
        )
        self.add(f"{key}.kappa1_1_s2", g.kappa1, f"{KAPPA1_PER_K2_SQUARED:g} k2^2")
        self.add(f"{key}.kappa2_1_s2", g.kappa2, f"{KAPPA2_PER_K3_SQUARED:g} k3^2")
        self.add(
            f"{key}.w1_over_w2_m", g.w1_over_w2, f"{MU_PER_SPRING:g} lamA: half of the oil's own spring acts on errors"
        )
        self.robust(joint, key, g)
        self.add(f"{key}.spool_lead", g.spool_lead, "the same for every machine so far")
        self.pid(joint, key)

    def robust(self, joint: int, key: str, g: LoopGains) -> None:
        """Bounds of the fast compensation and of the robust terms."""
        m = self.machine
        heaviest = 1.5
        gamma1 = two_digits(1.5 * heaviest * self.torque_scale(joint) + self.friction(joint))
        what = "held" if joint == 1 else "accelerated"
        why = f"1.5 times the heaviest load of the range (150 % of the full one) {what}, and friction"
        self.add(f"{key}.gamma1_max_Nm", gamma1, why)
        gamma2 = two_digits(0.1 * self.full_QL(joint))
        self.add(f"{key}.gamma2_max_m2_s", gamma2, "10 % of QL at full opening: what valve and supply may be off by")
        # Eq 22: k2s = (gamma_M + uncertainty)^2 / (4 eta) reaches its bound when the uncertainty is gamma_M, too
        H = float(inertia(m, joint, 0.0, self.full_load_kg))
        compliance = m["estimator.prior.beta_inverse_1_Pa.value"]
        self.add(
            f"{key}.eta1_Nm_rad_s",
            two_digits((2.0 * gamma1) ** 2 / (4.0 * g.k2s1 * H)),
            "Eq 22: the robust gain reaches its bound at full load when the unknown is twice gamma1_max",
        )
        self.add(
            f"{key}.eta2_Nm2_s",
            two_digits((1.5 * gamma2) ** 2 / (4.0 * g.k2s2 * compliance)),
            "Eq 22: the same at one and a half times gamma2_max",
        )
        self.add(f"{key}.k2s1_max_1_s", g.k2s1, f"{ROBUST_1_PER_K2:g} k2")
        self.add(f"{key}.k2s2_max_1_s", g.k2s2, f"{ROBUST_2_PER_K3:g} k3")

    def friction(self, joint: int) -> float:
        """Friction at the joint's peak rate, N m."""
        m, name = self.machine, JOINT_NAMES[joint]
        return m[f"{name}.coulomb_Nm"] + m[f"{name}.viscous_Nms_rad"] * self.peak_rate[joint]

    def pid(self, joint: int, key: str) -> None:
        """The baseline: slow against the resonance, which nothing but friction damps."""
        m, c = self.machine, cylinder_of(self.machine, joint)
        lowest = 2.0 * math.pi * float(natural_frequency(m, joint, c.angles(), 0.0, self.full_load_kg).min())
        middle = float(c.lever(0.5 * (c.q_min + c.q_max)))
        rate = fastest_rate(m, joint) * float(c.lever(c.angles()).min()) / middle
        kp = two_digits(0.4 * lowest / rate)
        why = f"0.4 of the lowest resonance ({lowest:.0f} rad/s) over the rate at full opening ({rate:.1f} rad/s)"
        self.add(f"{key}.pid_kp", kp, why + "; tools/tune_pid.py finds better")
        self.add(f"{key}.pid_ki", two_digits(kp * 0.2 * lowest), "half of that speed again")
        self.add(f"{key}.pid_kd", 0.0, "")

    # ---- limits and bases ----------------------------------------------------------------------------

    def supervision(self) -> None:
        """Limits beyond what a healthy machine does."""
        m = self.machine
        supply, tank = m["supply.pressure_Pa"], m["supply.tank_Pa"]
        cylinders = [cylinder_of(m, joint) for joint in range(2)]
        ratio = max(c.area1 / c.area2 for c in cylinders)
        highest = two_digits(min(max(1.2 * ratio, 1.5) * supply, 0.94 * HIGHEST_PRESSURE_PA))
        steps = []
        for c in cylinders:
            smallest = c.dead_volume + c.area2 * c.margin
            flow = c.kv * math.sqrt(supply)
            steps.append(flow / smallest / m["estimator.prior.beta_inverse_1_Pa.value"] * 1e-3)
        add = self.add
        add("supervision.sensor_wrong_ticks", 4, "4 ms of prediction at most")
        why = "1.2 times what a valve can do in 1 ms to the smallest volume"
        add("supervision.pressure_step_Pa", two_digits(1.2 * max(steps)), why)
        sensors = two_digits(min(1.25 * highest, HIGHEST_PRESSURE_PA))
        add(
            "supervision.pressure_range_Pa", sensors, "put the end of YOUR sensors' range here; 1.25 times pressure_max"
        )
        add("supervision.angle_range_rad", 0.2, "beyond the stops no angle is real")
        add("supervision.stuck_rad", 0.003, "many steps of an encoder")
        add("supervision.stuck_s", 0.1, "many samples of pressure noise")
        add("supervision.mismatch_updates", 25, "the same for every machine so far")
        add("supervision.contradiction_rad_s", 0.1, "the same for every machine so far")
        add("supervision.spool_error", 0.3, "the same for every machine so far")
        spare = min(c.margin / float(c.lever(np.array([c.q_min, c.q_max])).max()) for c in cylinders)
        why = f"a third of the spare stroke ({spare:.2g} rad), 0.02 at most"
        add("supervision.angle_margin_rad", two_digits(min(spare / 3.0, 0.02)), why)
        why = f"1.2 times supply times the areas' ratio {ratio:.2f}, to which a rod side can rise; 1.5 times at least"
        add("supervision.pressure_max_Pa", highest, why)
        add("supervision.pressure_min_Pa", two_digits(0.1 * tank), "a tenth of the tank pressure")
        add("supervision.persist_s", 0.05, "no shorter than a valve's transient")
        far = 0.15
        add("supervision.tracking_error_rad", far, "three times what a PID loop is behind in such moves")
        add("supervision.saturation_s", 0.3, "a move that needs the whole valve for longer is too fast")
        add("supervision.bound_s", 0.5, "a load beyond the range is one for longer than this")
        add("supervision.late_ticks", 20, "strict pace: 2 % of a second")
        add("supervision.send_ticks", 5, "a bus that is gone, not one that is busy")
        stops = [stop_from_peak(m, joint, self.motion, self.full_load_kg, 0.2).shortest_s for joint in range(2)]
        stop_s = min(max(two_digits(1.2 * max(stops)), 0.2), 2.0)
        add(
            "supervision.stop_s",
            stop_s,
            f"1.2 times what the cylinders need with the full load, {max(stops):.2f} s; 0.2 at least",
        )
        for joint, name in enumerate(JOINT_NAMES):
            rate = fastest_rate(m, joint)
            why = f"1.3 times what the full valve does at the shortest lever arm, {rate:.1f} rad/s"
            add(f"supervision.{name}.rate_rad_s", two_digits(max(1.3 * rate, 3.0 * self.peak_rate[joint])), why)

    def bases(self) -> None:
        """Powers of two that bring pressures, areas and lever arms to order one, and that all number types accept."""
        m = self.machine
        cylinders = [cylinder_of(m, joint) for joint in range(2)]
        area = math.sqrt(cylinders[0].area1 * cylinders[1].area1)
        lever = math.sqrt(math.prod(float(c.lever(c.angles()).max()) for c in cylinders))
        ideal = (
            _exponent(m["supply.pressure_Pa"], PRESSURE_BASE_SHARE, 2),
            _exponent(area, AREA_BASE_SHARE, 2),
            _exponent(lever, LEVER_BASE_SHARE, 1),
        )
        bases = load_parameter_table().bases
        limits = [bases[key] for key in BASE_KEYS]
        ideal = tuple(min(max(e, low), high) for e, (low, high) in zip(ideal, limits, strict=True))
        chosen, refused = self.accepted_bases(ideal, limits, bases["torque_log2"])
        say = "supply pressure", "bore areas", "lever arms"
        sizes = m["supply.pressure_Pa"], area, lever
        for key, what, size, exponent, share in zip(
            BASE_KEYS,
            say,
            sizes,
            chosen,
            (PRESSURE_BASE_SHARE, AREA_BASE_SHARE, LEVER_BASE_SHARE),
            strict=True,
        ):
            why = f"{what}: {size / 2.0**exponent:.2g} per unit (aim {share[0]:g} to {share[1]:g})"
            self.add(f"base.{key}", exponent, why + (f"; {refused}" if refused else ""))

    def accepted_bases(
        self, ideal: tuple[int, ...], limits: list[tuple[int, int]], torque: tuple[int, int]
    ) -> tuple[tuple[int, ...], str]:
        """The exponents nearest to the ideal ones that the firmware takes, and what it says if it takes none."""
        near = [
            (ideal[0] + 2 * p, ideal[1] + 2 * a, ideal[2] + r)
            for p, a, r in product((0, -1, 1), (0, -1, 1), (0, -1, 1, 2))
        ]
        near = [
            e
            for e in near
            if torque[0] <= sum(e) <= torque[1]
            and all(low <= x <= high for x, (low, high) in zip(e, limits, strict=True))
        ]
        near.sort(key=lambda e: sum(abs(x - y) for x, y in zip(e, ideal, strict=True)))
        problem = "no exponents are possible"
        for exponents in near:
            values = {key: p.value for key, p in self.found.items() if not key.startswith("base.")}
            base = dict(zip(BASE_KEYS, exponents, strict=True))
            problem = firmware_refusal(
                Machine(self.machine.name, self.machine.path, base, self.machine.values | values)
            )
            if not problem:
                return exponents, ""
        return (near[0] if near else ideal), problem


def _exponent(size: float, share: tuple[float, float], step: int) -> int:
    """The exponent, a multiple of ``step``, that brings a size into the share."""
    middle = math.log2(size / math.sqrt(share[0] * share[1]))
    return step * round(middle / step)


def firmware_refusal(machine: Machine) -> str:
    """Why the firmware of one of the number types does not start with this machine; empty if all do."""
    try:
        image = parameter_image(machine)
    except (KeyError, OverflowError) as error:
        return f"no parameter image can be made ({error})"
    for scalar in SCALARS:
        try:
            InprocEcu(image, scalar=scalar)
        except ConfigError as error:
            return f"number type {scalar}: {error}"
    return ""


def propose(machine: Machine, scenario: Scenario, full_load_kg: float) -> dict[str, Proposal]:
    """Values for everything that is not on a data sheet.

    Parameters
    ----------
    machine : Machine
        Only its physical sections are used.
    scenario : Scenario
        The moves it is to make.
    full_load_kg : float
        The heaviest load it is to carry.
    """
    proposer = Proposer(machine, scenario, full_load_kg)
    proposer.control()
    proposer.supervision()
    proposer.estimator()
    proposer.priors()
    proposer.bases()
    order = {key: n for n, key in enumerate(_order())}
    return dict(sorted(proposer.found.items(), key=lambda item: order[item[0]]))


def _order() -> list[str]:
    """Keys in the order of a machine file: whole sections together."""
    keys = [f"base.{key}" for key in BASE_KEYS]
    names = [entry.name for entry in load_parameter_table().entries]
    for section in ("control", "supervision", "estimator"):
        mine = [name for name in names if name.startswith(f"{section}.")]
        stems = list(dict.fromkeys(name.rsplit(".", 1)[0] for name in mine))
        keys += [
            name
            for stem in sorted(stems, key=lambda s: s.count("."))
            for name in mine
            if name.rsplit(".", 1)[0] == stem
        ]
    return keys


def number(value: float) -> str:
    """A number as TOML, as short as it can be."""
    if isinstance(value, int):
        return str(value)
    text = f"{value:.6g}".replace("e+0", "e").replace("e-0", "e-")
    return text if any(c in text for c in ".en") else f"{text}.0"


def as_toml(proposals: dict[str, Proposal], reasons: bool = True) -> str:
    """Proposals as TOML sections that can be pasted into a machine file."""
    lines: list[str] = []
    section = None
    for key, proposal in proposals.items():
        where, name = key.rsplit(".", 1)
        if where != section:
            lines += ["", f"[{where}]"] if lines else [f"[{where}]"]
            section = where
        text = f"{name} = {number(proposal.value)}"
        comment = proposal.reason if reasons else ""
        lines.append(f"{text:<32}# {comment}" if comment else text)
    return "\n".join(lines) + "\n"
