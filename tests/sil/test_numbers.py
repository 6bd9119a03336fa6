"""The number types against one another."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def test_number_type_does_not_cost_accuracy() -> None:
    """GIVEN the paper's profile, six loads, three seeds WHEN run in double, float and fixed point
    THEN float stays within 1.05 and fixed within 1.5 times the figures of double, and they are not the same build.
    """
    command = [sys.executable, str(ROOT / "tools" / "agreement.py"), "--check"]
    result = subprocess.run(command, capture_output=True, text=True, timeout=110, check=False)
    assert result.returncode == 0, result.stdout + result.stderr
    rows = [line for line in result.stdout.splitlines() if line.startswith(("| joint angle", "| spool set-point"))]
    assert len(rows) == 2
    angle, spool = ([float(cell) for cell in row.split("|")[2:4]] for row in rows)
    assert 0.0 < min(angle) and max(angle) < 1e-3
    assert 0.0 < spool[0] < spool[1] < 1e-2
