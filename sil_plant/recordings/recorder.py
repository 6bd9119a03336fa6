"""Write what a bus carries to a file, by python-can's and asammdf's writers, so that a kill loses nothing.

Text formats go to their file at once. The writers of .blf and .mf4 make a whole file only when they end in order;
for these the frames are collected in a .log beside it, and converted at the end: by the recorder, or after a kill
by ``record.py --recover``.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterable, Iterator
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sil_plant.bus import protocol
from sil_plant.config import ConfigError
from sil_plant.recordings.recording import BOOT_UP, TEXT_FORMATS, WholeLines, format_of, spool_of

if TYPE_CHECKING:
    import can

FULL_FRAME_BYTES = 64  # room for CAN FD in an .mf4
MF4_GROUPS = ("DataFrame", "ErrorFrame", "RemoteFrame")


class RecorderError(ConfigError):
    """Why a recording cannot be written, in one line, and what is kept."""


class Recorder:
    """Collects messages in a file.

    Parameters
    ----------
    path : Path
        The recording; its name says the format.
    force : bool
        Replace what is there.

    Attributes
    ----------
    frames : int
        Taken so far.
    flushed : int
        Of these, safe from a kill of this program.
    has_start : bool
        A start of the ECU is among them.

    Raises
    ------
    RecorderError
        When it cannot be written, or would replace something.
    """

    def __init__(self, path: Path, force: bool = False) -> None:
        import can

        self.path = path
        self.kind = format_of(path)
        if path.suffix.lower() == ".gz":
            raise RecorderError(f"{path}: record to {path.with_suffix('').name}, and gzip it afterwards")
        self.spool = spool_of(path)
        check_free(path, force)
        if self.spool.exists() and not force:
            raise RecorderError(
                f"{self.spool}: is left of a recorder that was killed, if none is running; keep it: python "
                f"tools/record.py --recover {path}; throw it away: --force"
            )
        self.is_direct = self.kind in TEXT_FORMATS
        self.target = path if self.is_direct else self.spool
        self.frames = 0
        self.flushed = 0
        self.has_start = False
        self._boot_id = protocol.frame_id("HEARTBEAT_ECU")
        try:
            if self.is_direct:
                self.writer = can.Logger(str(self.target))
            else:
                self.writer = can.CanutilsLogWriter(str(self.target))
        except OSError as error:
            raise RecorderError(
                f"{path}: cannot be written: {error.strerror}; choose another file or folder"
            ) from error

    def add(self, message: can.Message) -> None:
        """Take one message."""
        self._guard(lambda: self.writer.on_message_received(message))
        self.frames += 1
        if message.arbitration_id == self._boot_id and bytes(message.data) == bytes((BOOT_UP,)):
            self.has_start = True

    def flush(self) -> None:
        """Hand everything to the system: from here on a kill of this program does not lose it."""
        if self.flushed != self.frames:
            self._guard(self.writer.file.flush)
            self.flushed = self.frames

    def _guard(self, action: object) -> None:
        try:
            action()  # type: ignore[operator]
        except OSError as error:
            with contextlib.suppress(OSError):
                self.writer.file.close()
            _cut_to_whole_lines(self.target)
            where = "" if self.is_direct else f" in {self.target}; when there is room: record.py --recover {self.path}"
            raise RecorderError(
                f"{self.path}: cannot be written any more: {error.strerror}; at least {self.flushed} of {self.frames} "
                f"frames are kept{where}"
            ) from error

    def close(self) -> None:
        """End the recording; for .blf and .mf4 this makes the file.

        Raises
        ------
        RecorderError
            When it cannot be made; what was collected is kept.
        """
        self.flush()
        self._guard(self.writer.stop)
        if not self.is_direct:
            convert_spool(self.path, force=True)


def check_free(path: Path, force: bool) -> None:
    """Refuse to replace a file.

    Raises
    ------
    RecorderError
        When there is one, or no folder for it.
    """
    if not path.resolve().parent.is_dir():
        raise RecorderError(f"{path}: its folder does not exist; make it: mkdir -p {path.parent}")
    if path.exists() and not force:
        raise RecorderError(f"{path}: is there already; another name, or --force to replace it")


def convert_spool(path: Path, force: bool = False) -> int:
    """Make a recording from what its recorder collected; the frames in it.

    Raises
    ------
    RecorderError
        When there is nothing to make it from, or it cannot be written; what was collected is kept.
    """
    kind = format_of(path)
    spool = spool_of(path)
    if not spool.exists():
        raise RecorderError(f"{path}: there is nothing to recover: no {spool.name} beside it")
    check_free(path, force)
    part = path.with_name(f"{path.stem}.part{path.suffix}")
    try:
        count = _write_mf4(part, _spooled(spool)) if kind == ".mf4" else _write(part, _spooled(spool))
        os.replace(part, path)
        spool.unlink()
    except OSError as error:
        raise RecorderError(
            f"{path}: cannot be written: {error.strerror}; all frames are kept in {spool}; when there is room: "
            f"python tools/record.py --recover {path}"
        ) from error
    finally:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)
    return count


def _spooled(spool: Path) -> Iterator[can.Message]:
    """The messages of a spool; a kill may have cut the last line off."""
    import can

    with spool.open(encoding="utf-8") as file:
        yield from can.CanutilsLogReader(WholeLines(file))  # type: ignore[arg-type]


def _write(path: Path, messages: Iterable[can.Message]) -> int:
    import can

    count = 0
    with can.Logger(str(path)) as writer:
        for message in messages:
            writer.on_message_received(message)
            count += 1
    return count


def _write_mf4(path: Path, messages: Iterable[can.Message]) -> int:
    """An .mf4 as python-can's MF4Writer makes it, all frames at once: one by one takes twenty times as long."""
    from asammdf import MDF, Signal
    from asammdf.blocks.v4_blocks import SourceInformation
    from asammdf.blocks.v4_constants import BUS_TYPE_CAN, SOURCE_BUS
    from can.io.mf4 import ERR_DTYPE, RTR_DTYPE, STD_DTYPE

    groups: tuple[list[can.Message], ...] = ([], [], [])
    for message in messages:
        groups[1 if message.is_error_frame else 2 if message.is_remote_frame else 0].append(message)
    start_s = min((group[0].timestamp for group in groups if group), default=0.0)
    mdf = MDF(version="4.10")
    try:
        mdf.header.start_time = datetime.fromtimestamp(start_s)
        source = SourceInformation(source_type=SOURCE_BUS, bus_type=BUS_TYPE_CAN)
        for name, dtype, group in zip(MF4_GROUPS, (STD_DTYPE, ERR_DTYPE, RTR_DTYPE), groups, strict=True):
            times, samples = _mf4_samples(f"CAN_{name}", dtype, group)
            mdf.append(Signal(name=f"CAN_{name}", samples=samples, timestamps=times - start_s, source=source))
        mdf.save(str(path), compression=2, overwrite=True)
    finally:
        mdf.close()
    return sum(len(group) for group in groups)


