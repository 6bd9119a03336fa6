"""Runs the lines of docs/tools.md against an ECU and a plant, each in a terminal of its own, and tells what came.

Usage: standard_tools.py ROOT FOLDER BUS; BUS is vcan0 or tcp:127.0.0.1:PORT. The result is FOLDER/seen.json. It is a
script because the bus may be inside a virtual machine, where no test runs.
"""

import ctypes
import json
import os
import pty
import re
import select
import signal
import subprocess
import sys
import time
from pathlib import Path

ROOT, FOLDER, BUS = Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3]
LINE_LIMIT_S = 60.0
SCREEN_S = 4.0
SECTION = {"vcan0": "bus"}.get(BUS, "sil")
PR_SET_PDEATHSIG = 1
COLUMNS, ROWS = "100", "30"


def lines() -> list[str]:
    """The section's commands; the port of the documentation is replaced by ours."""
    text = (ROOT / "docs" / "tools.md").read_text(encoding="utf-8")
    block = re.search(rf"<!-- tools: run by tests/{SECTION}/.*?-->\n```sh\n(.*?)```", text, re.DOTALL)
    if block is None:
        raise SystemExit("docs/tools.md has no such section")
    port = BUS.rpartition(":")[2]
    found = block.group(1).splitlines()
    if (ROOT / "can_protocol" / "diarc_ecu.eds").exists():
        canopen = re.search(r"<!-- canopen -->.*?```sh\n(.*?)```", text, re.DOTALL)
        interface = "'socketcan'" if SECTION == "bus" else "'socketcand'"
        found += [line for line in (canopen.group(1).splitlines() if canopen else []) if interface in line]
    return [line.replace("29536", port) for line in found if line]


def run_line(line: str) -> dict:
    """Run one line in a terminal; what shows a screen gets q, what logs gets Ctrl-C."""
    screen = "cantools monitor" in line or "can.viewer" in line
    endless = "can.logger" in line
    child, terminal = pty.fork()
    if child == 0:
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)  # it would spin for ever without a bus
        os.environ.update(TERM="xterm", COLUMNS=COLUMNS, LINES=ROWS)
        os.chdir(FOLDER)
        os.execvp("bash", ["bash", "-c", line])
    import fcntl
    import struct
    import termios

    fcntl.ioctl(terminal, termios.TIOCSWINSZ, struct.pack("HHHH", int(ROWS), int(COLUMNS), 0, 0))
    start, told, seen, status = time.monotonic(), 0, b"", None
    log = FOLDER / line.split(" -f ")[1].split()[0] if endless else None
    logs_since = None
    while time.monotonic() - start < LINE_LIMIT_S:
        ended, raw = os.waitpid(child, os.WNOHANG)
        if ended:
            status = os.waitstatus_to_exitcode(raw)
            break
        if select.select([terminal], [], [], 0.1)[0]:
            try:
                chunk = os.read(terminal, 1 << 16)
            except OSError:  # nobody has the terminal open any more; the child ends now
                time.sleep(0.1)
                continue
            seen += chunk
        shown = b"ESTIMATE" in seen if "cantools" in line else b"0x181" in seen or b"181" in seen
        due = (shown and time.monotonic() - start > SCREEN_S) or time.monotonic() - start > LINE_LIMIT_S / 2
        if log is not None and logs_since is None and log.exists():
            logs_since = time.monotonic()
        logged = logs_since is not None and time.monotonic() - logs_since > SCREEN_S
        if (screen and due) or logged:
            os.write(terminal, b"q" if screen and told < 3 else b"\x03")
            told += 1
            # a second Ctrl-C would break the first one's tidy end
            logs_since = time.monotonic() + LINE_LIMIT_S / 4 if endless else None
            time.sleep(0.5)
    else:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
    while select.select([terminal], [], [], 0.0)[0]:
        try:
            seen += os.read(terminal, 1 << 16)
        except OSError:
            break
    os.close(terminal)
    return {"line": line, "status": status, "out": seen.decode("utf-8", "replace")[-200_000:]}


def heard(tool: str, *arguments: str) -> dict:
    """Run one of our tools."""
    argv = [sys.executable, str(ROOT / "tools" / tool), BUS, *arguments]
    done = subprocess.run(argv, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=60, check=False)
    return {"status": done.returncode, "out": done.stdout, "err": done.stderr}


def main() -> None:
    """Start the run, wait for motion, try everything, stop it."""
    os.environ["PATH"] = f"{Path(sys.executable).parent}:{os.environ['PATH']}:/usr/sbin:/sbin"
    (FOLDER / "out").mkdir()
    (FOLDER / "can_protocol").symlink_to(ROOT / "can_protocol")
    seen: dict = {"dead bus": heard("doctor.py", "--json", "--listen", "0.5")}
    with (FOLDER / "run.err").open("w") as err:
        argv = [sys.executable, str(ROOT / "sil_plant" / "run.py"), "--bus", BUS, "--ecu", "spawn", "--load", "2.5"]
        run = subprocess.Popen([*argv, "--duration", "600"], stdin=subprocess.DEVNULL, stderr=err, stdout=err)
    try:
        end = time.monotonic() + 90.0
        while True:
            seen["monitor"] = heard("monitor.py", "--once", "--json")
            if seen["monitor"]["status"] == 0 and json.loads(seen["monitor"]["out"])["mode"] == "RUN":
                break
            if time.monotonic() > end or run.poll() is not None:
                raise SystemExit(f"the arm does not move: {(FOLDER / 'run.err').read_text()}")
        seen["doctor"] = heard("doctor.py", "--json")
        seen["lines"] = [run_line(line) for line in lines()]
        seen["run is alive"] = run.poll() is None
    finally:
        run.send_signal(signal.SIGINT)
        try:
            run.wait(20)
        except subprocess.TimeoutExpired:
            run.kill()
    (FOLDER / "seen.json").write_text(json.dumps(seen), encoding="utf-8")


if __name__ == "__main__":
    main()
