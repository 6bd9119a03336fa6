"""tools/check_arm.py: every planted mistake is found, no sound machine is blamed, and what is proposed runs."""

from __future__ import annotations

import contextlib
import io
import json
import os
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from sil_plant.design import linear_loop
from sil_plant.design.proposal import propose
from sil_plant.experiments import experiment
from sil_plant.inputs.machine import ARMS, BASE_KEYS, JOINT_NAMES, REFERENCE_ARM, Machine, load_machine
from sil_plant.inputs.scenario import DEFAULT_SCENARIO, SCENARIOS, load_profile, load_scenario, with_load
from sil_plant.plant import dynamics, statics
from tools import check_arm

REFERENCE_TEXT = REFERENCE_ARM.read_text(encoding="utf-8")
LOADER = ("sil_plant/arms/loader.toml", "--load", "200", "--scenario", str(SCENARIOS / "loader.toml"))
PROPOSED = re.compile(r"^\[(base|control|supervision|estimator)")


class Checked(NamedTuple):
    """One run of the tool."""

    status: int
    out: str
    err: str


@pytest.fixture
def check() -> Callable[..., Checked]:
    """Run the tool in this process: its imports take longer than all it does."""

    def run(*arguments: object) -> Checked:
        out, err = io.StringIO(), io.StringIO()
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            status = check_arm.main([str(word) for word in arguments])
        return Checked(status, out.getvalue(), err.getvalue())

    return run


def physical_only(text: str) -> str:
    """A machine file without what is proposed."""
    kept, inside = [], False
    for line in text.splitlines():
        if line.startswith("["):
            inside = bool(PROPOSED.match(line))
        if not inside:
            kept.append(line)
    return "\n".join(kept) + "\n"


def test_a_sound_machine_is_not_blamed(check: Callable[..., Checked]) -> None:
    """GIVEN the two machines that run WHEN checked with their loads and moves THEN nothing but notes."""
    for arguments in ((REFERENCE_ARM, "--load", 10), (ARMS / "loader.toml", *LOADER[1:])):
        result = check(*arguments)
        assert result.status == 0 and "0 errors, 0 warnings" in result.out, result.out


