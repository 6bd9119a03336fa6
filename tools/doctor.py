"""Say what is wrong when nothing moves: interface, bit rate, nodes, mode and faults, DBC, frames, permissions.

Listens for a moment, changes nothing, and lists what it found with the next command to type, in the order in which
to mend it: what comes first may explain the rest. Exit status: 0 nothing wrong (notes may be shown), 1 errors or
warnings, 2 wrong use.

Examples
--------
  python tools/doctor.py vcan0
  python tools/doctor.py tcp:127.0.0.1:29536
  python tools/doctor.py can0 --listen 10
  python tools/doctor.py vcan0 --json
"""

from __future__ import annotations

import argparse
import json
import signal
import sys
import time
from dataclasses import asdict
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[0] = str(ROOT)

from sil_plant.environment import CommandLine, enter, say, show  # noqa: E402

enter(__file__)

from rich.console import Console  # noqa: E402
from rich.text import Text  # noqa: E402

from sil_plant.bus.ports import BusError  # noqa: E402
from sil_plant.config import ConfigError  # noqa: E402
from sil_plant.monitoring.diagnosis import Evidence, Finding, diagnose, examine  # noqa: E402
from sil_plant.monitoring.listen import joinable  # noqa: E402
from sil_plant.monitoring.view import Place, one_line  # noqa: E402
from tools.signals import take_for_interrupt  # noqa: E402

EXIT_FINDINGS, EXIT_WRONG_USE, EXIT_INTERRUPTED = 1, 2, 130
LISTEN_S = 2.0
_STYLES = {"error": "bold red", "warning": "yellow", "note": "dim"}


def parse_arguments(argv: list[str]) -> argparse.Namespace:
    """Read the command line; a wrong one ends the program with status 2."""
    parser = CommandLine(prog="doctor.py", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "bus", nargs="?", default="vcan0", metavar="BUS", help="vcan0 (default), can0, tcp:HOST:PORT, slcan:DEVICE"
    )
    parser.add_argument(
        "--listen", type=float, default=LISTEN_S, metavar="S", help=f"for how long; default {LISTEN_S:g}"
    )
    parser.add_argument("--json", action="store_true", help="JSON instead of text")
    arguments = parser.parse_args(argv)
    if not 0.5 <= arguments.listen <= 600.0:
        parser.error(f"--listen {arguments.listen:g}: 0.5 to 600 s is possible")
    return arguments


def report(findings: list[Finding], evidence: Evidence) -> None:
    """Print the findings for people."""
    console = Console(highlight=False, soft_wrap=True)
    for finding in findings:
        console.print(Text(f"{finding.severity:8}", style=_STYLES[finding.severity]), end="")
        console.print(Text(finding.text))
        console.print(Text(f"{'':8}next: {finding.next}"))
    errors, warnings = (sum(finding.severity == word for finding in findings) for word in ("error", "warning"))
    if evidence.state is not None and not evidence.state.silent:
        console.print(Text(one_line(evidence.state, Place(evidence.bus, evidence.problem, time.time()))))
    if errors or warnings:
        console.print(Text(f"{errors} errors, {warnings} warnings on {evidence.bus}; begin with the first"))
    else:
        console.print(Text(f"nothing wrong on {evidence.bus}"))


def main(argv: list[str]) -> int:
    """Run the command line; the exit status."""
    arguments = parse_arguments(argv)
    take_for_interrupt(signal.SIGTERM)
    try:
        address = joinable(arguments.bus)
        if not arguments.json:
            say(f"doctor.py: listening on {address} for {arguments.listen:g} s ...")
        evidence = examine(address, arguments.listen)
        findings = diagnose(evidence)
    except (BusError, ConfigError) as error:
        say(f"doctor.py: {error}")
        return EXIT_WRONG_USE
    except KeyboardInterrupt:
        say("doctor.py: interrupted")
        return EXIT_INTERRUPTED
    if arguments.json:
        state = None if evidence.state is None else evidence.state.as_dict()
        facts = {"bus": evidence.bus, "findings": [asdict(finding) for finding in findings], "state": state}
        show(json.dumps(facts, indent=1))
    else:
        report(findings, evidence)
    return EXIT_FINDINGS if any(finding.severity != "note" for finding in findings) else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
