"""The report on the paper: what a run is judged by, and the page, the JSON and the README section made of runs.

`tools/paper.py` makes the runs. ``report.json`` is a list of them: the keys of ``run.py --json``, and

profile
    the plant's: ``paper``, ``realistic``, or one effect of it.
group
    what the run is for, one of ``GROUPS``.
bar
    a list of what was asked of this run: ``name``, ``unit``, ``value``, ``least``, ``most`` (null: no limit) and
    ``met``.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, field
from html import escape

from matplotlib.figure import Figure

from sil_plant.inputs.machine import JOINT_NAMES
from sil_plant.loop.results import Result
from sil_plant.reports import paper_figures
from sil_plant.reports.figures import Trace

GROUPS = {
    "commission": "commissioning",
    "load": "load estimate",
    "tracking": "tracking",
    "change": "changing load",
    "ablation": "effects one by one",
    "check": "hold-out",
}
REFERENCE, SECOND = "reference", "loader"
PAPER, REALISTIC = "paper", "realistic"

# What the paper prints.
PAPER_LOAD_ERROR_KG = {0.0: 0.005, 2.5: 0.004, 5.0: 0.005, 7.5: 0.007, 10.0: 0.012}
PAPER_SETTLE = "about 1"
PAPER_PID_MRAD = 60.0
PAPER_ERROR_MRAD = {
    "diarc-noload": ((-0.55, 0.55), (-1.0, 0.6)),
    "diarc": ((-0.4, 0.4), (-0.3, 0.4)),
}
CONTROLLER_NAMES = {
    "pid": "PID",
    "diarc-noload": "DIARC without load compensation",
    "diarc": "DIARC with load compensation",
}

# What is asked of runs, as report.json names it.
LOAD_ERROR = "load error at the end"
SETTLE = "load within 0.1 kg after motion starts"
PEAK_LATE = "peak error after 1 s"
PEAK = "peak error, whole run"
PID_PEAK = "peak error of PID, whole run"
WRIST_BETTER = "wrist better by load compensation, peak-to-peak"
PARAMETERS = "largest parameter error"
COMPRESSIBILITY = "error of 1/beta_e"
CHANGE_SETTLE = "load within 0.1 kg after the motion that shows a change"
FAULTS = "faults"

MAKE = "make paper"
MARKERS = ("<!-- paper:begin -->", "<!-- paper:end -->")


@dataclass(frozen=True)
class Bar:
    """What is asked of a run, and what it did; a value of None is one that never came."""

    name: str
    unit: str
    value: float | None
    least: float | None = None
    most: float | None = None

    @property
    def excess(self) -> float:
        """How far the value is beyond its limits, as a share of them; 0 or less where it is met."""
        if self.value is None:
            return math.inf
        beyond = []
        if self.most is not None:
            beyond.append((self.value - self.most) / (abs(self.most) or 1.0))
        if self.least is not None:
            beyond.append((self.least - self.value) / (abs(self.least) or 1.0))
        return max(beyond)

    @property
    def met(self) -> bool:
        """Whether the value is within its limits."""
        return self.excess <= 0.0


@dataclass(frozen=True)
class ParameterFinding:
    """A parameter as the plant has it and as commissioning found it, SI."""

    name: str
    unit: str
    true: float
    found: float
    sd: float
    identifiable: bool

    @property
    def error_percent(self) -> float | None:
        """Relative error; None for what is nothing in the plant."""
        return 100.0 * abs(self.found - self.true) / abs(self.true) if self.true else None


@dataclass(frozen=True)
class Case:
    """One run of the report.

    Attributes
    ----------
    result : Result
        Its figures.
    profile, group : str
        As in report.json.
    bars : tuple of Bar
        What was asked of it.
    range_mrad : tuple
        Least and greatest tracking error after 1 s, per joint.
    change_settle_s : tuple
        Per change of the load, how long after the motion that shows it the estimate was off.
    parameters : tuple of ParameterFinding
        What was found, for runs that find parameters.
    trace : Trace, optional
        For those that are drawn.
    """

    result: Result
    profile: str
    group: str
    bars: tuple[Bar, ...] = ()
    range_mrad: tuple[tuple[float, float], ...] = ()
    change_settle_s: tuple[float | None, ...] = ()
    parameters: tuple[ParameterFinding, ...] = ()
    trace: Trace | None = None

    @property
    def where(self) -> str:
        """Which run of its group it is."""
        result = self.result
        run = result.scenario if self.group == "check" else f"seed {result.seed}"
        return f"{result.load_true_kg:.3g} kg, {run}"


@dataclass(frozen=True)
class Verdict:
    """One bar over all runs that it is asked of: the worst of them."""

    arm: str
    profile: str
    group: str
    worst: Bar
    where: str
    met_runs: int
    runs: int

    @property
    def met(self) -> bool:
        """Whether every run met it."""
        return self.met_runs == self.runs


@dataclass(frozen=True)
class Report:
    """All runs, and what was left out and why."""

    cases: tuple[Case, ...]
    notes: tuple[str, ...] = ()
    full_scale_kg: dict[str, float] = field(default_factory=dict)

    def of(self, group: str, profile: str | None = None, arm: str = REFERENCE, controller: str = "diarc") -> list[Case]:
        """The runs of a group."""
        return [
            c
            for c in self.cases
            if c.group == group
            and c.result.arm == arm
            and c.result.controller == controller
            and profile in (None, c.profile)
        ]


def verdicts(cases: Iterable[Case]) -> list[Verdict]:
    """Every bar over the runs it is asked of, in order of first appearance."""
    found: dict[tuple[str, str, str, str], list[tuple[Bar, Case]]] = {}
    for case in cases:
        for bar in case.bars:
            key = (case.result.arm, case.profile, case.group, bar.name)
            found.setdefault(key, []).append((bar, case))
    rows = []
    for (arm, profile, group, _), pairs in found.items():
        bar, case = max(pairs, key=lambda pair: pair[0].excess)
        met = sum(b.met for b, _ in pairs)
        rows.append(Verdict(arm, profile, group, bar, case.where, met, len(pairs)))
    return rows


def to_json(cases: Iterable[Case]) -> str:
    """The runs as ``report.json``."""
    rows = []
    for case in cases:
        bars = [asdict(bar) | {"met": bar.met} for bar in case.bars]
        rows.append(asdict(case.result) | {"profile": case.profile, "group": case.group, "bar": bars})
    return json.dumps(rows, indent=1, allow_nan=False) + "\n"


# ---- figures of several runs -----------------------------------------------------------------------


def worst_load(cases: Iterable[Case]) -> float:
    """Largest load error, kg."""
    return max(abs(c.result.load_err_kg) for c in cases)


def worst_late_mrad(cases: Iterable[Case]) -> float:
    """Largest tracking error after 1 s."""
    return 1e3 * max(v or 0.0 for c in cases for v in c.result.peak_err_after_1s_rad)


def worst_range(cases: Iterable[Case], joint: int) -> tuple[float, float]:
    """Least and greatest tracking error after 1 s, mrad."""
    ranges = [c.range_mrad[joint] for c in cases]
    return min(r[0] for r in ranges), max(r[1] for r in ranges)


def better_percent(
    without: tuple[float, float], with_it: tuple[float, float], measure: Callable[[tuple[float, float]], float]
) -> float:
    """By how much load compensation makes a range of errors smaller."""
    return 100.0 * (1.0 - measure(with_it) / measure(without))


def peak_to_peak(extent: tuple[float, float]) -> float:
    """Width of a range."""
    return extent[1] - extent[0]


def peak(extent: tuple[float, float]) -> float:
    """Largest magnitude in a range."""
    return max(-extent[0], extent[1])


def shares(cases: Sequence[Case]) -> list[paper_figures.Share]:
    """What each plant of the ablation costs, in order of appearance."""
    found = []
    for name in dict.fromkeys(c.profile for c in cases):
        of_it = [c for c in cases if c.profile == name]
        found.append(paper_figures.Share(name, worst_load(of_it), worst_late_mrad(of_it)))
    return found


# ---- texts -----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Cell:
    """A table's cell that has been judged."""

    text: str
    met: bool


