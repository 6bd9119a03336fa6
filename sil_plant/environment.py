"""Start-up of the project's scripts with nothing but the standard library: the right Python, the right path."""

from __future__ import annotations

import argparse
import os
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import NoReturn

ROOT = Path(__file__).resolve().parents[1]
NEEDED = ("numpy", "numba", "can", "cantools", "rich")


def enter(script: str, *, mf4: bool = False) -> None:
    """Continue in the project's environment, or say which command prepares it and exit with status 2.

    Parameters
    ----------
    script : str
        ``__file__`` of the script that was started.
    mf4 : bool
        The script reads or writes .mf4 files. python-can imports asammdf wherever it is installed, which takes
        longer than all the rest of a start; the others do without.
    """
    missing = [name for name in NEEDED if find_spec(name) is None]
    if not missing:
        if not mf4:
            sys.modules.setdefault("asammdf", None)  # type: ignore[arg-type]
        return
    python = ROOT / ".venv" / "bin" / "python"
    if python.exists() and "DIARC_ENTERED" not in os.environ:
        os.environ["DIARC_ENTERED"] = "1"
        os.execv(python, [str(python), script, *sys.argv[1:]])
    print(
        f"{Path(script).name}: {missing[0]} is missing here; prepare the project's environment once: make setup",
        file=sys.stderr,
    )
    sys.exit(2)


def say(text: str) -> None:
    """Write one line to standard error."""
    print(text, file=sys.stderr, flush=True)


def show(text: str) -> None:
    """Write text to standard output; a reader that has gone away is no error."""
    try:
        print(text, flush=True)
    except BrokenPipeError:
        reader_has_gone()


def reader_has_gone() -> None:
    """Write nothing more to standard output, nor at the end of the process what is still kept for it."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


class CommandLine(argparse.ArgumentParser):
    """A parser whose errors are one line that says what to do next."""

    def error(self, message: str) -> NoReturn:
        """Say what is wrong with the command line and exit with status 2."""
        say(f"{self.prog}: {message}; see {self.prog} --help")
        sys.exit(2)
