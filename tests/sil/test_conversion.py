"""Physical values: what would make the firmware, the DBC and a user's tool mean different things by
one number.
"""

from __future__ import annotations

import hashlib
import random
import re
import signal as signals
import struct
from collections import Counter, defaultdict
from pathlib import Path

import numpy as np
import pytest

from sil_plant.bus import frames, protocol
from sil_plant.inputs.machine import load_parameter_table, parameter_image
from sil_plant.loop import inproc

ROOT = Path(__file__).resolve().parents[2]
SCALES_H = ROOT / "can_protocol" / "generated" / "diarc_scales.h"
SI = {"bar": 1e5, "%": 0.01, "ms": 1e-3, "us": 1e-6}
PID, DIARC = 0, 2
CYCLES_MS = {  # as docs and tools expect them; the DBC must agree, and so must the ECU
    "SYNC": 1, "ENCODERS": 1, "PRESSURES_SWING": 1, "PRESSURES_WRIST": 1, "VALVES": 1,
    "TRACKING": 5, "ESTIMATE": 10, "PARAMETERS": 10, "TIMING": 10, "HEARTBEAT_ECU": 100, "HEARTBEAT_IO": 100,
}  # fmt: skip
THETA = (
    "m_t_kg J_kgm2 m2_kg fv_swing_Nms_rad fv_wrist_Nms_rad fc_swing_Nm fc_wrist_Nm Om1_swing_Nm Om1_wrist_Nm "
    "beta_inverse_1_Pa Om2_swing_m3_s Om3_swing_m3_s Om2_wrist_m3_s Om3_wrist_m3_s"
).split()


def of_name(name: str):
    return protocol.database().get_message_by_name(name)


def binary32(value: float) -> float:
    return struct.unpack("<f", struct.pack("<f", value))[0]


# ---- the DBC -------------------------------------------------------------------------------------


def test_no_signal_lacks_unit_or_range() -> None:
    """GIVEN every signal WHEN looked at THEN it has a range inside its field, and a unit if it is scaled."""
    for message in protocol.database().messages:
        for signal in message.signals:
            name = f"{message.name}.{signal.name}"
            assert signal.minimum is not None and signal.maximum is not None, name
            assert signal.minimum < signal.maximum and signal.offset == 0, name
            assert signal.unit or signal.scale == 1, f"{name}: scaled, without a unit"
            length, scale = signal.length, signal.scale
            low, high = (-(1 << (length - 1)), (1 << (length - 1)) - 1) if signal.is_signed else (0, (1 << length) - 1)
            slack = 1e-9 * (high - low) * scale
            assert low * scale - slack <= signal.minimum and signal.maximum <= high * scale + slack, name
            if signal.unit and signal.scale != 1 and "Spool" not in name:
                # nothing of the field is given away: no more than the invalid values at its ends
                assert signal.maximum >= (high - 1) * scale - slack, name


def test_firmware_scales_do_not_drift_from_the_dbc() -> None:
    """GIVEN diarc_scales.h WHEN its mantissas and exponents are put together
    THEN they are the DBC's scales in SI.
    """
    found = dict(re.findall(r"#define (DIARC_\w+) \(?([-0-9.e]+)\)?", SCALES_H.read_text("utf-8")))
    checked = 0
    for message in protocol.database().messages:
        for signal in message.signals:
            if signal.scale == 1:
                continue
            snake = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", signal.name)
            name = f"DIARC_{message.name}_{snake}".upper()
            si = signal.scale * SI.get(signal.unit, 1.0)
            for suffix, value in (("STEP", si), ("PER_STEP", 1.0 / si)):
                mantissa = float(found.pop(f"{name}_{suffix}_MANTISSA"))
                exponent = int(found.pop(f"{name}_{suffix}_EXPONENT"))
                assert 0.5 <= mantissa < 1.0 and mantissa * 2.0**exponent == pytest.approx(value, rel=1e-15)
                checked += 1
    assert checked > 80 and not found


# ---- angles --------------------------------------------------------------------------------------


