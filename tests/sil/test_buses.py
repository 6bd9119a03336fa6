"""Bus strings and frame ports: what would leave a user guessing, or lose frames, if it came back."""

from __future__ import annotations

import errno
import os
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import can
import pytest

from sil_plant.bus import ports
from sil_plant.bus.hub import Hub
from sil_plant.bus.ports import (
    BusAddress,
    BusError,
    FramePort,
    HubPort,
    InprocPort,
    PythonCanPort,
    SocketCanPort,
    connect_python_can,
    open_frame_port,
    parse_bus,
)

LIMIT_S = 8.0  # no wait in this file is longer; reaching it is a failure
ROOT = Path(__file__).resolve().parents[2]


def one_line(error: pytest.ExceptionInfo[BusError]) -> str:
    text = str(error.value)
    assert "\n" not in text
    return text


# ---- bus strings ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "address"),
    [
        ("vcan0", BusAddress("socketcan", channel="vcan0")),
        ("can1", BusAddress("socketcan", channel="can1")),
        ("tcp:127.0.0.1:29536", BusAddress("tcp", host="127.0.0.1", port=29536, channel="vcan0")),
        ("tcp:localhost:0", BusAddress("tcp", host="localhost", port=0, channel="vcan0")),
        ("slcan:/dev/ttyACM0", BusAddress("slcan", channel="/dev/ttyACM0")),
        ("slcan:socket://127.0.0.1:3333", BusAddress("slcan", channel="socket://127.0.0.1:3333")),
        ("inproc", BusAddress("inproc")),
    ],
)
def test_every_form_of_bus_is_understood_and_written_back(text: str, address: BusAddress) -> None:
    """GIVEN a bus string of the documentation WHEN it is parsed THEN it means that, and prints as written."""
    assert parse_bus(text) == address
    assert str(parse_bus(f" {text}\n")) == text


@pytest.mark.parametrize(
    ("text", "hint"),
    [
        ("", "vcan0"),
        ("tcp", "tcp:HOST:PORT"),
        ("tcp:29536", "tcp:HOST:PORT"),
        ("tcp:127.0.0.1", "tcp:HOST:PORT"),
        ("tcp:127.0.0.1:", "tcp:HOST:PORT"),
        ("tcp:127.0.0.1:70000", "tcp:HOST:PORT"),
        ("tcp:127.0.0.1:-1", "tcp:HOST:PORT"),
        ("tcp:[::1]:29536", "IPv4"),
        ("tcp:bad host:29536", "host name"),
        ("slcan", "slcan:/dev/ttyACM0"),
        ("slcan:", "slcan:/dev/ttyACM0"),
        ("tpc:127.0.0.1:29536", "tcp:127.0.0.1:29536"),
        ("/dev/ttyACM0", "slcan:/dev/ttyACM0"),
        ("127.0.0.1:29536", "tcp:127.0.0.1:29536"),
        ("an_interface_name_too_long", "vcan0"),
    ],
)
def test_nonsense_is_answered_with_the_form_that_is_right(text: str, hint: str) -> None:
    """GIVEN a bus string that is none WHEN it is parsed THEN one line shows how to write it."""
    with pytest.raises(BusError) as error:
        parse_bus(text)
    assert hint in one_line(error)


# ---- inproc --------------------------------------------------------------------------------------


def test_inproc_ends_hear_each_other_and_not_themselves() -> None:
    """GIVEN an inproc port WHEN frames go both ways THEN each end has the other's, in order, and no waits."""
    with open_frame_port("inproc") as port:
        assert isinstance(port, InprocPort)
        port.send_many([(1, b"a"), (2, b"")])
        port.peer.send(3, bytearray(b"c"))
        assert [port.peer.receive(None), port.peer.receive(None), port.peer.receive(None)] == [
            (1, b"a"),
            (2, b""),
            None,
        ]
        assert (port.receive(0), port.receive(1e9)) == ((3, b"c"), None)
        port.peer.send(4, b"")
        assert port.discard_pending() == 1
        assert (port.sent, port.received, port.send_retries) == (2, 1, 0)


@pytest.mark.parametrize(("can_id", "data"), [(0x800, b""), (-1, b""), (1, bytes(9))])
def test_impossible_frames_raise_before_they_reach_a_bus(can_id: int, data: bytes) -> None:
    """GIVEN an id above 11 bits or 9 bytes WHEN it is sent THEN it raises."""
    with pytest.raises(ValueError):
        InprocPort().send(can_id, data)


