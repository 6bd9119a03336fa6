"""The watch behind monitor and doctor: what would make it show something else than what is on the bus."""

from __future__ import annotations

import json
import math
import random
from collections.abc import Callable
from dataclasses import replace

import pytest

from sil_plant.bus import e2e, frames, protocol
from sil_plant.bus.fault_table import fault_text, fault_texts
from sil_plant.bus.ports import parse_bus
from sil_plant.loop import session
from sil_plant.monitoring.diagnosis import Evidence, diagnose
from sil_plant.monitoring.host import LinkFacts, RealtimeFacts, can_interfaces, link_facts
from sil_plant.monitoring.view import Place, one_line, page, silence
from sil_plant.monitoring.watch import STALE_S, Snapshot, Watch

Frame = tuple[int, bytes]
PERIOD_S = 1e-3


class Bus:
    """An ECU on the bench whose bus a watch listens to."""

    def __init__(self, bench: Callable, image: bytes | None = None) -> None:
        self.bench = bench(image)
        self.now_s = 100.0
        self.watch = Watch(self.now_s)

    def hear(self, sent: list[Frame]) -> None:
        for can_id, data in sent:
            self.watch.take(can_id, data, self.now_s)

    def tick(self, count: int = 1, *, extra: list | None = None, sensors: bool = True) -> None:
        """Ticks whose frames are heard, those of sensors and master too."""
        for _ in range(count):
            self.now_s += PERIOD_S
            sent = self.bench.tick(extra or [], None if sensors else [])
            answers = self.bench.sensors() if sensors else []
            sent[1:1] = [frames.from_row(row) for row in [*answers, *(extra or [])]]
            self.hear(sent)
            if self.bench.ticks % 100 == 0 and sensors:
                self.hear([(0x702, b"\x05")])
            extra = None

    def start(self) -> None:
        self.tick(extra=[session.nmt_frame(session.NMT_START)])
        self.tick(200)

    def state(self) -> Snapshot:
        return self.watch.snapshot(self.now_s)


@pytest.fixture
def bus(bench, open_image) -> Bus:
    """An ECU in STANDBY, watched from its boot on."""
    started = Bus(bench, open_image())
    started.start()
    return started


def told(name: str, raw: dict[str, int], counter: int = 0) -> Frame:
    """A frame from raw integers, protected where the DBC says so."""
    message = protocol.database().get_message_by_name(name)
    needed = {s.name for s in message.signals if not s.multiplexer_ids}
    mux = next((s for s in message.signals if s.is_multiplexer), None)
    if mux is not None:
        needed |= {s.name for s in message.signals if s.multiplexer_ids and raw[mux.name] in s.multiplexer_ids}
    values = dict.fromkeys(needed, 0) | raw
    data = message.encode(values, scaling=False, strict=False)
    if "E2eCrc" not in needed:
        return message.frame_id, bytes(data)
    row = frames.to_row(message.frame_id, data)
    frames.protect(row, counter)
    return frames.from_row(row)


# ---- what is told ----------------------------------------------------------------------------------


def test_mode_and_nodes_are_not_made_up(bus: Bus) -> None:
    """GIVEN an ECU in STANDBY WHEN watched THEN mode, nodes, DBC and counters are its own."""
    state = bus.state()
    assert (state.mode, state.ecu.nmt, state.io_node.nmt) == ("STANDBY", "OPERATIONAL", "OPERATIONAL")
    assert state.ecu.alive and state.io_node.alive and not state.silent
    assert state.ecu.boots == 1 and not state.ecu.doubled and not state.io_node.doubled
    assert state.dbc_match is True and state.dbc_hash_heard == protocol.dbc_hash()
    assert state.timing["PeriodUs"] == 1000 and state.timing["LastRefusal"] == "NONE"
    assert state.faults == () and state.faults_complete and not state.unknown
    assert state.joints["swing"].bore_bar == pytest.approx(40.0)
    assert state.joints["wrist"].annulus_bar == pytest.approx(55.0)
    assert state.joints["swing"].enabled is False and state.joints["swing"].sensor_status == "GOOD"
    assert "theta" not in "".join(state.parameters) and len(state.parameters) == 14
    assert all(kind.corrupt == kind.skipped == 0 for kind in state.frames.values())


