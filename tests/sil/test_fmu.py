"""FMUs: another tool's plant under our ECU, our plant and our ECU in another tool, and what goes wrong with them."""

# ruff: noqa: E501 - one change and what is said of it a row

from __future__ import annotations

import ctypes
import functools
import importlib.util
import json
import math
import re
import shutil
import struct
import subprocess
import sys
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import fmpy
import numpy as np
import pytest
from fmpy.fmi1 import FMICallException
from fmpy.simulation import instantiate_fmu
from fmpy.validation import validate_fmu

from sil_plant.config import ConfigError, tomllib
from sil_plant.fmu import ecu_fmu, plant_fmu
from sil_plant.fmu.plant_object import slots
from sil_plant.inputs.machine import Machine, load_parameter_table, parameter_image, with_changes
from sil_plant.inputs.scenario import Scenario, with_load
from sil_plant.loop import inproc, session
from sil_plant.loop.external_plant import ExternalPlant, PlantLostError
from sil_plant.loop.fmu_map import bind, load_map
from sil_plant.plant import dynamics

ROOT = Path(__file__).resolve().parents[2]
MAP = ROOT / "sil_plant" / "maps" / "diarc_plant.toml"
PERIOD_S, DELAY_S = 1e-3, 0.5e-3
LOAD_KG = 2.5
LIMIT_S = 120.0
ENDINGS = {"2.0": "linux64", "3.0": "x86_64-linux"}


# ---- FMUs to test ----------------------------------------------------------------------------------------------


@pytest.fixture(scope="session")
def plants(tmp_path_factory: pytest.TempPathFactory, machine: Machine) -> dict[str, Path]:
    """Our plant as an FMU, by version of FMI."""
    folder = tmp_path_factory.mktemp("plants")
    made = {}
    for version in plant_fmu.VERSIONS:
        made[version] = folder / f"plant{version[0]}.fmu"
        plant_fmu.export_plant(machine, made[version], version=version)
    return made


@pytest.fixture(scope="session")
def ecu_file() -> Path:
    """The firmware as an FMU, built as `make fmu` does."""
    for command in (
        ["cmake", "-S", str(ROOT), "-B", str(ROOT / "build"), f"-DDIARC_PYTHON={sys.executable}"],
        ["cmake", "--build", str(ROOT / "build"), "--target", "fmu", "--parallel", "2"],
    ):
        result = subprocess.run(command, capture_output=True, text=True, timeout=LIMIT_S)
        assert result.returncode == 0, result.stdout + result.stderr
    return ROOT / "build" / "diarc_ecu.fmu"


@pytest.fixture
def rewritten(tmp_path: Path) -> Callable[..., Path]:
    """A copy of an FMU with changes: ``rewritten(fmu, name, (what, by), .., files=rename)``."""

    def make(
        fmu: Path, name: str, *changes: tuple[str, str], files: Callable[[str], str | None] = lambda name: name
    ) -> Path:
        path = tmp_path / name
        with zipfile.ZipFile(fmu) as source, zipfile.ZipFile(path, "w") as target:
            for entry in source.namelist():
                content = source.read(entry)
                if entry == "modelDescription.xml":
                    text = content.decode()
                    for what, by in changes:
                        assert what in text, what
                        text = text.replace(what, by)
                    content = text.encode()
                renamed = files(entry)
                if renamed is not None:
                    target.writestr(renamed, content)
        return path

    return make


class Slave:
    """An FMU in FMPy, with what it said."""

    def __init__(self, path: Path) -> None:
        self.model = fmpy.read_model_description(str(path))
        self.variables = {variable.name: variable for variable in self.model.modelVariables}
        self.said: list[str] = []
        self.folder = fmpy.extract(str(path))
        self.fmu = instantiate_fmu(self.folder, self.model, "CoSimulation", logger=self._log)

    def _log(self, *arguments: Any) -> None:
        text = arguments[-1]
        self.said.append(text.decode() if isinstance(text, bytes) else str(text))

    def close(self) -> None:
        self.fmu.freeInstance()
        shutil.rmtree(self.folder, ignore_errors=True)

    def start(self) -> Slave:
        if self.model.fmiVersion == "2.0":
            self.fmu.setupExperiment(startTime=0.0)
        self.fmu.enterInitializationMode()
        self.fmu.exitInitializationMode()
        return self

    def set(self, **values: Any) -> Slave:
        for name, value in values.items():
            variable = self.variables[name]
            getattr(self.fmu, f"set{variable.type}")([variable.valueReference], [value])
        return self

    def get(self, *names: str) -> list[Any]:
        found = []
        for name in names:
            variable = self.variables[name]
            found.append(getattr(self.fmu, f"get{variable.type}")([variable.valueReference])[0])
        return found

    def one(self, name: str) -> Any:
        return self.get(name)[0]

    def refused(self, call: Callable[[], Any], words: str) -> None:
        """The call must fail, and the FMU must have said these words."""
        self.said.clear()
        with pytest.raises(FMICallException):
            call()
        assert re.search(words, " ".join(self.said)), self.said


@pytest.fixture
def slave() -> Iterator[Callable[[Path], Slave]]:
    """Open FMUs: ``slave(path)``; freed at the end."""
    opened: list[Slave] = []

    def make(path: Path) -> Slave:
        opened.append(Slave(path))
        return opened[-1]

    yield make
    for one in opened:
        one.close()


@pytest.fixture(scope="session")
def native(machine: Machine, paper: Scenario) -> Callable[..., session.Session]:
    """Runs of the built-in plant: ``native(duration)``."""

    @functools.cache
    def run(duration: float) -> session.Session:
        scenario = with_load(replace(paper, duration_s=duration), LOAD_KG)
        made = session.make_session(machine, scenario, "diarc", 1, PERIOD_S)
        inproc.run_inproc(made, inproc.InprocEcu(parameter_image(machine)), len(made.noise) + 1)
        return made

    return run


