"""The firmware as an FMU: its variables from the DBC and the parameter list, as C for the port and as XML.

The C side is firmware/ports/fmu; CMake builds it and calls tools/export_fmu.py for what is here.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sil_plant.bus import protocol
from sil_plant.fmu.description import Model, Variable, description_2, write_fmu
from sil_plant.fmu.plant_fmu import binary_folder
from sil_plant.inputs.machine import JOINT_NAMES, REFERENCE_ARM, load_machine, load_parameter_table
from sil_plant.loop.io_node import node_layout

NAME = "diarc_ecu"
PERIOD_US = 1000
DURATION_S = 1.0
# Value references; the C side gets them from here.
REFERENCES = {
    "OUTPUT": 1,
    "SENSOR": 100,
    "TARGET": 110,
    "DURATION": 112,
    "PERIOD": 114,
    "REQUEST": 200,
    "CONTROLLER": 201,
    "MODE": 202,
    "FAULT": 203,
    "REFUSED": 204,
    "REFUSAL": 205,
    "MOVE": 300,
    "ACTIVE": 302,
    "IMAGE": 400,
    "PARAMETER": 1000,
}
# SI units of the DBC's, as FMI writes them, and how a raw step becomes SI: to the bit as the I/O node does it.
_SI = {
    "%": ("1", lambda scale: scale / 100.0),
    "bar": ("Pa", lambda scale: scale * 1e5),
    "rad": ("rad", float),
    "kg": ("kg", float),
    "kg m^2": ("kg.m2", float),
    "N m": ("N.m", float),
    "N m s/rad": ("N.m.s/rad", float),
    "1/Pa": ("1/Pa", float),
    "m^3/s": ("m3/s", float),
    "": ("1", float),
}
# Ends of parameter names and the units they mean; the longest that fits counts.
_SUFFIX_UNITS = {
    "_m": "m",
    "_m_s2": "m/s2",
    "_rad": "rad",
    "_rad_s": "rad/s",
    "_s": "s",
    "_1_s": "1/s",
    "_kg": "kg",
    "_kgm2": "kg.m2",
    "_Pa": "Pa",
    "_1_Pa": "1/Pa",
    "_m3": "m3",
    "_m3_s": "m3/s",
    "_m3_s_Pa": "m3/(s.Pa)",
    "_m2_s": "m2/s",
    "_Nm": "N.m",
    "_Nms_rad": "N.m.s/rad",
    "_m_per_m": None,
    "_1_s2": None,
    "_Nm_rad_s": None,
    "_Nm2_s": None,
}


@dataclass(frozen=True)
class _Output:
    """A signal that the ECU sends, as a variable."""

    name: str
    frame: str
    signal: Any
    page: int | None
    selector: Any


def _outputs() -> list[_Output]:
    wanted = [
        ("swing_command", "VALVES", "SwingSpool"),
        ("wrist_command", "VALVES", "WristSpool"),
        ("load", "ESTIMATE", "Load"),
        ("load_sd", "ESTIMATE", "LoadSd"),
    ]
    for joint in JOINT_NAMES:
        wanted.append((f"{joint}_error", "TRACKING", f"{joint.title()}Error"))
        wanted.append((f"{joint}_reference", "TRACKING", f"{joint.title()}Reference"))
    for signal in protocol.database().get_message_by_name("PARAMETERS").signals:
        for prefix, folder in (("theta_", "theta"), ("sd_", "theta_sd")):
            if signal.name.startswith(prefix):
                wanted.append((f"{folder}.{signal.name.removeprefix(prefix)}", "PARAMETERS", signal.name))
    outputs = []
    for name, frame, signal_name in wanted:
        message = protocol.database().get_message_by_name(frame)
        signal = message.get_signal_by_name(signal_name)
        selector = message.get_signal_by_name(signal.multiplexer_signal) if signal.multiplexer_signal else None
        page = signal.multiplexer_ids[0] if signal.multiplexer_ids else None
        outputs.append(_Output(name, frame, signal, page, selector))
    return outputs


def _text(output: _Output) -> str:
    special = {
        "swing_command": "spool set-point of the swing valve, -1..1; drive it only while valves_active",
        "wrist_command": "spool set-point of the wrist valve, -1..1; drive it only while valves_active",
    }
    if output.name in special:
        return special[output.name]
    if output.signal.comment:
        return str(output.signal.comment)
    words = {"theta.": "estimated parameter ", "theta_sd.": "standard deviation of the estimate of "}
    for prefix, text in words.items():
        if output.name.startswith(prefix):
            return text + output.name.removeprefix(prefix)
    return output.name.replace("_", " ")


SENSORS = (
    *((f"{joint}_angle", "rad", f"{joint} angle") for joint in JOINT_NAMES),
    *(
        (f"{joint}_{chamber}_pressure", "Pa", f"pressure of the {joint} cylinder's {chamber} chamber, absolute")
        for joint in JOINT_NAMES
        for chamber in ("bore", "annulus")
    ),
    *((f"{joint}_spool", "1", f"spool of the {joint} valve, -1..1") for joint in JOINT_NAMES),
)


def _parameter_unit(name: str) -> str | None:
    stem = name.split(".")[-2] if name.startswith("estimator.prior.") else name.split(".")[-1]
    fits = [suffix for suffix in _SUFFIX_UNITS if stem.endswith(suffix)]
    return _SUFFIX_UNITS[max(fits, key=len)] if fits else None


def _single(value: float) -> float:
    """The number as binary32 holds it."""
    return float(struct.unpack("<f", struct.pack("<f", value))[0])


def _choices(frame: str, signal: str) -> str:
    choices = protocol.database().get_message_by_name(frame).get_signal_by_name(signal).choices
    return ", ".join(f"{code} {name}" for code, name in sorted(choices.items()))


def ecu_model() -> Model:
    """Describe the firmware as an FMU."""
    at = REFERENCES
    variables = [
        Variable(name, at["SENSOR"] + k, "input", "continuous", f"{text}; no number: invalid", unit, 0.0)
        for k, (name, unit, text) in enumerate(SENSORS)
    ]
    text = "a request is made in the first step with this value: " + _choices("MOTION", "Request")
    variables.append(Variable("request", at["REQUEST"], "input", "discrete", text, None, 0, "Integer", 0, 8))
    text = "controller of the next RUN: " + _choices("MOTION", "Controller")
    variables.append(Variable("controller", at["CONTROLLER"], "input", "discrete", text, None, 2, "Integer", 0, 2))
    for i, joint in enumerate(JOINT_NAMES):
        text = f"from false to true: the {joint} joint begins a move to {joint}_target"
        variables.append(Variable(f"{joint}_move", at["MOVE"] + i, "input", "discrete", text, None, False, "Boolean"))
        text = f"angle at the end of the next move of the {joint} joint"
        variables.append(Variable(f"{joint}_target", at["TARGET"] + i, "input", "continuous", text, "rad", 0.0))
        text = f"duration of the next move of the {joint} joint"
        variables.append(
            Variable(f"{joint}_duration", at["DURATION"] + i, "input", "continuous", text, "s", DURATION_S)
        )
    variables += [
        Variable(output.name, at["OUTPUT"] + k, "output", "discrete", _text(output), _SI[output.signal.unit or ""][0])
        for k, output in enumerate(_outputs())
    ]
    for name, key, text in (
        ("mode", "MODE", _choices("VALVES", "Mode")),
        ("fault", "FAULT", "first of the active faults, docs/faults.md: " + _choices("TIMING", "FaultCode")),
        ("requests_refused", "REFUSED", "requests and moves that were not carried out"),
        ("last_refusal", "REFUSAL", "why the last one was not: " + _choices("TIMING", "LastRefusal")),
    ):
        variables.append(Variable(name, at[key], "output", "discrete", text, type="Integer"))
    text = "the valves are to be driven; else they shut, whatever the commands say"
    variables.append(Variable("valves_active", at["ACTIVE"], "output", "discrete", text, type="Boolean"))
    text = "tick; the communication step is one tick or a whole number of them"
    variables.append(
        Variable("tick_period", at["PERIOD"], "parameter", "fixed", text, "s", PERIOD_US * 1e-6, low=2.5e-4, high=0.02)
    )
    text = "path of a parameter image (tools/commission.py, docs/fmu.md); empty: the machine parameters below"
    variables.append(Variable("parameter_image", at["IMAGE"], "parameter", "fixed", text, None, "", "String"))
    machine = load_machine(REFERENCE_ARM)
    for k, entry in enumerate(load_parameter_table().entries):
        variables.append(
            Variable(
                entry.name, at["PARAMETER"] + k, "parameter", "fixed", entry.text, _parameter_unit(entry.name),
                _single(machine[entry.name]), low=_single(entry.low), high=_single(entry.high),
            )
        )  # fmt: skip
    text = "DIARC ECU: adaptive robust control of a two-joint hydraulic arm, the firmware itself"
    return Model(NAME, text, variables, PERIOD_US * 1e-6, any_step=False).with_token(
        f"{protocol.dbc_hash()} {load_parameter_table().layout_hash}".encode()
    )


def _field(signal: Any) -> str:
    return f"{{{signal.start}, {signal.length}}}"


def variables_header() -> str:
    """``ports/fmu/variables.h``: what the C side needs to know of the DBC and of the variables."""
    layout = node_layout()
    message = protocol.database().get_message_by_name
    encoders, motion, valves = message("ENCODERS"), message("MOTION"), message("VALVES")
    rows = [
        f"{{{encoders.frame_id}, {_field(encoders.get_signal_by_name(f'{joint.title()}Angle'))}, "
        f"-8388607, 8388607, -8388608, {layout.angle_step.hex()}}}"
        for joint in JOINT_NAMES
    ]
    frames = [message(f"PRESSURES_{joint.upper()}") for joint in JOINT_NAMES]
    pressure_step = layout.pressure_step.hex()
    rows += [
        f"{{{frame.frame_id}, {_field(frame.get_signal_by_name(signal))}, 0, 65534, 65535, {pressure_step}}}"
        for frame in frames
        for signal in ("BorePressure", "AnnulusPressure")
    ]
    rows += [
        f"{{{frame.frame_id}, {_field(frame.get_signal_by_name('SpoolPosition'))}, -32767, 32767, -32768, "
        f"{layout.spool_step.hex()}}}"
        for frame in frames
    ]
    outputs = []
    for output in _outputs():
        signal, scale = output.signal, _SI[output.signal.unit or ""][1]
        selector = _field(output.selector) if output.selector is not None else "{0, 0}"
        outputs.append(
            f"{{{message(output.frame).frame_id}, {selector}, {output.page or 0}, {_field(signal)}, "
            f"{'true' if signal.is_signed else 'false'}, {scale(signal.scale).hex()}}}"
        )
    for signal in (*encoders.signals, *motion.signals, *valves.signals):
        assert signal.byte_order == "little_endian"
    active = next(code for code, name in valves.get_signal_by_name("SwingControl").choices.items() if name == "ACTIVE")

    def table(lines: list[str]) -> str:
        return ", \\\n    ".join(lines)

    lines = [
        "/* Made by tools/export_fmu.py; do not edit. */",
        "#ifndef PORTS_FMU_VARIABLES_H",
        "#define PORTS_FMU_VARIABLES_H",
        "",
        f'#define FMU_TOKEN "{ecu_model().token}"',
        *(f"#define FMU_REFERENCE_{name} {number}u" for name, number in REFERENCES.items()),
        f"#define FMU_PERIOD_US {PERIOD_US}u",
        f"#define FMU_PERIOD_S {PERIOD_US * 1e-6!r}",
        f"#define FMU_DURATION_S {DURATION_S!r}",
        f"#define FMU_SYNC_ID {protocol.SYNC_ID}u",
        f"#define FMU_NMT_ID {protocol.NMT_ID}u",
        f"#define FMU_MOTION_ID {motion.frame_id}u",
        f"#define FMU_VALVES_ID {valves.frame_id}u",
        f"#define FMU_VALVES_ACTIVE {active}u",
        "#define FMU_VALVES_CONTROL "
        + ", ".join(_field(valves.get_signal_by_name(f"{joint.title()}Control")) for joint in JOINT_NAMES),
        *(
            f"#define FMU_MOTION_{name.upper()} {_field(motion.get_signal_by_name(name))}"
            for name in ("Request", "Joint", "Controller", "Target", "Duration")
        ),
        f"#define FMU_MOTION_TARGET_STEP {protocol.scale('MOTION', 'Target').hex()}",
        "#define FMU_SENSOR_FRAMES " + ", ".join(str(frame.frame_id) for frame in (encoders, *frames)),
        f"#define FMU_SENSOR_COUNT {len(rows)}u",
        f"#define FMU_SENSORS \\\n    {table(rows)}",
        f"#define FMU_OUTPUT_COUNT {len(outputs)}u",
        f"#define FMU_OUTPUTS \\\n    {table(outputs)}",
        "",
        "#endif",
    ]
    return "\n".join(lines) + "\n"


def pack(library: Path, path: Path) -> None:
    """Put the built port and its description into an FMU.

    Raises
    ------
    ConfigError
        When the file cannot be written.
    """
    write_fmu(
        path,
        {
            "modelDescription.xml": description_2(ecu_model()).encode(),
            f"{binary_folder('2.0')}/{NAME}.so": library.read_bytes(),
        },
    )
