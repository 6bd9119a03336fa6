"""Replay: what would let a changed law pass, or refuse a recording of the same one."""

from __future__ import annotations

import gzip
import importlib.util
import struct
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import can
import numpy as np
import pytest

from sil_plant.bus import protocol
from sil_plant.bus.frames import DATA, from_row, protect, to_row
from sil_plant.inputs.machine import Machine, load_parameter_table, parameter_image
from sil_plant.inputs.scenario import Scenario
from sil_plant.loop import session
from sil_plant.loop.inproc import InprocEcu
from sil_plant.recordings.capture import capture
from sil_plant.recordings.recording import (
    ECU_NODE,
    FORMATS,
    Recording,
    RecordingError,
    find_ticks,
    raw_signal,
    read_recording,
    rows_of,
    signal,
)
from sil_plant.recordings.replay import SDO_ANSWER_ID, replay

ROOT = Path(__file__).resolve().parents[2]
REFERENCE = ROOT / "tests" / "sil" / "data" / "reference.log.gz"
UPDATE = "python tools/record_reference.py"
TICKS = 401
RUN_TICK = 60  # of the prelude: RUN is requested

Messages = list[can.Message]
Disturb = Callable[[int, np.ndarray], np.ndarray]


def recording_of(messages: Messages) -> Recording:
    """Messages as if read from a file."""
    rows = np.array([to_row(m.arbitration_id, bytes(m.data)) for m in messages], dtype=np.uint8)
    return Recording(Path("test.log"), np.array([m.timestamp for m in messages]), rows)


def frame(row: np.ndarray, time_s: float = 0.0) -> can.Message:
    """A message of a frame row."""
    can_id, data = from_row(row)
    return can.Message(timestamp=time_s, arbitration_id=can_id, data=data, is_extended_id=False)


def changed(message: can.Message, change: Callable[[np.ndarray], None], counter: int | None = None) -> can.Message:
    """A copy with other data, and the right CRC for it."""
    row = to_row(message.arbitration_id, bytes(message.data))
    change(row)
    protect(row, int(row[DATA + 1]) & 15 if counter is None else counter)
    return frame(row, message.timestamp)


def places(messages: Messages, name: str) -> list[int]:
    """Where the messages of a kind are."""
    return [k for k, m in enumerate(messages) if m.arbitration_id == protocol.frame_id(name)]


@pytest.fixture(scope="module")
def record_run(machine: Machine, image: bytes, paper: Scenario) -> Callable[..., Messages]:
    """Record a run of 0.3 s of motion: ``record_run(disturb, ecu)``."""

    def run(disturb: Disturb | None = None, ecu: InprocEcu | None = None) -> Messages:
        short = session.make_session(machine, replace(paper, duration_s=0.3), "diarc", 1, 1e-3)
        return capture(short, ecu or InprocEcu(image), disturb)

    return run


@pytest.fixture(scope="module")
def messages(record_run: Callable[..., Messages]) -> Messages:
    """An undisturbed run from the ECU's start."""
    return record_run()


# ---- the committed recording ---------------------------------------------------------------------


def test_a_changed_law_is_noticed() -> None:
    """GIVEN the committed recording, in fixed point WHEN replayed
    THEN not one bit differs, over the ticks, frames and the restart that it is known to have.
    """
    try:
        result = replay(read_recording(REFERENCE), None, "fixed")
    except RecordingError as error:
        pytest.fail(f"{error}; if the frames were meant to change, make the recording anew: {UPDATE}")
    assert result.is_identical and not result.unusable, (
        f"the ECU says something else than it did: {result.first}. If that is meant, make the recording anew: {UPDATE}"
    )
    assert [(s.ticks, s.by_reset) for s in result.sections] == [(1151, False), (150, True)]
    assert result.counts["VALVES"].compared == 1152
    assert result.counts["ESTIMATE"].compared == 115


