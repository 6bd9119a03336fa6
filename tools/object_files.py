"""What tools/generate.py makes from the object dictionary: tables in C, the EDS, docs/objects.md."""

from __future__ import annotations

from pathlib import Path

from sil_plant.bus.objects import (
    DATA_TYPES,
    FIRST_FRAME,
    FIRST_PARAMETER,
    NODE_ID,
    Dictionary,
    Entry,
    Object,
    known_values,
    load_objects,
    version,
)
from sil_plant.inputs.machine import load_parameter_table

ECU_DIR = Path("firmware/ecu/generated")
EDS_FILE = Path("can_protocol/diarc_ecu.eds")
DOCS_FILE = Path("docs/objects.md")
NOTICE = "/* Made by tools/generate.py; do not edit. */\n"

MANDATORY = (0x1000, 0x1001, 0x1018)
MANUFACTURER = range(0x2000, 0x6000)
OBJECT_TYPES = {"VAR": 0x7, "ARRAY": 0x8, "RECORD": 0x9, "DOMAIN": 0x2}
BIT_RATES = (10, 20, 50, 125, 250, 500, 800, 1000)


# ---- C ---------------------------------------------------------------------------------------------


def _row(entry: Entry, texts: list[str]) -> str:
    """One row of the table in C; a row's text goes to `texts`."""
    access = {"const": "READ", "ro": "READ", "rw": "READ | WRITE"}[entry.access]
    if entry.idle:
        access += " | IDLE"
    source, size, value = "SOURCE_VALUE", "0", f"0x{entry.default:X}u" if isinstance(entry.default, int) else "0"
    if entry.source == "value" and not entry.target.isdecimal():
        value = entry.target
    elif entry.source == "string":
        text = entry.target if entry.target in ("SCALAR_NAME", "SOFTWARE_VERSION") else f'"{entry.target}"'
        texts.append(f"    {{{text}, sizeof {text} - 1u}},\n")
        source, value = "SOURCE_TEXT", f"{len(texts) - 1}u"
    elif entry.source == "field":
        size = f"sizeof ((const struct ecu *)0)->{entry.target}"
        source, value = "SOURCE_FIELD", f"offsetof(struct ecu, {entry.target})"
    elif entry.source == "call":
        source, value = "SOURCE_CALL", f"CALL_{entry.target}"
    high = f"0x{int(entry.high):X}u" if entry.high is not None else "0"
    return (
        f"    {{0x{entry.index:04X}u, {entry.sub}, TYPE_{entry.type}, {access}, {source}, {size}, {value}, {high}}}, "
        f"/* {entry.name} */\n"
    )


