"""The firmware as a shared library in this process: the fast path, with no bus."""

from __future__ import annotations

import ctypes
from pathlib import Path

import numba.experimental.function_type  # noqa: F401  without it numba does not know _CFunction before its first compiling
import numpy as np
from numba import types
from numba.types import WrapperAddressProtocol

from sil_plant.bus.frames import DATA, FRAME_BYTES, frame_id
from sil_plant.bus.protocol import SYNC_ID
from sil_plant.compiled import inlined
from sil_plant.config import ROOT, ConfigError
from sil_plant.loop.external_plant import ExternalPlant
from sil_plant.loop.session import (
    OUT_ROWS,
    TICK,
    Session,
    ecu_is_dead,
    on_frame_plain,
    on_frame_with_faults,
    on_sync_plain,
    on_sync_with_faults,
    restarts,
    transmit_room,
    without_sync,
)

LIBRARIES = ROOT / "build" / "lib"
SCALARS = ("double", "float", "fixed")
TX_ROWS = 16

_BEGIN = types.int32(types.uintp, types.uintp, types.int32)
_END = types.int32(types.uintp, types.uintp, types.int32, types.uintp, types.int32)


class _CFunction(WrapperAddressProtocol):
    """A C function that compiled code calls through its address, without Python in between."""

    def __init__(self, address: int, signature: object) -> None:
        self._address = address
        self._signature = signature

    def __wrapper_address__(self) -> int:
        return self._address

    def signature(self) -> object:
        return self._signature


class InprocEcu:
    """One ECU in this process.

    Parameters
    ----------
    image : bytes or None
        Parameter image; None is the reference arm that is built in.
    period_us : int
        The tick.
    scalar : str
        Number type of the law, one of ``SCALARS``.

    Raises
    ------
    ConfigError
        When the library is not built, or the image is refused; says what to do.
    """

    def __init__(self, image: bytes | None = None, period_us: int = 1000, scalar: str = "double") -> None:
        path = LIBRARIES / f"libdiarc_inproc_{scalar}.so"
        self.library = _load(path)
        size = self.library.diarc_inproc_size()
        self.memory = np.zeros(size + 64, dtype=np.uint8)
        self.pointer = (self.memory.ctypes.data + 63) & ~63
        self._image, self._period_us = image, period_us
        self.begin = _CFunction(ctypes.cast(self.library.diarc_inproc_begin, ctypes.c_void_p).value or 0, _BEGIN)
        self.end = _CFunction(ctypes.cast(self.library.diarc_inproc_end, ctypes.c_void_p).value or 0, _END)
        self.restart()

    def restart(self) -> None:
        """Switch it off and on again: nothing is left but its parameters."""
        image = self._image
        entry = ctypes.c_uint16()
        status = self.library.diarc_inproc_init(
            self.pointer, image, len(image) if image else 0, self._period_us, ctypes.byref(entry)
        )
        if status != 0:
            text = self.library.diarc_inproc_status_text(status).decode()
            name = self.library.diarc_inproc_parameter_name(entry.value).decode()
            raise ConfigError(f"the firmware refuses its parameters: the image {text} (parameter {name})")

    def tick_begin(self) -> np.ndarray:
        """First half of a tick; the frames sent, shape (n, 16)."""
        tx = np.zeros((TX_ROWS, FRAME_BYTES), dtype=np.uint8)
        sent = self.library.diarc_inproc_begin(self.pointer, tx.ctypes.data, TX_ROWS)
        return tx[:sent]

    def tick_end(self, rows: np.ndarray) -> np.ndarray:
        """Rest of a tick on frames of shape (n, 16), uint8; the frames sent."""
        rx = np.ascontiguousarray(rows, dtype=np.uint8)
        tx = np.zeros((TX_ROWS, FRAME_BYTES), dtype=np.uint8)
        sent = self.library.diarc_inproc_end(self.pointer, rx.ctypes.data, len(rx), tx.ctypes.data, TX_ROWS)
        return tx[:sent]

    def request_safe_stop(self) -> None:
        """What its port does, between ticks, when it is told to end."""
        self.library.diarc_inproc_request_safe_stop(self.pointer)

    def shutdown(self) -> np.ndarray:
        """Shut the valves at once; the frames sent."""
        tx = np.zeros((TX_ROWS, FRAME_BYTES), dtype=np.uint8)
        sent = self.library.diarc_inproc_shutdown(self.pointer, tx.ctypes.data, TX_ROWS)
        return tx[:sent]