def test_the_committed_recording_can_be_made_again() -> None:
    """GIVEN the command that made it WHEN made again THEN the same frames, and small enough for a repository."""
    assert gzip.decompress(tool("record_reference").reference_log()) == gzip.decompress(REFERENCE.read_bytes()), UPDATE
    assert REFERENCE.stat().st_size < 300_000


@pytest.mark.parametrize("gain", ["control.swing.k1_1_s", "control.wrist.k1_1_s"])
def test_a_changed_gain_is_noticed(messages: Messages, machine: Machine, gain: str) -> None:
    """GIVEN a gain that is a thousandth larger WHEN replayed THEN the valve commands differ, from RUN on."""
    image = parameter_image(machine, {gain: 1.001 * machine[gain]})
    result = replay(recording_of(messages), image)
    assert not result.is_identical
    assert result.first is not None and result.first.tick > RUN_TICK
    assert result.counts["VALVES"].different > 0 and result.counts["SYNC"].wrong == 0


@pytest.mark.parametrize("scalar", ["float", "fixed"])
def test_another_number_type_is_noticed(messages: Messages, image: bytes, scalar: str) -> None:
    """GIVEN a recording of an ECU in double WHEN replayed in another number type THEN it differs."""
    assert not replay(recording_of(messages), image, scalar).is_identical


# ---- single frames -------------------------------------------------------------------------------


def test_the_undisturbed_run_is_identical(messages: Messages, image: bytes) -> None:
    """GIVEN a run WHEN replayed THEN every frame of the ECU is compared and the same."""
    result = replay(recording_of(messages), image)
    assert result.is_identical and not result.notes and not result.unusable
    assert result.counts["VALVES"].compared == result.counts["SYNC"].compared == TICKS


@pytest.mark.parametrize(
    ("name", "byte"), [("VALVES", 3), ("ESTIMATE", 4), ("TRACKING", 6), ("PARAMETERS", 5), ("VALVES", 1)]
)
def test_one_changed_bit_of_the_ecu_is_found(messages: Messages, image: bytes, name: str, byte: int) -> None:
    """GIVEN one bit of one frame other than recorded, CRC right WHEN replayed
    THEN one frame differs, and tick and frame are named.
    """
    place = places(messages, name)[-3]
    tick = find_ticks(recording_of(messages).rows).of_row[place]

    def flip(row: np.ndarray) -> None:
        row[DATA + byte] ^= 1

    other = [*messages[:place], changed(messages[place], flip), *messages[place + 1 :]]
    result = replay(recording_of(other), image)
    assert [(k, c.different) for k, c in result.counts.items() if c.wrong] == [(name, 1)]
    assert (result.first.frame, result.first.tick, result.first.section) == (name, tick, 1)


def test_a_changed_sensor_value_is_found(messages: Messages, image: bytes) -> None:
    """GIVEN a recorded angle that is one step off, CRC right WHEN replayed THEN what the ECU says differs."""
    place = places(messages, "ENCODERS")[200]

    def step(row: np.ndarray) -> None:
        row[DATA + 2] ^= 1

    other = [*messages[:place], changed(messages[place], step), *messages[place + 1 :]]
    result = replay(recording_of(other), image)
    assert not result.is_identical and result.first.tick >= 200
    assert not result.unusable  # no frame is missing