Row = Sequence[str | Cell]


def number(value: float | None, digits: int = 3) -> str:
    """A figure for people."""
    if value is None:
        return "never"
    if value == 0.0:
        return "0"
    decimals = max(0, digits - 1 - math.floor(math.log10(abs(value))))
    return f"{value:.{min(decimals, 6)}f}" if abs(value) >= 1e-4 else f"{value:.{digits}g}"


def percent(value: float) -> str:
    """Percent to a tenth, a half rounded up as the paper does."""
    return f"{math.floor(10.0 * value + 0.5) / 10.0:.1f} %"


def shown(bar: Bar) -> tuple[str, str]:
    """Value and limit of a bar for people; angles in mrad."""
    factor, unit = (1e3, "mrad") if bar.unit == "rad" else (1.0, bar.unit)

    def plain(limit: float | None) -> str:
        return "-" if limit is None else f"{factor * limit:g}"

    if bar.least is None:
        limit = f"≤ {plain(bar.most)}"
    elif bar.most is None:
        limit = f"≥ {plain(bar.least)}"
    else:
        limit = f"{plain(bar.least)} to {plain(bar.most)}"
    value = number(None) if bar.value is None else f"{number(factor * bar.value)} {unit}".rstrip()
    return value, f"{limit} {unit}".rstrip()


