"""What tools/generate.py makes for people from the DBC: docs/protocol.md."""

from __future__ import annotations

import re
import string
import textwrap
from pathlib import Path
from typing import Any

from sil_plant.bus import e2e
from sil_plant.bus.protocol import BIT_RATE, SYNC_ID, database, frame_id, worst_case_bits
from sil_plant.config import ROOT
from sil_plant.inputs.machine import REFERENCE_ARM, load_machine

PAGE = Path("docs/protocol.md")
NODES = {"MASTER": "master", "ECU": "ECU", "IO": "I/O node"}
SENSOR_FRAMES = ("ENCODERS", "PRESSURES_SWING", "PRESSURES_WRIST")
SLOW_TICKS = 10  # the ECU sends one slow frame at most in a tick, each in its phase of so many
PERIODS_MS = (0.5, 1.0, 2.0, 5.0, 10.0)
WIDTH = 120
E2E_SIGNALS = {
    "E2eCrc": "[CRC of the other bytes](#end-to-end-protection)",
    "E2eCounter": "[of the frames with this id](#end-to-end-protection)",
}
US_PER_S = 1e6


def wrapped(text: str) -> str:
    """Paragraphs and list items filled anew; tables, headings, drawings and code as they are."""
    done: list[str] = []
    block: list[str] = []

    def close() -> None:
        if block:
            indent = re.match(r"(- |\d+\. )?", block[0])
            hang = " " * len(indent.group(0)) if indent else ""
            words = " ".join(line.strip() for line in block)
            done.extend(
                textwrap.wrap(words, WIDTH, subsequent_indent=hang, break_long_words=False, break_on_hyphens=False)
            )
            block.clear()

    fenced = False
    for line in text.splitlines():
        fence = line.startswith("```")
        if fenced or fence or not line or line[0] in "|#<":
            close()
            done.append(line)
            fenced = fenced != fence
            continue
        if re.match(r"- |\d+\. ", line):
            close()
        block.append(line)
    close()
    return "\n".join(done) + "\n"


# ---- one frame -----------------------------------------------------------------------------------


def _pages(message: Any) -> list[tuple[str, list[Any]]]:
    """The layouts a frame has: one, or one per group of pages that place their signals alike."""
    common = [s for s in message.signals if not s.multiplexer_ids]
    if not message.is_multiplexed():
        return [("", common)]
    selector = next(s for s in common if s.is_multiplexer)
    groups: dict[tuple[tuple[int, int], ...], list[int]] = {}
    numbers = sorted({n for s in message.signals for n in s.multiplexer_ids or []})
    for number in numbers:
        key = tuple((s.start, s.length) for s in message.signals if number in (s.multiplexer_ids or []))
        groups.setdefault(key, []).append(number)
    layouts = []
    for members in groups.values():
        in_a_row = len(members) > 2 and members[-1] - members[0] == len(members) - 1
        span = f"{members[0]} to {members[-1]}" if in_a_row else " and ".join(map(str, members))
        own = [s for s in message.signals if members[0] in (s.multiplexer_ids or [])]
        layouts.append((f"{selector.name} {span}", common + own))
    return layouts


def letters(message: Any) -> dict[str, str]:
    """A letter for each signal of a frame; signals of different pages at the same place share theirs."""
    found: dict[tuple[int, int], str] = {}
    for signal in sorted(message.signals, key=lambda s: (s.start, s.length)):
        found.setdefault((signal.start, signal.length), string.ascii_lowercase[len(found)])
    return {signal.name: found[signal.start, signal.length] for signal in message.signals}


def drawing(message: Any, signals: list[Any]) -> list[str]:
    """The bytes of a frame in the order they are sent, each with its highest bit first; a dot is an unused bit."""
    bits = ["."] * (8 * message.length)
    letter = letters(message)
    for signal in signals:
        for k in range(signal.length):
            bits[signal.start + k] = letter[signal.name]
    octets = range(message.length)
    return [
        "byte  " + " ".join(f"{n:<8}" for n in octets).rstrip(),
        "bit   " + " ".join("76543210" for _ in octets),
        "      " + " ".join("".join(reversed(bits[8 * n : 8 * n + 8])) for n in octets),
    ]