def run_external(
    machine: Machine, paper: Scenario, fmu: Path, map_path: Path, duration: float = 0.3
) -> tuple[session.Session, ExternalPlant]:
    """A run with an FMU for a plant."""
    scenario = with_load(replace(paper, duration_s=duration), LOAD_KG)
    made = session.make_session(machine, scenario, "diarc", 1, PERIOD_S)
    with ExternalPlant(fmu, map_path) as other:
        other.start(made, scenario)
        inproc.run_inproc(made, inproc.InprocEcu(parameter_image(machine)), len(made.noise) + 1, other)
    return made, other


def edited(tmp_path: Path, *changes: tuple[str, str]) -> Path:
    """The map of our plant with changes."""
    text = MAP.read_text("utf-8")
    for what, by in changes:
        assert what in text, what
        text = text.replace(what, by)
    path = tmp_path / "map.toml"
    path.write_text(text, "utf-8")
    return path


# ---- our plant as an FMU ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("version", plant_fmu.VERSIONS)
def test_exported_plant_is_not_refused_by_the_validator(plants: dict[str, Path], version: str) -> None:
    """GIVEN the exported plant WHEN FMPy validates and simulates it THEN no finding, and a second of finite numbers."""
    fmu = str(plants[version])
    assert validate_fmu(fmu) == []
    result = fmpy.simulate_fmu(fmu, stop_time=1.0, output_interval=0.1, start_values={"load": 1.0})
    assert len(result) == 11
    assert all(np.isfinite(result[name]).all() for name in result.dtype.names)


@pytest.mark.parametrize("version", plant_fmu.VERSIONS)
def test_exported_plant_is_not_another_plant(
    plants: dict[str, Path], version: str, machine: Machine, paper: Scenario, native
) -> None:
    """GIVEN the plant as an FMU WHEN the ECU drives it THEN the trace is the built-in plant's within 1e-9."""
    expected = native(0.5)
    found, _ = run_external(machine, paper, plants[version], MAP, 0.5)
    ticks = len(expected.noise)
    assert int(found.progress.index[session.TICK]) == ticks
    scale = np.maximum(np.abs(expected.record.state).max(axis=0), 1.0)
    assert (np.abs(found.record.state - expected.record.state) / scale).max() < 1e-9
    assert np.abs(found.record.command - expected.record.command).max() < 1e-9
    assert np.array_equal(found.record.load_true, expected.record.load_true)


def test_exported_plant_does_not_need_python(plants: dict[str, Path], tmp_path: Path) -> None:
    """GIVEN the FMU's binary WHEN its undefined symbols are listed THEN they are the C library's."""
    with zipfile.ZipFile(plants["2.0"]) as archive:
        name = next(entry for entry in archive.namelist() if entry.endswith(".so"))
        library = Path(archive.extract(name, tmp_path))
    listed = subprocess.run(["nm", "-D", "-u", str(library)], capture_output=True, text=True, check=True).stdout
    assert not re.search(r"Py|numba|NRT", listed), listed
    needed = subprocess.run(["readelf", "-d", str(library)], capture_output=True, text=True, check=True).stdout
    assert set(re.findall(r"\(NEEDED\).*\[(.*)\]", needed)) <= {"libm.so.6", "libc.so.6"}


def test_no_parameter_of_the_plant_is_forgotten(machine: Machine) -> None:
    """GIVEN the plant's parameters WHEN compared with the FMU's THEN each is offered, or follows from the geometry."""
    fixed = {"crank_a2_b2", "crank_ab", "q0", "x_offset", "stroke", "lever_inverse", "q_low", "q_high"}
    fixed |= {"friction_at_cylinder"}
    fields = set(dynamics.plant_parameters(machine)._fields)
    assert fields == fixed | set(plant_fmu.PARAMETER_VARIABLES), "describe the new one in sil_plant/fmu/plant_fmu.py"
    assert len(slots(dynamics.plant_parameters(machine))["kv"]) == 2


@pytest.mark.parametrize("version", plant_fmu.VERSIONS)
def test_parameter_of_the_plant_is_not_ignored(plants: dict[str, Path], version: str, slave, machine: Machine) -> None:
    """GIVEN another load, pose and supply WHEN initialised THEN the arm rests there with the pressures of the model."""
    opened = slave(plants[version]).set(load=4.0, swing_angle_start=0.3, wrist_angle_start=-0.2, p_supply=150e5)
    opened.start()
    expected = dynamics.state_at_rest(
        dynamics.plant_parameters(with_changes(machine, {"supply.pressure_Pa": 150e5}, "test")),
        np.array([0.3, -0.2]),
        4.0,
    )
    found = opened.get(*(name for name, _, _ in plant_fmu.STATE_VARIABLES))
    assert found == expected.tolist()


@pytest.mark.parametrize("version", plant_fmu.VERSIONS)
def test_wrong_use_of_the_plant_does_not_pass(plants: dict[str, Path], version: str, slave) -> None:
    """GIVEN calls out of order or with bad values WHEN made THEN each is refused with a reason, and the rest works."""
    opened = slave(plants[version])
    opened.refused(lambda: opened.fmu.doStep(0.0, 1e-3), "initialised")
    opened.refused(lambda: opened.set(load=math.nan), "finite")
    opened.refused(lambda: opened.set(load=-1.0), "0 kg or more")
    opened.refused(lambda: opened.set(swing_angle=1.0), "nothing that can be set")
    opened.set(load=1e5)
    opened.refused(opened.start, "cannot hold 100000 kg")
    opened.fmu.reset()
    opened.start()
    opened.refused(lambda: opened.set(p_supply=1e7), "after initialisation")
    opened.refused(lambda: opened.fmu.doStep(0.0, 0.0), "not possible")
    opened.refused(lambda: opened.fmu.doStep(0.0, -1e-3), "not possible")
    opened.fmu.doStep(0.0, 1e-3)
    opened.set(load=3.0)
    opened.fmu.terminate()
    opened.refused(lambda: opened.fmu.doStep(1e-3, 1e-3), "initialised")


