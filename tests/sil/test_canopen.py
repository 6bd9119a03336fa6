"""PyPI `canopen`, the client that others use, on the bus with diarc_ecu: what would shut such tools out, or tell them
something else than the EDS does.

The I/O node is a thread that answers SYNC with an arm at rest. On the hub of this rig, or where DIARC_TEST_BUS says.
"""

from __future__ import annotations

import configparser
import gc
import math
import os
import struct
import subprocess
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path

import canopen
import pytest
from canopen.objectdictionary import ODArray, ODRecord, ODVariable

from sil_plant.bus import protocol
from sil_plant.bus.hub import BusError
from sil_plant.bus.objects import DATA_TYPES, EDS_PATH, load_objects
from sil_plant.bus.ports import FramePort, connect_python_can, open_frame_port
from sil_plant.inputs.machine import REFERENCE_ARM, load_machine, load_parameter_table, parameter_image

ROOT = Path(__file__).resolve().parents[2]
ECU = ROOT / "firmware" / "diarc_ecu"
LIMIT_S = 20.0  # no wait in this file is longer; reaching it is a failure
PERIOD_US = 2000  # half the frames of the usual tick: this is no test of speed
IO_FRAMES = ("ENCODERS", "PRESSURES_SWING", "PRESSURES_WRIST")
AT_REST = {
    "ENCODERS": {"SwingAngle": 267017, "WristAngle": 267017},
    "PRESSURES_SWING": {"BorePressure": 10000, "AnnulusPressure": 14628},
    "PRESSURES_WRIST": {"BorePressure": 8412, "AnnulusPressure": 10000},
}
INIT, STANDBY, RUN, FAULT = 0, 1, 2, 15
SEGMENTS = 78  # of an image
# What the client needs but for PDOs: a slow machine loses frames in its socket when it must look at all of them.
SERVICES = [{"can_id": i, "can_mask": 0x7FF, "extended": False} for i in (0x081, 0x581, 0x701)]
SAVE, LOAD = 0x65766173, 0x64616F6C


def crc8(data_id: int, payload: bytes) -> int:
    """E2E profile 1, mode BOTH, of bytes 1 to 7."""
    crc = 0
    for byte in (data_id & 0xFF, data_id >> 8, *payload[1:]):
        crc ^= byte
        for _ in range(8):
            crc = (crc << 1 ^ 0x1D if crc & 0x80 else crc << 1) & 0xFF
    return crc


def packed(name: str, counter: int, **raw: int) -> tuple[int, bytes]:
    """A protected frame from raw values; signals left out are 0."""
    message = protocol.database().get_message_by_name(name)
    values = dict.fromkeys((s.name for s in message.signals), 0) | raw | {"E2eCounter": counter}
    data = message.encode(values, scaling=False, strict=False)
    return message.frame_id, bytes((crc8(message.frame_id, data), *data[1:]))


class IoNode(threading.Thread):
    """Answers every SYNC with the same samples, until told to be silent or to end."""

    def __init__(self, port: FramePort) -> None:
        super().__init__(daemon=True)
        self.port = port
        self.silent = threading.Event()
        self.ended = threading.Event()
        self.error: BusError | None = None
        self.services: deque[tuple[float, int, str]] = deque(maxlen=6)  # told when a test fails
        self.answers = [[packed(name, counter, **AT_REST[name]) for name in IO_FRAMES] for counter in range(15)]

    def run(self) -> None:
        """Answer until the end."""
        try:
            while not self.ended.is_set():
                frame = self.port.receive(0.05)
                if frame is None:
                    continue
                if frame[0] in (0x601, 0x581):
                    self.services.append((time.monotonic(), frame[0], frame[1].hex()))
                if frame[0] == protocol.SYNC_ID and not self.silent.is_set():
                    self.port.send_many(self.answers[(frame[1][0] - 1) % 15])
        except BusError as error:
            self.error = error