def _number(value: float) -> str:
    return f"{value:.10g}"


def _signal_row(message: Any, signal: Any) -> str:
    """One row of a frame's table."""
    bits = f"{signal.start}" if signal.length == 1 else f"{signal.start}..{signal.start + signal.length - 1}"
    name = signal.name
    if signal.multiplexer_ids:
        name += f" (page {', '.join(str(n) for n in signal.multiplexer_ids)})"
    kind = ("signed " if signal.is_signed else "") + f"{signal.length}"
    unit = f" {signal.unit}" if signal.unit else ""
    step = "" if signal.scale == 1 and not signal.unit else f"{_number(signal.scale)}{unit}"
    span = f"{_number(signal.minimum)} to {_number(signal.maximum)}"
    words = [signal.comment or E2E_SIGNALS.get(signal.name, "")]
    if signal.choices:
        words.append(", ".join(f"{code} {name}" for code, name in sorted(signal.choices.items())))
    text = "; ".join(word for word in words if word)
    return f"| {letters(message)[signal.name]} | {name} | {bits} | {kind} | {step} | {span} | {text} |\n"


def _is_protected(message: Any) -> bool:
    return any(signal.name == "E2eCrc" for signal in message.signals)


def _when(message: Any) -> str:
    if not message.cycle_time:
        return "by event"
    ticks = f"; {'every tick' if message.cycle_time == 1 else f'every {message.cycle_time} ticks'}"
    return f"every {message.cycle_time} ms" + ("" if message.name.startswith("HEARTBEAT") else ticks)


def _frame_section(message: Any) -> str:
    """A frame: who, when, what, where."""
    sender = ", ".join(NODES[s] for s in message.senders)
    receivers = ", ".join(NODES[r] for r in sorted(message.receivers))
    protection = "E2E" if _is_protected(message) else "no E2E"
    size = f"{message.length} byte" + ("" if message.length == 1 else "s")
    text = f"### {message.name}, {message.frame_id:03X}h\n\n"
    text += f"{(message.comment or '').rstrip('.')}.\n\n"
    text += f"{sender} to {receivers}; {_when(message)}; {size}; {protection}.\n\n```text\n"
    drawn: dict[str, list[str]] = {}
    for title, signals in _pages(message):
        rows = drawing(message, signals)
        if not drawn:
            text += "\n".join(rows[:2]) + "\n"
        drawn.setdefault(rows[2], []).append(title)
    for row, titles in drawn.items():
        text += row + (f"   {', '.join(titles)}" if titles[0] else "") + "\n"
    text += "```\n\n| | signal | bits | size | step | range | |\n|---|---|---|---|---|---|---|\n"
    return text + "".join(_signal_row(message, signal) for signal in message.signals) + "\n"


# ---- the bus -------------------------------------------------------------------------------------


def _overview() -> str:
    text = "| id | frame | from | to | every | bytes | E2E | bits at worst |\n|---|---|---|---|---|---|---|---|\n"
    for message in _messages():
        cycle = f"{message.cycle_time} ms" if message.cycle_time else "event"
        text += (
            f"| {message.frame_id:03X}h | [{message.name}](#{message.name.lower()}-{message.frame_id:03x}h) "
            f"| {', '.join(NODES[s] for s in message.senders)} "
            f"| {', '.join(NODES[r] for r in sorted(message.receivers))} | {cycle} | {message.length} "
            f"| {'yes' if _is_protected(message) else '-'} | {worst_case_bits(message.length)} |\n"
        )
    text += f"| 601h | SDO request | master | ECU | event | 8 | - | {worst_case_bits(8)} |\n"
    return text + f"| 581h | SDO answer | ECU | master | event | 8 | - | {worst_case_bits(8)} |\n"


