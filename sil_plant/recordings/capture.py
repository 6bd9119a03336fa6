"""A run in this process with every frame kept, as a recorder on a bus would have it."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from sil_plant.bus import protocol
from sil_plant.bus.frames import DATA, FRAME_BYTES, frame_id, from_row
from sil_plant.loop.execution import PERIOD_US
from sil_plant.loop.inproc import InprocEcu
from sil_plant.loop.session import OUT_ROWS, Session, on_frame, on_sync

if TYPE_CHECKING:
    import can

STEP_S = 20e-6  # between two frames of a tick: any bus keeps their order


def capture(
    run: Session, ecu: InprocEcu, disturb: Callable[[int, np.ndarray], np.ndarray] | None = None
) -> list[can.Message]:
    """Carry out a session and keep the frames of both sides.

    Parameters
    ----------
    run : Session
        The run; it goes to its end.
    ecu : InprocEcu
        Just made.
    disturb : callable, optional
        Given tick and frames for the ECU; gives the frames that the bus makes of them.

    Returns
    -------
    list of can.Message
        In the order of the bus. Time is simulated: tick by tick, one period each.
    """
    import can

    messages: list[can.Message] = []
    out = np.zeros((OUT_ROWS, FRAME_BYTES), dtype=np.uint8)
    nothing = np.zeros((0, FRAME_BYTES), dtype=np.uint8)
    tick, start_s = 0, 0.0

    def keep(rows: np.ndarray, received: bool) -> None:
        for row in rows:
            can_id, data = from_row(row)
            messages.append(
                can.Message(
                    timestamp=start_s + STEP_S * (len(messages) - first),
                    arbitration_id=can_id,
                    data=data,
                    is_extended_id=False,
                    is_rx=received,
                    channel="vcan0",
                )
            )

    while True:
        first, start_s = len(messages), tick * PERIOD_US * 1e-6
        sent = ecu.tick_begin()
        heard = nothing
        for row in sent:
            if frame_id(row) == protocol.SYNC_ID:
                count = on_sync(run, int(row[DATA]), out)
                if count < 0:
                    return messages
                heard = out[:count].copy()
            else:
                on_frame(run, row)
        keep(sent, True)
        if disturb is not None:
            heard = disturb(tick, heard)
        keep(heard, True)
        answer = ecu.tick_end(heard)
        for row in answer:
            on_frame(run, row)
        keep(answer, True)
        tick += 1
