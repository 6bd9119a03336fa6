"""run.py as its users get it wrong, and what happens when a run does not end as planned."""

# ruff: noqa: E501 - one bad command line a row

from __future__ import annotations

import contextlib
import csv
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import can
import pytest

from sil_plant.bus import protocol
from sil_plant.bus.ports import connect_python_can
from sil_plant.inputs.machine import REFERENCE_ARM
from sil_plant.inputs.scenario import DEFAULT_SCENARIO
from sil_plant.monitoring.host import kernel_has_can

ROOT = Path(__file__).resolve().parents[2]
LIMIT_S = 30.0  # no wait in this file is longer; reaching it is a failure


# ---- bad input -----------------------------------------------------------------------------------

SCENARIO = {  # name: (what stands in the default scenario, what the bad one has, which occurrence)
    "malformed.toml": ("duration_s = 10.0", "duration_s = = 10.0", 1),
    "unknown.toml": ("duration_s = 10.0", "durations = 10.0", 1),
    "long.toml": ("duration_s = 10.0", "duration_s = 1e9", 1),
    "segment.toml": ("dwell_s = 0.5", "dwel_s = 0.5", 1),
    "second.toml": ("dwell_s = 0.5", "dwell_s = -1", 2),
    "far.toml": ("target_rad = 0.6", "target_rad = 1.3", 1),
    "heavy.toml": ("load_kg = 3.0", "load_kg = 1e9", 1),
    "text.toml": ("seed = 1", 'seed = "one"', 1),
}
ARM = {
    "malformed-arm.toml": ("bore_m = 0.032", "bore_m = [0.032", 1),
    "unknown-arm.toml": ("bore_m = 0.032", "borre_m = 0.032", 1),
    "wide-arm.toml": ("bore_m = 0.032", "bore_m = 32.0", 1),
    "nan-arm.toml": ("mass_kg = 5.0", "mass_kg = nan", 1),
    "rod-arm.toml": ("rod_m = 0.018", "rod_m = 0.04", 1),
    "less-arm.toml": ("rod_m = 0.018\n", "", 1),
}

