"""The I/O node: what would make a valve move at another time, on another command, or stay open alone."""

from __future__ import annotations

import copy

import numpy as np
import pytest

from sil_plant.bus import frames, protocol
from sil_plant.inputs.machine import Machine, with_changes
from sil_plant.loop import io_node
from sil_plant.loop.io_node import E2E_REFUSED, SYNC_LOST, TICK, TIMED_OUT, Node, NodeTiming
from sil_plant.plant import dynamics

PERIOD_S = 1e-3
LOAD_KG = 3.0


class Rig:
    """A node with its plant, spoken to in frames."""

    def __init__(self, machine: Machine, **changes: float) -> None:
        machine = with_changes(machine, {f"io.{key}": value for key, value in changes.items()}, "test")
        self.plant = dynamics.plant_parameters(machine)
        self.layout = io_node.node_layout()
        self.timing: NodeTiming = io_node.node_timing(machine, PERIOD_S)
        self.errors = io_node.node_errors(machine)
        y = dynamics.state_at_rest(self.plant, np.array([0.1, 0.2]), LOAD_KG)
        self.node: Node = io_node.make_node(y, LOAD_KG)
        self.counter = 0
        self.out = np.zeros((3, frames.FRAME_BYTES), dtype=np.uint8)

    def sync(self, counter: int, noise: np.ndarray | None = None) -> dict:
        """SYNC; the answer's signals, raw, by frame."""
        chance = np.ones(12)
        chance[:8] = 0.0
        if noise is not None:
            chance[:6] = noise
        rows = io_node.node_sync(
            self.node, self.plant, self.layout, self.timing, self.errors, False, counter, chance, self.out
        )
        assert rows == 3
        answer = {}
        for row in self.out:
            can_id, data = frames.from_row(row)
            message = protocol.database().get_message_by_frame_id(can_id)
            answer[message.name] = message.decode(data, scaling=False, decode_choices=False)
        return answer

    def command(
        self,
        sync: int,
        swing: int = 0,
        wrist: int = 0,
        control: tuple[int, int] = (7, 7),
        counter: int | None = None,
    ) -> np.ndarray:
        """A valve frame, made by cantools."""
        if counter is None:
            self.counter = counter = (self.counter + 1) % 15
        message = protocol.database().get_message_by_name("VALVES")
        raw = {"E2eCrc": 0, "E2eCounter": 0, "Mode": 2, "SwingSpool": swing, "WristSpool": wrist}
        raw |= {"SwingControl": control[0], "WristControl": control[1], "SyncCounter": sync}
        row = frames.to_row(message.frame_id, message.encode(raw, scaling=False, strict=False))
        frames.protect(row, counter)
        return row

    def send(self, row: np.ndarray) -> None:
        io_node.node_frame(self.node, self.layout, row)

    def advance(self, *parts: tuple[tuple[float, float], float]) -> np.ndarray:
        """The plant's present state, moved on by (spools, seconds) each, in a copy."""
        y, work = self.node.y.copy(), np.zeros((5, dynamics.STATES))
        for u, seconds in parts:
            dynamics.integrate(y, np.array(u), self.node.load[0], self.plant, seconds, work)
        return y


@pytest.fixture
def rig(machine: Machine) -> Rig:
    rig = Rig(machine)
    rig.sync(1)
    return rig


# ---- when a command takes effect ------------------------------------------------------------------


@pytest.mark.parametrize("delay_s", [0.0, 0.25e-3, 0.5e-3, 0.9e-3, 1e-3])
def test_command_does_not_take_effect_at_another_time(machine: Machine, delay_s: float) -> None:
    """GIVEN a command for a SYNC WHEN the next SYNC comes
    THEN the old one held up to the delay, the new one after.
    """
    rig = Rig(machine, command_delay_s=delay_s)
    rig.sync(1)
    rig.send(rig.command(1, 4096, -2048))
    first = rig.advance(((0.0, 0.0), delay_s), ((0.25, -0.125), PERIOD_S - delay_s))
    rig.sync(2)
    assert np.array_equal(rig.node.y, first)
    rig.send(rig.command(2, -8192, 1024))
    second = rig.advance(((0.25, -0.125), delay_s), ((-0.5, 0.0625), PERIOD_S - delay_s))
    late = rig.advance(((0.25, -0.125), delay_s + 5e-5), ((-0.5, 0.0625), PERIOD_S - delay_s - 5e-5))
    rig.sync(3)
    assert np.array_equal(rig.node.y, second) and not np.array_equal(rig.node.y, late)


def test_delay_of_the_reference_arm_is_not_another_than_half_a_millisecond(machine: Machine) -> None:
    """GIVEN the reference arm WHEN its node is made
    THEN the delay is 0.5 ms after SYNC, and never beyond a tick.
    """
    assert io_node.node_timing(machine, PERIOD_S).delay_s == 0.5e-3
    assert io_node.node_timing(machine, 0.25e-3).delay_s == 0.25e-3