# ---- tcp -----------------------------------------------------------------------------------------


class ServedHub:
    """A hub that a thread serves, in place of a plant in another process; its local port is an echo."""

    def __init__(self) -> None:
        self.hub = Hub("127.0.0.1", 0)
        self.address = f"tcp:127.0.0.1:{self.hub.port}"
        self._stop = False
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def _serve(self) -> None:
        while not self._stop:
            frame = self.hub.receive(0.01)
            if frame is not None:
                self.hub.send(frame[0], frame[1])
        self.hub.close()

    def stop(self) -> None:
        self._stop = True
        self._thread.join(LIMIT_S)
        assert not self._thread.is_alive()


@pytest.fixture
def served() -> Iterator[ServedHub]:
    served = ServedHub()
    yield served
    served.stop()


def test_hosted_hub_and_client_port_exchange_frames_in_order(served: ServedHub) -> None:
    """GIVEN a hub that echoes WHEN a client port sends 1000 frames THEN it gets them back, in order."""
    with open_frame_port(served.address) as port:
        assert isinstance(port, PythonCanPort)
        frames = [(i % 0x800, i.to_bytes(2, "big") * (i % 5)) for i in range(1000)]
        port.send_many(frames)
        assert [port.receive(LIMIT_S) for _ in frames] == frames
        assert port.receive(0) is None
        assert (port.sent, port.received, port.ignored) == (1000, 1000, 0)


def test_29_bit_frames_are_not_handed_up_by_the_hub_port() -> None:
    """GIVEN a client that sends 29-bit, then 11-bit frames WHEN the plant receives
    THEN it sees the 11-bit ones only, and the others are counted."""
    with open_frame_port("tcp:127.0.0.1:0", host_hub=True) as port:
        assert isinstance(port, HubPort)
        with socket.create_connection(("127.0.0.1", port.hub.port), timeout=LIMIT_S) as sock:
            sock.sendall(b"< open x >< rawmode >< send 18DAF110 0 >< send 00000123 0 >< send 123 1 7 >")
            assert port.receive(LIMIT_S) == (0x123, b"\x07")
            assert (port.received, port.ignored) == (1, 2)
            sock.sendall(b"< send 18DAF110 0 >")
            assert port.receive(0.05) is None
            sock.sendall(b"< send 123 0 >")
            end = time.monotonic() + LIMIT_S
            while port.hub.frames < 5 and time.monotonic() < end:
                port.hub.service()
            assert port.discard_pending() == 1
            assert port.receive(0) is None


def test_29_bit_frames_are_not_handed_up_by_the_client_port(served: ServedHub) -> None:
    """GIVEN 29-bit and 11-bit frames on the bus WHEN a client port receives THEN it sees 11-bit ones only."""
    with open_frame_port(served.address) as port, connect_python_can(served.address) as other:
        other.send(can.Message(arbitration_id=0x18DAF110, is_extended_id=True))
        other.send(can.Message(arbitration_id=0x123, is_extended_id=False, data=[1]))
        assert port.receive(LIMIT_S) == (0x123, b"\x01")
        assert port.ignored >= 1


def test_discarding_ends_on_a_bus_that_is_never_quiet(served: ServedHub) -> None:
    """GIVEN a bus with constant traffic WHEN a client port discards what is pending THEN it ends."""
    stop = threading.Event()

    def talk() -> None:
        with connect_python_can(served.address) as bus:
            while not stop.is_set():
                bus.send(can.Message(arbitration_id=1, is_extended_id=False))
                time.sleep(0.0005)

    thread = threading.Thread(target=talk, daemon=True)
    with open_frame_port(served.address) as port:
        thread.start()
        assert port.receive(LIMIT_S) is not None
        assert port.discard_pending() > 0
        stop.set()
        thread.join(LIMIT_S)
    assert not thread.is_alive()


def test_client_port_says_that_the_hub_is_gone_instead_of_waiting_for_ever() -> None:
    """GIVEN a client port WHEN the hub closes THEN receive raises, whatever its timeout."""
    served = ServedHub()
    with open_frame_port(served.address) as port:
        served.stop()
        with pytest.raises(BusError, match="closed the connection"):
            port.receive(None)

        def keep_sending() -> None:
            for _ in range(1000):
                port.send(1, b"")
                time.sleep(0.001)

        with pytest.raises(BusError):
            keep_sending()


