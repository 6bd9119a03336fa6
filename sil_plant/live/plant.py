"""The plant that a live page acts on: the link to its control channel, and a plant of one's own."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import deque
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sil_plant.config import ROOT, ConfigError
from sil_plant.loop.control_channel import HOST, PROTOCOL, Hello

RUN_PY = ROOT / "sil_plant" / "run.py"
LIVE_SCENARIO = ROOT / "sil_plant" / "scenarios" / "live.toml"
TRUTH_STALE_S = 0.5
_RETRY_S = 1.0
_CONNECT_S = 0.2
_ANSWER_S = 2.0
_STOP_S = 10.0
_LINES_KEPT = 20


@dataclass(frozen=True)
class Truth:
    """What no sensor has touched; None: the plant does not tell."""

    load_kg: float | None = None
    angles_rad: tuple[float, float] | None = None


class PlantLink:
    """A program's end of the control channel; never waits longer than a connection on this computer takes.

    Parameters
    ----------
    port : int or None
        Of the plant on this computer; None: there is none to look for.
    bus : str
        The bus that is watched: a plant on another one is not the one to act on.

    Attributes
    ----------
    hello : Hello or None
        What the plant says of itself, while it is there.
    reason : str
        Why there is none.
    said : deque of str
        Its answers to what was asked of it.
    """

    def __init__(self, port: int | None, bus: str) -> None:
        self._port = port
        self._bus = bus
        self._sock: socket.socket | None = None
        self._unfinished = b""
        self._retry_s = 0.0
        self._open: deque[tuple[str, float]] = deque()
        self._truth: tuple[float, Truth] = (-1e9, Truth())
        self.hello: Hello | None = None
        self.reason = ""
        self.said: deque[str] = deque(maxlen=_LINES_KEPT)
        self._without()

    def _without(self, why: str = "") -> None:
        """No link: say why, once more when the next attempt has failed."""
        if self._sock is not None:
            self._sock.close()
        self._sock, self.hello, self._unfinished = None, None, b""
        self._open.clear()
        self.reason = why or (
            "no plant of this project is known here"
            if self._port is None
            else f"no plant takes commands on port {self._port}; run.py --control {self._port} makes one do so"
        )

    def step(self) -> None:
        """Connect when it is time to, take what has come, ask for the truth."""
        now_s = time.monotonic()
        if self._sock is None:
            if self._port is None or now_s < self._retry_s:
                return
            self._retry_s = now_s + _RETRY_S
            try:
                self._sock = socket.create_connection((HOST, self._port), _CONNECT_S)
                self._sock.setblocking(False)
                self._sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            except OSError:
                self._without()
                return
            self._open.append(("hello", now_s))
        self._receive(now_s)
        if self._sock is not None and self._open and now_s - self._open[0][1] > _ANSWER_S:
            self._without("the plant does not answer; it waits for its ECU, or has stopped")
            self._retry_s = now_s + _RETRY_S
        if self.hello is not None and not any(what == "truth" for what, _ in self._open):
            self._ask("truth", {"do": "truth"})

    def _receive(self, now_s: float) -> None:
        while self._sock is not None:
            try:
                data = self._sock.recv(1 << 16)
            except BlockingIOError:
                return
            except OSError:
                data = b""
            if not data:
                self._without("the plant has ended")
                return
            *lines, self._unfinished = (self._unfinished + data).split(b"\n")
            for line in lines:
                self._take(line, now_s)

    def _take(self, line: bytes, now_s: float) -> None:
        try:
            answer = json.loads(line)
            what, _ = self._open.popleft()
            if what == "hello":
                self._greet(answer)
            elif what == "truth":
                angles = answer.get("angle_rad")
                known = Truth(answer.get("load_kg"), None if angles is None else (angles[0], angles[1]))
                self._truth = (now_s, known)
            elif answer["ok"]:
                self.said.append(f"{answer['done']}, at {answer['time_s']:.3f} s of the plant")
            else:
                self.said.append(f"refused: {answer['why']}")
        except (ValueError, KeyError, TypeError, IndexError, AttributeError):
            self._port = None
            self._without("what listens there is no plant of this version")

    def _greet(self, answer: dict[str, Any]) -> None:
        if answer.get("plant") != "diarc" or answer.get("protocol") != PROTOCOL:
            raise ValueError
        hello = Hello(answer["bus"], answer["arm"], float(answer["heaviest_kg"]), bool(answer["spawned"]))
        if hello.bus != self._bus:
            self._without(f"the plant on port {self._port} is on another bus, {hello.bus}")
            self._retry_s = time.monotonic() + 5.0 * _RETRY_S
            return
        self.hello = hello

    def ask(self, request: dict[str, Any]) -> None:
        """Ask for a load or a fault; the answer comes to `said`."""
        if self.hello is None:
            self.said.append(f"not possible: {self.reason}")
        else:
            self._ask("command", request)

    def _ask(self, what: str, request: dict[str, Any]) -> None:
        if self._sock is None:
            return
        try:
            self._sock.sendall(json.dumps(request).encode() + b"\n")
            self._open.append((what, time.monotonic()))
        except OSError:
            self._without("the plant has ended")

    def truth(self) -> Truth:
        """What the plant says is true now."""
        when_s, found = self._truth
        return found if self.hello is not None and time.monotonic() - when_s <= TRUTH_STALE_S else Truth()

    def close(self) -> None:
        """Leave."""
        self._port = None
        self._without()


class OwnPlant:
    """A plant and an ECU of our own, in a process beside this one: run.py, that goes on until it is stopped.

    Parameters
    ----------
    bus : str
        The bus it makes.
    control_port : int
        Where it takes commands.
    options : list of str
        Of run.py, to go with these.
    """

    def __init__(self, bus: str, control_port: int, options: list[str]) -> None:
        self._command = [
            sys.executable, str(RUN_PY), "--bus", bus, "--ecu", "spawn", "--endless", "--quiet",
            "--control", str(control_port), "--scenario", str(LIVE_SCENARIO), *options,
        ]  # fmt: skip
        self._lines: deque[str] = deque(maxlen=_LINES_KEPT)
        self._process: subprocess.Popen[str] | None = None
        self.start()

    def start(self) -> None:
        """Start it; again after it has ended."""
        self._lines.clear()
        # a session of its own: Ctrl-C comes to us, and we end it in order
        self._process = subprocess.Popen(
            self._command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
            text=True, start_new_session=True,
        )  # fmt: skip
        threading.Thread(target=self._listen, args=(self._process,), daemon=True).start()

    def _listen(self, process: subprocess.Popen[str]) -> None:
        assert process.stderr is not None
        for line in process.stderr:
            self._lines.append(line.strip())

    @property
    def ended(self) -> bool:
        """Whether it has, by itself."""
        return self._process is not None and self._process.poll() is not None

    def said(self) -> str:
        """Its last words; empty when it has said nothing."""
        return self._lines[-1] if self._lines else ""

    def stop(self) -> None:
        """End it and its ECU, in order, and at last by force."""
        process, self._process = self._process, None
        if process is None or process.poll() is not None:
            return
        process.send_signal(signal.SIGTERM)
        try:
            process.wait(_STOP_S)
        except subprocess.TimeoutExpired:
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.killpg(process.pid, signal.SIGKILL)  # its ECU with it
            process.wait()


def free_port(preferred: int) -> int:
    """A free port of the loopback interface, this one where it is free.

    Raises
    ------
    ConfigError
        When there is none.
    """
    for port in (preferred, 0):
        with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((HOST, port))
                probe.listen()
                return int(probe.getsockname()[1])
            except OSError:
                continue
    raise ConfigError(f"no TCP port is free on {HOST}; is the loopback interface up (ip link show lo)?")


def machine_of(hello: Hello | None, given: Path) -> Path:
    """The machine file to draw: the plant's where it is known and here, else the one given."""
    if hello is not None and Path(hello.arm).is_file():
        return Path(hello.arm)
    return given
