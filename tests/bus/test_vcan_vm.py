"""The virtual machine with a CAN bus (`tools/vcan_vm`): what could silently spoil the tests run in it.

Starting it takes seconds, so that most tests look at the outcome of one common run (`tour`).
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

ARGUMENTS = ["two  words", "quote'\"s", "", "ünï 💡", "line\nbreak", "$HOME * \\ ;|&", "--help"]
TOUR_STATUS = 37
NOISE = bytes(range(256)) * 2000
ROUND_TRIPS = 200
TICKS = 300

CHAIN = """
import math
import struct


def chain(seed: float, steps: int = 40_000) -> str:
    x, total = seed, 0.0
    for _ in range(steps):
        x = math.sin(1.7 * x + 0.3) + math.atan(x) * math.sqrt(abs(x) + 1e-3)
        total = 0.999 * total + x
    return struct.pack("<dd", x, total).hex()
"""

CACHED = """
import json
import math
import sys

import numba


@numba.njit(cache=True)
def chain(seed, steps):
    x, total = seed, 0.0
    for _ in range(steps):
        x = math.sin(1.7 * x + 0.3) + math.atan(x) * math.sqrt(abs(x) + 1e-3)
        total = 0.999 * total + x
    return x, total


result = [value.hex() for value in chain(0.5, 300_000)]
outcome = {"result": result, "hits": sum(chain.stats.cache_hits.values())}
with open(sys.argv[1], "w") as file:
    json.dump(outcome, file)
"""

TOUR = """
import ctypes
import json
import multiprocessing
import os
import select
import socket
import struct
import subprocess
import sys
import time

from chain import chain

REPORT, STATUS, ROUND_TRIPS, TICKS, CACHED = json.loads(sys.argv[1])
FILTER = (socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER)


def bus(interface, can_id):
    raw = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
    raw.settimeout(5)
    raw.setsockopt(*FILTER, struct.pack("=II", can_id, 0x7FF))
    raw.bind((interface,))
    return raw


def echo(ready):
    raw = bus("can1", 0x100)
    ready.set()
    for _ in range(ROUND_TRIPS):
        raw.send(struct.pack("=IB3x8s", 0x101, 8, raw.recv(16)[8:]))


def round_trips():
    ready = multiprocessing.Event()
    peer = multiprocessing.Process(target=echo, args=(ready,))
    peer.start()
    ready.wait(10)
    raw, answered = bus("can1", 0x101), 0
    for number in range(ROUND_TRIPS):
        raw.send(struct.pack("=IB3xQ", 0x100, 8, number))
        answered += struct.unpack("=Q", raw.recv(16)[8:])[0] == number
    peer.join(5)
    return answered