def free_port() -> int:
    with socket.socket() as sock:
        sock.bind(("127.0.0.1", 0))
        return int(sock.getsockname()[1])


@pytest.mark.parametrize("connect", [connect_python_can, open_frame_port])
def test_nobody_listening_is_said_at_once_with_the_command_to_start(connect: Any) -> None:
    """GIVEN a port nobody listens on WHEN a tool connects THEN one line says what to start; python-can itself
    would try for 10 s."""
    address = f"tcp:127.0.0.1:{free_port()}"
    with pytest.raises(BusError) as error:
        connect(address)
    assert f"python sil_plant/run.py --bus {address}" in one_line(error)


def test_other_server_on_the_port_is_named_as_such() -> None:
    """GIVEN a server that is no socketcand WHEN a tool connects THEN it is told so, and how to find out."""
    with socket.create_server(("127.0.0.1", 0)) as server:

        def greet() -> None:
            server.accept()[0].sendall(b"220 mail.example.org ESMTP")

        threading.Thread(target=greet, daemon=True).start()
        with pytest.raises(BusError) as error:
            connect_python_can(f"tcp:127.0.0.1:{server.getsockname()[1]}")
    assert "no socketcand server" in one_line(error) and "ss -ltnp" in str(error.value)


def test_server_that_says_nothing_does_not_hang_the_tool(monkeypatch: pytest.MonkeyPatch) -> None:
    """GIVEN a paused plant: its kernel accepts, but nobody greets WHEN a tool connects THEN it ends."""
    monkeypatch.setattr(ports._probe_hub, "__defaults__", (0.05,))
    with socket.create_server(("127.0.0.1", 0)) as server, pytest.raises(BusError) as error:
        connect_python_can(f"tcp:127.0.0.1:{server.getsockname()[1]}")
    assert "does not greet" in one_line(error)


def test_tool_does_not_litter_the_terminal_with_split_frames() -> None:
    """GIVEN a plant in another process WHEN a tool reads frames that straddle python-can's 1024-byte reads
    THEN nothing is written to its terminal."""
    code = (
        "import sys; from sil_plant.bus.ports import connect_python_can\n"
        "with connect_python_can(sys.argv[1]) as bus:\n"
        "    bus.send(__import__('can').Message(arbitration_id=1, is_extended_id=False))\n"
        f"    assert all(bus.recv({LIMIT_S}) for _ in range(200))\n"
    )
    with Hub("127.0.0.1", 0) as hub:
        process = subprocess.Popen(
            [sys.executable, "-c", code, f"tcp:127.0.0.1:{hub.port}"],
            stderr=subprocess.PIPE,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
        )
        end = time.monotonic() + LIMIT_S
        while hub.receive(0.05) is None:
            assert time.monotonic() < end and process.poll() is None
        for _ in range(200):
            hub.send(0x123, bytes(8))
        while process.poll() is None:
            assert time.monotonic() < end
            hub.receive(0.01)
        assert process.stderr is not None
        assert (process.returncode, process.stderr.read()) == (0, b"")
        process.stderr.close()


def test_inproc_cannot_be_joined_by_a_tool() -> None:
    """GIVEN inproc WHEN a tool connects THEN one line says what to use instead."""
    with pytest.raises(BusError) as error:
        connect_python_can("inproc")
    assert "--bus tcp:127.0.0.1:29536" in one_line(error)


# ---- SocketCAN (real kernels are tested in tests/bus; here the rules around them) -----------------


def test_kernel_without_can_is_answered_with_all_ways_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """GIVEN a kernel without CAN (WSL2, containers, CI) WHEN vcan0 is opened
    THEN one line has the modprobe command and the ways that need no kernel."""
    real = socket.socket

    def no_can(family: int = -1, *args: Any, **kwargs: Any) -> socket.socket:
        if family == socket.AF_CAN:
            raise OSError(errno.EAFNOSUPPORT, "Address family not supported by protocol")
        return real(family, *args, **kwargs)

    monkeypatch.setattr(socket, "socket", no_can)
    with pytest.raises(BusError) as error:
        open_frame_port("vcan0")
    for part in (
        "sudo modprobe -a can_raw vcan",
        "--bus tcp:127.0.0.1:29536",
        "--bus inproc",
        "tools/vcan_vm",
    ):
        assert part in one_line(error)


