"""Faults on purpose do to frames, sensors and plant what they say, and nothing else: the rig's side, whatever the
ECU makes of it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from sil_plant.bus import frames, protocol
from sil_plant.experiments import experiment
from sil_plant.inputs.faults import FRAMES, KINDS, SENSORS, Fault
from sil_plant.inputs.machine import Machine
from sil_plant.inputs.scenario import Scenario, load_profile
from sil_plant.loop import inproc, session
from sil_plant.loop.injection import SUPPLY_SHARE, draw

START_S, DURATION_S = 0.30, 0.05
BEGIN, END = 400, 450  # ticks of the run: 0.1 s of standstill come first
RUN_S = 0.6
SENSOR_FRAMES = ("ENCODERS", "PRESSURES_SWING", "PRESSURES_WRIST")


class Observed:
    """A closed loop with every frame that reached the ECU, by tick."""

    def __init__(self, machine: Machine, scenario: Scenario, image: bytes) -> None:
        self.run = run = session.make_session(machine, scenario, "diarc", 1, 1e-3)
        self.to_ecu: list[list[tuple[int, bytes]]] = []
        self.from_ecu: list[list[tuple[int, bytes]]] = []
        ecu = inproc.InprocEcu(image)
        out = np.zeros((session.OUT_ROWS, frames.FRAME_BYTES), dtype=np.uint8)
        for tick in range(len(run.noise)):
            sent = ecu.tick_begin()
            rows = 0
            for row in sent:
                if frames.frame_id(row) == protocol.SYNC_ID:
                    rows = session.on_sync(run, int(row[frames.DATA]), out)
            answers = out[:rows].copy()
            self.to_ecu.append([frames.from_row(row) for row in answers])
            rest = ecu.tick_end(answers)
            for row in rest:
                session.on_frame(run, row)
            self.from_ecu.append([frames.from_row(row) for row in [*sent, *rest]])
            assert run.progress.index[session.TICK] == tick + 1

    def raw(self, name: str, signal: str, tick: int) -> int:
        """A raw value as it reached the ECU."""
        message = protocol.database().get_message_by_name(name)
        data = next(data for can_id, data in self.to_ecu[tick] if can_id == message.frame_id)
        return int(message.decode(data, decode_choices=False, scaling=False)[signal])


@pytest.fixture(scope="module")
def observe(machine: Machine, image: bytes, paper: Scenario) -> Callable[..., Observed]:
    """``observe(kind, target, size)``: 0.6 s of the paper's benchmark with one fault from 0.3 s to 0.35 s."""

    def run(kind: str = "", target: str = "", size: float = 0.0, duration_s: float = DURATION_S) -> Observed:
        faults = (Fault(kind, target, START_S, duration_s, size),) if kind else ()
        return Observed(machine, replace(paper, duration_s=RUN_S, faults=faults), image)

    return run


@pytest.fixture(scope="module")
def quiet(observe) -> Observed:
    """The same run undisturbed."""
    return observe()


def of(log: list[tuple[int, bytes]], name: str) -> list[bytes]:
    """The frames of a tick by name."""
    can_id = protocol.frame_id(name)
    return [data for i, data in log if i == can_id]


def counter(data: bytes) -> int:
    return data[1] & 0x0F


def is_intact(name: str, data: bytes) -> bool:
    return bool(frames.intact(frames.to_row(protocol.frame_id(name), data)))


def test_fault_does_not_reach_beyond_its_time(observe, quiet: Observed) -> None:
    """GIVEN a fault from 0.30 to 0.35 s WHEN run THEN all frames before are those of the undisturbed run."""
    for kind, target, size in (("dropped", "sensors", 1.0), ("noisy", "swing_bore", 1e5), ("sync_jitter", "", 1e-4)):
        found = observe(kind, target, size)
        assert found.to_ecu[:BEGIN] == quiet.to_ecu[:BEGIN]
        assert found.to_ecu[BEGIN:END] != quiet.to_ecu[BEGIN:END]
        lengths = [len(log) for log in found.to_ecu[END:]]
        assert lengths == [len(log) for log in quiet.to_ecu[END:]]


@pytest.mark.parametrize("name", SENSOR_FRAMES)
def test_dropped_frame_does_not_arrive(observe, name: str) -> None:
    """GIVEN one sensor frame dropped WHEN run THEN it alone is missing, and only then."""
    found = observe("dropped", name.lower(), 1.0)
    for tick, log in enumerate(found.to_ecu):
        assert len(of(log, name)) == (0 if BEGIN <= tick < END else 1), tick
        assert all(len(of(log, other)) == 1 for other in SENSOR_FRAMES if other != name)


