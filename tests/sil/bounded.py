"""Programs that must end in time."""

from __future__ import annotations

import os
import signal
import subprocess
from collections.abc import Sequence

import pytest


def run_bounded(
    argv: Sequence[str], timeout_s: float, *, stderr: int = subprocess.PIPE, **options
) -> subprocess.CompletedProcess:
    """Run a command; at the time limit kill it with all its children, and fail."""
    with subprocess.Popen(
        argv,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=stderr,
        text=True,
        start_new_session=True,
        **options,
    ) as process:
        try:
            out, err = process.communicate(timeout=timeout_s)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            out, err = process.communicate()
            pytest.fail(f"still running after {timeout_s} s: {argv}\n{out}\n{err}")
        return subprocess.CompletedProcess(argv, process.returncode, out, err)
