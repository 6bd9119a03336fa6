"""Frames in compiled code and in the firmware, against cantools and the PyPI package autosar-e2e."""

from __future__ import annotations

import random
from collections import defaultdict

import numpy as np
import pytest

from sil_plant.bus import frames, protocol

e2e_p01 = pytest.importorskip("e2e.p01", reason="autosar-e2e comes for x86-64 only")

MESSAGES = [message.name for message in protocol.database().messages]
PROCESS_FRAMES = [m.name for m in protocol.database().messages if m.length == 8 and m.name != "EMCY_ECU"]
ECU_PROCESS_FRAMES = ["VALVES", "ESTIMATE", "TRACKING", "PARAMETERS", "TIMING"]
# What the DBC's comment says means "invalid".
INVALID = {
    ("ENCODERS", "SwingAngle"): -(2**23),
    ("ENCODERS", "WristAngle"): -(2**23),
    ("PRESSURES_SWING", "BorePressure"): 65535,
    ("PRESSURES_SWING", "SpoolPosition"): -(2**15),
    ("PRESSURES_WRIST", "AnnulusPressure"): 65535,
    ("VALVES", "SwingSpool"): -(2**15),
}


def of_name(name: str):
    return protocol.database().get_message_by_name(name)


def pages(message) -> list[tuple[dict[str, int], list]]:
    """Each page of a message: its multiplexer value (or nothing), and the signals on it."""
    plain = [s for s in message.signals if s.multiplexer_ids is None and not s.is_multiplexer]
    multiplexers = [s for s in message.signals if s.is_multiplexer]
    if not multiplexers:
        return [({}, plain)]
    (multiplexer,) = multiplexers
    values = sorted({n for s in message.signals for n in s.multiplexer_ids or []})
    return [
        ({multiplexer.name: n}, plain + [s for s in message.signals if n in (s.multiplexer_ids or [])]) for n in values
    ]


def bounds(signal) -> tuple[int, int]:
    if signal.is_signed:
        return -(1 << (signal.length - 1)), (1 << (signal.length - 1)) - 1
    return 0, (1 << signal.length) - 1


def raw_sets(message, signals: list) -> list[dict[str, int]]:
    """Corners of each signal with the others at theirs, the invalid values, and random ones."""
    rng = random.Random(message.name)
    low, high = ({s.name: bounds(s)[k] for s in signals} for k in (0, 1))
    zero = dict.fromkeys(low, 0)
    sets = [low, high, zero]
    for s in signals:
        corners = {*bounds(s), 0, 1, *([-1] if s.is_signed else []), INVALID.get((message.name, s.name), 0)}
        for other in (low, high, zero):
            sets += [other | {s.name: corner} for corner in corners]
    sets += [{s.name: rng.randint(*bounds(s)) for s in signals} for _ in range(100)]
    return sets


@pytest.mark.parametrize("name", MESSAGES)
def test_no_bit_field_is_put_or_read_elsewhere_than_the_dbc_says(name: str) -> None:
    """GIVEN raw corners, invalid and random values WHEN put and got THEN bytes and values are cantools'."""
    message = of_name(name)
    layouts = {s.name: protocol.layout(name, (s.name,))[0] for s in message.signals}
    for page, signals in pages(message):
        assert signals
        for raws in raw_sets(message, signals):
            values = page | raws
            expected = message.encode(values, scaling=False, strict=False)
            row = np.zeros(frames.FRAME_BYTES, dtype=np.uint8)
            frames.write_header(row, message.frame_id, message.length)
            for signal, raw in values.items():
                start, length, _ = layouts[signal]
                frames.put(row, start, length, raw)
            assert frames.from_row(row) == (message.frame_id, expected), values
            assert not row[frames.DATA + message.length :].any()
            for signal, raw in values.items():
                assert frames.get(row, *layouts[signal]) == raw, (signal, values)
            assert message.decode(expected, decode_choices=False, scaling=False) == values


def test_put_does_not_leave_old_bits_or_touch_its_neighbours() -> None:
    """GIVEN a frame full of ones and of zeros WHEN a field is overwritten THEN only its bits change."""
    message = of_name("TRACKING")
    start, length, _ = protocol.layout("TRACKING", ("SwingError",))[0].tolist()
    mask = ((1 << length) - 1) << start
    for fill in (0x00, 0xFF):
        for raw in (0, -1, 0x5A5A5, -0x2AAAA):
            row = frames.to_row(message.frame_id, bytes([fill] * 8))
            frames.put(row, start, length, raw)
            bits = int.from_bytes(frames.from_row(row)[1], "little")
            assert bits & ~mask == int.from_bytes(bytes([fill] * 8), "little") & ~mask
            assert (bits & mask) >> start == raw & ((1 << length) - 1)


