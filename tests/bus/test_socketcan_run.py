"""Runs on a real SocketCAN interface, as users have it: what would make them differ, hang, or shut tools out.

A boot of the virtual machine and each start of run.py in it take seconds, so that all looks at one tour.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cantools
import pytest

from tests.cantools_decode import decoded

ROOT = Path(__file__).resolve().parents[2]
DBC = ROOT / "can_protocol" / "diarc.dbc"
LOAD_KG = 2.5
DURATION_S = 3.0
TICKS = 3101
TOUR_LIMIT_S = 120.0

TOUR = r"""
import atexit
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

ROOT, FOLDER, ARGUMENTS = Path(sys.argv[1]), Path(sys.argv[2]), json.loads(sys.argv[3])
os.environ["PATH"] += ":/usr/sbin:/sbin"
ECU, RUN = str(ROOT / "firmware" / "diarc_ecu"), [sys.executable, str(ROOT / "sil_plant" / "run.py")]
OURS = "DIARC_VCAN_VM" in os.environ  # the interface is nobody else's: it may be taken down
seen = {"ours": OURS}


def ended(argv, limit_s=40):
    done = subprocess.run(argv, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=limit_s)
    return {"status": done.returncode, "out": done.stdout, "err": done.stderr}


def link(state):
    subprocess.run(["ip", "link", "set", "vcan0", state], check=True, timeout=10)


def started(argv, name):
    with open(FOLDER / (name + ".out"), "w") as out, open(FOLDER / (name + ".err"), "w") as err:
        process = subprocess.Popen(argv, stdin=subprocess.DEVNULL, stdout=out, stderr=err)
    atexit.register(process.kill)  # whatever happens, nothing of ours stays
    return process


def stopped(process, number=signal.SIGTERM):
    process.send_signal(number)
    return process.wait(10)


def until(condition, limit_s=20):
    end = time.monotonic() + limit_s
    while not condition():
        if time.monotonic() > end:
            raise SystemExit("waited in vain")
        time.sleep(0.02)


def run(name, *more):
    return ended([*RUN, "--bus", "vcan0", *ARGUMENTS, "--json", str(FOLDER / (name + ".json")), *more])


# what a user gets wrong; both run.py cases in one process, for one start-up
seen["ecu, no interface"] = ended([ECU, "vcan7"])
if OURS:
    link("down")
    seen["ecu, down"] = ended([ECU, "vcan0"])
bad = "import sys; sys.path.insert(0, sys.argv[1]); from sil_plant import run"
bad += "; print(run.main(['--bus', sys.argv[2]])); print(run.main(['--bus', sys.argv[3]]))"
seen["run"] = ended([sys.executable, "-c", bad, str(ROOT), "vcan7", "vcan0" if OURS else "vcan8"])
if OURS:
    link("up")

# three processes on one bus, and a log
reader = started([sys.executable, str(FOLDER / "reader.py"), str(ROOT / "can_protocol" / "diarc.dbc"),
                  str(FOLDER / "read.json")], "reader")
until(lambda: "reading" in (FOLDER / "reader.out").read_text())
log = started(["candump", "-L", "vcan0"], "log")
ecu = started([ECU, "vcan0"], "ecu")
seen["candump"] = ended(["candump", "-n", "5", "vcan0"], 10)
seen["first"] = run("first")
seen["reader"] = stopped(reader)
stopped(log)
# the same ECU again, right away
seen["second"] = run("second")
seen["ecu"] = {"status": stopped(ecu)}
seen["ecu"] |= {stream: (FOLDER / f"ecu.{stream}").read_text() for stream in ("out", "err")}
seen["lockstep"] = run("lockstep", "--ecu", "spawn", "--pace", "lockstep")


def left():
    lines = subprocess.run(["ps", "-eo", "args"], capture_output=True, text=True).stdout.splitlines()
    return [line for line in lines if "diarc_ecu vcan0" in line]