# name: (arguments, patterns the one line must match)
BAD: dict[str, tuple[list[str], list[str]]] = {
    "unknown flag": (["--nonsense"], [r"--nonsense", r"--help"]),
    "load is no number": (["--load", "much"], [r"--load", r"much"]),
    "unknown controller": (["--controller", "lqr"], [r"lqr", r"diarc-noload"]),
    "pace without an ECU": (["--pace", "lockstep"], [r"--pace", r"--ecu spawn"]),
    "negative load": (["--load", "-1"], [r"--load -1", r"0 kg or more"]),
    "absurd load": (["--load", "1e6"], [r"1e\+06 kg", r"0 to 15 kg"]),
    "load nan": (["--load", "nan"], [r"--load nan", r"0 kg or more"]),
    "load inf": (["--load", "inf"], [r"inf kg", r"0 to 15 kg"]),
    "no duration": (["--duration", "0"], [r"--duration 0", r"0\.01 to 3600"]),
    "negative seed": (["--seed", "-3"], [r"--seed -3", r"from 0"]),
    "bus not understood": (["--bus", "tcp127.0.0.1:1"], [r"tcp127\.0\.0\.1:1", r"tcp:127\.0\.0\.1:29536"]),
    "spawn in process": (["--ecu", "spawn"], [r"--ecu spawn needs a bus", r"--bus tcp:"]),
    "float on a bus": (["--bus", "tcp:127.0.0.1:0", "--scalar", "float"], [r"--scalar", r"--bus inproc"]),
    "hub for everybody": (["--bus", "tcp:0.0.0.0:0"], [r"0\.0\.0\.0", r"--bus tcp:127\.0\.0\.1:"]),
    "scenario malformed": (["--scenario", "malformed.toml"], [r"malformed\.toml: not valid TOML: .*line {line}\b"]),
    "scenario unknown key": (["--scenario", "unknown.toml"], [r"unknown\.toml:{line}: durations: is not a key.*duration_s"]),
    "scenario out of range": (["--scenario", "long.toml"], [r"long\.toml:{line}: duration_s: 1e\+09 is outside 0\.01 to 3600"]),
    "segment unknown key": (["--scenario", "segment.toml"], [r"segment\.toml:{line}: swing\.segment\.dwel_s: is not a key.*dwell_s"]),
    "second segment out of range": (["--scenario", "second.toml"], [r"second\.toml:{line}: swing\.segment\.dwell_s: -1 is outside 0 to 3600"]),
    "target out of range": (["--scenario", "far.toml"], [r"far\.toml:{line}: swing\.segment\.target_rad: 1\.3 .*-1 to 1\.2"]),
    "load out of range": (["--scenario", "heavy.toml"], [r"heavy\.toml:{line}: load\.load_kg: 1e\+09 is outside 0 to"]),
    "seed is text": (["--scenario", "text.toml"], [r"text\.toml:{line}: seed: .*whole number"]),
    "no such scenario": (["--scenario", "none.toml"], [r"none\.toml", r"No such file"]),
    "arm malformed": (["--arm", "malformed-arm.toml"], [r"malformed-arm\.toml: not valid TOML: .*line \d+"]),
    "arm unknown key": (["--arm", "unknown-arm.toml"], [r"unknown-arm\.toml:{line}: swing\.borre_m: is not a key.*reference\.toml"]),
    "arm out of range": (["--arm", "wide-arm.toml"], [r"wide-arm\.toml:{line}: swing\.bore_m: 32 is outside 0\.005 to 0\.5"]),
    "arm nan": (["--arm", "nan-arm.toml"], [r"nan-arm\.toml:{line}: wrist\.mass_kg: nan is outside 0\.01 to"]),
    "arm rod wider than bore": (["--arm", "rod-arm.toml"], [r"rod-arm\.toml:{line}: swing\.rod_m: must be smaller than the bore"]),
    "arm key missing": (["--arm", "less-arm.toml"], [r"less-arm\.toml.*swing\.rod_m: is missing"]),
    "no such arm": (["--arm", "none.toml"], [r"none\.toml", r"No such file"]),
    "arm is a program": (["--arm", sys.executable], [re.escape(sys.executable), r"not UTF-8|not valid TOML"]),
    "json in no folder": (["--json", "no/where.json"], [r"no/where\.json", r"folder does not exist"]),
    "csv in no folder": (["--csv", "no/where.csv"], [r"no/where\.csv", r"folder does not exist"]),
    "busy port": (["--bus", "tcp:127.0.0.1:{busy}"], [r"port {busy} on 127\.0\.0\.1 is taken", r"--bus tcp:127\.0\.0\.1:\d+", r"ss -ltnp"]),
    "nobody there": (["--bus", "tcp:127.0.0.1:0"], [r"no ECU on tcp:127\.0\.0\.1:(\d+) within 3 s", r"\./firmware/diarc_ecu tcp:127\.0\.0\.1:\d+", r"--ecu spawn"]),
    "vcan0 without CAN": (["--bus", "vcan0"], [r"vcan0", r"modprobe|ip link", r"--bus tcp:", r"vcan_vm"]),
}  # fmt: skip


def change(text: str, old: str, new: str, which: int) -> str:
    """Replace the n-th occurrence."""
    parts = text.split(old)
    assert len(parts) > which, old
    return old.join(parts[:which]) + new + old.join(parts[which:])


# Imports run.py once (a second of work), then forks for each case: what a process of its own would
# do, but sooner.
FORKS = """
import json, os, sys, traceback
root, cases = sys.argv[1], json.loads(sys.argv[2])
sys.path.insert(0, root)
from sil_plant import run
children = {}
for name, arguments in cases.items():
    child = os.fork()
    if child == 0:
        for number, stream in ((1, "out"), (2, "err")):
            os.dup2(os.open(f"{name}.{stream}", os.O_WRONLY | os.O_CREAT | os.O_TRUNC), number)
        try:
            status = run.main(arguments)
        except SystemExit as end:
            status = end.code
        except BaseException:
            traceback.print_exc()
            status = 1
        sys.stdout.flush()
        os._exit(status)
    children[child] = name
ended = {}
while children:
    child, status = os.wait()
    ended[children.pop(child)] = os.waitstatus_to_exitcode(status)
print(json.dumps(ended))
"""


@dataclass(frozen=True)
class Ended:
    """How run.py ended on one bad input; `busy`: the port that was taken, `line`: where the file is wrong."""

    status: int
    out: str
    err: str
    busy: str
    line: int

    def says(self, pattern: str) -> bool:
        """Whether the message matches a pattern with {busy} and {line} in it."""
        pattern = pattern.replace("{busy}", self.busy).replace("{line}", str(self.line))
        return re.search(pattern, self.err) is not None


