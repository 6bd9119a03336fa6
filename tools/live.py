"""Watch an arm in a browser, and act on it: the machine in 3-D, its load as the ECU estimates it, traces, controls.

Without BUS it starts a simulated arm and an ECU of its own on this computer and lets them move. With BUS it joins what
runs there, listens, and asks the ECU only for what somebody clicks. Load and faults are changed in a simulated plant
that offers it (run.py --control); only that one can tell the truth. Ctrl-C ends it, and what it has started.

Examples
--------
  python tools/live.py
  python tools/live.py --load 5 --port 8090 --no-open
  python tools/live.py vcan0
  python sil_plant/run.py --bus tcp:127.0.0.1:29536 --ecu spawn --control --duration 600 &
  python tools/live.py tcp:127.0.0.1:29536
  python tools/live.py --screenshot docs/img/live.png    the picture in README; needs Chromium and PyPI playwright
"""

from __future__ import annotations

import argparse
import contextlib
import io
import signal
import socket
import sys
import time
import webbrowser
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

ROOT = Path(__file__).resolve().parents[1]
sys.path[0] = str(ROOT)

from sil_plant.environment import CommandLine, enter, say, show  # noqa: E402

enter(__file__)

from sil_plant.bus import hub  # noqa: E402
from sil_plant.bus.ports import BusError  # noqa: E402
from sil_plant.config import ConfigError  # noqa: E402
from sil_plant.inputs.machine import REFERENCE_ARM, load_machine  # noqa: E402
from sil_plant.inputs.scenario import DEFAULT_SCENARIO, check_scenario, load_scenario  # noqa: E402
from sil_plant.live.plant import OwnPlant, PlantLink, free_port, machine_of  # noqa: E402
from sil_plant.loop.control_channel import DEFAULT_CONTROL_PORT, HOST  # noqa: E402
from sil_plant.monitoring.diagnosis import REFUSALS  # noqa: E402
from sil_plant.monitoring.listen import Listener, joinable  # noqa: E402
from sil_plant.monitoring.master import Master  # noqa: E402
from sil_plant.monitoring.view import Place  # noqa: E402
from sil_plant.monitoring.watch import Snapshot, Watch  # noqa: E402
from tools.signals import take_for_interrupt  # noqa: E402

if TYPE_CHECKING:
    from sil_plant.live.page import Page, Wish
    from sil_plant.live.picture import Picture

EXIT_FAILED, EXIT_WRONG_USE = 1, 2
DEFAULT_PORT = 8080
RESTART_S = 2.0
GREETING_S = 1.0
PICTURE_LOAD_KG = 5.0


def parse_arguments(argv: list[str]) -> argparse.Namespace:
    """Read the command line; a wrong one ends the program with status 2."""
    parser = CommandLine(prog="live.py", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "bus", nargs="?", metavar="BUS",
        help="vcan0, can0, tcp:HOST:PORT, slcan:DEVICE; without: an arm and an ECU of one's own",
    )  # fmt: skip
    parser.add_argument("--port", type=int, default=DEFAULT_PORT, help=f"of the page; default {DEFAULT_PORT}")
    parser.add_argument("--no-open", action="store_true", help="do not open a browser")
    parser.add_argument(
        "--control", type=int, default=DEFAULT_CONTROL_PORT, metavar="PORT",
        help=f"where the plant on BUS takes commands; default {DEFAULT_CONTROL_PORT}",
    )  # fmt: skip
    parser.add_argument("--arm", type=Path, default=REFERENCE_ARM, metavar="FILE", help="machine file")
    parser.add_argument("--scenario", type=Path, default=DEFAULT_SCENARIO, metavar="FILE", help="whose moves to repeat")
    parser.add_argument(
        "--load", type=float, metavar="KG", help="to begin with, of one's own arm; default: the scenario's, 3"
    )
    parser.add_argument(
        "--screenshot", type=Path, metavar="FILE", help="write a picture (.png) of the page, 1200 pixels wide, and end"
    )
    arguments = parser.parse_args(argv)
    if not 1 <= arguments.port <= 65535:
        parser.error(f"--port {arguments.port}: a port is 1 to 65535")
    if not 0 <= arguments.control <= 65535:
        parser.error(f"--control {arguments.control}: a port is 0 to 65535")
    if arguments.bus is not None and arguments.load is not None:
        parser.error("--load is of an arm of one's own; that of a plant on a bus is changed on the page")
    if arguments.screenshot and arguments.screenshot.suffix.lower() != ".png":
        parser.error(f"--screenshot {arguments.screenshot}: the name of a .png file is needed")
    return arguments