@pytest.fixture
def fake_interfaces(monkeypatch: pytest.MonkeyPatch) -> dict[str, tuple[int, int]]:
    """A kernel with CAN whose interfaces are name -> (flags, hardware type)."""
    import fcntl

    interfaces: dict[str, tuple[int, int]] = {}
    real = socket.socket

    def fake_socket(family: int = -1, *args: Any, **kwargs: Any) -> socket.socket:
        return real() if family == socket.AF_CAN else real(family, *args, **kwargs)

    def fake_ioctl(sock: object, request: int, argument: bytes) -> bytes:
        name = argument[:16].rstrip(b"\0").decode()
        if name not in interfaces:
            raise OSError(errno.ENODEV, "No such device")
        value = interfaces[name][{0x8913: 0, 0x8927: 1}[request]]
        return argument[:16] + struct.pack("H22x", value)

    monkeypatch.setattr(socket, "socket", fake_socket)
    monkeypatch.setattr(fcntl, "ioctl", fake_ioctl)
    return interfaces


@pytest.mark.parametrize(
    ("name", "parts"),
    [
        ("vcan7", ["sudo ip link add dev vcan7 type vcan && sudo ip link set up vcan7", "tools/vcan_vm"]),
        ("can3", ["plugged in", "sudo ip link set up can3 type can bitrate 1000000"]),
        ("vcan1", ["vcan1 is down", "sudo ip link set up vcan1"]),
        ("can1", ["can1 is down", "sudo ip link set up can1 type can bitrate 1000000"]),
        ("eth0", ["not CAN", "tcp:127.0.0.1:29536"]),
    ],
)
def test_interface_that_cannot_work_is_answered_with_the_command_that_helps(
    fake_interfaces: dict[str, tuple[int, int]], name: str, parts: list[str]
) -> None:
    """GIVEN an interface that is missing, down, or no CAN WHEN it is opened THEN one line has the command."""
    fake_interfaces.update(vcan1=(0, 280), can1=(0, 280), eth0=(1, 1))
    with pytest.raises(BusError) as error:
        connect_python_can(name)
    for part in parts:
        assert part in one_line(error)


class FakeCanBus:
    """Stands for python-can's socketcan bus: its `socket` is one end of a pair that keeps message borders."""

    def __init__(self) -> None:
        self.socket, self.far_end = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.closed = 0

    def shutdown(self) -> None:
        self.closed += 1
        self.socket.close()


@pytest.fixture
def fake_bus(monkeypatch: pytest.MonkeyPatch) -> Iterator[FakeCanBus]:
    bus = FakeCanBus()
    monkeypatch.setattr(ports, "_open_socketcan", lambda address, **options: bus)
    yield bus
    bus.socket.close()
    bus.far_end.close()


def test_socketcan_frames_keep_their_id_length_and_order(fake_bus: FakeCanBus) -> None:
    """GIVEN a SocketCAN port WHEN frames of all lengths go both ways THEN they are as sent."""
    with open_frame_port("vcan0") as port:
        assert isinstance(port, SocketCanPort)
        for length in range(9):
            data = bytes(range(1, length + 1))
            port.send(0x100 + length, data)
            raw = fake_bus.far_end.recv(100)
            assert raw == struct.pack("=IB3x8s", 0x100 + length, length, data)
            fake_bus.far_end.send(raw)
            assert port.receive(LIMIT_S) == (0x100 + length, data)
        assert port.receive(0) is None
        assert (port.sent, port.received) == (9, 9)
        fake_bus.far_end.send(raw)
        assert (port.discard_pending(), port.received) == (1, 9)
    port.close()
    assert fake_bus.closed == 1


def test_socketcan_hands_up_11_bit_data_frames_only(fake_bus: FakeCanBus) -> None:
    """GIVEN a 29-bit, a remote and an error frame that passed the kernel's filter WHEN the port receives
    THEN it skips and counts them."""
    port = open_frame_port("vcan0")
    for flag in (0x8000_0000, 0x4000_0000, 0x2000_0000):
        fake_bus.far_end.send(struct.pack("=IB3x8s", flag | 0x123, 0, b""))
    assert port.receive(0.02) is None
    fake_bus.far_end.send(struct.pack("=IB3x8s", 0x123, 1, b"\x05"))
    assert port.receive(LIMIT_S) == (0x123, b"\x05")
    assert port.ignored == 3


