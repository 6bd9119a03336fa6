"""tools/params.py against an SDO server with the ECU's objects: what would mislead the person who sets a machine up."""

from __future__ import annotations

import importlib
import re
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import canopen
import pytest

from sil_plant.bus.hub import Hub
from sil_plant.bus.objects import FIRST_PARAMETER
from sil_plant.bus.ports import connect_python_can
from sil_plant.inputs.machine import ARMS, REFERENCE_ARM, load_machine, load_parameter_table, parameter_image

ROOT = Path(__file__).resolve().parents[2]
ECU_BINARY = ROOT / "firmware" / "diarc_ecu"
LIMIT_S = 60.0
RUN_MODE, STANDBY_MODE = 2, 1
HEADER_BYTES = 12


@pytest.fixture
def hub() -> Iterator[Hub]:
    """A bus: a hub that is served by a thread."""
    over = threading.Event()
    with Hub("127.0.0.1", 0) as hub:

        def serve() -> None:
            while not over.is_set():
                hub.receive(0.02)

        thread = threading.Thread(target=serve)
        thread.start()
        yield hub
        over.set()
        thread.join(LIMIT_S)


@dataclass(frozen=True)
class Done:
    """What a run of the program ended with."""

    returncode: int
    stdout: str
    stderr: str


Params = Callable[..., Done]


