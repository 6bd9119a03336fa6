"""A recording on a real SocketCAN interface: what would make it lose frames, or not replay."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

from sil_plant.recordings.recording import read_recording
from sil_plant.recordings.replay import replay

ROOT = Path(__file__).resolve().parents[2]
TICKS = 1101

TOUR = r"""
import json
import signal
import subprocess
import sys
import time
from pathlib import Path

ROOT, FOLDER = Path(sys.argv[1]), Path(sys.argv[2])


def started(argv, name):
    with open(FOLDER / (name + ".err"), "w") as err:
        return subprocess.Popen([str(word) for word in argv], stdin=subprocess.DEVNULL, stderr=err)


end = time.monotonic() + 60
recorder = started([sys.executable, ROOT / "tools" / "record.py", "vcan0", FOLDER / "run.blf"], "record")
while "recording" not in (FOLDER / "record.err").read_text() and time.monotonic() < end and recorder.poll() is None:
    time.sleep(0.02)
ecu = started([ROOT / "firmware" / "diarc_ecu", "vcan0"], "ecu")
run = started([sys.executable, ROOT / "sil_plant" / "run.py", "--bus", "vcan0", "--duration", "1", "--quiet"], "run")
seen = {"run": run.wait(60)}
ecu.send_signal(signal.SIGTERM)
seen["ecu"] = ecu.wait(20)
time.sleep(0.3)
recorder.send_signal(signal.SIGINT)
seen["record"] = recorder.wait(60)

# a reader that does not read: what the kernel drops is counted
sys.path.insert(0, str(ROOT))
import can

from sil_plant.bus.ports import PythonCanPort, connect_python_can

with PythonCanPort(connect_python_can("vcan0"), "vcan0") as deaf, connect_python_can("vcan0") as sender:
    for number in range(20000):
        sender.send(can.Message(arbitration_id=0x555, data=bytes(8), is_extended_id=False))
    seen["drops"] = deaf.receive_drops
    seen["heard"] = 0
    while deaf.receive_message(0.0) is not None:
        seen["heard"] += 1
(FOLDER / "seen.json").write_text(json.dumps(seen))
"""


def test_a_recording_on_vcan_replays_identically(run_on_vcan, tmp_path: Path) -> None:
    """GIVEN ECU, plant and recorder on vcan0, the ECU ended by SIGTERM WHEN the recording is replayed
    THEN every frame from its start to its last is the same, and none was lost.
    """
    compiled = [sys.executable, ROOT / "sil_plant" / "run.py", "--bus", "inproc", "--duration", "0.01", "--quiet"]
    subprocess.run(compiled, check=True, timeout=100)
    (tmp_path / "tour.py").write_text(TOUR)
    done = run_on_vcan([sys.executable, tmp_path / "tour.py", ROOT, tmp_path], timeout_s=90.0)
    said = "\n".join(path.read_text() for path in sorted(tmp_path.glob("*.err")))
    assert done.returncode == 0, done.stderr + said
    seen = json.loads((tmp_path / "seen.json").read_text())
    assert (seen["run"], seen["ecu"], seen["record"]) == (0, 0, 0), said
    assert seen["drops"] > 0 and seen["heard"] + seen["drops"] == 20000
    assert " 0 lost" in (tmp_path / "record.err").read_text()
    recording = read_recording(tmp_path / "run.blf")
    assert not recording.damage
    result = replay(recording, None)
    assert result.is_identical and not result.unusable, (result.first, result.notes, result.unusable)
    assert [section.by_reset for section in result.sections] == [False, True]
    assert result.counts["VALVES"].compared >= TICKS