def test_bus_load_is_not_another_than_the_plants(bus: Bus) -> None:
    """GIVEN all frames at their cycles WHEN watched for a second THEN load and rates are those of the DBC."""
    bus.tick(1000)
    bus.state()
    bus.tick(1000)
    state = bus.state()
    assert state.bus_load == pytest.approx(protocol.worst_case_bus_load(), rel=0.01)
    for kind in state.frames.values():
        if kind.expected_hz:
            assert kind.rate_hz == pytest.approx(kind.expected_hz, rel=0.11), kind


def test_mode_change_is_not_missed(bus: Bus) -> None:
    """GIVEN STANDBY WHEN RUN and STANDBY are asked for THEN modes, requests and events say so."""
    bus.tick(extra=[bus.bench.motion("RUN", Controller=2)])
    bus.tick(20)
    assert bus.state().mode == "RUN" and bus.state().request == "request RUN with DIARC"
    texts = [event.text for event in bus.state().events]
    assert "mode STANDBY -> RUN" in texts and "ECU booted" in texts
    assert bus.state().joints["swing"].enabled and bus.state().joints["swing"].error_rad is not None


def test_stopped_ecu_is_not_shown_in_its_last_mode(bus: Bus) -> None:
    """GIVEN STANDBY WHEN the network is stopped THEN no mode is told, and its NMT state is."""
    bus.tick(extra=[session.nmt_frame(session.NMT_STOP)])
    bus.tick(150)
    assert bus.state().mode is None and bus.state().ecu.nmt == "STOPPED" and bus.state().ecu.alive


def test_refused_request_is_not_a_riddle(bus: Bus) -> None:
    """GIVEN STANDBY WHEN a MOVE is asked for THEN counter, rise and reason are there."""
    bus.tick(extra=[bus.bench.motion("MOVE", Duration=1000)])
    bus.tick(60)
    state = bus.state()
    assert (state.timing["RefusedRequests"], state.timing_rise["RefusedRequests"]) == (1, 1)
    assert state.timing["LastRefusal"] == "NOT_IN_RUN"


def test_silence_is_not_shown_as_news(bus: Bus) -> None:
    """GIVEN values on the page WHEN nothing comes any more THEN they go, and the silence has its time."""
    assert bus.state().load.kg is not None
    bus.now_s += STALE_S + 0.1
    state = bus.state()
    assert state.silent and state.silent_s == pytest.approx(STALE_S + 0.1)
    assert state.load.kg is None and state.mode is None and not state.ecu.alive
    assert state.joints["swing"].angle_rad is None and state.timing == {}
    place = Place("vcan0", "", 1000.0)
    assert silence(state, place).startswith(f"no frames since {place.clock(STALE_S + 0.1)}")
    assert state.events[0].text in ("ECU fell silent", "I/O node fell silent")


def test_restarted_ecu_does_not_keep_the_old_ones_values(bus: Bus) -> None:
    """GIVEN an ECU in STANDBY WHEN it boots again THEN mode, load and counters are gone until it tells them."""
    bus.hear([(0x701, b"\0")])
    state = bus.state()
    assert state.mode is None and state.load.kg is None and state.timing == {} and state.ecu.boots == 2


def test_invalid_values_are_not_shown_as_numbers(bus: Bus) -> None:
    """GIVEN raw values that mean invalid WHEN watched THEN there is no number."""
    bus.hear([told("ENCODERS", {"SwingAngle": -(1 << 23), "SensorStatus": 15})])
    bus.hear([told("PRESSURES_WRIST", {"BorePressure": 65535, "SpoolPosition": -32768, "SensorStatus": 15})])
    state = bus.state()
    assert state.joints["swing"].angle_rad is None and state.joints["wrist"].angle_rad == 0.0
    wrist = state.joints["wrist"]
    assert (wrist.bore_bar, wrist.spool_percent, wrist.sensor_status) == (None, None, "INVALID")