@pytest.fixture(scope="module")
def bad(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Ended]:
    """Every bad command line, run once."""
    folder = tmp_path_factory.mktemp("bad")
    lines = {}
    for origin, files in ((DEFAULT_SCENARIO, SCENARIO), (REFERENCE_ARM, ARM)):
        good = origin.read_text("utf-8")
        for name, edit in files.items():
            (folder / name).write_text(change(good, *edit), "utf-8")
            lines[name] = 1 + (edit[0].join(good.split(edit[0])[: edit[2]])).count("\n")
    names = [name for name in BAD if name != "vcan0 without CAN" or not kernel_has_can()]
    with socket.create_server(("127.0.0.1", 0)) as holder:
        busy = str(holder.getsockname()[1])
        cases = {
            name: [
                "--bus",
                "inproc",
                "--duration",
                "0.5",
                "--quiet",
                *(word.replace("{busy}", busy) for word in BAD[name][0]),
            ]
            for name in names
        }
        driver = subprocess.run(
            [sys.executable, "-c", FORKS, str(ROOT), json.dumps(cases)],
            cwd=folder,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=LIMIT_S,
            check=True,
        )
    statuses = json.loads(driver.stdout)
    return {
        name: Ended(
            status=statuses[name],
            out=(folder / f"{name}.out").read_text(),
            err=(folder / f"{name}.err").read_text(),
            busy=busy,
            line=lines.get(BAD[name][0][-1], 0),
        )
        for name in names
    }


@pytest.mark.parametrize("name", list(BAD))
def test_bad_input_does_not_leave_the_user_guessing(name: str, bad: dict[str, Ended]) -> None:
    """GIVEN a wrong command line or file WHEN run
    THEN status 2 and one line that names the thing and the way out.
    """
    if name not in bad:
        pytest.skip("this machine has CAN")
    result = bad[name]
    assert result.status == 2, result.err
    assert result.out == ""
    assert re.fullmatch(r"run\.py: [^\n]{15,400}\n", result.err), result.err
    for pattern in BAD[name][1]:
        assert result.says(pattern), (pattern, result.line, result.err)


@pytest.mark.parametrize("name", list(BAD))
def test_bad_input_does_not_show_a_traceback(name: str, bad: dict[str, Ended]) -> None:
    """GIVEN a wrong command line or file WHEN run
    THEN status 2, its last line from run.py, and no traceback.
    """
    if name not in bad:
        pytest.skip("this machine has CAN")
    assert bad[name].status == 2
    assert "Traceback" not in bad[name].err
    assert bad[name].err.splitlines()[-1].startswith("run.py: ")


@pytest.fixture(scope="module")
def unwritable(run_py: Callable, tmp_path_factory: pytest.TempPathFactory) -> tuple[subprocess.CompletedProcess, Path]:
    """A run whose JSON cannot be written although its folder is there, also for root."""
    folder = tmp_path_factory.mktemp("unwritable")
    (folder / "result.json").mkdir()
    arguments = ["--bus", "inproc", "--duration", "0.5", "--json", "result.json", "--csv", "trace.csv"]
    return run_py(*arguments, cwd=folder), folder


def test_figures_that_cannot_be_written_do_not_pass_in_silence(unwritable) -> None:
    """GIVEN a --json that cannot be written WHEN run THEN status 2 and one line that names it."""
    result, _ = unwritable
    assert result.returncode == 2
    assert re.fullmatch(r"run\.py: result\.json: cannot be written: [^\n]+\n", result.stderr)


def test_figures_that_cannot_be_written_do_not_take_the_rest_with_them(unwritable) -> None:
    """GIVEN a --json that cannot be written WHEN run
    THEN it is refused before the run, or CSV and table come all the same.
    """
    result, folder = unwritable
    early = "times real time" not in result.stdout and not (folder / "trace.csv").exists()
    late = "times real time" in result.stdout and (folder / "trace.csv").stat().st_size > 1000
    assert late or (early and "choose another" in result.stderr)


# ---- outside the project's environment -----------------------------------------------------------


