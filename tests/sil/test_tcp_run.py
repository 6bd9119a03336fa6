"""Whole runs over the socketcand protocol: what would make a bus give other numbers than none, or shut
tools out.
"""

from __future__ import annotations

import json
import re
import time
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from sil_plant.bus import protocol
from sil_plant.bus.ports import connect_python_can

LIMIT_S = 30.0  # no wait in this file is longer; reaching it is a failure
PAUSED = "this machine paused the plant"  # run.py's own note: the trace may differ then, and that is no fault
ATTEMPTS = 3


def undisturbed(attempt):
    """The outcome of an attempt that this machine did not disturb by a pause."""
    for _ in range(ATTEMPTS):
        outcome, said = attempt()
        if PAUSED not in said:
            return outcome
    pytest.skip("this machine paused the plant for longer than the ECU waits, three times over")


@pytest.mark.parametrize("pace", ["lockstep", None])
def test_tcp_does_not_give_another_trace(run_py, simulate, tmp_path: Path, pace: str | None) -> None:
    """GIVEN a spawned ECU, in lockstep or at the default pace WHEN run for 2 s
    THEN the trace is that of no bus at all.
    """

    def attempt() -> tuple[dict, str]:
        flags = ["--pace", pace] if pace else []
        run = run_py(
            "--bus",
            "tcp:127.0.0.1:0",
            "--ecu",
            "spawn",
            *flags,
            "--duration",
            2,
            "--json",
            tmp_path / "r.json",
        )
        assert run.returncode == 0, run.stderr
        return json.loads((tmp_path / "r.json").read_text("utf-8")), run.stderr

    found = undisturbed(attempt)
    expected = simulate(3.0, duration=2.0).result
    assert found["trace_sha256"] == expected.trace_sha256
    assert (found["ticks"], found["lost_frames"]) == (2101, 0)
    assert found["load_est_kg"] == expected.load_est_kg
    assert found["peak_err_after_1s_rad"] == expected.peak_err_after_1s_rad
    if pace is None:
        assert found["realtime_factor"] <= 1.05  # the timer did set the pace
    print(f"{pace or 'realtime'}: {found['realtime_factor']:.2f} times real time")


def test_listener_on_the_same_hub_is_not_left_out(start_run_py, start_ecu, simulate, tmp_path: Path) -> None:
    """GIVEN an ECU started by hand WHEN python-can listens with the DBC
    THEN it sees the load settle, in kg, and the same trace.
    """
    database = protocol.database()
    names = {message.frame_id: message for message in database.messages}

    def attempt() -> tuple[tuple, str]:
        run = start_run_py("--bus", "tcp:127.0.0.1:0", "--load", 7.5, "--duration", 2, "--json", tmp_path / "r.json")
        end = time.monotonic() + LIMIT_S
        while not (found := re.search(r"\./firmware/diarc_ecu (tcp:\S+)", run.err.read_text())):
            assert time.monotonic() < end and run.process.poll() is None, run.err.read_text()
            time.sleep(0.02)
        bus = found.group(1)
        heard = []
        with connect_python_can(bus) as listener:
            ecu = start_ecu(bus)
            while run.process.poll() is None:
                assert time.monotonic() < end, "the run does not end"
                message = listener.recv(0.2)
                if message is not None:
                    heard.append((message.arbitration_id, bytes(message.data)))
        assert run.wait() == 0, run.err.read_text()
        ecu.process.terminate()
        ecu.wait(LIMIT_S)
        return (heard, json.loads((tmp_path / "r.json").read_text("utf-8"))), run.err.read_text()

    heard, figures = undisturbed(attempt)
    assert figures["trace_sha256"] == simulate(7.5, duration=2.0).result.trace_sha256
    loads = [names[i].decode(data) for i, data in heard if names[i].name == "ESTIMATE"]
    in_run = [decoded for decoded in loads if decoded["Mode"] == "RUN"]
    assert 190 <= len(in_run) <= 205
    assert abs(in_run[0]["Load"]) < 0.5
    assert all(abs(decoded["Load"] - 7.5) < 0.1 for decoded in in_run[60:])
    assert in_run[-1]["Load"] == pytest.approx(figures["load_est_kg"], abs=2e-3)
    assert in_run[-1]["LoadSd"] < in_run[0]["LoadSd"]
    assert names[protocol.frame_id("ESTIMATE")].get_signal_by_name("Load").unit == "kg"
    # both sides of the conversation reached the listener, the I/O node's heartbeat in its cycle too
    count = Counter(names[i].name for i, _ in heard)
    assert set(count) >= {
        "SYNC",
        "ENCODERS",
        "PRESSURES_SWING",
        "PRESSURES_WRIST",
        "VALVES",
        "MOTION",
        "NMT",
        "TIMING",
    }
    syncs = [i for i, (can_id, _) in enumerate(heard) if can_id == protocol.SYNC_ID]
    beats = [i for i, (can_id, _) in enumerate(heard) if names[can_id].name == "HEARTBEAT_IO"]
    cycle = names[protocol.frame_id("HEARTBEAT_IO")].cycle_time
    assert len(beats) >= 20 and set(np.diff(np.searchsorted(syncs, beats)).tolist()) == {cycle}
    assert count["ENCODERS"] == 2101