class StubbornSocket:
    """A CAN socket whose transmit queue is full for the first `refusals` attempts."""

    def __init__(self, refusals: int, error: int) -> None:
        self.refusals, self.error, self.frames = refusals, error, 0

    def send(self, frame: bytes, flags: int) -> int:
        if self.refusals > 0:
            self.refusals -= 1
            raise OSError(self.error, os.strerror(self.error))
        self.frames += 1
        return len(frame)


def stubborn_port(fake_bus: FakeCanBus, refusals: int, error: int) -> tuple[FramePort, StubbornSocket]:
    port = open_frame_port("can0")
    assert isinstance(port, SocketCanPort)
    sock = StubbornSocket(refusals, error)
    port._sock = sock  # type: ignore[assignment]
    return port, sock


@pytest.mark.parametrize("error", [errno.ENOBUFS, errno.EAGAIN])
def test_full_transmit_queue_is_waited_for_and_counted(fake_bus: FakeCanBus, error: int) -> None:
    """GIVEN a transmit queue that is full three times WHEN a frame is sent THEN it goes out once, counted."""
    port, sock = stubborn_port(fake_bus, 3, error)
    port.send(0x182, bytes(8))
    assert (sock.frames, port.sent, port.send_retries) == (1, 1, 3)


def test_transmit_queue_that_stays_full_ends_with_a_reason(fake_bus: FakeCanBus) -> None:
    """GIVEN a bus nobody acknowledges WHEN a frame is sent THEN it ends, and says what to look at."""
    port, sock = stubborn_port(fake_bus, 10**9, errno.ENOBUFS)
    with pytest.raises(BusError) as error:
        port.send(0x182, bytes(8))
    assert "acknowledge" in one_line(error) and "txqueuelen" in str(error.value)
    assert sock.frames == port.sent == 0 and port.send_retries > 0


def test_interface_that_goes_down_while_running_is_named(fake_bus: FakeCanBus) -> None:
    """GIVEN an interface that goes down WHEN a frame is sent THEN one line says so, without retries."""
    port, _ = stubborn_port(fake_bus, 1, errno.ENETDOWN)
    with pytest.raises(BusError, match=r"can0 went down.*ip link set up can0"):
        port.send(0x182, b"")
    assert port.send_retries == 0


# ---- slcan ---------------------------------------------------------------------------------------


def test_slcan_without_pyserial_names_the_package(monkeypatch: pytest.MonkeyPatch) -> None:
    """GIVEN no pyserial WHEN slcan is opened THEN one line says what to install."""
    slcan = pytest.importorskip("can.interfaces.slcan")
    monkeypatch.setattr(slcan, "serial", None)
    with pytest.raises(BusError) as error:
        open_frame_port("slcan:/dev/ttyACM0")
    assert "pip install pyserial" in one_line(error)


def test_slcan_device_that_is_missing_is_named() -> None:
    """GIVEN a device that does not exist WHEN slcan is opened THEN one line says what to look at."""
    pytest.importorskip("serial")
    with pytest.raises(BusError) as error:
        connect_python_can("slcan:/dev/ttyNOPE7")
    assert "/dev/ttyNOPE7" in one_line(error) and "dialout" in str(error.value)
    with pytest.raises(BusError, match="emulator"):
        connect_python_can(f"slcan:socket://127.0.0.1:{free_port()}")


def test_slcan_over_a_socket_exchanges_frames() -> None:
    """GIVEN an emulated UART that acknowledges and echoes each frame WHEN a port sends frames
    THEN it gets them back, and the acknowledgements do not count as frames."""
    pytest.importorskip("serial")
    with socket.create_server(("127.0.0.1", 0)) as server:

        def board() -> None:
            link = server.accept()[0]
            with link, link.makefile("rb") as reader:
                line = b""
                while char := reader.read(1):
                    line += char
                    if char == b"\r":
                        link.sendall(b"z\r" + line if line.startswith(b"t") else b"\r")
                        line = b""

        thread = threading.Thread(target=board, daemon=True)
        thread.start()
        with open_frame_port(f"slcan:socket://127.0.0.1:{server.getsockname()[1]}") as port:
            for frame in [(0x182, bytes(range(8))), (0x080, b"")]:
                port.send(*frame)
                assert port.receive(LIMIT_S) == frame
            port.send(1, b"")
            port.send(2, b"")
            time.sleep(0.05)
            assert port.discard_pending() == 2
        thread.join(LIMIT_S)
        assert not thread.is_alive()
