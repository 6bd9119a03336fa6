"""The recorder: what would lose frames, or somebody's file."""

from __future__ import annotations

import json
import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import can
import pytest

from sil_plant.bus import protocol
from sil_plant.bus.hub import Hub
from sil_plant.bus.ports import HubPort
from sil_plant.recordings.recorder import Recorder, RecorderError, convert_spool
from sil_plant.recordings.recording import FORMATS, RecordingError, read_recording, spool_of
from sil_plant.recordings.replay import replay

ROOT = Path(__file__).resolve().parents[2]
RECORD_PY = ROOT / "tools" / "record.py"
LIMIT_S = 60.0  # no wait is longer; reaching it is a failure
FRAMES = 3000


def a_frame(number: int) -> tuple[int, bytes]:
    """Frame number so much: each is another."""
    return 0x100 + number % 0x200, number.to_bytes(4, "big") + bytes(number % 5)


def a_message(number: int) -> can.Message:
    can_id, data = a_frame(number)
    return can.Message(timestamp=1e9 + number * 1e-3, arbitration_id=can_id, data=data, is_extended_id=False)


def expect_frames(path: Path, count: int) -> None:
    """The recording has exactly the first so many frames."""
    rows = read_recording(path).rows
    numbers = [int.from_bytes(row[5:9].tobytes(), "big") for row in rows]
    assert numbers == list(range(count))
    assert [(int(row[0]) | int(row[1]) << 8, int(row[4])) for row in rows] == [
        (a_frame(n)[0], len(a_frame(n)[1])) for n in range(count)
    ]


@pytest.fixture
def hub() -> Iterator[HubPort]:
    """A bus that the test drives."""
    with HubPort(Hub("127.0.0.1", 0)) as port:
        yield port


Begin = Callable[..., subprocess.Popen]


@pytest.fixture
def begin(hub: HubPort, tmp_path: Path) -> Iterator[Begin]:
    """Start record.py on the hub and wait until it records: ``begin(path, *options)``."""
    started: list[subprocess.Popen] = []

    def start(path: Path, *options: str, **more: object) -> subprocess.Popen:
        said = tmp_path / f"said{len(started)}"
        with said.open("w") as file:
            process = subprocess.Popen(
                [sys.executable, RECORD_PY, f"tcp:127.0.0.1:{hub.hub.port}", path, *options],
                stdin=subprocess.DEVNULL, stderr=file, **more,
            )  # fmt: skip
        process.said = said  # type: ignore[attr-defined]
        started.append(process)
        wait_until(hub, lambda: "recording" in said.read_text() or process.poll() is not None)
        assert process.poll() is None, said.read_text()
        return process

    yield start
    for process in started:
        process.kill()
        process.wait()


def wait_until(hub: HubPort, condition: Callable[[], bool]) -> None:
    end = time.monotonic() + LIMIT_S
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        hub.hub.service()
        time.sleep(0.01)


def finish(hub: HubPort, process: subprocess.Popen) -> tuple[int, str]:
    """Its exit status and what it said, while the hub goes on."""
    wait_until(hub, lambda: process.poll() is not None)
    return process.returncode, process.said.read_text()  # type: ignore[attr-defined]


def send(hub: HubPort, first: int, last: int) -> None:
    for number in range(first, last):
        hub.send(*a_frame(number))
        if number % 20 == 0:
            hub.hub.service()
    hub.hub.flush()


def collected(hub: HubPort, path: Path, count: int) -> None:
    """Wait until the file has grown to so many lines; nothing closes or flushes it but the recorder itself."""
    wait_until(hub, lambda: path.exists() and path.read_bytes().count(b"\n") >= count)


# ---- on a bus ------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", FORMATS)
def test_ctrl_c_leaves_a_whole_file(hub: HubPort, begin: Begin, tmp_path: Path, suffix: str) -> None:
    """GIVEN a recorder in each format WHEN it gets Ctrl-C THEN every frame is in the file, and status 0."""
    path = tmp_path / f"run{suffix}"
    process = begin(path)
    send(hub, 0, FRAMES)
    target = path if suffix in (".asc", ".log", ".csv") else spool_of(path)
    collected(hub, target, FRAMES)
    process.send_signal(signal.SIGINT)
    status, said = finish(hub, process)
    assert status == 0 and f"{FRAMES} frames" in said and "0 lost" in said
    assert "no start of the ECU" in said
    expect_frames(path, FRAMES)
    assert not read_recording(path).damage
    assert sorted(p.name for p in tmp_path.iterdir()) == [path.name, "said0"]  # no spool, no part


