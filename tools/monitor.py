"""Watch an ECU and its machine on a bus: mode, faults in words, load estimate, errors, pressures, valves, counters.

Joins what is running already, only listens, and survives when bus, ECU or plant go and come back. In a terminal it
is a page that refreshes itself; into a pipe or file it writes one line a second. Ctrl-C ends it with status 0.

Examples
--------
  python tools/monitor.py vcan0
  python tools/monitor.py tcp:127.0.0.1:29536
  python tools/monitor.py slcan:/dev/ttyACM0
  python tools/monitor.py vcan0 --once                 one page of text, then end; status 1 when nothing is heard
  python tools/monitor.py vcan0 --once --json | jq .load.kg
  python tools/monitor.py vcan0 --json >> watch.jsonl  one object a second
"""

from __future__ import annotations

import argparse
import json
import signal
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[0] = str(ROOT)

from sil_plant.environment import CommandLine, enter, reader_has_gone, say, show  # noqa: E402

enter(__file__)

from rich.console import Console, RenderableType  # noqa: E402
from rich.live import Live  # noqa: E402

from sil_plant.bus.ports import BusAddress, BusError  # noqa: E402
from sil_plant.config import ConfigError  # noqa: E402
from sil_plant.monitoring.listen import Listener, joinable  # noqa: E402
from sil_plant.monitoring.view import TRACE_POINTS, Place, one_line, page  # noqa: E402
from sil_plant.monitoring.watch import Snapshot, Watch  # noqa: E402
from tools.signals import take_for_interrupt  # noqa: E402

EXIT_NOTHING_HEARD, EXIT_WRONG_USE = 1, 2
REFRESH_S = 0.25
LINE_S = 1.0
ONCE_S = 1.2  # longer than the window of the rates, and than every cycle on the bus


def parse_arguments(argv: list[str]) -> argparse.Namespace:
    """Read the command line; a wrong one ends the program with status 2."""
    parser = CommandLine(prog="monitor.py", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "bus", nargs="?", default="vcan0", metavar="BUS", help="vcan0 (default), can0, tcp:HOST:PORT, slcan:DEVICE"
    )
    parser.add_argument("--once", action="store_true", help=f"listen for {ONCE_S:g} s, print, and end")
    parser.add_argument("--json", action="store_true", help="JSON instead of text")
    return parser.parse_args(argv)


class Monitor:
    """The watch, its bus, and what is shown of them."""

    def __init__(self, address: BusAddress) -> None:
        self.watch = Watch(time.monotonic())
        self.listener = Listener(address, self.watch)
        self.bus = str(address)

    def listen(self, duration_s: float) -> None:
        """Take frames for a while."""
        self.listener.listen(time.monotonic() + duration_s)

    def place(self) -> Place:
        """Where and when we are."""
        return Place(self.bus, self.listener.problem, time.time())

    def as_json(self, state: Snapshot) -> str:
        """One snapshot as one line of JSON."""
        facts = {"time_s": round(time.time(), 3), "bus": self.bus, "problem": self.listener.problem or None}
        return json.dumps(facts | state.as_dict())

    def rendered(self, console: Console, *, with_trace: bool = True) -> RenderableType:
        """The page of now."""
        now_s = time.monotonic()
        plain = not console.encoding.lower().startswith("utf")
        trace = self.watch.load_trace(now_s, TRACE_POINTS) if with_trace else []
        return page(self.watch.snapshot(now_s), trace, self.place(), console.width, plain_signs=plain)


def once(monitor: Monitor, as_json: bool) -> int:
    """Print one snapshot; the exit status."""
    try:
        monitor.listener.open()
    except BusError as error:
        say(f"monitor.py: {error}")
        return EXIT_NOTHING_HEARD
    monitor.listen(ONCE_S)
    state = monitor.watch.snapshot(time.monotonic())
    if as_json:
        show(monitor.as_json(state))
    else:
        Console().print(monitor.rendered(Console(), with_trace=False))
    if state.silent:
        say(f"monitor.py: {monitor.listener.problem or f'no frames on {monitor.bus} within {ONCE_S:g} s'}")
        return EXIT_NOTHING_HEARD
    return 0


def follow_in_terminal(monitor: Monitor, console: Console) -> None:
    """Refresh the page until Ctrl-C."""
    with Live(monitor.rendered(console), console=console, screen=True, auto_refresh=False) as live:
        while True:
            monitor.listen(REFRESH_S)
            live.update(monitor.rendered(console), refresh=True)


def follow_in_lines(monitor: Monitor, as_json: bool) -> None:
    """Write one line a second until Ctrl-C, or until nobody reads them."""
    while True:
        monitor.listen(LINE_S)
        state = monitor.watch.snapshot(time.monotonic())
        print(monitor.as_json(state) if as_json else one_line(state, monitor.place()), flush=True)


def main(argv: list[str]) -> int:
    """Run the command line; the exit status."""
    arguments = parse_arguments(argv)
    take_for_interrupt(signal.SIGTERM)
    console = Console()
    try:
        address = joinable(arguments.bus)
        monitor = Monitor(address)
        try:
            if arguments.once:
                return once(monitor, arguments.json)
            if console.is_terminal and not arguments.json:
                follow_in_terminal(monitor, console)
            else:
                follow_in_lines(monitor, arguments.json)
        finally:
            monitor.listener.close()
    except (BusError, ConfigError) as error:
        say(f"monitor.py: {error}")
        return EXIT_WRONG_USE
    except BrokenPipeError:
        reader_has_gone()
        return 0
    except KeyboardInterrupt:
        pass
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
