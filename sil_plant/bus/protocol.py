"""The frames, as the DBC describes them: ids, bit layouts for compiled code, and the DBC's hash."""

from __future__ import annotations

import functools
import hashlib
from pathlib import Path
from typing import Any

import numpy as np

from sil_plant.config import ROOT, ConfigError

DBC_PATH = ROOT / "can_protocol" / "diarc.dbc"

SYNC_ID = 0x080
NMT_ID = 0x000
BIT_RATE = 1_000_000


def dbc_hash(path: Path = DBC_PATH) -> int:
    """First four bytes of the SHA-256 of the DBC, line ends as LF: what the ECU sends as ``DbcHash``."""
    text = path.read_bytes().replace(b"\r\n", b"\n")
    return int.from_bytes(hashlib.sha256(text).digest()[:4], "big")


@functools.cache
def database() -> Any:
    """The DBC as a cantools database (slow to load, so only once)."""
    import cantools

    return cantools.database.load_file(str(DBC_PATH), strict=True)


def frame_id(name: str) -> int:
    """Identifier of a frame by its name in the DBC."""
    return int(database().get_message_by_name(name).frame_id)


def layout(name: str, signals: tuple[str, ...]) -> np.ndarray:
    """Where signals of a frame stand, for :mod:`sil_plant.bus.frames`.

    Returns
    -------
    np.ndarray
        int64, one row ``start bit, length, signed`` per signal; bit 0 is the lowest bit of byte 0.
    """
    message = database().get_message_by_name(name)
    rows = []
    for signal_name in signals:
        signal = message.get_signal_by_name(signal_name)
        if signal.byte_order != "little_endian":
            raise ConfigError(f"{DBC_PATH}: {name}.{signal_name} is not little-endian")
        rows.append((signal.start, signal.length, int(signal.is_signed)))
    return np.array(rows, dtype=np.int64)


def worst_case_bits(length: int) -> int:
    """Bits of a classic frame with an 11-bit identifier on the wire: worst stuffing, and the gap after it."""
    return 8 * length + 44 + (34 + 8 * length - 1) // 4 + 3


def worst_case_bus_load() -> float:
    """Share of the bit rate that the cyclic frames of the DBC need, 0..1."""
    bits_per_s = sum(
        worst_case_bits(message.length) / (message.cycle_time * 1e-3)
        for message in database().messages
        if message.cycle_time
    )
    return float(bits_per_s / BIT_RATE)


def scale(name: str, signal: str) -> float:
    """Physical value of one raw step."""
    return float(database().get_message_by_name(name).get_signal_by_name(signal).scale)


def check_dbc_hash(heard: int) -> None:
    """Refuse an ECU that was built from another DBC.

    Raises
    ------
    ConfigError
        Naming both hashes and what to do.
    """
    ours = dbc_hash()
    if heard != ours:
        raise ConfigError(
            f"the ECU's frames follow another DBC: its hash is {heard:08X}, {DBC_PATH.name} here has {ours:08X}; "
            "build the firmware from this tree (make firmware) or use the tools of the firmware's release"
        )
