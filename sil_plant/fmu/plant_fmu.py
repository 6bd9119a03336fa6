"""The plant as an FMU: the equations as compiled for this process, in C that speaks FMI; no Python when it runs."""

from __future__ import annotations

import shutil
import subprocess
import tempfile
from pathlib import Path

import numpy as np

from sil_plant.config import ROOT, ConfigError
from sil_plant.fmu.description import Model, Variable, description_2, description_3, write_fmu
from sil_plant.fmu.plant_object import SCRATCH_SHAPE, flatten, plant_object, slots
from sil_plant.inputs.machine import JOINT_NAMES, Machine
from sil_plant.plant.dynamics import LONGEST_STEP_S, STATES, plant_parameters, state_at_rest

SOURCES = ROOT / "tools" / "plant_fmu"
VERSIONS = ("2.0", "3.0")
NAME = "diarc_plant"
# As those of the firmware, cmake/Flags.cmake.
FLAGS = "-std=c11 -O2 -fPIC -ffp-contract=off -Wall -Wextra -Wconversion -Wshadow -Wdouble-promotion -Werror".split()

# Value references, as in tools/plant_fmu/plant.h.
_STATE, _COMMAND, _LOAD, _START, _PARAMETER = 1, 101, 201, 202, 1000

STATE_VARIABLES = (
    *((f"{joint}_angle", "rad", f"{joint} angle") for joint in JOINT_NAMES),
    *((f"{joint}_rate", "rad/s", f"{joint} rate") for joint in JOINT_NAMES),
    *(
        (f"{joint}_{chamber}_pressure", "Pa", f"pressure of the {joint} cylinder's {chamber} chamber, absolute")
        for joint in JOINT_NAMES
        for chamber in ("bore", "annulus")
    ),
    *((f"{joint}_spool", "1", f"spool of the {joint} valve, -1..1") for joint in JOINT_NAMES),
    *((f"{joint}_spool_rate", "1/s", f"spool rate of the {joint} valve") for joint in JOINT_NAMES),
)
# Fields of PlantParameters that are parameters of the FMU: unit and description; the others stay as exported.
PARAMETER_VARIABLES = {
    "g": ("m/s2", "gravity"),
    "I1": ("kg.m2", "inertia of the swing link about its axis, without wrist link and load"),
    "L1": ("m", "swing axis to wrist axis"),
    "L2": ("m", "wrist axis to tip"),
    "m2": ("kg", "mass of the wrist link"),
    "J": ("kg.m2", "inertia of the wrist link about its axis; m2 L2^2 / 3 for a rod"),
    "coulomb_slope": ("s/rad", "slope of the Coulomb friction's arctangent at rest"),
    "fv": ("N.m.s/rad", "viscous friction"),
    "fc": ("N.m", "Coulomb friction"),
    "area1": ("m2", "piston area of the bore chamber"),
    "area2": ("m2", "piston area of the annulus chamber"),
    "dead_volume": ("m3", "dead volume of each chamber with its line"),
    "kv": (None, "valve gain, m^3/s per root of Pa at full opening"),
    "leakage": ("m3/(s.Pa)", "leakage across the piston"),
    "valve_w": ("rad/s", "natural frequency of the valve"),
    "valve_damping": ("1", "damping of the valve"),
    "overlap": ("1", "spool travel either side of the middle that passes nothing, of full travel"),
    "bulk_modulus": ("Pa", "bulk modulus of the oil"),
    "p_supply": ("Pa", "supply pressure, absolute"),
    "p_tank": ("Pa", "tank pressure, absolute"),
    "stribeck": ("1", "Stribeck peak above Coulomb friction, of it"),
    "stribeck_rate": ("rad/s", "rate at which the Stribeck peak has fallen to 1/e"),
    "air_bulk_low": ("Pa", "bulk modulus at no pressure with air in the oil; 0: no air"),
    "air_bulk_high": ("Pa", "bulk modulus at high pressure with air in the oil"),
    "air_pressure": ("Pa", "pressure at which half of the air's effect is gone"),
    "supply_sag": ("Pa.s/m3", "fall of the supply pressure per flow"),
}