@pytest.mark.parametrize(("scalar", "tolerance"), [("double", 0), ("float", 1)])
def test_angles_do_not_change_on_their_way_through_the_ecu(bench, open_image, scalar: str, tolerance: int) -> None:
    """GIVEN angles on ENCODERS WHEN armed there
    THEN the reference on TRACKING is the same raw value (float: +-1).
    """
    ecu = bench(open_image(), scalar)
    ecu.start()
    rng = random.Random(1)
    top = 2**23 - 1
    pairs = [(0, 1), (-1, 2), (top, -top), (-top, top), (top - 1, 1 - top), (2**22, -(2**22))]
    pairs += [(rng.randint(-top, top), rng.randint(-top, top)) for _ in range(400)]
    encoders, tracking = of_name("ENCODERS"), of_name("TRACKING")
    for swing, wrist in pairs:
        ecu.to_standby()
        ecu.raw["ENCODERS"] = {"SwingAngle": swing, "WristAngle": wrist}
        ecu.run(DIARC)
        sent = [frame for _ in range(10) for frame in ecu.tick()]
        sent_physical = encoders.decode(next(iter(ecu.sensors()))[5:13].tobytes())
        heard = {}
        for can_id, data in sent:
            if can_id == tracking.frame_id:
                raw = tracking.decode(data, scaling=False, decode_choices=False)
                assert raw["Mode"] == 2
                heard |= raw
                physical = tracking.decode(data)
                joint = str(physical["TrackingJoint"]).title()
                assert physical[f"{joint}Reference"] == pytest.approx(
                    sent_physical[f"{joint}Angle"], abs=1.01 * tolerance * 2 * np.pi / 2**24 + 1e-15
                )
        assert abs(heard["SwingReference"] - swing) <= tolerance, (swing, heard)
        assert abs(heard["WristReference"] - wrist) <= tolerance, (wrist, heard)
        assert abs(heard["SwingError"]) <= tolerance and abs(heard["WristError"]) <= tolerance


def test_no_16_bit_word_of_an_angle_is_read_wrongly(bench, open_image) -> None:
    """GIVEN all 65536 low words of an angle, in STANDBY WHEN read back from TRACKING
    THEN each is that of its tick.
    """
    ecu = bench(open_image())
    ecu.start()
    tracking = of_name("TRACKING").frame_id
    starts = protocol.layout("TRACKING", ("SwingReference", "WristReference"))
    assert (starts == [40, 24, 1]).all()  # the same bytes 5..7 for both joints, whichever has its turn
    while tracking not in dict(ecu.tick()):
        pass
    # The reference follows the encoder in STANDBY. TRACKING comes every 5 ticks; 4 in a row may
    # miss their sensors.
    library, pointer = ecu.ecu.library, ecu.ecu.pointer
    sent = np.zeros((inproc.TX_ROWS, frames.FRAME_BYTES), dtype=np.uint8)
    for word in range(65536):
        raw = ((word * 37) % 255 - 127) * 65536 + word
        for _ in range(4):
            library.diarc_inproc_begin(pointer, sent.ctypes.data, inproc.TX_ROWS)
            library.diarc_inproc_end(pointer, sent.ctypes.data, 0, sent.ctypes.data, inproc.TX_ROWS)
        ecu.raw["ENCODERS"] = {"SwingAngle": raw, "WristAngle": raw}
        heard = dict(ecu.tick())[tracking]
        assert heard[1] >> 4 == 1 and int.from_bytes(heard[5:8], "little", signed=True) == raw


# A joint may jump by 30 rad/s times 20 ms: 0.6 rad.
SLOW_PERIOD_US = 20000
SLOW_OBSERVER = {"control.observer_rad_s": 40.0}
JUMP_RAW = 1_500_000


def move_to(ecu, swing: int, wrist: int) -> None:
    """Bring the encoders there in jumps that the rate limit lets pass."""
    raw = ecu.raw["ENCODERS"]
    while (raw["SwingAngle"], raw["WristAngle"]) != (swing, wrist):
        for name, target in (("SwingAngle", swing), ("WristAngle", wrist)):
            step = target - raw[name]
            raw[name] += max(-JUMP_RAW, min(JUMP_RAW, step))
        ecu.tick()


