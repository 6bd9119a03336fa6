"""The report of a campaign: one HTML file that needs no other, and the README's table."""

from __future__ import annotations

import math
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np
import pyarrow as pa

from sil_plant.campaigning.arm_run import ArmRun, run_arm
from sil_plant.campaigning.sampling import Arm
from sil_plant.campaigning.spec import FIGURES, Base, Campaign, Variable
from sil_plant.campaigning.statistics import CONFIDENCE, Drivers, Figure, Quantile, Share, Summary
from sil_plant.loop.execution import PERIOD_US
from sil_plant.reports import campaign_figures
from sil_plant.reports.figures import Trace, trace_of
from sil_plant.reports.paper_figures import svg
from sil_plant.reports.paper_report import STYLE_SHEET, Cell, commands, figure_html, number, paragraph, table

DRIVERS_TABLED = 8


@dataclass(frozen=True)
class Made:
    """What the report is made of.

    Attributes
    ----------
    campaign : Campaign
        The spec.
    rows : pa.Table
        Its results.
    summary : Summary
        What they say.
    worst : dict
        Picture of each of the worst runs, as SVG, by run; empty where the run has no trace.
    code : str
        Hash of the code.
    notes : tuple of str
        What a reader has to know: batches left out, samples that are not balanced.
    command : str
        What makes this report.
    """

    campaign: Campaign
    rows: pa.Table
    summary: Summary
    worst: Mapping[int, str]
    code: str
    notes: tuple[str, ...]
    command: str


def trace_of_run(run: ArmRun) -> Trace | None:
    """The trace of an arm's operation, where there was one."""
    if run.operation is None:
        return None
    session = run.operation.session
    timeline = session.timeline
    return trace_of(session.record, PERIOD_US * 1e-6, timeline.motion, run.operation.result.ticks)


def worst_picture(base: Base, arm: Arm) -> str:
    """The picture of one of the worst runs, made anew; with its trace."""
    trace = trace_of_run(run_arm(base, arm))
    return "" if trace is None else svg(campaign_figures.run(trace), f"run{arm.run}")


def pictures(made: Made) -> dict[str, Any]:
    """Every picture but those of the worst runs, by name."""
    found: dict[str, Any] = {}
    error = made.rows["load_err_kg"].to_numpy(zero_copy_only=False).astype(np.float64)
    load = made.rows["load_true_kg"].to_numpy(zero_copy_only=False).astype(np.float64)
    there = np.isfinite(error)
    if there.any():
        limit = made.campaign.limits.get("load_err_kg")
        found["load"] = campaign_figures.load_errors(load[there], error[there], limit)
    if made.summary.figures:
        found["shares"] = campaign_figures.shares(made.summary.figures)
    for one in made.summary.drivers:
        found[one.figure] = campaign_figures.drivers(one)
    return found


# ---- texts -----------------------------------------------------------------------------------------


def percent(value: float, digits: int = 3) -> str:
    """A share for people; never 0 or 100 where it is not."""
    shown = f"{100.0 * value:.{digits}g}"
    if (float(shown) == 100.0 and value < 1.0) or (float(shown) == 0.0 and value > 0.0):
        shown = f"{100.0 * value:.{digits + 2}g}"
    return f"{shown} %"


def share_text(one: Share) -> str:
    """A share with its interval."""
    return f"{one.count} of {one.of}: {percent(one.count / max(one.of, 1))} ({percent(one.low)} to {percent(one.high)})"


def value_text(value: float, name: str) -> str:
    """A figure for people, without its unit."""
    return "never" if math.isinf(value) else number(value * FIGURES[name][2])


def quantile_text(one: Quantile | None, name: str) -> str:
    """A quantile with its interval."""
    if one is None:
        return "-"
    return f"{value_text(one.value, name)} ({value_text(one.low, name)} to {value_text(one.high, name)})"


def quantile_of(figure: Figure, at: float) -> Quantile | None:
    """A quantile that may be missing."""
    return next((q for q in figure.quantiles if q.at == at), None)


def rerun_command(campaign: Campaign, run: int, planned: int | None = None) -> str:
    """The command that makes one run again; with the number of runs where it is not the spec's."""
    runs = "" if planned is None else f" --runs {planned}"
    return f"python tools/campaign.py {shlex.quote(str(campaign.path))}{runs} --rerun {run}"


# ---- the page --------------------------------------------------------------------------------------


