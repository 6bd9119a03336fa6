"""monitor, doctor and request on a bus over TCP with the real ECU: what would leave their user in the dark."""

from __future__ import annotations

import json
import os
import pty
import re
import select
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import pytest

from sil_plant.bus import e2e, frames, protocol
from sil_plant.bus.hub import Hub
from sil_plant.bus.ports import parse_bus
from sil_plant.loop import session
from sil_plant.monitoring import diagnosis
from sil_plant.monitoring.listen import Listener
from sil_plant.monitoring.watch import Watch

ROOT = Path(__file__).resolve().parents[2]
ECU = ROOT / "firmware" / "diarc_ecu"
LIMIT_S = 30.0  # no wait in this file is longer; reaching it is a failure
SENSORS = {
    "ENCODERS": {"SwingAngle": 0, "WristAngle": 0},
    "PRESSURES_SWING": {"BorePressure": 8000, "AnnulusPressure": 12000, "SpoolPosition": 0},
    "PRESSURES_WRIST": {"BorePressure": 9000, "AnnulusPressure": 11000, "SpoolPosition": 0},
}


@dataclass
class World:
    """A hub, and an I/O node of a still arm on it; a thread of its own answers SYNC."""

    hub: Hub
    answers: bool = True  # the I/O node is there
    corrupt: bool = False  # its encoder frames have a wrong CRC
    doubled: bool = False  # it answers twice
    raw: dict[str, dict[str, int]] = field(default_factory=lambda: {k: dict(v) for k, v in SENSORS.items()})
    every_20_ms: list[tuple[int, bytes]] = field(default_factory=list)
    going: bool = True

    @property
    def bus(self) -> str:
        return f"tcp:127.0.0.1:{self.hub.port}"

    def rows(self, sync: int) -> list[tuple[int, bytes]]:
        made = []
        for name, raw in self.raw.items():
            message = protocol.database().get_message_by_name(name)
            values = dict.fromkeys((signal.name for signal in message.signals), 0) | raw
            data = message.encode(values, scaling=False, strict=False)
            data = e2e.protected(message.frame_id, data, (sync - 1) % 15)
            if self.corrupt and name == "ENCODERS":
                data = bytes((data[0] ^ 0x55,)) + data[1:]
            made.append((message.frame_id, data))
        return made

    def serve(self) -> None:
        made: dict[tuple, list[tuple[int, bytes]]] = {}
        next_s = beat_s = time.monotonic()
        while self.going:
            frame = self.hub.receive(0.005)
            if frame is not None and frame[0] == protocol.SYNC_ID and self.answers:
                key = (frame[1][0] % 15, self.corrupt, *(n for raw in self.raw.values() for n in raw.values()))
                if key not in made:
                    made[key] = self.rows(frame[1][0])
                self.hub.send_many(made[key] * (2 if self.doubled else 1))
            now_s = time.monotonic()
            if now_s >= next_s:
                next_s = now_s + 0.02
                self.hub.send_many(self.every_20_ms)
            if self.answers and now_s >= beat_s:
                beat_s = now_s + 0.1
                self.hub.send(0x702, b"\x05")


@pytest.fixture
def world() -> Iterator[World]:
    """A hub with an I/O node on it."""
    made = World(Hub("127.0.0.1", 0))
    thread = threading.Thread(target=made.serve)
    thread.start()
    yield made
    made.going = False
    thread.join(LIMIT_S)
    made.hub.close()


def tool(name: str, *arguments: object, limit_s: float = LIMIT_S) -> subprocess.CompletedProcess[str]:
    """Run a tool to its end."""
    return subprocess.run(
        [sys.executable, str(ROOT / "tools" / f"{name}.py"), *map(str, arguments)],
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=limit_s,
        check=False,
    )


@dataclass
class Opinion:
    """What the doctor says."""

    status: int
    findings: dict[str, dict[str, str]]
    state: dict[str, Any] | None

    def has(self, code: str) -> dict[str, str]:
        assert code in self.findings, self.findings
        assert self.status == 1 and len(self.findings[code]["next"]) > 5
        return self.findings[code]


def doctor(bus: str, listen_s: float = 0.8) -> Opinion:
    """Ask the doctor, in this process."""
    evidence = diagnosis.examine(parse_bus(bus), listen_s)
    found = diagnosis.diagnose(evidence)
    state = None if evidence.state is None else evidence.state.as_dict()
    serious = any(finding.severity != "note" for finding in found)
    return Opinion(int(serious), {finding.code: asdict(finding) for finding in found}, state)


