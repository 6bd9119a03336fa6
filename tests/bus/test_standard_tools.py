"""The lines of docs/tools.md on a real vcan0, and monitor and doctor there: what would not paste and run."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def seen(run_on_vcan: Callable, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What every line brought."""
    folder = tmp_path_factory.mktemp("tools")
    script = Path(__file__).with_name("standard_tools.py")
    done = run_on_vcan([sys.executable, script, ROOT, folder, "vcan0"], timeout_s=300.0, cwd=folder)
    assert done.returncode == 0, done.stderr
    return json.loads((folder / "seen.json").read_text("utf-8")) | {"folder": folder}


def line(seen: dict[str, Any], words: str) -> dict[str, Any]:
    """The one line with these words."""
    (found,) = [each for each in seen["lines"] if words in each["line"]]
    return found


@pytest.mark.timeout(400)
def test_doctor_is_not_blind_on_socketcan(seen: dict[str, Any]) -> None:
    """GIVEN vcan0 without and with ECU and plant WHEN asked THEN silence is found, and then nothing is wrong."""
    assert seen["dead bus"]["status"] == 1
    dead = json.loads(seen["dead bus"]["out"])["findings"]
    assert [finding["code"] for finding in dead if finding["severity"] == "error"] == ["silent"]
    assert dead[0]["next"] == "./firmware/diarc_ecu vcan0"
    sound = json.loads(seen["doctor"]["out"])
    assert [finding for finding in sound["findings"] if finding["severity"] == "error"] == []
    assert seen["run is alive"]


@pytest.mark.timeout(400)
def test_monitor_is_not_blind_on_socketcan(seen: dict[str, Any]) -> None:
    """GIVEN a run on vcan0 WHEN the monitor joins THEN it tells mode, load and pressures."""
    state = json.loads(seen["monitor"]["out"])
    assert state["mode"] == "RUN" and state["dbc_match"] is True and state["load"]["kg"] is not None
    assert state["joints"]["swing"]["bore_bar"] > 0.0 and state["frames_per_s"] > 100.0


@pytest.mark.timeout(400)
@pytest.mark.parametrize(
    ("words", "shown"),
    [
        ("candump -n 20", "080   [1]"),
        ("cantools decode", "ESTIMATE("),
        ("cantools monitor", "ESTIMATE"),
        ("can.viewer", "0x181"),
        ("cantools plot", ""),
        ("can.logger", ""),
    ],
)
def test_documented_line_does_not_fail(seen: dict[str, Any], words: str, shown: str) -> None:
    """GIVEN a line of docs/tools.md WHEN pasted THEN it ends well and shows the ECU's frames."""
    found = line(seen, words)
    assert found["status"] == 0 and shown in found["out"], found["out"][-2000:]
    assert "Traceback" not in found["out"] and "Unknown frame id" not in found["out"]


@pytest.mark.timeout(400)
def test_documented_lines_do_not_write_empty_files(seen: dict[str, Any]) -> None:
    """GIVEN the lines that write WHEN pasted THEN log, plot and recording have content."""
    folder = seen["folder"] / "out"
    assert (folder / "load.png").read_bytes()[:4] == b"\x89PNG"
    assert len((folder / "drive.log").read_text().splitlines()) == 20000
    assert (folder / "drive.blf").read_bytes()[:4] == b"LOGG" and (folder / "drive.blf").stat().st_size > 1000


@pytest.mark.timeout(400)
def test_canopen_line_does_not_fail(seen: dict[str, Any]) -> None:
    """GIVEN the object dictionary's EDS WHEN the documented line is pasted THEN it prints the device's name."""
    if not (ROOT / "can_protocol" / "diarc_ecu.eds").exists():
        pytest.skip("this firmware has no object dictionary yet")
    found = line(seen, "import canopen")
    assert found["status"] == 0 and "Traceback" not in found["out"] and found["out"].strip(), found["out"]
