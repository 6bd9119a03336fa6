"""What `cantools decode` makes of a log, as a user runs it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

DBC = Path(__file__).resolve().parents[1] / "can_protocol" / "diarc.dbc"


def decoded(log: str) -> str:
    """Lines of `candump -L`, decoded with our DBC."""
    argv = [sys.executable, "-m", "cantools", "decode", "--single-line", DBC]
    return subprocess.run(argv, input=log, capture_output=True, text=True, timeout=60, check=True).stdout