def table(head: Sequence[str], rows: Iterable[Row], caption: str = "") -> str:
    """An HTML table; what has not met its bar is red."""
    lines = ["<div class=wide><table>"]
    if caption:
        lines.append(f"<caption>{escape(caption)}</caption>")
    lines.append("<thead><tr>" + "".join(f"<th>{escape(h)}</th>" for h in head) + "</tr></thead><tbody>")
    for row in rows:
        cells = []
        for cell in row:
            if isinstance(cell, Cell):
                cells.append(f'<td class="{"met" if cell.met else "unmet"}">{escape(cell.text)}</td>')
            else:
                cells.append(f"<td>{escape(cell)}</td>")
        lines.append("<tr>" + "".join(cells) + "</tr>")
    lines.append("</tbody></table></div>")
    return "\n".join(lines)


def paragraph(text: str) -> str:
    """A paragraph; backquotes mark commands."""
    parts = escape(text).split("`")
    return "<p>" + "".join(f"<code>{p}</code>" if k % 2 else p for k, p in enumerate(parts)) + "</p>"


def commands(*lines: str) -> str:
    """Commands to copy."""
    return "<pre>" + escape("\n".join(lines)) + "</pre>"


def bar_of(case: Case, name: str) -> Bar | None:
    """The bar of this name, where the run has it."""
    return next((bar for bar in case.bars if bar.name == name), None)


def judged(cases: Sequence[Case], name: str) -> str | Cell:
    """The worst value of a bar over some runs; a dash where none was asked."""
    bars = [bar for case in cases if (bar := bar_of(case, name))]
    if not bars:
        return "-"
    worst = max(bars, key=lambda bar: bar.excess)
    return Cell(shown(worst)[0], worst.met)


# ---- the page --------------------------------------------------------------------------------------

STYLE_SHEET = """
:root { color-scheme: light; }
body { font: 16px/1.55 "Segoe UI", "DejaVu Sans", Verdana, Helvetica, Arial, sans-serif; color: #1b1b1b;
  background: #fff; max-width: 1080px; margin: 2rem auto 4rem; padding: 0 1.2rem; }
h1 { font-size: 1.75rem; line-height: 1.25; margin: 0 0 .6rem; }
h2 { font-size: 1.3rem; margin: 2.6rem 0 .6rem; padding-top: .6rem; border-top: 1px solid #d8d8d8; }
h3 { font-size: 1.08rem; margin: 1.8rem 0 .4rem; }
p { margin: .6rem 0; max-width: 52rem; }
figure { margin: 1rem 0 1.4rem; }
figcaption { color: #4a4a4a; font-size: .92rem; margin-top: .3rem; max-width: 52rem; }
svg { display: block; width: 100%; height: auto; }
.wide { overflow-x: auto; margin: .8rem 0 1.2rem; }
table { border-collapse: collapse; font-size: .92rem; font-variant-numeric: tabular-nums; }
caption { text-align: left; font-weight: 600; padding: .2rem 0 .4rem; }
th, td { text-align: left; vertical-align: top; padding: .28rem .9rem .28rem 0; border-bottom: 1px solid #e4e4e4; }
th { border-bottom: 2px solid #b0b0b0; font-weight: 600; }
code, pre { font: .88em/1.5 "DejaVu Sans Mono", Consolas, Menlo, monospace; background: #f4f4f4; }
code { padding: .05em .25em; }
pre { padding: .6rem .8rem; white-space: pre-wrap; overflow-wrap: anywhere; }
.met, .unmet, .bar { white-space: nowrap; }
.met { color: #14642a; }
.unmet { color: #c62828; font-weight: 700; }
.summary { font-size: 1.12rem; font-weight: 600; }
.note { background: #fff6dc; border-left: 4px solid #d9a400; padding: .5rem .8rem; }
"""