def test_tracking_error_is_not_scaled_or_signed_otherwise_than_the_dbc_says(bench, open_image) -> None:
    """GIVEN an armed joint that is moved away WHEN TRACKING comes
    THEN its error is q - qd in rad, limited at 2^19 - 1.
    """
    ecu = bench(open_image(SLOW_OBSERVER), period_us=SLOW_PERIOD_US)
    ecu.start()
    ecu.run(PID)
    tracking, encoders = of_name("TRACKING"), of_name("ENCODERS")
    step = encoders.get_signal_by_name("SwingAngle").scale
    rng = random.Random(2)
    raws = [1, -1, 3, -3, 1_300_000, -1_300_000, 1_500_000, -1_500_000, 8_388_607, -8_388_607]
    for raw in raws + [rng.randint(-1_390_000, 1_390_000) for _ in range(100)]:
        move_to(ecu, raw, -raw)
        heard = {}
        for _ in range(10):
            for can_id, data in ecu.tick():
                if can_id == tracking.frame_id:
                    heard |= tracking.decode(data)
        limit = tracking.get_signal_by_name("SwingError").maximum
        expected = min(max(raw * step, -limit), limit)
        assert heard["SwingError"] == pytest.approx(expected, abs=0.5001e-6)
        assert heard["WristError"] == pytest.approx(-expected, abs=0.5001e-6)


# ---- valves --------------------------------------------------------------------------------------


def pure_gain(kp: float) -> dict[str, float]:
    """Parameters of a PID that has nothing but its gain."""
    gains = {"pid_kp": kp, "pid_ki": 0.0, "pid_kd": 0.0}
    return {f"control.{j}.{k}": v for j in ("swing", "wrist") for k, v in gains.items()} | SLOW_OBSERVER


@pytest.mark.parametrize("scalar", ["double", "float"])
def test_no_spool_set_point_is_wrong_over_the_whole_range(bench, open_image, scalar: str) -> None:
    """GIVEN a pure gain, swept over all 32769 set-points WHEN sent
    THEN each is there once, and is -kp e in per cent.
    """
    kp = 8.0
    ecu = bench(open_image(pure_gain(kp)), scalar, SLOW_PERIOD_US)
    ecu.start()
    ecu.run(PID)
    valves = of_name("VALVES")
    signal = valves.get_signal_by_name("SwingSpool")
    angle = of_name("ENCODERS").get_signal_by_name("SwingAngle").scale
    per_step = signal.scale / 100.0 / kp / angle  # encoder steps per raw spool step: 20.4
    seen = set()
    # in float the product of an angle may be one rounding beside a half: a quarter step off the
    # middle is safe
    for wanted in range(-16384, 16385):
        ecu.raw["ENCODERS"] = {
            "SwingAngle": -round(wanted * per_step),
            "WristAngle": round(wanted * per_step),
        }
        data = next(data for can_id, data in ecu.tick() if can_id == valves.frame_id)
        swing, wrist = struct.unpack_from("<hh", data, 2)
        assert (swing, wrist) == (wanted, -wanted)
        seen.add(swing)
    assert seen == set(range(-16384, 16385))
    for wanted in (-16384, -16383, -1, 0, 1, 8192, 16383, 16384):  # and that these integers mean per cent
        ecu.raw["ENCODERS"] = {"SwingAngle": -round(wanted * per_step), "WristAngle": 0}
        decoded = ecu.until("VALVES")
        assert decoded["SwingSpool"] == pytest.approx(wanted / 163.84, abs=1e-12)
        assert decoded["SwingControl"] == "ACTIVE"


@pytest.mark.parametrize("angle", [349_526, 2**22, 2**23 - 1])
def test_spool_set_point_does_not_wrap_when_saturated(bench, open_image, angle: int) -> None:
    """GIVEN an error far beyond the gain's range WHEN sent
    THEN both spools are at exactly 100 %, with the right sign.
    """
    ecu = bench(open_image(pure_gain(8.0)), period_us=SLOW_PERIOD_US)
    ecu.start()
    ecu.run(PID)
    move_to(ecu, angle, -angle)
    decoded = ecu.until("VALVES")
    assert (decoded["SwingSpool"], decoded["WristSpool"]) == (-100.0, 100.0)


# ---- moves ---------------------------------------------------------------------------------------