def test_instances_of_the_plant_do_not_share_state(plants: dict[str, Path], slave) -> None:
    """GIVEN two instances WHEN one is driven, saved, driven on and restored THEN the other does not move with it."""
    one, other = slave(plants["2.0"]).start(), slave(plants["2.0"]).start()
    one.set(swing_command=0.5)
    for tick in range(20):
        for opened in (one, other):
            opened.fmu.doStep(tick * PERIOD_S, PERIOD_S)
    at_20 = one.get("swing_angle", "swing_bore_pressure")
    state = one.fmu.getFMUstate()
    kept = one.fmu.serializeFMUstate(state)
    one.fmu.doStep(0.02, 0.05)
    assert one.one("swing_angle") > at_20[0] > other.one("swing_angle") + 1e-4
    one.fmu.setFMUstate(state)
    assert one.get("swing_angle", "swing_bore_pressure") == at_20
    one.fmu.freeFMUstate(state)
    restored = other.fmu.deSerializeFMUstate(kept)
    other.fmu.setFMUstate(restored)
    assert other.get("swing_angle", "swing_bore_pressure") == at_20
    other.fmu.freeFMUstate(restored)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--load", "1000"], "cannot hold 1000 kg"),
        (["--load", "-1"], "0 kg or more"),
        (["--pose", "3", "0"], "outside"),
        (["--arm", "missing.toml"], "missing.toml"),
    ],
)
def test_export_does_not_leave_half_a_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, arguments: list[str], words: str
) -> None:
    """GIVEN an arm that cannot be exported WHEN asked to THEN status 2 and a reason, and no file."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    spec = importlib.util.spec_from_file_location("export_fmu", ROOT / "tools" / "export_fmu.py")
    assert spec and spec.loader
    tool = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(tool)
    assert tool.main(["plant", "-o", str(tmp_path / "plant.fmu"), *arguments]) == 2
    assert words in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


# ---- another tool's plant under our ECU ------------------------------------------------------------------------


def test_documented_map_is_not_another_than_the_one_that_works() -> None:
    """GIVEN docs/fmu.md WHEN its first map is compared with sil_plant/maps THEN they are the same."""
    blocks = re.findall(r"```toml\n(.*?)```", (ROOT / "docs" / "fmu.md").read_text("utf-8"), re.DOTALL)
    assert blocks[0] == MAP.read_text("utf-8")
    for block in blocks[1:]:
        tomllib.loads(block)


def test_bus_does_not_change_the_trace_of_an_fmu(plants: dict[str, Path], run_py, tmp_path: Path, native) -> None:
    """GIVEN the plant as an FMU WHEN an ECU process drives it over TCP THEN the trace is that of the built-in one."""
    result = run_py(
        "--bus", "tcp:127.0.0.1:0", "--ecu", "spawn", "--pace", "lockstep", "--duration", 0.5, "--load", LOAD_KG,
        "--fmu", plants["3.0"], "--map", MAP, "--json", tmp_path / "run.json",
    )  # fmt: skip
    assert result.returncode == 0, result.stderr
    expected = native(0.5)
    said = json.loads((tmp_path / "run.json").read_text("utf-8"))
    assert said["trace_sha256"] == session.trace_sha256(expected.record, len(expected.noise))
    assert "plant3.fmu" in said["arm"]


BARE = (
    (
        '[rates]                     # from here on: what an FMU may leave out\nswing = "swing_rate"\nwrist = "wrist_rate"',
        "",
    ),
    ('[spools]\nswing = "swing_spool"\nwrist = "wrist_spool"', ""),
    ('[spool_rates]\nswing = "swing_spool_rate"\nwrist = "wrist_spool_rate"', ""),
    ('[load]\ninput = "load"              # the scenario\'s load goes here', "[parameters]\nload = 2.5"),
)


def test_state_that_the_fmu_does_not_tell_is_not_made_up(plants: dict[str, Path], run_py, tmp_path: Path) -> None:
    """GIVEN a map without rates, spools and load WHEN run
    THEN JSON and CSV leave them out, the user is told, and the ECU still gets spools.
    """
    bare = edited(tmp_path, *BARE)
    result = run_py(
        "--bus", "inproc", "--duration", 0.3, "--fmu", plants["2.0"], "--map", bare,
        "--json", tmp_path / "run.json", "--csv", tmp_path / "run.csv",
    )  # fmt: skip
    assert result.returncode == 0, result.stderr
    assert "no spools" in result.stderr and "no load error" in result.stderr
    assert "true: not told by the plant" in result.stdout
    said = json.loads((tmp_path / "run.json").read_text("utf-8"))
    assert said["load_true_kg"] is None and said["load_err_kg"] is None and said["load_settle_s"] is None
    header, *rows = (line.split(",") for line in (tmp_path / "run.csv").read_text("utf-8").splitlines())
    last = dict(zip(header, rows[-1], strict=True))
    assert {name for name, text in last.items() if text == ""} == {
        "swing_rad_s", "wrist_rad_s", "swing_spool_1_s", "wrist_spool_1_s", "load_true_kg",
    }  # fmt: skip
    assert last["swing_spool"] == last["swing_command"] != "0", "without a lag, the command in effect"


def test_valve_lag_of_the_map_does_not_go_missing(
    plants: dict[str, Path], tmp_path: Path, machine: Machine, paper: Scenario
) -> None:
    """GIVEN a lag for an FMU without spools WHEN run THEN the spool told follows the commands in effect by that lag."""
    lag_s = 0.004
    bare = edited(tmp_path, *BARE, ("[parameters]", f"[valve]\nlag_s = {lag_s}\n[parameters]"))
    run, _ = run_external(machine, paper, plants["2.0"], bare)
    command, spool = run.record.command, run.record.state[:, dynamics.XV : dynamics.XV + 2]
    expected, value, u = np.zeros_like(spool), np.zeros(2), np.zeros(2)
    for tick in range(1, len(spool)):
        for duration, now in ((DELAY_S, u), (PERIOD_S - DELAY_S, command[tick])):
            value = value + (now - value) * (1.0 - math.exp(-duration / lag_s))
        u = command[tick]
        expected[tick] = value
    assert np.abs(spool).max() > 0.01
    assert np.abs(spool - expected).max() < 1e-12


def test_load_that_the_map_states_is_not_the_scenarios(
    plants: dict[str, Path], tmp_path: Path, machine: Machine, paper: Scenario
) -> None:
    """GIVEN a constant load in the map WHEN run with another in the scenario THEN the record has the map's."""
    stated = edited(tmp_path, ('input = "load"', "constant_kg = 1.25"))
    run, _ = run_external(machine, paper, plants["2.0"], stated, 0.05)
    assert (run.record.load_true == 1.25).all()


