"""One string names a bus everywhere, and one small interface moves frames on all of them.

===================== ==========================================================================
``vcan0``, ``can0``   SocketCAN, opened through python-can
``tcp:HOST:PORT``     the socketcand protocol: a hub hosted here (`sil_plant.bus.hub`) or elsewhere
``slcan:DEVICE``      a serial adapter or an emulated board: ``slcan:/dev/ttyACM0``,
                      ``slcan:socket://127.0.0.1:3333``
``inproc``            no bus at all: both ends live in this process
===================== ==========================================================================

`open_frame_port` is for the plant (fast, 11-bit data frames only), `connect_python_can` for tools.
"""

from __future__ import annotations

import contextlib
import errno
import logging
import re
import select
import socket
import struct
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

from sil_plant.bus.hub import DEFAULT_PORT, BusError, Hub

if TYPE_CHECKING:
    import can

__all__ = [
    "BusAddress",
    "BusError",
    "FramePort",
    "HubPort",
    "InprocPort",
    "PythonCanPort",
    "SlcanSocketPort",
    "SocketCanPort",
    "connect_python_can",
    "open_frame_port",
    "parse_bus",
]

Frame = tuple[int, bytes]

_FORMS = (
    f"write vcan0 or can0 (SocketCAN), tcp:127.0.0.1:{DEFAULT_PORT}, slcan:/dev/ttyACM0, "
    "slcan:socket://127.0.0.1:3333, or inproc"
)
_WITHOUT_KERNEL = f"or do without: --bus tcp:127.0.0.1:{DEFAULT_PORT}, --bus inproc, or tools/vcan_vm"
_SERIAL_BITRATE = 1_000_000  # of the CAN side of a serial adapter: the ECU's bus
_SLCAN_SOCKET = "socket://"
_SLCAN_CLOSE_LIMIT_S = 0.2  # how long to wait for the answer to a close

_CAN_FRAME = struct.Struct("=IB3x8s")  # struct can_frame of <linux/can.h>
_ARPHRD_CAN, _IFF_UP = 280, 1
_SIOCGIFFLAGS, _SIOCGIFHWADDR = 0x8913, 0x8927
_SO_MEMINFO, _MEMINFO_DROPS = 55, 8
_SO_RCVBUFFORCE = 33
_AF_CAN = getattr(socket, "AF_CAN", None)
_SEND_LIMIT_S = 0.1  # how long to wait for room in a full transmit queue
_SEND_PAUSE_S = 0.0002  # between attempts: about two frames at 1 Mbit/s
_DISCARD_LIMIT_S = 0.25


@dataclass(frozen=True)
class BusAddress:
    """A parsed bus string.

    Attributes
    ----------
    kind : {'socketcan', 'tcp', 'slcan', 'inproc'}
        Which transport.
    host, port : str, int
        For ``tcp``.
    channel : str
        Network interface (``socketcan``), device or URL (``slcan``), the name asked for with
        ``< open NAME >`` (``tcp``).
    """

    kind: Literal["socketcan", "tcp", "slcan", "inproc"]
    host: str = ""
    port: int = 0
    channel: str = ""

    def __str__(self) -> str:
        if self.kind == "tcp":
            return f"tcp:{self.host}:{self.port}"
        if self.kind == "slcan":
            return f"slcan:{self.channel}"
        return self.channel or self.kind