MISTAKES = [
    ("bore_m = 0.032", "bore_m = 32", "error", "swing.bore_m", "0.032 if 32 is in mm"),
    ("pressure_Pa = 100e5", "pressure_Pa = 100", "error", "supply.pressure_Pa", "if 100 is in bar"),
    ("q_max_rad = 1.2\nend_margin_m = 0.010\nvalve_kv = 6e-8", "q_max_rad = 60\nend_margin_m = 0.010\nvalve_kv = 6e-8",
     "error", "swing.q_max_rad", "in degrees"),
    ("valve_kv = 6e-8", "valve_kv = 4", "error", "swing.valve_kv", "l/min per sqrt"),
    ("crank_b_m = 0.09", "crank_b_mm = 90", "error", "swing.crank_b_mm", "is it swing.crank_b_m"),
    ("mass_kg = 5.0", "weight_kg = 5.0", "error", "wrist.weight_kg", "is it wrist.mass_kg"),
    ("bore_m = 0.032", 'bore_m = "32 mm"', "error", "swing.bore_m", "no quotation marks"),
    ("bore_m = 0.032", "bore_m = nan", "error", "swing.bore_m", "correct it"),
    ("bore_m = 0.032", "bore_m = [0.032]", "error", "swing.bore_m", "a number from"),
    ("rod_m = 0.018", "rod_m = 0.036", "error", "swing.rod_m", "swapped"),
    ("crank_q0_rad = 1.35", "crank_q0_rad = 2.0", "error", "swing.q_max_rad", "dead point"),
    ("crank_q0_rad = 1.60", "crank_q0_rad = 1.85", "warning", "wrist.q_max_rad", "near a dead point"),
    ("crank_a_m = 0.35\ncrank_b_m = 0.09", "crank_a_m = 0.1\ncrank_b_m = 0.09", "error", "swing.crank_a_m",
     "no such cylinder"),
    ("dead_volume_m3 = 50e-6", "dead_volume_m3 = 0.05", "warning", "swing.dead_volume_m3", "the piston sweeps"),
    ("valve_kv = 6e-8", "valve_kv = 2e-8", "error", "swing.valve_kv", "saturated"),
    ("valve_kv = 6e-8", "valve_kv = 3e-8", "warning", "swing.valve_kv", "left"),
    ("bore_m = 0.025\nrod_m = 0.014", "bore_m = 0.010\nrod_m = 0.005", "error", "wrist.bore_m", "does not hold 10 kg"),
    ("swing_inertia_kgm2 = 3.0", "swing_inertia_kgm2 = 3000.0", "error", "swing.bore_m", "too weak"),
    ("k3_1_s = 250.0\nkappa1_1_s2 = 1200.0", "k3_1_s = 700.0\nkappa1_1_s2 = 1200.0", "error", "control.swing.k3_1_s",
     "unstable"),
    ("observer_rad_s = 400.0", "observer_rad_s = 100.0", "warning", "control.observer_rad_s", "twice k2"),
    ("valve_frequency_Hz = 120.0\nvalve_damping = 0.8\nleakage_m3_s_Pa = 2e-13\nviscous_Nms_rad = 4.0",
     "valve_frequency_Hz = 20.0\nvalve_damping = 0.8\nleakage_m3_s_Pa = 2e-13\nviscous_Nms_rad = 4.0",
     "warning", "wrist.valve_frequency_Hz", "as fast as the resonance"),
    ("encoder_noise_rad = 5e-5", "encoder_noise_rad = 1e-3", "warning", "sensors.encoder_noise_rad", "shakes"),
    ("high = 15.0", "high = 8.0", "error", "estimator.prior.m_t_kg.high", "below the load of 10 kg"),
    ("[supervision.swing]\nrate_rad_s = 4.0", "[supervision.swing]\nrate_rad_s = 0.5", "error",
     "supervision.swing.rate_rad_s", "SENSOR_RATE"),
    ("pressure_max_Pa = 200e5", "pressure_max_Pa = 90e5", "error", "supervision.pressure_max_Pa",
     "not above the supply"),
    ("pressure_min_Pa = 0.3e5", "pressure_min_Pa = 5e5", "error", "supervision.pressure_min_Pa", "tank"),
    ("stop_s = 0.2", "stop_s = 0.02", "warning", "supervision.stop_s", "overshoots"),
    ("pressure_log2 = 22", "pressure_log2 = 21", "error", "base.pressure_log2", "odd"),
    ("area_log2 = -12", "area_log2 = -18", "error", "base", "three exponents|does not take"),
]  # fmt: skip


@pytest.mark.parametrize(("good", "bad", "severity", "key", "says"), MISTAKES)
def test_a_planted_mistake_is_found_where_it_is(
    check: Callable[..., Checked], tmp_path: Path, good: str, bad: str, severity: str, key: str, says: str
) -> None:
    """GIVEN the reference arm with one mistake WHEN checked THEN a finding names key and remedy; errors exit with 1."""
    assert good in REFERENCE_TEXT
    path = tmp_path / "arm.toml"
    path.write_text(REFERENCE_TEXT.replace(good, bad, 1), encoding="utf-8")
    result = check(path, "--load", 10, "--json")
    report = json.loads(result.out)
    found = [f for f in report["findings"] if f["severity"] == severity and f["key"].startswith(key)]
    assert any(re.search(says, f"{f['what']} {f['advice']}") for f in found), report["findings"]
    assert all(f["advice"] for f in found)
    assert severity == "warning" or (result.status == 1 and not report["works"])


