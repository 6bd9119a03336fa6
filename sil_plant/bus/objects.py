"""The object dictionary: ``can_protocol/objects.toml``, the parameters and the frames, put together."""

from __future__ import annotations

import functools
import itertools
import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sil_plant.bus.protocol import SYNC_ID, database, dbc_hash
from sil_plant.config import ROOT, ConfigError, tomllib
from sil_plant.inputs.machine import Parameter, load_parameter_table

OBJECTS = ROOT / "can_protocol" / "objects.toml"
EDS_PATH = ROOT / "can_protocol" / "diarc_ecu.eds"
NODE_ID = 1
FIRST_PARAMETER = 0x2100
FIRST_FRAME = 0x3000
RPDO_COMMUNICATION, RPDO_MAPPING = 0x1400, 0x1600
TPDO_COMMUNICATION, TPDO_MAPPING = 0x1800, 0x1A00
NO_REMOTE_REQUESTS = 0x40000000
EVENT_DRIVEN = 255
LAST_SYNCHRONOUS = 240
FRAME_BITS = 64

DATA_TYPES = {
    "BOOL": 0x01, "I8": 0x02, "I16": 0x03, "I32": 0x04, "U8": 0x05, "U16": 0x06, "U32": 0x07, "R32": 0x08,
    "TEXT": 0x09, "DOMAIN": 0x0F, "I24": 0x10, "U24": 0x16,
}  # fmt: skip
"""CiA 301's numbers of the data types."""

# Ends of parameters' names, longest first, and what they say of the unit.
_UNITS = {
    "_m3_s_Pa": "m^3/(s Pa)", "_Nm_rad_s": "N m rad/s", "_Nms_rad": "N m s/rad", "_Nm2_s": "N m^2/s",
    "_rad_s": "rad/s", "_m_s2": "m/s^2", "_m2_s": "m^2/s", "_m3_s": "m^3/s", "_kgm2": "kg m^2", "_1_s2": "1/s^2",
    "_1_s": "1/s", "_1_Pa": "1/Pa", "_rad": "rad", "_Pa": "Pa", "_Nm": "N m", "_m3": "m^3", "_kg": "kg",
    "_kv": "m^3/(s sqrt(Pa))", "_sd": "sd", "_m": "m", "_s": "s",
}  # fmt: skip


@dataclass(frozen=True)
class Entry:
    """One value that SDO reaches.

    Attributes
    ----------
    type : str
        A key of ``DATA_TYPES``.
    low, high : float or None
        What may be written; None: whatever the type holds, or nothing.
    default : int, str or None
        What it always reads, if that is fixed.
    source : str
        Key of objects.toml that says where the value is: value, string, field, call; "" for parameters and frames,
        which the firmware knows by their index.
    target : str
        What that key says.
    scale : float
        Physical value of one step.
    """

    index: int
    sub: int
    name: str
    type: str
    access: str
    text: str
    unit: str = ""
    idle: bool = False
    low: float | None = None
    high: float | None = None
    default: int | str | None = None
    source: str = ""
    target: str = ""
    mappable: bool = False
    scale: float = 1.0


@dataclass(frozen=True)
class Object:
    """What has one index."""

    index: int
    name: str
    kind: str  # VAR, ARRAY, RECORD
    text: str
    entries: tuple[Entry, ...]


@dataclass(frozen=True)
class Piece:
    """Neighbouring bits of a frame that have one name whatever the frame's page."""

    name: str
    start: int
    length: int
    type: str
    unit: str
    scale: float
    text: str


@dataclass(frozen=True)
class Pdo:
    """A process frame as CANopen describes it."""

    frame: str
    text: str
    transmitted: bool
    number: int  # of the PDO, from 0
    cob_id: int
    transmission: int
    row: int  # of all PDOs, from 0
    field: str
    pieces: tuple[Piece, ...]

    @property
    def communication(self) -> int:
        """Index of the communication parameter."""
        return (TPDO_COMMUNICATION if self.transmitted else RPDO_COMMUNICATION) + self.number

    @property
    def mapping(self) -> int:
        """Index of the mapping parameter."""
        return (TPDO_MAPPING if self.transmitted else RPDO_MAPPING) + self.number