def until_heard(bus: str, wanted: Callable[[dict], bool]) -> dict:
    """Listen until what is heard is as wanted."""
    end, state = time.monotonic() + LIMIT_S, None
    while time.monotonic() < end:
        heard = diagnosis.examine(parse_bus(bus), 0.5).state
        state = heard.as_dict() if heard else {}
        if state and wanted(state):
            return state
    pytest.fail(f"not heard: {state}")


def start_network(bus: str) -> None:
    """NMT START, as a master that stays for a moment: a client that leaves at once may take its frame with it."""
    listener = Listener(parse_bus(bus), Watch(time.monotonic()))
    listener.open()
    try:
        end = time.monotonic() + LIMIT_S
        while listener.watch.snapshot(time.monotonic()).mode is None:
            assert time.monotonic() < end, "the ECU does not start"
            listener.send(0, bytes((1, 0)))
            listener.listen(time.monotonic() + 0.2)
    finally:
        listener.close()


def ask(bus: str, request: str, mode: str) -> None:
    """Send a request until the ECU is in that mode."""
    listener = Listener(parse_bus(bus), Watch(time.monotonic()))
    choices = protocol.database().get_message_by_name("MOTION").get_signal_by_name("Request").choices
    code = next(code for code, name in choices.items() if str(name) == request)
    end, counter = time.monotonic() + LIMIT_S, 0
    listener.open()
    try:
        while listener.watch.snapshot(time.monotonic()).mode != mode:
            assert time.monotonic() < end, f"never {mode}"
            counter += 1
            listener.send(*frames.from_row(session.motion_frame(counter, code, controller=2)))
            listener.listen(time.monotonic() + 0.1)
    finally:
        listener.close()


@pytest.fixture
def start_slow_ecu(start):
    """Start an ECU with ticks of 2 ms, which leave this machine time for others: ``start_slow_ecu(world)``."""
    return lambda world, name="ecu": start([ECU, world.bus, "--period-us", "2000"], name)


# ---- doctor: each situation has its finding -------------------------------------------------------------


def test_missing_hub_is_not_taken_for_a_silent_bus() -> None:
    """GIVEN nobody on the port WHEN asked THEN the plant that hosts it is the next command."""
    with Hub("127.0.0.1", 0) as hub:
        bus = f"tcp:127.0.0.1:{hub.port}"
    done = tool("doctor", bus, "--json")
    said = json.loads(done.stdout)
    assert (done.returncode, done.stderr, said["state"]) == (1, "", None)
    assert said["findings"][0]["code"] == "no-hub"
    assert said["findings"][0]["next"] == f"python sil_plant/run.py --bus {bus} --ecu spawn"
    assert {finding["code"] for finding in said["findings"]} <= {"no-hub", "no-realtime-permission"}


def test_silent_bus_is_not_a_riddle(world: World) -> None:
    """GIVEN a hub and nobody who sends WHEN asked THEN starting the ECU is the next command."""
    world.answers = False
    assert doctor(world.bus).has("silent")["next"] == f"./firmware/diarc_ecu {world.bus}"


def test_missing_ecu_is_not_blamed_on_the_plant(world: World) -> None:
    """GIVEN an I/O node's heartbeat alone WHEN asked THEN the ECU is missing, and nothing else is."""
    opinion = doctor(world.bus)
    assert opinion.has("no-ecu")["severity"] == "error"
    assert [code for code, found in opinion.findings.items() if found["severity"] == "error"] == [
        "no-ecu",
        "sensor-missing",
    ]


def test_missing_plant_is_not_blamed_on_the_ecu(world: World, start_slow_ecu) -> None:
    """GIVEN an ECU without an I/O node WHEN asked THEN the plant is missing, and SYNC is slow for it."""
    world.answers = False
    start_slow_ecu(world)
    opinion = doctor(world.bus)
    opinion.has("no-plant")
    assert "no-ecu" not in opinion.findings and "slow-sync" in opinion.findings


def test_ecu_that_nobody_started_is_not_called_sound(world: World, start_slow_ecu) -> None:
    """GIVEN ECU and I/O node without NMT START WHEN asked THEN START is the next command, and it helps."""
    start_slow_ecu(world)
    assert doctor(world.bus).has("not-started")["next"] == f"python tools/request.py {world.bus} START"
    assert tool("request", world.bus, "START").returncode == 0
    assert doctor(world.bus).has("mode-standby")["next"] == f"python tools/request.py {world.bus} RUN"