def parse_bus(text: str) -> BusAddress:
    """Understand a bus string.

    Parameters
    ----------
    text : str
        For example ``vcan0`` or ``tcp:127.0.0.1:29536``.

    Raises
    ------
    BusError
        One line that says what is wrong and which forms there are.
    """
    text = text.strip()
    if text == "inproc":
        return BusAddress("inproc")
    kind, colon, rest = text.partition(":")
    if kind == "tcp":
        host, _, port_text = rest.rpartition(":")
        if not host or not re.fullmatch(r"[0-9]{1,5}", port_text) or int(port_text) > 65535:
            raise BusError(f"bus {text!r}: expected tcp:HOST:PORT, for example tcp:127.0.0.1:{DEFAULT_PORT}")
        if ":" in host or "[" in host:
            raise BusError(f"bus {text!r}: socketcand is IPv4 only; write tcp:127.0.0.1:{port_text}")
        if not re.fullmatch(r"[A-Za-z0-9._-]+", host):
            raise BusError(f"bus {text!r}: {host!r} is no host name; for example tcp:127.0.0.1:{port_text}")
        return BusAddress("tcp", host=host, port=int(port_text), channel="vcan0")
    if kind == "slcan":
        if not rest or " " in rest:
            raise BusError(f"bus {text!r}: name the device: slcan:/dev/ttyACM0 or slcan:socket://127.0.0.1:3333")
        return BusAddress("slcan", channel=rest)
    if not colon and re.fullmatch(r"[A-Za-z][A-Za-z0-9_.-]{0,14}", text):  # an interface name for Linux
        return BusAddress("socketcan", channel=text)
    raise BusError(f"bus {text!r} is not understood: {_FORMS}")


# ---- the interface -------------------------------------------------------------------------------


class FramePort(ABC):
    """Sends and receives classic CAN data frames with 11-bit ids.

    Attributes
    ----------
    sent, received : int
        Frames that passed.
    send_retries : int
        Attempts repeated because a transmit queue was full (ENOBUFS).
    ignored : int
        Frames not handed up: 29-bit ids, remote, error and CAN FD frames.
    """

    _DISCARD_WAIT_S = 0.0

    def __init__(self) -> None:
        self.sent = 0
        self.received = 0
        self.send_retries = 0
        self.ignored = 0

    @abstractmethod
    def send(self, can_id: int, data: bytes) -> None:
        """Send one frame. Raises `BusError` if the bus does not take it."""

    def send_many(self, frames: Iterable[Frame]) -> None:
        """Send several frames, in order."""
        for can_id, data in frames:
            self.send(can_id, data)

    @abstractmethod
    def receive(self, timeout_s: float | None) -> Frame | None:
        """Next frame, or None when `timeout_s` (0: only look, None: for ever) is over."""

    def discard_pending(self) -> int:
        """Forget what has come but was not received yet; returns how many frames.

        Bounded, so that it ends on a bus that is never quiet.
        """
        count = 0
        end = time.monotonic() + _DISCARD_LIMIT_S
        while time.monotonic() < end and self.receive(self._DISCARD_WAIT_S) is not None:
            count += 1
        self.received -= count
        return count

    @property
    def receive_drops(self) -> int:
        """Frames the kernel threw away because this process read too slowly; 0 on a lossless bus."""
        return 0

    @abstractmethod
    def close(self) -> None:
        """Leave the bus; may be called again."""

    def __enter__(self) -> FramePort:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()


def open_frame_port(address: BusAddress | str, host_hub: bool = False, *, allow_remote: bool = False) -> FramePort:
    """Open a bus for the plant.

    Parameters
    ----------
    address : BusAddress or str
        Which bus.
    host_hub : bool
        For ``tcp``: host the hub (True) or join one that runs elsewhere (False). No effect on other buses.
    allow_remote : bool
        For a hosted hub: permit an address other computers can reach.

    Returns
    -------
    FramePort
        `HubPort`, `SocketCanPort`, `SlcanSocketPort`, `PythonCanPort` or `InprocPort`.

    Raises
    ------
    BusError
        One line with the next step.
    """
    if isinstance(address, str):
        address = parse_bus(address)
    if address.kind == "inproc":
        return InprocPort()
    if address.kind == "socketcan":
        return SocketCanPort(address)
    if address.kind == "slcan" and address.channel.startswith(_SLCAN_SOCKET):
        return SlcanSocketPort(address)
    if address.kind == "tcp" and host_hub:
        return HubPort(Hub(address.host, address.port, allow_remote=allow_remote))
    return PythonCanPort(connect_python_can(address), str(address))


