"""A socketcand hub: a lossless CAN bus over loopback TCP, without a kernel driver, root or a thread.

The process that runs the plant hosts the hub. The ECU, python-can tools (``interface='socketcand'``) and
SavvyCAN connect to it; a frame sent by one of them goes to all the others and to the local port of the owner,
and a frame the owner sends goes to all clients. The owner drives everything from its own loop with
`Hub.receive` or `Hub.service`; between these calls nothing moves.

What clients expect of the text, and why the code below cares:

- python-can compares each answer of the handshake with one ``recv()``. A frame that arrives glued to the last
  ``< ok >`` makes it give up, so frames for a new client are held (not dropped) until it has read that one.
- python-can splits ``< frame ID TIME DATA >`` at single spaces: data without spaces, two spaces when there is
  none.
- python-can parses ``< error ID TIME >``; free text there raises in its receive call. Errors are sent as
  ``< error 000 TIME text >`` instead, which it hands up as an error frame and a person can read.
- SavvyCAN writes ids without leading zeros and bytes above 7F sign-extended (``ffffffffffffff80``).
"""

from __future__ import annotations

import contextlib
import errno
import ipaddress
import logging
import select
import socket
import struct
import sys
import time
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass

log = logging.getLogger(__name__)

DEFAULT_PORT = 29536  # socketcand's own
EXTENDED_ID = 0x8000_0000  # marks a 29-bit id, as SocketCAN does (CAN_EFF_FLAG)

_READ_SIZE = 1 << 16
_LONGEST_TEXT = 256  # the longest legal one has about 170 characters (SavvyCAN's sign-extended bytes)
_FLUSH_AFTER = 1024  # frames the owner may send before they are written even without a wait
_INBOX_LIMIT = 1 << 16  # frames waiting for the owner before the clients are made to wait (TCP back-pressure)
_HOLD_FIRST_S, _HOLD_LONGEST_S, _HOLD_BLIND_S = 0.0005, 0.05, 0.1
_SIOCOUTQ = 0x5411
# Clients without TCP_NODELAY (SavvyCAN, python-can by default) keep a frame back until the last one is
# acknowledged, up to 40 ms later unless it is done at once.
_QUICKACK: int | None = getattr(socket, "TCP_QUICKACK", None)

_READABLE = select.POLLIN | select.POLLHUP | select.POLLERR

_BCM_COMMANDS = frozenset({"add", "update", "delete", "filter", "subscribe", "unsubscribe", "muxfilter"})
_OTHER_MODES = frozenset({"bcmmode", "controlmode", "isotpmode", "isotpconf", "sendpdu", "statistics"})
_FD_COMMANDS = frozenset({"fdsend", "fdframe"})

_LENGTH = {str(n): n for n in range(9)}


def _byte_texts() -> dict[str, int]:
    """Every way a client may write one byte: ``5``, ``05``, either case, SavvyCAN's sign-extended form."""
    texts: dict[str, int] = {}
    for value in range(256):
        digits = [f"{value:x}", f"{value:02x}"]
        if value >= 0x80:
            digits += [f"ffffff{value:02x}", f"ffffffffffffff{value:02x}"]
        for text in digits:
            texts[text] = texts[text.upper()] = value
        high, low = f"{value >> 4:x}", f"{value & 15:x}"
        texts[high.upper() + low] = texts[high + low.upper()] = value
    return texts


_byte_of = _byte_texts().__getitem__


class BusError(Exception):
    """Something about the bus that the user can mend; one line that says what and how."""


@dataclass(frozen=True)
class ClientInfo:
    """What the hub knows about one client.

    Attributes
    ----------
    address : str
        Peer as ``HOST:PORT``.
    channel : str
        Name given with ``< open NAME >``; empty before.
    mode : str
        ``greeted``, ``opened`` or ``raw``; only raw clients take part in the bus.
    frames : int
        Frames this client has sent.
    malformed : int
        Texts of this client that could not be understood.
    backlog : int
        Bytes waiting for this client to read.
    """

    address: str
    channel: str
    mode: str
    frames: int
    malformed: int
    backlog: int


