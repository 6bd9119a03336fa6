"""Commission, then operate: what the move shows, what it must not claim, and what operation makes of it."""

from __future__ import annotations

import re
import socket
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sil_plant.bus.ecu_parameters import RefusedError
from sil_plant.config import ConfigError
from sil_plant.experiments import commissioning, experiment
from sil_plant.inputs.machine import ARMS, REFERENCE_ARM, Machine, load_machine, parameter_image, with_changes
from sil_plant.inputs.scenario import (
    DEFAULT_SCENARIO,
    SCENARIOS,
    Scenario,
    load_profile,
    load_scenario,
    with_load,
)
from sil_plant.loop import execution, session
from sil_plant.loop.inproc import InprocEcu, run_inproc
from sil_plant.loop.results import run_of, summarise
from sil_plant.loop.session import THETA

ROOT = Path(__file__).resolve().parents[2]
TUNING_SEED, RUN_SEED = 41, 7


def commission_py(*arguments: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    """Run tools/commission.py as a user does."""
    command = [sys.executable, str(ROOT / "tools" / "commission.py"), *arguments]
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True, timeout=120, check=False)


@pytest.fixture(scope="module")
def paper() -> Scenario:
    return load_scenario(DEFAULT_SCENARIO)


@pytest.fixture(scope="module")
def reference() -> Machine:
    return load_machine(REFERENCE_ARM)


@pytest.fixture(scope="module")
def stored(tmp_path_factory: pytest.TempPathFactory) -> tuple[subprocess.CompletedProcess[str], Path]:
    """A commissioning run of the command line tool and what it stored."""
    folder = tmp_path_factory.mktemp("commission")
    return commission_py("-o", "set.toml", cwd=folder), folder / "set.toml"


def test_a_wrong_machine_file_does_not_stay_wrong(reference: Machine) -> None:
    """GIVEN an ECU whose machine file is 25 % off WHEN commissioned
    THEN every parameter is the plant's within 5 %, 1/be within 10 %, and not by being given it.
    """
    paper_profile = load_profile("paper")
    off = {
        f"estimator.prior.{prior}.value": 1.25 * reference[f"estimator.prior.{prior}.value"]
        for _, prior in THETA[1:]
        if reference[f"estimator.prior.{prior}.value"] != 0.0
    }
    _, found = experiment.commission(with_changes(reference, off, "test"), paper_profile, seed=TUNING_SEED)
    assert len(found) == 13
    for finding in found:
        true = reference[f"estimator.prior.{finding.prior}.value"]
        bound = 0.10 if finding.name == "beta_inverse" else 0.05
        if true != 0.0:
            assert finding.value == pytest.approx(true, rel=bound), finding
            assert abs(finding.value - finding.nominal) > 0.1 * true  # it moved there
        else:
            assert abs(finding.value) < 4.0 * finding.allowed_sd, finding
        assert not finding.poor


def test_commissioned_arm_does_not_weigh_worse_than_the_paper(reference: Machine, paper: Scenario) -> None:
    """GIVEN a wrist of 6 kg that the machine file says weighs 5 WHEN commissioned and loaded
    THEN the load is right within 0.005 kg; without commissioning it is off by half the kilogram.
    """
    profile = load_profile("paper")
    heavier = {"wrist.mass_kg": 6.0}
    setup = experiment.setup_for(reference, profile, with_load(paper, 5.0), seed=RUN_SEED)
    plant = with_changes(setup.plant_machine, heavier, "test")
    raw = experiment.simulate(replace(setup, plant_machine=plant)).result
    assert 0.4 < raw.load_err_kg < 0.6
    move = replace(load_scenario(commissioning.COMMISSION_SCENARIO), plant=heavier)
    known, _ = experiment.commission(reference, profile, TUNING_SEED, move)
    good = experiment.simulate(replace(setup, machine=known, plant_machine=plant)).result
    assert 1e-5 < abs(good.load_err_kg) < 0.005