def test_fixed_step_of_an_fmu_is_not_ignored(
    plants: dict[str, Path], rewritten, machine: Machine, paper: Scenario, native
) -> None:
    """GIVEN FMUs with one step each WHEN it divides the tick's parts THEN the same trace to its accuracy, else a message."""
    fixed = ('canHandleVariableCommunicationStepSize="true"', 'canHandleVariableCommunicationStepSize="false"')
    expected = native(0.5).record
    good = rewritten(plants["2.0"], "half.fmu", fixed, ('stepSize="0.001"', 'stepSize="0.0005"'))
    run, _ = run_external(machine, paper, good, MAP, 0.5)
    assert np.array_equal(run.record.state, expected.state)
    finer = rewritten(plants["2.0"], "quarter.fmu", fixed, ('stepSize="0.001"', 'stepSize="0.00025"'))
    run, _ = run_external(machine, paper, finer, MAP, 0.5)
    apart = np.abs(run.record.state - expected.state)[:, dynamics.Q : dynamics.W].max()
    assert 0.0 < apart < 2e-6  # the plant's own steps end where the FMU's do
    bad = rewritten(plants["2.0"], "third.fmu", fixed, ('stepSize="0.001"', 'stepSize="0.0003"'))
    with pytest.raises(ConfigError, match=r"third\.fmu: takes steps of 0\.0003 s only.*io\.command_delay_s"):
        run_external(machine, paper, bad, MAP)


def test_fmu_that_fails_does_not_end_the_run_as_good(plants: dict[str, Path], run_py, tmp_path: Path) -> None:
    """GIVEN parameters with which the arm's state runs away WHEN run THEN status 1, what the FMU said, records kept."""
    wild = edited(tmp_path, ("[load]\n", "[parameters]\nbulk_modulus = 1e20\n[load]\n"))
    result = run_py(
        "--bus", "inproc", "--duration", 1, "--fmu", plants["2.0"], "--map", wild, "--csv", tmp_path / "run.csv"
    )
    assert result.returncode == 1, result.stderr
    assert "plant2.fmu failed in the step" in result.stderr and "no number any more" in result.stderr
    assert (tmp_path / "run.csv").exists()


def test_parameter_that_the_fmu_refuses_is_not_passed_over(
    plants: dict[str, Path], tmp_path: Path, machine: Machine, paper: Scenario
) -> None:
    """GIVEN a supply pressure that holds no load WHEN started THEN a message with the FMU's own words."""
    weak = edited(tmp_path, ("[load]\n", "[parameters]\np_supply = 2e5\n[load]\n"))
    with pytest.raises(ConfigError, match=r"plant2\.fmu: cannot be started: .*cannot hold 2\.5 kg"):
        run_external(machine, paper, plants["2.0"], weak)


MAPS = {  # what of the good map becomes what, and what is said
    "misspelt": ('"swing_angle"', '"swing_angel"', r"map\.toml:7: angles\.swing: .* no variable swing_angel; near it: swing_angle"),
    "input for output": ('swing = "swing_angle"', 'swing = "swing_command"', "no result of the FMU but its input"),
    "output for input": ('swing = "swing_command"', 'swing = "swing_spool"', "no input of the FMU but its output"),
    "twice": ('wrist = "wrist_angle"', 'wrist = "swing_angle"', r"swing_angle is angles\.swing already"),
    "other quantity": ('"wrist_bore_pressure"', '"wrist_rate"', "is in rad/s, which is no unit of absolute pressure; Pa"),
    "other unit": ('"wrist_bore_pressure"', '{ variable = "wrist_bore_pressure", unit = "bar" }', "in Pa by the FMU's own word"),
    "unknown section": ("[angles]", "[angels]", r"angels: is not a section of a map; there are angles"),
    "unknown key": ("wrist_annulus =", "wrist_anulus =", r"pressures\.wrist_anulus: is not a key.*wrist_annulus"),
    "missing": ('swing_annulus = "swing_annulus_pressure"\n', "", r"pressures\.swing_annulus: is missing"),
    "one of two": ('swing = "swing_rate"\n', "", r"rates\.wrist: stands alone"),
    "two loads": ('input = "load" ', 'constant_kg = 1.0\ninput = "load" ', r"contradicts load\.input"),
    "unknown part": ('"swing_rate"', '{ variable = "swing_rate", factor = 2 }', "factor is not known"),
    "no variable": ('"swing_rate"', "3", "a variable is needed"),
    "scale 0": ('"swing_rate"', '{ variable = "swing_rate", scale = 0 }', "scale of 0"),
    "lag and spools": ("[load]", "[valve]\nlag_s = 0.1\n[load]", "for FMUs without spools"),
    "unknown parameter": ("[load]", "[parameters]\np_suply = 1\n[load]", r"no variable p_suply; near it: p_supply"),
    "parameter that is a result": ("[load]", "[parameters]\nswing_rate = 1\n[load]", "computed by the FMU"),
    "not TOML": ("[angles]", "[angles", "not valid TOML"),
}  # fmt: skip