def plant_model(machine: Machine, load_kg: float, pose_rad: tuple[float, float]) -> Model:
    """Describe the plant of a machine as an FMU, without a token."""
    parameters = plant_parameters(machine)
    values = flatten(parameters)
    variables = [
        Variable(f"{joint}_command", _COMMAND + i, "input", "continuous", f"{joint} spool set-point, -1..1", "1", 0.0)
        for i, joint in enumerate(JOINT_NAMES)
    ]
    variables += [
        Variable(name, _STATE + n, "output", "continuous", text, unit)
        for n, (name, unit, text) in enumerate(STATE_VARIABLES)
    ]
    variables.append(
        Variable("load", _LOAD, "parameter", "tunable", "point load at the wrist's tip", "kg", load_kg, low=0.0)
    )
    variables += [
        Variable(
            f"{joint}_angle_start", _START + i, "parameter", "fixed",
            f"{joint} angle at the start, where the arm rests", "rad", float(pose_rad[i]),
        )
        for i, joint in enumerate(JOINT_NAMES)
    ]  # fmt: skip
    for name, places in slots(parameters).items():
        if name not in PARAMETER_VARIABLES:
            continue
        unit, text = PARAMETER_VARIABLES[name]
        for i, place in enumerate(places):
            joint = f"{JOINT_NAMES[i]}." if len(places) > 1 else ""
            label = f"{JOINT_NAMES[i]}: {text}" if joint else text
            start = float(values[place])
            variables.append(Variable(f"{joint}{name}", _PARAMETER + place, "parameter", "fixed", label, unit, start))
    text = (
        f"Hydraulic arm {machine.name}: two joints, cylinders on cranks, spool valves; "
        "sil_plant/plant/dynamics.py, compiled"
    )
    return Model(NAME, text, variables, 2.0 * LONGEST_STEP_S, any_step=True, keeps_state=True)


def fmi_headers() -> Path:
    """Folder of FMI's C headers, as FMPy brings them.

    Raises
    ------
    ConfigError
        When FMPy is not installed.
    """
    try:
        import fmpy
    except ImportError as error:
        raise ConfigError("FMPy, which has FMI's headers, is missing here: make setup") from error
    return Path(fmpy.__file__).parent / "c-code"


def binary_folder(version: str) -> str:
    """Where an FMU has the binary for this machine."""
    import fmpy

    return f"binaries/{fmpy.platform if version == '2.0' else fmpy.platform_tuple}"


def _constants(model: Model, machine: Machine, load_kg: float, pose_rad: tuple[float, float]) -> str:
    values = flatten(plant_parameters(machine))

    def row(numbers: np.ndarray | tuple[float, float]) -> str:
        return ", ".join(float(number).hex() for number in numbers)

    return (
        f'#define PLANT_TOKEN "{model.token}"\n'
        f"#define PLANT_STATES {STATES}\n"
        f"#define PLANT_PARAMETERS {values.size}\n"
        f"#define PLANT_SCRATCH {int(np.prod(SCRATCH_SHAPE))}\n"
        f"#define PLANT_LOAD_KG {load_kg.hex()}\n"
        f"#define PLANT_START_VALUES {row(pose_rad)}\n"
        f"#define PLANT_PARAMETER_VALUES {row(values)}\n"
    )


def export_plant(
    machine: Machine, path: Path, load_kg: float = 0.0, pose_rad: tuple[float, float] = (0.0, 0.0), version: str = "2.0"
) -> Model:
    """Write the plant of a machine as an FMU for this machine's kind of processor.

    Parameters
    ----------
    machine : Machine
        The arm.
    path : Path
        The FMU.
    load_kg : float
        Load at the tip, until the importing tool sets another.
    pose_rad : tuple of float
        Angles at the start, the same.
    version : str
        Of FMI, one of ``VERSIONS``.

    Raises
    ------
    ConfigError
        When the arm cannot hold the load, there is no C compiler, or the file cannot be written.
    """
    parameters = plant_parameters(machine)
    try:
        state_at_rest(parameters, np.array(pose_rad), load_kg)
    except ValueError as error:
        raise ConfigError(f"{error} with the supply of {machine.name}") from error
    if shutil.which("gcc") is None:
        raise ConfigError("gcc is missing: sudo apt-get install gcc libc6-dev")
    equations = plant_object(parameters)
    model = plant_model(machine, load_kg, pose_rad).with_token(equations + version.encode())
    with tempfile.TemporaryDirectory(prefix="diarc-") as name:
        folder = Path(name)
        (folder / "plant_constants.h").write_text(_constants(model, machine, load_kg, pose_rad), encoding="utf-8")
        (folder / "equations.o").write_bytes(equations)
        library = folder / f"{NAME}.so"
        command = [
            "gcc", *FLAGS, "-shared", "-fvisibility=hidden", "-isystem", str(fmi_headers()), "-I", str(folder),
            "-I", str(SOURCES), str(SOURCES / "plant.c"), str(SOURCES / f"fmi{version[0]}.c"),
            str(folder / "equations.o"), "-o", str(library),
            "-Wl,-Bsymbolic", "-Wl,-z,defs", "-Wl,-z,noexecstack", "-s", "-lm",
        ]  # fmt: skip
        result = subprocess.run(command, capture_output=True, text=True)
        if result.returncode:
            raise ConfigError(f"the FMU's C code does not compile:\n{result.stderr.strip()}")
        describe = description_2 if version == "2.0" else description_3
        files = {
            "modelDescription.xml": describe(model).encode(),
            f"{binary_folder(version)}/{NAME}.so": library.read_bytes(),
        }
    write_fmu(path, files)
    return model