def test_share_of_dropped_frames_does_not_drift(observe) -> None:
    """GIVEN 10 % of the sensor frames dropped for 0.3 s WHEN counted THEN it is about that, of 900."""
    found = observe("dropped", "sensors", 0.1, 0.3)
    arrived = sum(len(of(log, name)) for log in found.to_ecu[BEGIN:] for name in SENSOR_FRAMES)
    assert 60 <= 900 + 3 - arrived <= 120


def test_delayed_frame_does_not_lose_its_content(observe) -> None:
    """GIVEN encoders delayed by 3 ms WHEN run THEN each arrives intact three ticks late."""
    found = observe("delayed", "encoders", 3)
    for tick in range(BEGIN, END + 3):
        arrived = [counter(data) for data in of(found.to_ecu[tick], "ENCODERS")]
        expected = [(tick - 3) % 15] if tick >= BEGIN + 3 else []
        expected += [tick % 15] if tick >= END else []
        assert arrived == expected, tick


def test_repeated_frame_does_not_differ_from_the_first(observe) -> None:
    """GIVEN encoders sent three times WHEN run THEN three equal frames a tick."""
    found = observe("repeated", "encoders", 2)
    for tick in range(BEGIN, END):
        data = of(found.to_ecu[tick], "ENCODERS")
        assert len(data) == 3 and len(set(data)) == 1


def test_reordered_frames_do_not_get_lost(observe) -> None:
    """GIVEN encoders reordered WHEN run THEN every second one comes after the one that follows it."""
    found = observe("reordered", "encoders")
    arrived = [counter(data) for log in found.to_ecu[BEGIN:END] for data in of(log, "ENCODERS")]
    pairs = [[(tick + 1) % 15, tick % 15] for tick in range(BEGIN, END, 2)]
    assert arrived == [c for pair in pairs for c in pair]


@pytest.mark.parametrize("bits", [1, 3, 8, 64])
def test_corrupted_frame_does_not_have_another_number_of_wrong_bits(observe, bits: int) -> None:
    """GIVEN bits flipped WHEN compared with the monitor's E2E THEN so many differ; a few never pass the CRC."""
    found = observe("corrupted", "pressures_wrist", bits)
    clean = observe("repeated", "pressures_wrist", 1)  # the ECU takes the first: nothing differs
    first = of(found.to_ecu[BEGIN], "PRESSURES_WRIST")[0]
    original = of(clean.to_ecu[BEGIN], "PRESSURES_WRIST")[0]
    flipped = int.from_bytes(first, "little") ^ int.from_bytes(original, "little")
    assert flipped.bit_count() == bits
    if bits <= 3:
        arrived = [data for log in found.to_ecu[BEGIN:END] for data in of(log, "PRESSURES_WRIST")]
        assert len(arrived) == 50 and not any(is_intact("PRESSURES_WRIST", data) for data in arrived)


@pytest.mark.parametrize("length", [0, 7])
def test_wrong_length_does_not_arrive_as_eight(observe, length: int) -> None:
    """GIVEN a wrong length WHEN run THEN the frames have it."""
    found = observe("wrong_length", "encoders", length)
    assert {len(data) for log in found.to_ecu[BEGIN:END] for data in of(log, "ENCODERS")} == {length}


def test_foreign_id_does_not_arrive_as_ours(observe) -> None:
    """GIVEN encoders under another identifier WHEN run THEN 50 of these and no ENCODERS."""
    found = observe("foreign_id", "encoders", 0x555)
    logs = found.to_ecu[BEGIN:END]
    assert sum(can_id == 0x555 for log in logs for can_id, _ in log) == 50
    assert not any(of(log, "ENCODERS") for log in logs)


@pytest.mark.parametrize("back", [1, 14])
def test_old_counter_does_not_have_a_wrong_crc(observe, back: int) -> None:
    """GIVEN an old counter WHEN run THEN it is that, and the CRC is right."""
    found = observe("old_counter", "encoders", back)
    for tick in range(BEGIN, END):
        (data,) = of(found.to_ecu[tick], "ENCODERS")
        assert counter(data) == (tick - back) % 15 and is_intact("ENCODERS", data)


