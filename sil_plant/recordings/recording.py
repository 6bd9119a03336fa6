"""Recordings of a bus: frames from a log file, ticks from the SYNC counter, signals as arrays.

Files are read by python-can's readers. What cannot be read does not cost what can: a recording says how far it
is whole.
"""

from __future__ import annotations

import gzip
import io
import struct
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from sil_plant.bus import protocol
from sil_plant.bus.frames import DATA, FRAME_BYTES, intact_rows
from sil_plant.config import ConfigError

if TYPE_CHECKING:
    import can

FORMATS = (".blf", ".asc", ".log", ".mf4", ".csv")
TEXT_FORMATS = (".asc", ".log", ".csv")
SPOOL_SUFFIX = ".spool.log"  # beside a recording whose format is only whole when its writer ends in order
SYNC_COUNTERS = 240  # CiA 301, 1019h
ECU_NODE = 1
BOOT_UP = 0  # of a heartbeat

_FRAME = struct.Struct("<IB8s3x")
_BLF_HEADER_BYTES = 144


class RecordingError(ConfigError):
    """Why a recording cannot be used, in one line, and what to do."""


@dataclass(frozen=True)
class Recording:
    """The classic frames with 11-bit identifiers of a recording, in its order.

    Attributes
    ----------
    path : Path
        The file.
    time_s : np.ndarray
        From the first frame on, shape (n,).
    rows : np.ndarray
        The frames as :mod:`sil_plant.bus.frames` has them, shape (n, 16), uint8.
    ignored : int
        Frames that the ECU does not hear: 29-bit identifiers, remote, error and CAN FD frames.
    damage : str
        Empty, or where and why the file ends before its time.
    """

    path: Path
    time_s: np.ndarray
    rows: np.ndarray
    ignored: int = 0
    damage: str = ""

    @property
    def ids(self) -> np.ndarray:
        """Identifier of each frame."""
        return ids_of(self.rows)

    @property
    def duration_s(self) -> float:
        """From the first frame to the last."""
        return float(self.time_s[-1] - self.time_s[0]) if len(self.time_s) else 0.0


def ids_of(rows: np.ndarray) -> np.ndarray:
    """Identifiers of frame rows."""
    return np.ascontiguousarray(rows[:, :4]).view("<u4")[:, 0]


# ---- files ---------------------------------------------------------------------------------------


def spool_of(path: Path) -> Path:
    """Where the frames of a recording are collected whose writer is not safe against being killed."""
    return path.with_name(path.name + SPOOL_SUFFIX)


def format_of(path: Path) -> str:
    """The format that a file's name stands for, ``.gz`` aside.

    Raises
    ------
    RecordingError
        When there is no such format, or what it needs is not installed.
    """
    name = path.name.lower().removesuffix(".gz")
    suffix = next((known for known in FORMATS if name.endswith(known)), None)
    if suffix is None:
        raise RecordingError(f"{path}: the format follows from the name, which ends in {', '.join(FORMATS)}")
    if suffix == ".mf4":
        # through python-can: it does without asammdf when that is imported first, for they import one another
        import can.io.mf4

        if can.io.mf4.asammdf is None:
            raise RecordingError(
                f"{path}: .mf4 needs asammdf: .venv/bin/python -m pip install -r requirements.txt; "
                "the other formats do not"
            )
    return suffix


class WholeLines:
    """A text file for python-can's readers, line by line; a last line that is cut off is not handed out."""

    def __init__(self, file: io.TextIOBase) -> None:
        self.file = file
        self.number = 0
        self.is_cut = False

    def __iter__(self) -> Iterator[str]:
        return self

    def __next__(self) -> str:
        line = self.file.readline()
        if not line:
            raise StopIteration
        self.number += 1
        if not line.endswith("\n"):
            self.is_cut = True
            raise StopIteration
        return line

    def close(self) -> None:
        """Close the file."""
        self.file.close()


@dataclass
class _Collector:
    """Frames on their way into arrays."""

    times: list[float] = field(default_factory=list)
    frames: bytearray = field(default_factory=bytearray)
    ignored: int = 0

    def take(self, messages: Iterable[can.Message]) -> None:
        pack, add, note = _FRAME.pack, self.frames.extend, self.times.append
        for message in messages:
            if message.is_extended_id or message.is_remote_frame or message.is_error_frame or message.is_fd:
                self.ignored += 1
                continue
            data = bytes(message.data)
            add(pack(message.arbitration_id, len(data), data))
            note(message.timestamp)


def read_recording(path: Path) -> Recording:
    """Read a recording as far as it can be read.

    Parameters
    ----------
    path : Path
        One of ``FORMATS``, the text ones and ``.blf`` also with ``.gz`` behind.

    Raises
    ------
    RecordingError
        When no frame at all can be read; one line with the next step.
    """
    kind = format_of(path)
    if not path.exists() and spool_of(path).exists():
        raise RecordingError(
            f"{path}: its recorder was killed; make it from what was kept: python tools/record.py --recover {path}"
        )
    found = _Collector()
    try:
        damage = _read_text(path, kind, found) if kind in TEXT_FORMATS else _read_binary(path, kind, found)
    except OSError as error:
        if not isinstance(error, gzip.BadGzipFile) and error.errno is not None:
            raise RecordingError(f"{path}: cannot be read: {error.strerror}; check the path") from error
        damage = str(error)
    if not found.times:
        why = f": {damage}" if damage else ""
        raise RecordingError(f"{path}: no frame could be read{why}; is it a recording, and whole? Make one: "
                             "python tools/record.py --help")  # fmt: skip
    rows = np.frombuffer(bytes(found.frames), dtype=np.uint8).reshape(-1, FRAME_BYTES)
    times = np.array(found.times)
    return Recording(path, times - times[0], rows, found.ignored, damage)