@pytest.mark.parametrize("name", MAPS)
def test_wrong_map_does_not_run(plants: dict[str, Path], tmp_path: Path, name: str) -> None:
    """GIVEN a map with one mistake WHEN held against the FMU THEN a message with file, key and what would do."""
    what, by, words = MAPS[name]
    with pytest.raises(ConfigError, match=words):
        ExternalPlant(plants["2.0"], edited(tmp_path, (what, by)))


def test_second_mistake_of_a_map_does_not_wait_for_another_run(plants: dict[str, Path], run_py, tmp_path: Path) -> None:
    """GIVEN a map with two wrong names WHEN run.py is started THEN status 2 and both are named, each on its line."""
    twice = edited(tmp_path, ('"swing_angle"', '"phi_1"'), ('"wrist_rate"', '"wrist_speed"'))
    result = run_py("--bus", "inproc", "--fmu", plants["2.0"], "--map", twice)
    assert result.returncode == 2
    assert "no variable phi_1" in result.stderr and "no variable wrist_speed; near it: wrist_" in result.stderr
    alone = run_py("--bus", "inproc", "--fmu", plants["2.0"])
    assert alone.returncode == 2 and "--fmu and --map go together" in alone.stderr


UNITS = {  # definition in the FMU, entry in the map: scale and offset to SI, or what is said
    "bar, defined": ('<BaseUnit kg="1" m="-1" s="-2" factor="1e5"/>', "", (1e5, 0.0)),
    "gauge, defined": ('<BaseUnit kg="1" m="-1" s="-2" factor="1e5" offset="101325"/>', "", (1e5, 101325.0)),
    "bar, named": ("", "", (1e5, 0.0)),
    "offset": ("", ", offset = 2e5", (1e5, 2e5)),
    "scale": ("", ", scale = 3.0", (3.0, 0.0)),
    "wrong quantity": ('<BaseUnit kg="1" m="1" s="-2"/>', "", "is in bar, which is no unit of absolute pressure"),
}


@pytest.mark.parametrize("name", UNITS)
def test_unit_of_an_fmu_is_not_taken_for_si(plants: dict[str, Path], rewritten, tmp_path: Path, name: str) -> None:
    """GIVEN an FMU whose pressures are in bar WHEN bound THEN converted as defined, or refused."""
    definition, entry, expected = UNITS[name]
    fmu = rewritten(
        plants["2.0"], "bar.fmu",
        ('<Unit name="Pa">\n      <BaseUnit kg="1" m="-1" s="-2" />\n    </Unit>', f'<Unit name="bar">{definition}</Unit>'),
        ('unit="Pa"', 'unit="bar"'),
    )  # fmt: skip
    changed = edited(tmp_path, ('"wrist_bore_pressure"', f'{{ variable = "wrist_bore_pressure"{entry} }}'))
    model = fmpy.read_model_description(str(fmu), validate=False)
    if isinstance(expected, str):
        with pytest.raises(ConfigError, match=expected):
            bind(load_map(changed), model, fmu)
        return
    signal = bind(load_map(changed), model, fmu)["pressures.wrist_bore"]
    assert (signal.scale, signal.offset) == expected
    assert signal.own(signal.si(0.7)) == pytest.approx(0.7)


def test_unit_that_nobody_knows_is_not_guessed(plants: dict[str, Path], rewritten, tmp_path: Path) -> None:
    """GIVEN an unknown unit, and none at all WHEN bound THEN both are refused with what to write in the map."""
    strange = rewritten(
        plants["2.0"], "strange.fmu", ('<Unit name="Pa">\n      <BaseUnit kg="1" m="-1" s="-2" />', '<Unit name="torr">'),
        ('unit="Pa"', 'unit="torr"'),
    )  # fmt: skip
    with pytest.raises(ConfigError, match=r"unit torr is not known.*scale = "):
        bind(load_map(MAP), fmpy.read_model_description(str(strange), validate=False), strange)
    silent = rewritten(plants["2.0"], "silent.fmu", ('unit="rad"', ""), ('unit="1"', ""))
    model = fmpy.read_model_description(str(silent), validate=False)
    with pytest.raises(ConfigError, match=r'swing_angle has no unit .*unit = "rad"') as caught:
        bind(load_map(MAP), model, silent)
    assert "swing_command" not in str(caught.value), "commands have no unit anyway"
    stated = edited(
        tmp_path, ('"swing_angle"', '{ variable = "swing_angle", unit = "deg" }'),
        ('"wrist_angle"', '{ variable = "wrist_angle", unit = "rad" }'),
        ('swing_angle = "swing_angle_start"\nwrist_angle = "wrist_angle_start"', ""),
    )  # fmt: skip
    assert bind(load_map(stated), model, silent)["angles.swing"].scale == pytest.approx(math.pi / 180.0)