def test_a_move_outside_the_range_is_found(check: Callable[..., Checked], tmp_path: Path) -> None:
    """GIVEN moves beyond the joint's range WHEN checked THEN it says what was asked for and what is possible."""
    path = tmp_path / "far.toml"
    path.write_text("[[wrist.segment]]\ntarget_rad = 1.5\nduration_s = 3.0\n", encoding="utf-8")
    result = check(REFERENCE_ARM, "--scenario", path)
    assert result.status == 1 and "wrist.q_max_rad" in result.out and "it can -1 to 1.2" in result.out


@pytest.mark.parametrize(
    ("content", "status", "says"),
    [
        (b"", 1, "swing.bore_m: is missing"),
        (b"this is no = toml = at all", 1, "not valid TOML"),
        (b"[swing\nbore_m = 1", 1, "not valid TOML"),
        (b"\xff\xfe\x00\x01", 2, "not UTF-8"),
        (b"swing = 3", 1, "is a section, not a number"),
        (b"[[swing]]\nbore_m = 1", 1, "swing"),
        (b"name = 5", 1, "a text is needed"),
        (b"zzz = 5", 1, "remove it"),
    ],
)
def test_nonsense_gets_a_message_and_not_a_traceback(
    check: Callable[..., Checked], tmp_path: Path, content: bytes, status: int, says: str
) -> None:
    """GIVEN what is no machine file WHEN checked, proposed for, and to be completed THEN a message, and no file."""
    path = tmp_path / "arm.toml"
    path.write_bytes(content)
    assert (result := check(path)).status == status and says in result.out + result.err
    written = tmp_path / "whole.toml"
    result = check(path, "--propose", "--write", written, "--plots", tmp_path / "plots")
    assert result.status == status and not written.exists() and not (tmp_path / "plots").exists()
    assert result.err


def test_a_file_that_cannot_be_read_is_wrong_use(check: Callable[..., Checked], tmp_path: Path) -> None:
    """GIVEN a folder, no file, or one without the right to read WHEN checked THEN status 2 and what to do."""
    assert (result := check(tmp_path)).status == 2 and "is a folder" in result.err
    assert (result := check(tmp_path / "none.toml")).status == 2 and "check the path" in result.err
    assert (result := check(REFERENCE_ARM, "--load", "-3")).status == 2 and "--load" in result.err
    assert (result := check(REFERENCE_ARM, "--load", "nan")).status == 2 and "--load" in result.err
    assert (result := check(REFERENCE_ARM, "--plots", REFERENCE_ARM)).status == 2 and "is no folder" in result.err
    assert (result := check(REFERENCE_ARM, "--write", tmp_path / "no" / "file.toml")).status == 2
    if os.geteuid() != 0:
        locked = tmp_path / "locked.toml"
        locked.write_text(REFERENCE_TEXT, encoding="utf-8")
        locked.chmod(0)
        assert (result := check(locked)).status == 2 and "cannot be read" in result.err


def test_completing_a_file_keeps_what_its_author_wrote(check: Callable[..., Checked], tmp_path: Path) -> None:
    """GIVEN a file with comments and one gain of its own WHEN completed
    THEN the copy loads, has both, and the values of the original.
    """
    path, whole = tmp_path / "arm.toml", tmp_path / "whole.toml"
    mine = physical_only(REFERENCE_TEXT) + "\n[control.swing]   # mine\nk1_1_s = 33.0\n"
    path.write_text(mine, encoding="utf-8")
    result = check(path, "--load", 10, "--write", whole)
    assert result.status == 0, result.out
    text, machine = whole.read_text(encoding="utf-8"), load_machine(whole)
    assert "# mine" in text and "# uniform, amplitude (the paper's)" in text
    assert machine["control.swing.k1_1_s"] == 33.0
    reference = load_machine(REFERENCE_ARM)
    for key in reference.values:
        if key.split(".")[0] in ("swing", "wrist", "arm", "supply", "io", "sensors", "oil"):
            assert machine[key] == reference[key]