def _mf4_samples(name: str, dtype: np.dtype, group: list[can.Message]) -> tuple[np.ndarray, np.ndarray]:
    """Times and samples of the messages of one kind."""
    from can.util import channel2int, len2dlc

    samples = np.zeros(len(group), dtype=dtype)
    times = np.array([message.timestamp for message in group], dtype="<f8")
    samples[f"{name}.ID"] = [message.arbitration_id for message in group]
    samples[f"{name}.IDE"] = [message.is_extended_id for message in group]
    samples[f"{name}.Dir"] = [not message.is_rx for message in group]
    samples[f"{name}.BusChannel"] = [channel2int(message.channel) or 0 for message in group]
    samples[f"{name}.DLC"] = [len2dlc(message.dlc) if message.is_fd else message.dlc for message in group]
    if f"{name}.DataBytes" in (dtype.names or ()):
        data = b"".join(bytes(message.data).ljust(FULL_FRAME_BYTES, b"\0") for message in group)
        samples[f"{name}.DataBytes"] = np.frombuffer(data, dtype=np.uint8).reshape(-1, FULL_FRAME_BYTES)
        samples[f"{name}.DataLength"] = [len(message.data) for message in group]
        samples[f"{name}.EDL"] = [message.is_fd for message in group]
        samples[f"{name}.BRS"] = [message.bitrate_switch for message in group]
        samples[f"{name}.ESI"] = [message.error_state_indicator for message in group]
    return times, samples


def _cut_to_whole_lines(path: Path) -> None:
    """Drop a last line that was written in part."""
    with contextlib.suppress(OSError), path.open("r+b") as file:
        end = file.seek(0, os.SEEK_END)
        start = max(0, end - 4096)
        file.seek(start)
        tail = file.read()
        file.truncate(start + tail.rfind(b"\n") + 1 if b"\n" in tail else start)
