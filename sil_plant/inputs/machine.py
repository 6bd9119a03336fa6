"""A machine file (``arms/*.toml``): read, checked, completed, and made into the firmware's parameter image."""

from __future__ import annotations

import functools
import hashlib
import struct
import zlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sil_plant.config import ROOT, ConfigError, TomlFile, flatten, tomllib

ARMS = ROOT / "sil_plant" / "arms"
REFERENCE_ARM = ARMS / "reference.toml"
PARAMETERS = ROOT / "can_protocol" / "parameters.toml"
JOINT_NAMES = ("swing", "wrist")

IMAGE_MAGIC = b"DIAR"

# What only the plant reads; the rest of a machine file is in can_protocol/parameters.toml.
PLANT_RANGES: dict[str, tuple[float, float]] = {
    "wrist.mass_kg": (0.01, 1e5),
    "*.valve_frequency_Hz": (5.0, 500.0),
    "*.valve_damping": (0.2, 3.0),
    "*.viscous_Nms_rad": (0.0, 1e5),
    "*.coulomb_Nm": (0.0, 1e5),
    "oil.bulk_modulus_Pa": (1e8, 3e9),
    "sensors.encoder_noise_rad": (0.0, 0.1),
    "sensors.pressure_noise_Pa": (0.0, 1e6),
    "io.command_delay_s": (0.0, 0.02),
    "io.valve_timeout_s": (1e-3, 1.0),
}
# What makes the plant less kind than the paper's; each by itself, none by default. docs/scenario.md explains them.
EFFECTS: dict[str, tuple[float, float, float]] = {  # default, low, high
    "effects.stribeck": (0.0, 0.0, 2.0),
    "effects.stribeck_rate_rad_s": (0.02, 1e-3, 1.0),
    "effects.hysteresis": (0.0, 0.0, 0.2),
    "effects.air_bulk_low_Pa": (0.0, 0.0, 3e9),
    "effects.air_bulk_high_Pa": (1.2e9, 1e8, 3e9),
    "effects.air_pressure_Pa": (30e5, 1e4, 1e8),
    "effects.supply_sag_Pa_s_m3": (0.0, 0.0, 1e12),
    "effects.encoder_bits": (0.0, 0.0, 24.0),
    "effects.pressure_gain_error": (0.0, 0.0, 0.1),
    "effects.pressure_offset_Pa": (0.0, 0.0, 1e6),
    "effects.sensor_set": (1.0, 0.0, 1e6),
    "effects.sync_jitter_s": (0.0, 0.0, 5e-4),
    "effects.frame_loss": (0.0, 0.0, 0.2),
    "effects.viscosity_factor": (1.0, 0.1, 10.0),
}
BASE_KEYS = ("pressure_log2", "area_log2", "lever_log2")


@dataclass(frozen=True)
class Parameter:
    """One entry of the parameter image."""

    name: str
    field: str
    quantity: str
    exponents: tuple[int, int, int]
    gain: bool
    low: float
    high: float
    text: str


@dataclass(frozen=True)
class ParameterTable:
    """All entries, in image order, and the hash that tells one layout from another."""

    entries: tuple[Parameter, ...]
    layout_hash: int
    bases: dict[str, tuple[int, int]]


@dataclass(frozen=True)
class Machine:
    """A checked machine file.

    Attributes
    ----------
    name : str
        As the file says.
    path : Path
        The file.
    base : dict
        Binary logarithms of the per-unit bases.
    values : dict
        Every number by its dotted key, SI; priors completed.
    """

    name: str
    path: Path
    base: dict[str, int]
    values: dict[str, float] = field(default_factory=dict)

    def __getitem__(self, key: str) -> float:
        """The number at a dotted key."""
        return self.values[key]

    def pair(self, key: str) -> tuple[float, float]:
        """Values of swing and wrist for a key with ``*`` in the joint's place."""
        return self.values[key.replace("*", "swing")], self.values[key.replace("*", "wrist")]


