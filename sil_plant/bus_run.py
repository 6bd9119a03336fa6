"""A run over a bus: the ECU is another process, the plant follows its SYNC."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable

import numpy as np

from sil_plant import protocol
from sil_plant.buses import FramePort
from sil_plant.external_plant import ExternalPlant
from sil_plant.frames import FRAME_BYTES, from_row, to_row
from sil_plant.io_node import IO_HEARTBEAT_S, advance_one_period, heartbeat_row
from sil_plant.session import (
    DBC_HASH,
    HASH_HEARD,
    NMT_RESET,
    NMT_STOP,
    OUT_ROWS,
    REQUEST_STANDBY,
    TICK,
    Session,
    motion_frame,
    nmt_frame,
    on_frame,
    on_sync,
)

ECU_WAIT_S = 3.0
BOOT_WAIT_S = 2.0
# Longer than the ECU's own stall limit: a paused plant must not look like a dead ECU.
ECU_LOST_S = 0.5


class EcuMissingError(Exception):
    """Nobody answers as the ECU; says how to start one."""


class EcuLostError(Exception):
    """The ECU went away, or began anew, in the middle of a run."""


def wait_for_ecu(port: FramePort, bus: str, alive: Callable[[], None]) -> None:
    """Wait until the ECU is heard, reset it, and take its frames from its boot-up message on.

    Parameters
    ----------
    port : FramePort
        The bus.
    bus : str
        Its name, for the message.
    alive : callable
        Raises when an ECU that was spawned has ended.

    Raises
    ------
    EcuMissingError
        When no ECU is heard within 3 s, or it does not restart.
    """
    heartbeat_id = protocol.frame_id("HEARTBEAT_ECU")
    if not _heard(port, ECU_WAIT_S, lambda can_id, _: can_id in (protocol.SYNC_ID, heartbeat_id), alive):
        how = (
            "is the board powered and running its image? docs/porting.md"
            if bus.startswith("slcan:")
            else f"start one: ./firmware/diarc_ecu {bus}   (or let run.py start it: --ecu spawn)"
        )
        raise EcuMissingError(f"no ECU on {bus} within {ECU_WAIT_S:g} s; {how}")
    port.send(*from_row(nmt_frame(NMT_RESET)))
    if not _heard(port, BOOT_WAIT_S, lambda can_id, data: can_id == heartbeat_id and data == b"\0", alive):
        raise EcuMissingError(
            f"the ECU on {bus} does not restart on NMT reset; is it this version's? Build it (make firmware, make "
            "images) and start it anew"
        )


def _heard(port: FramePort, limit_s: float, wanted: Callable[[int, bytes], bool], alive: Callable[[], None]) -> bool:
    deadline = time.monotonic() + limit_s
    while (left := deadline - time.monotonic()) > 0.0:
        frame = port.receive(min(left, 0.1))
        if frame is not None and wanted(*frame):
            return True
        alive()
    return False


def run_on_bus(
    session: Session,
    port: FramePort,
    progress: Callable[[int], None],
    alive: Callable[[], None],
    plant: ExternalPlant | None = None,
) -> None:
    """Run the session to its end; the ECU must just have booted.

    Parameters
    ----------
    session : Session
        The run.
    port : FramePort
        The bus.
    progress : callable
        Told the tick now and then.
    alive : callable
        Raises when an ECU that was spawned has ended.
    plant : ExternalPlant, optional
        Another plant than ours.

    Raises
    ------
    EcuLostError
        When SYNC stays away or the ECU boots again; the plant has closed its valves by then.
    PlantLostError
        When the other plant fails.
    ConfigError
        When the ECU follows another DBC.
    """
    out = np.zeros((OUT_ROWS, FRAME_BYTES), dtype=np.uint8)
    heartbeat_id = protocol.frame_id("HEARTBEAT_ECU")
    period_s = session.timing.period_s
    check_tick = session.timeline.run_request
    heartbeat_ticks = max(1, round(IO_HEARTBEAT_S / period_s))
    heartbeat = from_row(heartbeat_row())
    while True:
        frame = port.receive(ECU_LOST_S)
        if frame is None:
            close_valves(session, plant)
            alive()
            raise EcuLostError(f"the ECU fell silent for {ECU_LOST_S:g} s; the valves are closed")
        can_id, data = frame
        if can_id == protocol.SYNC_ID and data:
            tick = int(session.progress.index[TICK])
            if tick == check_tick:
                check_hash(session)
            rows = on_sync(session, data[0], out) if plant is None else plant.on_sync(session, data[0], out)
            if rows < 0:
                return
            answer = [from_row(row) for row in out[:rows]]
            if tick % heartbeat_ticks == 0:
                answer.append(heartbeat)
            port.send_many(answer)
            if tick % 100 == 0:
                progress(tick)
        elif can_id == heartbeat_id and data == b"\0":
            close_valves(session, plant)
            raise EcuLostError("the ECU restarted in the middle of the run; the valves are closed")
        elif can_id < 0x800:
            on_frame(session, to_row(can_id, data))


def check_hash(session: Session) -> None:
    """Refuse an ECU that has told another DBC hash.

    Raises
    ------
    ConfigError
        Naming both hashes.
    """
    whole = session.monitor.whole
    if whole[HASH_HEARD]:
        protocol.check_dbc_hash(int(whole[DBC_HASH]))


def warm_up(session: Session) -> None:
    """Compile all that a run on a bus calls, with a session that is thrown away afterwards."""
    out = np.zeros((OUT_ROWS, FRAME_BYTES), dtype=np.uint8)
    on_sync(session, 6, out)
    for row in out[:1]:
        on_frame(session, to_row(*from_row(row)))
    motion_frame(0, REQUEST_STANDBY)
    close_valves(session)


def close_valves(session: Session, plant: ExternalPlant | None = None) -> None:
    """What the node does without SYNC: it goes on by its own clock until its valves are closed."""
    for _ in range(session.timing.timeout_ticks + 2):
        if plant is not None:
            plant.advance_one_period(session, 0.0)
        else:
            advance_one_period(session.node, session.plant, session.timing, session.errors, 0.0)


def leave_ecu_safe(port: FramePort) -> None:
    """Ask the ECU to shut the valves and to stop, whatever state the bus is in."""
    with contextlib.suppress(Exception):
        port.send(*from_row(motion_frame(14, REQUEST_STANDBY)))
        port.send(*from_row(nmt_frame(NMT_STOP)))
