"""The CANopen client on a real SocketCAN interface, as users have it: what the rig's hub would hide."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
CLIENT_TESTS = ROOT / "tests" / "sil" / "test_canopen.py"
LIMIT_S = 120.0


def test_client_does_not_see_another_ecu_than_on_the_hub(run_on_vcan: Callable) -> None:
    """GIVEN vcan0 WHEN the tests with the real client run there THEN each passes, as on the hub."""
    done = run_on_vcan(
        [
            "env", "DIARC_TEST_BUS=vcan0", sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider",
            "--rootdir", ROOT, CLIENT_TESTS,
        ],
        timeout_s=LIMIT_S,
        cwd=ROOT,
    )  # fmt: skip
    assert done.returncode == 0, f"{done.stdout[-4000:]}\n{done.stderr[-2000:]}"
    assert " passed" in done.stdout and "failed" not in done.stdout and "skipped" not in done.stdout, done.stdout