def figure_html(figure: Figure, name: str, caption: str) -> str:
    """A picture with its caption."""
    return f"<figure>{paper_figures.svg(figure, name)}<figcaption>{escape(caption)}</figcaption></figure>"


def summary_line(rows: Sequence[Verdict]) -> str:
    """How many bars were met."""
    return f"{sum(v.met for v in rows)} of {len(rows)} bars met"


def page(report: Report, pictures: dict[str, Figure]) -> str:
    """The report as one HTML file that needs no other.

    Parameters
    ----------
    report : Report
        The runs.
    pictures : dict
        Figures by name; sections whose figure is not there do without.
    """
    rows = verdicts(report.cases)
    parts = [
        "<h1>The paper’s results, on the simulated arm</h1>",
        paragraph(
            "“Precision Control and Simulation Verification of Hydraulic Manipulator under Unknown Load” proposes "
            "direct/indirect adaptive robust control (DIARC). Here the firmware runs that law against the simulated "
            "arm, in one process and in simulated time. The paper’s arm is not printed in full, so the arm is "
            "our reference arm; the paper’s figures stand beside ours to show what was asked for, not as "
            "a comparison on the same machine."
        ),
        f'<p class="summary">{summary_line(rows)}</p>',
        *(f'<p class="note">{escape(note)}</p>' for note in report.notes),
        paragraph(
            "A bar is met when every run it is asked of meets it; the table has the worst run of each. Red has not "
            f"been met. `{MAKE}` makes all of this page; `python tools/paper.py --only PART` one part of it."
        ),
        table(
            ["machine", "plant", "for", "what", "worst", "bar", "runs that met it", "worst at"],
            [
                [
                    v.arm,
                    v.profile,
                    GROUPS.get(v.group, v.group),
                    v.worst.name,
                    Cell(shown(v.worst)[0], v.met),
                    shown(v.worst)[1],
                    Cell(f"{v.met_runs} of {v.runs}", v.met),
                    v.where,
                ]
                for v in rows
            ],
        ),
    ]
    for section in (
        _paper_section,
        _commission_section,
        _change_section,
        _realistic_section,
        _second_section,
        _check_section,
    ):
        parts += section(report, pictures)
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>DIARC ECU: the paper’s results</title>\n<style>{STYLE_SHEET}</style>\n</head>\n<body>\n"
        + "\n".join(parts)
        + "\n</body>\n</html>\n"
    )


def _drawn(pictures: dict[str, Figure], name: str, caption: str) -> list[str]:
    return [figure_html(pictures[name], name, caption)] if name in pictures else []


def _reproduce(arm: str, profile: str, run_options: str) -> str:
    """The commands that make one of the runs by hand: seed 1."""
    options = "" if profile == PAPER else f" --profile {profile}"
    options += "" if arm == REFERENCE else f" --arm sil_plant/arms/{arm}.toml"
    return commands(
        f"python tools/commission.py{options} --seed 101 -o out/set.toml",
        f"python sil_plant/run.py{options} --params out/set.toml --bus inproc --seed 1 {run_options}",
    )


def _load_table(report: Report, profile: str, arm: str) -> str:
    cases = report.of("load", profile, arm)
    rows = []
    for load in dict.fromkeys(c.result.load_true_kg for c in cases):
        of_it = [c for c in cases if c.result.load_true_kg == load]
        settles = [c.result.load_settle_s for c in of_it]
        row: list[str | Cell] = [f"{load:g}"]
        if arm == REFERENCE and profile == PAPER:
            printed = PAPER_LOAD_ERROR_KG.get(load)
            row += ["-" if printed is None else f"{printed:.3f} kg", f"{PAPER_SETTLE} s"]
        row += [
            f"{of_it[0].result.load_err_kg:+.4f} kg",
            judged(of_it, LOAD_ERROR),
            f"{100.0 * worst_load(of_it) / report.full_scale_kg.get(arm, math.nan):.3f} %",
        ]
        if arm == REFERENCE:
            settle = judged(of_it, SETTLE)
            worst = None if None in settles else max(s for s in settles if s is not None)
            row.append(settle if isinstance(settle, Cell) else number(worst) + (" s" if worst is not None else ""))
        late = judged(of_it, PEAK_LATE)
        row.append(late if isinstance(late, Cell) else f"{number(worst_late_mrad(of_it))} mrad")
        rows.append(row)
    head = ["load, kg"]
    if arm == REFERENCE and profile == PAPER:
        head += ["paper: error", "paper: settled in"]
    seeds = len(dict.fromkeys(c.result.seed for c in cases))
    head += [f"here: error, seed {cases[0].result.seed}", f"here: worst of {seeds} seeds", "of full scale"]
    if arm == REFERENCE:
        head.append("here: within 0.1 kg in, worst")
    head.append("peak error after 1 s, worst")
    return table(head, rows)