SIGNALS = {
    "swing_angle": ("ENCODERS", "SwingAngle"),
    "wrist_angle": ("ENCODERS", "WristAngle"),
    "swing_bore": ("PRESSURES_SWING", "BorePressure"),
    "swing_annulus": ("PRESSURES_SWING", "AnnulusPressure"),
    "wrist_bore": ("PRESSURES_WRIST", "BorePressure"),
    "wrist_annulus": ("PRESSURES_WRIST", "AnnulusPressure"),
    "swing_spool": ("PRESSURES_SWING", "SpoolPosition"),
    "wrist_spool": ("PRESSURES_WRIST", "SpoolPosition"),
}
STEP = {"angle": 3.7450702829239286e-07, "bore": 500.0, "annulus": 500.0, "spool": 6.103515625e-05}


def others_of(found: Observed, name: str, signal: str, tick: int) -> list[int]:
    return [found.raw(n, s, tick) for n, s in SIGNALS.values() if (n, s) != (name, signal)]


@pytest.mark.parametrize("sensor", SENSORS)
def test_sensor_fault_does_not_strike_another_sensor(observe, quiet: Observed, sensor: str) -> None:
    """GIVEN each sensor stuck, biased, noisy, spiked, invalid WHEN run
    THEN its value shows it, all others are untouched in the first tick, and every frame is intact.
    """
    name, signal = SIGNALS[sensor]
    step = STEP[sensor.rpartition("_")[2]]
    true = quiet.raw(name, signal, BEGIN)
    size = 2000 * step
    for kind in ("stuck", "biased", "spiked", "noisy", "invalid"):
        found = observe(kind, sensor, 0.0 if kind in ("stuck", "invalid") else size)
        assert others_of(found, name, signal, BEGIN) == others_of(quiet, name, signal, BEGIN)
        values = [found.raw(name, signal, tick) for tick in range(BEGIN, END)]
        assert all(is_intact(name, data) for log in found.to_ecu[BEGIN:END] for data in of(log, name))
        if kind == "stuck":
            assert set(values) == {true}
        elif kind == "biased":
            assert values[0] - true == 2000
        elif kind == "invalid":
            assert set(values) == {{"angle": -(2**23), "spool": -(2**15)}.get(sensor.rpartition("_")[2], 65535)}
        elif kind == "noisy":
            assert 0 < abs(values[0] - true) <= 2000 and len(set(values)) > 25
        else:
            jumps = np.abs(np.diff(values)) > 1500
            assert 1 <= np.count_nonzero(jumps) <= 25


def test_sync_jitter_does_not_shift_time_for_good(observe, quiet: Observed) -> None:
    """GIVEN SYNC jitter of 0.3 ms WHEN the swing moves THEN its angle is off by at most rate times jitter, and no more
    once it is over.
    """
    found = observe("sync_jitter", "", 3e-4)
    a, b = found.run.record.state[:, 0], quiet.run.record.state[:, 0]
    fastest = np.abs(quiet.run.record.state[:, 2]).max()
    inside = np.abs(a - b)[BEGIN:END]
    assert 0.0 < inside.max() <= 1.2 * 3e-4 * fastest
    assert np.abs(a - b)[END + 50 :].max() < 0.2 * inside.max() + 1e-5


@pytest.mark.parametrize(
    ("kind", "size"),
    [("dropped", 1.0), ("delayed", 1), ("corrupted", 1), ("wrong_length", 7), ("foreign_id", 1365), ("old_counter", 3)],
)
def test_disturbed_valve_frame_does_not_move_a_valve(observe, kind: str, size: float) -> None:
    """GIVEN valve frames that are late, wrong or old WHEN 20 ticks have passed THEN the node has shut the valves."""
    found = observe(kind, "valves", size)
    effect = found.run.record.valves[:, :2]
    assert np.any(effect[BEGIN] != 0.0) and not np.any(effect[BEGIN + 22 : END])
    assert np.any(effect[END + 5] != 0.0)


@pytest.mark.parametrize("kind", ["repeated", "reordered"])
def test_valve_frames_twice_or_out_of_order_do_not_close_a_valve(observe, kind: str) -> None:
    """GIVEN valve frames repeated, or every second one late WHEN run THEN the valves stay in use."""
    found = observe(kind, "valves", 1)
    assert np.all(np.any(found.run.record.valves[:, :2][BEGIN:END] != 0.0, axis=1))


