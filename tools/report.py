"""Make a page of a recording: what happened, and all traces to zoom into, in one HTML file that needs no network.

Examples
--------
  python tools/report.py run.blf                    writes run.html
  python tools/report.py field.mf4 -o out/field.html
  python tools/report.py long.log --from 120 --to 150    a part, in full detail

Exit status: 0 written, 1 written, but of a damaged recording as far as it can be read, 2 nothing written.
"""

from __future__ import annotations

import argparse
import sys
from contextlib import nullcontext
from importlib.util import find_spec
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[0] = str(ROOT)

from sil_plant.environment import CommandLine, enter, say, show  # noqa: E402

enter(__file__, mf4=True)

from rich.console import Console  # noqa: E402

from sil_plant.config import ConfigError  # noqa: E402
from sil_plant.loop.results import check_writable  # noqa: E402
from sil_plant.recordings.recording import read_recording  # noqa: E402
from sil_plant.reports.recording_report import POINTS_MOST, contents_of, page, part_of  # noqa: E402

EXIT_DAMAGED, EXIT_WRONG_USE, EXIT_INTERRUPTED = 1, 2, 130


def parse_arguments(argv: list[str]) -> argparse.Namespace:
    """Read the command line; a wrong one ends the program with status 2."""
    parser = CommandLine(prog="report.py", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path, metavar="RECORDING", help=".blf, .asc, .log, .mf4 or .csv")
    parser.add_argument("-o", "--output", type=Path, metavar="FILE.html", help="default: beside the recording")
    parser.add_argument("--from", type=float, metavar="S", dest="from_s", help="leave out what is before")
    parser.add_argument("--to", type=float, metavar="S", dest="to_s", help="leave out what is after")
    return parser.parse_args(argv)


def main(argv: list[str]) -> int:
    """Run the command line; the exit status."""
    arguments = parse_arguments(argv)
    source = arguments.recording
    output = arguments.output or source.with_name(source.name.removesuffix(".gz")).with_suffix(".html")
    console = Console(stderr=True)
    try:
        check_writable(output)
        if find_spec("bokeh") is None:
            raise ConfigError("the traces need bokeh: .venv/bin/python -m pip install -r requirements.txt")
        with console.status("reading") if console.is_terminal else nullcontext():
            recording = part_of(read_recording(source), arguments.from_s, arguments.to_s)
            contents = contents_of(recording)
            notes = []
            if len(contents.ticks.row) > POINTS_MOST:
                notes.append(
                    "Long traces are thinned to their least and greatest values; for all of a part: "
                    f"python tools/report.py {source.name} --from S --to S"
                )
            text = page(contents, notes)
        output.write_text(text, encoding="utf-8")
    except ConfigError as error:
        say(f"report.py: {error}")
        return EXIT_WRONG_USE
    except OSError as error:
        say(f"report.py: {output}: cannot be written: {error.strerror}")
        return EXIT_WRONG_USE
    except KeyboardInterrupt:
        return EXIT_INTERRUPTED
    show(f"written: {output}")
    if recording.damage:
        say(
            f"report.py: {source} is damaged: {recording.damage}; the report has what could be read: "
            f"{len(recording.rows)} frames, {recording.duration_s:.3f} s"
        )
        return EXIT_DAMAGED
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