@dataclass(frozen=True)
class Dictionary:
    """All objects by index, and the process frames."""

    objects: tuple[Object, ...]
    pdos: tuple[Pdo, ...]
    estimates: int  # how many

    def entries(self) -> Iterator[Entry]:
        """Every value, by index and sub-index."""
        for item in self.objects:
            yield from item.entries


def version() -> tuple[int, int, int]:
    """The release, as CMakeLists.txt says."""
    found = re.search(r"project\(diarc_ecu VERSION (\d+)\.(\d+)\.(\d+)", (ROOT / "CMakeLists.txt").read_text("utf-8"))
    if not found:
        raise ConfigError("CMakeLists.txt: no project(diarc_ecu VERSION x.y.z ..)")
    return int(found[1]), int(found[2]), int(found[3])


def known_values() -> dict[str, int]:
    """Numbers that objects.toml may name."""
    major, minor, patch = version()
    return {
        "DIARC_DBC_HASH": dbc_hash(),
        "PARAMETER_LAYOUT_HASH": load_parameter_table().layout_hash,
        "REVISION_NUMBER": major << 16 | minor << 8 | patch,
    }


def parameter_unit(parameter: Parameter) -> str:
    """Unit of a parameter, from its name; "" without dimension."""
    words = parameter.name.split(".")
    name = words[2] if len(words) == 4 and words[1] == "prior" else words[-1]
    return next((unit for end, unit in _UNITS.items() if name.endswith(end)), "")


# ---- process frames --------------------------------------------------------------------------------


def _piece_type(start: int, length: int, signed: bool) -> str:
    """The smallest type that holds a piece together with the bits before it in its first byte."""
    needed = start % 8 + length
    width = next(width for width in (8, 16, 24, 32) if needed <= width)
    return f"{'I' if signed else 'U'}{width}"


def _beginning(names: list[str]) -> str:
    """The letters that all names begin with."""
    same = itertools.takewhile(lambda letters: len(set(letters)) == 1, zip(*names, strict=False))
    return "".join(letters[0] for letters in same)


def _common(names: list[str]) -> str:
    """What the names of a piece have in common: their end, or else their beginning."""
    if len(names) == 1:
        return names[0]
    end = _beginning([name[::-1] for name in names])[::-1].strip("_")
    beginning = _beginning(names).strip("_")
    return end if len(end) > len(beginning) else beginning


def _pieces(message: Any) -> tuple[Piece, ...]:
    """The frame's bits, cut so that every page of it can be read from the pieces."""
    edges = sorted({s.start for s in message.signals} | {s.start + s.length for s in message.signals})
    pieces = []
    for start, end in itertools.pairwise(edges):
        there = [s for s in message.signals if s.start <= start and end <= s.start + s.length]
        if not there:
            raise ConfigError(f"diarc.dbc: {message.name} has a gap at bit {start}; give it a name, PDOs have none")
        whole = [s for s in there if (s.start, s.length) == (start, end - start)]
        signed = {s.is_signed for s in there}
        same = len(whole) == len(there) and len(signed) == 1
        name = _common([s.name for s in there]) if same else ""
        units, scales = {s.unit or "" for s in there}, {s.scale for s in there}
        uniform = same and len(units) == len(scales) == 1
        text = "; ".join(dict.fromkeys(s.comment for s in there if s.comment)) if uniform else ""
        pieces.append(
            Piece(
                name=name or f"Bits{start}to{end - 1}",
                start=start,
                length=end - start,
                type=_piece_type(start, end - start, same and signed == {True}),
                unit=units.pop() if uniform else "",
                scale=float(scales.pop()) if uniform else 1.0,
                text=text or ("" if len(there) == 1 else "Depends on the page: " + ", ".join(s.name for s in there)),
            )
        )
    names = [piece.name for piece in pieces]
    if len(set(names)) != len(names) or edges[0] != 0 or edges[-1] > FRAME_BITS:
        raise ConfigError(f"diarc.dbc: {message.name} cannot be cut into pieces with names of their own: {names}")
    return tuple(pieces)