def _opened(path: Path) -> Any:
    return gzip.open(path, "rb") if path.name.lower().endswith(".gz") else path.open("rb")


def _read_text(path: Path, kind: str, found: _Collector) -> str:
    import can

    readers = {".asc": can.ASCReader, ".log": can.CanutilsLogReader, ".csv": can.CSVReader}
    with _opened(path) as file:
        lines = WholeLines(io.TextIOWrapper(file, encoding="utf-8", newline=None))
        try:
            found.take(readers[kind](lines))  # type: ignore[arg-type]
        except Exception as error:  # whatever a reader makes of text that is no recording
            return f"line {lines.number + isinstance(error, UnicodeDecodeError)} is damaged ({_reason(error)})"
        if lines.is_cut:
            return f"line {lines.number} is cut off, the last one"
        if lines.number and not found.times and not found.ignored:
            return f"none of its {lines.number} lines is a frame"
        return ""


def _read_binary(path: Path, kind: str, found: _Collector) -> str:
    import can

    try:
        if kind == ".mf4":
            with can.MF4Reader(path) as reader:
                found.take(reader)
            return ""
        with _opened(path) as file:
            reader = can.BLFReader(file)
            said = reader.file_size
            found.take(reader)
        size = path.stat().st_size
        if path.name.lower().endswith(".gz") or said == size:
            return ""
        if said == _BLF_HEADER_BYTES:
            return "its writer did not close it"
        return f"its header speaks of {said} bytes, it has {size}"
    except OSError:
        raise
    except Exception as error:  # whatever a reader makes of bytes that are no recording
        return f"it is damaged after frame {len(found.times) + found.ignored} ({_reason(error)})"


def _reason(error: Exception) -> str:
    text = str(error).strip().splitlines()
    return text[0] if text else type(error).__name__


# ---- ticks ---------------------------------------------------------------------------------------


class Ticks(NamedTuple):
    """Where the ticks of a recording are.

    Attributes
    ----------
    of_row : np.ndarray
        For each frame the number of its SYNC, -1 before the first.
    row : np.ndarray
        For each SYNC its frame.
    missing : np.ndarray
        For each SYNC, how many are missing before it by its counter; 0 after a start of the ECU.
    number : np.ndarray
        For each SYNC its tick since the recording's first, missing ones counted.
    boots : np.ndarray
        Frames that are the ECU's boot-up.
    """

    of_row: np.ndarray
    row: np.ndarray
    missing: np.ndarray
    number: np.ndarray
    boots: np.ndarray


def find_ticks(rows: np.ndarray) -> Ticks:
    """Divide frames into ticks: from a SYNC to the next."""
    ids = ids_of(rows)
    is_sync = (ids == protocol.SYNC_ID) & (rows[:, 4] == 1)
    row = np.flatnonzero(is_sync)
    of_row = np.cumsum(is_sync) - 1
    boot = (ids == protocol.frame_id("HEARTBEAT_ECU")) & (rows[:, 4] == 1) & (rows[:, DATA] == BOOT_UP)
    boots = np.flatnonzero(boot)
    counter = rows[row, DATA].astype(np.int64)
    missing = np.zeros(len(row), dtype=np.int64)
    if len(row) > 1:
        missing[1:] = (np.diff(counter) - 1) % SYNC_COUNTERS
    started = np.searchsorted(row, boots)
    missing[started[started < len(row)]] = 0
    return Ticks(of_row, row, missing, np.arange(len(row)) + np.cumsum(missing), boots)


# ---- signals -------------------------------------------------------------------------------------


def payload(rows: np.ndarray) -> np.ndarray:
    """The data of frame rows as one little-endian number each."""
    return np.ascontiguousarray(rows[:, DATA : DATA + 8]).view("<u8")[:, 0]


def raw_signal(rows: np.ndarray, message: str, signal: str) -> np.ndarray:
    """Raw values of a signal, int64; all rows must be of this message."""
    start, length, is_signed = (int(v) for v in protocol.layout(message, (signal,))[0])
    raw = (payload(rows) >> np.uint64(start)).astype(np.int64) & ((1 << length) - 1)
    return np.where(raw >> (length - 1), raw - (1 << length), raw) if is_signed else raw


def signal(rows: np.ndarray, message: str, name: str) -> np.ndarray:
    """Physical values of a signal; all rows must be of this message."""
    return raw_signal(rows, message, name) * protocol.scale(message, name)


def rows_of(recording: Recording, message: str) -> np.ndarray:
    """Indices of the whole frames of a message: right length, and right CRC where it has one."""
    description = protocol.database().get_message_by_name(message)
    index = np.flatnonzero((recording.ids == description.frame_id) & (recording.rows[:, 4] == description.length))
    if any(s.name == "E2eCrc" for s in description.signals):
        index = index[intact_rows(recording.rows[index])]
    return index


def names_of(message: str, name: str) -> dict[int, str]:
    """What the DBC calls the values of a signal."""
    choices = protocol.database().get_message_by_name(message).get_signal_by_name(name).choices or {}
    return {int(value): str(text) for value, text in choices.items()}
