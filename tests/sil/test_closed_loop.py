"""The whole loop in process, as the paper's benchmark: what would spoil its results, or make them not
the same twice.
"""

from __future__ import annotations

import json
import signal
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sil_plant.bus import frames, protocol
from sil_plant.inputs.machine import Machine
from sil_plant.inputs.scenario import Scenario, with_load
from sil_plant.loop import execution, inproc, results, session

KEYS = (
    "load_true_kg load_est_kg load_err_kg load_settle_s peak_err_rad peak_err_after_1s_rad rms_err_rad rho_s "
    "controller arm scenario seed bus ticks lost_frames wall_s realtime_factor trace_sha256"
).split()
LOADS = [0.0, 2.5, 5.0, 7.5, 10.0]


@pytest.mark.parametrize("load", LOADS)
def test_load_is_not_estimated_worse_than_20_g(simulate, load: float) -> None:
    """GIVEN the paper's loads WHEN 10 s have passed
    THEN the estimate is off by at most 0.02 kg, and settled early.
    """
    result = simulate(load).result
    assert result.load_true_kg == load
    assert abs(result.load_err_kg) <= 0.02
    assert result.load_err_kg == pytest.approx(result.load_est_kg - load)
    assert result.load_settle_s is not None and result.load_settle_s <= 1.0
    if load:
        assert result.load_settle_s >= 0.01  # it is learned from the motion, not known from the start


def test_estimate_does_not_lag_behind_a_load_it_was_not_told(simulate) -> None:
    """GIVEN 10 kg WHEN the run begins
    THEN the estimate is the prior's 0 kg: nothing leaks from the plant to the ECU.
    """
    record = simulate(10.0).record
    assert np.abs(record.load_est[:100]).max() < 0.5 and (record.load_true == 10.0).all()


def test_tracking_is_not_worse_than_the_paper(simulate) -> None:
    """GIVEN 3 kg WHEN 1 s has passed
    THEN both joints' peak error is at most 4e-4 rad, and not below the noise.
    """
    peaks = simulate(3.0).result.peak_err_after_1s_rad
    assert all(1e-6 <= peak <= 4e-4 for peak in peaks), peaks


@pytest.mark.parametrize("load", LOADS)
def test_no_load_of_the_paper_upsets_tracking(simulate, load: float) -> None:
    """GIVEN each load WHEN 1 s has passed
    THEN both joints' peak error is at most 4e-4 rad; before, at most 5e-3 rad.
    """
    result = simulate(load).result
    assert all(1e-6 <= peak <= 4e-4 for peak in result.peak_err_after_1s_rad)
    assert all(
        late <= peak <= 5e-3 for late, peak in zip(result.peak_err_after_1s_rad, result.peak_err_rad, strict=True)
    )


@pytest.mark.parametrize("load", [0.0, 3.0, 10.0])
def test_float_is_not_another_controller(simulate, load: float) -> None:
    """GIVEN the law in float WHEN compared with double
    THEN load within 0.002 kg, peaks within 5 % + 1e-6 rad; not equal.
    """
    double, single = simulate(load).result, simulate(load, scalar="float").result
    assert abs(double.load_err_kg - single.load_err_kg) <= 0.002
    for ours, theirs in zip(double.peak_err_after_1s_rad, single.peak_err_after_1s_rad, strict=True):
        assert abs(ours - theirs) <= 0.05 * ours + 1e-6
    assert double.trace_sha256 != single.trace_sha256  # else both are the same library


def test_same_seed_does_not_give_another_trace(simulate) -> None:
    """GIVEN a run WHEN made again
    THEN the trace is the same byte for byte; WHEN with another seed THEN another.
    """
    first = simulate(3.0, duration=1.0)
    again = simulate.__wrapped__(3.0, duration=1.0)
    assert again is not first
    assert again.result.trace_sha256 == first.result.trace_sha256
    assert again.record.state.tobytes() == first.record.state.tobytes()
    others = {simulate(3.0, seed=seed, duration=1.0).result.trace_sha256 for seed in (1, 2, 3)}
    assert len(others) == 3 and first.result.trace_sha256 in others


def test_longer_run_does_not_begin_differently(simulate) -> None:
    """GIVEN runs of 1 s and of 10 s WHEN compared THEN the longer one begins with the shorter one."""
    short, long = simulate(3.0, duration=1.0).record, simulate(3.0).record
    for name in ("state", "command", "reference", "load_est", "load_sd"):
        ours = getattr(short, name)
        assert np.array_equal(ours, getattr(long, name)[: len(ours)]), name