def _pdos(tree: dict[str, Any]) -> tuple[Pdo, ...]:
    sync_ms = database().get_message_by_frame_id(SYNC_ID).cycle_time
    pdos: list[Pdo] = []
    for transmitted, items in ((False, tree["rpdo"]), (True, tree["tpdo"])):
        for number, item in enumerate(items):
            message = database().get_message_by_name(item["frame"])
            ticks = message.cycle_time // sync_ms if transmitted and message.cycle_time else 0
            pdos.append(
                Pdo(
                    frame=message.name,
                    text=message.comment or "",
                    transmitted=transmitted,
                    number=number,
                    cob_id=message.frame_id | (NO_REMOTE_REQUESTS if transmitted else 0),
                    transmission=ticks if 1 <= ticks <= LAST_SYNCHRONOUS else EVENT_DRIVEN,
                    row=len(pdos),
                    field=item["field"],
                    pieces=_pieces(message),
                )
            )
    return tuple(pdos)


def _counted(index: int, name: str, kind: str, text: str, entries: list[Entry]) -> Object:
    """An array or record whose sub-index 0 is the number of the others."""
    count = Entry(index, 0, "Highest sub-index supported", "U8", "const", "", default=len(entries))
    return Object(index, name, kind, text, (count, *entries))


def _pdo_objects(pdo: Pdo) -> list[Object]:
    direction = "TPDO" if pdo.transmitted else "RPDO"
    label = f"{direction}{pdo.number + 1} {pdo.frame}"
    communication = [
        Entry(pdo.communication, 1, "COB-ID", "U32", "const", "Identifier", default=pdo.cob_id),
        Entry(
            pdo.communication, 2, "Transmission type", "U8", "const",
            "1 to 240: every so many SYNCs; 255: by event", default=pdo.transmission,
        ),
    ]  # fmt: skip
    record = FIRST_FRAME + pdo.row
    mapping, values = [], []
    for sub, piece in enumerate(pdo.pieces, start=1):
        entry = record << 16 | sub << 8 | piece.length
        mapping.append(Entry(pdo.mapping, sub, f"Mapping {sub}", "U32", "const", piece.name, default=entry))
        values.append(
            Entry(
                record, sub, piece.name, piece.type, "ro", piece.text,
                unit=piece.unit, mappable=True, scale=piece.scale,
            )
        )  # fmt: skip
    return [
        _counted(pdo.communication, f"{label} communication parameter", "RECORD", pdo.text, communication),
        _counted(pdo.mapping, f"{label} mapping parameter", "RECORD", pdo.text, mapping),
        _counted(record, pdo.frame, "RECORD", pdo.text, values),
    ]


# ---- the table -------------------------------------------------------------------------------------

_SOURCES = ("value", "string", "field", "call")
_KEYS = {"index", "name", "kind", "type", "access", "idle", "high", "unit", "text", "repeat", *_SOURCES}