seen["left"] = left()
# and the interface taken away in the middle of a run
if OURS:
    outputs = ["--json", str(FOLDER / "broken.json"), "--csv", str(FOLDER / "broken.csv")]
    broken = started([*RUN, "--bus", "vcan0", "--ecu", "spawn", "--duration", "60", *outputs], "broken")
    seen["under way"] = ended(["candump", "-n", "60", "vcan0,181:7FF"], 20)["status"]
    link("down")
    seen["broken"] = {"status": broken.wait(20), "err": (FOLDER / "broken.err").read_text()}
    link("up")
    seen["left"] += left()
Path(FOLDER / "seen.json").write_text(json.dumps(seen))
"""

READER = r"""
import json
import signal
import sys

import can
import cantools

database = cantools.database.load_file(sys.argv[1])
estimate = database.get_message_by_name("ESTIMATE")
read, going = [], True


def stop(*_):
    global going
    going = False


signal.signal(signal.SIGTERM, stop)
filters = [{"can_id": estimate.frame_id, "can_mask": 0x7FF, "extended": False}]
with can.Bus(interface="socketcan", channel="vcan0", can_filters=filters) as bus:
    print("reading", flush=True)
    while going:
        message = bus.recv(0.1)
        if message is not None:
            decoded = database.decode_message(message.arbitration_id, message.data)
            read.append({key: str(value) if key == "Mode" else value for key, value in decoded.items()})
with open(sys.argv[2], "w") as file:
    json.dump(read, file)
"""


@pytest.fixture(scope="module")
def inproc(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """The same run without a bus; also compiles the plant, so that nothing is compiled inside."""
    path = tmp_path_factory.mktemp("inproc") / "r.json"
    subprocess.run(
        [
            sys.executable, ROOT / "sil_plant" / "run.py", "--bus", "inproc",
            "--load", str(LOAD_KG), "--duration", str(DURATION_S), "--quiet", "--json", path,
        ],
        stdin=subprocess.DEVNULL,
        timeout=100,
        check=True,
    )  # fmt: skip
    return json.loads(path.read_text("utf-8"))


class Tour:
    """What came out of the tour."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.seen = json.loads((folder / "seen.json").read_text("utf-8"))

    def result(self, name: str) -> dict[str, Any]:
        """The JSON of one run, which must have gone well."""
        assert self.seen[name]["status"] == 0, self.seen[name]
        return json.loads((self.folder / f"{name}.json").read_text("utf-8"))

    def undisturbed(self, name: str) -> dict[str, Any]:
        """The JSON of one run; skips if this machine paused the plant for longer than the ECU waits."""
        found = self.result(name)
        if "this machine paused the plant" in self.seen[name]["err"]:
            pytest.skip("this machine paused the plant for longer than the ECU waits")
        return found


@pytest.fixture(scope="module")
def tour(run_on_vcan: Callable, inproc: dict, tmp_path_factory: pytest.TempPathFactory) -> Tour:
    """Run everything on vcan0, once."""
    folder = tmp_path_factory.mktemp("socketcan")
    (folder / "tour.py").write_text(TOUR)
    (folder / "reader.py").write_text(READER)
    arguments = json.dumps(["--load", str(LOAD_KG), "--duration", str(DURATION_S)])
    done = run_on_vcan(
        [sys.executable, folder / "tour.py", ROOT, folder, arguments], timeout_s=TOUR_LIMIT_S, cwd=folder
    )
    logs = "\n".join(f"{path.name}: {path.read_text()[-500:]}" for path in folder.glob("*.err"))
    assert done.returncode == 0, f"{done.stderr}\n{logs}"
    return Tour(folder)


# ---- the same numbers ------------------------------------------------------------------------------