def _tracking_table(report: Report, profile: str) -> str:
    rows: list[Row] = []
    for controller, name in CONTROLLER_NAMES.items():
        cases = report.of("tracking", profile, controller=controller)
        for joint, joint_name in enumerate(JOINT_NAMES):
            if not cases:
                continue
            extent = worst_range(cases, joint)
            printed = PAPER_ERROR_MRAD.get(controller)
            paper = (
                [
                    f"{printed[joint][0]:g} to {printed[joint][1]:g}",
                    f"{peak(printed[joint]):g}",
                    f"{peak_to_peak(printed[joint]):.3g}",
                ]
                if printed
                else ["-", f"{PAPER_PID_MRAD:g}", "-"]
            )
            rho = max(c.result.rho_s[joint] or 0.0 for c in cases)
            whole = 1e3 * max(c.result.peak_err_rad[joint] for c in cases)
            rows.append(
                [
                    name,
                    joint_name,
                    *(paper if profile == PAPER else []),
                    f"{number(extent[0])} to {number(extent[1])}",
                    number(peak(extent)),
                    number(peak_to_peak(extent)),
                    number(whole),
                    number(1e3 * rho),
                ]
            )
    head = ["controller", "joint"]
    if profile == PAPER:
        head += ["paper: errors", "paper: peak", "paper: peak-to-peak"]
    head += ["here: errors", "peak", "peak-to-peak", "peak, whole run", "rho, ms"]
    return table(head, rows, "Tracking errors in mrad; ours after 1 s, over all seeds")


def _improvement_table(report: Report, profile: str) -> str:
    without = report.of("tracking", profile, controller="diarc-noload")
    with_it = report.of("tracking", profile)
    rows = []
    for joint, name in enumerate(JOINT_NAMES):
        printed = [PAPER_ERROR_MRAD[c][joint] for c in ("diarc-noload", "diarc")]
        here = [worst_range(cases, joint) for cases in (without, with_it)]
        row: list[str | Cell] = [name]
        for measure in (peak_to_peak, peak):
            row += [percent(better_percent(*printed, measure)), percent(better_percent(*here, measure))]
        rows.append(row)
    head = ["joint", "paper: peak-to-peak", "here", "paper: by peak", "here"]
    return table(head, rows, "How much smaller load compensation makes the error")


def _paper_section(report: Report, pictures: dict[str, Figure]) -> list[str]:
    if not report.of("load", PAPER):
        return []
    parts = ["<h2>The paper’s plant</h2>"]
    parts += _drawn(
        pictures,
        "fig5",
        "Fig. 5, desired trajectory. The paper’s is not readable; this one is a point-to-point move with a septic "
        "profile, the same for both joints.",
    )
    if report.of("tracking", PAPER):
        parts += _drawn(pictures, "fig6", "Fig. 6, tracking errors of PID and DIARC.")
        parts += _drawn(
            pictures,
            "fig7",
            "Fig. 7, tracking errors of DIARC without and with load compensation. Figures in the tables begin at "
            "the grey line.",
        )
        parts += [
            _tracking_table(report, PAPER),
            _improvement_table(report, PAPER),
            paragraph(
                "rho is the peak error over the peak speed, both after 1 s. The paper’s “wrist improved by 56.3 %” is "
                "peak-to-peak; by peak its own figures give 60 %."
            ),
            _reproduce(REFERENCE, PAPER, "--load 3 --controller diarc    # or diarc-noload, pid"),
        ]
    parts += _drawn(pictures, "fig8", "Fig. 8, load estimates over time for the loads of Table 1.")
    parts += [
        "<h3>Table 1: load estimates</h3>",
        _load_table(report, PAPER, REFERENCE),
        _reproduce(REFERENCE, PAPER, "--load 5"),
    ]
    return parts


