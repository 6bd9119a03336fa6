"""Record what a bus carries: to .blf, .asc, .log (candump), .mf4 or .csv, by the file's name.

It listens on every bus that the project knows, also where ECU and plant are running already. Ctrl-C ends it in
order; a recorder that was killed has lost nothing that it heard. For tools/replay.py, start it before the ECU.

Examples
--------
  python tools/record.py vcan0 run.blf
  python tools/record.py tcp:127.0.0.1:29536 run.mf4 --duration 60
  python tools/record.py tcp:127.0.0.1:29536 run.log --wait 60     started before the bus: nothing is missed
  python tools/record.py --recover run.blf                         after the recorder was killed

Exit status: 0 all that was asked for is recorded, 1 the bus or the disk failed, frames were lost or none came (what
came is kept), 2 something has to be put right first.
"""

from __future__ import annotations

import argparse
import signal
import sys
import time
from pathlib import Path
from types import FrameType

ROOT = Path(__file__).resolve().parents[1]
sys.path[0] = str(ROOT)

from sil_plant.environment import CommandLine, enter, say  # noqa: E402

enter(__file__, mf4=True)

from rich.console import Console  # noqa: E402
from rich.progress import Progress, SpinnerColumn, TextColumn  # noqa: E402

from sil_plant.bus.ports import BusError, PythonCanPort, connect_python_can, parse_bus  # noqa: E402
from sil_plant.config import ConfigError  # noqa: E402
from sil_plant.recordings.recorder import Recorder, convert_spool  # noqa: E402

EXIT_FAILED, EXIT_WRONG_USE, EXIT_INTERRUPTED = 1, 2, 130
WAIT_S = 0.2  # the longest look at the bus: Ctrl-C takes effect after it
BATCH = 1000  # messages until time and signals are looked at, on a bus that is never quiet
RETRY_S = 0.02  # while waiting for the bus: it must not be in use for long before the first frame is heard
SHOW_S = 0.5  # between two progress lines


class Stop:
    """Set by Ctrl-C, SIGTERM and the end of the terminal; an exception could tear a frame in two."""

    def __init__(self) -> None:
        self.is_set = False
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, self._set)

    def _set(self, number: int, frame: FrameType | None) -> None:
        self.is_set = True

    def release(self) -> None:
        """Give the signals back: from here on Ctrl-C breaks off."""
        signal.signal(signal.SIGINT, signal.default_int_handler)
        signal.signal(signal.SIGTERM, signal.default_int_handler)