def page(made: Made, rerun: Sequence[str]) -> str:
    """The report as HTML.

    Parameters
    ----------
    made : Made
        What it tells.
    rerun : list of str
        The command for each of the worst runs.
    """
    campaign, summary = made.campaign, made.summary
    drawn = pictures(made)
    parts = [
        f"<h1>Campaign {escape(campaign.name)}</h1>",
        *([paragraph(campaign.text)] if campaign.text else []),
        f'<p class="summary">{escape(headline(summary))}</p>',
        *(f'<p class="note">{escape(note)}</p>' for note in made.notes),
        paragraph(
            f"In brackets: {100 * CONFIDENCE:.0f} % confidence, by Clopper and Pearson for shares, by bootstrap for "
            "quantiles."
        ),
        figures_table(summary),
        *_drawn(drawn, "load", "Load errors of all arms that were operated. Red: the limit."),
        *_drawn(drawn, "shares", "Which share of the arms is at most so far off. Red: the limit of the spec."),
        "<h2>How the arms ended</h2>",
        ends_table(summary),
        *_drivers_section(made, drawn),
        *_worst_section(made, rerun),
        *_spec_section(made),
    ]
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>Campaign {escape(campaign.name)}</title>\n<style>{STYLE_SHEET}</style>\n</head>\n<body>\n"
        + "\n".join(parts)
        + "\n</body>\n</html>\n"
    )


def headline(summary: Summary) -> str:
    """The campaign in one sentence."""
    ok = summary.statuses["ok"]
    return (
        f"{ok.count} of {ok.of} arms ended well: {percent(ok.count / max(ok.of, 1))} "
        f"({percent(ok.low)} to {percent(ok.high)})."
    )


def figures_table(summary: Summary) -> str:
    """Quantiles of every figure."""
    rows = []
    for one in summary.figures:
        text, unit, factor = FIGURES[one.name]
        within: str | Cell = "-"
        if one.within is not None:
            within = Cell(share_text(one.within), one.within.count == one.within.of)
        rows.append(
            [
                f"{text}, {unit}",
                *(quantile_text(quantile_of(one, at), one.name) for at in (0.5, 0.95, 0.99)),
                f"{value_text(one.worst, one.name)} (run {one.worst_run})",
                "-" if one.limit is None else f"{one.limit * factor:g}",
                within,
            ]
        )
    return table(["figure", "median", "95 % of arms below", "99 % below", "worst", "limit", "arms within"], rows)


def ends_table(summary: Summary) -> str:
    """How the arms ended, and which emergencies of the ECU were heard; not every one ends a run."""
    rows = [[name, share_text(one)] for name, one in summary.statuses.items()]
    rows += [[f"emergency {name} heard", share_text(one)] for name, one in summary.faults.items()]
    return table(["arms", "how many"], rows)


def _drawn(drawn: Mapping[str, Any], name: str, caption: str) -> list[str]:
    return [figure_html(drawn[name], name, caption)] if name in drawn else []


def _drivers_section(made: Made, drawn: Mapping[str, Any]) -> list[str]:
    if not made.summary.drivers:
        return []
    saltelli = made.campaign.sampling == "saltelli"
    how = (
        "Sobol indices are Saltelli's, first order and total, from the sample made for them (SALib)."
        if saltelli
        else "First-order Sobol indices are estimated from these same runs by RBD-FAST (SALib), which asks for "
        "independent variables and no special sample; it gives no total indices: the sampling saltelli does."
    )
    parts = [
        "<h2>What drives the errors</h2>",
        paragraph(
            "The Sobol index is the share of a figure’s variance that goes with one variable alone, in whatever shape; "
            f"Spearman’s rank correlation says which way, where it goes one way. {how} Red dashes: what chance gives "
            "(correlations: 5 % for all variables together; indices: the greatest of "
            "any variable with the figure shuffled). The load error counts with its sign, for what pushes it up pushes "
            "it down on other arms."
        ),
    ]
    for one in made.summary.drivers:
        text = FIGURES[one.figure][0]
        parts += [f"<h3>{escape(text[0].upper() + text[1:])}</h3>"]
        parts += _drawn(drawn, one.figure, f"{one.runs} arms.")
        parts += [drivers_table(one)]
    return parts


def drivers_table(one: Drivers) -> str:
    """The greatest drivers in numbers."""
    with_total = one.drivers[0].total is not None
    rows = []
    for d in one.drivers[:DRIVERS_TABLED]:
        seen = abs(d.rank_correlation) > one.chance_correlation or d.index > one.chance_index
        total = [f"{d.total:.3f}"] if d.total is not None else []
        rows.append(
            [
                d.variable,
                f"{d.index:.3f} ± {d.index_half_width:.3f}",
                *total,
                f"{d.rank_correlation:+.3f}",
                "yes" if seen else "no",
            ]
        )
    chance = 0.0 if math.isnan(one.chance_index) else one.chance_index
    explained = sum(d.index for d in one.drivers if d.index > chance)
    head = ["variable", "Sobol index", *(["total index"] if with_total else []), "rank correlation", "beyond chance"]
    return table(head, rows) + paragraph(
        f"First-order indices beyond chance, together: {explained:.2f}; the rest is small variables, variables that "
        "act together, and noise."
    )