def _commission_section(report: Report, pictures: dict[str, Figure]) -> list[str]:
    cases = [c for c in report.of("commission") if c.parameters]
    if not cases:
        return []
    rows = []
    for k, first in enumerate(cases[0].parameters):
        found = [c.parameters[k] for c in cases]
        bar = next((b for b in cases[0].bars if b.name == parameter_bar(first.name)), None)
        error = max((p.error_percent or 0.0 for p in found), default=0.0)
        if first.true == 0.0:
            text: str | Cell = f"{max(abs(p.found) for p in found):.2g} {first.unit}"
        elif bar and bar.most is not None and all(p.identifiable for p in found):
            text = Cell(f"{error:.2f} %", error <= bar.most)
        else:
            text = f"{error:.2f} %" + ("" if all(p.identifiable for p in found) else ", not identifiable")
        rows.append([first.name, first.unit, f"{first.true:.5g}", f"{first.found:.5g}", f"{first.sd:.2g}", text])
    return [
        "<h2>Commissioning</h2>",
        paragraph(
            "Every run of this page starts from parameters that the firmware itself found without a load, with "
            "another seed of the noise. What the plant has as zero is shown by its largest magnitude."
        ),
        table(
            ["parameter", "unit", "plant", f"found, seed {cases[0].result.seed}", "sd", f"worst of {len(cases)} seeds"],
            rows,
        ),
        commands("python tools/commission.py --seed 101"),
    ]


def parameter_bar(name: str) -> str:
    """Which bar a parameter is under."""
    return COMPRESSIBILITY if name == "beta_inverse" else PARAMETERS


def _change_table(cases: Sequence[Case]) -> str:
    rows: list[Row] = []
    for k in range(len(cases[0].change_settle_s)):
        values = [c.change_settle_s[k] for c in cases]
        worst = None if None in values else max(v for v in values if v is not None)
        limit = next((b.most for b in cases[0].bars if b.name == CHANGE_SETTLE and b.most is not None), None)
        text = number(worst) + ("" if worst is None else " s")
        cell = text if limit is None else Cell(text, worst is not None and worst <= limit)
        rows.append([f"change {k + 1}: within 0.1 kg after the motion that shows it", cell])
    whole = 1e3 * max(max(c.result.peak_err_rad) for c in cases)
    judged_peak = judged(cases, PEAK)
    rows.append([PEAK, judged_peak if isinstance(judged_peak, Cell) else f"{number(whole)} mrad"])
    rows.append([LOAD_ERROR, f"{number(worst_load(cases))} kg"])
    return table(["changing load", f"worst of {len(cases)} seeds"], rows)


def _change_section(report: Report, pictures: dict[str, Figure]) -> list[str]:
    cases = report.of("change", PAPER)
    if not cases:
        return []
    return [
        "<h2>A load that changes</h2>",
        paragraph(
            "5 kg are picked up at 4 s, as a move begins, and dropped at 7 s, in the middle of one. At rest, friction "
            "hides a load; so the time counts from the first motion at or after the change."
        ),
        *_drawn(pictures, "change", "The load, its estimate, and the tracking errors meanwhile."),
        _change_table(cases),
        _reproduce(REFERENCE, PAPER, "--scenario sil_plant/scenarios/load_change.toml"),
    ]