@pytest.fixture
def standby(world: World, start_slow_ecu) -> World:
    """An ECU in STANDBY."""
    start_slow_ecu(world)
    until_heard(world.bus, lambda state: state["ecu"]["alive"])
    start_network(world.bus)
    until_heard(world.bus, lambda state: state["mode"] == "STANDBY")
    return world


def test_refusal_is_not_left_without_its_reason(standby: World) -> None:
    """GIVEN STANDBY WHEN a MOVE is refused
    THEN request.py says why, and the doctor remembers the reason.
    """
    done = tool("request", standby.bus, "MOVE", "--joint", "swing", "--target", 0.1, "--duration", 1)
    assert done.returncode == 1 and "NOT_IN_RUN" in done.stderr and "RUN first" in done.stderr
    opinion = doctor(standby.bus)
    opinion.has("mode-standby")
    assert "NOT_IN_RUN" in opinion.has("refused")["text"]


def test_fault_is_not_told_without_what_to_do(standby: World) -> None:
    """GIVEN RUN and a pressure far too high WHEN asked
    THEN the fault has its name, cause and cure; once the pressure is back, the command that is told clears it.
    """
    ask(standby.bus, "HOLD", "HOLD")
    standby.raw["PRESSURES_SWING"]["BorePressure"] = 64000
    opinion = doctor(standby.bus)
    fault = opinion.has("fault")
    assert re.search(r"SENSOR_RATE|SENSOR_RANGE|OVER_PRESSURE", fault["text"]) and "RESET_FAULT" in fault["text"]
    assert opinion.state is not None and opinion.state["mode"] == "FAULT"
    standby.raw["PRESSURES_SWING"]["BorePressure"] = 8000
    command = fault["next"].split()
    assert command[:2] == ["python", "tools/request.py"]
    done = tool("request", *command[2:])
    assert done.returncode == 0, done.stderr
    assert "fault" not in doctor(standby.bus).findings


def test_corrupt_frames_are_not_taken_for_missing_ones(standby: World) -> None:
    """GIVEN encoder frames with a wrong CRC WHEN asked THEN they are named, here and as the ECU counts them."""
    standby.corrupt = True
    opinion = doctor(standby.bus, listen_s=6.0)  # an ECU that waits for its sensors tells its counters every 4 s
    assert "ENCODERS" in opinion.has("corrupt-frames")["text"]
    assert opinion.has("ecu-e2e")["severity"] in ("warning", "note")


def test_two_io_nodes_are_found(standby: World) -> None:
    """GIVEN two answers to each SYNC WHEN asked THEN that is found."""
    standby.doubled = True
    opinion = doctor(standby.bus)
    opinion.has("two-io-nodes")
    assert "two-ecus" not in opinion.findings


def test_second_ecu_is_found(standby: World, start_slow_ecu) -> None:
    """GIVEN a second ECU WHEN asked THEN that is found, and how to find the process."""
    start_slow_ecu(standby, "second")
    until_heard(standby.bus, lambda state: state["ecu"]["doubled"])
    opinion = doctor(standby.bus)
    assert opinion.has("two-ecus")["next"] == "pgrep -a diarc_ecu"


def test_other_dbc_is_found(world: World) -> None:
    """GIVEN frames of an ECU that was built from another DBC WHEN asked THEN both hashes are told."""
    message = protocol.database().get_message_by_name("TIMING")
    data = message.encode(
        {"E2eCrc": 0, "E2eCounter": 0, "Mode": 1, "TimingPage": 1, "DbcHash": 0xDEADBEEF}, scaling=False, padding=False
    )
    world.every_20_ms = [(0x701, b"\x05"), (message.frame_id, e2e.protected(message.frame_id, data, 0))]
    opinion = doctor(world.bus)
    text = opinion.has("dbc-mismatch")["text"]
    assert "DEADBEEF" in text and f"{protocol.dbc_hash():08X}" in text


def test_invalid_sensors_are_found(standby: World) -> None:
    """GIVEN an I/O node that marks pressures invalid WHEN asked THEN the joint is named."""
    standby.raw["PRESSURES_WRIST"]["SensorStatus"] = 15
    assert "wrist" in doctor(standby.bus).has("sensor-status")["text"]