def c_sources() -> dict[Path, str]:
    """The dictionary as the firmware has it; parameters are in its own table."""
    dictionary = load_objects()
    texts: list[str] = []
    frame_indices = {i for pdo in dictionary.pdos for i in (pdo.communication, pdo.mapping, FIRST_FRAME + pdo.row)}
    rows = [
        _row(entry, texts)
        for item in dictionary.objects
        for entry in item.entries
        if item.index not in frame_indices and (entry.source or entry.default is not None)
    ]
    calls = list(dict.fromkeys(e.target for item in dictionary.objects for e in item.entries if e.source == "call"))
    pdos, signals = [], []
    for pdo in dictionary.pdos:
        pdos.append(
            f"    {{0x{pdo.communication:04X}u, 0x{pdo.mapping:04X}u, 0x{pdo.cob_id:08X}u, {pdo.transmission}, "
            f"{len(signals)}, {len(pdo.pieces)}, offsetof(struct ecu, {pdo.field})}}, /* {pdo.frame} */\n"
        )
        signals += [f"    {{{p.start}, {p.length}, TYPE_{p.type}}}, /* {pdo.frame}.{p.name} */\n" for p in pdo.pieces]
    major, minor, patch = version()
    estimates = sorted(e.index for e in dictionary.entries() if 0x2020 <= e.index < FIRST_PARAMETER)
    header = (
        NOTICE
        + "#ifndef OBJECT_LAYOUT_H\n#define OBJECT_LAYOUT_H\n\n"
        + f"#define OBJECT_ROWS {len(rows)}\n"
        + f"#define OBJECT_TEXTS {len(texts)}\n"
        + f"#define OBJECT_PDOS {len(pdos)}\n"
        + f"#define OBJECT_SIGNALS {len(signals)}\n"
        + f"#define FIRST_ESTIMATE 0x{estimates[0]:04X}u\n"
        + f"#define FIRST_ESTIMATE_SD 0x{estimates[dictionary.estimates]:04X}u\n"
        + f"#define FIRST_PARAMETER 0x{FIRST_PARAMETER:04X}u\n"
        + f"#define FIRST_FRAME 0x{FIRST_FRAME:04X}u\n"
        + f"#define REVISION_NUMBER 0x{known_values()['REVISION_NUMBER']:08X}u\n"
        + f'#define SOFTWARE_VERSION "{major}.{minor}.{patch}"\n\n'
        + "enum object_type {\n"
        + "".join(f"    TYPE_{name} = 0x{number:02X},\n" for name, number in DATA_TYPES.items())
        + "};\n\n"
        + "enum object_call {\n"
        + "".join(f"    CALL_{name},\n" for name in calls)
        + "};\n\n#endif\n"
    )
    return {
        ECU_DIR / "object_layout.h": header,
        ECU_DIR / "object_table.inc": NOTICE + "".join(rows),
        ECU_DIR / "object_texts.inc": NOTICE + "".join(texts),
        ECU_DIR / "object_pdos.inc": NOTICE + "".join(pdos),
        ECU_DIR / "object_signals.inc": NOTICE + "".join(signals),
    }


# ---- EDS -------------------------------------------------------------------------------------------


def _limit(entry: Entry, value: float) -> str:
    return repr(float(value)) if entry.type == "R32" else str(int(value))


def _eds_value(section: str, entry: Entry) -> str:
    kind = "DOMAIN" if entry.type == "DOMAIN" else "VAR"
    lines = [
        f"[{section}]",
        f"ParameterName={entry.name}",
        f"ObjectType=0x{OBJECT_TYPES[kind]:X}",
        f"DataType=0x{DATA_TYPES[entry.type]:04X}",
        f"AccessType={entry.access}",
    ]
    if entry.low is not None and entry.high is not None:
        lines += [f"LowLimit={_limit(entry, entry.low)}", f"HighLimit={_limit(entry, entry.high)}"]
    if isinstance(entry.default, int):
        lines.append(f"DefaultValue=0x{entry.default:X}")
    lines.append(f"PDOMapping={int(entry.mappable)}")
    # what canopen reads beyond CiA 306
    if entry.unit:
        lines.append(f"Unit={entry.unit}")
    if entry.scale != 1.0:
        lines.append(f"Factor={entry.scale!r}")
    if entry.text:
        lines.append(f"Description={entry.text.replace(';', ',')}")
    return "\n".join(lines) + "\n\n"


def _eds_object(item: Object) -> str:
    if item.kind == "VAR":
        return _eds_value(f"{item.index:04X}", item.entries[0])
    head = (
        f"[{item.index:04X}]\nParameterName={item.name}\nObjectType=0x{OBJECT_TYPES[item.kind]:X}\n"
        f"SubNumber={len(item.entries)}\n\n"
    )
    return head + "".join(_eds_value(f"{item.index:04X}sub{entry.sub:X}", entry) for entry in item.entries)


def _eds_list(name: str, items: list[Object]) -> str:
    lines = [f"[{name}]", f"SupportedObjects={len(items)}"]
    lines += [f"{number}=0x{item.index:04X}" for number, item in enumerate(items, start=1)]
    return "\n".join(lines) + "\n\n" + "".join(_eds_object(item) for item in items)