def _realistic_section(report: Report, pictures: dict[str, Figure]) -> list[str]:
    if not report.of("load", REALISTIC):
        return []
    full = report.full_scale_kg.get(REFERENCE, math.nan)
    cases = report.of("load", REALISTIC)
    goal = 0.002 * full
    within = sum(abs(c.result.load_err_kg) <= goal for c in cases)
    parts = [
        "<h2>A plant that does not flatter</h2>",
        paragraph(
            "The profile realistic adds friction peaks, seal friction at the cylinders, valve overlap and hysteresis, "
            "air in the oil, a supply that sags, encoders of 17 bits, pressure sensors with gain and offset errors, "
            "jitter, lost frames, and oil that is 30 % thicker than when the machine was commissioned. Every seed has "
            "other signs of the sensors’ errors. The goal beyond the bar, 0.2 % of full scale "
            f"({goal:g} kg), is met in {within} of {len(cases)} runs."
        ),
        *_drawn(pictures, "realistic", "Load estimates under the profile realistic."),
        _load_table(report, REALISTIC, REFERENCE),
    ]
    if report.of("tracking", REALISTIC):
        parts += [_tracking_table(report, REALISTIC), _improvement_table(report, REALISTIC)]
    if report.of("change", REALISTIC):
        parts.append(_change_table(report.of("change", REALISTIC)))
    parts.append(_reproduce(REFERENCE, REALISTIC, "--load 5"))
    ablation = report.of("ablation")
    if ablation:
        seeds = len(dict.fromkeys(c.result.seed for c in ablation))
        loads = sorted(dict.fromkeys(round(c.result.load_true_kg, 6) for c in ablation))
        parts += [
            "<h3>Which effect costs what</h3>",
            paragraph(
                "The paper’s plant with one effect at a time, then with all. Each plant is commissioned under the "
                "same effects; only viscosity changes afterwards. Worst of loads "
                f"{', '.join(f'{v:g}' for v in loads)} kg and {seeds} seeds."
            ),
            *_drawn(pictures, "ablation", "The worst of each, and the bars that the profile realistic has to meet."),
            table(
                ["paper’s plant and", "worst load error, kg", "peak error after 1 s, mrad"],
                [[s.name, f"{s.load_kg:.4f}", f"{s.peak_mrad:.3f}"] for s in shares(ablation)],
            ),
            commands("python tools/paper.py --only ablation"),
        ]
    return parts


def _second_section(report: Report, pictures: dict[str, Figure]) -> list[str]:
    if not report.of("load", arm=SECOND):
        return []
    parts = [
        "<h2>A second machine</h2>",
        paragraph(
            f"The same firmware with the numbers of sil_plant/arms/{SECOND}.toml: full scale "
            f"{report.full_scale_kg.get(SECOND, math.nan):g} kg. Nothing is compiled anew."
        ),
    ]
    for profile in (PAPER, REALISTIC):
        if report.of("load", profile, SECOND):
            parts += [
                f"<h3>Profile {profile}</h3>",
                *_drawn(pictures, f"{SECOND}-{profile}", f"Load estimates, {SECOND}, profile {profile}."),
                _load_table(report, profile, SECOND),
                _reproduce(SECOND, profile, f"--scenario sil_plant/scenarios/{SECOND}.toml --load 100"),
            ]
    return parts


def _check_section(report: Report, pictures: dict[str, Figure]) -> list[str]:
    cases = report.of("check")
    if not cases:
        return []
    rows = [v for v in verdicts(report.cases) if v.group == "check"]
    return [
        "<h2>Hold-out</h2>",
        paragraph(
            "Cases that no number was chosen on: random loads, seeds, start poses, moves of either joint, and plants "
            "whose link mass, friction, bulk modulus, leakage and valve bandwidth are up to 20 % off. Each plant is "
            "commissioned first, then operated. The bars are those of the benchmark, times 1.5."
        ),
        *_drawn(pictures, "check", "Load errors of the hold-out."),
        table(
            ["plant", "what", "met in", "worst", "bar", "worst at"],
            [
                [
                    v.profile,
                    v.worst.name,
                    Cell(f"{v.met_runs} of {v.runs}", v.met),
                    Cell(shown(v.worst)[0], v.met),
                    shown(v.worst)[1],
                    v.where,
                ]
                for v in rows
            ],
        ),
        commands("python tools/paper.py --only check"),
    ]


# ---- the README ------------------------------------------------------------------------------------