def test_last_of_two_commands_is_not_forgotten(rig: Rig) -> None:
    """GIVEN two good commands in one tick WHEN it ends THEN the later one counts."""
    rig.send(rig.command(1, 4096, 0))
    rig.send(rig.command(1, 0, 8192))
    rig.sync(2)
    assert rig.node.u[0].tolist() == [0.0, 0.5] and rig.node.count[E2E_REFUSED] == 0


@pytest.mark.parametrize(
    ("control", "expected"),
    [
        ((7, 7), (0.5, -0.25)),
        ((1, 7), (0.0, -0.25)),
        ((7, 1), (0.5, 0.0)),
        ((1, 1), (0.0, 0.0)),
        ((0, 3), (0.0, 0.0)),
        ((15, 6), (0.0, 0.0)),
    ],
)
def test_valve_that_is_not_active_does_not_open(rig: Rig, control, expected) -> None:
    """GIVEN control nibbles WHEN one is not ACTIVE (7)
    THEN that valve is shut, whatever the set-point says.
    """
    rig.send(rig.command(1, 8192, -4096, control))
    rig.sync(2)
    assert tuple(rig.node.u[0]) == expected


@pytest.mark.parametrize(
    ("raw", "u"), [(16384, 1.0), (-16384, -1.0), (32767, 1.0), (-32767, -1.0), (1, 1 / 16384), (0, 0.0)]
)
def test_set_point_does_not_exceed_the_spool(rig: Rig, raw: int, u: float) -> None:
    """GIVEN raw set-points over their 16 bits WHEN sent THEN 16384 is 100 %, and more is no more."""
    rig.send(rig.command(1, raw, 0))
    rig.sync(2)
    assert rig.node.u[0, 0] == u


def test_invalid_set_point_does_not_open_the_valve(rig: Rig) -> None:
    """GIVEN the spool value that means invalid WHEN sent with a good CRC THEN the valve stays shut."""
    rig.send(rig.command(1, -32768, 0))
    rig.sync(2)
    assert rig.node.u[0, 0] == 0.0


# ---- what is refused ------------------------------------------------------------------------------


def spoil_crc(row: np.ndarray) -> None:
    row[frames.DATA + 3] ^= 0x10


def spoil_length(row: np.ndarray) -> None:
    row[4] = 7


def spoil_counter(row: np.ndarray) -> None:
    frames.protect(row, 15)