SCALED = [(m.name, s.name) for m in protocol.database().messages for s in m.signals if s.scale != 1]


@pytest.mark.parametrize(("name", "signal_name"), SCALED)
def test_quantise_does_not_round_otherwise_than_cantools(name: str, signal_name: str) -> None:
    """GIVEN physical values in range WHEN quantised THEN the raw integer is the one cantools encodes."""
    message = of_name(name)
    signal = message.get_signal_by_name(signal_name)
    page = next(page for page, signals in pages(message) if signal in signals)
    others = dict.fromkeys((s.name for p, ss in pages(message) if p == page for s in ss), 0)
    low, high = bounds(signal)
    rng = random.Random(signal_name)
    values = [rng.uniform(signal.minimum, signal.maximum) for _ in range(200)]
    values += [raw * signal.scale for raw in (0, 1, low + 1, high - 1, (low + high) // 3)]
    for value in values:
        raw = frames.quantise(value, signal.scale, low, high)
        data = message.encode(others | page | {signal_name: value}, strict=False)
        assert raw == message.decode(data, decode_choices=False, scaling=False)[signal_name], value


def test_quantise_does_not_wrap_or_crash_out_of_range() -> None:
    """GIVEN values beyond the field, infinite or no number WHEN quantised
    THEN the result is inside, at the end.
    """
    step = 2.0**-10
    for value, expected in [
        (1e300, 32767), (np.inf, 32767), (-1e300, -32767), (-np.inf, -32767),
        (32767.4 * step, 32767), (32768 * step, 32767), (-32767.6 * step, -32767),
    ]:  # fmt: skip
        assert frames.quantise(value, step, -32767, 32767) == expected
    assert -32767 <= frames.quantise(np.nan, step, -32767, 32767) <= 32767


def test_quantise_is_not_biased_at_halves() -> None:
    """GIVEN values exactly half way WHEN quantised THEN they go away from zero, to both sides alike."""
    for half in (0.5, 1.5, 2.5, 1000.5):
        assert frames.quantise(half, 1.0, -32767, 32767) == int(half + 0.5)
        assert frames.quantise(-half, 1.0, -32767, 32767) == -int(half + 0.5)


# ---- E2E -----------------------------------------------------------------------------------------


def test_no_process_frame_of_the_dbc_is_without_protection() -> None:
    """GIVEN every frame of 8 bytes but EMCY WHEN looked at
    THEN byte 0 is the CRC, byte 1's low nibble the counter.
    """
    assert len(PROCESS_FRAMES) >= 9
    for name in PROCESS_FRAMES:
        crc, counter = protocol.layout(name, ("E2eCrc", "E2eCounter"))
        assert tuple(crc) == (0, 8, 0) and tuple(counter) == (8, 4, 0), name
        signal = of_name(name).get_signal_by_name("E2eCounter")
        assert (signal.minimum, signal.maximum) == (0, 14), name
    short = [m.name for m in protocol.database().messages if m.name not in PROCESS_FRAMES]
    assert sorted(short) == ["EMCY_ECU", "HEARTBEAT_ECU", "HEARTBEAT_IO", "NMT", "SYNC"]


@pytest.mark.parametrize("name", PROCESS_FRAMES)
def test_protection_does_not_differ_from_autosar(name: str) -> None:
    """GIVEN random data and every counter WHEN protected
    THEN bytes are autosar-e2e's; its check accepts ours.
    """
    can_id = of_name(name).frame_id
    rng = random.Random(name)
    for n in range(300):
        counter = n % 15
        data = rng.randbytes(8)
        row = frames.to_row(can_id, data)
        frames.protect(row, counter)
        ours = bytearray(frames.from_row(row)[1])
        theirs = bytearray(data)
        theirs[1] = theirs[1] & 0xF0 | counter
        e2e_p01.e2e_p01_protect(theirs, can_id, increment_counter=False)
        assert ours == theirs
        assert frames.e2e_crc(can_id, row) == theirs[0]
        assert frames.intact(row) and e2e_p01.e2e_p01_check(ours, can_id)
        assert ours[1] >> 4 == data[1] >> 4 and ours[2:] == data[2:]
        assert not frames.intact(frames.to_row(can_id ^ 0x100, bytes(ours)))


def test_golden_vector_is_not_missed() -> None:
    """GIVEN id 123h, counter 2, bytes 11..66 WHEN protected THEN bytes 0 and 1 are 67 02."""
    row = frames.to_row(0x123, bytes.fromhex("0000112233445566"))
    frames.protect(row, 2)
    assert frames.from_row(row)[1].hex() == "6702112233445566"


def test_flipped_bits_do_not_pass() -> None:
    """GIVEN a protected frame WHEN any 1 or 2 bits, or a burst of 8 behind the CRC, are flipped
    THEN it is refused.
    """
    row = frames.to_row(0x182, bytes.fromhex("00001234567890ab"))
    frames.protect(row, 7)
    good = int.from_bytes(frames.from_row(row)[1], "big")
    patterns = {(1 << a) | (1 << b) for a in range(64) for b in range(a + 1)}
    patterns |= {burst << shift for burst in range(1, 256, 2) for shift in range(49)}
    for pattern in patterns:
        assert not frames.intact(frames.to_row(0x182, (good ^ pattern).to_bytes(8, "big"))), hex(pattern)
    assert frames.intact(frames.to_row(0x182, good.to_bytes(8, "big")))


def test_short_frame_does_not_pass() -> None:
    """GIVEN a frame of 7 bytes with the CRC of its row WHEN checked THEN it is not intact."""
    row = frames.to_row(0x182, bytes(7))
    row[frames.DATA] = frames.e2e_crc(0x182, row)
    assert not frames.intact(row)


def test_firmware_does_not_send_a_frame_that_autosar_refuses(bus_log) -> None:
    """GIVEN a closed loop WHEN each process frame of both sides is checked
    THEN the CRC is right by autosar-e2e.
    """
    ids = {of_name(name).frame_id: name for name in PROCESS_FRAMES}
    seen = defaultdict(int)
    for frame in bus_log:
        if frame.can_id in ids:
            assert len(frame.data) == 8
            assert e2e_p01.e2e_p01_check(bytearray(frame.data), frame.can_id), frame
            seen[ids[frame.can_id]] += 1
    assert set(seen) == set(PROCESS_FRAMES)
    assert min(seen[name] for name in ECU_PROCESS_FRAMES) > 100


def test_firmware_counters_do_not_skip_or_repeat(bus_log) -> None:
    """GIVEN a closed loop WHEN each frame's counter is followed
    THEN it goes 0..14 and round, one step a frame.
    """
    for name in ECU_PROCESS_FRAMES:
        counters = [frame.data[1] & 15 for frame in bus_log if frame.can_id == of_name(name).frame_id]
        assert counters == [n % 15 for n in range(len(counters))], name


def test_sensor_counter_does_not_leave_its_sync(bus_log) -> None:
    """GIVEN a closed loop over the wrap at 240 WHEN sensors answer
    THEN their counter is (SYNC - 1) mod 15.
    """
    sync, seen = 0, set()
    sensors = {of_name(n).frame_id for n in ("ENCODERS", "PRESSURES_SWING", "PRESSURES_WRIST")}
    for frame in bus_log:
        if frame.can_id == protocol.SYNC_ID:
            assert frame.data[0] == sync % 240 + 1
            sync = frame.data[0]
            seen.add(sync)
        elif frame.can_id in sensors:
            assert frame.data[1] & 15 == (sync - 1) % 15
    assert seen == set(range(1, 241))


@pytest.mark.parametrize("name", ["ENCODERS", "PRESSURES_SWING", "PRESSURES_WRIST"])
@pytest.mark.parametrize("fault", ["crc", "counter", "length", "repeated"])
def test_firmware_does_not_take_a_bad_sensor_frame(bench, name: str, fault: str) -> None:
    """GIVEN one bad sensor frame a tick WHEN five have come THEN each is counted; the pages tell how many."""
    ecu = bench()
    ecu.start()
    before = ecu.until("TIMING", ("TimingPage", 2))
    assert before["E2eErrors"] == 0
    ordinary = ecu.sensors

    def spoiled() -> list[np.ndarray]:
        rows = ordinary()
        k = list(ecu.raw).index(name)
        bad = rows[k].copy()
        if fault == "crc":
            bad[frames.DATA] ^= 0x40
        elif fault == "counter":
            frames.protect(bad, (ecu.sync + 3) % 15)
        elif fault == "length":
            bad[4] = 7
        else:
            return [*rows, bad]
        rows[k] = bad
        return rows

    ecu.sensors = spoiled
    for _ in range(5):
        ecu.tick()
    ecu.sensors = ordinary
    after = ecu.until("TIMING", ("TimingPage", 2))
    assert after["E2eErrors"] == 5
    assert after["LostFrames"] - before["LostFrames"] == (0 if fault == "repeated" else 5)