@pytest.fixture
def params(hub: Hub, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Params:
    """Run tools/params.py on the hub, in this process: its imports take longer than all it does."""
    monkeypatch.setattr(sys, "path", [str(ROOT), *sys.path])
    main = importlib.import_module("tools.params").main

    def run(*arguments: object) -> Done:
        try:
            status = main(["--bus", f"tcp:127.0.0.1:{hub.port}", *map(str, arguments)])
        except SystemExit as end:
            status = end.code
        return Done(status, *capsys.readouterr())

    return run


class Server:
    """The parameter objects of the ECU, on canopen's own SDO server: a parameter image, a mode and a memory."""

    def __init__(self, node: canopen.LocalNode) -> None:
        self.image = bytearray(parameter_image(load_machine(REFERENCE_ARM)))
        self.saved: bytes | None = None
        self.mode = STANDBY_MODE
        self.has_memory = True
        self.layout_hash = load_parameter_table().layout_hash
        node.add_read_callback(self.read)
        node.add_write_callback(self.write)

    def read(self, index: int, subindex: int, od: object, **_: object) -> bytes:
        """What an upload gives."""
        if index == 0x2000:
            return bytes(self.image)
        if index == 0x2003:
            return struct.pack("<I", self.layout_hash)
        if index == 0x2004:
            return bytes([self.mode])
        place = HEADER_BYTES + 4 * (index - FIRST_PARAMETER)
        return bytes(self.image[place : place + 4])

    def write(self, index: int, subindex: int, od: object, data: bytes, **_: object) -> None:
        """What a download does, or why it is refused."""
        if self.mode == RUN_MODE:
            raise canopen.SdoAbortedError(0x08000022)
        if index in (0x1010, 0x1011):
            assert data == (b"save" if index == 0x1010 else b"load")
            if not self.has_memory:
                raise canopen.SdoAbortedError(0x08000020)
            self.saved = bytes(self.image) if index == 0x1010 else None
        elif index == 0x2000:
            self.image[:] = data
        else:
            name = load_parameter_table().entries[index - FIRST_PARAMETER].name
            if name == "swing.rod_m" and struct.unpack("<f", data)[0] > 0.032:  # thicker than the bore
                raise canopen.SdoAbortedError(0x06040043)
            place = HEADER_BYTES + 4 * (index - FIRST_PARAMETER)
            self.image[place : place + 4] = data

    def value(self, name: str) -> float:
        """A parameter of the image."""
        names = [entry.name for entry in load_parameter_table().entries]
        return float(struct.unpack_from("<f", self.image, HEADER_BYTES + 4 * names.index(name))[0])


@pytest.fixture
def server(hub: Hub) -> Iterator[Server]:
    """An SDO server as node 1 of the hub."""
    objects = canopen.ObjectDictionary()
    for index, kind in [
        (0x2000, canopen.objectdictionary.DOMAIN),
        (0x2003, canopen.objectdictionary.UNSIGNED32),
        (0x2004, canopen.objectdictionary.UNSIGNED8),
        *((FIRST_PARAMETER + k, canopen.objectdictionary.REAL32) for k in range(len(load_parameter_table().entries))),
    ]:
        variable = canopen.objectdictionary.ODVariable(f"{index:04X}", index)
        variable.data_type = kind
        objects.add_object(variable)
    for index in (0x1010, 0x1011):
        array = canopen.objectdictionary.ODArray(f"{index:04X}", index)
        variable = canopen.objectdictionary.ODVariable("all", index, 1)
        variable.data_type = canopen.objectdictionary.UNSIGNED32
        array.add_member(variable)
        objects.add_object(array)
    network = canopen.Network(connect_python_can(f"tcp:127.0.0.1:{hub.port}"))
    network.NOTIFIER_CYCLE = 0.05
    network.connect()
    node = canopen.LocalNode(1, objects)
    network.add_node(node)
    yield Server(node)
    network.disconnect()


def test_value_shown_without_unit_or_range(params: Params, server: Server) -> None:
    """GIVEN an ECU WHEN its parameters are listed or one is asked for THEN value, unit, range and meaning are there."""
    listed = params("list")
    assert listed.returncode == 0, listed.stderr
    assert len(listed.stdout.splitlines()) == 1 + len(load_parameter_table().entries)
    few = params("list", "wrist.q_*")
    assert [line.split()[0] for line in few.stdout.splitlines()] == ["name", "wrist.q_min_rad", "wrist.q_max_rad"]
    assert few.stdout.splitlines()[2].split(maxsplit=6) == [
        *("wrist.q_max_rad", "1.2", "rad", "-3.2", "to", "3.2"),
        "joint range, high end",
    ]
    one = params("get", "supply.pressure_Pa")
    assert one.stdout == "supply.pressure_Pa = 1e+07 Pa   (1e+06 to 3.2e+07; supply pressure, absolute)\n"


def test_value_not_changed_or_not_kept(params: Params, server: Server) -> None:
    """GIVEN an ECU WHEN a value is set, also a negative one, saved, and the default restored THEN so it is."""
    done = params("set", "control.swing.k1_1_s", "61.5")
    assert (done.returncode, done.stdout) == (
        0,
        "control.swing.k1_1_s = 61.5 1/s, was 50; in use until power-off; to keep it: params.py save\n",
    )
    assert params("set", "wrist.q_min_rad", "-1.25e0").returncode == 0
    assert (server.value("control.swing.k1_1_s"), server.value("wrist.q_min_rad")) == (61.5, -1.25)
    assert server.saved is None
    assert params("save").returncode == 0
    assert server.saved == server.image
    assert params("restore").returncode == 0
    assert server.saved is None


def test_machine_file_loaded_in_part(params: Params, server: Server, tmp_path: Path) -> None:
    """GIVEN another machine's file WHEN loaded THEN the ECU has its image, and diff says so before and after."""
    loader = ARMS / "loader.toml"
    before = params("diff", loader)
    assert before.returncode == 1
    assert ["swing.link_length_m", "0.8", "1.6", "m"] in [line.split() for line in before.stdout.splitlines()]
    loaded = params("load", loader)
    assert loaded.returncode == 0, loaded.stderr
    assert server.image == parameter_image(load_machine(loader))
    after = params("diff", loader)
    assert (after.returncode, after.stdout) == (0, f"no difference between the ECU and {loader}\n")
    assert params("diff").returncode == 1  # the reference arm


WRONG = {
    "unknown name": (["get", "wrist.qmax_rad"], 1, r"no such parameter; did you mean wrist\.q_max_rad"),
    "nothing like it": (["get", "!"], 1, r"`params\.py list` has all names"),
    "pattern": (["list", "elbow.*"], 1, r"no name matches"),
    "too high": (["set", "supply.pressure_Pa", "4e7"], 1, r"4e7 is outside its range, 1e\+06 to 3\.2e\+07 Pa"),
    "too low": (["set", "wrist.q_min_rad", "-4"], 1, r"-4 is outside its range, -3\.2 to 3\.2 rad"),
    "no number": (["set", "supply.pressure_Pa", "100bar"], 1, r"'100bar' is no number; its range is 1e\+06 to"),
    "nan": (["set", "supply.pressure_Pa", "nan"], 1, r"nan is outside its range"),
    "contradiction": (["set", "swing.rod_m", "0.4"], 1, r"contradicts another parameter.*all at once: params\.py load"),
    "no file": (["load", "/nowhere.toml"], 2, r"/nowhere\.toml: cannot be read"),
    "no command": (["wash"], 2, r"invalid choice: 'wash'.*see params\.py --help"),
    "left over": (["save", "it"], 2, r"it is not understood|unrecognized"),
}  # fmt: skip


@pytest.mark.parametrize("case", WRONG)
def test_mistake_not_explained(params: Params, server: Server, case: str) -> None:
    """GIVEN a mistake WHEN made THEN one line says what is right, and nothing is changed."""
    arguments, status, said = WRONG[case]
    before = bytes(server.image)
    done = params(*arguments)
    assert done.returncode == status, done.stderr
    assert re.search(said, done.stderr), done.stderr
    assert done.stderr.count("\n") == 1
    assert server.image == before


@pytest.mark.parametrize(
    "arguments", [["set", "swing.bore_m", "0.04"], ["load", ARMS / "loader.toml"], ["save"], ["restore"]]
)
def test_refusal_while_driving_not_explained(params: Params, server: Server, arguments: list[object]) -> None:
    """GIVEN an ECU in RUN WHEN something that it refuses there is asked for THEN the mode and what to do is said."""
    server.mode = RUN_MODE
    done = params(*arguments)
    assert done.returncode == 1
    assert "the ECU is in mode RUN" in done.stderr and "bring it to STANDBY" in done.stderr
    assert params("get", "swing.bore_m").returncode == 0


def test_ecu_without_memory_not_explained(params: Params, server: Server) -> None:
    """GIVEN an ECU without a store WHEN told to save THEN --store is named."""
    server.has_memory = False
    done = params("save")
    assert (done.returncode, "--store FILE" in done.stderr) == (1, True)


def test_ecu_of_another_release_written_to(params: Params, server: Server) -> None:
    """GIVEN an ECU with another list of parameters WHEN asked for anything THEN nothing is read or written."""
    server.layout_hash ^= 1
    done = params("set", "swing.bore_m", "0.04")
    assert done.returncode == 2
    assert "another list of parameters" in done.stderr


def test_bus_without_ecu_not_explained(hub: Hub) -> None:
    """GIVEN a bus without an ECU WHEN asked as users do THEN within seconds it says so, and how to start one."""
    command = [sys.executable, "tools/params.py", "--bus", f"tcp:127.0.0.1:{hub.port}", "list"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=LIMIT_S)
    assert done.returncode == 2
    assert "no ECU answers on tcp:127.0.0.1:" in done.stderr and "./firmware/diarc_ecu tcp:127.0.0.1:" in done.stderr
    assert done.stderr.count("\n") == 1


# ---- the ECU itself --------------------------------------------------------------------------------


@pytest.fixture
def ecu(hub: Hub, tmp_path: Path) -> Iterator[Callable[[], subprocess.Popen[str]]]:
    """Start the ECU on the hub with a store; each call is another start, the one before is over."""
    running: list[subprocess.Popen[str]] = []

    def end() -> None:
        for process in running:
            if process.poll() is None:
                process.terminate()
                process.communicate(timeout=LIMIT_S)
        running.clear()

    def start() -> subprocess.Popen[str]:
        end()
        command = [ECU_BINARY, f"tcp:127.0.0.1:{hub.port}", "--store", tmp_path / "store"]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        running.append(process)
        return process

    yield start
    end()


def ask(params: Params, *arguments: object) -> Done:
    """Ask again until the ECU that was just started answers."""
    end = time.monotonic() + LIMIT_S
    while True:
        done = params(*arguments)
        if done.returncode != 2 or time.monotonic() > end:
            return done


def test_ecu_forgets_what_was_saved(params: Params, ecu: Callable[[], subprocess.Popen[str]], tmp_path: Path) -> None:
    """GIVEN a store WHEN values are set, a machine is loaded, saved, restored THEN restarts show just that."""
    get = ("get", "control.swing.k1_1_s")
    ecu()
    assert ask(params, *get).stdout.startswith("control.swing.k1_1_s = 50 1/s")
    assert params("set", "control.swing.k1_1_s", "61.5").returncode == 0
    ecu()
    assert ask(params, *get).stdout.startswith("control.swing.k1_1_s = 50 1/s")  # not saved
    assert params("set", "control.swing.k1_1_s", "61.5").returncode == 0
    assert params("save").returncode == 0
    ecu()
    assert ask(params, *get).stdout.startswith("control.swing.k1_1_s = 61.5 1/s")
    assert params("load", ARMS / "loader.toml").returncode == 0
    assert params("diff", ARMS / "loader.toml").returncode == 0
    assert params("save").returncode == 0
    ecu()
    assert ask(params, "diff", ARMS / "loader.toml").returncode == 0
    assert params("restore").returncode == 0
    assert params("diff", ARMS / "loader.toml").returncode == 0  # until the next start
    ecu()
    assert ask(params, "diff").returncode == 0


def test_contradiction_taken_by_the_ecu(params: Params, ecu: Callable[[], subprocess.Popen[str]]) -> None:
    """GIVEN an ECU WHEN a value contradicts another THEN refused with the way out, and nothing is changed."""
    ecu()
    assert ask(params, "diff").returncode == 0
    done = params("set", "swing.rod_m", "0.45")
    assert done.returncode == 1
    assert "contradicts another parameter" in done.stderr
    assert params("diff").returncode == 0


def test_store_of_two_ecus(params: Params, ecu: Callable[[], subprocess.Popen[str]], hub: Hub, tmp_path: Path) -> None:
    """GIVEN an ECU with a store WHEN another is started with the same THEN it says so and ends with 2."""
    ecu()
    assert ask(params, "get", "swing.bore_m").returncode == 0
    command = [ECU_BINARY, f"tcp:127.0.0.1:{hub.port}", "--store", tmp_path / "store"]
    second = subprocess.run(command, capture_output=True, text=True, timeout=LIMIT_S)
    assert second.returncode == 2
    assert "another process has it" in second.stderr


def test_damaged_store_not_reported(params: Params, ecu: Callable[[], subprocess.Popen[str]], tmp_path: Path) -> None:
    """GIVEN a saved set that is damaged WHEN the ECU starts THEN it says so, has its default, and saving mends it."""
    ecu()
    assert ask(params, "set", "swing.bore_m", "0.041").returncode == 0
    assert params("save").returncode == 0
    process = ecu()
    ask(params, "get", "swing.bore_m")
    process.terminate()
    process.wait(LIMIT_S)
    store = bytearray((tmp_path / "store").read_bytes())
    store[0x10000 + 100] ^= 0x40
    (tmp_path / "store").write_bytes(store)
    process = ecu()
    assert ask(params, "diff").returncode == 0
    assert params("save").returncode == 0
    process.terminate()
    _, said = process.communicate(timeout=LIMIT_S)
    assert "what was saved is damaged, the default is in use" in said and "RESET_FAULT" in said
    process = ecu()
    assert ask(params, "diff").returncode == 0
    process.terminate()
    assert "damaged" not in process.communicate(timeout=LIMIT_S)[1]
