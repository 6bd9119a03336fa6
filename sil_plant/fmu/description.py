"""What an FMU says of itself: ``modelDescription.xml`` of FMI 2.0 and 3.0 from one list of variables, and the zip."""

from __future__ import annotations

import hashlib
import os
import zipfile
from dataclasses import dataclass, field
from pathlib import Path
from xml.etree import ElementTree

from sil_plant.config import ConfigError

# Units by the names our FMUs use; exponents of SI base units as FMI writes them.
UNITS: dict[str, dict[str, int]] = {
    "1": {},
    "rad": {"rad": 1},
    "rad/s": {"rad": 1, "s": -1},
    "s/rad": {"rad": -1, "s": 1},
    "s": {"s": 1},
    "Hz": {"s": -1},
    "1/s": {"s": -1},
    "m": {"m": 1},
    "m2": {"m": 2},
    "m3": {"m": 3},
    "m/s2": {"m": 1, "s": -2},
    "m2/s": {"m": 2, "s": -1},
    "m3/s": {"m": 3, "s": -1},
    "kg": {"kg": 1},
    "kg.m2": {"kg": 1, "m": 2},
    "N.m": {"kg": 1, "m": 2, "s": -2},
    "N.m.s/rad": {"kg": 1, "m": 2, "s": -1, "rad": -1},
    "Pa": {"kg": 1, "m": -1, "s": -2},
    "Pa/s": {"kg": 1, "m": -1, "s": -3},
    "1/Pa": {"kg": -1, "m": 1, "s": 2},
    "m3/(s.Pa)": {"kg": -1, "m": 4, "s": 1},
    "Pa.s/m3": {"kg": 1, "m": -4, "s": -1},
}
_TYPES_3 = {"Real": "Float64", "Integer": "Int32", "Boolean": "Boolean", "String": "String"}


@dataclass(frozen=True)
class Variable:
    """One variable of an FMU; ``start`` None for what the FMU computes."""

    name: str
    reference: int
    causality: str
    variability: str
    description: str
    unit: str | None = None
    start: float | int | bool | str | None = None
    type: str = "Real"
    low: float | None = None
    high: float | None = None


@dataclass(frozen=True)
class Model:
    """An FMU's description but for its format."""

    name: str
    description: str
    variables: list[Variable]
    step_s: float
    any_step: bool
    keeps_state: bool = False
    version: str = "0.1.0"
    token: str = field(default="", compare=False)

    def with_token(self, more: bytes = b"") -> Model:
        """The model with a token that changes with any variable and with ``more``, the code behind them."""
        digest = hashlib.sha256(repr((self.name, self.variables, self.step_s)).encode() + more).hexdigest()
        text = f"{{{digest[:8]}-{digest[8:12]}-{digest[12:16]}-{digest[16:20]}-{digest[20:32]}}}"
        return Model(
            self.name,
            self.description,
            self.variables,
            self.step_s,
            self.any_step,
            self.keeps_state,
            self.version,
            text,
        )


def _text(value: float | int | bool | str) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    return value if isinstance(value, str) else repr(value)


def _add_units(root: ElementTree.Element, variables: list[Variable]) -> None:
    used = sorted({variable.unit for variable in variables if variable.unit})
    if used:
        definitions = ElementTree.SubElement(root, "UnitDefinitions")
        for name in used:
            unit = ElementTree.SubElement(definitions, "Unit", name=name)
            ElementTree.SubElement(unit, "BaseUnit", {key: str(power) for key, power in UNITS[name].items()})


def _value_attributes(variable: Variable) -> dict[str, str]:
    attributes = {}
    if variable.unit:
        attributes["unit"] = variable.unit
    if variable.low is not None:
        attributes["min"] = _text(variable.low)
    if variable.high is not None:
        attributes["max"] = _text(variable.high)
    if variable.start is not None:
        attributes["start"] = _text(variable.start)
    return attributes


def _initial(variable: Variable) -> dict[str, str]:
    if variable.causality in ("output", "local"):
        return {"initial": "calculated"}
    return {}


def _is_computed(variable: Variable) -> bool:
    return variable.causality == "output"