def readme_section(report: Report) -> str:
    """Picture, table and commands, as Markdown between the markers."""
    rows = verdicts(report.cases)

    def worst(group: str, profile: str, name: str, arm: str = REFERENCE) -> tuple[str, str]:
        for v in rows:
            if (v.arm, v.profile, v.group, v.worst.name) == (arm, profile, group, name):
                value, limit = shown(v.worst)
                return (value if v.met else f"**{value}, not met**"), limit
        return "-", "-"

    def spread(cases: Sequence[Case], joint: int) -> str:
        low, high = worst_range(cases, joint)
        return f"{number(low, 2)} to {number(high, 2)} mrad"

    lines = ["| | here, worst | paper | bar |", "|---|---|---|---|"]

    def add(what: str, here: tuple[str, str], printed: str = "-") -> None:
        lines.append(f"| {what} | {here[0]} | {printed} | {here[1]} |")

    for load in dict.fromkeys(c.result.load_true_kg for c in report.of("load", PAPER)):
        of_it = [c for c in report.of("load", PAPER) if c.result.load_true_kg == load]
        one = next(v for v in verdicts(of_it) if v.worst.name == LOAD_ERROR)
        value, limit = shown(one.worst)
        printed = PAPER_LOAD_ERROR_KG.get(load)
        add(
            f"load error at {load:g} kg",
            (value if one.met else f"**{value}, not met**", limit),
            "-" if printed is None else f"{printed:g} kg",
        )
    add("load within 0.1 kg after", worst("load", PAPER, SETTLE), f"{PAPER_SETTLE} s")
    add("peak tracking error, PID", worst("tracking", PAPER, PID_PEAK), f"{PAPER_PID_MRAD:g} mrad")
    for controller, text in (
        ("diarc-noload", "DIARC, load not compensated"),
        ("diarc", "DIARC, load compensated"),
    ):
        for joint, name in enumerate(JOINT_NAMES):
            low, high = PAPER_ERROR_MRAD[controller][joint]
            cases = report.of("tracking", PAPER, controller=controller)
            limit = worst("tracking", PAPER, PEAK_LATE)[1] if controller == "diarc" else "-"
            add(f"{name} after 1 s: {text}", (spread(cases, joint), limit), f"{low:g} to {high:g} mrad")
    wrist = len(JOINT_NAMES) - 1
    by_peak = better_percent(
        worst_range(report.of("tracking", PAPER, controller="diarc-noload"), wrist),
        worst_range(report.of("tracking", PAPER), wrist),
        peak,
    )
    add("wrist better by load compensation, peak-to-peak", worst("tracking", PAPER, WRIST_BETTER), "56.3 %")
    add("the same by peak", (percent(by_peak), "-"), "60 %")
    add("peak tracking error, from arming on", worst("tracking", PAPER, PEAK))
    add("load picked up or dropped: within 0.1 kg after", worst("change", PAPER, CHANGE_SETTLE))
    add("realistic plant: load error, 0 to 10 kg", worst("load", REALISTIC, LOAD_ERROR))
    add("realistic plant: peak tracking error after 1 s", worst("load", REALISTIC, PEAK_LATE))
    for profile in (PAPER, REALISTIC):
        if report.of("load", profile, SECOND):
            full = report.full_scale_kg.get(SECOND, math.nan)
            add(
                f"second machine ({full:g} kg), {profile} plant: load error",
                worst("load", profile, LOAD_ERROR, SECOND),
            )
    checks = [v for v in rows if v.group == "check" and v.worst.name == LOAD_ERROR]
    for v in checks:
        value, limit = shown(v.worst)
        text = f"{value}; {v.met_runs} of {v.runs} met"
        add(f"hold-out, {v.profile} plant: load error", (text if v.met else f"**{text}**", limit))
    seeds = len(dict.fromkeys(c.result.seed for c in report.of("load", PAPER)))
    return "\n".join(
        [
            "## The paper's results",
            "",
            "![Tracking errors of PID and DIARC, and load estimates, on the simulated arm](docs/img/paper.png)",
            "",
            f"The reference arm, commissioned by `tools/commission.py`, then {seeds} seeds of noise. The paper's",
            "arm is not printed in full: its figures show what was asked for.",
            "",
            *lines,
            "",
            "```sh",
            f"{MAKE}    # all runs: out/paper/report.html and report.json, and refreshes this section",
            "```",
            "",
            f"{summary_line(rows)}; the report has every bar, Fig. 5 to 8 and Table 1 of the paper, which effect of",
            "the realistic plant costs what, and a hold-out of random plants, moves and loads.",
        ]
    )


def replace_section(text: str, section: str) -> str:
    """A README with the section between its markers made anew; without markers it goes to the end."""
    begin, end = MARKERS
    block = f"{begin}\n{section}\n{end}"
    if text.count(begin) == 1 and text.count(end) == 1 and text.index(begin) < text.index(end):
        before, rest = text.split(begin)
        return f"{before}{block}{rest.split(end)[1]}"
    return f"{text.rstrip()}\n\n{block}\n" if text.strip() else f"# DIARC ECU\n\n{block}\n"
