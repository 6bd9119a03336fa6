"""Break things on purpose: run the fault matrix in this process, print it, and say whether the ECU did right.

Every kind of fault, in several sizes, at several moments, with both profiles; each twice, to see that it is the same
to the last bit. What is run and expected stands in sil_plant/fault_matrix.toml.

Example: python tools/faults.py --only stuck --json out/stuck.json
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[0] = str(ROOT)

from sil_plant.environment import CommandLine, enter, say, show  # noqa: E402

enter(__file__)

from sil_plant.config import ConfigError  # noqa: E402
from sil_plant.experiments.fault_matrix import Row, benchmark, cells, load_cases, measure, table, unknown_names  # noqa: E402
from sil_plant.inputs.faults import KINDS  # noqa: E402
from sil_plant.inputs.machine import REFERENCE_ARM, load_machine  # noqa: E402
from sil_plant.loop import execution  # noqa: E402
from sil_plant.loop.results import check_writable, fault_names  # noqa: E402

CHUNK = 8  # cells that a process takes at a time


def parse_arguments(argv: list[str]) -> argparse.Namespace:
    """Read the command line; a wrong one ends the program with status 2."""
    parser = CommandLine(prog="faults.py", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", choices=tuple(KINDS), metavar="KIND", help=f"one of {', '.join(KINDS)}")
    parser.add_argument("--json", type=Path, default=ROOT / "build" / "faults.json", metavar="FILE")
    parser.add_argument("--failed", action="store_true", help="print only the rows that failed")
    parser.add_argument("--jobs", type=int, default=min(2, os.cpu_count() or 1), metavar="N", help="processes")
    return parser.parse_args(argv)


def write(path: Path, rows: list[Row]) -> None:
    """Write the rows; ``pass`` is a word of Python's, so that key is put in here."""
    entries = [{("pass" if key == "passed" else key): value for key, value in asdict(row).items()} for row in rows]
    path.write_text(json.dumps({"rows": entries}, indent=1) + "\n", encoding="utf-8")


def main(argv: list[str]) -> int:
    """Run the command line; the exit status."""
    arguments = parse_arguments(argv)
    start = time.perf_counter()
    try:
        if arguments.jobs < 1:
            raise ConfigError(f"--jobs {arguments.jobs}: 1 or more is needed")
        arguments.json.parent.mkdir(exist_ok=True)
        check_writable(arguments.json)
        cases = load_cases()
        wanted = list(cells(cases, arguments.only))
        if not wanted:
            raise ConfigError(f"the table has no {arguments.only}; add a case to sil_plant/fault_matrix.toml")
        for faults in ((), (wanted[0].fault,)):
            execution.compile_plant(load_machine(REFERENCE_ARM), benchmark(faults))
        with ProcessPoolExecutor(arguments.jobs) as pool:
            rows = list(pool.map(measure, wanted, chunksize=CHUNK))
        write(arguments.json, rows)
    except (ConfigError, OSError) as error:
        say(f"faults.py: {error}")
        return 2
    except KeyboardInterrupt:
        return 130
    failed = [row for row in rows if not row.passed]
    shown = failed if arguments.failed else rows
    if shown:
        show(table(shown))
    for name in unknown_names(cases, fault_names()):
        say(f"faults.py: note: the table expects {name}, which this DBC does not name")
    show(f"{len(rows) - len(failed)} of {len(rows)} rows pass; {time.perf_counter() - start:.0f} s; {arguments.json}")
    return 1 if failed or not rows else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