def ticks():
    libc = ctypes.CDLL(None)
    timer = libc.timerfd_create(time.CLOCK_MONOTONIC, 0)
    start = time.monotonic_ns()
    when = (ctypes.c_long * 4)(0, 1_000_000, start // 10**9, start % 10**9)
    assert libc.timerfd_settime(timer, 1, ctypes.byref(when), None) == 0
    poll, seen = select.epoll(), 0
    poll.register(timer, select.EPOLLIN)
    while seen < TICKS:
        assert poll.poll(5)
        seen += struct.unpack("=Q", os.read(timer, 8))[0]
    return (time.monotonic_ns() - start) / 1e9 / seen * 1e3


def talk(family, address):
    server = socket.socket(family)
    server.bind(address)
    server.listen()
    client = socket.socket(family)
    client.connect(server.getsockname())
    server.accept()[0].sendall(b"hello")
    return client.recv(5).decode()


outcome = {
    "arguments": sys.argv[2:],
    "directory": os.getcwd(),
    "environment": dict(os.environ),
    "stdin": sys.stdin.read(),
    "terminal": os.isatty(1) or os.isatty(2),
    "interfaces": sorted(name for _, name in socket.if_nameindex()),
    "round_trips": round_trips(),
    "tick_ms": ticks(),
    "loopback": talk(socket.AF_INET, ("127.0.0.1", 0)),
    "unix": talk(socket.AF_UNIX, REPORT + ".socket"),
}
with multiprocessing.Pool(3) as pool:
    outcome["chains"] = pool.map(chain, [0.25, 0.5, 0.75], chunksize=1)
outcome["cached"] = subprocess.run([sys.executable, *CACHED]).returncode
with open(REPORT, "w") as file:
    json.dump(outcome, file)

subprocess.Popen(["sleep", "1000"])  # keeps our stdout and stderr open
sys.stderr.write("only for stderr\\n")
sys.stdout.buffer.write(bytes(range(256)) * 2000)
sys.stdout.flush()
os._exit(STATUS)
"""


@dataclass(frozen=True)
class Tour:
    """What came out of the common run.

    Attributes
    ----------
    status : int
        Exit status of `tools/vcan_vm`.
    out, err : bytes
        Its standard output and error.
    inside : dict[str, Any]
        What the program inside saw.
    directory : Path
        Working directory of the run.
    cached_outside, cached_inside : dict[str, Any]
        Results of the same cached numba function, compiled outside.
    temporary : Path
        Directory for temporary files during the run.
    """

    status: int
    out: bytes
    err: bytes
    inside: dict[str, Any]
    directory: Path
    cached_outside: dict[str, Any]
    cached_inside: dict[str, Any]
    temporary: Path


@pytest.fixture(scope="module")
def tour(vcan_vm: Path, tmp_path_factory: pytest.TempPathFactory) -> Tour:
    """Run one program in the virtual machine that tries everything out.

    Parameters
    ----------
    vcan_vm : Path
        The program under test.
    tmp_path_factory : pytest.TempPathFactory
        For the directories.

    Returns
    -------
    Tour
        The outcome.
    """
    base = tmp_path_factory.mktemp("tour")
    directory, temporary = base / "with space", base / "t"
    directory.mkdir()
    temporary.mkdir()
    (directory / "chain.py").write_text(CHAIN)
    (directory / "cached.py").write_text(CACHED)
    (directory / "tour.py").write_text(TOUR)
    report, outside, inside = (directory / name for name in ("report", "outside", "inside"))
    environment = os.environ | {
        "TMPDIR": str(temporary),
        "DIARC_TEST": "a 'b' ü",
        "SECRET": "not for inside",
        "NUMBA_CACHE_DIR": str(base / "cache"),
    }
    subprocess.run([sys.executable, "cached.py", outside], cwd=directory, env=environment, timeout=60, check=True)
    settings = json.dumps([str(report), TOUR_STATUS, ROUND_TRIPS, TICKS, ["cached.py", str(inside)]])
    options = ["--timeout", "60", "--interface", "vcan0", "--interface", "can1"]
    run = subprocess.run(
        [vcan_vm, *options, "--", sys.executable, "tour.py", settings, *ARGUMENTS],
        cwd=directory,
        env=environment,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        timeout=75,
        check=False,
    )
    assert report.exists(), run.stderr.decode(errors="replace")
    return Tour(
        run.returncode,
        run.stdout,
        run.stderr,
        json.loads(report.read_text()),
        directory,
        json.loads(outside.read_text()),
        json.loads(inside.read_text()) if inside.exists() else {},
        temporary,
    )


def test_exit_status_of_the_command_is_not_swallowed(tour: Tour) -> None:
    """GIVEN a command that ends with status 37 WHEN it ran inside THEN the caller gets 37."""
    assert tour.status == TOUR_STATUS


def test_arguments_with_spaces_are_not_split(tour: Tour) -> None:
    """GIVEN arguments with blanks, quotes and line breaks WHEN passed on THEN they arrive unharmed."""
    assert tour.inside["arguments"] == ARGUMENTS


def test_command_does_not_start_in_another_directory(tour: Tour) -> None:
    """GIVEN a caller in some directory WHEN the command starts inside THEN it is in that directory."""
    assert Path(tour.inside["directory"]) == tour.directory


def test_settings_in_the_environment_are_not_lost(tour: Tour) -> None:
    """GIVEN project variables and others WHEN a command runs inside THEN it sees the former only."""
    environment = tour.inside["environment"]
    assert environment["DIARC_TEST"] == "a 'b' ü"
    assert environment["PATH"] == os.environ["PATH"]
    assert "SECRET" not in environment


def test_command_that_reads_stdin_does_not_wait_for_ever(tour: Tour) -> None:
    """GIVEN a caller without a terminal WHEN the command reads its input THEN that is at its end."""
    assert tour.inside["stdin"] == ""
    assert not tour.inside["terminal"]


def test_output_is_not_cut_or_altered(tour: Tour) -> None:
    """GIVEN half a megabyte of every byte value WHEN written to stdout THEN all arrives as written."""
    assert hashlib.sha256(tour.out).hexdigest() == hashlib.sha256(NOISE).hexdigest()


def test_errors_are_not_mixed_into_the_output(tour: Tour) -> None:
    """GIVEN words on stderr WHEN the command ends THEN they are on stderr, with nothing added."""
    assert tour.err == b"only for stderr\n"


def test_process_left_behind_does_not_keep_the_caller_waiting(tour: Tour) -> None:
    """GIVEN a sleeper that holds stdout WHEN the command ends THEN so does the run, leaving nothing."""
    assert tour.status == TOUR_STATUS
    assert list(tour.temporary.iterdir()) == []


def test_can_frames_between_processes_are_not_lost(tour: Tour) -> None:
    """GIVEN two processes on a second interface WHEN they exchange frames THEN each is answered."""
    assert tour.inside["interfaces"] == ["can1", "lo", "vcan0"]
    assert tour.inside["round_trips"] == ROUND_TRIPS


def test_clock_inside_does_not_run_at_another_pace(tour: Tour) -> None:
    """GIVEN a timer of 1 ms WHEN 300 ticks have passed inside THEN a tick took 1 ms, not 10."""
    assert tour.inside["tick_ms"] == pytest.approx(1.0, rel=0.3)


def test_local_sockets_are_not_dead(tour: Tour) -> None:
    """GIVEN the loopback network and a socket in a directory WHEN talked over THEN both carry data."""
    assert (tour.inside["loopback"], tour.inside["unix"]) == ("hello", "hello")


def test_floating_point_state_is_not_mixed_up_between_processes(tour: Tour) -> None:
    """GIVEN three processes computing at once WHEN compared with outside THEN every bit is the same."""
    scope: dict[str, Callable[[float], str]] = {}
    exec(CHAIN, scope)  # the very text that ran inside
    assert tour.inside["chains"] == [scope["chain"](seed) for seed in (0.25, 0.5, 0.75)]


def test_compiled_functions_are_not_compiled_again_inside(tour: Tour) -> None:
    """GIVEN a numba cache filled outside WHEN used inside THEN it hits, and the results are identical."""
    assert tour.inside["cached"] == 0
    assert tour.cached_inside["hits"] == 1
    assert tour.cached_inside["result"] == tour.cached_outside["result"]


def living_members(group: int) -> list[int]:
    """List the living processes of a process group.

    Parameters
    ----------
    group : int
        Its number.

    Returns
    -------
    list[int]
        Process numbers, without those that are dead and merely not waited for yet.
    """
    members = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, _, process_group = stat.read_text(errors="replace").rpartition(") ")[2].split()[:3]
        except (OSError, ValueError):
            continue
        if int(process_group) == group and state not in "ZX":
            members.append(int(stat.parent.name))
    return members


def wait_until(condition: Callable[[], bool], timeout_s: float) -> bool:
    """Wait for a condition.

    Parameters
    ----------
    condition : Callable[[], bool]
        Asked every 20 ms.
    timeout_s : float
        Time limit in seconds.

    Returns
    -------
    bool
        Whether it came true in time.
    """
    deadline = time.monotonic() + timeout_s
    while not condition():
        if time.monotonic() > deadline:
            return False
        time.sleep(0.02)
    return True


@dataclass(frozen=True)
class Hanging:
    """A virtual machine with a command in it that does not end.

    Attributes
    ----------
    process : subprocess.Popen[bytes]
        `tools/vcan_vm`.
    group : int
        Process group of the virtual machine.
    temporary : Path
        Directory for its temporary files.
    first_line : bytes
        What the command wrote before it hung.
    """

    process: subprocess.Popen[bytes]
    group: int
    temporary: Path
    first_line: bytes


@pytest.fixture(scope="module")
def hanging(vcan_vm: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Hanging]]:
    """Start several virtual machines at once whose commands write a line and hang.

    Parameters
    ----------
    vcan_vm : Path
        The program under test.
    tmp_path_factory : pytest.TempPathFactory
        For the directories.

    Yields
    ------
    dict[str, Hanging]
        By what will end them; `timeout` ends by itself 10 s after its start.
    """
    command = ["bash", "-c", "echo started; sleep 1000 & wait"]
    started: dict[str, tuple[subprocess.Popen[bytes], Path]] = {}
    try:
        for name in ("timeout", "term", "kill"):
            temporary = tmp_path_factory.mktemp(name)
            limit = "10" if name == "timeout" else "60"
            process = subprocess.Popen(
                [vcan_vm, "--timeout", limit, "--", *command],
                env=os.environ | {"TMPDIR": str(temporary)},
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                start_new_session=True,
            )
            started[name] = process, temporary
        machines = {}
        for name, (process, temporary) in started.items():
            assert process.stdout is not None
            line = process.stdout.readline()  # bounded: the program ends by itself
            numbers = [int(path.read_text()) for path in temporary.glob("*/vm/pid")]
            assert len(numbers) == 1, (name, line)
            machines[name] = Hanging(process, numbers[0], temporary, line)
        yield machines
    finally:
        for process, _ in started.values():
            if process.poll() is None:
                process.terminate()
            process.communicate(timeout=10)


def test_output_is_not_held_back_until_the_end(hanging: dict[str, Hanging]) -> None:
    """GIVEN several machines at once with hanging commands WHEN they wrote a line THEN we have it."""
    assert {machine.first_line for machine in hanging.values()} == {b"started\n"}
    assert all(living_members(machine.group) for machine in hanging.values() if machine.process.poll() is None)


@pytest.mark.parametrize(
    ("end", "number", "status"), [("term", signal.SIGTERM, 143), ("kill", signal.SIGKILL, -signal.SIGKILL)]
)
def test_machine_does_not_outlive_its_caller(
    hanging: dict[str, Hanging], end: str, number: signal.Signals, status: int
) -> None:
    """GIVEN a hanging command WHEN the caller is ended or even killed THEN no process or file remains."""
    machine = hanging[end]
    assert living_members(machine.group)
    machine.process.send_signal(number)
    assert machine.process.wait(5) == status
    assert wait_until(lambda: not living_members(machine.group), 5)
    assert wait_until(lambda: not any(machine.temporary.iterdir()), 5)


def test_command_that_hangs_does_not_hang_the_caller(hanging: dict[str, Hanging]) -> None:
    """GIVEN a hanging command WHEN its time is up THEN it ends with 124 and says so, leaving nothing."""
    machine = hanging["timeout"]
    _, err = machine.process.communicate(timeout=15)
    assert machine.process.returncode == 124
    assert b"timeout after 10 s" in err
    assert living_members(machine.group) == []
    assert list(machine.temporary.iterdir()) == []


def test_misuse_is_not_taken_for_success(vcan_vm: Path) -> None:
    """GIVEN wrong options WHEN called THEN the status is 2 and the message names what is wrong."""
    cases = {
        "no command": [],
        "unknown option --frob": ["--frob", "--", "true"],
        "not a number of seconds above 0: soon": ["--timeout", "soon", "--", "true"],
        "not a name for a CAN interface: a b": ["--interface", "a b", "--", "true"],
        "--timeout needs a value": ["--timeout"],
    }
    for message, arguments in cases.items():
        run = subprocess.run([vcan_vm, *arguments], capture_output=True, text=True, timeout=10, check=False)
        assert (run.returncode, run.stdout) == (2, "")
        assert message in run.stderr


def test_missing_package_is_not_left_to_guessing(vcan_vm: Path, tmp_path: Path) -> None:
    """GIVEN a machine without user-mode Linux WHEN checked THEN the message says how to install it."""
    for tool in ("bash", "grep", "perl", "setpriv", "cc"):
        (tmp_path / tool).symlink_to(shutil.which(tool) or "/missing")
    run = subprocess.run(
        ["bash", vcan_vm, "--check"],
        env={"PATH": str(tmp_path)},
        capture_output=True,
        text=True,
        timeout=10,
        check=False,
    )
    assert run.returncode == 2
    assert "apt-get install user-mode-linux" in run.stderr


def test_fixture_does_not_run_without_a_bus(run_on_vcan: Callable[..., Any]) -> None:
    """GIVEN the fixture that bus tests use WHEN a command asks for vcan0 THEN it is up."""
    run = run_on_vcan(["bash", "-c", "cat /sys/class/net/vcan0/flags; exit 5"], timeout_s=20)
    assert run.returncode == 5, run.stderr
    assert int(run.stdout, 16) & 1
