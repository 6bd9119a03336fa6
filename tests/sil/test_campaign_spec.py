"""Specs of campaigns: what is wrong is named, and what is drawn is what the spec says."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from sil_plant.campaigning.sampling import arms, check_arms, note, prepared
from sil_plant.campaigning.spec import CAMPAIGNS, load_campaign
from sil_plant.config import ROOT, ConfigError
from sil_plant.experiments.experiment import setup_for
from sil_plant.inputs.machine import REFERENCE_ARM, load_machine

LOAD = '[[vary]]\nkey = "load_kg"\ndistribution = "uniform"\nlow = 0\nhigh = 10\n'


def entry(key: str, distribution: str, **numbers: object) -> str:
    """A table [[vary]]."""
    rest = "".join(f"{name} = {str(value).lower()}\n" for name, value in numbers.items())
    return f'[[vary]]\nkey = "{key}"\ndistribution = "{distribution}"\n{rest}'


def write(folder: Path, text: str, head: str = "runs = 8\n") -> Path:
    """A spec in a folder."""
    path = folder / "spec.toml"
    path.write_text(head + text, encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (entry("swing.bore", "uniform", low=0.03, high=0.04), r"spec.toml:3: vary.key: swing.bore .*swing.bore_m"),
        (entry("valve_kv", "uniform", low=0.03, high=0.04), r"near it: .*swing.valve_kv"),
        (entry("load_kg", "uniform", low=5, high=5), r"spec.toml:5: vary.low: the range 5 to 5 is empty"),
        (entry("load_kg", "uniform", low=0, high=16), r"load_kg reaches 16, which is 1 outside its range 0 to 15"),
        (
            entry("swing.bore_m", "uniform", relative=True, low=0.9, high=20.0),
            r"swing.bore_m reaches 0.64 \(20 times 0.032\), which is 0.14 outside its range 0.005 to 0.5",
        ),
        (entry("load_kg", "normal", mean=5, sd=1), r"load_kg reaches -1, .* narrow .*low and high"),
        (entry("load_kg", "normal", mean=5, sd=1, low=12, high=14), r"nothing of the normal distribution is left"),
        (entry("load_kg", "normal", mean=5, sd=0, low=1, high=9), r"a standard deviation above 0"),
        (entry("load_kg", "gauss", mean=5), r"'gauss' is no distribution; known are constant, uniform"),
        (entry("load_kg", "uniform", low=1), r"uniform needs high"),
        (entry("load_kg", "uniform", low=1, high=2, sd=3), r"vary.sd: is nothing that uniform has"),
        (entry("load_kg", "log-uniform", low=0, high=2), r"log-uniform needs a low above 0"),
        (entry("load_kg", "triangular", low=0, mode=3, high=2), r"vary.mode: 3 is outside 0 to 2"),
        (entry("load_kg", "choice", values=[]), r"a list of numbers"),
        (entry("load_kg", "choice", values=[1, 2], weights=[1]), r"one weight for each value"),
        (entry("load_kg", "constant", value=3), r"everything is constant"),
        (entry("effects.hysteresis", "uniform", relative=True, low=0.5, high=1.5), r"is 0 without the campaign"),
        (entry("effects.encoder_bits", "uniform", low=12, high=17), r"is a whole number"),
        (entry("swing.segment.1.target_rad", "uniform", low=0, high=1.5), r"0.3 outside its range -1 to 1.2"),
        (entry("swing.segment.9.target_rad", "uniform", low=0, high=1), r"near it: swing.segment"),
        (entry("faults.1.size", "uniform", low=0, high=1), r"nothing that this campaign can vary"),
        (LOAD + LOAD.replace("10", "9"), r"load_kg is there already"),
        (LOAD + LOAD.replace("10", "9") + 'label = "other"\n', r"load_kg is varied already"),
        (LOAD + "\n[limits]\nload_error = 1\n", r"limits.load_error: is no figure of a run"),
        ("", r"a list of tables \[\[vary\]\]"),
        (entry("swing.rod_m", "uniform", low=0.01, high=0.05), r"run \d of 8 cannot be: .*smaller than the bore"),
    ],
)  # fmt: skip
def test_wrong_spec_is_run_or_is_refused_without_saying_what_is_wrong(tmp_path: Path, text: str, said: str) -> None:
    path = write(tmp_path, text)

    def read() -> None:
        campaign = load_campaign(path)
        check_arms(campaign, arms(campaign))

    with pytest.raises(ConfigError) as error:
        read()
    assert re.search(said, str(error.value)), str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("head", "said"),
    [
        ("runs = 0\n", "a whole number from 1"),
        ("", "runs is missing"),
        ("runs = 8\nsampling = 'sobel'\n", "known are sobol"),
        ("runs = 8\nprofil = 'paper'\n", "near it: profile"),
        ("runs = 8\nscenario = 'nowhere.toml'\n", "nowhere.toml is not there"),
        ("runs = 8\ncontroller = 'lqr'\n", "known are pid"),
    ],
)
def test_wrong_head_of_a_spec_is_accepted(tmp_path: Path, head: str, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        load_campaign(write(tmp_path, LOAD, head))


@pytest.mark.parametrize("sampling", ["sobol", "latin-hypercube", "random"])
def test_sample_does_not_follow_its_distribution(tmp_path: Path, sampling: str) -> None:
    text = (
        LOAD
        + entry("swing.bore_m", "normal", relative=True, sd=0.001, low=0.998, high=1.002)
        + entry("swing.leakage_m3_s_Pa", "log-uniform", low=1e-13, high=1e-12)
        + entry("wrist.coulomb_Nm", "triangular", low=1, mode=2, high=4)
        + entry("effects.sensor_set", "integer", low=1, high=4)
        + entry("effects.encoder_bits", "choice", values=[0, 17], weights=[1, 3])
        + entry("supply.tank_Pa", "constant", value=2e5)
    )
    campaign = load_campaign(write(tmp_path, text, f"runs = 1024\nsampling = '{sampling}'\n"))
    found = arms(campaign)
    assert found == arms(campaign)
    drawn = {label: np.array([arm.draws[label] for arm in found]) for label in found[0].draws}
    truth = {
        "load_kg": stats.uniform(0, 10),
        "swing.bore_m": stats.truncnorm(-2, 2, 0.032, 0.000032),
        "swing.leakage_m3_s_Pa": stats.loguniform(1e-13, 1e-12),
        "wrist.coulomb_Nm": stats.triang(1 / 3, 1, 3),
    }
    for label, distribution in truth.items():
        assert stats.kstest(drawn[label], distribution.cdf).pvalue > 1e-4, label
    sets, counts = np.unique(drawn["effects.sensor_set"], return_counts=True)
    assert sets.tolist() == [1, 2, 3, 4] and counts.min() > 200
    assert abs((drawn["effects.encoder_bits"] == 17).mean() - 0.75) < 0.05
    assert set(drawn["supply.tank_Pa"]) == {2e5}
    independent = np.corrcoef(drawn["load_kg"], drawn["swing.bore_m"])[0, 1]
    assert abs(independent) < 0.12
    assert len({arm.seed for arm in found} | {arm.commission_seed for arm in found}) == 2 * len(found)


def test_value_does_not_reach_what_it_is_of(tmp_path: Path) -> None:
    fault = '[[faults]]\nkind = "biased"\ntarget = "swing_bore"\nstart_s = 1\nduration_s = 0.5\nsize = 1e5\n'
    text = fault + (
        entry("load_kg", "uniform", low=1, high=2)
        + entry("swing.bore_m", "uniform", low=0.031, high=0.0319)
        + entry("control.observer_rad_s", "uniform", low=300, high=350)
        + entry("start_pose.wrist_rad", "uniform", low=-0.5, high=-0.4)
        + entry("wrist.segment.2.target_rad", "uniform", low=-0.5, high=-0.4)
        + entry("swing.segment.*.dwell_s", "uniform", low=0.1, high=0.2)
        + entry("wrist.speed_rad_s", "uniform", low=0.5, high=0.7)
        + entry("faults.1.size", "uniform", low=2e5, high=3e5)
    )
    campaign = load_campaign(write(tmp_path, text))
    arm = arms(campaign)[3]
    machine, scenario, move = prepared(campaign.base, arm)
    plant = setup_for(machine, campaign.base.profile, scenario).plant_machine
    nominal = load_machine(REFERENCE_ARM)
    assert [step.load_kg for step in scenario.load] == [arm.draws["load_kg"]]
    assert plant["swing.bore_m"] == arm.draws["swing.bore_m"] != nominal["swing.bore_m"]
    assert machine["swing.bore_m"] == nominal["swing.bore_m"]  # the ECU does not know
    assert machine["control.observer_rad_s"] == arm.draws["control.observer_rad_s"]
    assert scenario.start_pose_rad[1] == arm.draws["start_pose.wrist_rad"]
    assert scenario.segments[1][1].target_rad == arm.draws["wrist.segment.2.target_rad"]
    assert {s.dwell_s for s in scenario.segments[0]} == {arm.draws["swing.segment.*.dwell_s"]}
    stroke = abs(scenario.segments[1][1].target_rad - scenario.segments[1][0].target_rad)
    speed = 35.0 / 16.0 * stroke / scenario.segments[1][1].duration_s
    assert speed == pytest.approx(arm.draws["wrist.speed_rad_s"], rel=1e-3)
    assert scenario.faults[0].size == arm.draws["faults.1.size"]
    assert move is not None and move.plant["swing.bore_m"] == arm.draws["swing.bore_m"]
    assert not move.faults and [step.load_kg for step in move.load] == [0.0]


def test_fault_strikes_every_arm_although_it_is_to_be_present_in_some(tmp_path: Path) -> None:
    fault = '[[faults]]\nkind = "stuck"\ntarget = "swing_angle"\nstart_s = 1\nduration_s = 0.5\n'
    text = fault + LOAD + entry("faults.1.present", "choice", values=[0, 1], weights=[3, 1])
    campaign = load_campaign(write(tmp_path, text, "runs = 64\n"))
    struck = [bool(prepared(campaign.base, arm)[1].faults) for arm in arms(campaign)]
    assert sum(struck) == 16


def test_sobol_sample_that_is_not_balanced_goes_unsaid(tmp_path: Path) -> None:
    unbalanced = load_campaign(write(tmp_path, LOAD, "runs = 1000\nsampling = 'sobol'\n"))
    assert "take 512 or 1024" in str(note(unbalanced))
    assert note(load_campaign(write(tmp_path, LOAD, "runs = 1024\nsampling = 'sobol'\n"))) is None
    assert note(load_campaign(write(tmp_path, LOAD, "runs = 1000\n"))) is None


def test_spec_hash_misses_what_matters_or_minds_what_does_not(tmp_path: Path) -> None:
    def hashed(text: str) -> str:
        return load_campaign(write(tmp_path, text)).spec_hash

    first = hashed(LOAD)
    assert hashed("# a remark\n" + LOAD + "[limits]\nload_err_kg = 0.1\n") == first
    assert hashed(LOAD.replace("10", "9")) != first
    assert hashed("profile = 'realistic'\n" + LOAD) != first


def test_committed_specs_are_wrong() -> None:
    paths = [p for p in CAMPAIGNS.glob("*.toml") if "runs =" in p.read_text(encoding="utf-8")]
    assert paths
    for path in paths:
        campaign = load_campaign(path, 64)
        check_arms(campaign, arms(campaign))
    production = load_campaign(CAMPAIGNS / "production.toml")
    assert production.runs == 1000 and production.base.commission_scenario is not None


def test_documented_example_is_wrong(tmp_path: Path) -> None:
    text = (ROOT / "docs" / "campaigns.md").read_text(encoding="utf-8")
    example = re.search(r"<!-- example -->\n```toml\n(.*?)```\n<!-- end of example -->", text, re.DOTALL)
    assert example
    path = write(tmp_path, example[1].replace("../sil_plant", str(ROOT / "sil_plant")), "")
    campaign = load_campaign(path)
    found = arms(campaign)
    check_arms(campaign, found)
    assert len(found) == 64 and note(campaign) is None
    assert 10 <= sum(bool(prepared(campaign.base, arm)[1].faults) for arm in found) <= 16