def test_sound_bus_does_not_get_a_finding(start_run_py, run_py, tmp_path: Path) -> None:
    """GIVEN a run under way WHEN asked THEN status 0, and in text it says that nothing is wrong."""
    run = start_run_py("--bus", "tcp:127.0.0.1:0", "--ecu", "spawn", "--duration", 60)
    bus = hub_of(run)
    until_heard(bus, lambda state: state["mode"] == "RUN")
    end = time.monotonic() + LIMIT_S
    while (done := tool("doctor", bus)).returncode != 0:  # a busy machine does pause plant or ECU now and then
        assert time.monotonic() < end, done.stdout
    assert f"nothing wrong on {bus}" in done.stdout and "RUN" in done.stdout
    os.kill(run.process.pid, signal.SIGINT)
    run.wait(LIMIT_S)


def hub_of(run) -> str:
    """The bus string of a run with an ECU of its own and port 0: from its children's command line."""
    end = time.monotonic() + 90.0  # the plant may be compiled first
    while time.monotonic() < end:
        children = Path(f"/proc/{run.process.pid}/task/{run.process.pid}/children").read_text().split()
        for child in children:
            words = Path(f"/proc/{child}/cmdline").read_bytes().split(b"\0")
            if words[0].endswith(b"diarc_ecu"):
                return words[1].decode()
        assert run.process.poll() is None, run.err.read_text()
        time.sleep(0.05)
    pytest.fail("the run starts no ECU")


@pytest.mark.parametrize(
    ("name", "arguments", "said"),
    [
        ("doctor", ["inproc"], "inproc"),
        ("doctor", ["tcp:nowhere"], "tcp:127.0.0.1:29536"),
        ("doctor", ["vcan0", "--listen", "0"], "--listen 0"),
        ("doctor", ["vcan0", "vcan1"], "vcan1"),
        ("monitor", ["inproc"], "tcp:127.0.0.1:29536"),
        ("monitor", ["what is this"], "tcp:127.0.0.1:29536"),
        ("monitor", ["vcan0", "--nonsense"], "--help"),
        ("request", ["vcan0", "DANCE"], "SAFE_STOP"),
        ("request", ["vcan0", "MOVE"], "--target"),
        ("request", ["inproc", "RUN"], "inproc"),
    ],
)
def test_wrong_use_does_not_leave_the_user_guessing(name: str, arguments: list[str], said: str) -> None:
    """GIVEN a wrong command line WHEN run THEN status 2 and one line that says what to write."""
    done = tool(name, *arguments)
    assert (done.returncode, done.stdout) == (2, ""), done.stdout
    assert re.fullmatch(rf"{name}\.py: [^\n]{{15,400}}\n", done.stderr) and said in done.stderr, done.stderr


# ---- monitor -------------------------------------------------------------------------------------------


def test_snapshot_for_scripts_is_not_empty_or_torn(standby: World) -> None:
    """GIVEN an ECU in STANDBY WHEN asked once THEN text and JSON say so; without frames status is 1."""
    state = until_heard(standby.bus, lambda state: state["mode"] == "STANDBY")
    assert state["load"]["kg"] is not None and state["dbc_match"] is True and state["ecu"]["nmt"] == "OPERATIONAL"
    assert state["joints"]["swing"]["bore_bar"] == pytest.approx(40.0)
    text = tool("monitor", standby.bus, "--once")
    assert text.returncode == 0 and "STANDBY" in text.stdout and "bore, bar" in text.stdout
    assert all(len(line) <= 80 for line in text.stdout.splitlines())
    with Hub("127.0.0.1", 0) as hub:
        nowhere = f"tcp:127.0.0.1:{hub.port}"
    none = tool("monitor", nowhere, "--once")
    assert none.returncode == 1 and "nobody listens" in none.stderr and "Traceback" not in none.stderr


def lines_until(path: Path, pattern: str) -> str:
    """What the monitor wrote, once it shows the pattern."""
    end = time.monotonic() + LIMIT_S
    while time.monotonic() < end:
        text = path.read_text()
        if re.search(pattern, text):
            return text
        time.sleep(0.1)
    pytest.fail(f"never {pattern!r} in: {path.read_text()[-2000:]}")