def parse_arguments(argv: list[str]) -> argparse.Namespace:
    """Read the command line; a wrong one ends the program with status 2."""
    parser = CommandLine(prog="record.py", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bus", nargs="?", metavar="BUS", help="vcan0, can0, tcp:HOST:PORT, slcan:DEVICE")
    parser.add_argument("file", type=Path, metavar="FILE", help="ends in .blf, .asc, .log, .mf4 or .csv")
    parser.add_argument("--duration", type=float, metavar="S", help="stop after so long; default: at Ctrl-C")
    parser.add_argument("--wait", type=float, default=0.0, metavar="S", help="for the bus to come; default: not at all")
    parser.add_argument("--force", action="store_true", help="replace FILE")
    parser.add_argument("--recover", action="store_true", help="make FILE from what a killed recorder has kept")
    parser.add_argument("--quiet", action="store_true", help="no progress line; errors and losses are still said")
    arguments = parser.parse_args(argv)
    if arguments.recover == (arguments.bus is not None):
        parser.error("--recover goes without BUS" if arguments.recover else "BUS and FILE are needed")
    if arguments.duration is not None and not arguments.duration > 0.0:
        parser.error(f"--duration {arguments.duration:g}: more than 0 s is needed")
    return arguments


def connect(bus: str, wait_s: float) -> PythonCanPort:
    """Open the bus, if need be when it comes.

    Raises
    ------
    BusError
        When it does not come; one line with the next step.
    """
    address = parse_bus(bus)
    end = time.monotonic() + wait_s
    while True:
        try:
            return PythonCanPort(connect_python_can(address), bus)
        except BusError:
            if address.kind == "inproc" or time.monotonic() >= end:
                raise
        time.sleep(RETRY_S)


class Progressing:
    """One line that says how it goes."""

    def __init__(self, quiet: bool) -> None:
        console = Console(stderr=True)
        self.bar = Progress(
            SpinnerColumn("line"), TextColumn("{task.description}"), console=console, transient=True,
            disable=quiet or not console.is_terminal, auto_refresh=False,
        )  # fmt: skip
        self.task = self.bar.add_task("recording")
        self.last = (time.monotonic(), 0)

    def show(self, elapsed_s: float, recorder: Recorder, drops: int) -> None:
        """Refresh the line, now and then."""
        now = time.monotonic()
        before, frames = self.last
        if now - before < SHOW_S:
            return
        rate = (recorder.frames - frames) / (now - before)
        self.last = (now, recorder.frames)
        text = f"recording {elapsed_s:.0f} s: {recorder.frames} frames, {rate:.0f}/s, {drops} lost; Ctrl-C ends it"
        self.bar.update(self.task, description=text)
        self.bar.refresh()


def record(port: PythonCanPort, recorder: Recorder, duration_s: float | None, stop: Stop, quiet: bool) -> None:
    """Record until the time is over or somebody stops it.

    Raises
    ------
    BusError
        When the bus goes away.
    ConfigError
        When the file cannot be written any more.
    """
    start = time.monotonic()
    progressing = Progressing(quiet)
    with progressing.bar:
        while not stop.is_set:
            elapsed = time.monotonic() - start
            if duration_s is not None and elapsed >= duration_s:
                break
            left = WAIT_S if duration_s is None else min(WAIT_S, duration_s - elapsed)
            message = port.receive_message(left)
            for _ in range(BATCH):
                if message is None:
                    break
                recorder.add(message)
                message = port.receive_message(0.0)
            if message is not None:
                recorder.add(message)
            # mostly nothing waits now: what has come is safe from a kill before the next look
            recorder.flush()
            progressing.show(elapsed, recorder, port.receive_drops)


def main(argv: list[str]) -> int:
    """Run the command line; the exit status."""
    arguments = parse_arguments(argv)
    try:
        if arguments.recover:
            count = convert_spool(arguments.file, arguments.force)
            say(f"record.py: {arguments.file}: {count} frames recovered")
            return 0
        port = connect(arguments.bus, arguments.wait)
    except (ConfigError, BusError) as error:
        say(f"record.py: {error}")
        return EXIT_WRONG_USE
    except KeyboardInterrupt:
        return EXIT_INTERRUPTED
    with port:
        return run(arguments, port)


def run(arguments: argparse.Namespace, port: PythonCanPort) -> int:
    """Record from a bus that is open; the exit status."""
    stop = Stop()
    try:
        recorder = Recorder(arguments.file, arguments.force)
    except ConfigError as error:
        say(f"record.py: {error}")
        return EXIT_WRONG_USE
    if not arguments.quiet:
        say(f"record.py: recording {arguments.bus} to {arguments.file}; Ctrl-C ends it")
    status = 0
    start = time.monotonic()
    try:
        try:
            record(port, recorder, arguments.duration, stop, arguments.quiet)
        except BusError as error:
            # a hub lives as long as the run that hosts it
            ends_with_hub = parse_bus(arguments.bus).kind == "tcp" and arguments.duration is None
            end = "with it ends the recording" if ends_with_hub else "what came before is kept"
            say(f"record.py: {error}; {end}")
            status = 0 if ends_with_hub else EXIT_FAILED
        elapsed_s = time.monotonic() - start
        drops = port.receive_drops
        stop.release()
        if not recorder.is_direct and not arguments.quiet:
            say(f"record.py: writing {arguments.file} ...")
        recorder.close()
    except ConfigError as error:
        say(f"record.py: {error}")
        return EXIT_FAILED
    except KeyboardInterrupt:
        say(f"record.py: broken off; the frames are in {recorder.target}: python tools/record.py --recover "
            f"{arguments.file}")  # fmt: skip
        return EXIT_INTERRUPTED
    if not arguments.quiet:
        say(f"record.py: {arguments.file}: {recorder.frames} frames in {elapsed_s:.1f} s, {drops} lost")
    if drops:
        say(
            f"record.py: {drops} frames came faster than this computer read them and are lost; less load on it, or a "
            "larger buffer: sudo sysctl net.core.rmem_max=4194304"
        )
        status = EXIT_FAILED
    if not recorder.frames:
        say(f"record.py: nothing was heard on {arguments.bus}: is an ECU running there, at the right bit rate?")
        status = EXIT_FAILED
    elif not recorder.has_start and not arguments.quiet:
        say("record.py: note: no start of the ECU is in it, which tools/replay.py needs; tools/report.py does not")
    return status


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