def test_a_file_of_dotted_keys_is_completed_as_well(check: Callable[..., Checked], tmp_path: Path) -> None:
    """GIVEN a file without section headers WHEN completed THEN the copy loads with the same values."""
    path, whole = tmp_path / "arm.toml", tmp_path / "whole.toml"
    reference = load_machine(REFERENCE_ARM)
    physical = ("swing", "wrist", "arm", "supply", "io", "sensors", "oil")
    lines = [f"{key} = {value!r}" for key, value in reference.values.items() if key.split(".")[0] in physical]
    path.write_text("\n".join(lines) + "\ncontrol.swing.k1_1_s = 33.0\n", encoding="utf-8")
    assert check(path, "--load", 10, "--write", whole).status == 0
    machine = load_machine(whole)
    assert machine["swing.bore_m"] == reference["swing.bore_m"] and machine["control.swing.k1_1_s"] == 33.0


def test_plots_are_drawn_the_same_every_time(check: Callable[..., Checked], tmp_path: Path) -> None:
    """GIVEN a machine WHEN drawn twice THEN four files with the same bytes."""
    for folder in ("a", "b"):
        assert check(REFERENCE_ARM, "--plots", tmp_path / folder).status == 0
    names = sorted(p.name for p in (tmp_path / "a").iterdir())
    assert names == [f"reference_{what}.{kind}" for what in ("geometry", "moves") for kind in ("png", "svg")]
    for name in names:
        data = (tmp_path / "a" / name).read_bytes()
        assert len(data) > 10_000 and data == (tmp_path / "b" / name).read_bytes()


# ---- what it computes, against the simulation ---------------------------------------------------------


@pytest.mark.parametrize("load", [0.0, 10.0])
def test_opening_and_pressures_are_not_off_the_simulated_ones(load: float) -> None:
    """GIVEN the benchmark WHEN its demand is worked out and simulated
    THEN the references agree to their frame's resolution, peak openings within 12 %, pressures within 4 bar.
    """
    machine = load_machine(REFERENCE_ARM)
    scenario = replace(load_scenario(DEFAULT_SCENARIO), duration_s=3.9)
    motion = statics.motion_of(scenario, 1e-3)
    demand = statics.demand(machine, motion, load)
    run = experiment.simulate(experiment.setup_for(machine, load_profile("paper"), with_load(scenario, load))).session
    start = run.timeline.motion
    time_s = (np.arange(len(run.record.state)) - start) * 1e-3
    for joint in range(2):
        wanted = np.interp(time_s[start:], motion.time_s, motion.q[:, joint])
        assert np.abs(run.record.reference[start:, joint] - wanted).max() < 5e-3  # told once in 10 ticks
        spool = np.abs(run.record.state[start:, dynamics.XV + joint])
        assert demand.opening[:, joint].max() == pytest.approx(spool.max(), rel=0.12)
        middle = (time_s > 0.5) & (time_s < 1.0)
        for side in range(2):
            simulated = run.record.state[middle, dynamics.P_SWING + 2 * joint + side]
            worked_out = np.interp(time_s[middle], motion.time_s, demand.pressure[:, joint, side])
            assert np.abs(simulated - worked_out).max() < 4e5


def test_the_heaviest_load_is_what_the_plant_holds() -> None:
    """GIVEN the load said to be the heaviest WHEN the plant holds 1 % less and 1 % more THEN it can, and cannot."""
    machine = load_machine(REFERENCE_ARM)
    heaviest, where = statics.heaviest_held(machine)
    parameters = dynamics.plant_parameters(machine)
    dynamics.holding_pressures(parameters, np.array([0.0, where]), 0.99 * heaviest)
    with pytest.raises(ValueError, match="wrist cylinder cannot hold"):
        dynamics.holding_pressures(parameters, np.array([0.0, where]), 1.01 * heaviest)


