"""The fault matrix: its table, its rules, and the part of it that runs with the other tests. All of it: make faults."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sil_plant.config import ConfigError
from sil_plant.experiments import fault_matrix
from sil_plant.experiments.fault_matrix import Cell, cells, judge, load_cases, measure, one_cell, run
from sil_plant.inputs.faults import KINDS, Fault
from sil_plant.inputs.scenario import Scenario, check_scenario, load_scenario
from sil_plant.loop import session

ROOT_PATH = Path(__file__).resolve().parents[2]
LIMIT_S = 120.0

# Some of every family: kind, target, moment, profile, other keys.
SUBSET = [
    ("dropped", "encoders", "rest", "paper", {"size": 1.0}),
    ("dropped", "sensors", "top", "paper", {"duration_s": 0.001}),
    ("dropped", "sensors", "run", "realistic", {"size": 0.01}),
    ("dropped", "valves", "run", "paper", {"size": 0.01}),
    ("delayed", "valves", "rest", "realistic", {"size": 1.0}),
    ("repeated", "sensors", "top", "realistic", {"size": 4.0}),
    ("wrong_length", "pressures_wrist", "rest", "paper", {"size": 7.0}),
    ("foreign_id", "encoders", "rest", "realistic", {"size": 2.0}),
    ("old_counter", "sensors", "rest", "paper", {"size": 14.0}),
    ("invalid", "swing_spool", "rest", "paper", {}),
    ("noisy", "swing_angle", "top", "paper", {"size": 1e-4}),
    ("sync_jitter", "", "top", "realistic", {"size": 3e-4}),
    ("bus_off", "", "rest", "paper", {}),
    ("alien_traffic", "lower_priority", "top", "paper", {"size": 1.0}),
    ("alien_traffic", "higher_priority", "top", "paper", {"size": 0.25}),
    ("nmt_stop", "", "rest", "paper", {}),
    ("nmt_reset", "", "rest", "realistic", {}),
    ("ecu_killed", "", "top", "paper", {}),
    ("load_dropped", "", "top", "paper", {"size": 0.0}),
    ("dropped", "valves", "top", "paper", {"size": 1.0, "duration_s": 0.2}),
    ("stuck", "swing_angle", "end", "paper", {}),
    ("stuck", "wrist_bore", "top", "realistic", {}),
    ("biased", "wrist_bore", "rest", "realistic", {"size": 4e6}),
    ("biased", "wrist_spool", "end", "paper", {"size": 0.5}),
    ("spiked", "wrist_bore", "rest", "paper", {"size": 5e6}),
    ("noisy", "wrist_annulus", "rest", "paper", {"size": 4e6}),
    ("dbc_mismatch", "", "top", "paper", {}),
    ("supply_lost", "", "end", "paper", {"size": 0.01}),
]


@pytest.mark.parametrize(("kind", "target", "moment", "profile", "keys"), SUBSET)
def test_fault_does_not_pass_with_a_rule_broken(kind: str, target: str, moment: str, profile: str, keys: dict) -> None:
    """GIVEN a cell of the matrix WHEN run twice THEN every rule of the table and of the matrix holds."""
    row = measure(one_cell(kind, target, moment, profile, **keys))
    assert row.passed, row.why


def test_no_kind_of_fault_is_left_out_of_the_matrix() -> None:
    """GIVEN the table WHEN read THEN every kind is in it, with both profiles, and every target of sensors."""
    found = list(cells(load_cases()))
    assert {cell.case.kind for cell in found} == set(KINDS)
    assert {cell.profile for cell in found} == {"paper", "realistic"}
    invalid = {cell.target for cell in found if cell.case.kind == "invalid"}
    assert invalid == set(KINDS["invalid"].targets)


@pytest.fixture(scope="module")
def stopped() -> tuple[Cell, fault_matrix.Outcome]:
    """A run that the ECU stops, and that passes."""
    cell = one_cell("dropped", "encoders", "rest", "paper", size=1.0)
    outcome = run(cell.profile, cell.fault)
    assert judge(cell, outcome, outcome).passed
    return cell, outcome


def with_record(outcome: fault_matrix.Outcome, **arrays: np.ndarray) -> fault_matrix.Outcome:
    return outcome._replace(session=outcome.session._replace(record=outcome.session.record._replace(**arrays)))


def test_rules_do_not_pass_what_they_are_there_to_catch(stopped: tuple[Cell, fault_matrix.Outcome]) -> None:
    """GIVEN a run that passes WHEN one thing in its record is made wrong THEN the row fails and says which."""
    cell, good = stopped
    record, first = good.session.record, int(good.session.injection.plan[0, 2])

    late = record.mode.copy()
    late[first : first + 40] = session.MODE_RUN
    assert "too late" in judge(cell, with_record(good, mode=late), good).why

    never = np.full_like(record.mode, session.MODE_RUN)
    assert "valves not safe" in judge(cell, with_record(good, mode=never), good).why

    moving = record.state.copy()
    moving[first + 600, 2] = 0.5
    assert "not at rest" in judge(cell, with_record(good, state=moving), good).why
    assert "not the same" in judge(cell, with_record(good, state=moving), good).why

    off = record.state.copy()
    off[-50:, 0] += 0.1
    assert "does not follow" in judge(cell, with_record(good, state=off), good).why

    code = record.emergency.copy()
    code[0, 2] = 2
    assert "SENSOR_INVALID instead of" in judge(cell, with_record(good, emergency=code), good).why

    number = record.emergency.copy()
    number[0, 1] = 0x8110
    why = judge(cell, with_record(good, emergency=number), good).why
    assert "SENSOR_FRAMES_LOST with error code 8110h instead of 8100h" in why

    outside = good.session.monitor.whole.copy()
    outside[session.OUTSIDE] = 1
    wrong = good._replace(session=good.session._replace(monitor=good.session.monitor._replace(whole=outside)))
    assert "outside their limits" in judge(cell, wrong, good).why


def test_loss_that_costs_too_much_does_not_pass() -> None:
    """GIVEN half of the frames lost WHEN held against the limit of 1 % loss THEN the row says by how much."""
    cell = one_cell("dropped", "sensors", "run", "paper", size=0.01)
    strict = replace(cell, case=replace(cell.case, error_factor=1.0))
    assert "times that without" in measure(strict).why


def test_tool_does_not_forget_a_row(start, tmp_path: Path) -> None:
    """GIVEN one kind WHEN tools/faults.py runs it THEN JSON and table have each of its rows, and the status fits."""
    path = tmp_path / "faults.json"
    command = [sys.executable, ROOT_PATH / "tools" / "faults.py", "--only", "load_dropped", "--json", path]
    tool = start(command, "faults")
    status = tool.wait(LIMIT_S)
    rows = json.loads(path.read_text("utf-8"))["rows"]
    assert len(rows) == len(list(cells(load_cases(), "load_dropped"))) == 12
    assert status == (0 if all(row["pass"] for row in rows) else 1), tool.err.read_text()
    assert tool.out.read_text().count("load_dropped ") == 12


# ---- the scenario's list -------------------------------------------------------------------------

GOOD = {"kind": '"dropped"', "target": '"encoders"', "start_s": "0.5", "duration_s": "0.1", "size": "0.5"}
BAD = {
    "unknown kind": ({"kind": '"lost"'}, "faults.kind: 'lost' is not a kind of fault; known are dropped, delayed,"),
    "kind missing": ({"kind": None}, "faults: kind is missing"),
    "unknown key": ({"sise": "1"}, "faults.sise: is not a key of a fault; known are duration_s, kind,"),
    "unknown target": ({"target": '"boom"'}, "'boom' is not a target; dropped has encoders, pressures_swing"),
    "target missing": ({"target": None}, "faults: the target is missing; dropped has encoders"),
    "target too much": ({"kind": '"bus_off"', "size": None}, "bus_off has no target; leave it out"),
    "size too large": ({"size": "2"}, "a number from 0 to 1 is needed, not 2 (unit: share of the frames)"),
    "size not whole": ({"kind": '"delayed"', "size": "1.5"}, "a whole number from 1 to 20 is needed, not 1.5"),
    "size missing": ({"kind": '"delayed"', "size": None}, "size is missing: 1 to 20 ms"),
    "size too much": ({"kind": '"stuck"', "target": '"swing_angle"'}, "stuck has no size; leave it out"),
    "size of an angle": (
        {"kind": '"biased"', "target": '"swing_angle"', "size": "1e5"},
        "a number from -3 to 3 is needed, not 100000.0 (unit: rad)",
    ),
    "start before the run": ({"start_s": "-0.1"}, "faults.start_s: -0.1 is outside 0 to"),
    "end after the run": ({"start_s": "9.95"}, "dropped from 9.95 to 10.05 s is outside the run, 0 to 10 s"),
    "duration missing": ({"duration_s": None}, "faults: duration_s is missing"),
    "duration of an event": (
        {"kind": '"nmt_reset"', "target": None, "size": None},
        "nmt_reset happens once, at start_s; leave the duration out",
    ),
}  # fmt: skip


def scenario_with(tmp_path: Path, **changes: str | None) -> Scenario:
    entry = {**GOOD, **changes}
    lines = [f"{key} = {value}" for key, value in entry.items() if value is not None]
    path = tmp_path / "s.toml"
    path.write_text("\n".join(["duration_s = 10.0", "[[faults]]", *lines, ""]), "utf-8")
    return load_scenario(path)


@pytest.mark.parametrize("name", BAD)
def test_wrong_fault_does_not_pass_for_another(tmp_path: Path, machine, name: str) -> None:
    """GIVEN a mistake in the list of faults WHEN read THEN one line: where, what, and what there is."""
    changes, message = BAD[name]
    with pytest.raises(ConfigError) as error:
        check_scenario(scenario_with(tmp_path, **changes), machine)
    assert message in str(error.value) and "s.toml:" in str(error.value) and "\n" not in str(error.value)


def test_good_fault_does_not_change_on_its_way(tmp_path: Path, machine) -> None:
    """GIVEN a complete entry WHEN read THEN that fault; left out, the size is the kind's own."""
    scenario = scenario_with(tmp_path, recover_after_s="0.2")
    check_scenario(scenario, machine)
    assert scenario.faults == (Fault("dropped", "encoders", 0.5, 0.1, 0.5, 0.2),)
    assert scenario_with(tmp_path, size=None).faults[0].size == 1.0