@functools.cache
def load_parameter_table(path: Path = PARAMETERS) -> ParameterTable:
    """Read ``parameters.toml`` and expand its joints and priors."""
    tree = tomllib.loads(path.read_text(encoding="utf-8"))
    quantities = {name: tuple(exponents) for name, exponents in tree["quantities"].items()}
    entries: list[Parameter] = []
    for item in tree["parameter"]:
        joints = range(len(JOINT_NAMES)) if "*" in item["name"] else [0]
        for joint in joints:
            entries.append(
                Parameter(
                    name=item["name"].replace("*", JOINT_NAMES[joint]),
                    field=item["field"].replace("*", str(joint)),
                    quantity=item["quantity"],
                    exponents=quantities[item["quantity"]],
                    gain=item.get("gain", False),
                    low=item["low"],
                    high=item["high"],
                    text=item["text"],
                )
            )
    for item in tree["prior"]:
        for part in ("value", "sd", "low", "high"):
            entries.append(
                Parameter(
                    name=f"estimator.prior.{item['name']}.{part}",
                    field=f"{item['field']}.{part}",
                    quantity=item["quantity"],
                    exponents=quantities[item["quantity"]],
                    gain=False,
                    low=0.0 if part == "sd" else -1e6,
                    high=1e6,
                    text=f"{item['text']}: {part}",
                )
            )
    layout = "\n".join(f"{e.name} {e.field} {e.exponents} {e.gain}" for e in entries)
    digest = hashlib.sha256(layout.encode()).digest()
    bases = {key: (low, high) for key, (low, high) in tree["bases"].items()}
    return ParameterTable(tuple(entries), int.from_bytes(digest[:4], "big"), bases)


def machine_ranges() -> dict[str, tuple[float, float]]:
    """Every number that a machine file can have, and its range."""
    ranges = {entry.name: (entry.low, entry.high) for entry in load_parameter_table().entries}
    for key, bounds in PLANT_RANGES.items():
        for joint in JOINT_NAMES if "*" in key else ("",):
            ranges[key.replace("*", joint)] = bounds
    ranges |= {key: (low, high) for key, (_, low, high) in EFFECTS.items()}
    return ranges


def prior_values(values: dict[str, float]) -> dict[str, float]:
    """What the priors' values are when the file leaves them to its other sections."""
    mass, length = values["wrist.mass_kg"], values["wrist.link_length_m"]
    prior = {
        "m_t_kg": 0.0,
        "J_kgm2": mass * length**2 / 3.0,
        "m2_kg": mass,
        "beta_inverse_1_Pa": 1.0 / values["oil.bulk_modulus_Pa"],
    }
    for joint in JOINT_NAMES:
        prior[f"fv_{joint}_Nms_rad"] = values[f"{joint}.viscous_Nms_rad"]
        prior[f"fc_{joint}_Nm"] = values[f"{joint}.coulomb_Nm"]
        prior[f"Om1_{joint}_Nm"] = 0.0
        prior[f"Om2_{joint}_m3_s"] = 0.0
        prior[f"Om3_{joint}_m3_s"] = 0.0
    return {f"estimator.prior.{name}.value": value for name, value in prior.items()}


def load_machine(path: Path) -> Machine:
    """Read and check a machine file.

    Parameters
    ----------
    path : Path
        A TOML file as ``arms/reference.toml``.

    Raises
    ------
    ConfigError
        Naming file, line, key and range.
    """
    toml = TomlFile(path)
    table = load_parameter_table()
    ranges = machine_ranges()
    found = dict(flatten(toml.data))
    name = found.pop("name", path.stem)
    if not isinstance(name, str):
        raise toml.error("name", "a text is needed")
    base: dict[str, int] = {}
    for key in BASE_KEYS:
        value = found.pop(f"base.{key}", None)
        if value is None:
            raise toml.error(f"base.{key}", "is missing")
        low, high = table.bases[key]
        if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
            raise toml.error(f"base.{key}", f"a whole number from {low} to {high} is needed, not {value!r}")
        base[key] = value
    low, high = table.bases["torque_log2"]
    if not low <= sum(base.values()) <= high:
        raise toml.error("base.pressure_log2", f"the sum of the three must be from {low} to {high}")
    for key in ("pressure_log2", "area_log2"):
        if base[key] % 2:
            raise toml.error(f"base.{key}", "must be even: some quantities' bases have its square root")
    values: dict[str, float] = {}
    for key, value in found.items():
        if key not in ranges:
            raise toml.error(key, "is not a key of a machine file; see sil_plant/arms/reference.toml")
        values[key] = toml.number(key, value, *ranges[key])
    optional = set(EFFECTS) | {
        f"estimator.prior.{e.name.split('.')[2]}.value" for e in table.entries if ".prior." in e.name
    }
    for key in ranges:
        if key not in values and key not in optional:
            raise toml.error(key, "is missing")
    values = {key: default for key, (default, _, _) in EFFECTS.items()} | prior_values(values) | values
    _check_relations(toml, values)
    return Machine(name=name, path=path, base=base, values=values)