def connect_python_can(address: BusAddress | str) -> can.BusABC:
    """Open a bus as a python-can bus, for tools. Does not retry.

    Parameters
    ----------
    address : BusAddress or str
        Any bus but ``inproc``.

    Raises
    ------
    BusError
        If the interface is missing or down, or nobody listens; one line with the next step.
    """
    if isinstance(address, str):
        address = parse_bus(address)
    if address.kind == "inproc":
        raise BusError(
            "inproc is inside the plant's process, no tool can join it: "
            f"start `python sil_plant/run.py --bus tcp:127.0.0.1:{DEFAULT_PORT}`"
        )
    if address.kind == "socketcan":
        return _open_socketcan(address)
    if address.kind == "tcp":
        return _open_socketcand(address)
    return _open_slcan(address)


# ---- inproc --------------------------------------------------------------------------------------


class InprocPort(FramePort):
    """One of two ends joined in memory; the other one is `peer`.

    Nothing waits: both ends are driven by one thread, so a frame that is not there will not come by waiting.
    """

    def __init__(self, peer: InprocPort | None = None) -> None:
        super().__init__()
        self._inbox: deque[Frame] = deque()
        self.peer: InprocPort = peer if peer is not None else InprocPort(self)

    def send(self, can_id: int, data: bytes) -> None:
        """Send one frame."""
        _check_frame(can_id, data)
        self.peer._inbox.append((can_id, bytes(data)))
        self.sent += 1

    def receive(self, timeout_s: float | None) -> Frame | None:
        """Next frame, or None when the time is over."""
        if not self._inbox:
            return None
        self.received += 1
        return self._inbox.popleft()

    def close(self) -> None:
        """Leave the bus."""
        self._inbox.clear()


# ---- hub -----------------------------------------------------------------------------------------


class HubPort(FramePort):
    """The local port of a hub hosted by this process; the hub itself is `hub`."""

    def __init__(self, hub: Hub) -> None:
        super().__init__()
        self.hub = hub

    def send(self, can_id: int, data: bytes) -> None:
        """Send one frame."""
        self.hub.send(can_id, data)
        self.sent += 1

    def receive(self, timeout_s: float | None) -> Frame | None:
        """Next frame, or None when the time is over."""
        frame = self.hub.receive(timeout_s)
        if frame is not None and frame[0] > 0x7FF:
            frame = self._receive_next(timeout_s)
        if frame is not None:
            self.received += 1
        return frame

    def _receive_next(self, timeout_s: float | None) -> Frame | None:
        """Look beyond a frame that is not for us, without starting the wait anew."""
        end = None if timeout_s is None else time.monotonic() + timeout_s
        while True:
            self.ignored += 1
            frame = self.hub.receive(None if end is None else max(0.0, end - time.monotonic()))
            if frame is None or frame[0] <= 0x7FF:
                return frame

    def discard_pending(self) -> int:
        """Forget the frames that have come but were not received yet."""
        return self.hub.discard_pending()

    def close(self) -> None:
        """Leave the bus."""
        self.hub.close()


# ---- SocketCAN -----------------------------------------------------------------------------------