def _worst_section(made: Made, rerun: Sequence[str]) -> list[str]:
    what = FIGURES[made.campaign.worst_by][0]
    parts = [
        f"<h2>The worst {len(made.summary.worst)}</h2>",
        paragraph(f"Arms that did not end well first, then by {what}. The command prints the figures of the run anew."),
    ]
    place = {run: n for n, run in enumerate(made.rows["run"].to_pylist())}
    for run, command in zip(made.summary.worst, rerun, strict=True):
        row = {name: made.rows[name][place[run]].as_py() for name in made.rows.column_names}
        parts += [
            f"<h3>Run {run}: {escape(row['status'])}</h3>",
            paragraph(run_text(row)),
            *([f"<figure>{made.worst[run]}</figure>"] if made.worst.get(run) else []),
            commands(command),
        ]
    return parts


def run_text(row: Mapping[str, Any]) -> str:
    """The figures of one run."""
    if row["load_err_kg"] is None:
        return f"{row['reason']}."
    settle = row["load_settle_s"]

    def mrad(name: str) -> str:
        both = (row[f"{joint}_{name}_rad"] for joint in ("swing", "wrist"))
        return " / ".join("-" if value is None else number(1e3 * value) for value in both)

    parts = [
        f"load {row['load_true_kg']:.3f} kg, error {row['load_err_kg']:+.4f} kg",
        "never within 0.1 kg" if settle is None else f"within 0.1 kg after {settle:.3f} s",
        f"errors swing / wrist, mrad: peak {mrad('peak_err')}, after 1 s {mrad('peak_err_after_1s')}, "
        f"rms {mrad('rms_err')}",
    ]
    if row["faults"]:
        parts.append(f"emergencies: {row['faults']}")
    if row["reason"]:
        parts.append(row["reason"])
    return "; ".join(parts) + "."


def _spec_section(made: Made) -> list[str]:
    campaign = made.campaign
    base = campaign.base
    rows = [
        ["arm", f"{base.machine.name}, profile {base.profile.name}, controller {base.controller}"],
        ["scenario", base.scenario.name],
        [
            "commissioned",
            "no" if base.commission_scenario is None else f"yes, each, by {base.commission_scenario.name}",
        ],
        ["sample", f"{campaign.sampling}, {campaign.runs} points in {len(campaign.random)} dimensions"],
        ["seed", str(campaign.seed)],
        ["spec", campaign.spec_hash],
        ["code", made.code],
    ]
    return [
        "<h2>What was run</h2>",
        table(["", ""], rows),
        commands(made.command),
        table(
            ["variable", "distribution", "from", "to", "without the campaign"],
            [_variable_row(variable) for variable in campaign.variables],
        ),
    ]


def _variable_row(variable: Variable) -> list[str]:
    low, high = variable.distribution.support
    keys = "" if variable.keys == (variable.label,) else f": {', '.join(variable.keys)}"
    if variable.nominal is None:
        return [variable.label + keys, variable.distribution.text(), f"{low:.5g}", f"{high:.5g}", "-"]
    if len(variable.keys) > 1:
        return [variable.label + keys, f"factor, {variable.distribution.text()}", f"{low:.5g}", f"{high:.5g}", "1"]
    nominal = variable.nominal[0]
    ends = sorted((low * nominal, high * nominal))
    return [
        variable.label + keys,
        f"factor, {variable.distribution.text()}",
        f"{ends[0]:.5g}",
        f"{ends[1]:.5g}",
        f"{nominal:.5g}",
    ]


# ---- the README ------------------------------------------------------------------------------------


def readme_table(summary: Summary) -> str:
    """The rows of the README's table, as Markdown."""
    ok = summary.statuses["ok"]
    lines = [
        f"| {ok.of} arms | median | 95 % below | 99 % below | worst | arms within the limit |",
        "|---|---|---|---|---|---|",
        f"| commissioned, then run without a fault | | | | | {_markdown_share(ok)} |",
    ]
    for one in summary.figures:
        if one.limit is None:
            continue
        text, unit, factor = FIGURES[one.name]
        quantiles = (quantile_of(one, at) for at in (0.5, 0.95, 0.99))
        cells = ["-" if q is None else value_text(q.value, one.name) for q in quantiles]
        within = _markdown_share(one.within) if one.within else "-"
        lines.append(
            f"| {text}, {unit} | {' | '.join(cells)} | {value_text(one.worst, one.name)} "
            f"| ≤ {one.limit * factor:g}: {within} |"
        )
    return "\n".join(lines)


def _markdown_share(one: Share) -> str:
    return f"{percent(one.count / max(one.of, 1))} ({percent(one.low)} to {percent(one.high)})"
