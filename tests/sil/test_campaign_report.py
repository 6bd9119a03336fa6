"""Reports of campaigns: the statistics are right, and the page has its parts."""

from __future__ import annotations

import re
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from sil_plant.campaigning import statistics
from sil_plant.campaigning.results import schema
from sil_plant.campaigning.sampling import arms
from sil_plant.campaigning.spec import Campaign, load_campaign
from sil_plant.reports import campaign_report as report
from tests.sil.campaign_specs import VARY_LOAD_AND_BORE

SPEC = """name = "made up"
runs = {runs}
sampling = "{sampling}"
[limits]
load_err_kg = 0.02
{vary}[[vary]]
key = "wrist.coulomb_Nm"
distribution = "uniform"
relative = true
low = 0.5
high = 1.5
"""
Made = Callable[..., tuple[Campaign, pa.Table]]


@pytest.fixture
def made(tmp_path: Path) -> Made:
    """Rows of a campaign whose errors are known: the load's by a formula, the others by chance."""

    def make(runs: int, sampling: str = "latin-hypercube", failed: int = 0) -> tuple[Campaign, pa.Table]:
        path = tmp_path / "made.toml"
        path.write_text(SPEC.format(runs=runs, sampling=sampling, vary=VARY_LOAD_AND_BORE), encoding="utf-8")
        campaign = load_campaign(path)
        chance = np.random.default_rng(7)
        rows = []
        for n, arm in enumerate(arms(campaign)):
            row = dict.fromkeys(schema(campaign).names)
            row |= {"run": arm.run, "seed": arm.seed, "faults": "", "status": "ok", "reason": "", "faulted": False}
            row |= arm.draws
            if n < failed:
                row |= {"status": "commissioning faulted", "faulted": True, "reason": "it broke"}
                rows.append(row)
                continue
            bore = (arm.draws["wrist.bore_m"] / 0.025 - 1.0) / 0.001
            error = 0.01 * bore + 0.02 * ((arm.draws["load_kg"] / 5.0 - 1.0) ** 2 - 1.0 / 3.0)
            row |= {"load_true_kg": arm.draws["load_kg"], "load_est_kg": 0.0, "load_err_kg": error}
            row["load_settle_s"] = None if n == failed else float(chance.uniform(0.1, 0.3))
            for name in row:
                if name.endswith("_rad"):
                    row[name] = float(chance.uniform(1e-5, 1e-4))
            rows.append(row)
        return campaign, pa.Table.from_pylist(rows, schema(campaign))

    return make


def test_share_is_surer_than_its_runs_allow() -> None:
    none = statistics.share(0, 1000)
    assert none.low == 0.0 and none.high == pytest.approx(1.0 - 0.025 ** (1 / 1000), rel=1e-9)
    half = statistics.share(50, 100)
    assert half.low == pytest.approx(0.3983, abs=1e-4) and half.high == pytest.approx(0.6017, abs=1e-4)


def test_interval_of_a_quantile_misses_the_truth() -> None:
    chance = np.random.default_rng(3)
    inside = 0
    for _ in range(40):
        q = statistics.quantile(chance.uniform(0.0, 1.0, 400), 0.95)
        assert q is not None and q.low <= q.value <= q.high
        inside += q.low <= 0.95 <= q.high
    assert inside >= 33  # 38 expected
    assert statistics.quantile(np.ones(99), 0.95) is None  # too few beyond it
    never = np.concatenate([np.ones(90), np.full(10, np.inf)])
    assert statistics.quantile(never, 0.95).value == np.inf


def test_cause_of_an_error_is_not_found(made: Made) -> None:
    campaign, table = made(512)
    found = statistics.drivers(campaign, table, "load_err_kg")
    by_name = {d.variable: d for d in found.drivers}
    # variances: bore 1e-4; load 4e-4 * Var(x^2) for x uniform in -1..1, which is 4/45
    total = 1e-4 + 4e-4 * 4.0 / 45.0
    assert by_name["wrist.bore_m"].index == pytest.approx(1e-4 / total, abs=0.08)
    assert by_name["load_kg"].index == pytest.approx(4e-4 * 4.0 / 45.0 / total, abs=0.08)
    assert by_name["load_kg"].index > found.chance_index > by_name["wrist.coulomb_Nm"].index
    assert by_name["wrist.bore_m"].rank_correlation > 0.6 > found.chance_correlation
    assert abs(by_name["wrist.coulomb_Nm"].rank_correlation) < found.chance_correlation
    noise = statistics.drivers(campaign, table, "wrist_peak_err_after_1s_rad")
    assert all(d.index < 0.2 for d in noise.drivers)


def test_total_indices_are_wrong(made: Made) -> None:
    campaign, table = made(512, "saltelli")
    assert table.num_rows == 512 * (3 + 2)
    found = statistics.drivers(campaign, table, "load_err_kg")
    by_name = {d.variable: d for d in found.drivers}
    total = 1e-4 + 4e-4 * 4.0 / 45.0
    for name, share in (("wrist.bore_m", 1e-4 / total), ("load_kg", 1.0 - 1e-4 / total), ("wrist.coulomb_Nm", 0.0)):
        assert by_name[name].index == pytest.approx(share, abs=0.08)
        assert by_name[name].total == pytest.approx(share, abs=0.08)


class Page(HTMLParser):
    """What a page has."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.ids: list[str] = []
        self.text = ""
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list) -> None:
        self.tags.append(tag)
        self.ids += [value for name, value in attrs if name == "id"]

    def handle_data(self, data: str) -> None:
        self.text += data


def test_report_lacks_a_part_or_needs_another_file(made: Made) -> None:
    campaign, table = made(256, failed=2)
    summary = statistics.summary(campaign, table, 260)
    assert summary.worst[:2] == (1, 2)  # what failed comes first
    assert summary.statuses["ok"].count == 254 and summary.statuses["commissioning faulted"].count == 2
    load = next(f for f in summary.figures if f.name == "load_err_kg")
    assert load.within is not None and load.within.of == 256  # arms that failed are not within
    settle = next(f for f in summary.figures if f.name == "load_settle_s")
    assert settle.worst == np.inf
    drawn = dict.fromkeys(summary.worst, "<svg></svg>")
    rerun = [report.rerun_command(campaign, run) for run in summary.worst]
    inputs = report.Made(
        campaign, table, summary, drawn, "c0de", ("Missing: runs 1 to 4.",), "python tools/campaign.py X"
    )
    page = Page(report.page(inputs, rerun))
    text = report.page(inputs, rerun)
    assert not re.search(r"@import|url\((?!#)|<script|<link|https?://", text)
    assert len(page.ids) == len(set(page.ids))
    assert page.tags.count("svg") == 2 + len(summary.drivers) + 10
    for part in (
        "254 of 256 arms ended well",
        "Missing: runs 1 to 4.",
        "What drives the errors",
        "The worst 10",
        "it broke",
        "--rerun 1",
        "made up",
        campaign.spec_hash,
    ):
        assert part in page.text, part
    assert "never" in page.text


def test_readme_table_has_a_row_too_few(made: Made) -> None:
    campaign, table = made(256, failed=1)
    text = report.readme_table(statistics.summary(campaign, table, 256))
    rows = text.splitlines()
    assert len(rows) == 4 and len({row.count("|") for row in rows}) == 1
    assert "99.6 %" in rows[2] and "≤ 0.02" in rows[3]


def test_percent_rounds_a_failure_away() -> None:
    assert report.percent(1.0) == "100 %" and report.percent(0.0) == "0 %"
    assert report.percent(0.99996) != "100 %"
