"""A run through every mode of the ECU, as commands of a master: what a tick costs when modes begin and end."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sil_plant.bus import protocol
from sil_plant.bus.frames import frame_id, protect, to_row
from sil_plant.inputs.machine import Machine
from sil_plant.inputs.scenario import LoadStep, Scenario
from sil_plant.loop import execution, session

SDO_REQUEST_ID = 0x601
NMT_ENTER_PRE_OPERATIONAL = 128
MASTER_HASH, LOAD_ESTIMATE = 0x2002, 0x2010
REQUEST_HOLD, REQUEST_COMMISSION, REQUEST_SAFE_STOP = 6, 7, 8
MODES = {"STANDBY", "RUN", "TARE", "COMMISSION", "HOLD", "SAFE_STOP", "FAULT"}  # INIT is where every run begins
MOVE_RAD, MOVE_MS = 0.1, 400
DURATION_S = 3.0


def sdo_read(index: int) -> np.ndarray:
    """A request to read an object."""
    return to_row(SDO_REQUEST_ID, bytes((0x40, index & 0xFF, index >> 8, 0, 0, 0, 0, 0)))


def sdo_write(index: int, value: int) -> np.ndarray:
    """A request to write an object of four bytes."""
    return to_row(SDO_REQUEST_ID, bytes((0x23, index & 0xFF, index >> 8, 0)) + value.to_bytes(4, "little"))


def commands(start_rad: tuple[float, float]) -> list[tuple[float, np.ndarray]]:
    """Seconds since the moves could begin, and the frame; MOTION frames not yet with their counter."""

    def moves(time_s: float, away: bool) -> list[tuple[float, np.ndarray]]:
        step = MOVE_RAD if away else 0.0
        return [
            (time_s + 0.001 * joint, _motion(session.REQUEST_MOVE, joint, start_rad[joint] + step)) for joint in (0, 1)
        ]

    return [
        *moves(0.0, away=True),
        (0.2, _motion(REQUEST_HOLD)),  # brakes the moves
        (0.5, _motion(session.REQUEST_RUN)),
        *moves(0.55, away=False),
        (0.7, _motion(REQUEST_SAFE_STOP)),  # in the middle of a move
        (1.0, _motion(REQUEST_COMMISSION)),
        *moves(1.05, away=True),
        (1.5, _motion(session.REQUEST_STANDBY)),  # through SAFE_STOP
        (1.8, _motion(session.REQUEST_RUN)),
        (1.9, sdo_write(MASTER_HASH, 1)),  # a fault
        (2.2, sdo_write(MASTER_HASH, 0)),
        (2.25, _motion(session.REQUEST_RESET_FAULT)),
        (2.3, _motion(session.REQUEST_RUN)),
        *moves(2.35, away=False),
        (2.5, session.nmt_frame(NMT_ENTER_PRE_OPERATIONAL)),  # with the valves open
        (2.55, session.nmt_frame(session.NMT_START)),
        (2.65, _motion(session.REQUEST_RUN)),
        *((0.01 * k, sdo_read(LOAD_ESTIMATE)) for k in range(20, 290, 5) if k not in (190, 220)),
    ]


def _motion(request: int, joint: int = 0, target_rad: float = 0.0) -> np.ndarray:
    controller = session.CONTROLLERS.index("diarc")
    return session.motion_frame(0, request, joint, controller, target_rad, MOVE_MS)


def make(machine: Machine, scenario: Scenario) -> session.Session:
    """The run: the arm of a scenario, unloaded, with the commands above in place of its moves."""
    scenario = replace(scenario, load=(LoadStep(0.0, 0.0),), duration_s=DURATION_S)
    run = session.make_session(machine, scenario, "diarc", scenario.seed, execution.PERIOD_US * 1e-6, True)
    timeline, before = run.timeline, run.schedule
    keep = before.frame_tick < timeline.motion
    rows = list(zip(before.frame_tick[keep].tolist(), before.frame_row[keep], strict=True))
    start_rad = (scenario.start_pose_rad[0], scenario.start_pose_rad[1])
    rows += [(timeline.motion + round(time_s / timeline.period_s), row) for time_s, row in commands(start_rad)]
    rows.sort(key=lambda row: row[0])
    motion_id, counter = protocol.frame_id("MOTION"), 0
    for _, row in rows:
        if frame_id(row) == motion_id:
            protect(row, counter % 15)
            counter += 1
    none = np.zeros(0, dtype=np.int64)
    return run._replace(
        schedule=before._replace(
            frame_tick=np.array([tick for tick, _ in rows], dtype=np.int64),
            frame_row=np.array([row for _, row in rows], dtype=np.uint8),
            move_tick=none,
            move_joint=none,
            move_target=np.zeros(0),
            move_ticks=none,
        )
    )


def failure(run: session.Session) -> str | None:
    """Why the run was not through every mode, or None."""
    seen = {session.MODE_NAMES.get(int(mode), "?") for mode in np.unique(run.record.mode)}
    if MODES - seen:
        return f"the ECU was never in {', '.join(sorted(MODES - seen))}"
    last = session.MODE_NAMES.get(int(run.monitor.whole[session.MODE]), "?")
    return None if last == "RUN" else f"the ECU ended in {last}"
