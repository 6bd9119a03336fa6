"""The lines of docs/tools.md for a bus over TCP: what would not paste and run."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.cantools_decode import decoded

ROOT = Path(__file__).resolve().parents[2]
LIMIT_S = 300.0


@pytest.fixture(scope="module")
def seen(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What every line brought."""
    folder = tmp_path_factory.mktemp("tools")
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port = probe.getsockname()[1]
    script = ROOT / "tests" / "bus" / "standard_tools.py"
    argv = [sys.executable, script, ROOT, folder, f"tcp:127.0.0.1:{port}"]
    done = subprocess.run(
        argv, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=LIMIT_S, check=False, cwd=folder
    )
    assert done.returncode == 0, done.stderr
    return json.loads((folder / "seen.json").read_text("utf-8")) | {"folder": folder}


@pytest.mark.timeout(LIMIT_S)
@pytest.mark.parametrize(
    ("words", "shown"), [("cantools monitor", "ESTIMATE"), ("can.viewer", "181"), ("can.logger", "")]
)
def test_documented_line_does_not_fail_over_tcp(seen: dict[str, Any], words: str, shown: str) -> None:
    """GIVEN a line of docs/tools.md WHEN pasted THEN it ends well and shows the ECU's frames."""
    (found,) = [each for each in seen["lines"] if words in each["line"]]
    assert found["status"] == 0 and shown in found["out"], found["out"][-2000:]
    assert "Traceback" not in found["out"]


@pytest.mark.timeout(LIMIT_S)
def test_log_over_tcp_is_not_foreign_to_cantools(seen: dict[str, Any]) -> None:
    """GIVEN the log of the documented line WHEN given to cantools decode THEN the estimate has its unit."""
    log = (seen["folder"] / "out" / "drive.log").read_text()
    assert len(log.splitlines()) > 1000
    sample = "".join(f"{line}\n" for line in log.splitlines() if " 181#" in line)
    lines = decoded(sample)
    assert "ESTIMATE(" in lines and " kg" in lines


@pytest.mark.timeout(LIMIT_S)
def test_doctor_does_not_blame_a_run_that_moves(seen: dict[str, Any]) -> None:
    """GIVEN no hub, then a run WHEN asked THEN the hub is missing first, and no error is left then."""
    dead = json.loads(seen["dead bus"]["out"])["findings"]
    assert dead[0]["code"] == "no-hub"
    sound = json.loads(seen["doctor"]["out"])["findings"]
    assert [finding for finding in sound if finding["severity"] == "error"] == []
    assert seen["run is alive"]


@pytest.mark.timeout(LIMIT_S)
def test_canopen_line_does_not_fail_over_tcp(seen: dict[str, Any]) -> None:
    """GIVEN the object dictionary's EDS WHEN the documented line is pasted THEN it prints the device's name."""
    if not (ROOT / "can_protocol" / "diarc_ecu.eds").exists():
        pytest.skip("this firmware has no object dictionary yet")
    found = next(each for each in seen["lines"] if "import canopen" in each["line"])
    assert found["status"] == 0 and "Traceback" not in found["out"] and found["out"].strip(), found["out"]