class SocketCanPort(FramePort):
    """SocketCAN, opened through python-can; frames go straight through its socket.

    Reading and writing ``bus.socket`` takes a fraction of the time of ``bus.recv()`` and ``bus.send()``,
    which build a Message with a time stamp for each frame; at 1 kHz the plant shares its thread with them.
    """

    def __init__(self, address: BusAddress) -> None:
        super().__init__()
        # The kernel filters: data frames with 11-bit ids only.
        filters = [{"can_id": 0, "can_mask": 0x4000_0000, "extended": False}]
        self.name = address.channel
        self._bus = _open_socketcan(address, can_filters=filters, ignore_rx_error_frames=True)
        self._sock: socket.socket = self._bus.socket  # type: ignore[attr-defined]
        _enlarge_buffer(self._sock)
        self._poll = select.poll()
        self._poll.register(self._sock, select.POLLIN)
        self._closed = False

    def send(self, can_id: int, data: bytes) -> None:
        """Send one frame."""
        _check_frame(can_id, data)
        frame = _CAN_FRAME.pack(can_id, len(data), data)
        try:
            self._sock.send(frame, socket.MSG_DONTWAIT)
        except OSError as error:
            self._send_again(frame, error)
        self.sent += 1

    def _send_again(self, frame: bytes, error: OSError) -> None:
        """Try again for a short while if the transmit queue is full; it empties at the pace of the bus."""
        end = time.monotonic() + _SEND_LIMIT_S
        while error.errno in (errno.ENOBUFS, errno.EAGAIN):
            if time.monotonic() >= end:
                raise BusError(
                    f"{self.name}: the transmit queue stayed full for {_SEND_LIMIT_S:g} s (ENOBUFS): "
                    "does another node acknowledge, is the bit rate right? Look: `ip -details -statistics "
                    f"link show {self.name}`; longer queue: `sudo ip link set {self.name} txqueuelen 1000`"
                ) from error
            self.send_retries += 1
            time.sleep(_SEND_PAUSE_S)
            try:
                self._sock.send(frame, socket.MSG_DONTWAIT)
                return
            except OSError as again:
                error = again
        raise _socketcan_lost(self.name, error) from error

    def receive(self, timeout_s: float | None) -> Frame | None:
        """Next frame, or None when the time is over."""
        end = 0.0
        wait_ms = None if timeout_s is None else timeout_s * 1e3
        while True:
            # poll first: an EAGAIN in vain costs more than the poll
            if not self._poll.poll(wait_ms):
                return None
            try:
                can_id, length, data = _CAN_FRAME.unpack(self._sock.recv(16, socket.MSG_DONTWAIT))
            except BlockingIOError:
                pass
            except OSError as error:
                raise _socketcan_lost(self.name, error) from error
            else:
                if can_id <= 0x7FF:
                    self.received += 1
                    return can_id, data[:length]
                self.ignored += 1
            if timeout_s is not None:  # something else came: wait for the rest of the time only
                now = time.monotonic()
                end = end or now + timeout_s
                wait_ms = max(0.0, end - now) * 1e3

    @property
    def receive_drops(self) -> int:
        """Frames the kernel threw away because this process read too slowly."""
        return _kernel_drops(self._sock)

    def close(self) -> None:
        """Leave the bus."""
        if not self._closed:
            self._closed = True
            self._bus.shutdown()


def _enlarge_buffer(sock: socket.socket) -> None:
    """Ask for room for 2 s of frames; the default has it for 50 ms, and without rights the kernel grants 100 ms."""
    for option in (_SO_RCVBUFFORCE, socket.SO_RCVBUF):
        with contextlib.suppress(OSError):
            sock.setsockopt(socket.SOL_SOCKET, option, 4 << 20)
            return


def _kernel_drops(sock: socket.socket) -> int:
    """Frames that the kernel threw away because nobody read them in time."""
    try:
        info = sock.getsockopt(socket.SOL_SOCKET, _SO_MEMINFO, 4 * (_MEMINFO_DROPS + 1))
        return int(struct.unpack_from("=I", info, 4 * _MEMINFO_DROPS)[0])
    except (OSError, struct.error):
        return 0


def _open_socketcan(address: BusAddress, **options: object) -> can.BusABC:
    """A python-can socketcan bus, after finding out why it could not be opened."""
    name = address.channel
    _check_interface(name)
    import can

    try:
        return can.Bus(interface="socketcan", channel=name, **options)  # type: ignore[arg-type]
    except (can.CanError, OSError) as error:
        raise BusError(f"cannot open {name}: {error}; look: `ip -details link show {name}`") from error