def _entry(index: int, sub: int, item: dict[str, Any], name: str | None = None) -> Entry:
    where = f"{OBJECTS.name}: {index:04X}h:{sub:02X}"
    sources = [key for key in _SOURCES if key in item]
    if len(sources) != 1:
        raise ConfigError(f"{where}: needs one of {', '.join(_SOURCES)}")
    unknown = set(item) - _KEYS
    if unknown or item["type"] not in DATA_TYPES or item["access"] not in ("const", "ro", "rw"):
        raise ConfigError(f"{where}: unknown key, type or access: {sorted(unknown)} {item['type']} {item['access']}")
    target = item[sources[0]]
    default = target if sources[0] == "value" else None
    if isinstance(default, str):
        default = known_values()[default]
    high = item.get("high")
    if item["access"] == "rw" and item["type"] in ("U8", "U16", "U32") and high is None:
        high = (1 << int(item["type"][1:])) - 1
    return Entry(
        index=index,
        sub=sub,
        name=name or item["name"],
        type=item["type"],
        access=item["access"],
        text=item["text"],
        unit=item.get("unit", ""),
        idle=item.get("idle", False),
        low=None if high is None else 0,
        high=high,
        default=default,
        source=sources[0],
        target=str(target),
    )


def _table_object(item: dict[str, Any]) -> Object:
    index, kind = item["index"], item.get("kind", "VAR")
    if kind == "VAR":
        return Object(index, item["name"], kind, item["text"], (_entry(index, 0, item),))
    entries: list[Entry] = []
    for sub in item["sub"]:
        repeat = sub.get("repeat", 1)
        for number in range(1, repeat + 1):
            name = f"{sub['name']} {number}" if repeat > 1 else None
            entries.append(_entry(index, len(entries) + 1, sub, name))
    found = _counted(index, item["name"], kind, item["text"], entries)
    if "count_call" not in item:
        return found
    count = {"type": "U8", "access": "rw", "call": item["count_call"], "text": item["count_text"], "high": 0}
    return Object(index, item["name"], kind, item["text"], (_entry(index, 0, count, "Number of errors"), *entries))


def _estimate_objects(items: list[dict[str, Any]]) -> tuple[list[Object], int]:
    message = database().get_message_by_name("PARAMETERS")
    objects, counts = [], set()
    for item in items:
        signals = sorted(
            (s for s in message.signals if s.name.startswith(item["prefix"])), key=lambda s: s.multiplexer_ids[0]
        )
        for k, signal in enumerate(signals):
            name = item["name"].format(name=signal.name.removeprefix(item["prefix"]))
            text = item["text"].format(k=k + 1)
            entry = Entry(item["index"] + k, 0, name, "R32", "ro", text, unit=signal.unit or "")
            objects.append(Object(entry.index, name, "VAR", text, (entry,)))
        counts.add(len(signals))
    if len(counts) != 1:
        raise ConfigError("diarc.dbc: PARAMETERS has not as many sd_ as theta_")
    return objects, counts.pop()


def _parameter_object(k: int, parameter: Parameter) -> Object:
    index = FIRST_PARAMETER + k
    entry = Entry(
        index, 0, parameter.name, "R32", "rw", parameter.text,
        unit=parameter_unit(parameter), idle=True, low=parameter.low, high=parameter.high,
    )  # fmt: skip
    return Object(index, parameter.name, "VAR", parameter.text, (entry,))


@functools.cache
def load_objects(path: Path = OBJECTS) -> Dictionary:
    """The whole dictionary.

    Raises
    ------
    ConfigError
        For a table that contradicts itself or the DBC.
    """
    tree = tomllib.loads(path.read_text(encoding="utf-8"))
    pdos = _pdos(tree)
    objects = [_table_object(item) for item in tree["object"]]
    estimates, count = _estimate_objects(tree["estimates"])
    objects += estimates
    objects += [_parameter_object(k, entry) for k, entry in enumerate(load_parameter_table().entries)]
    for pdo in pdos:
        objects += _pdo_objects(pdo)
    objects.sort(key=lambda item: item.index)
    indices = [item.index for item in objects]
    if len(set(indices)) != len(indices):
        raise ConfigError(f"{path.name}: an index is there twice: {indices}")
    if not all(math.isfinite(e.high) for item in objects for e in item.entries if e.high is not None):
        raise ConfigError(f"{path.name}: a limit is no number")
    return Dictionary(tuple(objects), pdos, count)
