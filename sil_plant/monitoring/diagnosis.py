"""Why nothing moves: from what was heard and what the computer says to findings, each with the next command."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

from sil_plant.bus import protocol
from sil_plant.bus.ports import BusAddress, BusError
from sil_plant.config import ROOT
from sil_plant.monitoring.host import ECU_BINARY, LinkFacts, RealtimeFacts, kernel_has_can, link_facts, realtime_facts
from sil_plant.monitoring.listen import Listener
from sil_plant.monitoring.watch import Snapshot, Watch

Severity = Literal["error", "warning", "note"]

SENSORS = ("ENCODERS", "PRESSURES_SWING", "PRESSURES_WRIST")
_QUEUE_LEAST = 100  # frames; the kernel's default for a real interface, 10, is two ticks
_SLOW_SHARE = 0.3  # of the nominal rate of SYNC; a busy computer alone does not slow it so far
_MISSING_SHARE = 0.05
_SKIPPED_SHARE = 0.01
_FULL_BUS = 0.9
_LONGEST_PERIOD_US = 20000
_FEWEST = 20  # frames from which a share says something

REFUSALS = {
    "NOT_OPERATIONAL": "the network was not started: NMT START first",
    "NOT_IN_STANDBY": "it is possible from STANDBY only",
    "NOT_IN_RUN": "a MOVE is possible in RUN and COMMISSION only: RUN first",
    "SENSORS_NOT_FRESH": "the sensor frames of that tick were not all there and good",
    "MOVE_UNDER_WAY": "the joint was still moving",
    "TARGET_OUT_OF_RANGE": "the target is outside the joint's range",
    "DURATION_TOO_SHORT": "the move would be faster than the joint may go: give it more time",
    "NO_FAULT_TO_RESET": "there was no fault",
    "UNKNOWN_REQUEST": "the ECU does not know such a request, joint or controller",
    "NOT_DEPRESSURISED": "a tare needs all chambers at tank pressure: pump off, wait",
    "STOPPING": "a safe stop was under way: wait for STANDBY",
    "CAUSE_PERSISTS": "the cause of the fault is still there",
}


@dataclass(frozen=True)
class Finding:
    """One thing that is wrong, or worth knowing.

    Attributes
    ----------
    code : str
        Short name that stays, for scripts.
    severity : {'error', 'warning', 'note'}
        An error keeps the arm from moving, a warning may; a note is no reason to act.
    text : str
        What is wrong.
    next : str
        The command to type, or what to do by hand.
    """

    code: str
    severity: Severity
    text: str
    next: str


@dataclass(frozen=True)
class Evidence:
    """What a diagnosis rests on.

    Attributes
    ----------
    address : BusAddress
        The bus asked about.
    has_can : bool
        This kernel knows CAN sockets.
    link : LinkFacts or None
        The interface of a SocketCAN bus.
    realtime : RealtimeFacts
        Permissions.
    problem : str
        Why the bus could not be opened, or broke; empty when it was open all the time.
    state : Snapshot or None
        What was heard; None when the bus was never open.
    listened_s : float
        For how long.
    """

    address: BusAddress
    has_can: bool
    link: LinkFacts | None
    realtime: RealtimeFacts
    problem: str
    state: Snapshot | None
    listened_s: float

    @property
    def bus(self) -> str:
        """The bus string."""
        return str(self.address)

    @property
    def real(self) -> bool:
        """A bus with a cable, as far as can be told."""
        if self.address.kind == "slcan":
            return "://" not in self.address.channel
        return self.link is not None and not self.link.virtual


def examine(address: BusAddress, listen_s: float) -> Evidence:
    """Listen to a bus, and look at this computer; nothing is sent or changed."""
    watch = Watch(time.monotonic())
    listener = Listener(address, watch)
    state = None
    try:
        listener.open()
    except BusError as error:
        listener.problem = str(error)
    else:
        listener.listen(time.monotonic() + listen_s)
        state = watch.snapshot(time.monotonic())
    finally:
        listener.close()
    link = link_facts(address.channel) if address.kind == "socketcan" else None
    return Evidence(address, kernel_has_can(), link, realtime_facts(), listener.problem, state, listen_s)


def diagnose(evidence: Evidence) -> list[Finding]:
    """Every finding, in the order in which to mend them: what comes first may explain what follows."""
    found = [*_of_interface(evidence)]
    if not any(finding.severity == "error" for finding in found) and evidence.problem:
        found.append(_of_opening(evidence))
    if evidence.state is not None:
        found += _of_bus(evidence, evidence.state)
    found += _of_realtime(evidence)
    return sorted(found, key=lambda finding: ("error", "warning", "note").index(finding.severity))


# ---- this computer -------------------------------------------------------------------------------


def _of_interface(evidence: Evidence) -> Iterator[Finding]:
    link = evidence.link
    if link is None:
        return
    name = link.name
    set_up = f"sudo ip link set {name} up" + ("" if link.virtual else f" type can bitrate {protocol.BIT_RATE}")
    if not evidence.has_can:
        yield Finding(
            "no-can-in-kernel",
            "error",
            "this kernel has no CAN sockets; without them use tcp:127.0.0.1:29536 as the bus",
            "sudo modprobe -a can_raw vcan",
        )
        return
    if not link.exists:
        there = f"; CAN interfaces here: {', '.join(link.others)}" if link.others else "; there is no CAN interface"
        yield Finding(
            "no-interface",
            "error",
            f"there is no interface {name}{there}",
            f"sudo ip link add dev {name} type vcan && {set_up}" if link.virtual else "ip -brief link",
        )
        return
    if not link.is_can:
        there = f"; CAN interfaces here: {', '.join(link.others)}" if link.others else ""
        yield Finding("not-can", "error", f"{name} is a network interface, but not CAN{there}", "ip -brief link")
        return
    if not link.up:
        yield Finding("interface-down", "error", f"interface {name} is down", set_up)
        return
    again = f"sudo ip link set {name} down && {set_up}"
    if link.bitrate is not None and link.bitrate != protocol.BIT_RATE:
        yield Finding(
            "bitrate",
            "error",
            f"{name} runs at {link.bitrate} bit/s, the ECU at {protocol.BIT_RATE}",
            again,
        )
    if link.state in ("BUS-OFF", "STOPPED", "ERROR-PASSIVE"):
        yield Finding(
            "controller-state",
            "error",
            f"the CAN controller of {name} is {link.state}: no other node acknowledges, the bit rate differs, or "
            "cable and termination (60 ohm between CAN-H and CAN-L) are wrong",
            f"{again} restart-ms 100",
        )
    if link.queue is not None and link.queue < _QUEUE_LEAST:
        yield Finding(
            "short-queue",
            "warning",
            f"the transmit queue of {name} holds {link.queue} frames: sending fails with ENOBUFS when the bus is "
            "busy for two ticks",
            f"sudo ip link set {name} txqueuelen 1000",
        )
    if link.dropped:
        yield Finding(
            "kernel-drops",
            "note",
            f"the kernel has dropped {link.dropped} frames on {name} since it is up",
            f"ip -details -statistics link show {name}",
        )


def _of_opening(evidence: Evidence) -> Finding:
    bus, problem = evidence.bus, evidence.problem
    if evidence.address.kind == "tcp":
        port = evidence.address.port
        if "nobody listens" in problem or "cannot reach" in problem:
            return Finding(
                "no-hub",
                "error",
                f"nobody listens on {bus}: the plant hosts this bus, and it does not run",
                f"python sil_plant/run.py --bus {bus} --ecu spawn",
            )
        return Finding("hub-answers-wrong", "error", problem, f"ss -ltnp 'sport = :{port}'")
    typed = re.search(r"`([^`]+)`", problem)
    return Finding("bus-not-open", "error", problem, typed.group(1) if typed else f"python tools/doctor.py {bus}")


def _of_realtime(evidence: Evidence) -> Iterator[Finding]:
    """Missing permissions matter with ``--pace strict`` only, and more when ticks come late."""
    facts = evidence.realtime
    if evidence.real and evidence.state is not None and evidence.state.ecu.alive:
        return  # the ECU is a board
    missing = [
        word
        for word, is_there in (("SCHED_FIFO (ulimit -r)", facts.may_have_priority),
                               ("locked memory (ulimit -l)", facts.may_lock_memory))
        if not is_there
    ]  # fmt: skip
    if not facts.built:
        yield Finding("ecu-not-built", "note", "firmware/diarc_ecu is not built here", "make firmware")
    elif missing:
        late = evidence.state is not None and bool(evidence.state.timing_rise.get("LateTicks"))
        yield Finding(
            "no-realtime-permission",
            "warning" if late else "note",
            f"diarc_ecu --pace strict has no permission for {' and '.join(missing)}"
            + (", and ticks come late" if late else "; the other paces do without"),
            f"sudo setcap cap_sys_nice,cap_ipc_lock=ep {ECU_BINARY.relative_to(ROOT)}",
        )


# ---- what was heard ------------------------------------------------------------------------------


def _of_bus(evidence: Evidence, state: Snapshot) -> Iterator[Finding]:
    bus, within = evidence.bus, f"within {evidence.listened_s:g} s"
    start_ecu = (
        "is the board powered, and does it run its image? docs/porting.md"
        if evidence.real or evidence.address.kind == "slcan"
        else f"./firmware/diarc_ecu {bus}"
    )
    if state.silent:
        if not evidence.problem:
            yield Finding("silent", "error", f"{bus} is open, but no frame came {within}: no ECU, no plant", start_ecu)
        return
    if not state.ecu.alive:
        yield Finding(
            "no-ecu", "error", f"no ECU: neither SYNC (0x080) nor its heartbeat (0x701) was heard {within}", start_ecu
        )
    yield from _of_identity(evidence, state)
    yield from _of_io_node(evidence, state)
    if state.ecu.alive:
        yield from _of_ecu(evidence, state)
    yield from _of_frames(evidence, state)


def _of_identity(evidence: Evidence, state: Snapshot) -> Iterator[Finding]:
    who = "unplug one of the boards" if evidence.real else "pgrep -a diarc_ecu"
    if state.ecu.doubled:
        yield Finding(
            "two-ecus", "error", "two ECUs lead the bus: the counters of SYNC (0x080) run into one another", who
        )
    if state.io_node.doubled:
        yield Finding(
            "two-io-nodes",
            "error",
            "two I/O nodes answer: more than one ENCODERS frame (0x182) for a SYNC",
            "unplug one of the I/O nodes" if evidence.real else "pgrep -af sil_plant/run.py",
        )
    if state.dbc_match is False:
        yield Finding(
            "dbc-mismatch",
            "error",
            f"the ECU's firmware was built from another DBC (its hash is {state.dbc_hash_heard:08X}, "
            f"can_protocol/diarc.dbc here has {state.dbc_hash:08X}): values shown here may be wrong",
            "make firmware   # and start the ECU anew; or use the tools of its release",
        )


def _of_io_node(evidence: Evidence, state: Snapshot) -> Iterator[Finding]:
    bus = evidence.bus
    frames = state.frames
    missing = [name for name in SENSORS if frames[name].age_s is None or frames[name].age_s > 1.0]
    if evidence.address.kind == "tcp":
        start = (
            f"ss -ltnp 'sport = :{evidence.address.port}'   # who hosts the bus; the plant is python sil_plant/run.py"
        )
    elif evidence.real:
        start = f"python tools/monitor.py {bus}   # while you check power and cable of the I/O node"
    else:
        start = f"python sil_plant/run.py --bus {bus}"
    if len(missing) == len(SENSORS) and not state.io_node.alive:
        yield Finding(
            "no-plant",
            "error",
            "no plant: no sensor frames (0x182, 0x282, 0x382) and no heartbeat (0x702) of the I/O node",
            start,
        )
        return
    if missing:
        ids = ", ".join(f"{name} (0x{frames[name].can_id:03X})" for name in missing)
        yield Finding("sensor-missing", "error", f"the I/O node sends no {ids}", start)
    beat_s = state.io_node.heartbeat_age_s
    if beat_s is None or beat_s > 1.0:
        yield Finding(
            "no-io-heartbeat",
            "warning",
            "the I/O node sends sensor frames, but no heartbeat (0x702)",
            f"python tools/monitor.py {bus}",
        )
    elif state.io_node.nmt not in ("OPERATIONAL", None):
        yield Finding(
            "io-not-operational",
            "error",
            f"the I/O node is {state.io_node.nmt}, not OPERATIONAL",
            f"python tools/request.py {bus} START",
        )
    for name, joint in state.joints.items():
        if joint.sensor_status not in ("GOOD", None):
            yield Finding(
                "sensor-status",
                "error" if joint.sensor_status == "INVALID" else "warning",
                f"the I/O node marks the sensors of the {name} joint {joint.sensor_status}",
                f"python tools/monitor.py {bus}   # while you mend the sensor",
            )


def _of_ecu(evidence: Evidence, state: Snapshot) -> Iterator[Finding]:
    bus = evidence.bus
    sync = state.frames["SYNC"]
    if not state.frames["HEARTBEAT_ECU"].count and (sync.rate_hz or 0.0) > nominal_hz(state):
        yield Finding(
            "no-ecu-heartbeat",
            "warning",
            "the ECU leads the bus, but its heartbeat (0x701) is missing",
            f"python tools/monitor.py {bus}",
        )
    for fault in state.faults:
        yield Finding(
            "fault",
            "warning" if fault.reaction == "degrade" else "error",
            f"fault {fault.name} ({fault.code}): {fault.when}. To clear: {fault.clear}",
            f"python tools/monitor.py {bus}"
            if fault.reaction == "degrade"
            else f"python tools/request.py {bus} RESET_FAULT",
        )
    if state.mode is None:
        if state.ecu.nmt not in ("OPERATIONAL", None):
            yield Finding(
                "not-started",
                "error",
                f"the ECU is {state.ecu.nmt}: nobody has started the network, so it sends no valve commands",
                f"python tools/request.py {bus} START",
            )
    else:
        yield from _of_mode(evidence, state, state.mode)
    refused = state.timing.get("RefusedRequests")
    if refused:
        reason = str(state.timing.get("LastRefusal", "?"))
        rise = state.timing_rise.get("RefusedRequests", 0)
        yield Finding(
            "refused",
            "warning" if rise or state.mode in ("INIT", "STANDBY", "FAULT") else "note",
            f"the ECU has refused {refused:.0f} requests, the last with {reason}: "
            f"{REFUSALS.get(reason, 'see the DBC')}",
            f"python tools/monitor.py {bus}",
        )
    if sync.rate_hz is not None and sync.count >= 2:
        nominal = nominal_hz(state)
        if sync.rate_hz < _SLOW_SHARE * nominal:
            yield Finding(
                "slow-sync",
                "warning",
                f"SYNC comes {sync.rate_hz:.0f} times a second instead of {nominal:.0f}: the ECU waits for sensor "
                "frames, or its computer is too busy",
                f"python tools/monitor.py {bus}",
            )


def nominal_hz(state: Snapshot) -> float:
    """Ticks a second as the ECU tells; the fewest it may have where it does not."""
    period_us = state.timing.get("PeriodUs")
    return 1e6 / period_us if isinstance(period_us, int | float) and period_us else 1e6 / _LONGEST_PERIOD_US


def _of_mode(evidence: Evidence, state: Snapshot, mode: str) -> Iterator[Finding]:
    bus = evidence.bus
    run = f"python tools/request.py {bus} RUN"
    if mode == "INIT":
        yield Finding(
            "mode-init",
            "error",
            "mode INIT: the ECU has not had good sensor frames for a whole tick yet",
            f"python tools/monitor.py {bus}",
        )
    elif mode == "STANDBY":
        yield Finding("mode-standby", "warning", "mode STANDBY: all is ready, but nobody has asked for RUN", run)
    elif mode == "FAULT" and not state.faults:
        yield Finding(
            "mode-fault",
            "error",
            "mode FAULT; which fault is not told yet",
            f"python tools/request.py {bus} RESET_FAULT",
        )
    elif mode == "SAFE_STOP":
        yield Finding(
            "mode-safe-stop", "warning", "mode SAFE_STOP: the arm is being stopped", f"python tools/doctor.py {bus}"
        )
    elif mode == "TARE":
        yield Finding(
            "mode-tare", "note", "mode TARE: the pressure sensors are being compared", f"python tools/doctor.py {bus}"
        )
    elif mode == "HOLD":
        yield Finding("mode-hold", "note", "mode HOLD: the arm is held where it is", run)
    elif mode in ("RUN", "COMMISSION") and state.moving is False:
        yield Finding(
            "no-move",
            "note",
            f"mode {mode}, but no move is under way",
            f"python tools/request.py {bus} MOVE --joint swing --target 0.3 --duration 2",
        )


def _of_frames(evidence: Evidence, state: Snapshot) -> Iterator[Finding]:
    bus = evidence.bus
    look = (
        f"ip -details -statistics link show {evidence.link.name}" if evidence.link else f"python tools/monitor.py {bus}"
    )
    for name, kind in state.frames.items():
        if kind.corrupt:
            yield Finding(
                "corrupt-frames",
                "error",
                f"{kind.corrupt} of {kind.count} {name} frames (0x{kind.can_id:03X}) have a wrong CRC or length: "
                "noise, a second sender of this identifier, or a sender with another DBC",
                look,
            )
    syncs = state.frames["SYNC"].count
    for name in SENSORS:
        kind = state.frames[name]
        if syncs >= _FEWEST and kind.count >= _FEWEST and syncs - kind.count > _MISSING_SHARE * syncs + 1:
            yield Finding(
                "frames-missing",
                "warning",
                f"{syncs - kind.count} of {syncs} {name} frames (0x{kind.can_id:03X}) did not come",
                look,
            )
    skipping = [
        name
        for name, kind in state.frames.items()
        if kind.count >= _FEWEST and kind.skipped > _SKIPPED_SHARE * kind.count + 1
    ]
    if skipping and not state.receive_drops and not (state.ecu.doubled or state.io_node.doubled):
        yield Finding(
            "counters-skip",
            "warning",
            f"sequence counters jump in {', '.join(skipping)}: frames are lost on the way, or sent twice",
            look,
        )
    yield from _of_counters(evidence, state, look)
    if state.receive_drops:
        yield Finding("own-drops", "note", f"this computer was too busy to read {state.receive_drops} frames", "uptime")
    if evidence.real and (state.bus_load or 0.0) > _FULL_BUS:
        yield Finding(
            "bus-full",
            "warning",
            f"the bus is loaded to {state.bus_load or 0.0:.0%} of {protocol.BIT_RATE} bit/s",
            look,
        )
    if state.unknown:
        listed = ", ".join(f"{can_id} ({count})" for can_id, count in list(state.unknown.items())[:8])
        yield Finding(
            "unknown-frames",
            "note",
            f"frames that are in no DBC here: {listed}; harmless unless they crowd the bus",
            f"python tools/monitor.py {bus}",
        )


def _of_counters(evidence: Evidence, state: Snapshot, look: str) -> Iterator[Finding]:
    meant = {
        "E2eErrors": ("ecu-e2e", "frames refused by the ECU for their CRC, counter or length"),
        "LostFrames": ("ecu-lost", "sensor frames that did not reach the ECU in time, or were refused"),
        "LateTicks": ("ecu-late", "ticks of the ECU without all sensor frames at the deadline"),
        "SendDrops": ("ecu-drops", "frames of the ECU that its bus driver did not take (queue full or bus-off)"),
    }
    for counter, (code, words) in meant.items():
        rise, total = state.timing_rise.get(counter, 0), state.timing.get(counter, 0)
        if isinstance(total, str) or not total:
            continue
        if rise:
            yield Finding(
                code, "warning", f"{words}: {rise} within {evidence.listened_s:g} s, {total:.0f} in all", look
            )
        else:
            yield Finding(code, "note", f"{words}: {total:.0f} since its start, none while listening", look)