def test_socketcan_does_not_give_another_trace_at_the_default_pace(tour: Tour, inproc: dict) -> None:
    """GIVEN diarc_ecu and run.py on vcan0 WHEN run for 3 s THEN the trace is that of no bus at all."""
    found = tour.undisturbed("first")
    assert found["trace_sha256"] == inproc["trace_sha256"]
    assert (found["ticks"], found["lost_frames"], found["bus"]) == (TICKS, 0, "vcan0")
    assert found["load_err_kg"] == inproc["load_err_kg"]
    assert found["realtime_factor"] <= 1.05  # the timer did set the pace
    print(f"realtime: {found['realtime_factor']:.2f} times real time")


def test_socketcan_does_not_give_another_trace_in_lockstep(tour: Tour, inproc: dict) -> None:
    """GIVEN a spawned ECU in lockstep on vcan0 WHEN run for 3 s THEN the trace is that of no bus at all."""
    found = tour.undisturbed("lockstep")
    assert found["trace_sha256"] == inproc["trace_sha256"]
    assert (found["ticks"], found["lost_frames"]) == (TICKS, 0)
    print(f"lockstep: {found['realtime_factor']:.2f} times real time")


def test_second_run_right_after_is_not_another_one(tour: Tour, inproc: dict) -> None:
    """GIVEN an ECU that has just done a run WHEN run.py is started again THEN it gives the same trace."""
    assert tour.undisturbed("second")["trace_sha256"] == inproc["trace_sha256"]


def test_run_does_not_end_in_disorder(tour: Tour) -> None:
    """GIVEN two runs WHEN the ECU is stopped
    THEN it ends with status 0 and tells its figures; no ECU is left behind.
    """
    for name in ("first", "second", "lockstep"):
        said = [line for line in tour.seen[name]["err"].splitlines() if "note:" not in line]
        assert said == [], name
        assert f"{TICKS} ticks" in tour.seen[name]["out"]
    ecu = tour.seen["ecu"]
    assert ecu["status"] == 0
    assert set(ecu["err"].splitlines()) <= {
        "diarc_ecu: no sensor frames for 1 s, still waiting; is the plant running on this bus?"
    }
    found = re.search(r"(\d+) ticks, .* (\d+) frames not sent, (\d+) receive errors, (\d+) frames lost", ecu["out"])
    assert found and int(found[1]) > 2 * TICKS and found.groups()[1:] == ("0", "0", "0")
    assert tour.seen["left"] == []


# ---- other tools on the bus ------------------------------------------------------------------------


def test_listener_does_not_see_another_load_than_the_run(tour: Tour) -> None:
    """GIVEN a third process with python-can and the DBC WHEN it listens
    THEN it sees the estimate settle, in kg.
    """
    found = tour.result("first")
    assert tour.seen["reader"] == 0
    read = [row for row in json.loads((tour.folder / "read.json").read_text("utf-8")) if row["Mode"] == "RUN"]
    assert 295 <= len(read) <= 315
    assert abs(read[0]["Load"]) < 0.5
    assert all(abs(row["Load"] - LOAD_KG) < 0.1 for row in read[60:])
    assert read[-1]["Load"] == pytest.approx(found["load_est_kg"], abs=2e-3)
    assert read[-1]["LoadSd"] < read[0]["LoadSd"]


def test_candump_is_not_blind(tour: Tour) -> None:
    """GIVEN an ECU on vcan0 WHEN `candump -n 5 vcan0` listens
    THEN it prints five frames and ends; SYNC is among them.
    """
    assert tour.seen["candump"]["status"] == 0
    lines = tour.seen["candump"]["out"].splitlines()
    assert len(lines) == 5 and all(
        re.fullmatch(r"\s+vcan0\s+[0-9A-F]{3}\s+\[\d\]( +[0-9A-F]{2})*\s*", line) for line in lines
    )
    assert any(re.search(r"\b080\s+\[1\]", line) for line in lines)


