"""A run over a bus: the ECU is another process, the plant follows its SYNC."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterator
from typing import Protocol

import numpy as np

from sil_plant.bus import protocol
from sil_plant.bus.frames import FRAME_BYTES, from_row, to_row
from sil_plant.bus.ports import BusError, FramePort
from sil_plant.loop import injection
from sil_plant.loop.external_plant import ExternalPlant, PlantLostError
from sil_plant.loop.io_node import advance_one_period
from sil_plant.loop.session import (
    DBC_HASH,
    HASH_HEARD,
    NMT_ENTER_PRE_OPERATIONAL,
    NMT_RESET,
    NMT_STOP,
    OUT_ROWS,
    REQUEST_STANDBY,
    TICK,
    Session,
    ecu_is_dead,
    motion_frame,
    nmt_frame,
    on_frame,
    on_sync,
    rewind,
    without_sync,
)

ECU_WAIT_S = 3.0
BOOT_WAIT_S = 2.0
# Longer than the ECU's own stall limit: a paused plant must not look like a dead ECU.
ECU_LOST_S = 0.5
COMMANDS_EVERY_TICKS = 10


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


class Commands(Protocol):
    """What others may ask of a running plant."""

    def serve(self, session: Session) -> Session:
        """Carry out what has come since the last time; the session to go on with."""

    def rewound(self, ticks: int) -> None:
        """Told when an endless run counts its ticks anew."""


class EcuPower(Protocol):
    """What switches an ECU of ours off and on again."""

    def kill(self) -> None:
        """End it at once."""

    def start(self) -> None:
        """Start it anew."""


def run_on_bus(
    session: Session,
    port: FramePort,
    progress: Callable[[int], None],
    alive: Callable[[], None],
    power: EcuPower | None = None,
    plant: ExternalPlant | None = None,
    commands: Commands | None = None,
    endless: bool = False,
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
    power : EcuPower or None
        Switches the ECU off and on again, for a scenario that has it killed.
    plant : ExternalPlant, optional
        Another plant than ours.
    commands : Commands or None
        Asked between two ticks, now and then.
    endless : bool
        Go on after the end of the scenario, and when the ECU restarts; the record then has the last of it.

    Raises
    ------
    EcuLostError
        When SYNC stays away, or the ECU boots again and no fault of the scenario made it; the plant has closed its
        valves by then.
    PlantLostError
        When the other plant fails.
    ConfigError
        When the ECU follows another DBC.
    """
    out = np.zeros((OUT_ROWS, FRAME_BYTES), dtype=np.uint8)
    heartbeat_id = protocol.frame_id("HEARTBEAT_ECU")
    check_tick = session.timeline.run_request
    while True:
        frame = port.receive(ECU_LOST_S)
        if frame is None:
            close_valves(session, plant)
            alive()
            raise EcuLostError(f"the ECU fell silent for {ECU_LOST_S:g} s; the valves are closed")
        can_id, data = frame
        if can_id == protocol.SYNC_ID and power is not None and session.faulty and ecu_is_dead(session):
            sit_out_death(session, port, power, out)
        elif can_id == protocol.SYNC_ID and data:
            tick = int(session.progress.index[TICK])
            if tick == check_tick:
                check_hash(session)
            rows = on_sync(session, data[0], out) if plant is None else plant.on_sync(session, data[0], out)
            if rows < 0:
                if not endless:
                    return
                ticks = rewind(session)
                if commands is not None:
                    commands.rewound(ticks)
                rows = on_sync(session, data[0], out)
            port.send_many([from_row(row) for row in out[:rows]])
            if commands is not None and tick % COMMANDS_EVERY_TICKS == 0:
                session = commands.serve(session)
            if tick % 100 == 0:
                progress(tick)
        elif can_id == heartbeat_id and data == b"\0" and not (endless or reboot_expected(session)):
            close_valves(session, plant)
            raise EcuLostError("the ECU restarted in the middle of the run; the valves are closed")
        elif can_id < 0x800:
            on_frame(session, to_row(can_id, data))


def sit_out_death(session: Session, port: FramePort, power: EcuPower, out: np.ndarray) -> None:
    """Kill the ECU, let the node go on by its own clock for as long as the fault lasts, start the ECU anew.

    Raises
    ------
    EcuMissingError
        When it does not boot.
    """
    heartbeat_id = protocol.frame_id("HEARTBEAT_ECU")
    power.kill()  # at the SYNC that the plant no longer answers
    port.discard_pending()
    while ecu_is_dead(session) and without_sync(session, out) >= 0:
        pass
    power.start()
    if not _heard(port, ECU_WAIT_S, lambda can_id, data: can_id == heartbeat_id and data == b"\0", lambda: None):
        raise EcuMissingError("the ECU that was killed does not boot again; try it by hand: ./firmware/diarc_ecu")
    on_frame(session, to_row(heartbeat_id, b"\0"))


def reboot_expected(session: Session) -> bool:
    """True from the first fault on that makes an ECU begin anew."""
    plan = session.injection.plan
    kinds = plan[plan[:, injection.FIRST] < session.progress.index[TICK], injection.KIND]
    return bool(np.isin(kinds, (injection.NMT_RESET, injection.ECU_KILLED)).any())


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
    if session.faulty:
        without_sync(session, out)
        ecu_is_dead(session)
    motion_frame(0, REQUEST_STANDBY)
    close_valves(session)


def close_valves(session: Session, plant: ExternalPlant | None = None) -> None:
    """What the node does without SYNC: it goes on by its own clock until its valves are closed."""
    for _ in range(session.timing.timeout_ticks + 2):
        if plant is not None:
            with contextlib.suppress(PlantLostError):  # a plant that is gone has no valves to close
                plant.advance_one_period(session, 0.0)
        else:
            advance_one_period(session.node, session.plant, session.timing, session.errors, 0.0)


def park_ecu(port: FramePort) -> None:
    """Have the ECU of a run that is over shut the valves and answer SDO; it hears no sensors any more."""
    port.send(*from_row(nmt_frame(NMT_ENTER_PRE_OPERATIONAL)))


@contextlib.contextmanager
def served(port: FramePort) -> Iterator[None]:
    """Take what comes on the bus, so that a hub in this process goes on for its clients, while the context lasts."""
    over = threading.Event()

    def serve() -> None:
        with contextlib.suppress(BusError):  # who uses the bus meanwhile is told by its own port
            while not over.is_set():
                port.receive(0.02)

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


def leave_ecu_safe(port: FramePort) -> None:
    """Ask the ECU to shut the valves and to stop, whatever state the bus is in."""
    with contextlib.suppress(Exception):
        port.send(*from_row(motion_frame(14, REQUEST_STANDBY)))
        port.send(*from_row(nmt_frame(NMT_STOP)))
