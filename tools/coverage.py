"""Run the unit tests in a build of their own that counts lines, and report what of control/ and ecu/ they run.

The build is build/coverage (CMake preset coverage): number types double and fixed, the law and the ECU without
optimisation. A line counts as run when either type runs it. Exit 1 when a test fails or a line is not run.

Example: .venv/bin/python tools/coverage.py             table of the files, lines that are missing
         .venv/bin/python tools/coverage.py --branches  the same of branches, for reading: no limit
         .venv/bin/python tools/coverage.py --html out/coverage
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
BUILD = Path("build/coverage")
FOLDERS = ("firmware/control/", "firmware/ecu/")
LIMIT_S = 600.0


class CoverageError(Exception):
    """The coverage could not be found out."""


def run(command: Sequence[str], failure: str) -> None:
    """Run a command quietly; when it fails, its output and `failure`, which says what to do."""
    try:
        result = subprocess.run(
            command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, timeout=LIMIT_S
        )
    except subprocess.TimeoutExpired as error:
        raise CoverageError(f"{command[0]} took more than {LIMIT_S:.0f} s: {failure}") from error
    if result.returncode != 0:
        raise CoverageError(f"{result.stdout[-6000:]}\n{failure}")


def measure(jobs: int) -> None:
    """Build, forget the counts of the last time, run the unit tests."""
    for name, package in (("cmake", "cmake"), ("gcc", "gcc"), ("gcov", "gcc")):
        if shutil.which(name) is None:
            raise CoverageError(f"{name} is not installed: sudo apt-get install {package}")
    if importlib.util.find_spec("gcovr") is None:
        raise CoverageError("gcovr is not installed: make setup, then .venv/bin/python tools/coverage.py")
    run(["cmake", "--preset", "coverage"], "the coverage build cannot be configured: see above")
    run(["cmake", "--build", str(BUILD), "--parallel", str(jobs)], "the coverage build fails: see above")
    for counts in (ROOT / BUILD).rglob("*.gcda"):
        counts.unlink()
    run(
        ["ctest", "--test-dir", str(BUILD), "--output-on-failure", "--no-tests=error", "--parallel", str(jobs)],
        "a unit test fails: coverage says nothing before they all pass",
    )


def report(branches: bool, html: Path | None, least: float) -> int:
    """Print gcovr's table; its exit status, not 0 with less than `least` percent of the lines."""
    command = [sys.executable, "-m", "gcovr", "--root", ".", str(BUILD)]
    for folder in FOLDERS:
        command += ["--filter", folder]
    command += ["--print-summary", "--fail-under-line", f"{least:g}"]
    command += ["--txt-metric", "branch" if branches else "line", "--txt", "-"]
    if html is not None:
        html.mkdir(parents=True, exist_ok=True)
        command += ["--html-details", str(html / "index.html")]
    return subprocess.run(command, cwd=ROOT, timeout=LIMIT_S).returncode


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--branches", action="store_true", help="show branches instead of lines")
    parser.add_argument("--html", type=Path, metavar="FOLDER", help="also write the sources, coloured, to FOLDER")
    parser.add_argument("--least", type=float, default=100.0, metavar="PERCENT", help="lines that must be run (100)")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="compilers and tests at once")
    options = parser.parse_args(arguments)
    html = None if options.html is None else options.html.absolute()
    try:
        measure(options.jobs)
    except CoverageError as error:
        print(f"coverage: {error}", file=sys.stderr)
        return 1
    return 1 if report(options.branches, html, options.least) != 0 else 0


if __name__ == "__main__":
    sys.exit(main())