def _messages() -> list[Any]:
    return sorted(database().messages, key=lambda m: m.frame_id)


def bus_load(period_ms: float) -> float:
    """Share of the bit rate that the cyclic frames need with this tick, 0..; the DBC's cycles are those of 1 ms.

    Heartbeats are on time, all else is on ticks.
    """
    bits_per_s = 0.0
    for message in database().messages:
        if message.cycle_time:
            scale = 1.0 if message.name.startswith("HEARTBEAT") else period_ms
            bits_per_s += worst_case_bits(message.length) / (message.cycle_time * scale * 1e-3)
    return bits_per_s / BIT_RATE


def _bits(*names: str) -> int:
    return sum(worst_case_bits(database().get_message_by_name(name).length) for name in names)


def _load_section() -> str:
    to_sensors = _bits("SYNC", *SENSOR_FRAMES)
    tick = to_sensors + _bits("VALVES")
    slow = max(_bits(m.name) for m in _messages() if m.cycle_time in (5, 10))
    fullest = tick + slow + _bits("HEARTBEAT_ECU", "HEARTBEAT_IO", "EMCY_ECU") + 2 * worst_case_bits(8)
    us = US_PER_S / BIT_RATE
    rows = (
        ("SYNC and the three sensor frames: the earliest moment the law can start", to_sensors),
        (".. and VALVES: what every tick has", tick),
        (".. and a slow frame: ESTIMATE, TRACKING, PARAMETERS or TIMING, never two in a tick", tick + slow),
        (".. and both heartbeats, an emergency, an SDO request and its answer", fullest),
    )
    text = f"""A classic frame with an 11-bit identifier and n data bytes takes at most
`44 + 8 n + floor((34 + 8 n - 1) / 4) + 3` bits: its own, a stuff bit after each four that may need one, the gap behind
it. At {BIT_RATE / 1e6:g} Mbit/s a bit is {us:g} us.

| in one tick | bits at worst | us |
|---|---|---|
"""
    text += "".join(f"| {what} | {bits} | {bits * us:.0f} |\n" for what, bits in rows)
    text += """
Frames wait for each other by their identifiers, lowest first: what does not fit into a tick of 1 ms waits for the next
one, behind SYNC, the sensors and VALVES. The cyclic frames together, with the ticks a port may choose (`PERIOD_US`,
read in object 1006h; heartbeats keep their 100 ms):

| tick | bus load at worst |
|---|---|
"""
    for period_ms in PERIODS_MS:
        load = bus_load(period_ms)
        text += f"| {period_ms:g} ms | {100 * load:.0f} %{'' if load < 1 else ': does not fit'} |\n"
    return text


# ---- E2E -----------------------------------------------------------------------------------------

GOLDEN_ID, GOLDEN_COUNTER, GOLDEN_PAYLOAD = 0x123, 2, bytes.fromhex("112233445566")


def _hex(data: bytes) -> str:
    return data.hex(" ").upper()


def _examples() -> list[tuple[str, int, bytes, str]]:
    """Frames that an I/O node and an ECU send, whole: name, identifier, data, what they say."""
    sync_counter = 17
    counter = (sync_counter - 1) % e2e.STATES
    cases: list[tuple[str, dict[str, float], str]] = [
        ("ENCODERS", {"SwingAngle": 0.1, "WristAngle": -0.2}, "swing 0.1 rad, wrist -0.2 rad"),
        (
            "PRESSURES_SWING",
            {"BorePressure": 50.0, "AnnulusPressure": 73.14, "SpoolPosition": 12.5},
            "50 bar, 73.14 bar, spool at 12.5 %",
        ),
        (
            "VALVES",
            {
                "Mode": 2,
                "SwingSpool": 12.5,
                "WristSpool": -50.0,
                "SwingControl": 7,
                "WristControl": 7,
                "SyncCounter": sync_counter,
            },
            "RUN, swing 12.5 %, wrist -50 %, both active",
        ),
    ]
    rows = []
    for name, values, text in cases:
        message = database().get_message_by_name(name)
        whole = {signal.name: 0 for signal in message.signals} | values
        data = e2e.protected(message.frame_id, bytes(message.encode(whole)), counter)
        rows.append((name, message.frame_id, data, f"{text}; counter {counter}, of SYNC {sync_counter}"))
    return rows


