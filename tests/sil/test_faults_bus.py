"""Faults that need a process and a bus: an ECU that is killed, a bus that is cut, monitors that come and go."""

from __future__ import annotations

import json
import re
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from sil_plant.bus import frames, protocol
from sil_plant.bus.hub import Hub
from sil_plant.bus.ports import BusError, connect_python_can
from sil_plant.loop import session

LIMIT_S = 60.0
SILENCE_LIMIT_S = 10.0
PAUSED = "this machine paused the plant"

MOVE = """
duration_s = 1.5
[[load]]
time_s = 0.0
load_kg = 3.0
[[swing.segment]]
target_rad = 0.3
duration_s = 0.8
dwell_s = 0.3
[[swing.segment]]
target_rad = 0.0
duration_s = 0.4
"""


@pytest.fixture
def both(run_py, tmp_path: Path) -> Callable[[str], tuple[dict, dict]]:
    """``both(fault)``: figures of a scenario in process, and on tcp with an ECU of its own in lockstep."""

    def run(fault: str) -> tuple[dict, dict]:
        path = tmp_path / "s.toml"
        path.write_text(f"{MOVE}[[faults]]\n{fault}", "utf-8")

        def figures(*bus: str) -> dict:
            json_path = tmp_path / "r.json"
            done = run_py("--bus", *bus, "--scenario", path, "--json", json_path, timeout_s=LIMIT_S)
            assert done.returncode == 0, done.stderr
            return json.loads(json_path.read_text("utf-8"))

        inproc = figures("inproc")
        for _ in range(5):
            tcp = figures("tcp:127.0.0.1:0", "--ecu", "spawn", "--pace", "lockstep")
            if tcp["lost_frames"] == inproc["lost_frames"]:
                break  # else this machine paused one of the two for longer than a tick may take
        return inproc, tcp

    return run


@pytest.mark.parametrize(
    "fault",
    [
        'kind = "ecu_killed"\nduration_s = 0.1\n',
        # as short as the ECU bears: in process its driver refuses frames, over tcp the cable is cut unseen
        'kind = "bus_off"\nduration_s = 0.004\n',
        'kind = "dropped"\ntarget = "valves"\nduration_s = 0.05\n',
        'kind = "corrupted"\ntarget = "encoders"\nsize = 3\nduration_s = 0.004\n',
    ],
)
def test_bus_does_not_give_another_trace_of_a_fault(both, fault: str) -> None:
    """GIVEN an ECU killed and restarted, a bus cut, frames disturbed WHEN run in process and over tcp
    THEN the same trace, and it ends in RUN both times.
    """
    inproc, tcp = both(f"{fault}start_s = 0.3\nrecover_after_s = 0.2\n")
    assert tcp["ticks"] == inproc["ticks"] == 1601
    assert tcp["trace_sha256"] == inproc["trace_sha256"]


def test_dead_plant_does_not_keep_the_ecu_ramping_for_long(bench, start_ecu) -> None:
    """GIVEN an ECU in lockstep in RUN WHEN the plant pauses for 20 ms THEN it stays in RUN
    WHEN the plant falls silent THEN its valves are shut after the five ticks and the ramp: once it is sure that the
    sensors are gone, a tick takes no longer than its period, not as long as a pause may take (205 of those are 20 s).
    """
    rig = bench()
    valves = protocol.database().get_message_by_name("VALVES")
    mode, run_ticks, silent_ticks, end = "", 0, 0, time.monotonic() + LIMIT_S
    with Hub("127.0.0.1", 0) as hub:
        start_ecu(f"tcp:127.0.0.1:{hub.port}", "--pace", "lockstep")
        while mode != "FAULT":
            assert time.monotonic() < end, f"{mode} after {run_ticks} ticks in RUN, {silent_ticks} in silence"
            frame = hub.receive(0.1)
            if frame is None:
                continue
            can_id, data = frame
            if can_id == valves.frame_id:
                mode = str(valves.decode(data)["Mode"])
                assert silent_ticks or mode in ("INIT", "STANDBY", "RUN")
                run_ticks += mode == "RUN"
            elif can_id == protocol.SYNC_ID and run_ticks < 50:
                if run_ticks in (20, 30, 40):
                    time.sleep(0.02)
                rig.sync = data[0]
                rows = rig.sensors()
                if not mode:
                    rows.insert(0, session.nmt_frame(session.NMT_START))
                elif mode == "STANDBY":
                    rows.insert(0, rig.motion("RUN", Controller=0))
                hub.send_many(frames.from_row(row) for row in rows)
            elif can_id == protocol.SYNC_ID:
                if not silent_ticks:
                    end = time.monotonic() + SILENCE_LIMIT_S
                silent_ticks += 1
    assert run_ticks >= 50
    assert 204 <= silent_ticks <= 206


def test_monitor_that_comes_and_goes_does_not_disturb(start_run_py, simulate, tmp_path: Path) -> None:
    """GIVEN monitors that join the bus, read a little or nothing, and leave, all the time WHEN the arm moves
    THEN the trace is that of a run without them.
    """
    json_path = tmp_path / "r.json"
    run = start_run_py(
        "--bus", "tcp:127.0.0.1:0", "--ecu", "spawn", "--pace", "lockstep", "--duration", 2, "--json", json_path
    )  # fmt: skip
    end = time.monotonic() + LIMIT_S
    # the hub's port is on the command line of the ECU that was started
    while not (found := re.search(r"tcp:127\.0\.0\.1:[1-9]\d*", ecu_command_line(run.process.pid))):
        assert time.monotonic() < end and run.process.poll() is None, run.err.read_text()
        time.sleep(0.01)
    attached = 0

    def come_and_go(reads: int) -> None:
        nonlocal attached
        while run.process.poll() is None and time.monotonic() < end:
            try:
                with connect_python_can(found.group()) as monitor:
                    attached += 1
                    for _ in range(reads):
                        monitor.recv(0.01)
            except (BusError, OSError):
                return  # the run is over

    monitors = [threading.Thread(target=come_and_go, args=(reads,)) for reads in (0, 50)]
    for monitor in monitors:
        monitor.start()
    assert run.wait(LIMIT_S) == 0, run.err.read_text()
    for monitor in monitors:
        monitor.join(LIMIT_S)
    assert attached >= 2
    if PAUSED not in run.err.read_text():
        figures = json.loads(json_path.read_text("utf-8"))
        assert figures["trace_sha256"] == simulate(3.0, duration=2.0).result.trace_sha256


def ecu_command_line(parent: int) -> str:
    """Command lines of a process's children, as text."""
    lines = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            if int(path.read_text().rpartition(")")[2].split()[1]) == parent:
                lines.append(path.with_name("cmdline").read_bytes().replace(b"\0", b" ").decode())
        except (OSError, ValueError):
            continue  # it has ended meanwhile
    return "\n".join(lines)