def test_fault_outside_a_shorter_run_does_not_go_unsaid(run_py) -> None:
    """GIVEN the example WHEN --duration cuts its faults off THEN status 2 and the line of the fault."""
    done = run_py("--bus", "inproc", "--scenario", "sil_plant/scenarios/faults.toml", "--duration", 5, cwd=ROOT_PATH)
    assert done.returncode == 2
    assert "faults.toml:" in done.stderr and "supply_lost from 6.4 to 6.7 s is outside the run" in done.stderr


def test_example_does_not_end_outside_run(run_py) -> None:
    """GIVEN the example of docs/scenario.md WHEN run THEN the table names its faults, and the ECU ends in RUN."""
    done = run_py("--bus", "inproc", "--scenario", "sil_plant/scenarios/faults.toml", cwd=ROOT_PATH)
    assert done.returncode == 0, done.stderr
    for text in ("dropped encoders", "ecu_killed, at 4.500 s for 0.300 s", "supply_lost", "SENSOR_FRAMES_LOST, 8100h"):
        assert text in done.stdout


def test_bus_that_cannot_do_a_fault_does_not_try(run_py, tmp_path: Path) -> None:
    """GIVEN faults that need the ECU in this process, or one that may be killed WHEN on a bus THEN which bus can."""
    for kind, advice in (("send_queue_full", "--bus inproc"), ("ecu_killed", "--ecu spawn")):
        path = tmp_path / "s.toml"
        path.write_text(f'[[faults]]\nkind = "{kind}"\nstart_s = 1.0\nduration_s = 0.1\n', "utf-8")
        done = run_py("--bus", "tcp:127.0.0.1:0", "--scenario", path)
        assert done.returncode == 2 and kind in done.stderr and advice in done.stderr