def _e2e_section() -> str:
    golden = e2e.protected(GOLDEN_ID, bytes(2) + GOLDEN_PAYLOAD, GOLDEN_COUNTER)
    text = f"""Process frames carry AUTOSAR E2E profile 1 (variant 1A: data id mode BOTH; the identifier is
the data id):

- **Byte 0** is a CRC-8, polynomial 1Dh (SAE J1850), start value 0, no inversion at either end, taken over the low
  byte of the identifier, its high byte, then data bytes 1 to 7.
- **Byte 1, low nibble** is a counter 0 to {e2e.STATES - 1}; {e2e.STATES} is never sent and always refused. It has
  one more with each frame of an identifier, except in sensor frames: there it is **(SyncCounter - 1) mod
  {e2e.STATES}**, so that it says which SYNC is answered.
- The high nibble of byte 1 is not E2E's: it is a mode or a status, under the CRC like all else.

```c
uint8_t e2e_crc(uint16_t id, const uint8_t data[8])
{{
    const uint8_t first[2] = {{(uint8_t)id, (uint8_t)(id >> 8)}};
    uint8_t crc = 0;
    for (int k = 0; k < 9; k++) {{
        crc ^= k < 2 ? first[k] : data[k - 1];
        for (int bit = 0; bit < 8; bit++) {{
            crc = (uint8_t)(crc << 1 ^ ((crc & 0x80) != 0 ? 0x1D : 0));
        }}
    }}
    return crc;
}}
```

The golden vector: identifier {GOLDEN_ID:03X}h, counter {GOLDEN_COUNTER}, payload {_hex(GOLDEN_PAYLOAD)} gives
**{_hex(golden)}**. The same bytes come from
the PyPI package `autosar-e2e`. Whole frames to try a node with:

| frame | id | data | says |
|---|---|---|---|
"""
    for name, can_id, data, meaning in _examples():
        text += f"| {name} | {can_id:03X}h | `{_hex(data)}` | {meaning} |\n"
    return (
        text
        + """
| receiver | takes a frame when |
|---|---|
| ECU, sensor frames | 8 bytes, CRC right, counter that of the SYNC of this tick, and the first one of its kind in it |
| ECU, MOTION | 8 bytes, CRC right, counter 0 to 14 and not that of the MOTION taken before |
| I/O node, VALVES | 8 bytes, CRC right, counter 0 to 14 and not that of the VALVES taken before, SyncCounter that of \
the last SYNC |
| master | 8 bytes, CRC right |

What the ECU refuses counts in `E2eErrors` (TIMING, object 200Ch) and is otherwise as if it had not come.
"""
    )


# ---- the rest ------------------------------------------------------------------------------------


def _strict_percent() -> int:
    source = (ROOT / "firmware/ports/linux/loop.c").read_text(encoding="utf-8")
    found = re.search(r"STRICT_DEADLINE_PERCENT = (\d+)", source)
    if found is None:
        raise SystemExit("protocol_page: loop.c no longer names STRICT_DEADLINE_PERCENT")
    return int(found.group(1))


