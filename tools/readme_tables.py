"""Rewrite the parts of README.md that follow from the DBC and from runs; they stand between markers.

The last `make bench` and `make campaign` are read, not run.

Examples
--------
  python tools/readme_tables.py            write (about 10 s; needs make firmware)
  python tools/readme_tables.py --check    compare, exit 1 when README.md is stale
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path[0] = str(ROOT)

from sil_plant.environment import enter, say  # noqa: E402

enter(__file__)

from sil_plant.bus.protocol import database, worst_case_bus_load  # noqa: E402
from sil_plant.config import ConfigError  # noqa: E402

README = ROOT / "README.md"
RUN = "sil_plant/run.py"
EXAMPLE = ["--load", "2.5", "--bus", "inproc"]
COMPARED = (
    ("DIARC", []),
    ("DIARC, load not compensated", ["--controller", "diarc-noload"]),
    ("PID", ["--controller", "pid"]),
    (
        "DIARC, plant with friction peaks, air in the oil, sensor errors, lost frames",
        ["--profile", "realistic"],
    ),
)
SENDERS = {"MASTER": "master", "ECU": "ECU", "IO": "I/O node"}


def frames_table() -> str:
    """One row per frame of the DBC, in order of id."""
    rows = ["| id | name | from | content | every |", "|---|---|---|---|---|"]
    for message in sorted(database().messages, key=lambda m: m.frame_id):
        senders = ", ".join(SENDERS.get(sender, sender) for sender in message.senders)
        content = re.split(r"\. |; ", message.comment or "")[0].replace("this file", "the DBC")
        cycle = f"{message.cycle_time} ms" if message.cycle_time else "event"
        rows.append(f"| 0x{message.frame_id:03X} | {message.name} | {senders} | {content} | {cycle} |")
    load = f"{100.0 * worst_case_bus_load():.0f} %"
    rows += ["", f"Together at most {load} of 1 Mbit/s, with worst-case bit stuffing."]
    return "\n".join(rows)


def run(arguments: list[str], *more: str) -> str:
    """What run.py prints.

    Raises
    ------
    ConfigError
        When it fails.
    """
    done = subprocess.run(
        [sys.executable, RUN, *arguments, *more], cwd=ROOT, stdout=subprocess.PIPE, text=True, check=False
    )
    if done.returncode != 0:
        raise ConfigError(f"{command(arguments)} ended with status {done.returncode}")
    return done.stdout


def command(arguments: list[str]) -> str:
    """The command as a reader types it."""
    return " ".join(["python", RUN, *arguments])


def example_run() -> str:
    """What the example prints, but for its last line, the time, which differs from computer to computer."""
    printed = run(EXAMPLE).rstrip().splitlines()
    return "\n".join(["```console", f"$ {command(EXAMPLE)}", *printed[:-1], "  ...", "```"])


def comparison_table() -> str:
    """The same motion and load under other controllers and on another plant."""
    rows = [
        "| | load error, kg | within 0.1 kg in, s | peak error after 1 s, mrad: swing / wrist | options |",
        "|---|---|---|---|---|",
    ]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "result.json"
        for name, options in COMPARED:
            run([*EXAMPLE, *options], "--quiet", "--json", str(path))
            result: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
            peaks = " / ".join(f"{1e3 * peak:.2f}" for peak in result["peak_err_after_1s_rad"])
            settle = result["load_settle_s"]
            rows.append(
                f"| {name} | {result['load_err_kg']:+.3f} | {'never' if settle is None else f'{settle:.2f}'} "
                f"| {peaks} | {f'`{chr(32).join(options)}`' if options else ''} |"
            )
    return "\n".join(rows)


def speed_table() -> str:
    """How fast the closed loop is, from the last `make bench`."""
    from tools.bench import readme_table

    path = ROOT / "build" / "bench.json"
    try:
        result = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise ConfigError("build/bench.json is not there yet: make bench") from error
    return readme_table(result)


def campaign_table() -> str:
    """How a thousand arms do, from the last `make campaign`."""
    arguments = [sys.executable, "tools/campaign.py", "sil_plant/campaigns/production.toml", "--table"]
    done = subprocess.run(arguments, cwd=ROOT, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise ConfigError(done.stderr.strip())
    return done.stdout.rstrip()


PARTS: dict[str, Callable[[], str]] = {
    "frames": frames_table,
    "example": example_run,
    "comparison": comparison_table,
}
# From results that take minutes or an idle computer: made anew when they are there, else left as they are.
MEASURED: dict[str, Callable[[], str]] = {"speed": speed_table, "campaign": campaign_table}


def rewrite(text: str, measured: bool = False) -> str:
    """The README with every part made anew.

    Parameters
    ----------
    text : str
        As it is.
    measured : bool
        Those of `MEASURED`, too, as far as there are results.

    Raises
    ------
    ConfigError
        When a marker is missing.
    """
    made = {name: make() for name, make in PARTS.items()}
    for name, make in MEASURED.items() if measured else ():
        try:
            made[name] = make()
        except ConfigError as error:
            say(f"readme_tables: the part {name} stays as it is: {error}")
    for name, part in made.items():
        start, end = f"<!-- {name}: made by tools/readme_tables.py -->", f"<!-- end of {name} -->"
        if text.count(start) != 1 or text.count(end) != 1 or text.index(end) < text.index(start):
            raise ConfigError(f"{README.name}: the markers `{start}` and `{end}` are needed once, in this order")
        before, rest = text.split(start)
        text = f"{before}{start}\n{part}\n{end}{rest.split(end)[1]}"
    return text


def main() -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="compare instead of writing")
    arguments = parser.parse_args()
    try:
        old = README.read_text(encoding="utf-8")
        new = rewrite(old, measured=not arguments.check)
        if new == old:
            return 0
        if arguments.check:
            say("README.md is stale; run `python tools/readme_tables.py` and commit the result")
            return 1
        README.write_text(new, encoding="utf-8")
        print(f"wrote: {README.name}")
    except (ConfigError, OSError) as error:
        say(f"readme_tables: {error}")
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