class Live:
    """The bus, the plant, and the page that shows them; one loop does all.

    Parameters
    ----------
    arguments : argparse.Namespace
        The command line's.
    stack : contextlib.ExitStack
        Ends what was started.
    """

    def __init__(self, arguments: argparse.Namespace, stack: contextlib.ExitStack) -> None:
        from sil_plant.plant.geometry import geometry

        machine = load_machine(arguments.arm)
        scenario = load_scenario(arguments.scenario)
        check_scenario(scenario, machine)
        check_port(arguments.port)
        self.own: OwnPlant | None = None
        self._ended_s: float | None = None
        if arguments.bus is None:
            bus = f"tcp:{HOST}:{free_port(hub.DEFAULT_PORT)}"
            control = free_port(DEFAULT_CONTROL_PORT)
            load_kg = scenario.load[0].load_kg if arguments.load is None else arguments.load
            options = ["--arm", str(arguments.arm), "--load", f"{load_kg:g}"]
            self.own = OwnPlant(bus, control, options)
            stack.callback(self.own.stop)
        else:
            bus, control = arguments.bus, arguments.control
        address = joinable(bus)
        self.watch = Watch(time.monotonic())
        self.listener = Listener(address, self.watch)
        stack.callback(self.listener.close)
        self.link = PlantLink(control, str(address))
        stack.callback(self.link.close)
        self.master = Master(self.listener, scenario.segments)
        self.master.repeat = arguments.bus is None
        self.bus = str(address)
        if self.own is None:
            # the plant there knows best which arm it is
            end_s = time.monotonic() + GREETING_S
            while self.link.hello is None and time.monotonic() < end_s:
                self.link.step()
                time.sleep(0.02)
            machine = load_machine(machine_of(self.link.hello, arguments.arm))
        self.page = start_page(arguments.port, geometry(machine), self.master.repeat, stack)
        self._refused: float | None = None

    def run(self, until: Callable[[], bool]) -> None:
        """Listen, show, and do what is asked for, until it is time to end."""
        from sil_plant.live.page import FRAME_S, View

        next_s = time.monotonic()
        while not until():
            next_s = max(next_s + FRAME_S, time.monotonic())
            self.listener.listen(next_s)
            self.link.step()
            now_s = time.monotonic()
            state = self.watch.snapshot(now_s)
            place = Place(self.bus, self.listener.problem, time.time())
            self.page.show(View(state, place, self.link.truth(), self.link, self._look_after()), now_s)
            try:
                while not self.page.wishes.empty():
                    self._grant(self.page.wishes.get(), state)
                self.master.step(state)
            except BusError as error:
                self.watch.note(now_s, f"not sent: {error}")
            while self.link.said:
                self.watch.note(now_s, self.link.said.popleft())
            self._note_refusal(state, now_s)

    def _grant(self, wish: Wish, state: Snapshot) -> None:
        if wish.what == "request":
            self.master.request(wish.values["request"])
        elif wish.what == "move":
            self.master.request("MOVE", **wish.values)
        elif wish.what == "controller":
            self.master.choose(wish.values["controller"], state)
        elif wish.what == "repeat":
            self.master.repeat = wish.values["on"]
        elif wish.what in ("load", "fault"):
            if wish.what == "load":
                self.page.controls.load_touched(time.monotonic())
            self.link.ask({"do": wish.what, **wish.values})
        elif wish.what == "kind":
            self.page.controls.kind_chosen()
        elif wish.what == "victim":
            self.page.controls.victim_chosen()

    def _note_refusal(self, state: Snapshot, now_s: float) -> None:
        count = state.timing.get("RefusedRequests")
        if not isinstance(count, int | float):
            self._refused = None
            return
        if self._refused is not None and count > self._refused:
            reason = str(state.timing.get("LastRefusal", "?"))
            self.watch.note(now_s, f"refused, {reason}: {REFUSALS.get(reason, 'see can_protocol/diarc.dbc')}")
        self._refused = count

    def _look_after(self) -> str:
        """Start a plant of our own again when it has ended; what to say of it."""
        if self.own is None:
            return ""
        if not self.own.ended:
            self._ended_s = None
            waiting = self.watch.frames == 0 and self.own.said()
            return self.own.said() if waiting else ""
        now_s = time.monotonic()
        said = self.own.said() or "without a word"
        if self._ended_s is None:
            self._ended_s = now_s
            self.watch.note(now_s, f"the plant has ended: {said}")
        elif now_s - self._ended_s > RESTART_S:
            self.own.start()
        return f"the plant has ended and is started again: {said}"