def test_supply_does_not_fall_faster_than_its_time_constant(observe) -> None:
    """GIVEN a supply that falls with 20 ms WHEN 50 ms have passed THEN the pressures have followed it; it comes
    back when the fault is over.
    """
    found = observe("supply_lost", "", 0.02)
    before, after = found.run.record.state[BEGIN, 4:8].sum(), found.run.record.state[END, 4:8].sum()
    assert after < 0.8 * before
    assert found.run.injection.number[SUPPLY_SHARE] == pytest.approx(1.0, abs=1e-3)  # it comes back as it went


def test_load_does_not_stay_when_dropped(observe, quiet: Observed) -> None:
    """GIVEN the load dropped to 1 kg WHEN run THEN the record has 1 kg for that time and 3 kg else."""
    load = observe("load_dropped", "", 1.0).run.record.load_true
    assert set(load[BEGIN:END]) == {1.0} and set(load[:BEGIN]) == set(load[END:]) == {3.0}


def test_killed_node_does_not_answer_nor_hold_its_valves(observe) -> None:
    """GIVEN the node killed WHEN run THEN no sensor frame comes, the valves are centred, and it answers afterwards."""
    found = observe("node_killed")
    assert not any(of(log, name) for log in found.to_ecu[BEGIN:END] for name in SENSOR_FRAMES)
    assert not np.any(found.run.record.valves[:, :2][BEGIN + 1 : END])
    assert all(len(of(log, "ENCODERS")) == 1 for log in found.to_ecu[END:])


def test_second_ecu_does_not_stay_silent(observe) -> None:
    """GIVEN a second ECU WHEN run THEN its boot-up, and an intact valve frame of the present SYNC every tick."""
    found = observe("second_ecu")
    assert (protocol.frame_id("HEARTBEAT_ECU"), b"\0") in found.to_ecu[BEGIN]
    for tick in range(BEGIN, END):
        (data,) = of(found.to_ecu[tick], "VALVES")
        assert is_intact("VALVES", data) and data[7] == tick % 240 + 1


@pytest.mark.parametrize(
    ("kind", "frame"),
    [
        ("nmt_stop", (0, bytes((2, 1)))),
        ("nmt_reset", (0, bytes((129, 1)))),
        ("dbc_mismatch", (0x601, bytes((0x23, 0x02, 0x20, 0)) + (protocol.dbc_hash() ^ 1).to_bytes(4, "little"))),
    ],
)
def test_single_event_does_not_come_twice(observe, kind: str, frame: tuple[int, bytes]) -> None:
    """GIVEN an event WHEN run THEN its frame, once, at its time."""
    logs = observe(kind, duration_s=0.0).to_ecu
    assert [tick for tick, log in enumerate(logs) if frame in log] == [BEGIN]


@pytest.mark.parametrize("share", [0.25, 1.0])
def test_foreign_traffic_of_lower_priority_does_not_cost_a_frame(observe, quiet: Observed, share: float) -> None:
    """GIVEN foreign frames of lower priority WHEN run THEN ours all arrive, and no more foreign ones than the bus has
    room for.
    """
    logs = observe("alien_traffic", "lower_priority", share).to_ecu[BEGIN:END]
    ours = {message.frame_id for message in protocol.database().messages}
    foreign = [frame for log in logs for frame in log if frame[0] not in ours]
    bits = sum(protocol.worst_case_bits(len(data)) for _, data in foreign)
    assert 0.15 < bits / 50_000 < 0.3 and all(can_id >= 0x703 for can_id, _ in foreign)
    assert all(len(of(log, name)) == 1 for log in logs for name in SENSOR_FRAMES)


def test_foreign_traffic_of_higher_priority_does_not_leave_more_than_the_rest(observe) -> None:
    """GIVEN 60 % of the bus taken by higher priority WHEN run
    THEN two of our frames fit into a tick, and those that do not come in the next.
    """
    logs = observe("alien_traffic", "higher_priority", 0.6).to_ecu[BEGIN + 2 : END]
    bits = sum(protocol.worst_case_bits(len(data)) for log in logs for can_id, data in log if can_id < 0x80)
    assert 0.5 < bits / (1000 * len(logs)) <= 0.62
    late = [counter(data) != (BEGIN + 2 + k) % 15 for k, log in enumerate(logs) for data in of(log, "PRESSURES_WRIST")]
    assert late and all(late)