def test_fmu_in_other_units_does_not_drive_another_way(
    plants: dict[str, Path], tmp_path: Path, machine: Machine, paper: Scenario, native
) -> None:
    """GIVEN scale and offset that cancel a known difference WHEN run THEN rounding is all that is left of it."""
    scaled = edited(
        tmp_path,
        ('"swing_bore_pressure"', '{ variable = "swing_bore_pressure", scale = 1.0, offset = 0.0 }'),
        ('swing = "swing_command"', 'swing = { variable = "swing_command", scale = 1.0 }'),
    )
    run, _ = run_external(machine, paper, plants["2.0"], scaled, 0.5)
    assert np.array_equal(run.record.state, native(0.5).record.state)
    shifted = edited(tmp_path, ('"swing_bore_pressure"', '{ variable = "swing_bore_pressure", offset = 3e5 }'))
    off, _ = run_external(machine, paper, plants["2.0"], shifted, 0.05)
    same = native(0.5).record.state[0, dynamics.P_SWING]
    assert off.record.state[0, dynamics.P_SWING] == pytest.approx(same + 3e5)


def test_fmu_that_cannot_be_used_is_not_tried(plants: dict[str, Path], rewritten, tmp_path: Path) -> None:
    """GIVEN files that are no FMU for us WHEN opened THEN each is refused with the reason and what to do."""
    good = plants["2.0"]
    text = tmp_path / "text.fmu"
    text.write_text("no zip", "utf-8")
    cut = tmp_path / "cut.fmu"
    cut.write_bytes(good.read_bytes()[:2000])
    exchange = rewritten(
        good, "exchange.fmu", ("<CoSimulation", "<ModelExchange"),
        ('canHandleVariableCommunicationStepSize="true" ', ""),
    )  # fmt: skip
    windows = rewritten(good, "windows.fmu", files=lambda name: name.replace("linux64", "win64"))
    bare = rewritten(good, "bare.fmu", files=lambda name: None if name.endswith(".so") else name)
    empty = rewritten(good, "empty.fmu", files=lambda name: name.replace("modelDescription", "other"))
    broken = rewritten(good, "broken.fmu", ("<ModelVariables>", "<ModelVariable>"))
    old = rewritten(good, "old.fmu", ('fmiVersion="2.0"', 'fmiVersion="1.0"'))
    cases = {
        tmp_path / "missing.fmu": "no such file",
        text: "is no FMU: .*zip",
        cut: "is no FMU",
        exchange: "model exchange only; export it for co-simulation",
        windows: "no binary for linux64: it has win64",
        bare: "no binary for linux64: it has none at all",
        empty: "no modelDescription.xml",
        broken: "modelDescription.xml cannot be read",
        old: "1.0|cannot be read",
    }
    for path, words in cases.items():
        with pytest.raises(ConfigError, match=words):
            ExternalPlant(path, MAP)


def test_lost_plant_says_what_it_was(plants: dict[str, Path], machine: Machine, paper: Scenario) -> None:
    """GIVEN an FMU that was terminated behind our back WHEN the run goes on THEN an error of its own kind."""
    scenario = with_load(replace(paper, duration_s=0.1), LOAD_KG)
    made = session.make_session(machine, scenario, "diarc", 1, PERIOD_S)
    with ExternalPlant(plants["2.0"], MAP) as other:
        other.start(made, scenario)
        other._fmu.terminate()
        with pytest.raises(PlantLostError, match=r"plant2\.fmu failed"):
            other.advance_one_period(made, 0.0)


# ---- our ECU as an FMU -----------------------------------------------------------------------------------------

STATES = [name for name, _, _ in plant_fmu.STATE_VARIABLES]
SENSORS = [name for name, _, _ in ecu_fmu.SENSORS]


def test_ecu_is_not_refused_by_the_validator(ecu_file: Path) -> None:
    """GIVEN the firmware as an FMU WHEN FMPy validates and simulates it THEN no finding, and STANDBY at rest."""
    assert validate_fmu(str(ecu_file)) == []
    result = fmpy.simulate_fmu(
        str(ecu_file), stop_time=0.05, output_interval=1e-3, output=["mode", "swing_command"],
        start_values={name: 5e6 for name in SENSORS if name.endswith("pressure")},
    )  # fmt: skip
    assert result["mode"][-1] == 1 and not result["swing_command"].any()


def test_closed_fmus_do_not_run_another_way_than_in_process(
    ecu_file: Path, plants: dict[str, Path], slave, native
) -> None:
    """GIVEN ECU and plant as FMUs WHEN closed in FMPy, with the run's sensor noise and requests
    THEN every state and command is that of --bus inproc, to the bit, and so are the estimates.
    """
    run = native(0.5)
    ecu, arm = slave(ecu_file).start(), slave(plants["2.0"]).set(load=LOAD_KG).start()
    schedule, command = run.schedule, [0.0, 0.0]
    for tick in range(len(run.noise)):
        if tick:
            arm.fmu.doStep((tick - 1) * PERIOD_S, DELAY_S)
            arm.set(swing_command=command[0], wrist_command=command[1])
            arm.fmu.doStep((tick - 1) * PERIOD_S + DELAY_S, PERIOD_S - DELAY_S)
        y = np.array(arm.get(*STATES))
        assert np.array_equal(y, run.record.state[tick]), tick
        noise = run.noise[tick]
        values = [*(y[:2] + noise[:2]), *(y[4:8] + noise[2:6]), *y[8:10]]
        ecu.set(**dict(zip(SENSORS, values, strict=True)))
        ecu.set(request=2 if tick >= run.timeline.run_request else 0)
        for joint, name in enumerate(("swing", "wrist")):
            due = np.nonzero((schedule.move_tick == tick) & (schedule.move_joint == joint))[0]
            ecu.set(**{f"{name}_move": bool(due.size)})
            if due.size:
                ecu.set(**{f"{name}_target": float(schedule.move_target[due[0]])})
                ecu.set(**{f"{name}_duration": float(schedule.move_ticks[due[0]] * PERIOD_S)})
        ecu.fmu.doStep(tick * PERIOD_S, PERIOD_S)
        command = ecu.get("swing_command", "wrist_command")
    assert np.abs(run.record.command).max() > 0.01, "the arm has moved"
    assert ecu.get("mode", "fault", "requests_refused", "valves_active") == [2, 0, 0, 1]
    assert ecu.get("load", "load_sd") == pytest.approx(run.monitor.load.tolist(), abs=1e-12)
    theta = [name for name in ecu.variables if name.startswith("theta.")]
    assert ecu.get(*theta) == pytest.approx(run.monitor.theta.tolist(), rel=1e-12, abs=1e-30)
    ecu.fmu.terminate()
    assert ecu.get("swing_command", "wrist_command", "valves_active") == [0.0, 0.0, 0]