def test_run_after_commission_does_not_forget_what_was_found(reference: Machine, paper: Scenario) -> None:
    """GIVEN a wrist of 6 kg that the machine file says weighs 5 WHEN commissioned, then run with 5 kg, the ECU never
    off THEN the load is right within the paper's bar, which it is not by the kilogram that was found.
    """
    plant = with_changes(reference, {"wrist.mass_kg": 6.0}, "test")
    period_s = execution.PERIOD_US * 1e-6
    ecu = InprocEcu(parameter_image(reference), execution.PERIOD_US)
    move = load_scenario(commissioning.COMMISSION_SCENARIO)
    first = session.make_session(plant, move, "diarc", TUNING_SEED, period_s, start_request=session.REQUEST_COMMISSION)
    ticks = len(first.noise)
    standby = session.motion_frame(14, session.REQUEST_STANDBY)
    schedule = first.schedule._replace(
        frame_tick=np.append(first.schedule.frame_tick, ticks - 400),
        frame_row=np.vstack([first.schedule.frame_row, standby]),
    )
    run_inproc(first._replace(schedule=schedule), ecu, ticks + 1)
    assert set(first.record.mode) >= {session.MODE_STANDBY, session.MODE_COMMISSION}
    assert session.MODE_RUN not in first.record.mode
    assert first.monitor.whole[session.MODE] == session.MODE_STANDBY
    second = session.make_session(plant, with_load(paper, 5.0), "diarc", RUN_SEED, period_s)
    run_inproc(second, ecu, len(second.noise) + 1)
    assert execution.outcome(second) is None
    result = summarise(second.record, run_of(second, "diarc", reference.name, paper.name, RUN_SEED, "inproc", 1.0))
    assert 1e-6 < abs(result.load_err_kg) < 0.003
    assert 1e-6 < max(v for v in result.peak_err_after_1s_rad if v is not None) < 1e-4


def test_run_that_ended_in_another_mode_is_not_a_success(reference: Machine) -> None:
    """GIVEN a commissioning run WHEN judged THEN good as one, and as no other; a plain run is not commissioning."""
    move = replace(load_scenario(commissioning.COMMISSION_SCENARIO), duration_s=0.5)
    setup = experiment.commissioning_setup(reference, load_profile("paper"), 1, move)
    commissioned = experiment.simulate(setup).session
    assert execution.outcome(commissioned, session.MODE_COMMISSION) is None
    assert "in COMMISSION, not in RUN" in str(execution.outcome(commissioned))
    plain = experiment.simulate(replace(setup, start_request=session.REQUEST_RUN)).session
    assert "in RUN, not in COMMISSION" in str(execution.outcome(plain, session.MODE_COMMISSION))


def test_table_does_not_hide_a_parameter(stored: tuple[subprocess.CompletedProcess[str], Path]) -> None:
    """GIVEN a commissioning run WHEN it ends THEN each parameter stands there with sd and excitation."""
    result, path = stored
    assert result.returncode == 0, result.stderr
    for name, _ in THETA[1:]:
        assert re.search(rf"^{name} +(-?[\d.e+-]+ +){{3}}\d+ ", result.stdout, flags=re.MULTILINE), name
    assert path.exists() and path.with_suffix(".params").stat().st_size > 500


def test_stored_set_does_not_differ_from_what_operation_starts_from(
    stored: tuple[subprocess.CompletedProcess[str], Path], reference: Machine
) -> None:
    """GIVEN a stored set WHEN loaded THEN exactly the commissioned values replace the machine file's."""
    machine = commissioning.load_commissioned(stored[1], reference)
    changed = {key for key in machine.values if machine.values[key] != reference.values[key]}
    assert changed and all(re.fullmatch(r"estimator\.prior\.\w+\.value", key) for key in changed)
    assert "estimator.prior.m_t_kg.value" not in changed


def test_set_of_another_machine_is_not_taken(stored: tuple[subprocess.CompletedProcess[str], Path]) -> None:
    """GIVEN the reference arm's set WHEN loaded for the loader THEN it is refused, naming both."""
    with pytest.raises(ConfigError, match=r"set\.toml:2: machine: .*\"reference\".*\"loader\""):
        commissioning.load_commissioned(stored[1], load_machine(ARMS / "loader.toml"))


def test_poor_move_does_not_store_what_it_has_not_seen(tmp_path: Path) -> None:
    """GIVEN a move of the swing alone WHEN commissioned THEN refused, naming the wrist's parameters; nothing stored."""
    scenario = (SCENARIOS / "commission.toml").read_text(encoding="utf-8")
    (tmp_path / "swing.toml").write_text(scenario.split("[[wrist.segment]]")[0], encoding="utf-8")
    result = commission_py("--scenario", "swing.toml", "-o", "set.toml", cwd=tmp_path)
    assert result.returncode == 2
    refusal = result.stderr.splitlines()[-1]
    assert "fv2" in refusal and "fc2" in refusal and "move the wrist" in refusal and "fv1" not in refusal
    assert not (tmp_path / "set.toml").exists() and not (tmp_path / "set.params").exists()


