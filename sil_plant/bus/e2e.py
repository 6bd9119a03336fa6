"""E2E protection of frames in plain Python, for tools: they start sooner without numba (`sil_plant.bus.frames`)."""

from __future__ import annotations

STATES = 15  # of the counter: 0..14
_POLYNOMIAL = 0x1D


def _table() -> tuple[int, ...]:
    made = []
    for byte in range(256):
        crc = byte
        for _ in range(8):
            crc = (crc << 1 ^ _POLYNOMIAL if crc & 0x80 else crc << 1) & 0xFF
        made.append(crc)
    return tuple(made)


_TABLE = _table()


def crc(can_id: int, data: bytes) -> int:
    """CRC-8 of E2E profile 1 (mode BOTH, data id = identifier) over all bytes but the first."""
    table = _TABLE
    value = table[table[can_id & 0xFF] ^ can_id >> 8]
    for byte in data[1:]:
        value = table[value ^ byte]
    return value


def intact(can_id: int, data: bytes) -> bool:
    """Whether the CRC in the first byte is right."""
    return len(data) > 1 and crc(can_id, data) == data[0]


def protected(can_id: int, data: bytes, counter: int) -> bytes:
    """The frame with its counter and CRC, whatever stood there."""
    body = bytes((0, (data[1] & 0xF0) | counter % STATES)) + data[2:]
    return bytes((crc(can_id, body),)) + body[1:]