@pytest.mark.parametrize("suffix", [".log", ".mf4"])
def test_sigkill_loses_nothing(hub: HubPort, begin: Begin, tmp_path: Path, suffix: str) -> None:
    """GIVEN a recorder WHEN it is killed THEN all that it heard is in the file, or made into it by --recover,
    and nobody overwrites what it kept.
    """
    path = tmp_path / f"run{suffix}"
    process = begin(path)
    send(hub, 0, FRAMES)
    direct = suffix == ".log"
    collected(hub, path if direct else spool_of(path), FRAMES)
    process.kill()
    process.wait()
    if direct:
        expect_frames(path, FRAMES)
        return
    assert not path.exists()
    with pytest.raises(RecordingError, match=r"record\.py --recover"):
        read_recording(path)
    with pytest.raises(RecorderError, match=r"--recover .*throw it away: --force"):
        Recorder(path)
    done = subprocess.run(
        [sys.executable, RECORD_PY, "--recover", path], capture_output=True, text=True, timeout=LIMIT_S, check=False
    )
    assert done.returncode == 0 and f"{FRAMES} frames recovered" in done.stderr
    expect_frames(path, FRAMES)
    assert not spool_of(path).exists()


@pytest.mark.parametrize("suffix", [".log", ".blf"])
def test_a_full_disk_keeps_what_was_recorded(hub: HubPort, begin: Begin, tmp_path: Path, suffix: str) -> None:
    """GIVEN no room for all frames WHEN recorded THEN it ends with one message, and what fitted is readable."""
    most = 60_000

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (most, most))

    path = tmp_path / f"run{suffix}"
    process = begin(path, preexec_fn=limit)
    send(hub, 0, FRAMES)
    status, said = finish(hub, process)
    assert status == 1 and "cannot be written any more" in said and "are kept" in said
    assert "Traceback" not in said
    if suffix == ".blf":
        assert "record.py --recover" in said
        convert_spool(path)
    recording = read_recording(path)
    assert not recording.damage
    kept = len(recording.rows)
    assert 1000 < kept < FRAMES
    expect_frames(path, kept)


def test_the_end_of_the_bus_is_the_end_of_the_recording(hub: HubPort, begin: Begin, tmp_path: Path) -> None:
    """GIVEN a recorder on a hub WHEN the hub goes away THEN the file is whole, and it says why it ended."""
    path = tmp_path / "run.blf"
    process = begin(path)
    send(hub, 0, 100)
    collected(hub, spool_of(path), 100)
    hub.close()
    assert process.wait(LIMIT_S) == 0
    assert "with it ends the recording" in process.said.read_text()  # type: ignore[attr-defined]
    expect_frames(path, 100)


def test_nothing_heard_is_said(hub: HubPort, begin: Begin, tmp_path: Path) -> None:
    """GIVEN a bus without frames WHEN recorded for a while THEN status 1 and a hint."""
    status, said = finish(hub, begin(tmp_path / "run.log", "--duration", "0.3"))
    assert status == 1 and "nothing was heard" in said


def record_a_run(start, start_ecu, path: Path) -> bool:
    """Record run.py and the ECU on a hub; whether no frame was lost."""
    with Hub("127.0.0.1", 0) as probe:
        bus = f"tcp:127.0.0.1:{probe.port}"
    figures = path.with_suffix(".json")
    recorder = start([sys.executable, RECORD_PY, bus, path, "--wait", "60"], f"record {path.stem}")
    argv = [sys.executable, ROOT / "sil_plant" / "run.py", "--bus", bus, "--duration", 1, "--quiet", "--json", figures]
    run = start(argv, path.stem)
    end = time.monotonic() + LIMIT_S
    while "recording" not in recorder.err.read_text():
        assert time.monotonic() < end and run.process.poll() is None, recorder.err.read_text() + run.err.read_text()
        time.sleep(0.02)
    start_ecu(bus)
    assert run.wait() == 0, run.err.read_text()
    assert recorder.wait() == 0, recorder.err.read_text()
    return json.loads(figures.read_text("utf-8"))["lost_frames"] == 0


