"""The report on a recording: what would make it wrong, need a network, or fail on a bad file."""

from __future__ import annotations

import gzip
import importlib.util
import re
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from sil_plant.bus import protocol
from sil_plant.recordings.recording import Recording, read_recording
from sil_plant.reports.recording_report import Series, changes, contents_of, emergencies, page, summary_rows, thin

ROOT = Path(__file__).resolve().parents[2]
REFERENCE = ROOT / "tests" / "sil" / "data" / "reference.log.gz"
TRACES = (
    "Joint angles", "Tracking errors", "Load at the tip", "Chamber pressures", "Spools", "Modes", "Time of a tick",
    "From SYNC to SYNC", "Lost and refused",
)  # fmt: skip


@pytest.fixture(scope="module")
def recording() -> Recording:
    """The committed one: 1.3 s, one lost frame, an NMT reset."""
    return read_recording(REFERENCE)


@pytest.fixture
def report(capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str, str]]:
    """Call report.py: its exit status and what it said."""
    spec = importlib.util.spec_from_file_location("tool_report", ROOT / "tools" / "report.py")
    module = importlib.util.module_from_spec(spec)
    path = sys.path[0]
    spec.loader.exec_module(module)
    sys.path[0] = path

    def call(*arguments: object) -> tuple[int, str, str]:
        try:
            status = module.main([str(argument) for argument in arguments])
        except SystemExit as end:
            status = end.code
        return status, *capsys.readouterr()

    return call


def test_the_page_needs_no_network(report, tmp_path: Path) -> None:
    """GIVEN a recording WHEN reported THEN one page with every trace that loads nothing, and not too large."""
    path = tmp_path / "r.html"
    status, out, err = report(REFERENCE, "-o", path)
    assert (status, out, err) == (0, f"written: {path}\n", "")
    text = path.read_text("utf-8")
    assert not re.findall(r"<(?:script|link|img|iframe)[^>]*(?:src|href)=", text)
    assert [title for title in TRACES if f"<h3>{title}</h3>" not in text] == []
    assert text.count('<div class="plot">') == len(TRACES)
    assert len(text) < 3_000_000
    assert "m_t" in text and "beta_inverse" in text
    assert "Emergency messages" not in text and "<h3>Faults</h3>" not in text  # it had none


def test_figures_are_those_of_the_frames(recording: Recording) -> None:
    """GIVEN the committed recording WHEN summarised
    THEN load, loss and starts are what a frame-by-frame reading gives.
    """
    rows = dict(summary_rows(contents_of(recording)))
    message = protocol.database().get_message_by_name("ESTIMATE")
    data = [row[5:13].tobytes() for row in recording.rows[recording.ids == message.frame_id]]
    last = message.decode(data[-1])
    assert rows["load estimate at the end"].startswith(f"{last['Load']:.3f} kg")
    assert rows["ticks"] == "1301 of 1 ms; 0 missing in the recording"
    assert rows["starts of the ECU"] == "2, at 0.000, 1.151 s"
    assert "LostFrames 1," in rows["counted by the ECU"]
    assert rows["faults"] == "none" and "RUN" in rows["modes"]
    assert rows["DBC"].startswith("as diarc.dbc")


def test_faults_are_shown(recording: Recording) -> None:
    """GIVEN an emergency message in it WHEN reported THEN the fault is named, in table, timeline and summary."""
    emergency = np.zeros(16, dtype=np.uint8)
    emergency[:13] = [0x81, 0, 0, 0, 8, 0x00, 0x81, 0x11, 1, 2, 0, 0, 0]
    rows = np.insert(recording.rows, 3000, emergency, axis=0)
    time_s = np.insert(recording.time_s, 3000, recording.time_s[3000])
    contents = contents_of(Recording(recording.path, time_s, rows))
    assert [(e.code, e.fault) for e in emergencies(contents)] == [(0x8100, "SENSOR_FRAMES_LOST")]
    text = page(contents)
    assert "<h3>Faults</h3>" in text and "<h2>Emergency messages</h2>" in text
    assert dict(summary_rows(contents))["faults"] == "SENSOR_FRAMES_LOST"


def test_thinning_loses_no_peak() -> None:
    """GIVEN a long trace with single peaks WHEN thinned THEN few points, in order, the peaks among them."""
    rng = np.random.default_rng(1)
    value = rng.normal(size=100_003)
    value[[7, 54_321, 100_002]] = (50.0, -60.0, 70.0)
    series = Series(np.arange(100_003) * 1e-3, value)
    found = thin(series, 1000)
    assert len(found.value) <= 1200
    assert (np.diff(found.time_s) > 0.0).all()
    assert {50.0, -60.0, 70.0} <= set(found.value.tolist())
    assert thin(series, 200_000) is series


def test_states_keep_when_they_changed() -> None:
    """GIVEN a state over time WHEN reduced THEN its changes and its end are left."""
    found = changes(Series(np.arange(6.0), np.array([1.0, 1.0, 2.0, 2.0, 1.0, 1.0])))
    assert found.time_s.tolist() == [0.0, 2.0, 4.0, 5.0]


def test_a_damaged_recording_is_reported_as_far_as_it_goes(report, tmp_path: Path) -> None:
    """GIVEN a cut file WHEN reported THEN status 1, and page and message say that it is damaged."""
    path = tmp_path / "cut.log"
    path.write_bytes(gzip.decompress(REFERENCE.read_bytes())[:100_001])
    status, out, err = report(path)
    assert status == 1 and out == f"written: {tmp_path / 'cut.html'}\n"
    assert "is damaged" in err and "frames" in err
    assert "The file is damaged" in (tmp_path / "cut.html").read_text("utf-8")


def test_what_is_no_recording_is_refused_in_one_line(report, tmp_path: Path) -> None:
    """GIVEN nothing, garbage, a bus without ECU, or times outside WHEN reported THEN status 2 and no page."""
    garbage, silent = tmp_path / "garbage.blf", tmp_path / "silent.log"
    garbage.write_bytes(bytes(range(256)))
    silent.write_text("(1.0) vcan0 182#0011223344556677 R\n")
    for arguments, text in (
        ([tmp_path / "none.log"], "No such file"),
        ([garbage], "no frame could be read"),
        ([silent], "no SYNC"),
        ([REFERENCE, "-o", tmp_path / "p.html", "--from", 100], "nothing is between"),
        ([REFERENCE, "-o", tmp_path / "no" / "p.html"], "folder"),
    ):
        status, out, err = report(*arguments)
        assert status == 2 and text in err and err.count("\n") == 1 and not out, err
    assert not list(tmp_path.glob("*.html"))