# ---- load ------------------------------------------------------------------------------------------


def test_trend_of_the_load_is_not_upside_down(bus: Bus) -> None:
    """GIVEN estimates that rise by 0.5 kg/s WHEN watched THEN that is the trend; negative loads are no giants."""
    for k in range(150):
        bus.now_s += 0.01
        bus.hear([told("ESTIMATE", {"Load": -10000 + 50 * k, "LoadSd": 12, "Mode": 2}, k % 15)])
    state = bus.state()
    assert state.load.trend_kg_s == pytest.approx(0.5, rel=1e-6)
    assert state.load.kg == pytest.approx(-1.0 + 0.005 * 149) and state.load.sd_kg == pytest.approx(0.012)
    trace = [value for value in bus.watch.load_trace(bus.now_s, 30) if value is not None]
    assert trace == sorted(trace) and trace[-1] < 0.0


# ---- faults ----------------------------------------------------------------------------------------


def raise_fault(bus: Bus) -> None:
    """Over-pressure in RUN; then more than the ECU needs to reach FAULT."""
    bus.tick(extra=[bus.bench.motion("RUN", Controller=2)])
    bus.tick(5)
    bus.bench.raw["PRESSURES_SWING"]["BorePressure"] = 60000
    bus.tick(400)


@pytest.fixture
def faulted(bench, open_image) -> Bus:
    """An ECU in FAULT for an over-pressure."""
    made = Bus(bench, open_image({"supervision.pressure_max_Pa": 2.5e7}))
    made.start()
    raise_fault(made)
    return made


def test_fault_is_not_a_number(faulted: Bus) -> None:
    """GIVEN an over-pressure WHEN watched THEN the fault has its name, its condition and what to do."""
    state = faulted.state()
    assert state.mode == "FAULT" and state.faults_complete
    assert [fault.name for fault in state.faults] == ["OVER_PRESSURE"]
    assert "chamber is above the limit" in state.faults[0].when and "RESET_FAULT" in state.faults[0].clear
    assert "fault OVER_PRESSURE" in [event.text for event in state.events]
    assert "FAULT OVER_PRESSURE" in one_line(state, Place("vcan0", "", 0.0))


def test_fault_is_not_hidden_from_who_joins_late(faulted: Bus) -> None:
    """GIVEN an ECU in FAULT WHEN a watch joins after the EMCY
    THEN TIMING's fault is told, and that there may be others.
    """
    faulted.watch = Watch(faulted.now_s)
    faulted.tick(100)
    state = faulted.state()
    assert [fault.name for fault in state.faults] == ["OVER_PRESSURE"] and not state.faults_complete


def test_fault_that_is_gone_is_not_shown(faulted: Bus) -> None:
    """GIVEN a fault WHEN its cause goes and RESET_FAULT comes THEN none is shown."""
    faulted.bench.raw["PRESSURES_SWING"]["BorePressure"] = 8000
    faulted.tick(10)
    faulted.tick(extra=[faulted.bench.motion("RESET_FAULT")])
    faulted.tick(60)
    assert faulted.state().faults == () and faulted.state().faults_complete and faulted.state().mode == "STANDBY"


def test_second_fault_is_not_hidden_by_the_first(bus: Bus) -> None:
    """GIVEN an EMCY with three faults WHEN TIMING shows the first THEN all three are listed."""
    bus.hear([told("EMCY_ECU", {"FaultCode": 10, "FaultDetail": 1 << 9 | 1 << 10 | 1 << 13})])
    bus.hear([told("TIMING", {"TimingPage": 0, "FaultCode": 9})])
    assert [fault.code for fault in bus.state().faults] == [9, 10, 13] and bus.state().faults_complete


def test_fault_table_does_not_lack_a_code_of_the_dbc() -> None:
    """GIVEN the DBC's codes WHEN looked up THEN names agree; an unknown code is said to be one."""
    choices = protocol.database().get_message_by_name("EMCY_ECU").get_signal_by_name("FaultCode").choices
    assert {code: str(name) for code, name in choices.items() if code} == {
        code: text.name for code, text in fault_texts().items()
    }
    assert "not in can_protocol/faults.toml" in fault_text(200).when