def test_a_real_run_replays_identically(start, start_ecu, tmp_path: Path) -> None:
    """GIVEN run.py and the ECU on a hub, and a recorder that waited for it WHEN the run is over
    THEN its recording replays bit for bit, from the NMT reset that begins the run.
    """
    for attempt in range(5):
        path = tmp_path / f"run{attempt}.blf"
        if record_a_run(start, start_ecu, path):
            break  # else this machine paused the plant so long that the ECU went on without its sensors
    result = replay(read_recording(path), None)
    assert result.is_identical and not result.unusable, (result.first, result.notes, result.unusable)
    assert result.sections[-1].by_reset and result.counts["VALVES"].compared >= 1101


# ---- files ---------------------------------------------------------------------------------------


def test_no_file_is_overwritten_unasked(tmp_path: Path) -> None:
    """GIVEN a file of that name WHEN recorded to THEN refused and untouched, unless forced."""
    path = tmp_path / "run.log"
    path.write_text("precious\n")
    with pytest.raises(RecorderError, match="--force"):
        Recorder(path)
    assert path.read_text() == "precious\n"
    recorder = Recorder(path, force=True)
    recorder.add(a_message(0))
    recorder.close()
    expect_frames(path, 1)


@pytest.mark.parametrize(
    ("name", "text"), [("run.txt", "ends in"), ("run", "ends in"), ("a/run.log", "mkdir"), ("run.log.gz", "gzip")]
)
def test_wrong_names_are_refused_before_anything_is_made(tmp_path: Path, name: str, text: str) -> None:
    """GIVEN a name of no format, or in no folder WHEN recorded to THEN refused, and nothing is made."""
    with pytest.raises((RecorderError, RecordingError), match=text):
        Recorder(tmp_path / name)
    assert not list(tmp_path.iterdir())


def test_a_conversion_that_fails_keeps_the_frames(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """GIVEN a recording whose file cannot be made at the end WHEN closed THEN the frames stay, and can be recovered."""
    path = tmp_path / "run.blf"
    recorder = Recorder(path)
    for number in range(50):
        recorder.add(a_message(number))

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", full)
        with pytest.raises(RecorderError, match=r"No space left on device; all frames are kept in .*--recover"):
            recorder.close()
    assert not path.exists()
    assert convert_spool(path) == 50
    expect_frames(path, 50)


def test_other_frames_than_the_ecus_are_kept(tmp_path: Path) -> None:
    """GIVEN extended, remote and CAN FD frames and errors WHEN recorded to .mf4, whose writer is ours
    THEN python-can reads back what its own writer would have made of them.
    """
    common = {"timestamp": 1e9, "channel": 0}
    kinds = [
        can.Message(arbitration_id=0x1ABCDE0, data=b"\1\2", is_extended_id=True, **common),
        can.Message(arbitration_id=0x123, is_remote_frame=True, dlc=0, is_extended_id=False, **common),
        can.Message(arbitration_id=0x124, data=bytes(range(48)), is_fd=True, bitrate_switch=True,
                    is_extended_id=False, **common),
        can.Message(arbitration_id=0x125, data=b"", is_extended_id=False, is_rx=False, **common),
        can.Message(is_error_frame=True, is_extended_id=False, **common),
    ]  # fmt: skip
    path = tmp_path / "run.mf4"
    recorder = Recorder(path)
    for message in kinds:
        recorder.add(message)
    recorder.close()
    with can.MF4Reader(path) as reader:
        assert next(iter(reader)).timestamp == pytest.approx(1e9, abs=1e-3)
    with can.MF4Reader(path) as reader:
        ours = sorted((str(m.arbitration_id), m.is_extended_id, m.is_fd, m.is_remote_frame, m.is_error_frame, m.is_rx,
                       m.dlc, bytes(m.data)) for m in reader)  # fmt: skip
    expected = sorted((str(m.arbitration_id), m.is_extended_id, m.is_fd, m.is_remote_frame, m.is_error_frame, m.is_rx,
                       m.dlc, bytes(m.data)) for m in kinds)  # fmt: skip
    assert [entry for entry in ours if not entry[4]] == [entry for entry in expected if not entry[4]]
    assert sum(entry[4] for entry in ours) == 1


def test_a_start_of_the_ecu_is_noticed(tmp_path: Path) -> None:
    """GIVEN a boot-up message among others WHEN recorded THEN the recorder knows that a replay is possible."""
    recorder = Recorder(tmp_path / "run.log")
    heartbeat = protocol.frame_id("HEARTBEAT_ECU")
    recorder.add(can.Message(arbitration_id=heartbeat, data=b"\5", is_extended_id=False))
    assert not recorder.has_start
    recorder.add(can.Message(arbitration_id=heartbeat, data=b"\0", is_extended_id=False))
    assert recorder.has_start