class Bench:
    """One ECU, an I/O node and a CANopen client on one bus."""

    def __init__(self, bus: str, io: IoNode, network: canopen.Network, folder: Path) -> None:
        self.bus, self.io, self.network, self.folder = bus, io, network, folder
        self.node = network.add_node(canopen.RemoteNode(1, str(EDS_PATH)))
        self.node.sdo.RESPONSE_TIMEOUT = 5.0

    def power_on(self) -> subprocess.Popen:
        """Start the ECU; returns when it has booted up."""
        heard = threading.Event()
        self.network.subscribe(0x701, boot_up := lambda _, data, __: heard.set() if data[0] == 0 else None)
        with (self.folder / "ecu.err").open("w") as err:
            process = subprocess.Popen(
                [ECU, self.bus, "--period-us", str(PERIOD_US), "--quiet"],
                stdin=subprocess.DEVNULL,
                stdout=err,
                stderr=err,
            )
        try:
            assert heard.wait(LIMIT_S), (self.folder / "ecu.err").read_text()
        except BaseException:
            process.kill()
            process.wait()
            raise
        self.network.unsubscribe(0x701, boot_up)
        return process

    def until(self, condition: Callable[[], bool], what: str) -> None:
        """Wait for something the ECU does."""
        end = time.monotonic() + LIMIT_S
        while not condition():
            assert time.monotonic() < end, f"waited in vain: {what}"
            assert self.io.error is None, self.io.error
            time.sleep(0.02)

    def until_mode(self, mode: int) -> None:
        """Wait for a mode."""
        self.until(lambda: self.node.sdo["Mode"].raw == mode, f"mode {mode}, it is {self.node.sdo['Mode'].raw}")

    def abort(self, write: Callable[[], None]) -> canopen.SdoAbortedError:
        """The abort that a write or read ends in."""
        with pytest.raises(canopen.SdoAbortedError) as found:
            write()
        return found.value

    def set(self, name: str | int, value: float, sub: int | None = None) -> canopen.SdoAbortedError | None:
        """Write a number; the abort when it is refused."""
        item = self.node.sdo[name] if sub is None else self.node.sdo[name][sub]
        try:
            item.raw = value
        except canopen.SdoAbortedError as error:
            return error
        return None


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    """The bus, the I/O node and the client."""
    address = os.environ.get("DIARC_TEST_BUS", "tcp:127.0.0.1:0")
    with open_frame_port(address, host_hub=True) as port:
        if address.startswith("tcp:"):
            address = f"tcp:127.0.0.1:{port.hub.port}"
        io = IoNode(port)
        io.start()
        network = canopen.Network(connect_python_can(address))
        network.bus.set_filters(SERVICES)
        network.connect()
        try:
            yield Bench(address, io, network, tmp_path_factory.mktemp("canopen"))
        finally:
            network.disconnect()
            io.ended.set()
            io.join(LIMIT_S)
    assert io.error is None


@pytest.fixture
def bench(shared: Bench) -> Iterator[Bench]:
    """A fresh ECU in STANDBY."""
    shared.io.silent.clear()
    shared.network.bus.set_filters(SERVICES)
    shared.node.emcy.reset()
    process = shared.power_on()
    # A download that the ECU refused leaves a stream behind, which when it is collected sends a last segment and waits
    # for the answer. That may be in no thread that the answer needs: the I/O node's, or the client's own.
    gc.disable()
    try:
        shared.node.nmt.state = "OPERATIONAL"
        shared.until_mode(STANDBY)
        yield shared
        assert process.poll() is None, (shared.folder / "ecu.err").read_text()
    finally:
        gc.collect()
        gc.enable()
        print("now", time.monotonic(), "last SDO on the bus", *shared.io.services, sep="\n")
        process.terminate()
        try:
            process.wait(LIMIT_S)
        finally:
            process.kill()
            process.wait()


def variables(node: canopen.RemoteNode) -> list[ODVariable]:
    """Every value of the EDS."""
    found = []
    for item in node.object_dictionary.values():
        found += list(item.values()) if isinstance(item, (ODArray, ODRecord)) else [item]
    return found


# ---- the EDS and the ECU ---------------------------------------------------------------------------


def test_eds_does_not_differ_from_the_table() -> None:
    """GIVEN the EDS WHEN read as CiA 306 has it THEN names, types, access, limits and values are those of the table,
    its lists name every object, and there is no other.
    """
    eds = configparser.RawConfigParser(strict=True, inline_comment_prefixes=(";",))
    eds.optionxform = str
    eds.read_string(EDS_PATH.read_text("utf-8"))
    expected = {}
    for item in load_objects().objects:
        for entry in item.entries:
            expected[f"{item.index:04X}" + ("" if item.kind == "VAR" else f"sub{entry.sub:X}")] = entry
    sections = {s for s in eds.sections() if s[0] in "0123456789" and "DataType" in eds[s]}
    assert sections == set(expected)
    for section, entry in expected.items():
        found = eds[section]
        assert found["ParameterName"] == entry.name
        assert int(found["DataType"], 0) == DATA_TYPES[entry.type]
        assert found["AccessType"] == entry.access
        limits = (entry.low, entry.high) if entry.low is not None else (None, None)
        assert tuple(float(found[k]) if k in found else None for k in ("LowLimit", "HighLimit")) == limits
        assert isinstance(entry.default, int) == ("DefaultValue" in found)
    listed = []
    for name in ("MandatoryObjects", "OptionalObjects", "ManufacturerObjects"):
        numbers = [int(eds[name][str(k)], 0) for k in range(1, int(eds[name]["SupportedObjects"]) + 1)]
        assert len(eds[name]) == len(numbers) + 1
        listed += numbers
    assert sorted(listed) == [item.index for item in load_objects().objects]
    assert {f"Dummy{k:04d}" for k in range(1, 8)} == set(eds["DummyUsage"])