def _load(path: Path) -> ctypes.CDLL:
    try:
        library = ctypes.CDLL(str(path))
    except OSError as error:
        raise ConfigError(
            f"the in-process firmware {path.name} is not there or does not load; build it: make firmware"
        ) from error
    library.diarc_inproc_size.restype = ctypes.c_uint32
    library.diarc_inproc_status_text.restype = ctypes.c_char_p
    library.diarc_inproc_parameter_name.restype = ctypes.c_char_p
    library.diarc_inproc_init.argtypes = (
        ctypes.c_void_p,
        ctypes.c_char_p,
        ctypes.c_uint32,
        ctypes.c_uint32,
        ctypes.POINTER(ctypes.c_uint16),
    )
    library.diarc_inproc_begin.argtypes = (ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int32)
    library.diarc_inproc_end.argtypes = (
        ctypes.c_void_p,
        ctypes.c_void_p,
        ctypes.c_int32,
        ctypes.c_void_p,
        ctypes.c_int32,
    )
    library.diarc_inproc_request_safe_stop.argtypes = (ctypes.c_void_p,)
    library.diarc_inproc_request_safe_stop.restype = None
    library.diarc_inproc_shutdown.argtypes = (ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int32)
    return library


@inlined
def closed_loop(
    session: Session, begin: _CFunction, end: _CFunction, ecu: int, ticks: int, rx: np.ndarray, tx: np.ndarray
) -> int:
    """Run ECU and session together for ``ticks`` ticks, or until the run is over; the ticks done."""
    for done in range(ticks):
        sent = begin(ecu, np.uintp(tx.ctypes.data), np.int32(TX_ROWS))
        rows = 0
        for k in range(sent):
            if frame_id(tx[k]) == SYNC_ID:
                rows = on_sync_plain(session, int(tx[k, 5]), rx)
            else:
                on_frame_plain(session, tx[k])
        if rows < 0:
            return done
        sent = end(ecu, np.uintp(rx.ctypes.data), np.int32(rows), np.uintp(tx.ctypes.data), np.int32(TX_ROWS))
        for k in range(sent):
            on_frame_plain(session, tx[k])
    return ticks


@inlined
def closed_loop_with_faults(
    session: Session, begin: _CFunction, end: _CFunction, ecu: int, ticks: int, rx: np.ndarray, tx: np.ndarray
) -> int:
    """As :func:`closed_loop`, with an ECU that may be dead, or unable to send."""
    for done in range(ticks):
        if ecu_is_dead(session):
            if without_sync(session, rx) < 0:
                return done
            continue
        room = transmit_room(session, TX_ROWS)
        sent = begin(ecu, np.uintp(tx.ctypes.data), np.int32(room))
        room -= sent
        rows = 0
        synchronous = False
        for k in range(sent):
            if frame_id(tx[k]) == SYNC_ID:
                rows = on_sync_with_faults(session, int(tx[k, 5]), rx)
                synchronous = True
            else:
                on_frame_with_faults(session, tx[k])
        if not synchronous:
            rows = without_sync(session, rx)
        if rows < 0:
            return done
        sent = end(ecu, np.uintp(rx.ctypes.data), np.int32(rows), np.uintp(tx.ctypes.data), np.int32(room))
        for k in range(sent):
            on_frame_with_faults(session, tx[k])
    return ticks


def run_inproc(session: Session, ecu: InprocEcu, ticks: int, plant: ExternalPlant | None = None) -> int:
    """Run at most ``ticks`` ticks, with another plant than ours if one is given; the number done.

    An ECU that a fault kills starts anew here.
    """
    if plant is not None:
        return _run_external(session, ecu, ticks, plant)
    rx = np.zeros((OUT_ROWS, FRAME_BYTES), dtype=np.uint8)
    tx = np.zeros((TX_ROWS, FRAME_BYTES), dtype=np.uint8)
    first = int(session.progress.index[TICK])
    done = 0
    for stop in [tick - first for tick in restarts(session) if first < tick <= first + ticks] + [ticks]:
        loop = closed_loop_with_faults if session.faulty else closed_loop
        done += int(loop(session, ecu.begin, ecu.end, np.uintp(ecu.pointer), stop - done, rx, tx))
        if done < stop:
            break
        if first + stop in restarts(session):
            ecu.restart()
    return done


def _run_external(session: Session, ecu: InprocEcu, ticks: int, plant: ExternalPlant) -> int:
    """As :func:`closed_loop`, but for a plant that is not compiled with us."""
    out = np.zeros((OUT_ROWS, FRAME_BYTES), dtype=np.uint8)
    for done in range(ticks):
        rows = 0
        for row in ecu.tick_begin():
            if frame_id(row) == SYNC_ID:
                rows = plant.on_sync(session, int(row[DATA]), out)
            else:
                on_frame_plain(session, row)
        if rows < 0:
            return done
        for row in ecu.tick_end(out[:rows]):
            on_frame_plain(session, row)
    return ticks