@pytest.mark.parametrize("spoil", [spoil_crc, spoil_length, spoil_counter])
def test_spoiled_command_is_not_taken(rig: Rig, spoil) -> None:
    """GIVEN a wrong CRC, length, or counter 15 WHEN the frame comes
    THEN it is counted, the valve stays as it was.
    """
    rig.send(rig.command(1, 2048, 2048))
    rig.sync(2)
    row = rig.command(2, -8192, -8192)
    spoil(row)
    expected = rig.advance(((0.125, 0.125), PERIOD_S))
    rig.send(row)
    rig.sync(3)
    assert rig.node.count[E2E_REFUSED] == 1
    assert rig.node.u[0].tolist() == [0.125, 0.125]
    assert np.allclose(rig.node.y, expected, rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("answers", [239, 240, 2, 4, 0, 255])
def test_command_for_another_sync_is_not_taken(rig: Rig, answers: int) -> None:
    """GIVEN SYNC 1, 2, 3 WHEN a command says that it answers another THEN it is counted, not followed."""
    rig.sync(2)
    rig.sync(3)
    rig.send(rig.command(answers, 8192, 8192))
    assert rig.node.count[E2E_REFUSED] == 1
    rig.sync(4)
    assert not rig.node.u.any()
    rig.send(rig.command(4, 8192, 8192))
    rig.sync(5)
    assert rig.node.u[0].tolist() == [0.5, 0.5] and rig.node.count[E2E_REFUSED] == 1


def test_repeated_command_is_not_taken(rig: Rig) -> None:
    """GIVEN a command WHEN another one with the same counter comes
    THEN it is counted, not followed; the next is.
    """
    rig.send(rig.command(1, 4096, 0, counter=0))
    rig.send(rig.command(1, -4096, 0, counter=0))
    rig.sync(2)
    assert rig.node.u[0, 0] == 0.25 and rig.node.count[E2E_REFUSED] == 1
    rig.send(rig.command(2, -4096, 0, counter=1))
    rig.sync(3)
    assert rig.node.u[0, 0] == -0.25 and rig.node.count[E2E_REFUSED] == 1


def test_frames_of_others_are_not_taken_for_commands(rig: Rig) -> None:
    """GIVEN every other frame of the DBC and other ids WHEN they come
    THEN nothing is counted and nothing moves.
    """
    before = copy.deepcopy(rig.node)
    ids = {m.frame_id for m in protocol.database().messages} | {0x203, 0x302, 0x7FF}
    for can_id in ids - {protocol.frame_id("VALVES")}:
        row = rig.command(1, 8192, 8192)
        row[:4] = np.frombuffer(can_id.to_bytes(4, "little"), dtype=np.uint8)
        frames.protect(row, 3)
        rig.send(row)
    assert np.array_equal(before.count, rig.node.count) and np.array_equal(before.u, rig.node.u)


# ---- the node's own watch -------------------------------------------------------------------------


@pytest.mark.parametrize("timeout_s", [0.005, 0.02])
def test_valves_do_not_stay_open_without_commands(machine: Machine, timeout_s: float) -> None:
    """GIVEN an open valve WHEN commands stop
    THEN it is open up to the timeout and shut at most one tick later.
    """
    rig = Rig(machine, valve_timeout_s=timeout_s)
    rig.sync(1)
    rig.send(rig.command(1, 4096, 4096))
    rig.sync(2)  # in effect since 0.5 ms after SYNC 1
    limit = round(timeout_s / PERIOD_S)
    open_ticks = 0
    for tick in range(3, limit + 20):
        rig.sync(tick)
        open_ticks += bool(rig.node.u[0].any())
    assert open_ticks in (limit - 1, limit)
    assert rig.node.count[TIMED_OUT] == 1
    assert np.abs(rig.node.y[dynamics.XV : dynamics.XV + 2]).max() < 1e-3  # the spools did centre
    rig.send(rig.command(limit + 19, 4096, 0))
    rig.sync(limit + 20)
    assert rig.node.u[0].tolist() == [0.25, 0.0]


@pytest.mark.parametrize("kind", ["repeated", "old", "spoiled"])
def test_refused_commands_do_not_keep_the_valves_open(rig: Rig, kind: str) -> None:
    """GIVEN an open valve WHEN only refused commands come THEN the valves close as if there were none."""
    rig.send(rig.command(1, 4096, 4096, counter=3))
    for tick in range(2, 60):
        rig.sync(tick)
        row = rig.command(tick - (kind == "old"), 4096, 4096, counter=3 if kind == "repeated" else None)
        if kind == "spoiled":
            spoil_crc(row)
        rig.send(row)
    assert rig.node.u[0].tolist() == [0.0, 0.0] and rig.node.count[TIMED_OUT] == 1
    assert rig.node.count[E2E_REFUSED] == 58


def test_commands_in_time_do_not_run_into_the_timeout(rig: Rig) -> None:
    """GIVEN a command every 15 ticks WHEN 300 ticks pass THEN the valve never closes."""
    for tick in range(1, 301):
        if tick % 15 == 1:
            rig.send(rig.command((tick - 1) % 240 + 1, 1024, 0))
        rig.sync(tick % 240 + 1)
        assert rig.node.u[0, 0] == 0.0625
    assert rig.node.count[TIMED_OUT] == 0


def test_node_does_not_wait_for_an_ecu_that_died(rig: Rig) -> None:
    """GIVEN SYNC gone with valves open WHEN the node runs on its own clock
    THEN they close after its timeout.
    """
    rig.send(rig.command(1, 8192, 8192))
    for _ in range(rig.timing.timeout_ticks):
        io_node.advance_one_period(rig.node, rig.plant, rig.timing, rig.errors, 0.0)
        assert rig.node.u[0].tolist() == [0.5, 0.5]
    for _ in range(2):
        io_node.advance_one_period(rig.node, rig.plant, rig.timing, rig.errors, 0.0)
    assert rig.node.u[0].tolist() == [0.0, 0.0]


# ---- SYNC -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("counters", "ticks", "lost"),
    [
        ((1, 2, 3), 2, 0),
        ((1, 5), 4, 3),
        ((238, 239, 240, 1, 2), 4, 0),
        ((239, 2), 3, 2),
        ((240, 1), 1, 0),
        ((10, 9), 239, 238),
        ((17,), 0, 0),
    ],
)
def test_missing_sync_does_not_stop_time(machine: Machine, counters, ticks: int, lost: int) -> None:
    """GIVEN SYNC counters with gaps and wraps WHEN they come
    THEN the plant moves on by every tick; gaps are counted.
    """
    rig = Rig(machine)
    rig.node.y[dynamics.W] = 0.2  # something that moves on its own
    reference = rig.node.y.copy()
    for counter in counters:
        rig.sync(counter)
    work = np.zeros((5, dynamics.STATES))
    for _ in range(2 * ticks):
        dynamics.integrate(reference, np.zeros(2), LOAD_KG, rig.plant, PERIOD_S / 2, work)
    assert np.array_equal(rig.node.y, reference)
    assert rig.node.count[TICK] == ticks and rig.node.count[SYNC_LOST] == lost