def test_scan_does_not_miss_the_ecu(bench: Bench) -> None:
    """GIVEN all node ids WHEN scanned THEN node 1 answers, node 2 is there by its frames, and nobody else."""
    bench.network.bus.set_filters(None)
    bench.network.scanner.reset()
    bench.network.scanner.search()
    bench.until(lambda: 1 in bench.network.scanner.nodes and 2 in bench.network.scanner.nodes, "scan")
    assert sorted(bench.network.scanner.nodes) == [1, 2]


def test_object_of_the_eds_is_not_unreadable(bench: Bench) -> None:
    """GIVEN every value of the EDS WHEN read THEN it comes, as long as its type; one that the EDS calls constant
    reads what the EDS says; parameters are those of the reference arm.
    """
    arm = load_machine(REFERENCE_ARM)
    parameters = {entry.name for entry in load_parameter_table().entries}
    read = variables(bench.node)
    assert len(read) == sum(1 for _ in load_objects().entries())
    for variable in read:
        where = f"{variable.index:04X}:{variable.subindex} {variable.name}"
        if variable.index == 0x1003 and variable.subindex > 0:
            continue  # there is no error: 08000024
        data = bench.node.sdo.upload(variable.index, variable.subindex)
        assert data, where
        value = variable.decode_raw(data)
        if variable.data_type not in (DATA_TYPES["TEXT"], DATA_TYPES["DOMAIN"]):
            assert len(data) * 8 == len(variable), where
            assert math.isfinite(value), where
        if variable.default is not None:
            assert value == variable.default, where
        if variable.name in parameters:
            assert value == pytest.approx(arm[variable.name], rel=1e-7), where
    assert bench.node.sdo["Manufacturer device name"].raw == "DIARC ECU"
    assert bench.node.sdo["Parameter image"].raw == parameter_image(arm)
    assert bench.node.sdo["DBC hash"].raw == protocol.dbc_hash()


def test_ecu_does_not_have_objects_that_the_eds_hides(bench: Bench) -> None:
    """GIVEN indices around and between those of the EDS WHEN asked for THEN the ECU has none, and no sub-index more
    than the EDS says (the C test looks at all indices).
    """
    known = {item.index: item for item in load_objects().objects}
    around = {index + step for index in known for step in (-1, 1)} - set(known)
    for index in sorted(i for i in around if 0 <= i <= 0xFFFF):
        assert bench.abort(lambda i=index: bench.node.sdo.upload(i, 0)).code == 0x06020000, f"{index:04X}"
    for index, item in known.items():
        if item.kind != "VAR":
            count = len(item.entries)
            assert bench.abort(lambda i=index, n=count: bench.node.sdo.upload(i, n)).code == 0x06090011, f"{index:04X}"


