"""Watch the ECU move a simulated arm: one closed loop on the best CAN bus this computer has.

The bus is vcan0 where the kernel has it (or lets this user add it), else CAN over TCP on this computer, which
needs no driver. The ECU, firmware/diarc_ecu, is a process of its own at its default pace: the run takes 10 s.
Figures, trace and picture go to out/.

Examples
--------
  make demo
  python tools/demo.py --load 1
  python tools/demo.py --keep              until Ctrl-C, to watch the frames; writes no files
  python tools/demo.py --bus tcp:127.0.0.1:29536
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from types import FrameType
from typing import NoReturn

ROOT = Path(__file__).resolve().parents[1]
sys.path[0] = str(ROOT)

from sil_plant.environment import enter, say  # noqa: E402

enter(__file__)

from sil_plant.bus import protocol  # noqa: E402
from sil_plant.bus.hub import DEFAULT_PORT  # noqa: E402
from sil_plant.bus.ports import BusAddress, BusError, open_frame_port, parse_bus  # noqa: E402
from sil_plant.config import ConfigError  # noqa: E402
from sil_plant.monitoring.host import kernel_has_can  # noqa: E402
from sil_plant.reports import figures  # noqa: E402

OUT = ROOT / "out"
JSON, CSV, PNG = OUT / "demo.json", OUT / "demo.csv", OUT / "demo.png"
INTERFACE = "vcan0"
DEFAULT_LOAD_KG = 2.5
KEEP_S = 600.0  # how long one run with --keep lasts
LISTEN_S = 0.3  # three heartbeats of an ECU
STOP_S = 15.0
EXIT_WRONG_USE, EXIT_INTERRUPTED = 2, 130


class TerminatedError(Exception):
    """SIGTERM came."""


def main(argv: list[str]) -> int:
    """Run the command line; the exit status."""
    arguments = parse_arguments(argv)
    signal.signal(signal.SIGTERM, _terminate)
    try:
        return demonstrate(arguments)
    except (ConfigError, BusError) as error:
        say(f"demo: {error}")
        return EXIT_WRONG_USE
    except (KeyboardInterrupt, TerminatedError):
        say("demo: interrupted")
        return EXIT_INTERRUPTED


def parse_arguments(argv: list[str]) -> argparse.Namespace:
    """Read the command line; a wrong one ends the program with status 2."""
    parser = argparse.ArgumentParser(
        prog="demo.py", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--load", type=float, default=DEFAULT_LOAD_KG, metavar="KG", help="load at the tip; default 2.5"
    )
    parser.add_argument("--bus", metavar="BUS", help="vcan0, can0 or tcp:127.0.0.1:PORT; default: the best there is")
    parser.add_argument("--keep", action="store_true", help="until Ctrl-C")
    return parser.parse_args(argv)


def demonstrate(arguments: argparse.Namespace) -> int:
    """Find the bus, say how to watch it, and run; the exit status."""
    load = ["--load", f"{arguments.load:g}"]
    # In memory and short: whatever is wrong with load, build or environment shows, and all code is compiled,
    # before anybody watches a bus.
    status = run_py([*load, "--bus", "inproc", "--duration", "0.01", "--quiet"])
    if status != 0:
        return status
    bus = choose_bus(arguments.bus)
    loop = [*load, "--bus", bus, "--ecu", "spawn"]
    say(f"demo: python sil_plant/run.py {shlex.join(loop)}")
    longer = "" if arguments.keep else " (--keep gives you more time)"
    say(f"demo: to watch the load estimate from another terminal{longer}:")
    say(f"  cd {shlex.quote(str(ROOT))} && {watch_command(parse_bus(bus))}")
    if arguments.keep:
        say("demo: until Ctrl-C ...")
        while (status := run_py([*loop, "--duration", f"{KEEP_S:g}"])) == 0:
            say("demo: again")
        return 0 if status == EXIT_INTERRUPTED else status
    clear_out()
    status = run_py([*loop, "--json", str(JSON), "--csv", str(CSV)])
    if CSV.exists() and JSON.exists():  # a run that was broken off has them, too
        draw()
        print(f"written: {shown(PNG)}, {shown(JSON)}, {shown(CSV)}")
    if status not in (0, EXIT_INTERRUPTED):
        say(f"demo: failed, see above; another bus: python tools/demo.py --bus tcp:127.0.0.1:{DEFAULT_PORT}")
    return status


# ---- the bus -------------------------------------------------------------------------------------


def choose_bus(asked: str | None) -> str:
    """The bus asked for, or the best there is; says which.

    Raises
    ------
    BusError
        When the bus asked for cannot be used; one line with the next step.
    """
    if asked is not None:
        address = parse_bus(asked)
        if address.kind not in ("socketcan", "tcp"):
            raise BusError(
                f"--bus {asked}: the demo's ECU is on vcan0, can0 or tcp:127.0.0.1:{DEFAULT_PORT}; "
                f"without a bus: python sil_plant/run.py --load {DEFAULT_LOAD_KG:g} --bus inproc"
            )
        check_bus(address)
        return asked
    if kernel_has_can():
        try:
            raise_interface(INTERFACE)
            check_bus(parse_bus(INTERFACE))
        except BusError as error:
            say(f"demo: not on {INTERFACE}: {error}")
        else:
            say(f"demo: the bus is the kernel's {INTERFACE}")
            return INTERFACE
    bus = f"tcp:127.0.0.1:{free_port()}"
    say(f"demo: the bus is CAN over TCP on this computer, {bus}: no driver needed, no frame lost")
    return bus


def check_bus(address: BusAddress) -> None:
    """Open a bus for a moment, and listen for an ECU that leads it already.

    Raises
    ------
    BusError
        When it cannot be opened or another ECU is there.
    """
    led_by_another = False
    with open_frame_port(address, host_hub=True) as port:
        end = time.monotonic() + (LISTEN_S if address.kind == "socketcan" else 0.0)
        while not led_by_another and (left := end - time.monotonic()) > 0.0:
            frame = port.receive(left)
            led_by_another = frame is not None and frame[0] in (
                protocol.SYNC_ID,
                protocol.frame_id("HEARTBEAT_ECU"),
            )
    if led_by_another:
        raise BusError(f"another ECU is on {address}; stop it, or use another bus: --bus vcan1")


def raise_interface(name: str) -> None:
    """Add a virtual CAN interface and set it up where this user may, and say so; else leave all as it is."""
    flags = Path("/sys/class/net") / name / "flags"
    exists = flags.exists()
    if exists and int(flags.read_text(encoding="ascii"), 16) & 1:
        return
    root = [] if os.geteuid() == 0 else ["sudo", "-n"]
    path = f"{os.environ.get('PATH', '')}:/usr/sbin:/sbin"
    if shutil.which("ip", path=path) is None or (root and shutil.which("sudo") is None):
        return
    commands = [] if exists else [["ip", "link", "add", "dev", name, "type", "vcan"]]
    commands.append(["ip", "link", "set", name, "up"])
    for command in commands:
        done = subprocess.run(
            [*root, *command],
            stdin=subprocess.DEVNULL,
            capture_output=True,
            env=os.environ | {"PATH": path},
            check=False,
        )
        if done.returncode != 0:
            return
        say(f"demo: this system's network has been changed: {' '.join([*root, *command])}")
    if not exists:
        say(f"demo: {name} stays; to remove it: {' '.join([*root, 'ip', 'link', 'del', name])}")


def free_port() -> int:
    """Socketcand's own port where it is free, else any other; on loopback."""
    for port in (DEFAULT_PORT, 0):
        with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind(("127.0.0.1", port))
                probe.listen()  # two may be bound to a port, but only one listens
                return int(probe.getsockname()[1])
            except OSError:
                continue
    raise BusError("no TCP port is free on 127.0.0.1; is the loopback interface up (ip link show lo)?")