@pytest.mark.parametrize("venv", ["none", "empty"])
def test_start_outside_the_environment_does_not_end_in_an_import_error(tmp_path: Path, venv: str) -> None:
    """GIVEN a Python without the packages, no .venv or an empty one WHEN run
    THEN status 2 and `make setup`, no loop.
    """
    shutil.copytree(ROOT / "sil_plant", tmp_path / "sil_plant", ignore=shutil.ignore_patterns("__pycache__", "*.toml"))
    bare = [getattr(sys, "_base_executable", sys.executable), "-I", "-S"]
    if venv == "empty":
        python = tmp_path / ".venv" / "bin" / "python"
        python.parent.mkdir(parents=True)
        python.write_text(f'#!/bin/sh\nexec {" ".join(bare)} "$@"\n', "utf-8")
        python.chmod(0o755)
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("PYTHON", "DIARC", "VIRTUAL_ENV"))}
    result = subprocess.run(
        [*bare, str(tmp_path / "sil_plant" / "run.py"), "--bus", "inproc"],
        env=environment,
        cwd=tmp_path,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=LIMIT_S,
        check=False,
    )
    assert result.returncode == 2
    assert re.fullmatch(r"run\.py: \w+ is missing here;[^\n]*make setup\n", result.stderr), result.stderr


def test_start_by_another_python_is_not_refused_when_the_environment_is_there(tmp_path: Path) -> None:
    """GIVEN the project's .venv WHEN run by a Python without the packages
    THEN it goes on in .venv, arguments and all.
    """
    if not (ROOT / ".venv" / "bin" / "python").exists():
        pytest.skip("the tests run in another environment than .venv")
    bare = [getattr(sys, "_base_executable", sys.executable), "-I", "-S"]
    result = subprocess.run(
        [*bare, str(ROOT / "sil_plant" / "run.py"), "--bus", "inproc", "--load", "-7"],
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=LIMIT_S,
        check=False,
    )
    assert result.returncode == 2 and "--load -7" in result.stderr


# ---- runs that do not end as planned -------------------------------------------------------------


def hub_of(run) -> str:
    """The bus string that a run started with port 0 tells, once it listens."""
    end = time.monotonic() + LIMIT_S
    while time.monotonic() < end:
        found = re.search(r"CAN over TCP at (tcp:\S+?);", run.err.read_text())
        if found:
            return found.group(1)
        assert run.process.poll() is None, run.err.read_text()
        time.sleep(0.02)
    pytest.fail("the run does not listen")


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as probe:
        return int(probe.getsockname()[1])


def port_is_free(port: int) -> bool:
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("127.0.0.1", port))
        except OSError:
            return False
        return True


def join(bus: str) -> can.BusABC:
    """A python-can bus, as soon as the hub is there."""
    end = time.monotonic() + LIMIT_S
    while True:
        try:
            return connect_python_can(bus)
        except Exception:
            if time.monotonic() > end:
                raise
            time.sleep(0.02)


def wait_for_motion(bus: str) -> None:
    """Listen until the arm is under way: the ECU has said 40 times that it moves."""
    estimate = protocol.database().get_message_by_name("ESTIMATE")
    end, moving = time.monotonic() + LIMIT_S, 0
    with join(bus) as listener:
        while moving < 40:
            assert time.monotonic() < end, "the arm does not move"
            message = listener.recv(1.0)
            if message is not None and message.arbitration_id == estimate.frame_id:
                moving += estimate.decode(message.data, decode_choices=False)["Moving"]