def test_check_in_plain_python_is_not_another_than_the_compiled_one() -> None:
    """GIVEN 300 random frames WHEN protected by both THEN the bytes are the same; one flipped bit shows."""
    random_ = random.Random(3)
    for k in range(300):
        can_id, data = random_.randrange(0x800), random_.randbytes(8)
        row = frames.to_row(can_id, data)
        frames.protect(row, k % 15)
        made = e2e.protected(can_id, data, k % 15)
        assert (can_id, made) == frames.from_row(row) and e2e.intact(can_id, made)
        flipped = bytearray(made)
        flipped[k % 8] ^= 1 << k % 7
        assert not e2e.intact(can_id, bytes(flipped))
    assert e2e.protected(0x123, bytes.fromhex("0000112233445566"), 2)[:2] == b"\x67\x02"


# ---- what is wrong on the bus ------------------------------------------------------------------------


def test_corrupt_frame_is_not_believed(bus: Bus) -> None:
    """GIVEN a frame with a wrong CRC, one too short WHEN watched THEN both count, and the last good value stays."""
    can_id, data = told("ENCODERS", {"SwingAngle": 1000000})
    before = bus.state().joints["swing"].angle_rad
    bus.hear([(can_id, bytes([data[0] ^ 0x40]) + data[1:]), (can_id, data[:7])])
    state = bus.state()
    assert state.frames["ENCODERS"].corrupt == 2 and state.joints["swing"].angle_rad == before


def test_another_dbc_is_not_taken_for_ours(bus: Bus) -> None:
    """GIVEN a TIMING frame with another hash WHEN watched THEN both hashes are told and they do not match."""
    bus.hear([told("TIMING", {"TimingPage": 1, "DbcHash": 0x01020304})])
    assert bus.state().dbc_match is False and bus.state().dbc_hash_heard == 0x01020304
    assert "ANOTHER DBC" in one_line(bus.state(), Place("vcan0", "", 0.0))


def test_two_ecus_are_not_taken_for_one(bus: Bus, bench) -> None:
    """GIVEN two ECUs' SYNC on one bus WHEN watched THEN they are told from one; a frame lost is no second ECU."""
    bus.tick(1100)
    assert not bus.state().ecu.doubled
    bus.hear([(0x080, bytes([(bus.bench.sync + 5) % 240 + 1]))])
    bus.tick(100)
    assert not bus.state().ecu.doubled
    other = 17
    for _ in range(1500):
        bus.tick()
        other = other % 240 + 1
        bus.hear([(0x080, bytes([other]))])
        if other % 50 == 0:
            bus.state()
    assert bus.state().ecu.doubled


def test_two_io_nodes_are_not_taken_for_one(bus: Bus) -> None:
    """GIVEN two answers to each SYNC WHEN watched THEN two nodes are told."""
    for _ in range(1200):
        bus.tick()
        bus.hear([frames.from_row(bus.bench.sensors()[0])])
    assert bus.state().io_node.doubled and not bus.state().ecu.doubled


def test_strange_frames_do_not_break_the_watch(bus: Bus) -> None:
    """GIVEN 20000 frames of random ids, lengths and bytes WHEN watched
    THEN snapshots, page and JSON come all the same.
    """
    random_ = random.Random(7)
    known = [message.frame_id for message in protocol.database().messages]
    for k in range(20000):
        can_id = random_.choice(known) if k % 2 else random_.randrange(0x800)
        bus.now_s += 1e-4
        bus.watch.take(can_id, random_.randbytes(random_.randrange(9)), bus.now_s)
        if k % 2000 == 0:
            state = bus.state()
            json.dumps(state.as_dict(), allow_nan=False)
            page(state, bus.watch.load_trace(bus.now_s, 40), Place("vcan0", "", 0.0), 120)
            one_line(state, Place("vcan0", "", 0.0))
    assert all(not math.isnan(value[0]) for value in bus.state().parameters.values())