def test_bus_does_not_change_what_is_found(
    stored: tuple[subprocess.CompletedProcess[str], Path], tmp_path: Path
) -> None:
    """GIVEN the same move over TCP with the real ECU process WHEN commissioned THEN the same set, byte for byte."""
    arguments = ("--bus", "tcp:127.0.0.1:0", "--ecu", "spawn", "--pace", "lockstep", "-o", "set.toml")
    result = commission_py(*arguments, cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert (tmp_path / "set.toml").read_bytes() == stored[1].read_bytes()


def test_ecu_does_not_forget_what_it_was_to_save(
    stored: tuple[subprocess.CompletedProcess[str], Path], tmp_path: Path
) -> None:
    """GIVEN an ECU that keeps its parameters WHEN commissioned with --save
    THEN its memory has the very image that the tool wrote, found on it as in process.
    """
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        bus = f"tcp:127.0.0.1:{free.getsockname()[1]}"
    command = [str(execution.ECU_BINARY), bus, "--pace", "lockstep", "--quiet", "--store", str(tmp_path / "store")]
    with subprocess.Popen(command, stderr=subprocess.DEVNULL) as ecu:
        try:
            result = commission_py("--bus", bus, "--save", "-o", "set.toml", cwd=tmp_path)
        finally:
            ecu.terminate()
    assert result.returncode == 0, result.stderr
    assert (tmp_path / "set.toml").read_bytes() == stored[1].read_bytes()
    assert (tmp_path / "set.params").read_bytes() in (tmp_path / "store").read_bytes()


class OtherEcu:
    """As EcuParameters, of an ECU with a machine of its own that refuses one parameter."""

    def __init__(self, machine: Machine) -> None:
        self.own = parameter_image(machine)
        self.changed: list[str] = []
        self.saved = False

    def image(self) -> bytes:
        return self.own

    def change(self, values: dict[str, float]) -> None:
        self.changed += values

    def save(self) -> None:
        self.saved = True


def test_set_is_not_saved_in_another_machines_ecu(reference: Machine) -> None:
    """GIVEN an ECU whose arm has another link WHEN the set is to be saved in it THEN refused, naming the parameter and
    the next step; an ECU that differs in what was commissioned alone takes it.
    """
    _, found = experiment.commission(
        reference, load_profile("paper"), 1, replace(load_scenario(commissioning.COMMISSION_SCENARIO), duration_s=1.0)
    )
    other = OtherEcu(with_changes(reference, {"wrist.link_length_m": 0.41}, "test"))
    with pytest.raises(RefusedError, match=r"wrist\.link_length_m is 0\.41.*params\.py load"):
        commissioning.save_in_ecu(other, reference, found)
    assert not other.changed and not other.saved
    older = OtherEcu(with_changes(reference, {"estimator.prior.m2_kg.value": 5.5}, "test"))
    commissioning.save_in_ecu(older, reference, found)
    assert len(older.changed) == 13 and older.saved


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("--save",), r"--save is for an ECU that stays"),
        (("--save", "--bus", "slcan:/dev/null"), r"--save needs a bus that two programs can share"),
        (("--arm", "none.toml"), r"none\.toml: cannot be read"),
        (("-o", "no/where.toml"), r"no/where\.toml: its folder does not exist"),
        (("--bus", "nonsense:1"), r"nonsense"),
        (("--profile", "ideal"), r"--help"),
    ],
)
def test_bad_input_does_not_leave_the_user_guessing(arguments: tuple[str, ...], says: str, tmp_path: Path) -> None:
    """GIVEN wrong arguments WHEN commissioned THEN status 2 and one line that names them."""
    result = commission_py(*arguments, cwd=tmp_path)
    assert result.returncode == 2 and result.stdout == ""
    assert re.fullmatch(rf"commission\.py: [^\n]*{says}[^\n]*\n", result.stderr), result.stderr