def test_log_of_candump_is_not_foreign_to_cantools(tour: Tour) -> None:
    """GIVEN a log of candump -L WHEN given to `cantools decode`
    THEN every frame has its name, the load its kg.
    """
    log = (tour.folder / "log.out").read_text()
    lines = log.splitlines(keepends=True)
    assert len(lines) > 15_000
    wanted = [line for line in lines if re.search(r" (181|080|202|182|701|201|000)#", line)]
    sample = "".join(wanted[-4000:])
    text = decoded(sample)
    loads = [float(number) for number in re.findall(r"ESTIMATE\(.*?Load: ([-0-9.]+) kg", text)]
    assert len(loads) > 50 and any(abs(load - LOAD_KG) < 0.05 for load in loads)
    assert "Unknown frame id" not in text
    database = cantools.database.load_file(DBC)
    ids = {int(line.split()[2].split("#")[0], 16) for line in lines}
    names = {database.get_message_by_frame_id(can_id).name for can_id in ids}  # KeyError: a frame not in the DBC
    assert names == {message.name for message in database.messages} - {"EMCY_ECU"}


# ---- what users get wrong --------------------------------------------------------------------------


def test_missing_interface_does_not_leave_the_user_guessing(tour: Tour) -> None:
    """GIVEN no vcan7 WHEN diarc_ecu and run.py are started on it
    THEN status 2 and one line with the command that makes it.
    """
    ecu = tour.seen["ecu, no interface"]
    assert (ecu["status"], ecu["out"]) == (2, "")
    run = tour.seen["run"]
    assert run["status"] == 0 and run["out"].split()[0] == "2"
    for program, line in (("diarc_ecu", ecu["err"]), ("run.py", run["err"].splitlines(keepends=True)[0])):
        assert re.fullmatch(rf"{program}: [^\n]*\n", line)
        assert re.search(r"sudo ip link add dev vcan7 type vcan && sudo ip link set up vcan7", line), line


def test_interface_that_is_down_does_not_leave_the_user_guessing(tour: Tour) -> None:
    """GIVEN vcan0 down WHEN diarc_ecu and run.py are started on it
    THEN status 2 and one line with the command that helps.
    """
    if not tour.seen["ours"]:
        pytest.skip("this machine's own vcan0 is not ours to take down")
    ecu, run = tour.seen["ecu, down"], tour.seen["run"]
    assert (ecu["status"], ecu["out"], run["out"].split()) == (2, "", ["2", "2"])
    assert len(run["err"].splitlines()) == 2
    for program, line in (("diarc_ecu", ecu["err"]), ("run.py", run["err"].splitlines(keepends=True)[1])):
        assert re.fullmatch(rf"{program}: [^\n]*vcan0 is down[^\n]*\n", line)
        assert "sudo ip link set up vcan0" in line


@pytest.fixture
def broken(tour: Tour) -> dict[str, Any]:
    """The run whose interface went down."""
    if not tour.seen["ours"]:
        pytest.skip("this machine's own vcan0 is not ours to take down")
    assert tour.seen["under way"] == 0
    return tour.seen["broken"]


def test_interface_that_goes_down_does_not_hang_or_lose_the_run(tour: Tour, broken: dict[str, Any]) -> None:
    """GIVEN a run under way WHEN vcan0 goes down
    THEN it ends with an error, JSON and CSV, and the command that helps.
    """
    assert broken["status"] in (1, 2) and "Traceback" not in broken["err"]
    assert re.search(r"run\.py: vcan0 went down[^\n]*sudo ip link set up vcan0", broken["err"])
    ticks = json.loads((tour.folder / "broken.json").read_text("utf-8"))["ticks"]
    rows = (tour.folder / "broken.csv").read_text("utf-8").splitlines()
    assert len(rows) == ticks + 1 > 400 and rows[-1].endswith(",RUN")


def test_interface_that_goes_down_is_not_taken_for_wrong_use(broken: dict[str, Any]) -> None:
    """GIVEN a run under way WHEN vcan0 goes down
    THEN status 1, as with an ECU that dies, and the valves are closed.
    """
    assert broken["status"] == 1
    assert "valves are closed" in broken["err"]