class _Client:
    """One TCP connection."""

    __slots__ = (
        "address", "backlog", "channel", "frames", "held", "hold_checked", "hold_pause", "hold_since",
        "malformed", "out", "partial", "raw", "sock",
    )  # fmt: skip

    def __init__(self, sock: socket.socket, address: str) -> None:
        self.sock = sock
        self.address = address
        self.channel = ""
        self.raw = False
        self.partial = ""  # text behind the last '>'
        self.out: list[str] = []  # texts since the last flush
        self.backlog = bytearray()  # bytes the kernel did not take yet
        self.frames = 0
        self.malformed = 0
        self.held = False
        self.hold_since = self.hold_checked = 0.0
        self.hold_pause = _HOLD_FIRST_S

    @property
    def waiting(self) -> int:
        return len(self.backlog) + sum(map(len, self.out))

    @property
    def mode(self) -> str:
        return "raw" if self.raw else "opened" if self.channel else "greeted"


class Hub:
    """A socketcand server for many clients with a local port for its owner.

    Parameters
    ----------
    host : str
        Address to listen on; anything but loopback is refused unless `allow_remote`.
    port : int
        TCP port; 0 picks a free one, see the attribute `port`.
    allow_remote : bool
        Permit an address other computers can reach. CAN has no authentication: who connects moves the arm.
    max_backlog : int
        Bytes a client may lag behind before it is disconnected.

    Attributes
    ----------
    host, port : str, int
        Where the hub listens.
    sent, received : int
        Frames through the local port.
    frames : int
        Frames that came from clients.
    malformed : int
        Texts answered with ``< error ... >`` because they could not be understood.
    refused : int
        Commands understood but not offered (bcm mode, CAN FD, frames before ``< rawmode >``).
    dropped_clients : int
        Clients disconnected because they did not read.
    events : collections.deque of str
        The last 100 remarks about clients, for reports; also logged.

    Raises
    ------
    BusError
        If the port is taken or the address is not usable; one line with the next step.
    """

    def __init__(
        self,
        host: str = "127.0.0.1",
        port: int = DEFAULT_PORT,
        *,
        allow_remote: bool = False,
        max_backlog: int = 4 << 20,
    ) -> None:
        self.sent = self.received = 0
        self.frames = self.malformed = self.refused = self.dropped_clients = 0
        self.events: deque[str] = deque(maxlen=100)
        self.max_backlog = max_backlog
        self._clients: dict[int, _Client] = {}
        self._raw: list[_Client] = []
        self._inbox: deque[tuple[int, bytes]] = deque()
        self._ids: dict[str, tuple[int, str]] = {}  # id as a client wrote it -> (id, start of its frame text)
        self._starts: dict[int, str] = {}  # id -> start of its frame text
        self._stamp = ""  # wall time of this batch; empty: take it at the next frame
        self._unflushed = 0
        self._any_held = False
        self._paused = False
        self._closed = False
        self._listener = _listen(host, port, allow_remote)
        self.host, self.port = self._listener.getsockname()[:2]
        self._poll = select.poll()
        self._poll.register(self._listener, select.POLLIN)

    # ---- local port ------------------------------------------------------------------------------

    def send(self, can_id: int, data: bytes) -> None:
        """Put a frame on the bus; it is written at the next wait, `service` or `flush`.

        Parameters
        ----------
        can_id : int
            11-bit id, or a 29-bit id (above 7FFh, or with `EXTENDED_ID` set).
        data : bytes
            0 to 8 bytes.
        """
        if len(data) > 8:
            raise ValueError(f"a CAN frame has at most 8 data bytes, not {len(data)}")
        try:
            start = self._starts[can_id]
        except KeyError:
            start = self._starts[can_id] = _frame_start(can_id)
        self.sent += 1
        if self._raw:
            stamp = self._stamp or self._new_stamp()
            text = f"{start}{stamp}{data.hex().upper()} >"
            for client in self._raw:
                client.out.append(text)
            self._unflushed += 1
            if self._unflushed >= _FLUSH_AFTER:
                self.flush()

    def send_many(self, frames: Iterable[tuple[int, bytes]]) -> None:
        """Put several frames on the bus, in order."""
        for can_id, data in frames:
            self.send(can_id, data)

    def receive(self, timeout_s: float | None) -> tuple[int, bytes] | None:
        """Next frame from any client; all sockets are served while waiting.

        Parameters
        ----------
        timeout_s : float or None
            Longest wait; 0 only looks, None waits for ever.

        Returns
        -------
        tuple of int and bytes, or None
            Id (29-bit ids carry `EXTENDED_ID`) and data; None when the time is over.
        """
        inbox = self._inbox
        if not inbox:
            if timeout_s is None:
                while not inbox:
                    self._serve(None)
            else:
                end = time.monotonic() + timeout_s
                self._serve(timeout_s)
                while not inbox:
                    left = end - time.monotonic()
                    if left <= 0:
                        return None
                    self._serve(left)
        self.received += 1
        return inbox.popleft()

    def service(self) -> None:
        """Write what is due and read what has come, without waiting."""
        self._serve(0)

    def discard_pending(self) -> int:
        """Forget the frames that have come but were not received yet.

        Returns
        -------
        int
            How many.
        """
        self._serve(0)
        count = len(self._inbox)
        self._inbox.clear()
        return count

    @property
    def clients(self) -> list[ClientInfo]:
        """The clients connected now."""
        return [
            ClientInfo(c.address, c.channel, c.mode, c.frames, c.malformed, c.waiting) for c in self._clients.values()
        ]

    def close(self, linger_s: float = 0.5) -> None:
        """Hand the last frames to the clients (at most `linger_s` in all) and close everything."""
        if self._closed:
            return
        self._closed = True
        self._listener.close()
        end = time.monotonic() + linger_s
        self.flush()
        while any(c.backlog for c in self._raw) and time.monotonic() < end:
            time.sleep(0.001)
            self.flush()
        for client in self._clients.values():
            with contextlib.suppress(OSError):
                client.sock.shutdown(socket.SHUT_WR)
            client.sock.close()
        self._clients.clear()
        self._raw.clear()

    def __enter__(self) -> Hub:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    # ---- writing ---------------------------------------------------------------------------------

    def flush(self) -> None:
        """Write everything that is due: one ``send()`` per client."""
        self._stamp = ""
        self._unflushed = 0
        for client in self._raw[:]:  # a copy, because a client that is gone leaves the list
            if client.out:
                data = "".join(client.out).encode()
                client.out.clear()
            elif client.backlog:
                data = b""
            else:
                continue
            if client.backlog or client.held:
                client.backlog += data
                if client.held and not self._has_read_ok(client):
                    self._check_backlog(client)
                    continue
                self._write(client, client.backlog)
            else:
                self._write(client, data)

    def _write(self, client: _Client, data: bytes | bytearray) -> None:
        """Give `data`, which is all that this client is owed, to the kernel and keep the rest."""
        try:
            count = client.sock.send(data)
        except (BlockingIOError, InterruptedError):
            count = 0
        except OSError as error:
            self._drop(client, f"is gone ({error.strerror or error})")
            return
        if data is client.backlog:
            del client.backlog[:count]
            if self._check_backlog(client):
                self._watch(client)
        elif count < len(data):
            client.backlog += memoryview(data)[count:]
            if self._check_backlog(client):
                self._watch(client)

    def _check_backlog(self, client: _Client) -> bool:
        if len(client.backlog) <= self.max_backlog:
            return True
        self.dropped_clients += 1
        what = f"disconnected: it does not read and is {len(client.backlog)} bytes behind"
        self._drop(client, what, warn=True)
        return False

    def _answer(self, client: _Client, text: str) -> None:
        """Answer a command; in the handshake each answer is a write, so a segment, of its own."""
        if client.raw:
            client.out.append(text)
        elif client.backlog:
            client.backlog += text.encode()
            self._check_backlog(client)
        else:
            self._write(client, text.encode())

    def _new_stamp(self) -> str:
        self._stamp = f"{time.time():.6f} "
        return self._stamp

    def _has_read_ok(self, client: _Client) -> bool:
        """Whether a new raw client has read the last ``< ok >``; looked up ever more seldom, being slow."""
        now = time.monotonic()
        if now - client.hold_checked < client.hold_pause:
            return False
        client.hold_checked = now
        client.hold_pause = min(2 * client.hold_pause, _HOLD_LONGEST_S)
        unread = _unread_by_peer(client.sock)
        # None: not on this computer, or no /proc, so only time can tell
        done = now - client.hold_since >= _HOLD_BLIND_S if unread is None else unread == 0
        if done:
            self._release(client)
        return done

    def _release(self, client: _Client) -> None:
        client.held = False
        self._any_held = any(c.held for c in self._raw)

    # ---- reading ---------------------------------------------------------------------------------

    def _serve(self, timeout_s: float | None) -> None:
        """Flush, wait once, and handle whatever happened."""
        self.flush()
        if self._any_held and any(c.held and c.backlog for c in self._raw):
            pause = min(c.hold_pause for c in self._raw if c.held)
            timeout_s = pause if timeout_s is None else min(timeout_s, pause)
        if self._paused and len(self._inbox) < _INBOX_LIMIT // 2:
            self._pause(False)
        for fd, event in self._poll.poll(None if timeout_s is None else timeout_s * 1e3):
            client = self._clients.get(fd)
            if client is None:
                if not self._closed and fd == self._listener.fileno():
                    self._accept()
                continue
            if event & select.POLLOUT and client.backlog and not client.held:
                self._write(client, client.backlog)
            if event & _READABLE and fd in self._clients:
                self._read(client)

    def _accept(self) -> None:
        while True:
            try:
                sock, peer = self._listener.accept()
            except BlockingIOError:
                return
            except OSError as error:
                self._note(f"a client could not be accepted: {error.strerror or error}", warn=True)
                return
            sock.setblocking(False)
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            client = _Client(sock, f"{peer[0]}:{peer[1]}")
            self._clients[sock.fileno()] = client
            self._watch(client)
            self._answer(client, "< hi >")

    def _watch(self, client: _Client) -> None:
        """Tell the poll object what this client is waited for."""
        mask = 0 if self._paused else select.POLLIN
        if client.backlog and not client.held:
            mask |= select.POLLOUT
        if client.sock.fileno() in self._clients:
            self._poll.register(client.sock, mask)

    def _pause(self, paused: bool) -> None:
        """Stop or resume reading from all clients, because the owner lags behind."""
        self._paused = paused
        if paused:
            self._note(f"{len(self._inbox)} frames wait for the owner: the clients have to wait, too", warn=True)
        for client in self._clients.values():
            self._watch(client)

    def _read(self, client: _Client) -> None:
        try:
            chunk = client.sock.recv(_READ_SIZE)
        except (BlockingIOError, InterruptedError):
            return
        except OSError as error:
            self._drop(client, f"is gone ({error.strerror or error})")
            return
        if not chunk:
            where = " in the middle of a line" if client.partial.strip() else ""
            self._drop(client, f"closed the connection{where}")
            return
        if _QUICKACK is not None:
            client.sock.setsockopt(socket.IPPROTO_TCP, _QUICKACK, 1)  # holds for one read only
        if client.held:
            self._release(client)  # it talks, so it has read the answer
        pieces = (client.partial + chunk.decode("latin-1")).split(">")
        client.partial = pieces.pop()
        inbox, ids, byte_of, lengths = self._inbox, self._ids, _byte_of, _LENGTH
        others = [c.out.append for c in self._raw if c is not client]
        count = 0
        for piece in pieces:
            words = piece.split()
            try:
                if words[1] != "send" or words[0] != "<" or not client.raw:
                    raise LookupError
                known = ids.get(words[2]) or self._learn_id(words[2])
                data = bytes(map(byte_of, words[4:]))
                if len(data) != lengths[words[3]]:
                    raise ValueError
            except (LookupError, ValueError):
                self._command(client, piece, words)
                continue
            count += 1
            inbox.append((known[0], data))
            if others:
                text = f"{known[1]}{self._stamp or self._new_stamp()}{data.hex().upper()} >"
                for append in others:
                    append(text)
        client.frames += count
        self.frames += count
        if len(client.partial) > _LONGEST_TEXT:
            self._complain(client, client.partial)
            client.partial = ""
        if len(inbox) >= _INBOX_LIMIT and not self._paused:
            self._pause(True)

    def _command(self, client: _Client, piece: str, words: list[str]) -> None:
        """Anything but a well-formed frame in raw mode."""
        if len(words) < 2 or words[0] != "<":
            self._complain(client, piece)
            return
        verb = words[1]
        if verb == "echo" and len(words) == 2:
            self._answer(client, "< echo >")
        elif verb == "open" and len(words) == 3:
            if client.channel:
                self._refuse(client, f"{client.channel} is open already")
            else:
                client.channel = words[2]
                self._answer(client, "< ok >")
        elif verb == "rawmode" and len(words) == 2:
            if client.raw:
                self._answer(client, "< ok >")
            elif not client.channel:
                self._refuse(client, "open a bus first")
            else:
                self._answer(client, "< ok >")
                if client.sock.fileno() in self._clients:
                    client.raw = client.held = self._any_held = True
                    client.hold_since = time.monotonic()
                    self._raw.append(client)
                    self._note(f"client {client.address} joined {client.channel}")
        elif verb in _BCM_COMMANDS or (verb == "send" and not client.raw):
            self._refuse(client, f"{verb}: there is no bcm mode here, change to rawmode")
        elif verb in _OTHER_MODES:
            self._refuse(client, f"{verb}: there is only rawmode here")
        elif verb in _FD_COMMANDS:
            self._refuse(client, f"{verb}: there is no CAN FD here")
        else:
            self._complain(client, piece)

    def _learn_id(self, text: str) -> tuple[int, str]:
        """Id and start of the frame text for an id as a client wrote it; ValueError if it is none."""
        if not text.isalnum():  # int() would take '+12' and '1_2'
            raise ValueError
        value = int(text, 16)
        if len(text) == 16 and value >> 31 == 0x1_FFFF_FFFF:  # SavvyCAN: flag in bit 31, then sign-extended
            value &= 0xFFFF_FFFF
        elif len(text) > 8:
            raise ValueError
        if len(text) >= 8:  # eight digits are a 29-bit id, even a small one
            value &= ~EXTENDED_ID
            if value > 0x1FFF_FFFF:
                raise ValueError
            value |= EXTENDED_ID
        elif value > 0x7FF:
            raise ValueError
        if len(self._ids) > 4096:  # a scanner over all ids shall not fill the memory
            self._ids.clear()
        known = self._ids[text] = value, _frame_start(value)
        return known

    def _complain(self, client: _Client, piece: str) -> None:
        client.malformed += 1
        self.malformed += 1
        shown = "".join(c if c.isprintable() and c not in "<>" else "?" for c in piece.strip()[:60])
        self._answer(client, f"< error 000 {time.time():.6f} cannot understand: {shown} >")
        if client.malformed == 1:  # once per client: a noisy one must not fill the log
            self._note(f"client {client.address} sent text that is not socketcand: {shown!r}", warn=True)

    def _refuse(self, client: _Client, reason: str) -> None:
        self.refused += 1
        self._answer(client, f"< error 000 {time.time():.6f} {reason} >")

    def _drop(self, client: _Client, what: str, *, warn: bool = False) -> None:
        fd = client.sock.fileno()
        if self._clients.pop(fd, None) is None:
            return
        if client.raw:
            self._raw.remove(client)
            self._any_held = any(c.held for c in self._raw)
        self._poll.unregister(fd)
        client.sock.close()
        if client.channel or warn:  # who only looked whether there is a hub is not worth a line
            self._note(f"client {client.address} {what}", warn=warn)

    def _note(self, text: str, *, warn: bool = False) -> None:
        self.events.append(text)
        log.log(logging.WARNING if warn else logging.INFO, "%s:%d: %s", self.host, self.port, text)