@pytest.fixture(scope="module")
def closed_loop(machine: Machine, paper: Scenario) -> Callable[..., experiment.Outcome]:
    """``closed_loop(kind, target, size, seed=...)``: the compiled loop, 1.5 s with one fault from 0.7 to 0.8 s."""

    def run(kind: str = "", target: str = "", size: float = 0.0, seed: int = 1, **options) -> experiment.Outcome:
        faults = (Fault(kind, target, 0.7, 0.1, size, options.get("recover_after_s")),) if kind else ()
        scenario = replace(paper, duration_s=1.5, faults=faults)
        profile = load_profile("realistic" if options.get("realistic") else "paper")
        return experiment.simulate(experiment.setup_for(machine, profile, scenario, seed=seed))

    return run


def some_target(kind: str) -> tuple[str, float]:
    targets = KINDS[kind].targets
    sizes = {"delayed": 3.0, "sync_jitter": 2e-4, "biased": 1e5, "spiked": 1e5, "noisy": 1e5}
    target = "swing_bore" if targets == SENSORS else targets[0] if targets else ""
    return target, sizes.get(kind, KINDS[kind].default or 0.0)


@pytest.mark.parametrize("kind", KINDS)
def test_fault_does_not_differ_when_run_again(closed_loop, kind: str) -> None:
    """GIVEN every kind of fault WHEN run twice THEN the same trace, to the last bit, and not that of another seed."""
    target, size = some_target(kind)
    once, again = (closed_loop(kind, target, size, realistic=True) for _ in range(2))
    other = closed_loop(kind, target, size, seed=2, realistic=True)
    assert once.result.trace_sha256 == again.result.trace_sha256 != other.result.trace_sha256
    assert np.array_equal(once.session.record.mode, again.session.record.mode)
    assert once.result.ticks == len(once.session.noise)


def test_list_of_faults_does_not_change_a_run_in_which_none_strikes(closed_loop) -> None:
    """GIVEN a fault of size 0 WHEN run THEN the trace is that of a run without faults, on both profiles."""
    for realistic in (False, True):
        plain = closed_loop(realistic=realistic).result.trace_sha256
        assert closed_loop("dropped", "sensors", 0.0, realistic=realistic).result.trace_sha256 == plain
        assert closed_loop("alien_traffic", "lower_priority", 1.0, realistic=realistic).result.trace_sha256 == plain


def test_full_send_queue_does_not_go_uncounted(closed_loop) -> None:
    """GIVEN a driver that takes one frame a tick WHEN run THEN the ECU counts what it could not send."""
    found = closed_loop("send_queue_full", "", 1.0)
    assert found.session.monitor.whole[session.SEND_DROPS] >= 100


@pytest.mark.parametrize("kind", ["bus_off", "ecu_killed", "send_queue_full"])
def test_silent_ecu_does_not_keep_its_valves_open(closed_loop, kind: str) -> None:
    """GIVEN no frame from the ECU WHEN the node's 20 ms are over THEN its valves are shut and time goes on."""
    found = closed_loop(kind)
    effect, state = found.session.record.valves[:, :2], found.session.record.state
    assert np.any(effect[800] != 0.0) and not np.any(effect[800 + 22 : 900])
    assert np.any(state[805] != state[804])


def test_killed_ecu_does_not_come_back_by_itself(closed_loop) -> None:
    """GIVEN the ECU killed WHEN it is back THEN it waits in INIT; the master brings it to RUN where it is asked to."""
    alone, helped = closed_loop("ecu_killed"), closed_loop("ecu_killed", recover_after_s=0.1)
    whole = alone.session.monitor.whole
    assert (whole[session.MODE], whole[session.REBOOTS]) == (session.MODE_INIT, 1)
    assert helped.session.monitor.whole[session.MODE] == session.MODE_RUN


def test_chance_does_not_repeat_itself() -> None:
    """GIVEN draws by fault, tick and place WHEN drawn THEN spread evenly, and all different."""
    values = [draw(1, n, tick, k) for n in range(3) for tick in range(500) for k in range(4)]
    assert len(set(values)) == len(values)
    assert 0.48 < np.mean(values) < 0.52 and 0.27 < np.std(values) < 0.31


def test_every_frame_a_fault_may_strike_is_in_the_dbc() -> None:
    """GIVEN the names of frames WHEN looked up THEN the DBC has them."""
    assert [protocol.frame_id(name.upper()) for name in FRAMES]