@pytest.mark.parametrize(("controller", "factor"), [("pid", 10.0), ("diarc-noload", 1.5)])
def test_controllers_that_know_less_are_not_the_same_one(simulate, controller: str, factor: float) -> None:
    """GIVEN PID, or DIARC without the load WHEN run with 3 kg
    THEN both joints track worse, by the factor told.
    """
    diarc, other = simulate(3.0).result, simulate(3.0, controller).result
    assert other.controller == controller
    for ours, theirs in zip(diarc.peak_err_after_1s_rad, other.peak_err_after_1s_rad, strict=True):
        assert theirs > factor * ours and theirs < 0.5
    assert abs(other.load_err_kg) <= 0.02  # they estimate all the same


def test_run_does_not_lose_or_add_a_tick(simulate) -> None:
    """GIVEN 10 s and a tick of 1 ms WHEN run THEN 10101 ticks: 0.1 s before the motion, and both ends."""
    outcome = simulate(3.0)
    assert outcome.result.ticks == 10101 == len(outcome.record.state)
    assert outcome.result.lost_frames == 0
    assert np.any(outcome.record.state[-1] != 0.0)


def test_reference_of_the_record_is_not_another_than_the_ecu_follows(simulate, bus_log) -> None:
    """GIVEN a run WHEN the ECU's own error on TRACKING is compared with the record's
    THEN they agree to the noise.
    """
    record = simulate(3.0, duration=1.3).record
    tracking = protocol.database().get_message_by_name("TRACKING")
    seen = 0
    for frame in bus_log:
        if frame.can_id != tracking.frame_id or frame.tick < 100:
            continue
        decoded = tracking.decode(frame.data, decode_choices=False)
        joint = decoded["TrackingJoint"]
        name = ("Swing", "Wrist")[joint]
        # one tick is at most 1.4e-3 rad of motion: a reference that is late by one does not pass
        assert decoded[f"{name}Reference"] == pytest.approx(record.reference[frame.tick, joint], abs=1e-6)
        error = record.state[frame.tick, joint] - record.reference[frame.tick, joint]
        assert decoded[f"{name}Error"] == pytest.approx(error, abs=5.5e-5)
        seen += 1
    assert seen > 200


def test_figures_do_not_begin_or_end_a_tick_beside(simulate) -> None:
    """GIVEN a record with a spike on either side of each window's edge WHEN summed up THEN only those inside count."""
    record = simulate(3.0, duration=1.3).record
    ticks, timeline = len(record.state), session.make_timeline(1e-3, tare=False)
    assert (timeline.parked, timeline.run_request, timeline.motion) == (0, 60, 100)
    reference = record.state[:, :2].copy()
    load_est = record.load_true.copy()
    for tick, error in ((60, 0.9), (61, 0.5), (1099, 0.4), (1100, 0.3), (ticks - 1, 0.2)):
        reference[tick] += [error, -error / 10]
    load_est[[50, 100 + 400]] += [5.0, -0.11]  # the first is before the motion; the second the last outside the band
    load_est[100 + 401 :] += 0.09
    spiked = record._replace(reference=reference, load_est=load_est)

    def figures(ticks: int) -> results.Result:
        run = results.Run("diarc", "arm", "scenario", 1, "inproc", timeline, ticks, 0, 2.0, float(load_est[ticks - 1]))
        return results.summarise(spiked, run)

    whole = figures(ticks)
    assert whole.peak_err_rad == pytest.approx([0.5, 0.05])
    assert whole.peak_err_after_1s_rad == pytest.approx([0.3, 0.03])
    inside = np.array([0.5, 0.4, 0.3, 0.2])
    rms = float(np.sqrt((inside**2).sum() / (ticks - 61)))
    assert whole.rms_err_rad == pytest.approx([rms, rms / 10])
    fastest = np.abs(record.state[1100:, 2:4]).max(axis=0)
    assert whole.rho_s == pytest.approx([0.3 / fastest[0], 0.03 / fastest[1]])
    assert whole.load_settle_s == pytest.approx(0.401)
    assert whole.load_err_kg == pytest.approx(0.09)
    assert whole.realtime_factor == pytest.approx(ticks * 1e-3 / 2.0)
    broken_off = figures(1101)
    assert broken_off.peak_err_after_1s_rad == pytest.approx([0.3, 0.03]) and broken_off.ticks == 1101
    assert figures(1100).peak_err_after_1s_rad == [None, None]
    assert figures(501).load_settle_s is None  # it ends outside the band


@pytest.fixture
def main(monkeypatch: pytest.MonkeyPatch):
    """run.py's main in this process."""
    monkeypatch.setattr(sys, "path", list(sys.path))
    from sil_plant import run

    before = signal.getsignal(signal.SIGTERM)
    yield run.main
    signal.signal(signal.SIGTERM, before)


