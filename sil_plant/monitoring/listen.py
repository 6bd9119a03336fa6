"""A bus that comes and goes, listened to: opened again whenever it is there, its frames given to a watch."""

from __future__ import annotations

import contextlib
import time

from sil_plant.bus.hub import DEFAULT_PORT
from sil_plant.bus.ports import BusAddress, BusError, FramePort, SocketCanPort, open_frame_port, parse_bus
from sil_plant.monitoring.watch import Watch

REOPEN_S = 1.0
_SLICE_S = 0.05


def joinable(text: str) -> BusAddress:
    """Understand the bus string of a tool that joins what runs already.

    Raises
    ------
    BusError
        One line, for a string that is none, and for ``inproc``.
    """
    address = parse_bus(text)
    if address.kind == "inproc":
        raise BusError(
            "inproc is inside the plant's process, nothing can join it; on a bus it can be watched: "
            f"`python sil_plant/run.py --bus tcp:127.0.0.1:{DEFAULT_PORT} --ecu spawn`"
        )
    return address


class Listener:
    """Gives the frames of a bus to a watch, and opens the bus again after it went away.

    Times are of `time.monotonic`. One thread does all: a reader thread that dies unseen cannot be.

    Parameters
    ----------
    address : BusAddress
        Any bus but ``inproc``.
    watch : Watch
        Gets the frames.

    Attributes
    ----------
    problem : str
        Why the bus is not open, with the next step; empty while it is.
    ignored : int
        Frames that are none of ours: 29-bit identifiers, remote, error and CAN FD frames.
    """

    def __init__(self, address: BusAddress, watch: Watch) -> None:
        self.address = address
        self.watch = watch
        self.problem = ""
        self.ignored = 0
        self._port: FramePort | None = None
        self._retry_s = 0.0
        self._was_open = False

    @property
    def is_open(self) -> bool:
        """Whether the bus is there."""
        return self._port is not None

    def open(self) -> None:
        """Open the bus now.

        Raises
        ------
        BusError
            One line with the next step.
        """
        self.close()
        self._port = open_frame_port(self.address)
        self.problem = ""
        now_s = time.monotonic()
        self.watch.reopened(now_s)
        if self._was_open:
            self.watch.note(now_s, f"{self.address} is back")
        self._was_open = True

    def send(self, can_id: int, data: bytes) -> None:
        """Put one frame on the bus, which must be open.

        Raises
        ------
        BusError
            When it is not, or does not take the frame.
        """
        if self._port is None:
            raise BusError(self.problem or f"{self.address} is not open")
        self._port.send(can_id, data)

    def listen(self, until_s: float) -> None:
        """Take frames until a time; while the bus is away, wait and try to open it."""
        while (now_s := time.monotonic()) < until_s:
            if self._port is None:
                self._try_open(now_s)
            if self._port is None:
                time.sleep(max(0.0, min(until_s - time.monotonic(), _SLICE_S)))
                continue
            try:
                self._take(self._port, until_s)
            except BusError as error:
                self._lose(error)

    def _take(self, port: FramePort, until_s: float) -> None:
        """Take what comes. The clock is read once a frame, and the counts of drops at the end."""
        take, receive, clock = self.watch.take, port.receive, time.monotonic
        left_s = until_s - clock()
        while left_s > 0.0:
            frame = receive(left_s)
            now_s = clock()
            if frame is not None and len(frame[1]) <= 8:
                take(frame[0], frame[1], now_s)
            left_s = until_s - now_s
        self.ignored = port.ignored
        if isinstance(port, SocketCanPort):
            self.watch.receive_drops = port.receive_drops

    def _try_open(self, now_s: float) -> None:
        if now_s < self._retry_s:
            return
        try:
            self.open()
        except BusError as error:
            self.problem = str(error)
            self._retry_s = time.monotonic() + REOPEN_S

    def _lose(self, error: BusError) -> None:
        self.close()
        self.problem = str(error)
        now_s = time.monotonic()
        self.watch.note(now_s, f"{self.address} went away")
        self._retry_s = now_s + REOPEN_S

    def close(self) -> None:
        """Leave the bus."""
        if self._port is not None:
            with contextlib.suppress(BusError):
                self._port.close()
            self._port = None
