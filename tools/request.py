"""Ask an ECU on a bus for a mode or a move, as its master, and say what it answers.

START, STOP and RESET are network management (to all nodes); the others are requests on MOTION (docs/modes.md). Exit
status: 0 done, 1 refused or no answer, 2 wrong use.

Examples
--------
  python tools/request.py vcan0 START
  python tools/request.py vcan0 RUN
  python tools/request.py vcan0 MOVE --joint swing --target 0.3 --duration 2
  python tools/request.py tcp:127.0.0.1:29536 SAFE_STOP
  python tools/request.py vcan0 RESET_FAULT
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[0] = str(ROOT)

from sil_plant.environment import CommandLine, enter, say, show  # noqa: E402

enter(__file__)

from sil_plant.bus.ports import BusError  # noqa: E402
from sil_plant.config import ConfigError  # noqa: E402
from sil_plant.loop import session  # noqa: E402
from sil_plant.monitoring.diagnosis import REFUSALS  # noqa: E402
from sil_plant.monitoring.listen import Listener, joinable  # noqa: E402
from sil_plant.monitoring.master import NETWORK, request_frames  # noqa: E402
from sil_plant.monitoring.watch import JOINTS, Snapshot, Watch  # noqa: E402

EXIT_REFUSED, EXIT_WRONG_USE, EXIT_INTERRUPTED = 1, 2, 130
LOOK_S = 0.4  # every page of TIMING comes within it
ANSWER_S = 2.0
STEP_S = 0.1
PAGES_TWICE = 10  # frames of TIMING: then a refusal has been told
# The modes that show that a request was carried out.
MODES = {
    "STANDBY": ("STANDBY",),
    "RUN": ("RUN",),
    "MOVE": ("RUN", "COMMISSION"),
    "RESET_FAULT": ("INIT", "STANDBY"),
    "TARE": ("TARE", "STANDBY"),
    "HOLD": ("HOLD",),
    "COMMISSION": ("COMMISSION",),
    "SAFE_STOP": ("SAFE_STOP", "STANDBY"),
}


def parse_arguments(argv: list[str]) -> argparse.Namespace:
    """Read the command line; a wrong one ends the program with status 2."""
    parser = CommandLine(prog="request.py", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bus", metavar="BUS", help="vcan0, can0, tcp:HOST:PORT, slcan:DEVICE")
    names = [*NETWORK, *MODES]
    parser.add_argument("request", type=str.upper, choices=names, metavar="REQUEST", help=", ".join(names))
    parser.add_argument("--joint", choices=JOINTS, help="of MOVE")
    parser.add_argument("--target", type=float, metavar="RAD", help="of MOVE")
    parser.add_argument("--duration", type=float, metavar="S", help="of MOVE; 0.001 to 65 s")
    parser.add_argument(
        "--controller", choices=session.CONTROLLERS, default="diarc", help="of RUN, HOLD, COMMISSION; default diarc"
    )
    arguments = parser.parse_args(argv)
    if arguments.request == "MOVE":
        if None in (arguments.joint, arguments.target, arguments.duration):
            parser.error("MOVE needs --joint, --target and --duration")
        if not abs(arguments.target) <= 3.14:
            parser.error(f"--target {arguments.target:g}: -3.14 to 3.14 rad is possible")
        if not 0.001 <= arguments.duration <= 65.0:
            parser.error(f"--duration {arguments.duration:g}: 0.001 to 65 s is possible")
    return arguments


def send(listener: Listener, arguments: argparse.Namespace) -> None:
    """Send the request."""
    frames = request_frames(
        arguments.request,
        13,
        joint=arguments.joint or "swing",
        controller=arguments.controller,
        target_rad=arguments.target or 0.0,
        duration_s=arguments.duration or 0.0,
    )
    for frame in frames:
        listener.send(*frame)


def done(state: Snapshot, request: str) -> bool:
    """Whether the bus shows that the request was carried out."""
    if request in NETWORK:
        return state.ecu.nmt == NETWORK[request][1]
    return state.mode in MODES[request] and (request != "MOVE" or state.moving is True)


def ask(listener: Listener, watch: Watch, arguments: argparse.Namespace) -> int:
    """Send the request and wait for what the ECU does; the exit status."""

    def look(duration_s: float) -> Snapshot:
        listener.listen(time.monotonic() + duration_s)
        if listener.problem:
            raise BusError(listener.problem)
        return watch.snapshot(time.monotonic())

    before = look(LOOK_S)
    request, bus = arguments.request, arguments.bus
    if not before.ecu.alive:
        say(f"request.py: no ECU is heard on {bus}; python tools/doctor.py {bus} says why")
        return EXIT_REFUSED
    if request not in NETWORK and before.mode is None:
        nmt = before.ecu.nmt or "not started"
        say(f"request.py: the ECU is {nmt}; first: python tools/request.py {bus} START")
        return EXIT_REFUSED
    refused = before.timing.get("RefusedRequests", 0)
    # a mode that was there before shows nothing but that no refusal comes
    wait_for = before.frames["TIMING"].count + PAGES_TWICE if done(before, request) else 0
    send(listener, arguments)
    end_s = time.monotonic() + ANSWER_S
    state = look(STEP_S)
    while time.monotonic() < end_s:
        if request not in NETWORK and state.timing.get("RefusedRequests", 0) != refused:
            reason = str(state.timing.get("LastRefusal", "?"))
            say(f"request.py: {request} refused, {reason}: {REFUSALS.get(reason, 'see can_protocol/diarc.dbc')}")
            return EXIT_REFUSED
        if done(state, request) and state.frames["TIMING"].count >= wait_for:
            show(f"{request} done: {f'mode {state.mode}' if state.mode else f'ECU {state.ecu.nmt}'}")
            return 0
        state = look(STEP_S)
    told = state.mode or state.ecu.nmt or "silent"
    say(f"request.py: {request}: the ECU is {told} after {ANSWER_S:g} s; python tools/doctor.py {bus} says why")
    return EXIT_REFUSED


def main(argv: list[str]) -> int:
    """Run the command line; the exit status."""
    arguments = parse_arguments(argv)
    try:
        address = joinable(arguments.bus)
        watch = Watch(time.monotonic())
        listener = Listener(address, watch)
        try:
            listener.open()
            return ask(listener, watch, arguments)
        finally:
            listener.close()
    except (BusError, ConfigError) as error:
        say(f"request.py: {error}")
        return EXIT_WRONG_USE
    except KeyboardInterrupt:
        say("request.py: interrupted")
        return EXIT_INTERRUPTED


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