def processes_with(word: str) -> list[str]:
    """Command lines of the processes that have this word in theirs; our own apart."""
    found = []
    for entry in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            line = (entry / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
            if word in line and int(entry.name) != os.getpid():
                found.append(line)
    return found


def long_run(folder: Path) -> list[object]:
    """Arguments of a run that is to be broken off, and of what it then leaves."""
    return ["--duration", 60, "--json", folder / "r.json", "--csv", folder / "t.csv"]


def check_outputs(folder: Path) -> int:
    """The ticks of a run that was broken off; its JSON and CSV are whole and of one length."""
    found = json.loads((folder / "r.json").read_text("utf-8"))
    with (folder / "t.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == found["ticks"] > 400
    assert all(None not in row.values() for row in rows) and rows[-1]["mode"] == "RUN"
    assert float(rows[-1]["swing_reference_rad"]) > 0.0
    return found["ticks"]


def test_ecu_that_dies_does_not_hang_or_spoil_the_run(tmp_path: Path, start_run_py, start_ecu, run_py) -> None:
    """GIVEN a run under way WHEN its ECU is killed
    THEN status 1, JSON and CSV, valves closed, and the next run works.
    """
    port = free_port()
    bus = f"tcp:127.0.0.1:{port}"
    run = start_run_py("--bus", bus, *long_run(tmp_path))
    assert hub_of(run) == bus
    ecu = start_ecu(bus)
    wait_for_motion(bus)
    ecu.process.kill()
    assert run.wait(LIMIT_S) == 1
    said = [line for line in run.err.read_text().splitlines() if "CAN over TCP" not in line and "note:" not in line]
    assert len(said) == 1 and "the ECU fell silent" in said[0] and "valves are closed" in said[0]
    ticks = check_outputs(tmp_path)
    assert f"{ticks} ticks" in run.out.read_text()
    again = run_py(
        "--bus", bus, "--ecu", "spawn", "--pace", "lockstep", "--duration", 0.5, "--json", tmp_path / "2.json"
    )
    assert again.returncode == 0, again.stderr
    assert json.loads((tmp_path / "2.json").read_text())["ticks"] == 601


@pytest.mark.parametrize("how", ["terminal", "kill"])
def test_interrupted_run_does_not_leave_anything_behind(tmp_path: Path, start_run_py, run_py, how: str) -> None:
    """GIVEN a run with its own ECU WHEN Ctrl-C (to all) or SIGTERM (to it)
    THEN 130, outputs, no ECU, a free port.
    """
    port = free_port()
    bus = f"tcp:127.0.0.1:{port}"
    run = start_run_py("--bus", bus, "--ecu", "spawn", *long_run(tmp_path))
    wait_for_motion(bus)
    assert any("diarc_ecu" in line for line in processes_with(bus))
    if how == "terminal":
        os.killpg(run.process.pid, signal.SIGINT)
    else:
        run.process.terminate()
    assert run.wait(LIMIT_S) == 130
    said = [line for line in run.err.read_text().splitlines() if "note:" not in line]
    assert len(said) == 1 and "interrupted" in said[0] and "valves are closed" in said[0], said
    check_outputs(tmp_path)
    assert processes_with(bus) == []
    assert port_is_free(port)
    if how == "terminal":
        again = run_py("--bus", bus, "--ecu", "spawn", "--pace", "lockstep", "--duration", 0.5, "--quiet")
        assert (again.returncode, again.stderr) == (0, "")


def test_spawned_ecu_that_dies_is_not_waited_for(tmp_path: Path, start_run_py) -> None:
    """GIVEN a run with its own ECU WHEN that is killed
    THEN status 1, the outputs, and one line that tells its status.
    """
    bus = f"tcp:127.0.0.1:{free_port()}"
    run = start_run_py("--bus", bus, "--ecu", "spawn", *long_run(tmp_path))
    wait_for_motion(bus)
    children = Path(f"/proc/{run.process.pid}/task/{run.process.pid}/children").read_text().split()
    ours = [pid for pid in children if b"diarc_ecu" in Path(f"/proc/{pid}/cmdline").read_bytes()]
    assert len(ours) == 1
    os.kill(int(ours[0]), signal.SIGKILL)
    assert run.wait(LIMIT_S) == 1
    said = [line for line in run.err.read_text().splitlines() if "note:" not in line]
    assert len(said) == 1 and "ended with status -9" in said[0], said
    check_outputs(tmp_path)


def test_ecu_that_restarts_in_a_run_is_not_taken_for_the_same(tmp_path: Path, start_run_py, start_ecu) -> None:
    """GIVEN a run under way WHEN the ECU is reset by somebody's NMT
    THEN status 1, outputs, and one line that says so.
    """
    run = start_run_py("--bus", "tcp:127.0.0.1:0", *long_run(tmp_path))
    bus = hub_of(run)
    start_ecu(bus)
    wait_for_motion(bus)
    with join(bus) as other:
        other.send(can.Message(arbitration_id=0, is_extended_id=False, data=[129, 1]))
        assert run.wait(LIMIT_S) == 1
    said = [line for line in run.err.read_text().splitlines() if "CAN over TCP" not in line and "note:" not in line]
    assert len(said) == 1 and "restarted in the middle" in said[0] and "valves are closed" in said[0], said
    check_outputs(tmp_path)