def _check_interface(name: str) -> None:
    """Raise `BusError` unless `name` is a CAN interface that is up."""
    import fcntl

    try:
        probe = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
    except (OSError, AttributeError) as error:
        raise BusError(
            f"cannot open {name}: this kernel has no CAN ({getattr(error, 'strerror', None) or error}): "
            f"`sudo modprobe -a can_raw vcan`, {_WITHOUT_KERNEL}"
        ) from error
    with probe:
        virtual = name.startswith(("vcan", "vxcan"))
        set_up = f"sudo ip link set up {name}" + ("" if virtual else " type can bitrate 1000000")
        request = struct.pack("16s24x", name.encode())
        try:
            flags = struct.unpack_from("H", fcntl.ioctl(probe, _SIOCGIFFLAGS, request), 16)[0]
            family = struct.unpack_from("H", fcntl.ioctl(probe, _SIOCGIFHWADDR, request), 16)[0]
        except OSError as error:
            if virtual:
                raise BusError(
                    f"there is no interface {name}: `sudo ip link add dev {name} type vcan && {set_up}`, "
                    f"{_WITHOUT_KERNEL}"
                ) from error
            raise BusError(
                f"there is no interface {name}: is the adapter plugged in (`ip -brief link`)? "
                f"Then `{set_up}`, {_WITHOUT_KERNEL}"
            ) from error
        if family != _ARPHRD_CAN:
            raise BusError(f"{name} is a network interface, but not CAN: {_FORMS}")
        if not flags & _IFF_UP:
            raise BusError(f"interface {name} is down: `{set_up}`")


def _socketcan_lost(name: str, error: OSError) -> BusError:
    if error.errno in (errno.ENETDOWN, errno.ENXIO, errno.ENODEV):
        return BusError(f"{name} went down ({error.strerror}): `sudo ip link set up {name}`, then restart")
    return BusError(f"{name}: {error.strerror or error}; look: `ip -details link show {name}`")


# ---- slcan over a socket -------------------------------------------------------------------------


class SlcanSocketPort(FramePort):
    """SLCAN text over TCP: an emulated board's UART.

    python-can reads such a text byte by byte, with two system calls each; this one reads what there is.
    """

    def __init__(self, address: BusAddress) -> None:
        super().__init__()
        self.name = str(address)
        host, _, port = address.channel.removeprefix(_SLCAN_SOCKET).rpartition(":")
        try:
            self._sock = socket.create_connection((host, int(port)), timeout=3.0)
        except (OSError, ValueError, OverflowError) as error:
            raise BusError(
                f"cannot open {self.name}: {error}; is the emulator running and listening there, for example at "
                "slcan:socket://127.0.0.1:3333?"
            ) from error
        self._sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._sock.settimeout(None)
        self._poll = select.poll()
        self._poll.register(self._sock, select.POLLIN)
        self._partial = b""
        self._inbox: deque[Frame] = deque()
        self._closed = False
        self._write(b"O\r")

    def send(self, can_id: int, data: bytes) -> None:
        """Send one frame."""
        self.send_many([(can_id, data)])

    def send_many(self, frames: Iterable[Frame]) -> None:
        """Send several frames, in order."""
        text = ""
        count = 0
        for can_id, data in frames:
            _check_frame(can_id, data)
            text += f"t{can_id:03X}{len(data)}{data.hex().upper()}\r"
            count += 1
        self._write(text.encode())
        self.sent += count

    def receive(self, timeout_s: float | None) -> Frame | None:
        """Next frame, or None when the time is over."""
        end = None if timeout_s is None else time.monotonic() + timeout_s
        while not self._inbox:
            left_ms = None if end is None else max(0.0, end - time.monotonic()) * 1e3
            if not self._poll.poll(left_ms):
                return None
            self._read()
        self.received += 1
        return self._inbox.popleft()

    def _write(self, text: bytes) -> None:
        try:
            self._sock.sendall(text)
        except OSError as error:
            raise self._lost(error.strerror or str(error)) from error

    def _read(self) -> None:
        try:
            chunk = self._sock.recv(1 << 16)
        except OSError as error:
            raise self._lost(error.strerror or str(error)) from error
        if not chunk:
            raise self._lost("the far end closed it")
        lines = (self._partial + chunk.replace(b"\a", b"\r")).split(b"\r")
        self._partial = lines.pop()
        for line in lines:
            if line[:1] == b"t":
                try:
                    frame = int(line[1:4], 16), bytes.fromhex(line[5:].decode())
                    _check_frame(*frame)
                except ValueError:
                    self.ignored += 1
                else:
                    self._inbox.append(frame)
            elif line[:1] in (b"T", b"r", b"R"):
                self.ignored += 1

    def _lost(self, reason: str) -> BusError:
        return BusError(f"{self.name}: the connection broke ({reason}); is the other side still running?")

    def close(self) -> None:
        """Leave the bus; the far end has read everything by then, unless it no longer answers."""
        if self._closed:
            return
        self._closed = True
        with self._sock, contextlib.suppress(OSError):
            self._sock.sendall(b"C\r")
            self._sock.settimeout(_SLCAN_CLOSE_LIMIT_S)
            tail = self._partial or b"\r"
            while not tail.endswith(b"\r\r") and (chunk := self._sock.recv(1 << 16)):
                tail = (tail + chunk)[-2:]