def test_documented_loop_does_not_fail(ecu_file: Path, plants: dict[str, Path], tmp_path: Path) -> None:
    """GIVEN the Python of docs/fmu.md WHEN run THEN the swing joint is on its way and the load is near the true one."""
    code = re.search(r"```python\n(.*?)```", (ROOT / "docs" / "fmu.md").read_text("utf-8"), re.DOTALL)
    assert code
    (tmp_path / "build").mkdir()
    shutil.copy(ecu_file, tmp_path / "build" / "diarc_ecu.fmu")
    shutil.copy(plants["2.0"], tmp_path / "build" / "diarc_plant.fmu")
    command = [sys.executable, "-c", code[1]]
    result = subprocess.run(command, capture_output=True, text=True, timeout=LIMIT_S, cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    angle = float(result.stdout.split()[0])
    assert angle == pytest.approx(0.3, abs=2e-3), result.stdout


def test_step_that_is_no_tick_is_not_made_up(ecu_file: Path, slave) -> None:
    """GIVEN steps of another length WHEN asked for THEN discarded with a message; whole numbers of ticks are done."""
    ecu = slave(ecu_file).set(**{name: 5e6 for name in SENSORS if name.endswith("pressure")})
    ecu.refused(lambda: ecu.fmu.doStep(0.0, PERIOD_S), "initialised")
    ecu.start()
    for step in (0.0, -1e-3, 5e-4, 1.5e-3, math.nan, math.inf, 1e9):
        ecu.refused(lambda step=step: ecu.fmu.doStep(0.0, step), "one step is one tick of 0.001 s")
    ecu.fmu.doStep(0.0, PERIOD_S)
    ecu.fmu.doStep(PERIOD_S, 30 * PERIOD_S)
    assert ecu.one("mode") == 1
    slow = slave(ecu_file).set(tick_period=2e-3).start()
    slow.refused(lambda: slow.fmu.doStep(0.0, 1e-3), "0.002 s")
    slow.fmu.doStep(0.0, 2e-3)


def test_wrong_use_of_the_ecu_does_not_pass(ecu_file: Path, slave) -> None:
    """GIVEN wrong values, calls out of order and null pointers WHEN given THEN refused, and nothing crashes."""
    ecu = slave(ecu_file)
    ecu.refused(lambda: ecu.fmu.setReal([99999], [0.0]), "no parameter 98999")
    ecu.refused(lambda: ecu.fmu.setReal([1], [0.0]), "no Real that can be set")
    ecu.refused(lambda: ecu.fmu.getInteger([1]), "no Integer")
    ecu.refused(
        lambda: ecu.fmu.setString([ecu.variables["parameter_image"].valueReference], ["x" * 2000]), "1024 bytes"
    )
    ecu.refused(ecu.fmu.exitInitializationMode, "not entered")
    ecu.refused(ecu.fmu.terminate, "nothing to terminate")
    ecu.start()
    ecu.refused(ecu.fmu.enterInitializationMode, "once")
    ecu.refused(lambda: ecu.set(tick_period=2e-3), "after initialisation")
    ecu.refused(lambda: ecu.set(**{"swing.bore_m": 0.03}), "swing.bore_m cannot be set after")
    ecu.set(request=77)
    ecu.refused(lambda: ecu.fmu.doStep(0.0, PERIOD_S), "request 77")
    ecu.set(request=0)
    ecu.fmu.doStep(0.0, PERIOD_S)
    ecu.fmu.terminate()
    ecu.refused(lambda: ecu.set(request=2), "after termination")
    library = ecu.fmu.dll
    assert library.fmi2DoStep(None, ctypes.c_double(0.0), ctypes.c_double(1e-3), 0) == 3
    assert library.fmi2GetReal(None, None, ctypes.c_size_t(1), None) == 3
    assert library.fmi2Reset(None) == 3 and library.fmi2Terminate(None) == 3
    library.fmi2FreeInstance(None)
    handle = ctypes.c_void_p(ecu.fmu.component)
    assert library.fmi2GetReal(handle, None, ctypes.c_size_t(1), None) == 3


def test_fmu_of_another_build_is_not_started(ecu_file: Path, plants: dict[str, Path], rewritten, slave) -> None:
    """GIVEN a description whose GUID is another WHEN instantiated THEN no instance."""
    for fmu in (ecu_file, plants["2.0"]):
        token = fmpy.read_model_description(str(fmu)).guid
        with pytest.raises(Exception, match=r"[Ii]nstantiate"):
            slave(rewritten(fmu, f"other-{fmu.name}", (token, "{0}")))


def test_parameters_of_the_ecu_are_not_ignored(ecu_file: Path, slave, machine: Machine, tmp_path: Path) -> None:
    """GIVEN an image by path, and single parameters WHEN initialised
    THEN both are in force, the single ones above the image; bad ones are refused by name.
    """
    path = tmp_path / "arm.params"
    path.write_bytes(parameter_image(machine, {"swing.bore_m": 0.03, "estimator.gate_rate_rad_s": 0.03}))
    names = ("swing.bore_m", "estimator.gate_rate_rad_s", "wrist.bore_m")

    def single(value: float) -> float:
        return float(struct.unpack("<f", struct.pack("<f", value))[0])

    ecu = slave(ecu_file).set(parameter_image=str(path), **{"swing.bore_m": 0.031}).start()
    assert ecu.get(*names) == [single(0.031), single(0.03), single(machine["wrist.bore_m"])]
    for entry in load_parameter_table().entries[:20]:
        fresh = slave(ecu_file)
        assert fresh.one(entry.name) == single(machine[entry.name])
    bad = slave(ecu_file).set(**{"swing.bore_m": 7.0})
    bad.refused(bad.start, r"swing\.bore_m")
    bad.refused(lambda: bad.set(**{"swing.bore_m": math.nan}), r"swing\.bore_m cannot be nan")
    bad.fmu.reset()
    bad.start()
    gone = slave(ecu_file).set(parameter_image=str(tmp_path / "none.params"))
    gone.refused(gone.start, r"none\.params: the parameter image cannot be opened")
    path.write_bytes(path.read_bytes()[:-1])
    short = slave(ecu_file).set(parameter_image=str(path))
    short.refused(short.start, r"arm\.params: a parameter image of this firmware has \d+ bytes")
    path.write_bytes(parameter_image(machine)[:-1] + b"\0")
    damaged = slave(ecu_file).set(parameter_image=str(path))
    damaged.refused(damaged.start, r"arm\.params: the image .*(damaged|CRC)")


def test_request_is_not_made_twice(ecu_file: Path, slave) -> None:
    """GIVEN a request and a move that stay set WHEN ticks go on THEN each is made once; anew after a way back.

    Two requests of RUN: the second would be refused, and refusals are counted.
    """
    ecu = slave(ecu_file).set(**{name: 5e6 for name in SENSORS if name.endswith("pressure")}).start()

    def step(count: int = 1) -> None:
        for _ in range(count):
            ecu.fmu.doStep(0.0, PERIOD_S)

    ecu.set(request=4)  # RESET_FAULT: refused, for there is none
    step(20)
    assert ecu.one("requests_refused") == 1 and ecu.one("last_refusal") == 8
    ecu.set(request=0)
    step(2)
    ecu.set(request=4)
    step(5)
    assert ecu.one("requests_refused") == 2
    ecu.set(swing_move=True, swing_target=0.1)  # refused: not in RUN
    step(5)
    assert ecu.one("requests_refused") == 3
    ecu.set(swing_move=False)
    step(1)
    ecu.set(swing_move=True, wrist_move=True)
    step(5)
    assert ecu.one("requests_refused") == 5


def test_sensor_that_is_no_number_does_not_reach_the_law(ecu_file: Path, slave) -> None:
    """GIVEN a NaN from the plant WHEN it lasts THEN the ECU takes it for an invalid sensor and faults."""
    ecu = slave(ecu_file).set(**{name: 5e6 for name in SENSORS if name.endswith("pressure")}).start()
    ecu.fmu.doStep(0.0, 30 * PERIOD_S)
    ecu.set(request=2)
    ecu.fmu.doStep(0.03, 2 * PERIOD_S)
    assert ecu.get("mode", "fault") == [2, 0]
    ecu.set(swing_angle=math.nan)
    ecu.fmu.doStep(0.032, 20 * PERIOD_S)
    choices = ecu.variables["fault"].description
    assert f"{ecu.one('fault')} SENSOR_INVALID" in choices


def test_instances_of_the_ecu_do_not_share_state(ecu_file: Path, slave) -> None:
    """GIVEN two ECUs WHEN one is reset THEN the other goes on."""
    pressures = {name: 5e6 for name in SENSORS if name.endswith("pressure")}
    one, other = slave(ecu_file).set(**pressures).start(), slave(ecu_file).set(**pressures).start()
    for ecu in (one, other):
        ecu.fmu.doStep(0.0, 20 * PERIOD_S)
    one.fmu.reset()
    assert one.one("mode") == 0 and other.one("mode") == 1
    one.set(**pressures).start()
    one.fmu.doStep(0.0, 20 * PERIOD_S)
    assert one.one("mode") == 1


@pytest.mark.parametrize("compiler", ["gcc", "clang"])
def test_no_compiler_warns_of_the_fmus(compiler: str, tmp_path: Path, machine: Machine, ecu_file: Path) -> None:
    """GIVEN the C code of both FMUs WHEN compiled with the project's flags THEN no compiler says a word."""
    if shutil.which(compiler) is None:
        pytest.fail(f"{compiler} is missing: sudo apt-get install {compiler}", pytrace=False)
    model = plant_fmu.plant_model(machine, 0.0, (0.0, 0.0)).with_token()
    constants = plant_fmu._constants(model, machine, 0.0, (0.0, 0.0))
    (tmp_path / "plant_constants.h").write_text(constants, "utf-8")
    flags = [*plant_fmu.FLAGS, "-fsyntax-only", "-isystem", str(plant_fmu.fmi_headers())]
    ecu = ["-DDIARC_SCALAR_DOUBLE=1", f"-I{ROOT / 'firmware'}", f"-I{ROOT}", f"-I{ROOT / 'build' / 'fmu'}"]
    for sources, folders in (
        (sorted((ROOT / "firmware" / "ports" / "fmu").glob("*.c")), ecu),
        (sorted((ROOT / "tools" / "plant_fmu").glob("*.c")), [f"-I{tmp_path}", f"-I{ROOT / 'tools' / 'plant_fmu'}"]),
    ):
        assert sources
        result = subprocess.run(
            [compiler, *flags, *folders, *map(str, sources)], capture_output=True, text=True, timeout=LIMIT_S
        )
        assert result.returncode == 0 and result.stderr == "", result.stderr