def eds(dictionary: Dictionary) -> str:
    """The electronic data sheet, CiA 306."""
    major, minor, patch = version()
    values = known_values()
    head = f"""[FileInfo]
FileName={EDS_FILE.name}
FileVersion=1
FileRevision=0
EDSVersion=4.0
Description=Object dictionary of DIARC ECU
CreatedBy=tools/generate.py

[DeviceInfo]
VendorName=DIARC ECU
VendorNumber=0x0
ProductName=DIARC ECU
ProductNumber=0x{next(e.default for e in dictionary.entries() if (e.index, e.sub) == (0x1018, 2)):X}
RevisionNumber=0x{values["REVISION_NUMBER"]:X}
OrderCode=DIARC ECU {major}.{minor}.{patch}
{"".join(f"BaudRate_{rate}={int(rate == 1000)}" + chr(10) for rate in BIT_RATES)}SimpleBootUpMaster=0
SimpleBootUpSlave=1
Granularity=0
DynamicChannelsSupported=0
GroupMessaging=0
NrOfRXPDO={sum(not pdo.transmitted for pdo in dictionary.pdos)}
NrOfTXPDO={sum(pdo.transmitted for pdo in dictionary.pdos)}
LSS_Supported=0

[DeviceComissioning]
NodeID={NODE_ID}
Baudrate=1000

[DummyUsage]
{"".join(f"Dummy{number:04d}=0" + chr(10) for number in range(1, 8))}
[Comments]
Lines=1
Line1=Made by tools/generate.py from objects.toml, parameters.toml and diarc.dbc. Do not edit.

"""
    groups: dict[str, list[Object]] = {"MandatoryObjects": [], "OptionalObjects": [], "ManufacturerObjects": []}
    for item in dictionary.objects:
        if item.index in MANDATORY:
            groups["MandatoryObjects"].append(item)
        elif item.index in MANUFACTURER:
            groups["ManufacturerObjects"].append(item)
        else:
            groups["OptionalObjects"].append(item)
    return head + "".join(_eds_list(name, items) for name, items in groups.items()).rstrip("\n") + "\n"


# ---- docs ------------------------------------------------------------------------------------------

DOCS_HEAD = """<!-- Made by tools/generate.py; do not edit. -->
# Objects

What a CANopen tool reads and writes by SDO, node 1: requests on 601h, answers on 581h. The same list for tools is
[can_protocol/diarc_ecu.eds](../can_protocol/diarc_ecu.eds):

```python
import canopen
from sil_plant.bus.ports import connect_python_can

network = canopen.Network(connect_python_can("tcp:127.0.0.1:29536"))
network.connect()
ecu = network.add_node(1, "can_protocol/diarc_ecu.eds")
print(ecu.sdo["Estimated load"].raw)  # kg
ecu.sdo["wrist.q_max_rad"].raw = 1.1  # only with the valves shut
ecu.sdo["Store parameters"][1].raw = 0x65766173
ecu.tpdo.read()
ecu.tpdo[1].wait_for_reception()
print(ecu.tpdo["ESTIMATE.Load"].phys)
```

- **When.** SDO answers in PRE-OPERATIONAL and OPERATIONAL. While the valves are driven one frame is answered a tick,
  after the valve frame; else at once. A started transfer that rests for 1 s is given up.
- **How.** Expedited and segmented, both ways. Block transfer is refused (05040001); clients then use segments.
- **Numbers** are in SI. Limits are those of the parameter list; what one parameter says of another is checked with
  every write, so an order of writes may be needed (first `.high`, then `.value`), or all at once by 2000h.
- **Writes** that change the machine (*idle* below) are refused outside INIT, STANDBY and FAULT. A write is checked as
  a whole image is; then constants follow from it anew and the controller starts again, its estimate at the priors.
  A refused one changes nothing.
- **2000h** is all parameters at once. What has come of a download is kept where the machine's numbers are, so that
  while one is under way the law rests and RUN and TARE are refused; when it is cut short, refused or given up, the
  old set is in force as before. An image with another pressure base clears the tare.
- **1010h** keeps the set in use, **1011h** goes back to the one built in at the next start.
- **PDOs** are those of [diarc.dbc](../can_protocol/diarc.dbc) and cannot be changed. 3000h on hold what was last
  heard or sent in each. Frames with pages (TRACKING, PARAMETERS, TIMING) are cut so that each page can be read.

| abort code | when |
|---|---|
| 05030000 | the toggle bit did not change |
| 05040000 | the transfer rested for 1 s |
| 05040001 | block transfer, an unknown command, or a segment of no transfer |
| 05040004 | 2000h: the image's CRC is wrong |
| 06010002 | the object is read only |
| 06020000 | no such object |
| 06040043 | it contradicts another parameter, the period, or (2000h) was made for another list of parameters |
| 06060000 | 1010h, 1011h: the memory failed; what was kept before still is |
| 06070010 | the length is not the object's |
| 06090011 | no such sub-index |
| 06090030 | outside what is allowed: no number, too large for fixed point with this machine's bases, no image |
| 06090031, 06090032 | above, below the parameter's limit |
| 08000020 | 1010h, 1011h: the signature is wrong, or there is no memory to keep parameters in |
| 08000022 | not in this mode; 6040h: refused, the reason is in 2006h |
| 08000024 | 1003h: no such error is kept |

"""