def check_port(port: int) -> None:
    """Make sure that the page can have its port: viser would take another one.

    Raises
    ------
    ConfigError
        Saying what to type instead.
    """
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((HOST, port))
            probe.listen()
        except OSError as error:
            raise ConfigError(
                f"port {port} cannot be had on {HOST}: {error.strerror}; take another one: --port {port % 65535 + 1}"
            ) from error


def start_page(port: int, shape: object, repeat: bool, stack: contextlib.ExitStack) -> Page:
    """Open the page's server on the loopback interface."""
    import viser

    from sil_plant.live.page import Page

    with contextlib.redirect_stdout(io.StringIO()):  # its banner
        server = viser.ViserServer(host=HOST, port=port, verbose=False)
    stack.callback(server.stop)
    # the page can ask for a tunnel that shows it to the world: there is none from here
    server.request_share_url = lambda *_, **__: None  # type: ignore[method-assign]
    return Page(server, shape, repeat)  # type: ignore[arg-type]


def main(argv: list[str]) -> int:
    """Run the command line; the exit status."""
    arguments = parse_arguments(argv)
    needed = ["viser", *(["playwright"] if arguments.screenshot else [])]
    missing = [name for name in needed if find_spec(name) is None]
    if missing:
        say(f"live.py: PyPI {missing[0]} is missing here: make setup, or pip install '.[live]'")
        return EXIT_WRONG_USE
    take_for_interrupt(signal.SIGTERM, signal.SIGHUP)
    picture: Picture | None = None
    try:
        with contextlib.ExitStack() as stack:
            live = Live(arguments, stack)
            url = f"http://{HOST}:{arguments.port}"
            if arguments.screenshot:
                from sil_plant.live.page import Wish
                from sil_plant.live.picture import Picture

                other_load = Wish("load", {"kg": PICTURE_LOAD_KG})
                picture = Picture(url, arguments.screenshot, lambda: live.page.wishes.put(other_load))
                stack.callback(picture.stop)
                live.run(picture.done)
            else:
                show(f"live.py: {live.bus} at {url}   Ctrl-C ends it")
                if not arguments.no_open:
                    webbrowser.open(url)
                live.run(lambda: False)
    except (BusError, ConfigError) as error:
        say(f"live.py: {error}")
        return EXIT_WRONG_USE
    except KeyboardInterrupt:
        pass
    if picture is not None:
        if picture.problem:
            say(f"live.py: no picture: {picture.problem}")
            return EXIT_FAILED
        show(f"written: {arguments.screenshot}")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