def test_target_of_a_move_is_not_converted_wrongly(bench, open_image) -> None:
    """GIVEN targets over the joint range WHEN moved to THEN the reference ends there, to one encoder step."""
    ecu = bench(open_image())
    ecu.start()
    ecu.run(DIARC)
    step = of_name("MOTION").get_signal_by_name("Target").scale
    rng = random.Random(3)
    targets = [-1.0, 1.2, 0.0] + [rng.uniform(-1.0, 1.2) for _ in range(60)]
    for target in targets:
        raws = [int(target / step), int((0.2 - target) / step)]
        for joint, raw in enumerate(raws):
            ecu.tick([ecu.motion("MOVE", Joint=joint, Target=raw, Duration=20)])
        for k in range(20):
            ecu.raw["ENCODERS"] = {"SwingAngle": k % 2, "WristAngle": k % 2}  # an encoder that stands is stuck
            ecu.tick()
        for joint, name in enumerate(("Swing", "Wrist")):
            heard = ecu.until("TRACKING", ("TrackingJoint", joint))[f"{name}Reference"]
            assert heard == pytest.approx(raws[joint] * step, abs=1.01 * step)
    assert ecu.until("TIMING", ("TimingPage", 3))["RefusedRequests"] == 0


def test_duration_of_a_move_is_not_in_another_unit(bench, open_image) -> None:
    """GIVEN a move of 250 ms at a tick of 0.5 ms WHEN watched THEN Moving is set for 500 ticks."""
    ecu = bench(open_image(), period_us=500)
    ecu.start()
    ecu.run(DIARC)
    ecu.tick([ecu.motion("MOVE", Joint=1, Target=500_000, Duration=250)])
    started = ecu.ticks
    estimates = []
    estimate = of_name("ESTIMATE")
    while ecu.ticks < started + 700:
        for can_id, data in ecu.tick():
            if can_id == estimate.frame_id:
                estimates.append((ecu.ticks - started, estimate.decode(data, decode_choices=False)["Moving"]))
    moving = [tick for tick, flag in estimates if flag]
    assert 480 <= max(moving) <= 500 and all(flag for tick, flag in estimates if tick < 480)
    assert ecu.until("TIMING", ("TimingPage", 3))["PeriodUs"] == 500


@pytest.mark.parametrize(("target", "accepted"), [(1.2 - 1e-6, True), (1.2 + 1e-6, False), (-1.0 - 1e-6, False)])
def test_target_outside_the_joint_range_is_not_taken(bench, target: float, accepted: bool) -> None:
    """GIVEN a target just inside or outside the range WHEN asked for
    THEN it is taken or refused with the reason.
    """
    ecu = bench()
    ecu.start()
    ecu.run(DIARC)
    step = of_name("MOTION").get_signal_by_name("Target").scale
    ecu.tick([ecu.motion("MOVE", Joint=0, Target=round(target / step), Duration=100)])
    page = ecu.until("TIMING", ("TimingPage", 3))
    assert page["RefusedRequests"] == (0 if accepted else 1)
    assert str(page["LastRefusal"]) == ("NONE" if accepted else "TARGET_OUT_OF_RANGE")


# ---- estimates -----------------------------------------------------------------------------------


@pytest.mark.parametrize("scalar", ["double", "float"])
def test_no_parameter_is_sent_under_another_name_or_unit(bench, machine, scalar: str) -> None:
    """GIVEN priors that all differ WHEN PARAMETERS goes round
    THEN each frame has its parameter's value and sd.
    """
    rng = random.Random(4)
    signals = [s for s in of_name("PARAMETERS").signals if s.name.startswith("theta_")]
    assert len(signals) == len(THETA)
    changes, expected = {}, {}
    for k, name in enumerate(THETA):
        stem = f"estimator.prior.{name}"
        low, high = machine[f"{stem}.low"], machine[f"{stem}.high"]
        sd_signal = next(
            s for s in of_name("PARAMETERS").signals if s.name.startswith("sd_") and k in s.multiplexer_ids
        )
        value = binary32(low + (high - low) * rng.uniform(0.1, 0.9))
        sd = binary32(min(sd_signal.maximum, (high - low)) * rng.uniform(0.1, 0.9))
        changes |= {f"{stem}.value": value, f"{stem}.sd": sd}
        expected[k] = value, sd
    ecu = bench(parameter_image(machine, changes), scalar)
    ecu.start()
    for k, (value, sd) in expected.items():
        heard = ecu.until("PARAMETERS", ("Parameter", k))
        for prefix, wanted, slack in (("theta_", value, 1e-5), ("sd_", sd, 2e-3)):
            name = next(n for n in heard if n.startswith(prefix))
            step = of_name("PARAMETERS").get_signal_by_name(name).scale
            assert heard[name] == pytest.approx(wanted, rel=slack, abs=0.51 * step), (THETA[k], name)
    estimate = ecu.until("ESTIMATE")
    assert estimate["Load"] == pytest.approx(expected[0][0], abs=0.51e-4 + 1e-5 * abs(expected[0][0]))
    assert estimate["LoadSd"] == pytest.approx(expected[0][1], rel=2e-3, abs=0.51e-3)


