"""A channel into a running plant: a program on this computer changes the load, breaks something, asks for the truth.

The plant listens on a port of the loopback interface (``run.py --control``) and speaks lines of JSON. It looks for
them between two ticks only, so that whatever is asked for takes effect at a tick's beginning; the tick is in the
answer and in the run's output. A run to which nobody says anything is the same run, to the last bit.

======================================================== ==========================================================
``{"do": "load", "kg": 4.0}``                            the load at the tip from now on
``{"do": "fault", "kind": "stuck", "target": ...,        a fault as in a scenario's ``[[faults]]``, from now on
"duration_s": 0.3, "size": ..., "recover_after_s": ...}``
``{"do": "truth"}``                                      angles, rates, pressures, spools and load as they are
======================================================== ==========================================================

Every request has one answer, in order: ``{"ok": true, "tick": ...}`` or ``{"ok": false, "why": "..."}``. Who
connects is greeted with what the plant is.
"""

from __future__ import annotations

import contextlib
import errno
import json
import math
import socket
from dataclasses import dataclass
from typing import Any

from sil_plant.bus.ports import BusError
from sil_plant.config import ConfigError
from sil_plant.inputs.faults import read_fault
from sil_plant.loop import injection
from sil_plant.loop.execution import check_faults
from sil_plant.loop.session import TICK, Session, motion_frames_sent
from sil_plant.plant.dynamics import P_SWING, XV, Q, W

DEFAULT_CONTROL_PORT = 29540
PROTOCOL = 1
HOST = "127.0.0.1"
_LINE_MOST = 4096
_CLIENTS_MOST = 8
_UNREAD_MOST = 1 << 16  # bytes of answers that nobody reads
_FAULTS_MOST = 500


@dataclass(frozen=True)
class Hello:
    """What a plant says of itself.

    Attributes
    ----------
    bus, arm : str
        Its bus string and its machine file.
    heaviest_kg : float
        Loads are 0 to this.
    spawned : bool
        It has started its ECU itself, and may kill it.
    """

    bus: str
    arm: str
    heaviest_kg: float
    spawned: bool


@dataclass(frozen=True)
class Command:
    """What somebody has done to the plant.

    Attributes
    ----------
    time_s : float
        From the start of motion.
    what : str
        In words.
    """

    time_s: float
    what: str


class Request:
    """One request, read as a scenario's table is; its errors name no file."""

    def __init__(self, values: dict[str, Any]) -> None:
        self.data = values

    def error(self, key: str, what: str, item: int = 0) -> ConfigError:
        """The error that says what is wrong with a key."""
        return ConfigError(f"{key.removeprefix('faults.')}: {what}")

    def number(self, key: str, value: Any, low: float, high: float, item: int = 0) -> float:
        """Check that a value is a number in a range."""
        if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
            raise self.error(key, f"a number from {low:g} to {high:g} is needed, not {value!r}", item)
        return float(value)


class _Client:
    """One connection."""

    def __init__(self, sock: socket.socket) -> None:
        self.sock = sock
        self.unfinished = b""
        self.unread = b""