def _timing_section() -> str:
    machine = load_machine(REFERENCE_ARM)
    delay_ms, timeout_ms = 1e3 * machine["io.command_delay_s"], 1e3 * machine["io.valve_timeout_s"]
    wrong = int(machine["supervision.sensor_wrong_ticks"])
    bits = _bits("SYNC", *SENSOR_FRAMES)
    bus_us = bits * US_PER_S / BIT_RATE
    return f"""The ECU leads; nobody else needs a clock. One tick of 1 ms:

```text
   0 us    SYNC k            sensors and spools are sampled HERE, all of them, whenever their frames go out;
                             VALVES k-1 has been in effect for half a tick
           ENCODERS, PRESSURES_SWING, PRESSURES_WRIST, in any order
 {_strict_percent() * 10} us    deadline          of the pace `strict`: what has not come by now is lost for this tick
           the law, VALVES k its SyncCounter is k
 {1e3 * delay_ms:.0f} us    VALVES k acts     not before, even when it came earlier
           a slow frame, heartbeat, emergency, SDO
1000 us    SYNC k+1
```

SYNC and the sensor frames need {bus_us:.0f} us with all stuff bits there can be, more than real values take; a machine
that must hold the deadline even then has a tick of 2 ms ([porting.md](porting.md#the-tick)).

- **SYNC** comes every tick, in every NMT state of the ECU. `SyncCounter` goes 1, 2, .. 240, 1, ..; it is 1 after a
  restart.
- **Sampling**: both angles, four pressures and both spools are one instant's. A node that cannot sample at once samples
  as soon as it can, always equally late: jitter of the sampling becomes noise of the rates.
- **Answer to every SYNC**, in every state, with all three frames, each once. A node that has no new sample says
  `SensorStatus` INVALID; it does not repeat the last one under a new counter.
- **VALVES takes effect {delay_ms:g} ms after its SYNC**, not when it arrives. One whose SyncCounter is not that of the
  last SYNC is refused; the set-points before it stay.
- **Disabled** is any control nibble but 7 (ACTIVE): the node centres the spool, whatever the set-point.
- **{timeout_ms:g} ms without a VALVES that was taken** (`io.valve_timeout_s`) and the node closes both valves by
  itself, whatever it heard last. It goes on as soon as one comes again.
- **Missing sensor frames**: the ECU predicts for up to {wrong} ticks in a row, then stops safely
  ([SENSOR_FRAMES_LOST, SENSOR_FRAMES_CORRUPT](faults.md)); the limit is a parameter.
- **MOTION** is acted on in the tick it comes in. Requests and what they need: [modes.md](modes.md).
"""


def _invalid_section() -> str:
    rows = {
        "angles, spools": "the most negative raw value (24 bits: 800000h, 16 bits: 8000h)",
        "pressures": "the highest raw value, 65535",
        "LoadSd, sd_..": "65535 is no mark: so much, or more",
        "SensorStatus": "15 INVALID: all of the frame; 1 DEGRADED is used like 0 GOOD",
    }
    text = "| signal | invalid |\n|---|---|\n" + "".join(f"| {k} | {v} |\n" for k, v in rows.items())
    return (
        text
        + """
An invalid spool set-point counts as disabled. An invalid sample counts as none: the ECU goes on without, then stops
([SENSOR_INVALID](faults.md)). Values beyond a signal's range are sent as its end, never wrapped round. All
signals are little-endian (Intel); bit 0 is the lowest bit of byte 0.
"""
    )