def test_access_is_not_another_than_the_eds_says(bench: Bench) -> None:
    """GIVEN every object that is read only WHEN written THEN 06010002; GIVEN every limit of a parameter WHEN the next
    number beyond it is written THEN it is refused as too high or too low, and nothing has changed.
    """
    parameters = [entry for entry in load_objects().entries() if entry.idle and entry.type == "R32"]
    for variable in variables(bench.node):
        if not variable.writable and variable.data_type not in (DATA_TYPES["TEXT"], DATA_TYPES["DOMAIN"]):
            blank = bytes(len(variable) // 8)
            error = bench.abort(lambda v=variable, b=blank: bench.node.sdo.download(v.index, v.subindex, b))
            assert error.code == 0x06010002, f"{variable.index:04X}:{variable.subindex}"
    for entry in parameters:
        for limit, away, code in ((entry.low, -math.inf, 0x06090032), (entry.high, math.inf, 0x06090031)):
            beyond = struct.pack("<f", _next_float(limit, away))
            error = bench.abort(lambda e=entry, b=beyond: bench.node.sdo.download(e.index, 0, b))
            assert error.code == code, entry.name
    assert bench.node.sdo["Parameter image"].raw == parameter_image(load_machine(REFERENCE_ARM))


def _next_float(value: float, towards: float) -> float:
    """The binary32 number next to the one nearest to `value`."""
    bits = struct.unpack("<i", struct.pack("<f", value))[0]
    if bits == 0:
        return math.copysign(1.5e-45, towards)
    up = (towards > 0) == (bits >= 0)
    return struct.unpack("<f", struct.pack("<i", bits + (1 if up else -1)))[0]


# ---- writing ---------------------------------------------------------------------------------------


def test_written_parameter_is_not_lost(bench: Bench) -> None:
    """GIVEN STANDBY WHEN one parameter is written by name, and an image as a whole THEN they read back; a refused
    one, of either kind, changes nothing, and the text tells why.
    """
    node, arm = bench.node, load_machine(REFERENCE_ARM)
    node.sdo["wrist.q_max_rad"].raw = 1.0
    assert node.sdo["wrist.q_max_rad"].raw == pytest.approx(1.0)
    assert node.sdo["Parameter image"].raw == parameter_image(arm, {"wrist.q_max_rad": 1.0})
    assert "Value of parameter written too high" in str(bench.set("wrist.q_max_rad", 4.0))
    assert "incompatibility" in str(bench.set("swing.rod_m", arm["swing.bore_m"] * 1.1))
    names = [entry.name for entry in load_parameter_table().entries]
    assert names[node.sdo["Refused parameter"].raw] == "swing.rod_m"
    assert "Object does not exist" in str(bench.abort(lambda: node.sdo.upload(0x2FFF, 0)))
    assert "read only" in str(bench.abort(lambda: node.sdo.download(0x2001, 0, bytes(4))))

    image = parameter_image(arm, {"wrist.q_max_rad": 1.1, "control.swing.k1_1_s": 11.0})
    node.sdo["Parameter image"].raw = image
    assert node.sdo["Parameter image"].raw == image
    assert node.sdo["control.swing.k1_1_s"].raw == 11.0
    damaged = image[:100] + bytes((image[100] ^ 1,)) + image[101:]
    assert "CRC error" in str(bench.abort(lambda: node.sdo.download(0x2000, 0, damaged)))
    assert node.sdo["Parameter image"].raw == image
    # a number in segments, as some tools write all
    node.sdo.download(0x1017, 0, struct.pack("<H", 50), force_segment=True)
    assert node.sdo["Producer heartbeat time"].raw == 50


def test_machine_does_not_change_while_it_is_driven(bench: Bench) -> None:
    """GIVEN RUN by the control word WHEN a parameter, an image, save or restore are written THEN 08000022;
    in STANDBY by the control word they go again.
    """
    node = bench.node
    image = node.sdo["Parameter image"].raw
    assert node.sdo["Status word"].raw == 0x9
    node.sdo["Control word"].raw = 0x7
    bench.until_mode(RUN)
    assert node.sdo["Status word"].raw == 0xF
    for error in (
        bench.set("wrist.q_max_rad", 1.0),
        bench.set("Store parameters", SAVE, 1),
        bench.set("Restore default parameters", LOAD, 1),
        bench.abort(lambda: node.sdo.download(0x2000, 0, image)),
    ):
        assert error is not None and error.code == 0x08000022
    node.sdo["Control word"].raw = 0x1
    bench.until_mode(STANDBY)
    assert bench.set("wrist.q_max_rad", 1.0) is None


# ---- errors, heartbeat, PDOs -----------------------------------------------------------------------


def test_fault_is_not_kept_from_the_client(bench: Bench) -> None:
    """GIVEN RUN WHEN the sensors fall silent THEN an EMCY comes, 1001h and 1003h tell the same; when it is reset,
    by the control word, a second one says so.
    """
    node = bench.node
    assert "No data available" in str(bench.abort(lambda: node.sdo.upload(0x1003, 1)))
    node.sdo["Control word"].raw = 0x7
    bench.until_mode(RUN)
    bench.io.silent.set()
    bench.until(lambda: len(node.emcy.active) == 1, "EMCY")
    emergency = node.emcy.active[0]
    assert emergency.code == 0x8100
    fault = node.sdo["Fault"].raw
    assert emergency.data[0] == fault != 0
    assert node.sdo["Error register"].raw == emergency.register != 0
    assert node.sdo["Pre-defined error field"][0].raw == 1
    assert node.sdo["Pre-defined error field"][1].raw == emergency.code | fault << 16
    assert node.sdo["Active faults"].raw == 1 << fault
    bench.io.silent.clear()
    bench.until_mode(FAULT)
    assert "present device state" in str(bench.set("Control word", 0x7))

    def reset() -> bool:
        node.sdo["Control word"].raw = 0x0  # bit R must rise
        return bench.set("Control word", 0x8) is None

    bench.until(reset, "reset of the fault")
    bench.until_mode(STANDBY)
    bench.until(lambda: not node.emcy.active, "EMCY of no error")
    assert node.sdo["Error register"].raw == 0
    node.sdo["Pre-defined error field"][0].raw = 0
    assert node.sdo["Pre-defined error field"][0].raw == 0


def test_nmt_states_are_not_other_than_told(bench: Bench) -> None:
    """GIVEN the ECU WHEN it is stopped, made pre-operational and reset THEN its heartbeat says so and comes at the
    time of 1017h; SDO is silent while it is stopped; a reset boots up.
    """
    node = bench.node
    node.sdo["Producer heartbeat time"].raw = 20
    beats: list[float] = []
    bench.network.subscribe(0x701, listen := lambda _, __, stamp: beats.append(stamp))
    bench.until(lambda: len(beats) >= 12, "heartbeats")
    bench.network.unsubscribe(0x701, listen)
    assert node.nmt.wait_for_heartbeat(LIMIT_S) == "OPERATIONAL"
    node.nmt.state = "STOPPED"
    bench.until(lambda: node.nmt.wait_for_heartbeat(LIMIT_S) == "STOPPED", "stop")
    node.sdo.RESPONSE_TIMEOUT = 0.3
    with pytest.raises(canopen.SdoCommunicationError):
        node.sdo.upload(0x1000, 0)
    node.sdo.RESPONSE_TIMEOUT = 5.0
    node.nmt.state = "PRE-OPERATIONAL"
    bench.until(lambda: node.nmt.wait_for_heartbeat(LIMIT_S) == "PRE-OPERATIONAL", "pre-operational")
    assert node.sdo["Producer heartbeat time"].raw == 20
    booted = threading.Event()
    node.nmt.add_heartbeat_callback(lambda state: booted.set() if state == 0 else None)
    node.nmt.state = "RESET"
    assert booted.wait(LIMIT_S)
    assert node.sdo["Producer heartbeat time"].raw == 100


def test_pdo_is_not_without_names(bench: Bench) -> None:
    """GIVEN the PDO objects WHEN the client reads them THEN every frame of the ECU decodes by name, as by the DBC."""
    node = bench.node
    node.tpdo.read()
    node.rpdo.read()
    expected = {pdo.frame: pdo for pdo in load_objects().pdos}
    # all by SDO first: in STANDBY the estimate rests, and a slow machine loses answers among all the frames
    estimated, mapped = node.sdo["Estimated load"].raw, node.sdo["ESTIMATE"]["Load"].phys
    bench.network.bus.set_filters(None)
    maps = {m.cob_id: m for m in (*node.tpdo.map.values(), *node.rpdo.map.values())}
    assert set(maps) == {pdo.cob_id & 0x7FF for pdo in expected.values()}
    for name, pdo in expected.items():
        found = maps[pdo.cob_id & 0x7FF]
        assert [v.name for v in found.map] == [f"{name}.{piece.name}" for piece in pdo.pieces]
        assert found.enabled and not (pdo.transmitted and found.rtr_allowed)
        if name == "MOTION":
            continue  # nobody sends it
        assert found.wait_for_reception(LIMIT_S) is not None, name
        data = bytes(found.data)
        decoded = protocol.database().decode_message(pdo.cob_id & 0x7FF, data, decode_choices=False)
        compared = 0
        for variable, piece in zip(found.map, pdo.pieces, strict=True):
            if piece.name in decoded:
                signal = protocol.database().get_message_by_name(name).get_signal_by_name(piece.name)
                raw = round(decoded[piece.name] / signal.scale)
                data_now = found.data
                found.data = data
                assert variable.raw == raw, variable.name
                found.data = data_now
                assert variable.od.unit == (signal.unit or ""), variable.name
                compared += 1
        assert compared >= 4, name
    node.tpdo[1].wait_for_reception(LIMIT_S)
    load = node.tpdo["ESTIMATE.Load"].phys
    assert load == pytest.approx(estimated, abs=1e-3)
    assert load == pytest.approx(mapped, abs=1e-3)


def test_silence_of_the_plant_does_not_slow_the_client(bench: Bench) -> None:
    """GIVEN an ECU that waits for its sensors in every tick WHEN an image is read THEN segments do not wait."""
    bench.io.silent.set()
    bench.until_mode(INIT)
    ticks_before = bench.node.sdo["Late ticks"].raw
    assert len(bench.node.sdo["Parameter image"].raw) == len(parameter_image(load_machine(REFERENCE_ARM)))
    assert bench.node.sdo["Late ticks"].raw - ticks_before < SEGMENTS // 2
