"""Frames of a master that asks an ECU for a mode or a move: network management and MOTION (docs/modes.md)."""

from __future__ import annotations

import time
from collections.abc import Sequence

from sil_plant.bus.frames import E2E_STATES, from_row
from sil_plant.bus.protocol import database
from sil_plant.inputs.scenario import Segment
from sil_plant.loop import session
from sil_plant.monitoring.listen import Listener
from sil_plant.monitoring.watch import JOINTS, Snapshot

NETWORK = {"START": (1, "OPERATIONAL"), "STOP": (2, "STOPPED"), "RESET": (129, "PRE_OPERATIONAL")}
DRIVING = ("RUN", "COMMISSION")
_SHORTEST_REST_S = 0.1
_ARRIVED_RAD = 2.5e-6  # of the reference: a move ends so gently that 1 mrad is left for its last tenth
_ARRIVAL_S = 3.0  # so much later than planned the next move is made in any case
_CONTROLLER_LIMIT_S = 3.0
_RESTING = ("STANDBY", "INIT", "FAULT")


def request_frames(
    request: str,
    counter: int,
    *,
    joint: str = JOINTS[0],
    controller: str = "diarc",
    target_rad: float = 0.0,
    duration_s: float = 0.001,
) -> list[tuple[int, bytes]]:
    """The frames of one request.

    Parameters
    ----------
    request : str
        ``START``, ``STOP``, ``RESET``, or as MOTION.Request has it.
    counter : int
        E2E counter of the first; two are used.
    joint, target_rad, duration_s : str, float, float
        Of MOVE.
    controller : str
        Of RUN, HOLD, COMMISSION.
    """
    if request in NETWORK:
        return [(0x000, bytes((NETWORK[request][0], 0)))]
    choices = database().get_message_by_name("MOTION").get_signal_by_name("Request").choices
    code = next(code for code, name in choices.items() if str(name) == request)
    # A counter that the last master may have used last is refused once; NONE takes that upon itself.
    return [
        from_row(session.motion_frame(counter % E2E_STATES, 0)),
        from_row(
            session.motion_frame(
                (counter + 1) % E2E_STATES,
                code,
                joint=JOINTS.index(joint),
                controller=session.CONTROLLERS.index(controller),
                target_rad=target_rad,
                duration_ms=max(1, round(1e3 * duration_s)),
            )
        ),
    ]


class Master:
    """Leads an ECU that somebody watches: single requests, a change of controller, moves that repeat.

    It is asked to act with every snapshot (`step`), and sends through the listener that made it.

    Parameters
    ----------
    listener : Listener
        Of the bus.
    segments : tuple
        Moves of swing and of wrist, made again and again while `repeat` is set and the ECU is in RUN.

    Attributes
    ----------
    repeat : bool
        Make the moves.
    controller : str
        Of the next RUN.
    """

    def __init__(self, listener: Listener, segments: Sequence[Sequence[Segment]]) -> None:
        self._listener = listener
        self._segments = segments
        self._counter = 0
        self._next: list[tuple[float, int]] | None = None  # of each joint: when, which segment
        self._last: list[float | None] = [None] * len(JOINTS)  # of each joint: where it was sent
        self._changing_since_s: float | None = None
        self.repeat = False
        self.controller = "diarc"
        request_frames("NONE", 0)  # compiles what packs a frame, before a bus waits for one

    def request(
        self, request: str, *, joint: str = JOINTS[0], target_rad: float = 0.0, duration_s: float = 1.0
    ) -> None:
        """Send a request.

        Raises
        ------
        BusError
            When the bus is not there.
        """
        self._changing_since_s = None
        self._send(request, joint=joint, target_rad=target_rad, duration_s=duration_s)

    def _send(self, request: str, *, joint: str = JOINTS[0], target_rad: float = 0.0, duration_s: float = 1.0) -> None:
        frames = request_frames(
            request, self._counter, joint=joint, controller=self.controller,
            target_rad=target_rad, duration_s=duration_s,
        )  # fmt: skip
        self._counter = (self._counter + 2) % E2E_STATES
        for frame in frames:
            self._listener.send(*frame)

    def choose(self, controller: str, state: Snapshot) -> None:
        """Take another controller: at once for the next RUN; an ECU that drives is stopped and started for it."""
        self.controller = controller
        if state.mode in (*DRIVING, "HOLD"):
            self._send("SAFE_STOP")
            self._changing_since_s = time.monotonic()

    def _arrived(self, n: int, state: Snapshot) -> bool:
        """Whether a joint's reference is where it was sent; on a computer that is slow, that takes longer."""
        last, reference = self._last[n], state.joints[JOINTS[n]].reference_rad
        return last is None or (reference is not None and abs(reference - last) < _ARRIVED_RAD)

    def step(self, state: Snapshot) -> None:
        """Do what is due."""
        now_s = time.monotonic()
        if self._changing_since_s is not None:
            if state.mode in _RESTING:
                self._changing_since_s = None
                if state.mode == "STANDBY":
                    self._send("RUN")
            elif now_s - self._changing_since_s > _CONTROLLER_LIMIT_S:
                self._changing_since_s = None
        if not self.repeat or state.mode not in DRIVING:
            self._next = None
            return
        if self._next is None:
            self._next = [(now_s + _SHORTEST_REST_S, 0)] * len(JOINTS)
            self._last = [None] * len(JOINTS)
        if state.moving is not False:
            return  # under way, or not told: the ECU has just begun anew
        for n, (when_s, which) in enumerate(self._next):
            if now_s >= when_s and self._segments[n] and (self._arrived(n, state) or now_s > when_s + _ARRIVAL_S):
                segment = self._segments[n][which]
                self._send("MOVE", joint=JOINTS[n], target_rad=segment.target_rad, duration_s=segment.duration_s)
                self._last[n] = segment.target_rad
                pause_s = segment.duration_s + max(segment.dwell_s, _SHORTEST_REST_S)
                self._next[n] = (now_s + pause_s, (which + 1) % len(self._segments[n]))