def _check_relations(toml: TomlFile, values: dict[str, float]) -> None:
    for joint in JOINT_NAMES:
        if values[f"{joint}.rod_m"] >= values[f"{joint}.bore_m"]:
            raise toml.error(f"{joint}.rod_m", "must be smaller than the bore")
        if values[f"{joint}.q_min_rad"] >= values[f"{joint}.q_max_rad"]:
            raise toml.error(f"{joint}.q_min_rad", "must be below q_max_rad")
        for end in ("q_min_rad", "q_max_rad"):
            triangle = values[f"{joint}.{end}"] + values[f"{joint}.crank_q0_rad"]
            if not 0.05 <= triangle <= 3.09:
                raise toml.error(
                    f"{joint}.{end}",
                    f"the lever arm vanishes: {end} + crank_q0_rad = {triangle:.3f} must be in 0.05 to 3.09",
                )
    if values["supply.tank_Pa"] >= values["supply.pressure_Pa"]:
        raise toml.error("supply.tank_Pa", "must be below the supply pressure")
    for key in [k for k in values if k.endswith(".sd")]:
        stem = key.removesuffix(".sd")
        low, value, high = (values[f"{stem}.{part}"] for part in ("low", "value", "high"))
        if not low < high or not low <= value <= high:
            raise toml.error(key, f"its prior needs low < high and low <= value <= high: {low:g}, {value:g}, {high:g}")


def with_changes(machine: Machine, changes: dict[str, float], where: str) -> Machine:
    """The machine with some of its numbers replaced, for a plant that differs from what the ECU believes.

    Parameters
    ----------
    machine : Machine
        The machine to start from.
    changes : dict
        New values by dotted key.
    where : str
        Where they come from, for the message.

    Raises
    ------
    ConfigError
        For an unknown key or a value outside its range.
    """
    ranges = machine_ranges()
    for key, value in changes.items():
        if key not in ranges or key not in machine.values:
            raise ConfigError(f"{where}: {key} is not a number of {machine.path.name}")
        low, high = ranges[key]
        if not low <= value <= high:
            raise ConfigError(f"{where}: {key} = {value:g} is outside {low:g} to {high:g}")
    return Machine(machine.name, machine.path, machine.base, machine.values | changes)


def parameter_image(machine: Machine, changes: dict[str, Any] | None = None) -> bytes:
    """Make the image that the firmware starts from: ``diarc_ecu --params FILE``.

    Little-endian: magic, layout hash, three base exponents and a zero (int8), one binary32 per parameter in
    table order, CRC-32 of all that.

    Parameters
    ----------
    machine : Machine
        The checked machine.
    changes : dict, optional
        Values by dotted key that replace the machine's.
    """
    table = load_parameter_table()
    values = machine.values | (changes or {})
    unknown = set(changes or {}) - {entry.name for entry in table.entries}
    if unknown:
        raise ConfigError(f"{sorted(unknown)[0]}: is not a parameter of the firmware")
    body = IMAGE_MAGIC + struct.pack("<I", table.layout_hash)
    body += struct.pack("<4b", *(machine.base[key] for key in BASE_KEYS), 0)
    body += struct.pack(f"<{len(table.entries)}f", *(values[entry.name] for entry in table.entries))
    return body + struct.pack("<I", zlib.crc32(body))


def key_ranges() -> dict[str, tuple[float, float]]:
    """Every key that a machine file can have, and its range."""
    return machine_ranges()


def check_relations(machine: Machine) -> None:
    """Check what no single range can tell, as for a machine file: rod and bore, joint range and lever arm, priors.

    Raises
    ------
    ConfigError
        Naming the keys.
    """
    _check_relations(TomlFile(machine.path), machine.values)