def _network_section() -> str:
    consumer = 0x000201F4
    source = (ROOT / "firmware/ecu/ecu.c").read_text(encoding="utf-8")
    if f"CONSUMER_DEFAULT 0x{consumer:08X}u" not in source:
        raise SystemExit("protocol_page: ecu.c has another CONSUMER_DEFAULT than the page says")
    return f"""- **Nodes**: ECU 1, I/O node 2, CANopen's predefined connection set; SYNC {SYNC_ID:03X}h, 11-bit
  identifiers, data frames only, {BIT_RATE / 1e6:g} Mbit/s.
- **NMT**, {frame_id("NMT"):03X}h: the master sends command and node (0 is all). The ECU starts in
  PRE-OPERATIONAL: it sends SYNC and heartbeat, answers SDO, and no process frame. START makes it OPERATIONAL: VALVES
  comes every tick, disabled. STOP and ENTER_PREOPERATIONAL shut the valves with one last VALVES; in STOPPED SDO is
  silent, too. RESET_NODE and RESET_COMMUNICATION start it anew, with the tare gone; parameters stay.
- **Heartbeat**, 700h + node: 0 once at boot-up, then the NMT state every 100 ms (object 1017h). The I/O node's
  own state changes nothing: it answers SYNC, and its watch is on VALVES.
- **Who watches whom**: the ECU watches node {consumer >> 16}, once heard, for {consumer & 0xFFFF} ms (object 1016h;
  [HEARTBEAT_LOST](faults.md#heartbeat_lost)) while the law drives the valves. A master lets itself be watched by
  writing its node and time there. A second sender of SYNC, VALVES, ESTIMATE or the ECU's heartbeat is
  [DUPLICATE_NODE](faults.md#duplicate_node).
- **EMCY**, {frame_id("EMCY_ECU"):03X}h: once for each fault that becomes active, with its CiA 301 code, the error
  register, `FaultCode` and all active faults; once with code 0 when the last one is gone. The codes are in
  [faults.md](faults.md), the last eight in 1003h.
- **SDO**, 601h to the ECU and 581h from it: expedited and segmented. Every parameter, estimate, counter and the
  frames themselves: [objects.md](objects.md). The I/O node needs none.
- **The same DBC on both sides**: TIMING page 1 and object 2001h have its hash. A master writes its own to 2002h,
  and the ECU goes to FAULT with another ([DBC_MISMATCH](faults.md#dbc_mismatch)).
"""


def _port_section() -> str:
    return """1. Send 702h with 00h, then with 05h (OPERATIONAL) every 100 ms.
2. On 080h: latch encoders, pressures, spools. Keep its byte as `k`.
3. Send 182h, 282h, 382h: raw values into bytes 2 to 7, status into the high nibble of byte 1, counter (k - 1) mod 15
   into the low one, CRC into byte 0.
4. On 202h: check as the table above has it; keep set-points and control nibbles.
5. 0.5 ms after SYNC: put them into effect.
6. Count the time since the last 202h that was taken; at 20 ms centre both spools.

An angle is raw / 2^24 turns, a pressure raw * 0.005 bar, a spool raw / 16384: the node needs no floating point. To
see it work: `python tools/doctor.py BUS`, then `python tools/monitor.py BUS`. The same node in Python, with the arm
behind it, is [sil_plant/loop/io_node.py](../sil_plant/loop/io_node.py).
"""


def protocol_page() -> dict[Path, str]:
    """docs/protocol.md."""
    sections = {
        "Frames at a glance": _overview(),
        "Timing": _timing_section(),
        "End-to-end protection": _e2e_section(),
        "Numbers, and values that are none": _invalid_section(),
        "Network": _network_section(),
        "Bus load": _load_section(),
        "An I/O node, step by step": _port_section(),
        "Every frame": "".join(_frame_section(message) for message in _messages()),
    }
    text = f"""<!-- Made by tools/generate.py; do not edit. -->
# Protocol

What is on the bus: made from [diarc.dbc](../can_protocol/diarc.dbc), with which any CAN tool decodes the frames. To
port the I/O node, begin with [these steps](#an-io-node-step-by-step); the rest of this page says why, and what every
bit is. Modes and requests: [modes.md](modes.md). Faults: [faults.md](faults.md). What SDO reaches:
[objects.md](objects.md).

Drawings have bytes in the order they are sent, each with its highest bit first; a letter is a signal, a dot an unused
bit.

{"".join(f"- [{name}](#{_anchor(name)})" + chr(10) for name in sections)}"""
    for name, body in sections.items():
        text += f"\n## {name}\n\n{body.rstrip(chr(10))}\n"
    return {PAGE: wrapped(text)}


def _anchor(title: str) -> str:
    return re.sub(r"[^a-z0-9 -]", "", title.lower()).replace(" ", "-")