def test_changed_load_is_not_missed(reference: Machine) -> None:
    """GIVEN 5 kg picked up at 4 s and dropped at 7 s, in the middle of a move WHEN run
    THEN within 0.1 kg 0.5 s after the first motion that follows, no fault, peak error at most 5 mrad.
    """
    profile = load_profile("paper")
    known, _ = experiment.commission(reference, profile, TUNING_SEED)
    scenario = load_scenario(SCENARIOS / "load_change.toml")
    outcome = experiment.simulate(experiment.setup_for(known, profile, scenario, seed=RUN_SEED))
    record, motion = outcome.session.record, outcome.session.timeline.motion
    error = np.abs(record.load_est - record.load_true)[motion:]
    for begin, end in ((4500, 7000), (7500, 10000)):
        assert error[begin:end].max() < 0.1
    assert error[4050:4100].max() > 1.0  # it did change
    assert not outcome.faulted
    assert 1e-4 < max(outcome.result.peak_err_rad) < 5e-3


EFFECT_GROUPS = {
    "stribeck": ["effects.stribeck"],
    "hysteresis": ["effects.hysteresis"],
    "air": ["effects.air_bulk_low_Pa"],
    "sag": ["effects.supply_sag_Pa_s_m3"],
    "encoder": ["effects.encoder_bits"],
    "gain": ["effects.pressure_gain_error"],
    "offset": ["effects.pressure_offset_Pa"],
    "jitter": ["effects.sync_jitter_s"],
    "loss": ["effects.frame_loss"],
    "viscosity": ["effects.viscosity_factor"],
    "overlap": ["swing.valve_overlap", "wrist.valve_overlap"],
    "friction": ["arm.friction_at_cylinder"],
}


@pytest.mark.parametrize("group", list(EFFECT_GROUPS))
def test_effect_is_not_a_switch_without_a_wire(group: str, reference: Machine, paper: Scenario) -> None:
    """GIVEN one effect of the realistic profile, set from a scenario WHEN run THEN the plant moves differently."""
    realistic = load_profile("realistic")
    values = realistic.effects | realistic.machine
    change = {key: values[key] for key in EFFECT_GROUPS[group]}
    short = replace(with_load(paper, 3.0), duration_s=1.0)
    profile = load_profile("paper")
    plain = experiment.simulate(experiment.setup_for(reference, profile, short)).result
    changed = experiment.simulate(experiment.setup_for(reference, profile, replace(short, plant=change))).result
    assert changed.trace_sha256 != plain.trace_sha256


def test_no_effect_of_the_profile_is_untested() -> None:
    """GIVEN the realistic profile WHEN compared with the groups above THEN none is left out."""
    tested = {key for keys in EFFECT_GROUPS.values() for key in keys}
    tested |= {
        "effects.stribeck_rate_rad_s",
        "effects.air_bulk_high_Pa",
        "effects.air_pressure_Pa",
        "effects.sensor_set",
    }
    realistic = load_profile("realistic")
    assert set(realistic.effects) | set(realistic.machine) == tested


@pytest.mark.parametrize(("profile_name", "bar_kg"), [("paper", 0.003), ("realistic", 0.05)])
@pytest.mark.parametrize("load_kg", [1.3, 8.6])
def test_load_nobody_tuned_for_is_not_weighed_wrong(
    profile_name: str, bar_kg: float, load_kg: float, reference: Machine, paper: Scenario
) -> None:
    """GIVEN loads and seeds that no other file names WHEN commissioned and run
    THEN the load is within 1.5 times the bar and tracking within 1.5 mrad.
    """
    profile = load_profile(profile_name)
    known, _ = experiment.commission(reference, profile, TUNING_SEED)
    result = experiment.simulate(experiment.setup_for(known, profile, with_load(paper, load_kg), seed=1234)).result
    assert abs(result.load_err_kg) < 1.5 * bar_kg
    assert 1e-6 < max(v for v in result.peak_err_after_1s_rad if v is not None) < 1.5e-3


@pytest.mark.parametrize("profile_name", ["paper", "realistic"])
def test_second_machine_is_not_a_special_case(profile_name: str) -> None:
    """GIVEN the loader with 170 kg WHEN commissioned and run THEN the load is within 1 % of its full scale."""
    machine, profile = load_machine(ARMS / "loader.toml"), load_profile(profile_name)
    known, _ = experiment.commission(machine, profile, TUNING_SEED)
    scenario = with_load(load_scenario(SCENARIOS / "loader.toml"), 170.0)
    outcome = experiment.simulate(experiment.setup_for(known, profile, scenario, seed=RUN_SEED))
    assert abs(outcome.result.load_err_kg) < 2.0
    assert not outcome.faulted
