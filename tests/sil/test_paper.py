"""The report on the paper: nothing hidden, nothing missing, nothing loaded from elsewhere."""

from __future__ import annotations

import json
import re
from dataclasses import fields, replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from sil_plant.inputs.scenario import load_profile, load_scenario
from sil_plant.loop.results import Result
from sil_plant.reports import paper_figures
from sil_plant.reports import paper_report as report
from sil_plant.reports.paper_report import Bar, Report
from tools import paper

VOID = {"meta", "br", "img", "link", "hr", "input"}


@pytest.fixture(scope="module")
def made() -> Report:
    extent = paper.Extent(seeds=(1,), few_seeds=(), loads_kg=(2.5,), checks=1, parts=("paper", "realistic", "check"))
    return paper.run_all(extent, workers=1)


@pytest.fixture(scope="module")
def folder(made: Report, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("paper") / "new" / "folder"
    paper.write(made, path)
    return path


def page_of(made: Report) -> str:
    return report.page(made, {})


class Reader(HTMLParser):
    """Collects attributes and checks that every element is closed where it was opened."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.attributes: list[tuple[str, str]] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in VOID:
            self.open.append(tag)
        self.attributes += [(name, value or "") for name, value in attrs]

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.attributes += [(name, value or "") for name, value in attrs]

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag, f"</{tag}> at {self.getpos()}"


# ---- the files -------------------------------------------------------------------------------------


def test_page_does_not_need_a_network_or_a_file_beside_it(folder: Path) -> None:
    text = (folder / "report.html").read_text(encoding="utf-8")
    reader = Reader()
    reader.feed(text)
    assert not reader.open
    outside = [(n, v) for n, v in reader.attributes if n in ("src", "href", "xlink:href") and not v.startswith("#")]
    assert outside == []
    assert not re.search(r"@import|url\((?!#)|<script|<link|https?://", text)
    assert text.startswith("<!DOCTYPE html>")


def test_no_two_pictures_on_the_page_share_an_identifier(folder: Path) -> None:
    reader = Reader()
    reader.feed((folder / "report.html").read_text(encoding="utf-8"))
    names = [value for name, value in reader.attributes if name == "id"]
    assert len(names) > 100
    assert len(names) == len(set(names))
    used = {v[1:] for n, v in reader.attributes if n == "href"}
    used |= {m for _, v in reader.attributes for m in re.findall(r"url\(#([^)]+)\)", v)}
    assert used <= set(names)


def test_json_does_not_lack_or_rename_keys_of_run_py(folder: Path) -> None:
    runs = json.loads((folder / "report.json").read_text(encoding="utf-8"))
    expected = [f.name for f in fields(Result)] + ["profile", "group", "bar"]
    assert [list(run) for run in runs] == [expected] * len(runs)
    assert {run["group"] for run in runs} == {"commission", "load", "tracking", "change", "check"}
    for run in runs:
        for bar in run["bar"]:
            assert set(bar) == {"name", "unit", "value", "least", "most", "met"}


def test_no_picture_of_the_paper_is_missing(folder: Path) -> None:
    names = {path.name for path in folder.glob("*.png")}
    assert {"fig5.png", "fig6.png", "fig7.png", "fig8.png", "overview.png"} <= names


def test_same_runs_do_not_make_another_page(made: Report, folder: Path) -> None:
    text = (folder / "report.html").read_text(encoding="utf-8")
    assert report.page(made, paper.draw(made)) == text


def test_no_figure_of_ours_is_without_the_papers(made: Report) -> None:
    text = page_of(made)
    for printed in ("56.3 %", "60.0 %", "-0.55 to 0.55", "-1 to 0.6", "-0.3 to 0.4", "0.004 kg"):
        assert printed in text


# ---- the bars --------------------------------------------------------------------------------------


def with_bar(made: Report, bar: Bar) -> Report:
    """The report with every bar of this name in the group load replaced."""
    cases = [
        replace(c, bars=tuple(bar if b.name == bar.name else b for b in c.bars)) if c.group == "load" else c
        for c in made.cases
    ]
    return replace(made, cases=tuple(cases))


def test_bar_that_is_not_met_is_not_hidden(made: Report) -> None:
    good = with_bar(made, Bar(report.LOAD_ERROR, "kg", 0.0012, most=0.003))
    bad = with_bar(made, Bar(report.LOAD_ERROR, "kg", 0.1234, most=0.003))
    assert page_of(bad).count('class="unmet"') > page_of(good).count('class="unmet"')
    assert '<td class="unmet">0.123 kg</td>' in page_of(bad)
    assert re.search(r"\.unmet \{ color: #c62828", page_of(bad))
    met = [int(report.summary_line(report.verdicts(r.cases)).split()[0]) for r in (good, bad)]
    assert met[1] < met[0]
    assert "**0.123 kg, not met**" in report.readme_section(bad)


def test_estimate_that_never_settles_does_not_count_as_settled(made: Report) -> None:
    never = Bar(report.SETTLE, "s", None, most=0.25)
    assert not never.met
    assert '<td class="unmet">never</td>' in page_of(with_bar(made, never))
    assert json.loads(report.to_json(with_bar(made, never).cases))


@pytest.mark.parametrize(
    ("bar", "met"),
    [
        (Bar("", "", 0.01, 0.01, 0.1), True),
        (Bar("", "", 0.0099, 0.01, 0.1), False),
        (Bar("", "", 0.11, 0.01, 0.1), False),
        (Bar("", "", 0.0, most=0.0), True),
        (Bar("", "", 1.0, most=0.0), False),
        (Bar("", "", 55.9, least=56.0), False),
    ],
)
def test_no_limit_is_taken_for_its_opposite(bar: Bar, met: bool) -> None:
    assert bar.met is met


def test_worst_run_is_not_hidden_by_the_others(made: Report) -> None:
    cases = [c for c in made.cases if c.group == "load" and c.profile == "paper"]
    one, other = (
        replace(cases[0], bars=(Bar(report.LOAD_ERROR, "kg", value, most=0.003),)) for value in (0.001, 0.0031)
    )
    (verdict,) = report.verdicts([other, one])
    assert (verdict.worst.value, verdict.met_runs, verdict.runs, verdict.met) == (0.0031, 1, 2, False)


def test_run_without_compensation_does_not_go_uncompared(made: Report) -> None:
    (case,) = made.of("tracking", "paper", controller="diarc-noload")
    bar = report.bar_of(case, report.WRIST_BETTER)
    assert bar is not None
    assert bar.value is not None and 0.0 < bar.value < 100.0


def test_fault_does_not_pass_unnoticed(made: Report) -> None:
    case = next(c for c in made.cases if c.group == "load")
    names = [b.name for b in paper.bars_of(case, None, faulted=True)]
    assert names == [report.FAULTS]


# ---- the plan --------------------------------------------------------------------------------------


def test_no_effect_of_the_realistic_plant_is_left_out_of_the_table() -> None:
    profiles = [load_profile(name) for name in ("paper", "realistic")]
    single = paper.ablation_profiles(*profiles)
    covered = {key for p in single[:-1] for key in (*p.machine, *p.effects)}
    assert covered >= (set(profiles[1].machine) | set(profiles[1].effects)) - {paper.SENSOR_SET}
    more = replace(profiles[1], effects=profiles[1].effects | {"effects.new": 1.0})
    with pytest.raises(paper.ConfigError, match=r"effects\.new"):
        paper.ablation_profiles(profiles[0], more)


def test_missing_second_machine_does_not_stop_the_report_or_go_unsaid(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    gone = replace(paper.SECOND, path=paper.ROOT / "sil_plant" / "arms" / "not-there.toml")
    monkeypatch.setattr(paper, "SECOND", gone)
    made = paper.run_all(paper.Extent(parts=("second",)), workers=1)
    assert made.cases == ()
    assert "not-there.toml" in report.page(made, paper.draw(made))


def test_hold_out_does_not_change_or_repeat_a_seed_of_tuning() -> None:
    first, second = (paper.plan(paper.Extent(parts=("check",), checks=3)) for _ in range(2))
    for job, again in zip(first, second, strict=True):
        case, same = job.operations[0].scenario, again.operations[0].scenario
        assert (job.plant, job.seed, case.segments, case.load) == (again.plant, again.seed, same.segments, same.load)
    assert all(job.seed not in paper.SEEDS and job.operations[0].seed > 100 for job in first)


@pytest.mark.parametrize(("time_s", "expected"), [(4.0, 4.0), (7.0, 7.0), (7.7, 8.0), (1.6, 2.0), (9.6, None)])
def test_time_after_a_changed_load_does_not_count_rest(time_s: float, expected: float | None) -> None:
    assert paper.first_motion(load_scenario(paper.CHANGE_SCENARIO), time_s) == expected


# ---- drawing and README ----------------------------------------------------------------------------


def test_thinned_line_does_not_lose_its_peaks() -> None:
    time_s = np.linspace(0.0, 10.0, 10_101)
    values = np.zeros_like(time_s)
    values[[1234, 7777]] = 5.0, -3.0
    thin_time, thin_values = paper_figures.thin(time_s, values)
    assert thin_values.size <= paper_figures.POINTS_MOST
    assert (thin_values.max(), thin_values.min()) == (5.0, -3.0)
    assert np.all(np.diff(thin_time) > 0.0)


def test_other_text_of_the_readme_is_not_lost() -> None:
    begin, end = report.MARKERS
    old = f"# Title\n\nbefore\n\n{begin}\nold\n{end}\n\nafter\n"
    new = report.replace_section(old, "new")
    assert new == f"# Title\n\nbefore\n\n{begin}\nnew\n{end}\n\nafter\n"
    assert report.replace_section(new, "new") == new
    assert report.replace_section("# Title\n", "new") == f"# Title\n\n{begin}\nnew\n{end}\n"