def description_2(model: Model) -> str:
    """``modelDescription.xml`` of FMI 2.0."""
    root = ElementTree.Element(
        "fmiModelDescription",
        fmiVersion="2.0",
        modelName=model.name,
        guid=model.token,
        description=model.description,
        version=model.version,
        generationTool="DIARC ECU",
        variableNamingConvention="structured",
        numberOfEventIndicators="0",
    )
    ElementTree.SubElement(
        root,
        "CoSimulation",
        modelIdentifier=model.name,
        canHandleVariableCommunicationStepSize=_text(model.any_step),
        canNotUseMemoryManagementFunctions="true",
        canGetAndSetFMUstate=_text(model.keeps_state),
        canSerializeFMUstate=_text(model.keeps_state),
    )
    _add_units(root, model.variables)
    categories = ElementTree.SubElement(root, "LogCategories")
    for name in ("logStatusWarning", "logStatusDiscard", "logStatusError"):
        ElementTree.SubElement(categories, "Category", name=name)
    ElementTree.SubElement(root, "DefaultExperiment", startTime="0", stepSize=_text(model.step_s))
    variables = ElementTree.SubElement(root, "ModelVariables")
    for variable in model.variables:
        scalar = ElementTree.SubElement(
            variables,
            "ScalarVariable",
            {
                "name": variable.name,
                "valueReference": str(variable.reference),
                "description": variable.description,
                "causality": variable.causality,
                "variability": variable.variability,
            }
            | _initial(variable),
        )
        ElementTree.SubElement(scalar, variable.type, _value_attributes(variable))
    structure = ElementTree.SubElement(root, "ModelStructure")
    computed = [str(n) for n, variable in enumerate(model.variables, start=1) if _is_computed(variable)]
    for kind in ("Outputs", "InitialUnknowns"):
        unknowns = ElementTree.SubElement(structure, kind)
        for index in computed:
            ElementTree.SubElement(unknowns, "Unknown", index=index)
    return _xml(root)


def description_3(model: Model) -> str:
    """``modelDescription.xml`` of FMI 3.0."""
    root = ElementTree.Element(
        "fmiModelDescription",
        fmiVersion="3.0",
        modelName=model.name,
        instantiationToken=model.token,
        description=model.description,
        version=model.version,
        generationTool="DIARC ECU",
        variableNamingConvention="structured",
    )
    ElementTree.SubElement(
        root,
        "CoSimulation",
        modelIdentifier=model.name,
        canHandleVariableCommunicationStepSize=_text(model.any_step),
        canGetAndSetFMUState=_text(model.keeps_state),
        canSerializeFMUState=_text(model.keeps_state),
    )
    _add_units(root, model.variables)
    ElementTree.SubElement(root, "DefaultExperiment", startTime="0", stepSize=_text(model.step_s))
    variables = ElementTree.SubElement(root, "ModelVariables")
    ElementTree.SubElement(
        variables, "Float64", name="time", valueReference="0", causality="independent", variability="continuous"
    )
    for variable in model.variables:
        attributes = {
            "name": variable.name,
            "valueReference": str(variable.reference),
            "description": variable.description,
            "causality": variable.causality,
            "variability": variable.variability,
        }
        ElementTree.SubElement(
            variables, _TYPES_3[variable.type], attributes | _initial(variable) | _value_attributes(variable)
        )
    structure = ElementTree.SubElement(root, "ModelStructure")
    for kind in ("Output", "InitialUnknown"):
        for variable in filter(_is_computed, model.variables):
            ElementTree.SubElement(structure, kind, valueReference=str(variable.reference))
    return _xml(root)


def _xml(root: ElementTree.Element) -> str:
    ElementTree.indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n"


def write_fmu(path: Path, files: dict[str, bytes]) -> None:
    """Write an FMU whole or not at all; the same content gives the same bytes.

    Raises
    ------
    ConfigError
        When the file cannot be written.
    """
    part = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with zipfile.ZipFile(part, "w", zipfile.ZIP_DEFLATED) as archive:
            for name, content in sorted(files.items()):
                entry = zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0))
                entry.compress_type = zipfile.ZIP_DEFLATED
                entry.external_attr = (0o755 if name.startswith("binaries/") else 0o644) << 16
                archive.writestr(entry, content)
        os.replace(part, path)
    except OSError as error:
        part.unlink(missing_ok=True)
        raise ConfigError(f"{path}: cannot be written: {error.strerror}; choose another file or folder") from error