@pytest.mark.parametrize(("signal_name", "page", "same"), [("TickTime", 0, True), ("LateTicks", 0, False)])
def test_only_the_clocks_figures_may_differ(
    messages: Messages, image: bytes, signal_name: str, page: int, same: bool
) -> None:
    """GIVEN another figure in TIMING WHEN replayed THEN a time of a clock's does not count, a counter does."""
    timing = recording_of(messages)
    index = rows_of(timing, "TIMING")
    place = int(index[raw_signal(timing.rows[index], "TIMING", "TimingPage") == page][2])
    start = int(protocol.layout("TIMING", (signal_name,))[0, 0])

    def change(row: np.ndarray) -> None:
        row[DATA + start // 8] ^= 5

    other = [*messages[:place], changed(messages[place], change), *messages[place + 1 :]]
    assert replay(recording_of(other), image).is_identical == same
    # and a CRC that is wrong counts all the same
    spoiled = other[place]
    spoiled.data[0] ^= 1
    assert not replay(recording_of(other), image).is_identical


@pytest.mark.parametrize(("name", "column"), [("VALVES", "not_recorded"), ("HEARTBEAT_ECU", "not_recorded")])
def test_a_frame_that_is_not_there_is_found(messages: Messages, image: bytes, name: str, column: str) -> None:
    """GIVEN a frame of the ECU taken out WHEN replayed THEN it is counted as not recorded."""
    place = places(messages, name)[3]
    result = replay(recording_of([*messages[:place], *messages[place + 1 :]]), image)
    assert getattr(result.counts[name], column) == 1 and result.counts[name].wrong == 1


# ---- when frames were read -----------------------------------------------------------------------


def later(tick: int) -> Disturb:
    """The ECU reads the master's command of this tick one tick later."""
    held: list[np.ndarray] = []

    def disturb(now: int, heard: np.ndarray) -> np.ndarray:
        if now == tick:
            mine = heard[:, 1] == protocol.frame_id("MOTION") >> 8
            mine &= heard[:, 0] == protocol.frame_id("MOTION") & 0xFF
            held.append(heard[mine])
            assert len(held[0]) == 1
            return heard[~mine]
        return np.concatenate((held.pop(), heard)) if held else heard

    return disturb


@pytest.mark.parametrize("where", ["before VALVES", "after VALVES"])
def test_a_command_read_one_tick_later_is_no_difference(
    record_run: Callable[..., Messages], image: bytes, where: str
) -> None:
    """GIVEN a RUN request that was on the bus late in a tick, and that the ECU read in the next
    WHEN it was recorded before, or after, the valve frame of its tick THEN the replay is identical.
    """
    log = record_run(later(RUN_TICK))
    request = places(log, "MOTION")[0]
    motion = log.pop(request)
    valves = [k for k in places(log, "VALVES") if k < request][-1]  # of the tick before the ECU read it
    log.insert(valves + (where == "after VALVES"), motion)
    result = replay(recording_of(log), image)
    assert result.is_identical, result.first
    assert result.counts["VALVES"].compared == TICKS


def test_a_stop_by_a_signal_is_no_difference(record_run: Callable[..., Messages], image: bytes) -> None:
    """GIVEN an ECU whose program was told to end, and that shut the valves at last WHEN replayed
    THEN identical, and it is said what was taken over.
    """
    ecu = InprocEcu(image)

    def disturb(tick: int, heard: np.ndarray) -> np.ndarray:
        if tick == 250:
            ecu.request_safe_stop()
        return heard

    log = record_run(disturb, ecu)
    # the second signal comes in a tick that has just begun, as capture() leaves it
    shut = ecu.shutdown()
    sync = to_row(protocol.SYNC_ID, bytes((int(shut[0, DATA + 7]),)))
    log += [frame(row, log[-1].timestamp) for row in (sync, *shut)]
    result = replay(recording_of(log), image)
    assert result.is_identical, result.first
    assert any("told it to stop" in note for note in result.notes)
    modes = raw_signal(recording_of(log).rows[places(log, "VALVES")], "VALVES", "Mode")
    assert 6 in modes  # it did stop


def test_a_recorder_that_ends_in_a_tick_is_no_difference(messages: Messages, image: bytes) -> None:
    """GIVEN a recording cut at any frame of a tick WHEN replayed THEN identical as far as it goes."""
    last = places(messages, "SYNC")[-1]
    for end in range(last - 6, last + 5):
        result = replay(recording_of(messages[:end]), image)
        assert result.is_identical and not result.unusable, (end - last, result.first)


# ---- starts --------------------------------------------------------------------------------------


def test_several_starts_are_sections(messages: Messages, image: bytes) -> None:
    """GIVEN a recording that begins in the middle, then two starts of a new ECU WHEN replayed
    THEN two sections, and what is before is left out and said.
    """
    half = len(messages) // 2
    result = replay(recording_of([*messages[half:], *messages[: half // 2], *messages]), image)
    assert result.is_identical, result.first
    assert [s.by_reset for s in result.sections] == [False, False]
    assert result.sections[1].ticks == TICKS
    assert "before the first start" in result.notes[0]


def test_parameters_and_tare_do_not_leak_over_a_reset(record_run: Callable[..., Messages], image: bytes) -> None:
    """GIVEN NMT reset in RUN WHEN replayed THEN the ECU goes on as a second section, its last valve frame included."""

    def disturb(tick: int, heard: np.ndarray) -> np.ndarray:
        return np.concatenate((session.nmt_frame(session.NMT_RESET)[None], heard)) if tick == 200 else heard

    result = replay(recording_of(record_run(disturb)), image)
    assert result.is_identical, result.first
    assert [(s.ticks, s.by_reset) for s in result.sections] == [(201, False), (TICKS - 201, True)]


def test_what_sdo_changed_counts(record_run: Callable[..., Messages], image: bytes, machine: Machine) -> None:
    """GIVEN a gain written by SDO before RUN, read again after NMT reset, and the tick time read WHEN replayed
    THEN identical, also where a clock's figure was another; without the write it differs.
    """
    gain = "control.swing.k1_1_s"
    number = 0x2100 + [entry.name for entry in load_parameter_table().entries].index(gain)
    request = 0x600 + ECU_NODE

    def disturb(tick: int, heard: np.ndarray) -> np.ndarray:
        data = {
            40: struct.pack("<BHBf", 0x23, number, 0, 1.2 * machine[gain]),
            100: struct.pack("<BHB4x", 0x40, 0x2009, 0),
            300: struct.pack("<BHB4x", 0x40, number, 0),
        }.get(tick)
        extra = [to_row(request, data)] if data else []
        extra += [session.nmt_frame(session.NMT_RESET)] if tick == 200 else []
        return np.concatenate((np.array(extra, dtype=np.uint8), heard)) if extra else heard

    log = record_run(disturb)
    answers = [k for k, m in enumerate(log) if m.arbitration_id == SDO_ANSWER_ID]
    assert [log[k].data[0] & 0xE0 for k in answers] == [0x60, 0x40, 0x40]  # no abort
    assert struct.unpack("<f", bytes(log[answers[2]].data[4:]))[0] == pytest.approx(1.2 * machine[gain])
    log[answers[1]].data[4] ^= 0xFF  # a tick time
    result = replay(recording_of(log), image)
    assert result.is_identical, result.first
    assert result.counts["SDO answer"].compared == 3
    write = next(k for k, m in enumerate(log) if m.arbitration_id == request)
    other = replay(recording_of([*log[:write], *log[write + 1 :]]), image)
    assert other.counts["VALVES"].different > 0 and other.counts["SDO answer"].wrong > 0


def test_a_recording_without_start_says_what_it_needs(messages: Messages, image: bytes) -> None:
    """GIVEN a recording that begins in the middle WHEN replayed THEN refused, and the way to a start is named."""
    with pytest.raises(RecordingError, match=r"no start of the ECU .*NMT reset.*cansend vcan0 000#8101"):
        replay(recording_of(messages[100:]), image)
    with pytest.raises(RecordingError, match="no SYNC"):
        replay(recording_of([messages[k] for k in places(messages, "ENCODERS")]), image)


def test_another_dbc_is_refused(messages: Messages, image: bytes) -> None:
    """GIVEN frames of an ECU with another DBC WHEN replayed THEN both hashes are named."""
    timing = recording_of(messages)
    index = rows_of(timing, "TIMING")
    pages = index[raw_signal(timing.rows[index], "TIMING", "TimingPage") == 1]
    other = list(messages)

    def change(row: np.ndarray) -> None:
        row[DATA + 3] ^= 0xFF

    for place in pages:
        other[place] = changed(other[place], change)
    with pytest.raises(RecordingError, match=f"another DBC: hash [0-9A-F]{{8}}.*{protocol.dbc_hash():08X}"):
        replay(recording_of(other), image)


# ---- what the recorder lost ----------------------------------------------------------------------


def test_missing_ticks_do_not_look_like_another_law(messages: Messages, image: bytes) -> None:
    """GIVEN three ticks that the recorder lost WHEN replayed
    THEN what is before is compared and identical, and the recording is called unusable.
    """
    syncs = places(messages, "SYNC")
    result = replay(recording_of([*messages[: syncs[300]], *messages[syncs[303] :]]), image)
    assert result.is_identical and "3 ticks are missing" in result.unusable
    assert result.sections[0].ends_at_gap == 3 and result.counts["VALVES"].compared == 300


def test_a_second_ecu_is_not_called_lost_frames(messages: Messages, image: bytes) -> None:
    """GIVEN a SYNC that comes twice WHEN replayed THEN a second ECU is thought of."""
    place = places(messages, "SYNC")[300]
    result = replay(recording_of([*messages[:place], messages[place], *messages[place:]]), image)
    assert "second ECU" in result.unusable


def test_another_period_is_replayed(machine: Machine, image: bytes, paper: Scenario) -> None:
    """GIVEN an ECU at 2 ms WHEN its recording is replayed THEN with 2 ms, as it says itself."""
    short = session.make_session(machine, replace(paper, duration_s=0.3), "diarc", 1, 2e-3)
    result = replay(recording_of(capture(short, InprocEcu(image, 2000))), image)
    assert result.is_identical, result.first


def test_missing_sensor_frames_do_not_look_like_another_law(messages: Messages, image: bytes) -> None:
    """GIVEN sensor frames that the ECU had and the recorder has not WHEN replayed THEN the recorder is blamed."""
    lost = set(places(messages, "ENCODERS")[150:160])
    result = replay(recording_of([m for k, m in enumerate(messages) if k not in lost]), image)
    assert not result.is_identical and "the recorder lost" in result.unusable


# ---- files ---------------------------------------------------------------------------------------


def write(path: Path, messages: Messages) -> None:
    with can.Logger(str(path)) as writer:
        for message in messages:
            writer.on_message_received(message)


@pytest.mark.parametrize("suffix", [*FORMATS, ".log.gz"])
def test_no_format_changes_a_bit(messages: Messages, image: bytes, tmp_path: Path, suffix: str) -> None:
    """GIVEN a run, and frames that are not for the ECU WHEN written in each format and read back
    THEN the same frames in the same order, and an identical replay.
    """
    path = tmp_path / f"run{suffix}"
    alien = can.Message(timestamp=messages[50].timestamp, arbitration_id=0x18FF0001, data=b"\1", is_extended_id=True)
    write(path, [*messages[:50], alien, *messages[50:]])
    recording = read_recording(path)
    assert not recording.damage and recording.ignored == 1
    assert np.array_equal(recording.rows, recording_of(messages).rows)
    assert recording.duration_s == pytest.approx(messages[-1].timestamp, abs=1e-5)
    assert replay(recording, image).is_identical


@pytest.mark.parametrize("suffix", [".log", ".csv", ".asc", ".blf", ".log.gz"])
def test_a_truncated_file_says_how_far_it_goes(messages: Messages, image: bytes, tmp_path: Path, suffix: str) -> None:
    """GIVEN a file cut in the middle of a frame WHEN read THEN the frames before are there, and the damage is said."""
    path = tmp_path / f"run{suffix}"
    write(path, messages)
    data = path.read_bytes()
    path.write_bytes(data[: len(data) * 3 // 5])
    recording = read_recording(path)
    assert recording.damage
    assert 100 < len(recording.rows) < len(messages)
    assert np.array_equal(recording.rows, recording_of(messages).rows[: len(recording.rows)])
    assert replay(recording, image).is_identical


@pytest.mark.parametrize("suffix", [*FORMATS, ".log.gz"])
@pytest.mark.parametrize("content", [b"", b"no recording at all\n" * 30, bytes(range(256)) * 8])
def test_garbage_is_refused_in_one_line(tmp_path: Path, suffix: str, content: bytes) -> None:
    """GIVEN a file that is no recording WHEN read THEN one line that names it and what to do."""
    path = tmp_path / f"run{suffix}"
    path.write_bytes(content)
    with pytest.raises(RecordingError, match=r"no frame could be read.*record\.py") as error:
        read_recording(path)
    assert "\n" not in str(error.value) and str(path) in str(error.value)


def test_wrong_names_are_refused(tmp_path: Path) -> None:
    """GIVEN an unknown format, or no file WHEN read THEN one line says which there are, or that it is not there."""
    with pytest.raises(RecordingError, match=r"\.blf, \.asc, \.log, \.mf4, \.csv"):
        read_recording(tmp_path / "run.txt")
    with pytest.raises(RecordingError, match="No such file"):
        read_recording(tmp_path / "run.log")


def test_signals_are_those_of_the_dbc(messages: Messages) -> None:
    """GIVEN frames of every kind WHEN decoded as arrays THEN as cantools decodes them one by one."""
    recording = recording_of(messages)
    for name in ("ENCODERS", "PRESSURES_WRIST", "VALVES", "ESTIMATE"):
        message = protocol.database().get_message_by_name(name)
        index = rows_of(recording, name)[::7]
        decoded = [message.decode(bytes(messages[k].data), decode_choices=False) for k in index]
        for described in message.signals:
            expected = [values[described.name] for values in decoded]
            assert signal(recording.rows[index], name, described.name) == pytest.approx(expected, rel=1e-12, abs=0.0)


# ---- the command line ----------------------------------------------------------------------------


def tool(name: str) -> ModuleType:
    """A script of tools/ as a module; starting Python anew for each call would take most of the test."""
    spec = importlib.util.spec_from_file_location(f"tool_{name}", ROOT / "tools" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    path = sys.path[0]
    spec.loader.exec_module(module)
    sys.path[0] = path
    return module


def test_exit_status_and_texts(
    messages: Messages, image: bytes, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """GIVEN identical, different and unusable recordings WHEN given to replay.py
    THEN it exits with 0, 1 and 2, and says where the first difference is.
    """
    replay_py = tool("replay")

    def run(*arguments: object) -> subprocess.CompletedProcess:
        try:
            status = replay_py.main([str(argument) for argument in arguments])
        except SystemExit as end:
            status = end.code
        return subprocess.CompletedProcess(arguments, status, *capsys.readouterr())

    log, params = tmp_path / "run.log", tmp_path / "machine.params"
    write(log, messages)
    params.write_bytes(image)
    same = run(log, "--params", params)
    assert same.returncode == 0 and same.stdout.endswith("identical\n"), same.stderr
    fixed = run(log, "--params", params, "--scalar", "fixed")
    assert fixed.returncode == 1 and "identical with --scalar double" in fixed.stderr
    place = places(messages, "VALVES")[321]

    def flip(row: np.ndarray) -> None:
        row[DATA + 2] ^= 1

    write(log, [*messages[:place], changed(messages[place], flip), *messages[place + 1 :]])
    other = run(log, "--params", params)
    assert other.returncode == 1
    assert "section 1, tick 321 (0.321 s): VALVES SwingSpool" in other.stdout
    log.write_bytes(log.read_bytes()[:-5])
    damaged = run(log, "--params", params)
    assert damaged.returncode == 2
    assert "the last one; readable up to 0.400" in damaged.stderr and "different" in damaged.stderr
    for arguments, text in (
        ([tmp_path / "none.log"], "No such file"),
        ([log, "--params", tmp_path / "none.params"], "check the path"),
        ([log, "--params", log], "wrong size"),
        ([log, "--params", params, "--arm", "x.toml"], "leave --arm"),
        ([log, "--scalar", "quad"], "--help"),
    ):
        wrong = run(*arguments)
        assert wrong.returncode == 2 and text in wrong.stderr, wrong.stderr
        assert wrong.stderr.count("\n") == 1