def watch_command(address: BusAddress) -> str:
    """The command that shows the decoded estimate frames of a bus."""
    estimate = f"--filter {protocol.frame_id('ESTIMATE'):X}:7FF"
    monitor = f".venv/bin/cantools monitor {protocol.DBC_PATH.relative_to(ROOT)}"
    if address.kind == "tcp":
        # python-can remarks on every frame that TCP has cut in two; on a terminal that covers the values
        return (
            f"{monitor} -i socketcand -c {address.channel} {estimate} "
            f"--bus-kwargs host={address.host} port={address.port} 2>/dev/null"
        )
    return f"{monitor} -i socketcan -c {address.channel} {estimate}"


# ---- the run -------------------------------------------------------------------------------------


def run_py(arguments: list[str]) -> int:
    """Run sil_plant/run.py to its end, also after Ctrl-C, so that it leaves in order; its exit status."""
    process = subprocess.Popen([sys.executable, str(ROOT / "sil_plant" / "run.py"), *arguments])
    try:
        try:
            return process.wait()
        except KeyboardInterrupt:  # the terminal has told both of us
            return process.wait(STOP_S)
        except TerminatedError:
            process.terminate()
            return process.wait(STOP_S)
    except subprocess.TimeoutExpired:
        say(f"demo: run.py did not stop within {STOP_S:g} s and is ended by force")
        return EXIT_INTERRUPTED
    finally:
        if process.poll() is None:
            process.kill()


def clear_out() -> None:
    """Make the folder for the files, and remove those of the last demo."""
    try:
        OUT.mkdir(exist_ok=True)
        for path in (JSON, CSV, PNG):
            path.unlink(missing_ok=True)
    except OSError as error:
        raise ConfigError(f"{error.filename}: {error.strerror}; may you write here?") from error


def draw() -> None:
    """Make the picture from the trace."""
    facts = json.loads(JSON.read_text(encoding="utf-8"))
    title = figures.run_title(
        facts["scenario"], facts["arm"], facts["load_true_kg"], facts["controller"], facts["seed"]
    )
    figures.save_png(figures.trace_figure(figures.read_trace(CSV), title), PNG)


def shown(path: Path) -> str:
    """A path as the user would type it here."""
    here = Path.cwd()
    return str(path.relative_to(here)) if path.is_relative_to(here) else str(path)


def _terminate(number: int, frame: FrameType | None) -> NoReturn:
    raise TerminatedError


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