class Control:
    """The plant's end.

    Parameters
    ----------
    port : int
        Where to listen; 0 is any that is free.
    hello : Hello
        The greeting.

    Attributes
    ----------
    port : int
        Where it listens.
    commands : list of Command
        What was done, in order.
    session : Session or None
        The session as it was left last: a fault makes another one of it, with the same arrays.

    Raises
    ------
    BusError
        When the port cannot be had.
    """

    def __init__(self, port: int, hello: Hello) -> None:
        self._hello = hello
        self._clients: list[_Client] = []
        self.commands: list[Command] = []
        self.session: Session | None = None
        self._rewound_ticks = 0
        self._listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        try:
            self._listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            self._listener.bind((HOST, port))
            self._listener.listen(_CLIENTS_MOST)
            self._listener.setblocking(False)
        except (OSError, OverflowError) as error:
            self._listener.close()
            taken = isinstance(error, OSError) and error.errno == errno.EADDRINUSE
            what = "is taken by another program" if taken else f"cannot be used: {error}"
            raise BusError(f"--control {port}: the port {what}; choose another, or 0 for any that is free") from error
        self.port = int(self._listener.getsockname()[1])

    def rewound(self, ticks: int) -> None:
        """Note that an endless run has begun to count anew."""
        self._rewound_ticks += ticks

    def serve(self, session: Session) -> Session:
        """Carry out what has been asked for since the last time; never waits. The session to go on with."""
        self.session = session
        with contextlib.suppress(BlockingIOError, ConnectionError):
            sock, _ = self._listener.accept()
            sock.setblocking(False)
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            client = _Client(sock)
            self._clients.append(client)
            hello = {"plant": "diarc", "protocol": PROTOCOL, **vars(self._hello)}
            self._answer(client, hello)
            if len(self._clients) > _CLIENTS_MOST:
                self._drop(self._clients[0])
        for client in self._clients[:]:
            self._read(client)
        return self.session

    def _read(self, client: _Client) -> None:
        try:
            data = client.sock.recv(_LINE_MOST)
        except BlockingIOError:
            data = None
        except OSError:
            data = b""
        if data == b"" or len(client.unfinished) > _LINE_MOST:
            self._drop(client)
            return
        if data:
            *lines, client.unfinished = (client.unfinished + data).split(b"\n")
            for line in lines:
                self._answer(client, self._carry_out(line))
        elif client.unread:
            self._send(client)

    def _answer(self, client: _Client, answer: dict[str, Any]) -> None:
        client.unread += json.dumps(answer).encode() + b"\n"
        self._send(client)

    def _send(self, client: _Client) -> None:
        try:
            count = client.sock.send(client.unread)
            client.unread = client.unread[count:]
        except BlockingIOError:
            pass
        except OSError:
            self._drop(client)
        if len(client.unread) > _UNREAD_MOST:
            self._drop(client)

    def _drop(self, client: _Client) -> None:
        client.sock.close()
        if client in self._clients:
            self._clients.remove(client)

    def _carry_out(self, line: bytes) -> dict[str, Any]:
        session = self.session
        assert session is not None
        tick = int(session.progress.index[TICK])
        time_s = round((tick + self._rewound_ticks - session.timeline.motion) * session.timeline.period_s, 6)
        try:
            request = json.loads(line)
            if not isinstance(request, dict):
                raise ConfigError(f"an object is needed, not {request!r}")
            values = {key: value for key, value in request.items() if key != "do" and value is not None}
            what = request.get("do")
            if what == "truth":
                found = {"ok": True, "tick": tick, "time_s": time_s} | truth(session)
                return found
            if what == "load":
                done = self._set_load(session, values)
            elif what == "fault":
                done = self._kick(session, values, tick)
            else:
                raise ConfigError(f"{what!r} is not understood; there are load, fault and truth")
        except (ConfigError, ValueError, RecursionError) as error:
            return {"ok": False, "why": str(error)}
        self.commands.append(Command(time_s, done))
        return {"ok": True, "tick": tick, "time_s": time_s, "done": done}

    def _set_load(self, session: Session, values: dict[str, Any]) -> str:
        if set(values) != {"kg"}:
            raise ConfigError("load needs kg, and nothing else")
        load_kg = Request(values).number("kg", values["kg"], 0.0, self._hello.heaviest_kg)
        session.node.load[0] = load_kg
        return f"load {load_kg:g} kg"

    def _kick(self, session: Session, values: dict[str, Any], tick: int) -> str:
        if len(session.injection.plan) >= _FAULTS_MOST:
            raise ConfigError(f"this run has had {_FAULTS_MOST} faults; start another one")
        timeline = session.timeline
        if tick < timeline.motion:
            raise ConfigError("not before motion starts")
        start_s = (tick - timeline.motion) * timeline.period_s
        fault = read_fault(Request(values), values | {"start_s": start_s}, 0)
        check_faults((fault,), in_process=False, spawned=self._hello.spawned)
        changed = injection.with_fault(session.injection, fault, timeline.motion, timeline.period_s)
        if not session.faulty:
            changed.count[injection.MOTION_COUNTER] = motion_frames_sent(session)
        self.session = session._replace(injection=changed, faulty=True)
        return fault.text().partition(", at ")[0] + (f" for {fault.duration_s:g} s" if fault.duration_s else "")

    def close(self) -> None:
        """Say goodbye to everybody."""
        for client in self._clients[:]:
            self._drop(client)
        self._listener.close()

    def __enter__(self) -> Control:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()


def truth(session: Session) -> dict[str, Any]:
    """The plant as it is now: what no sensor has touched."""
    y = session.node.y
    tick = int(session.progress.index[TICK])
    load = session.record.load_true[tick - 1] if tick else session.node.load[0]
    values = {
        "load_kg": float(load),
        "angle_rad": y[Q : Q + 2].tolist(),
        "rate_rad_s": y[W : W + 2].tolist(),
        "pressure_Pa": y[P_SWING:XV].tolist(),
        "spool": y[XV : XV + 2].tolist(),
    }
    # a plant that has left all bounds has numbers that JSON has not
    finite = all(math.isfinite(v) for part in values.values() for v in (part if isinstance(part, list) else [part]))
    return values if finite else {"load_kg": values["load_kg"]}