def test_gap_in_sync_does_not_keep_the_valves_open(rig: Rig) -> None:
    """GIVEN an open valve WHEN 50 SYNC frames are missing
    THEN the valves closed in the gap, after the timeout.
    """
    rig.send(rig.command(1, 4096, 4096))
    rig.sync(2)
    rig.sync(52)
    assert rig.node.u[0].tolist() == [0.0, 0.0] and rig.node.count[SYNC_LOST] == 49
    assert np.abs(rig.node.y[dynamics.XV : dynamics.XV + 2]).max() < 1e-3


# ---- sensors --------------------------------------------------------------------------------------


def test_sensor_frames_are_not_other_than_the_state(rig: Rig) -> None:
    """GIVEN a moving plant and no noise WHEN it samples
    THEN each raw value is the state, rounded to half a step.
    """
    rig.send(rig.command(1, 3000, -2000))
    for tick in range(2, 10):
        answer = rig.sync(tick)
        y = rig.node.y
        step = protocol.scale("ENCODERS", "SwingAngle")
        assert answer["ENCODERS"]["SwingAngle"] == pytest.approx(y[0] / step, abs=0.5 + 1e-6)
        assert answer["ENCODERS"]["WristAngle"] == pytest.approx(y[1] / step, abs=0.5 + 1e-6)
        for joint, name in enumerate(("PRESSURES_SWING", "PRESSURES_WRIST")):
            assert answer[name]["BorePressure"] == pytest.approx(y[4 + 2 * joint] / 500.0, abs=0.5 + 1e-6)
            assert answer[name]["AnnulusPressure"] == pytest.approx(y[5 + 2 * joint] / 500.0, abs=0.5 + 1e-6)
            assert answer[name]["SpoolPosition"] == pytest.approx(y[8 + joint] * 16384.0, abs=0.5 + 1e-6)
            assert answer[name]["SensorStatus"] == 0
    assert abs(answer["PRESSURES_SWING"]["SpoolPosition"]) > 1000


def test_noise_is_not_added_to_the_wrong_sensor(machine: Machine) -> None:
    """GIVEN a known noise per sensor WHEN it samples
    THEN each raw value is off by its own, and the state by nothing.
    """
    plain, noisy = Rig(machine), Rig(machine)
    before = plain.node.y.copy()
    step = protocol.scale("ENCODERS", "SwingAngle")
    noise = np.array([10 * step, -20 * step, 30 * 500.0, -40 * 500.0, 50 * 500.0, -60 * 500.0])
    quiet, loud = plain.sync(1), noisy.sync(1, noise)
    difference = [
        loud[frame][signal] - quiet[frame][signal]
        for frame, signal in [
            ("ENCODERS", "SwingAngle"), ("ENCODERS", "WristAngle"),
            ("PRESSURES_SWING", "BorePressure"), ("PRESSURES_SWING", "AnnulusPressure"),
            ("PRESSURES_WRIST", "BorePressure"), ("PRESSURES_WRIST", "AnnulusPressure"),
        ]
    ]  # fmt: skip
    assert difference == [10, -20, 30, -40, 50, -60]
    assert np.array_equal(noisy.node.y, before)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_sensor_beyond_its_range_does_not_read_as_invalid(rig: Rig, sign: float) -> None:
    """GIVEN a state beyond every sensor's range WHEN it samples
    THEN raw values stop before the invalid one.
    """
    rig.node.count[io_node.SYNC_LAST] = 0  # sample this state, do not move on from it
    rig.node.y[0:2] = sign * 10.0
    rig.node.y[4:8] = sign * 1e9
    rig.node.y[8:10] = sign * 5.0
    answer = rig.sync(1)
    assert answer["ENCODERS"]["SwingAngle"] == answer["ENCODERS"]["WristAngle"] == sign * 8388607
    for name in ("PRESSURES_SWING", "PRESSURES_WRIST"):
        assert answer[name]["BorePressure"] == answer[name]["AnnulusPressure"] == (65534 if sign > 0 else 0)
        assert answer[name]["SpoolPosition"] == sign * 32767


def test_sensor_counter_does_not_answer_another_sync(machine: Machine) -> None:
    """GIVEN every SYNC counter and the wrap WHEN answered
    THEN the E2E counter is (SYNC - 1) mod 15, the CRC right.
    """
    rig = Rig(machine)
    for counter in [*range(1, 241), 1, 2]:
        rig.sync(counter)
        for row in rig.out:
            assert row[frames.DATA + 1] & 15 == (counter - 1) % 15 and frames.intact(row)