@pytest.mark.parametrize("joint", [0, 1])
def test_the_loop_rings_where_its_margin_says(joint: int, open_limits: dict[str, float]) -> None:
    """GIVEN a plant whose valve passes more than the law believes WHEN below and above the margin by 13 %
    THEN the arm is quiet, and rings.
    """
    machine = load_machine(REFERENCE_ARM)
    # without the supervision that would stop an arm that rings
    machine = replace(machine, values=machine.values | open_limits)
    key = f"{JOINT_NAMES[joint]}.valve_kv"
    margin = linear_loop.least_margin(machine, joint, linear_loop.loop_gains(machine, joint), (3.0,))
    rough = []
    for factor in (margin.up / 1.13, margin.up * 1.13):
        scenario = replace(load_scenario(DEFAULT_SCENARIO), duration_s=3.0, plant={key: factor * machine[key]})
        outcome = experiment.simulate(experiment.setup_for(machine, load_profile("paper"), with_load(scenario, 3.0)))
        rough.append(float(np.std(np.diff(outcome.session.record.command[-400:, joint]))))
    assert rough[0] < 0.08 < 0.15 < rough[1], (margin, rough)


# ---- what it proposes ---------------------------------------------------------------------------------

TRACKING, BASELINE = 3.0, 2.0  # times the error of the machine tuned by hand


def with_proposals(machine: Machine, scenario_name: str, full_kg: float) -> Machine:
    """The machine with everything proposed that can be."""
    found = propose(machine, load_scenario(SCENARIOS / f"{scenario_name}.toml"), full_kg)
    values = {key: float(p.value) for key, p in found.items() if not key.startswith("base.")}
    base = {key: int(found[f"base.{key}"].value) for key in BASE_KEYS}
    return replace(machine, base=base, values=machine.values | values)


@pytest.mark.parametrize(("name", "moves", "full_kg"), [("reference", "paper", 10.0), ("loader", "loader", 200.0)])
def test_proposed_gains_do_not_track_much_worse_than_those_tuned_by_hand(name: str, moves: str, full_kg: float) -> None:
    """GIVEN a machine tuned by hand WHEN everything that can be proposed is replaced
    THEN peak errors are within 3 times (PID: 2 times), and loads are estimated within 0.1 % of the full one.
    """
    hand = load_machine(ARMS / f"{name}.toml")
    machine = with_proposals(hand, moves, full_kg)
    scenario = load_scenario(SCENARIOS / f"{moves}.toml")
    for controller, factor in (("diarc", TRACKING), ("pid", BASELINE)):
        for load in (0.0, full_kg):
            peaks = []
            for which in (hand, machine):
                setup = experiment.setup_for(
                    which, load_profile("paper"), with_load(scenario, load), controller=controller
                )
                outcome = experiment.simulate(setup)
                assert not outcome.faulted
                peaks.append(np.array(outcome.result.peak_err_after_1s_rad))
                if controller == "diarc":
                    assert abs(outcome.result.load_err_kg) < 1e-3 * full_kg
            assert np.all(peaks[1] <= factor * peaks[0]), (controller, load, peaks)


def test_what_is_proposed_passes_the_check_and_says_why(check: Callable[..., Checked], tmp_path: Path) -> None:
    """GIVEN the physical part of both machines WHEN proposed for THEN it works, and each value has a reason."""
    for arm, arguments in ((REFERENCE_ARM, ("--load", "10")), (ARMS / "loader.toml", LOADER[1:])):
        path = tmp_path / arm.name
        path.write_text(physical_only(arm.read_text(encoding="utf-8")), encoding="utf-8")
        result = check(path, *arguments, "--propose", "--json")
        report = json.loads(result.out)
        assert result.status == 0 and report["works"], report["findings"]
        for key, proposal in report["proposals"].items():
            assert proposal["reason"] or key.endswith((".low", ".high", "pid_kd")), key