# ---- python-can (socketcand client, slcan) -------------------------------------------------------


class PythonCanPort(FramePort):
    """Any python-can bus; the bus itself is `bus`.

    Parameters
    ----------
    bus : can.BusABC
        Owned by the port from now on.
    name : str
        For messages.
    """

    _DISCARD_WAIT_S = 0.002  # an slcan adapter's acknowledgements look like "nothing there" to a bare look
    _SLICE_S = 0.25  # python-can's socketcand client does not notice by itself that the hub is gone

    def __init__(self, bus: can.BusABC, name: str) -> None:
        super().__init__()
        import can

        self.bus = bus
        self.name = name
        self._message = can.Message
        self._errors = (can.CanError, OSError)
        tcp = getattr(bus, "_SocketCanDaemonBus__socket", None)
        self._tcp: socket.socket | None = tcp if isinstance(tcp, socket.socket) else None
        sock = getattr(bus, "socket", None)
        if isinstance(sock, socket.socket) and sock.family == _AF_CAN:
            _enlarge_buffer(sock)
        self._closed = False

    def send(self, can_id: int, data: bytes) -> None:
        """Send one frame."""
        _check_frame(can_id, data)
        try:
            self.bus.send(self._message(arbitration_id=can_id, is_extended_id=False, data=data))
        except self._errors as error:
            raise self._lost(error) from error
        self.sent += 1

    def receive(self, timeout_s: float | None) -> Frame | None:
        """Next frame, or None when the time is over."""
        end = None if timeout_s is None else time.monotonic() + timeout_s
        while True:
            message = self.receive_message(self._SLICE_S if end is None else max(0.0, end - time.monotonic()))
            if message is None:
                if end is not None and time.monotonic() >= end:
                    return None
            elif message.is_extended_id or message.is_remote_frame or message.is_error_frame or message.is_fd:
                self.ignored += 1
            else:
                self.received += 1
                return message.arbitration_id, bytes(message.data)

    def receive_message(self, timeout_s: float) -> can.Message | None:
        """Next message of any kind, with its time, or None when the time, or a slice of it, is over."""
        try:
            message = self.bus.recv(min(self._SLICE_S, timeout_s))
        except self._errors as error:
            raise self._lost(error) from error
        if message is None and self._hub_gone():
            raise BusError(f"{self.name}: the hub closed the connection; start it again, then this")
        return message

    @property
    def receive_drops(self) -> int:
        """Frames the kernel threw away because this process read too slowly."""
        sock = getattr(self.bus, "socket", None)
        return _kernel_drops(sock) if isinstance(sock, socket.socket) and sock.family == _AF_CAN else 0

    def _hub_gone(self) -> bool:
        if self._tcp is None:
            return False
        try:
            return self._tcp.recv(1, socket.MSG_PEEK | socket.MSG_DONTWAIT) == b""
        except BlockingIOError:
            return False
        except OSError:
            return True

    def _lost(self, error: Exception) -> BusError:
        first_line = (str(error) or type(error).__name__).splitlines()[0]
        return BusError(f"{self.name}: the connection broke ({first_line}); is the other side still running?")

    def close(self) -> None:
        """Leave the bus."""
        if self._closed:
            return
        self._closed = True
        with contextlib.suppress(*self._errors):  # what is broken already need not close cleanly
            self.bus.shutdown()