def test_monitor_does_not_end_when_ecu_and_bus_go(standby: World, start, start_slow_ecu) -> None:
    """GIVEN a monitor into a file WHEN the bus goes and comes back with frames
    THEN it says since when nothing comes, goes on, and Ctrl-C ends it with status 0.
    """
    argv = [sys.executable, ROOT / "tools" / "monitor.py", standby.bus]
    monitor = start(argv, "monitor")
    lines_until(monitor.out, r"STANDBY  load ")
    port = standby.hub.port
    standby.going = False
    time.sleep(0.1)
    standby.hub.close()
    lines_until(monitor.out, r"no frames since \d\d:\d\d:\d\d: ")
    again = World(Hub("127.0.0.1", port))
    thread = threading.Thread(target=again.serve)
    thread.start()
    try:
        start_slow_ecu(again, "again")
        until_heard(again.bus, lambda state: state["ecu"]["alive"])
        start_network(again.bus)
        lines_until(monitor.out, r"no frames since[^$]*STANDBY  load ")
        monitor.process.send_signal(signal.SIGINT)
        assert monitor.wait(LIMIT_S) == 0
    finally:
        again.going = False
        thread.join(LIMIT_S)
        again.hub.close()
    assert monitor.err.read_text() == ""


def test_page_in_a_terminal_does_not_fail_or_overflow(standby: World) -> None:
    """GIVEN a terminal of 80 columns WHEN the monitor runs in it
    THEN the page has mode, load, faults and pressures; Ctrl-C ends it with status 0 and gives the screen back.
    """
    child, terminal = pty.fork()
    if child == 0:
        os.environ.update(COLUMNS="80", LINES="24", TERM="xterm-256color")
        os.execv(sys.executable, [sys.executable, str(ROOT / "tools" / "monitor.py"), standby.bus])
    seen, end = b"", time.monotonic() + LIMIT_S
    status = None
    while time.monotonic() < end and status is None:
        if select.select([terminal], [], [], 0.1)[0]:
            try:
                seen += os.read(terminal, 1 << 16)
            except OSError:
                break
        if b"DBC" in seen and b"STANDBY" in seen and b"bore, bar" in seen and b"\x03" not in seen:
            os.write(terminal, b"\x03")
            seen += b"\x03"
    _, status = os.waitpid(child, 0)
    os.close(terminal)
    text = re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", seen.decode("utf-8", "replace"))
    assert os.waitstatus_to_exitcode(status) == 0
    assert "no faults" in text and "± " in text and "Traceback" not in text
    assert b"\x1b[?1049l" in seen  # the alternate screen is left


def test_reader_that_goes_away_does_not_bring_a_traceback(standby: World) -> None:
    """GIVEN a monitor into a pipe WHEN its reader leaves THEN it ends without a word."""
    with subprocess.Popen(
        [sys.executable, str(ROOT / "tools" / "monitor.py"), standby.bus],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stdout is not None and process.stderr is not None
        process.stdout.readline()
        process.stdout.close()
        assert process.wait(LIMIT_S) == 0
        assert process.stderr.read() == ""


# ---- request -------------------------------------------------------------------------------------------


def test_request_is_not_called_done_before_it_is(standby: World) -> None:
    """GIVEN STANDBY WHEN HOLD and STANDBY are asked for THEN each is done, and the bus shows the mode."""
    done = tool("request", standby.bus, "HOLD")
    assert (done.returncode, done.stdout) == (0, "HOLD done: mode HOLD\n"), done.stderr
    assert until_heard(standby.bus, lambda state: True)["mode"] == "HOLD"
    done = tool("request", standby.bus, "STANDBY")
    assert done.returncode == 0 and "mode STANDBY" in done.stdout, done.stderr
    again = tool("request", standby.bus, "reset_fault")
    assert again.returncode == 1 and "NO_FAULT_TO_RESET" in again.stderr


def test_request_without_an_ecu_does_not_wait_for_ever(world: World) -> None:
    """GIVEN no ECU WHEN RUN is asked for THEN status 1 and the doctor is named; and before START, START is."""
    done = tool("request", world.bus, "RUN")
    assert done.returncode == 1 and f"python tools/doctor.py {world.bus}" in done.stderr


def test_request_before_start_names_start(world: World, start_slow_ecu) -> None:
    """GIVEN an ECU that is not operational WHEN RUN is asked for THEN status 1, and START is the next command."""
    start_slow_ecu(world)
    until_heard(world.bus, lambda state: state["ecu"]["alive"])
    done = tool("request", world.bus, "RUN")
    assert done.returncode == 1 and f"python tools/request.py {world.bus} START" in done.stderr
