"""Coverage: a line of the law or the ECU that no unit test runs."""

from __future__ import annotations

import re
import subprocess
import sys

import pytest

from tests.rules.compilers import ROOT, need, sources

LIMIT_S = 900.0


@pytest.mark.timeout(LIMIT_S)
def test_line_of_law_or_ecu_never_run() -> None:
    """GIVEN the unit tests of two number types WHEN lines are counted THEN each line of control/ and ecu/ is run."""
    need("cmake", "gcc")
    result = subprocess.run(
        [sys.executable, str(ROOT / "tools/coverage.py")],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=LIMIT_S,
    )
    assert result.returncode == 0, result.stdout[-6000:]
    counted = set(re.findall(r"^(firmware/\S+\.c) ", result.stdout, re.MULTILINE))
    assert counted == set(sources("firmware/control/*.c")) | set(sources("firmware/ecu/*.c"))