def _frame_start(can_id: int) -> str:
    """Start of the text of a frame: ``'< frame 123 '`` or ``'< frame 18DAF110 '``."""
    if 0 <= can_id <= 0x7FF:
        return f"< frame {can_id:03X} "
    if 0 <= can_id & ~EXTENDED_ID <= 0x1FFF_FFFF:
        return f"< frame {can_id & ~EXTENDED_ID:08X} "
    raise ValueError(f"{can_id:#x} is no CAN id: 11 or 29 bits")


def _listen(host: str, port: int, allow_remote: bool) -> socket.socket:
    """A listening socket, or a `BusError` that says what to do."""
    where = f"{host}:{port}"
    try:
        address = socket.getaddrinfo(host or "0.0.0.0", port, socket.AF_INET, socket.SOCK_STREAM)[0][4]
    except (OSError, OverflowError) as error:
        raise BusError(f"cannot listen on {where}: {error}; try --bus tcp:127.0.0.1:{DEFAULT_PORT}") from error
    if not allow_remote and not ipaddress.ip_address(address[0]).is_loopback:
        raise BusError(
            f"refused to listen on {where}: other computers could move the arm (CAN has no authentication); "
            f"use --bus tcp:127.0.0.1:{port}"
        )
    listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # a second run right after the first
        listener.bind(address)
        listener.listen(64)
        listener.setblocking(False)
    except OSError as error:
        listener.close()
        if error.errno == errno.EADDRINUSE:
            raise BusError(
                f"port {port} on {host} is taken: choose another (--bus tcp:{host}:{port % 65535 + 1}) "
                f"or find who holds it: ss -ltnp 'sport = :{port}'"
            ) from error
        raise BusError(f"cannot listen on {where}: {error.strerror}; use --bus tcp:127.0.0.1:{DEFAULT_PORT}") from error
    return listener


def _unread_by_peer(sock: socket.socket) -> int | None:
    """Bytes written to a local TCP peer that its program has not read yet; None if that cannot be known.

    An acknowledgement only says that the peer's kernel has the bytes. On the same computer, though, the
    peer's receive queue is listed in /proc/net/tcp.
    """
    try:
        import fcntl

        in_flight = struct.unpack("i", fcntl.ioctl(sock, _SIOCOUTQ, b"\0\0\0\0"))[0]
        if in_flight:
            return int(in_flight)
        peer, own = (
            f"{int.from_bytes(socket.inet_aton(host), sys.byteorder):08X}:{port:04X}"
            for host, port in (sock.getpeername(), sock.getsockname())
        )
        with open("/proc/net/tcp", encoding="ascii") as table:
            text = table.read()
        start = text.find(f" {peer} {own} ")
        if start < 0:
            return None
        queues = text[start:].split(maxsplit=4)[3]  # peer, own, state, tx:rx
        return int(queues.split(":")[1], 16)
    except (ImportError, OSError, ValueError, IndexError):
        return None