def _docs_rows(items: list[Object]) -> str:
    lines = ["| object | name | type | access | unit, range | |\n", "|---|---|---|---|---|---|\n"]
    for item in items:
        if item.kind != "VAR":
            lines.append(f"| {item.index:04X}h | **{item.name}** | {item.kind} | | | {item.text} |\n")
        for entry in item.entries:
            if item.kind != "VAR" and entry.sub == 0 and not entry.source:
                continue
            label = f"{entry.index:04X}h" if item.kind == "VAR" else f"{entry.index:04X}h:{entry.sub:02X}"
            access = entry.access + (" *idle*" if entry.idle else "")
            ranged = entry.type == "R32" and entry.low is not None and entry.high is not None
            span = f"{entry.low:g} to {entry.high:g}" if ranged else ""
            about = " ".join(word for word in (span, entry.unit) if word)
            text = entry.text
            if isinstance(entry.default, int) and item.index < 0x2000:
                text = f"{entry.default:X}h: {text}" if text else f"{entry.default:X}h"
            lines.append(f"| {label} | {entry.name} | {entry.type} | {access} | {about} | {text} |\n")
    return "".join(lines) + "\n"


def docs(dictionary: Dictionary) -> str:
    """docs/objects.md."""
    pdo_indices = {i for pdo in dictionary.pdos for i in (pdo.communication, pdo.mapping)}
    last = FIRST_PARAMETER + len(load_parameter_table().entries)
    groups = {
        "Communication, CiA 301": [o for o in dictionary.objects if o.index < 0x2000 and o.index not in pdo_indices],
        "This ECU": [o for o in dictionary.objects if 0x2000 <= o.index < 0x2020],
        "Drive, from CiA 408": [o for o in dictionary.objects if o.index >= 0x6000],
        "Estimates": [o for o in dictionary.objects if 0x2020 <= o.index < FIRST_PARAMETER],
        "Parameters": [o for o in dictionary.objects if FIRST_PARAMETER <= o.index < last],
        "Frames": [o for o in dictionary.objects if FIRST_FRAME <= o.index < 0x6000],
    }
    text = DOCS_HEAD
    for name, items in groups.items():
        text += f"## {name}\n\n" + _docs_rows(items)
    text += "## PDOs\n\n| PDO | frame | COB-ID | transmission | communication, mapping | signals |\n"
    text += "|---|---|---|---|---|---|\n"
    for pdo in dictionary.pdos:
        label = f"{'TPDO' if pdo.transmitted else 'RPDO'}{pdo.number + 1}"
        kind = f"every {pdo.transmission} SYNCs" if pdo.transmission < 255 else "by event"
        kind = "every SYNC" if pdo.transmission == 1 else kind
        text += (
            f"| {label} | {pdo.frame} | {pdo.cob_id & 0x7FF:03X}h | {kind} | {pdo.communication:04X}h, "
            f"{pdo.mapping:04X}h | {FIRST_FRAME + pdo.row:04X}h |\n"
        )
    return text


def object_files() -> dict[Path, str]:
    """Every file, by its path in the repository."""
    dictionary = load_objects()
    return c_sources() | {EDS_FILE: eds(dictionary), DOCS_FILE: docs(dictionary)}
