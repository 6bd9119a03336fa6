"""Frames in compiled code: bit fields, E2E protection, and the 16 byte layout shared with the firmware.

A frame is a row of 16 bytes as ``struct can_frame_11bit`` of the firmware: identifier (uint32,
little-endian), length, eight data bytes, padding. Bit layouts come from the DBC (:mod:`sil_plant.bus.protocol`).
"""

from __future__ import annotations

import numpy as np

from sil_plant.compiled import inlined

FRAME_BYTES = 16
DATA = 5  # first data byte in a row
E2E_STATES = 15


def _crc_table() -> np.ndarray:
    table = np.zeros(256, dtype=np.uint8)
    for byte in range(256):
        crc = byte
        for _ in range(8):
            crc = ((crc << 1) ^ 0x1D if crc & 0x80 else crc << 1) & 0xFF
        table[byte] = crc
    return table


_CRC = _crc_table()


@inlined
def e2e_crc(can_id: int, row: np.ndarray) -> int:
    """CRC-8 of E2E profile 1 (mode BOTH, data id = identifier) over data bytes 1..7 of a frame row."""
    crc = _CRC[can_id & 0xFF]
    crc = _CRC[crc ^ (can_id >> 8)]
    for k in range(1, 8):
        crc = _CRC[crc ^ row[DATA + k]]
    return crc


@inlined
def frame_id(row: np.ndarray) -> int:
    """Identifier of a frame row."""
    return int(row[0]) | int(row[1]) << 8 | int(row[2]) << 16 | int(row[3]) << 24


@inlined
def write_header(row: np.ndarray, can_id: int, length: int) -> None:
    """Make a row an empty frame."""
    for k in range(FRAME_BYTES):
        row[k] = 0
    row[0] = can_id & 0xFF
    row[1] = can_id >> 8
    row[4] = length


@inlined
def put(row: np.ndarray, start: int, length: int, raw: int) -> None:
    """Write a little-endian bit field; ``raw`` may be negative (two's complement)."""
    bit, taken = start, 0
    while taken < length:
        offset = bit & 7
        take = min(8 - offset, length - taken)
        mask = ((1 << take) - 1) << offset
        at = DATA + (bit >> 3)
        row[at] = (int(row[at]) & (0xFF ^ mask)) | (((raw >> taken) << offset) & mask)
        bit += take
        taken += take


@inlined
def get(row: np.ndarray, start: int, length: int, signed: int) -> int:
    """Read a little-endian bit field."""
    raw = 0
    bit, taken = start, 0
    while taken < length:
        offset = bit & 7
        take = min(8 - offset, length - taken)
        raw |= ((int(row[DATA + (bit >> 3)]) >> offset) & ((1 << take) - 1)) << taken
        bit += take
        taken += take
    if signed and raw >> (length - 1):
        raw -= 1 << length
    return raw


@inlined
def protect(row: np.ndarray, counter: int) -> None:
    """Put E2E counter and CRC into a frame whose other bytes are final."""
    row[DATA + 1] = (row[DATA + 1] & 0xF0) | counter
    row[DATA] = e2e_crc(frame_id(row), row)


@inlined
def intact(row: np.ndarray) -> bool:
    """True for a frame of 8 bytes whose CRC is right."""
    return row[4] == 8 and e2e_crc(frame_id(row), row) == row[DATA]


def intact_rows(rows: np.ndarray) -> np.ndarray:
    """For frame rows of one identifier: which are of 8 bytes and have the right CRC."""
    if not len(rows):
        return np.zeros(0, dtype=bool)
    can_id = int(rows[0, 0]) | int(rows[0, 1]) << 8
    crc = np.full(len(rows), _CRC[_CRC[can_id & 0xFF] ^ (can_id >> 8)], dtype=np.uint8)
    for k in range(1, 8):
        crc = _CRC[crc ^ rows[:, DATA + k]]
    return (rows[:, 4] == 8) & (crc == rows[:, DATA])


@inlined
def quantise(value: float, step: float, low: int, high: int) -> int:
    """Raw integer of a physical value: round half away from zero, saturate."""
    scaled = value / step
    if not scaled > low:
        return low
    if scaled >= high:
        return high
    return int(scaled - 0.5) if scaled < 0.0 else int(scaled + 0.5)


def to_row(can_id: int, data: bytes) -> np.ndarray:
    """A frame row from identifier and data."""
    row = np.zeros(FRAME_BYTES, dtype=np.uint8)
    row[:4] = np.frombuffer(can_id.to_bytes(4, "little"), dtype=np.uint8)
    row[4] = len(data)
    row[DATA : DATA + len(data)] = np.frombuffer(data, dtype=np.uint8)
    return row


def from_row(row: np.ndarray) -> tuple[int, bytes]:
    """Identifier and data of a frame row."""
    return int(row[0]) | int(row[1]) << 8, row[DATA : DATA + int(row[4])].tobytes()