def test_estimated_load_is_not_scaled_wrongly_at_its_bounds(bench, machine) -> None:
    """GIVEN prior loads at, inside and below the bounds WHEN ESTIMATE comes
    THEN kg and LoadAtBound are right.
    """
    for load, at_bound in ((-1.0, 1), (15.0, 1), (-0.9, 0), (14.9999, 0), (0.0, 0), (0.0001, 0)):
        ecu = bench(parameter_image(machine, {"estimator.prior.m_t_kg.value": load}))
        ecu.start()
        heard = ecu.until("ESTIMATE")
        assert heard["Load"] == pytest.approx(load, abs=0.51e-4) and heard["LoadAtBound"] == at_bound


def test_parameter_image_does_not_order_values_otherwise_than_its_table(machine) -> None:
    """GIVEN the reference arm WHEN made into an image
    THEN each binary32 is the value of that row of the table.
    """
    image = parameter_image(machine)
    entries = load_parameter_table().entries
    values = struct.unpack_from(f"<{len(entries)}f", image, 12)
    assert len(image) == 12 + 4 * len(entries) + 4
    for entry, value in zip(entries, values, strict=True):
        assert value == binary32(machine[entry.name]), entry.name


# ---- invalid values ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("frame", "signal", "invalid", "valid"),
    [
        ("ENCODERS", "SwingAngle", -(2**23), 1 - 2**23),
        ("ENCODERS", "WristAngle", -(2**23), 1 - 2**23),
        ("PRESSURES_SWING", "BorePressure", 65535, 65534),
        ("PRESSURES_SWING", "AnnulusPressure", 65535, 65534),
        ("PRESSURES_WRIST", "BorePressure", 65535, 65534),
        ("PRESSURES_WRIST", "AnnulusPressure", 65535, 65534),
        ("PRESSURES_SWING", "SpoolPosition", -(2**15), 1 - 2**15),
        ("PRESSURES_WRIST", "SpoolPosition", -(2**15), 1 - 2**15),
        ("ENCODERS", "SensorStatus", 15, 1),
        ("PRESSURES_SWING", "SensorStatus", 15, 1),
        ("PRESSURES_WRIST", "SensorStatus", 15, 1),
    ],
)
def test_invalid_sensor_value_is_not_taken_for_a_measurement(
    bench, open_image, frame: str, signal: str, invalid: int, valid: int
) -> None:
    """GIVEN RUN WHEN a value is at its field's end
    THEN RUN stays; WHEN it is the invalid one THEN FAULT, valves shut.
    """
    ecu = bench(open_image())
    ecu.start()
    ecu.run(PID)
    ecu.raw[frame][signal] = valid
    if frame == "ENCODERS" and signal != "SensorStatus":
        ecu = bench(open_image())  # armed where the field ends: no arm jumps there
        ecu.raw[frame][signal] = valid
        ecu.start()
        ecu.run(PID)
    for _ in range(20):
        sent = ecu.tick()
    valves = of_name("VALVES")
    assert valves.decode(dict(sent)[valves.frame_id])["Mode"] == "RUN"
    ecu.raw[frame][signal] = invalid
    sent = [f for _ in range(220) for f in ecu.tick()]  # a safe stop, then FAULT
    last = valves.decode([data for can_id, data in sent if can_id == valves.frame_id][-1])
    assert last["Mode"] == "FAULT"
    assert (last["SwingSpool"], last["SwingControl"], last["WristControl"]) == (0, "DISABLED", "DISABLED")
    (emergency,) = (of_name("EMCY_ECU").decode(d) for i, d in sent if i == of_name("EMCY_ECU").frame_id)
    assert emergency["ErrorCode"] == 0x5000
    assert str(ecu.until("TIMING", ("TimingPage", 0))["FaultCode"]) == "SENSOR_INVALID"


# ---- cycle times ---------------------------------------------------------------------------------