def test_frames_of_other_makers_are_not_overlooked(bus: Bus) -> None:
    """GIVEN an id of no DBC and an SDO WHEN watched THEN the first is strange, the second is CANopen's."""
    bus.hear([(0x123, b"\1"), (0x601, bytes(8)), (0x581, bytes(8)), (0x123, b"\1")])
    assert bus.state().unknown == {"0x123": 2}


# ---- findings that need an interface no test has -----------------------------------------------------

LINK = LinkFacts("can0", True, True, True, False, 1_000_000, "ERROR-ACTIVE", 100, 1000, 0, ("can0",))
PERMITTED = RealtimeFacts(True, True, True)


def findings(link: LinkFacts, state: Snapshot | None = None, has_can: bool = True) -> dict[str, str]:
    """Codes and next commands of a diagnosis of this interface."""
    evidence = Evidence(parse_bus(link.name), has_can, link, PERMITTED, "cannot open", state, 2.0)
    return {finding.code: finding.next for finding in diagnose(evidence)}


@pytest.mark.parametrize(
    ("change", "code", "typed"),
    [
        ({"exists": False, "is_can": False, "up": False}, "no-interface", "ip -brief link"),
        ({"exists": False, "name": "vcan3", "virtual": True}, "no-interface", "sudo ip link add dev vcan3 type vcan"),
        ({"is_can": False}, "not-can", "ip -brief link"),
        ({"up": False}, "interface-down", "sudo ip link set can0 up type can bitrate 1000000"),
        ({"up": False, "name": "vcan0", "virtual": True}, "interface-down", "sudo ip link set vcan0 up"),
        ({"bitrate": 500_000}, "bitrate", "bitrate 1000000"),
        ({"state": "BUS-OFF"}, "controller-state", "restart-ms"),
        ({"state": "ERROR-PASSIVE"}, "controller-state", "restart-ms"),
        ({"queue": 10}, "short-queue", "sudo ip link set can0 txqueuelen 1000"),
        ({"dropped": 3}, "kernel-drops", "ip -details -statistics link show can0"),
    ],
)
def test_interface_that_is_wrong_does_not_pass(change: dict, code: str, typed: str) -> None:
    """GIVEN an interface with one thing wrong WHEN diagnosed THEN that is found, with the command."""
    found = findings(replace(LINK, **change))
    assert typed in found[code]


def test_interface_that_is_right_is_not_blamed(bus: Bus) -> None:
    """GIVEN an interface in order and an ECU in RUN WHEN diagnosed THEN nothing is wrong."""
    bus.tick(extra=[bus.bench.motion("RUN", Controller=2)])
    bus.tick(20)
    evidence = Evidence(parse_bus("can0"), True, LINK, PERMITTED, "", bus.state(), 2.0)
    assert [finding.severity for finding in diagnose(evidence) if finding.severity != "note"] == []


def test_kernel_without_can_is_not_a_missing_interface() -> None:
    """GIVEN no CAN sockets WHEN diagnosed THEN modprobe is the next command."""
    assert findings(LINK, has_can=False) == {"no-can-in-kernel": "sudo modprobe -a can_raw vcan"}


def test_facts_of_an_interface_are_not_mixed_up(tmp_path) -> None:
    """GIVEN /sys of a CAN interface that is down, and an Ethernet WHEN looked at THEN the facts are theirs."""
    for name, kind, flags in (("can1", "280", "0x80"), ("eth0", "1", "0x1003")):
        (tmp_path / name / "statistics").mkdir(parents=True)
        for file, text in (("type", kind), ("flags", flags), ("tx_queue_len", "10")):
            (tmp_path / name / file).write_text(text + "\n")
        (tmp_path / name / "statistics" / "rx_dropped").write_text("4\n")
    assert can_interfaces(tmp_path) == ("can1",)
    facts = link_facts("can1", tmp_path)
    assert (facts.exists, facts.is_can, facts.up, facts.queue, facts.dropped) == (True, True, False, 10, 4)
    assert not link_facts("eth0", tmp_path).is_can and link_facts("eth0", tmp_path).up
    assert not link_facts("can2", tmp_path).exists
