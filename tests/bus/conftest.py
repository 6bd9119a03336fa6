"""Where the bus tests find a CAN bus: in this machine's kernel, else in a virtual machine."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[2]
VCAN_VM = REPOSITORY / "tools" / "vcan_vm"
INTERFACE = "vcan0"
BOOT_ALLOWANCE_S = 20.0
"""Added to a command's own time limit when a virtual machine has to start first (2 s when idle)."""
EXIT_TIMEOUT = 124
ARPHRD_CAN = 280
IFF_UP = 1

RunOnVcan = Callable[..., "subprocess.CompletedProcess[str]"]


def kernel_has_vcan(interface: str = INTERFACE) -> bool:
    """Say whether this kernel has a CAN interface that is up.

    Parameters
    ----------
    interface : str
        Name of the interface.

    Returns
    -------
    bool
        True if a raw CAN socket can be bound to it right now.
    """
    properties = Path("/sys/class/net") / interface
    try:
        is_can = int((properties / "type").read_text()) == ARPHRD_CAN
        is_up = int((properties / "flags").read_text(), 16) & IFF_UP
        if not (is_can and is_up):
            return False
        with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as probe:
            probe.bind((interface,))
    except (AttributeError, OSError, ValueError):
        return False
    return True


def why_no_vcan_vm() -> str:
    """Say what keeps `tools/vcan_vm` from running on this machine.

    Returns
    -------
    str
        Its message, which names the packages to install; empty if it can run.
    """
    check = subprocess.run(
        [VCAN_VM, "--check"],
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=20,
        check=False,
    )
    return "" if check.returncode == 0 else check.stderr.strip() or f"exit status {check.returncode}"


def run_bounded(
    argv: Sequence[str | os.PathLike[str]], timeout_s: float, cwd: Path | None = None
) -> subprocess.CompletedProcess[str]:
    """Run a command; at the time limit kill it with all its children.

    Parameters
    ----------
    argv : Sequence[str | os.PathLike[str]]
        Command and arguments.
    timeout_s : float
        Time limit in seconds.
    cwd : Path | None
        Working directory; the caller's if None.

    Returns
    -------
    subprocess.CompletedProcess[str]
        Output as text. Exit status 124 stands for the time limit; 128 + N for signal N, as in a shell.
    """
    with subprocess.Popen(
        [os.fspath(word) for word in argv],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        encoding="utf-8",
        errors="backslashreplace",
        cwd=cwd,
        start_new_session=True,
    ) as process:
        try:
            out, err = process.communicate(timeout=timeout_s)
            status = process.returncode if process.returncode >= 0 else 128 - process.returncode
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            out, err = process.communicate()
            status, err = EXIT_TIMEOUT, f"{err}timeout after {timeout_s} s\n"
        return subprocess.CompletedProcess(process.args, status, out, err)


@pytest.fixture(scope="session")
def vcan_vm() -> Path:
    """Give the path of `tools/vcan_vm` if it can run; else fail, or skip where nobody needs it.

    Returns
    -------
    Path
        The program.
    """
    reason = why_no_vcan_vm()
    if reason and kernel_has_vcan():
        pytest.skip(f"this kernel has {INTERFACE}, and: {reason}")
    if reason:
        pytest.fail(reason, pytrace=False)
    return VCAN_VM


@pytest.fixture(scope="session")
def run_on_vcan(request: pytest.FixtureRequest) -> RunOnVcan:
    """Give a function that runs a command where `vcan0` is up.

    Its signature is ``run_on_vcan(argv, timeout_s=60.0, cwd=None)``; it returns a
    `subprocess.CompletedProcess` with text output. Exit status 124 stands for the time limit. A virtual
    machine starts with an empty bus each time; the kernel's own vcan0 is shared with everybody else.

    Parameters
    ----------
    request : pytest.FixtureRequest
        Gives access to `vcan_vm`, which is asked for only if the kernel has no bus.

    Returns
    -------
    RunOnVcan
        The function.
    """
    program = None if kernel_has_vcan() else request.getfixturevalue("vcan_vm")

    def run(
        argv: Sequence[str | os.PathLike[str]], timeout_s: float = 60.0, cwd: Path | None = None
    ) -> subprocess.CompletedProcess[str]:
        if program is None:
            return run_bounded(argv, timeout_s, cwd)
        limit_s = timeout_s + BOOT_ALLOWANCE_S
        return run_bounded([program, "--timeout", f"{limit_s:f}", "--", *argv], limit_s + 10, cwd)

    return run