def _open_socketcand(address: BusAddress) -> can.BusABC:
    """A python-can socketcand client."""
    # Ask first: python-can retries a refused one for 10 s at full load, and waits for ever for a greeting.
    _probe_hub(address)
    import can

    logging.getLogger("can.interfaces.socketcand.socketcand").addFilter(_no_split_warnings)
    try:
        return can.Bus(
            interface="socketcand",
            channel=address.channel,
            host=address.host,
            port=address.port,
            tcp_tune=hasattr(socket, "TCP_QUICKACK"),
        )
    except (can.CanError, OSError) as error:
        raise BusError(f"{address} does not speak socketcand as expected: {error}") from error


def _no_split_warnings(record: logging.LogRecord) -> bool:
    """Drop python-can's warning, on the user's terminal, when a read ends within a frame: that is normal."""
    return "incomplete message =>" not in str(record.msg)


def _probe_hub(address: BusAddress, timeout_s: float = 3.0) -> None:
    """Raise `BusError` unless a socketcand server greets at `address`."""
    start = f"start `python sil_plant/run.py --bus {address}`"
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        probe.settimeout(timeout_s)
        try:
            probe.connect((address.host, address.port))
        except ConnectionRefusedError as error:
            raise BusError(f"nobody listens on {address}: {start}") from error
        except (OSError, OverflowError) as error:
            raise BusError(f"cannot reach {address} ({error}): {start}") from error
        try:
            greeting = probe.recv(256)
        except OSError as error:
            raise BusError(
                f"{address} accepts, but does not greet within {timeout_s:g} s: is the plant paused? "
                f"Who is it: ss -ltnp 'sport = :{address.port}'"
            ) from error
    if not greeting.startswith(b"< hi >"):
        raise BusError(
            f"{address} is no socketcand server: find who it is (ss -ltnp 'sport = :{address.port}') "
            "or choose another port"
        )


def _open_slcan(address: BusAddress) -> can.BusABC:
    """A python-can slcan bus."""
    import can

    device = address.channel
    # An emulated UART has no CAN bit rate, and needs no time to wake up.
    options: dict[str, Any] = {} if "://" in device else {"bitrate": _SERIAL_BITRATE}
    try:
        return can.Bus(interface="slcan", channel=device, sleep_after_open=0, **options)
    except can.CanInterfaceNotImplementedError as error:
        raise BusError(f"{address} needs pyserial: `python -m pip install pyserial`") from error
    except (can.CanError, OSError, ValueError) as error:
        hint = (
            "is the emulator running and listening?"
            if "://" in device
            else "is it plugged in (`ls /dev/ttyACM* /dev/ttyUSB*`), may you use it (group dialout)?"
        )
        raise BusError(f"cannot open {address}: {str(error).splitlines()[0]}; {hint}") from error


def _check_frame(can_id: int, data: bytes) -> None:
    if not 0 <= can_id <= 0x7FF:
        raise ValueError(f"{can_id:#x} is no 11-bit CAN id")
    if len(data) > 8:
        raise ValueError(f"a CAN frame has at most 8 data bytes, not {len(data)}")