def test_json_does_not_lose_or_grow_keys(main, tmp_path: Path, capsys: pytest.CaptureFixture[str], simulate) -> None:
    """GIVEN a run with --json WHEN read
    THEN it has exactly the documented keys and this run's figures; table printed.
    """
    assert main(["--bus", "inproc", "--load", "2.5", "--json", str(tmp_path / "r.json")]) == 0
    text = (tmp_path / "r.json").read_text("utf-8")
    found = json.loads(text)
    assert list(found) == KEYS
    result = simulate(2.5).result
    for key in set(KEYS) - {"wall_s", "realtime_factor"}:
        assert found[key] == getattr(result, key), key
    assert found["ticks"] == 10101 and found["bus"] == "inproc" and found["seed"] == 1
    assert (found["controller"], found["arm"], found["scenario"]) == ("diarc", "reference", "paper")
    assert found["realtime_factor"] == pytest.approx(10.101 / found["wall_s"])
    said = capsys.readouterr()
    assert f"{found['realtime_factor']:.1f} times real time" in said.out
    assert "2.500 kg" in said.out and "10101 ticks" in said.out
    assert not any(word in text for word in ("NaN", "Infinity"))


def test_short_run_does_not_put_no_numbers_into_the_json(main, tmp_path: Path) -> None:
    """GIVEN a run that ends before 1 s WHEN written
    THEN what is not known is null, and the JSON is strict.
    """
    assert main(["--bus", "inproc", "--duration", "0.05", "--quiet", "--json", str(tmp_path / "r.json")]) == 0

    def refuse(word: str) -> None:
        raise AssertionError(f"{word} is no JSON")

    found = json.loads((tmp_path / "r.json").read_text("utf-8"), parse_constant=refuse)
    assert found["peak_err_after_1s_rad"] == [None, None] == found["rho_s"]
    assert found["load_settle_s"] is None and found["ticks"] == 151


def test_csv_is_not_another_run_than_the_json(main, tmp_path: Path, simulate) -> None:
    """GIVEN a run with --csv WHEN read
    THEN a row per tick with the record's numbers, time 0 where motion starts.
    """
    assert main(["--bus", "inproc", "--duration", "0.5", "--quiet", "--csv", str(tmp_path / "t.csv")]) == 0
    lines = (tmp_path / "t.csv").read_text("utf-8").splitlines()
    head = lines[0].split(",")
    rows = [dict(zip(head, line.split(","), strict=True)) for line in lines[1:]]
    record = simulate(3.0, duration=0.5).record
    assert len(rows) == 601 == len(record.state)
    assert float(rows[100]["t_s"]) == 0.0 and float(rows[-1]["t_s"]) == 0.5
    assert rows[0]["mode"] == "INIT" and rows[-1]["mode"] == "RUN"
    for column, values in [
        ("swing_rad", record.state[:, 0]), ("wrist_annulus_Pa", record.state[:, 7]),
        ("wrist_command", record.command[:, 1]), ("swing_reference_rad", record.reference[:, 0]),
        ("load_est_kg", record.load_est), ("load_true_kg", record.load_true),
    ]:  # fmt: skip
        assert [float(row[column]) for row in rows] == pytest.approx(values.tolist(), rel=1e-8, abs=1e-12), column


@pytest.mark.parametrize("lost", ["ENCODERS", "MOTION"])
def test_frame_lost_when_run_is_requested_does_not_leave_the_arm_at_rest(
    machine: Machine, image: bytes, paper: Scenario, lost: str
) -> None:
    """GIVEN a frame that is lost in the tick of the request for RUN WHEN the run goes on
    THEN the ECU is asked again, drives before the first move, takes the moves and the run counts as a good one.
    """
    scenario = replace(with_load(paper, 3.0), duration_s=0.5)
    ecu = inproc.InprocEcu(image)
    run = session.make_session(machine, scenario, "diarc", 1, 1e-3, False)
    out = np.zeros((session.OUT_ROWS, frames.FRAME_BYTES), dtype=np.uint8)
    for tick in range(len(run.noise)):
        rows = 0
        for row in ecu.tick_begin():
            if frames.frame_id(row) == protocol.SYNC_ID:
                rows = session.on_sync(run, int(row[frames.DATA]), out)
        arrived = out[:rows]
        if tick == run.timeline.run_request:
            arrived = np.array([row for row in arrived if frames.frame_id(row) != protocol.frame_id(lost)])
            assert len(arrived) == rows - 1
        for row in ecu.tick_end(np.ascontiguousarray(arrived)):
            session.on_frame(run, row)
        assert (run.record.mode[tick] == session.MODE_RUN) == (
            tick > run.timeline.run_request + session.ASK_AGAIN_TICKS
        )
    assert execution.outcome(run) is None
    assert run.record.reference[-1, 0] > 0.05