def test_no_cyclic_frame_lacks_its_cycle_time_in_the_dbc() -> None:
    """GIVEN the DBC WHEN cycle times are read
    THEN each cyclic frame has the documented one, the others none.
    """
    for message in protocol.database().messages:
        assert (message.cycle_time or 0) == CYCLES_MS.get(message.name, 0), message.name
        assert message.send_type == ("cyclic" if message.name in CYCLES_MS else "event"), message.name


def test_ecu_does_not_send_at_other_times_than_the_dbc_says(bus_log) -> None:
    """GIVEN 1000 ticks of a closed loop WHEN frames are counted
    THEN each cyclic one came in its cycle, evenly.
    """
    names = {m.frame_id: m.name for m in protocol.database().messages}
    ticks = defaultdict(list)
    for frame in bus_log:
        if 200 <= frame.tick < 1200:
            ticks[names[frame.can_id]].append(frame.tick)
    expected = {n: 1000 // ms for n, ms in CYCLES_MS.items()}
    assert {n: len(t) for n, t in ticks.items() if n in CYCLES_MS} == expected
    for name, at in ticks.items():
        if name in CYCLES_MS:
            assert set(np.diff(at).tolist()) == {CYCLES_MS[name]}, name
    assert max(Counter(t for n in ("ESTIMATE", "TRACKING", "PARAMETERS", "TIMING") for t in ticks[n]).values()) == 1


def test_bus_is_not_overloaded_by_its_cyclic_frames() -> None:
    """GIVEN the DBC WHEN the worst case of stuffing is added up by hand
    THEN the rig says the same, below 80 %.
    """
    bits = 0.0
    for message in protocol.database().messages:
        if message.cycle_time:
            stuffable = 34 + 8 * message.length
            bits += (47 + 8 * message.length + (stuffable - 1) // 4) * 1000 / message.cycle_time
    assert protocol.worst_case_bus_load() == pytest.approx(bits / 1e6)
    assert 0.5 < bits / 1e6 < 0.8


# ---- the DBC's hash ------------------------------------------------------------------------------


def test_firmware_does_not_tell_another_dbc_than_this_one(bus_log) -> None:
    """GIVEN TIMING's page 1 WHEN read
    THEN DbcHash is the start of the SHA-256 of the file, line ends as LF.
    """
    timing = of_name("TIMING")
    heard = {
        decoded["DbcHash"]
        for decoded in (timing.decode(f.data, decode_choices=False) for f in bus_log if f.can_id == timing.frame_id)
        if decoded["TimingPage"] == 1
    }
    text = protocol.DBC_PATH.read_bytes().replace(b"\r\n", b"\n")
    assert heard == {protocol.dbc_hash()} == {int(hashlib.sha256(text).hexdigest()[:8], 16)}


def test_line_ends_of_a_checkout_do_not_change_the_hash(tmp_path: Path) -> None:
    """GIVEN the DBC with CR LF WHEN hashed
    THEN it is the same; WHEN one scale is changed THEN it is another.
    """
    text = protocol.DBC_PATH.read_bytes()
    (tmp_path / "crlf.dbc").write_bytes(text.replace(b"\n", b"\r\n"))
    (tmp_path / "changed.dbc").write_bytes(text.replace(b"(0.0001,0)", b"(0.001,0)", 1))
    assert protocol.dbc_hash(tmp_path / "crlf.dbc") == protocol.dbc_hash()
    assert protocol.dbc_hash(tmp_path / "changed.dbc") != protocol.dbc_hash()


def test_ecu_of_another_dbc_is_not_run(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """GIVEN a DBC that was changed after the build WHEN run
    THEN status 2 and one line with both hashes and the cure.
    """
    import sys

    monkeypatch.setattr(sys, "path", list(sys.path))
    from sil_plant import run

    real = protocol.dbc_hash()
    other = real ^ 0x00FF00FF
    before = signals.getsignal(signals.SIGTERM)
    try:
        assert run.main(["--bus", "inproc", "--duration", "0.5", "--quiet"]) == 0
        capsys.readouterr()
        monkeypatch.setattr(protocol, "dbc_hash", lambda *_: other)
        assert run.main(["--bus", "inproc", "--duration", "0.5", "--quiet"]) == 2
    finally:
        signals.signal(signals.SIGTERM, before)
    said = capsys.readouterr()
    assert said.err.count("\n") == 1
    for part in (f"{real:08X}", f"{other:08X}", "diarc.dbc", "make firmware"):
        assert part in said.err
