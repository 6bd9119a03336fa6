"""Run many arms: a sample of plants, loads, moves and faults, as a spec says; and report what came out, how surely.

Writes to out/campaigns/NAME: shards/*.parquet while it runs, then runs.parquet (one row per arm) and report.html.
The rows do not depend on who computes them. docs/campaigns.md has the format of specs and the columns.

Examples
--------
  python tools/campaign.py sil_plant/campaigns/production.toml
  python tools/campaign.py SPEC.toml --resume                        after Ctrl-C, a kill, or a full disk
  python tools/campaign.py SPEC.toml --cluster tcp://127.0.0.1:8786  by the workers of a dask scheduler
  python tools/campaign.py SPEC.toml --rerun 17                      one arm again: its figures and its plot
"""

from __future__ import annotations

import argparse
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import closing
from importlib.util import find_spec
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[0] = str(ROOT)

from sil_plant.environment import CommandLine, enter, say, show  # noqa: E402

if __name__ == "__main__":
    enter(__file__)

from sil_plant.config import ConfigError  # noqa: E402
from tools.signals import take_for_interrupt  # noqa: E402

NEEDED = ("SALib", "pebble", "pyarrow", "scipy")
EXIT_FAILED, EXIT_WRONG_USE, EXIT_INTERRUPTED = 1, 2, 130
OUT = ROOT / "out" / "campaigns"
REPORT = "report.html"
SAY_EVERY_S = 20.0  # where there is no terminal for a bar


def parse_arguments(argv: list[str]) -> argparse.Namespace:
    """Read the command line; a wrong one ends the program with status 2."""
    parser = CommandLine(prog="campaign.py", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("spec", type=Path, metavar="SPEC", help="a TOML file as sil_plant/campaigns/production.toml")
    parser.add_argument("--runs", type=int, metavar="N", help="in place of the spec's number, to try it out")
    parser.add_argument("--workers", type=int, metavar="N", help="processes; default: one for each processor")
    parser.add_argument("--cluster", metavar="tcp://HOST:8786", help="let a dask.distributed scheduler do it")
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="default: out/campaigns/NAME")
    parser.add_argument("--resume", action="store_true", help="go on with what is in the folder")
    parser.add_argument("--fresh", action="store_true", help="remove the results in the folder first")
    parser.add_argument("--rerun", type=int, metavar="K", help="run arm K again; print its figures and draw it")
    parser.add_argument("--table", action="store_true", help="print the table for README.md from finished results")
    parser.add_argument("--check", action="store_true", help="check the spec and every arm, run nothing")
    parser.add_argument("--quiet", action="store_true", help="no progress and no table")
    arguments = parser.parse_args(argv)
    if arguments.workers is not None and arguments.cluster:
        parser.error("--workers is for processes of this computer; a cluster has its own")
    if arguments.workers is not None and arguments.workers < 1:
        parser.error(f"--workers {arguments.workers}: 1 or more is needed")
    if arguments.resume and arguments.fresh:
        parser.error("--resume keeps results, --fresh removes them: choose one")
    return arguments


def main(argv: list[str]) -> int:
    """Run the command line; the exit status."""
    arguments = parse_arguments(argv)
    missing = [name for name in NEEDED if find_spec(name) is None]
    if missing:
        say(f"campaign.py: the package {missing[0]} is missing here; bring the environment in step: make setup")
        return EXIT_WRONG_USE
    take_for_interrupt(signal.SIGTERM)
    # imported here, for the workers that are spawned read this file, too
    from sil_plant.campaigning.pool import WorkersLostError

    try:
        return _main(arguments)
    except ConfigError as error:
        say(f"campaign.py: {error}")
        return EXIT_WRONG_USE
    except WorkersLostError as error:
        say(f"campaign.py: {error}; finished batches are kept, continue with --resume")
        return EXIT_FAILED
    except KeyboardInterrupt:
        say("campaign.py: interrupted; finished batches are kept, continue with --resume")
        return EXIT_INTERRUPTED


def _main(arguments: argparse.Namespace) -> int:
    from sil_plant.campaigning import sampling
    from sil_plant.campaigning.arm_run import code_hash
    from sil_plant.campaigning.results import ResultFolder, batches
    from sil_plant.campaigning.spec import load_campaign

    campaign = load_campaign(arguments.spec, arguments.runs)
    note = sampling.note(campaign)
    if note and not arguments.quiet:
        say(f"campaign.py: note: {note}")
    arms = sampling.arms(campaign)
    sampling.check_arms(campaign, arms)
    if arguments.check:
        show(f"{campaign.name}: {len(arms)} arms, {len(campaign.random)} random variables; nothing wrong")
        return 0
    folder = ResultFolder(arguments.out or OUT / campaign.name, campaign, code_hash())
    wanted = batches(arms, campaign.batch)
    if arguments.rerun is not None:
        return _rerun(campaign, arms, folder, arguments.rerun)
    if arguments.table:
        return _table(campaign, folder, wanted, len(arms))
    with closing(folder):
        folder.open(arguments.resume, arguments.fresh)
        return _run(arguments, campaign, folder, wanted, len(arms), note)


def _run(arguments, campaign, folder, wanted, planned: int, note: str | None) -> int:
    """Compute what is missing, then report on all of it."""
    from sil_plant.campaigning import pool
    from sil_plant.campaigning.arm_run import warm_up

    workers = arguments.workers or pool.default_workers()
    todo, damaged = folder.missing(wanted)
    for path in damaged:
        say(f"campaign.py: {path}: is damaged; its runs are computed again")
    start = time.perf_counter()
    left_out = []
    computed = sum(len(batch.arms) for batch in todo)
    if todo:
        if arguments.cluster:
            results = pool.on_cluster(campaign.base, todo, folder.code, arguments.cluster, _tell)
        else:
            warm_up(campaign.base)
            results = pool.on_processes(campaign.base, todo, folder.code, workers, _tell)
        with closing(results):
            for batch, rows in _with_progress(results, planned, planned - computed, arguments.quiet):
                if rows is None:
                    left_out.append(batch)
                else:
                    folder.write(batch, rows)
    wall_s = time.perf_counter() - start
    notes = [note] if note else []
    notes += [f"Missing: {batch.name}, for they killed their worker {pool.DEATHS_MOST} times." for batch in left_out]
    text = _report(arguments, campaign, folder, wanted, planned, tuple(notes))
    if not arguments.quiet:
        show(text)
        if computed:
            show(f"{computed} runs in {wall_s:.0f} s, {wall_s / computed:.3f} s each")
    for batch in left_out:
        say(f"campaign.py: {batch.name} are missing: their worker died each time; look at one: --rerun K")
    show(f"wrote {folder.path / REPORT} and {folder.path / 'runs.parquet'}")
    return EXIT_FAILED if left_out else 0


def _report(arguments, campaign, folder, wanted, planned: int, notes: tuple[str, ...]) -> str:
    """Write the report; its table for people."""
    from sil_plant.campaigning.results import write_whole
    from sil_plant.campaigning.statistics import summary
    from sil_plant.reports import campaign_report as report

    rows = folder.collect(wanted)
    if rows.num_rows == 0:
        raise ConfigError(f"{folder.path}: there are no results to report on")
    found = summary(campaign, rows, planned)
    by_run = {arm.run: arm for batch in wanted for arm in batch.arms}
    drawn = {run: report.worst_picture(campaign.base, by_run[run]) for run in found.worst}
    command = f"python tools/campaign.py {campaign.path}" + (f" --runs {campaign.runs}" if arguments.runs else "")
    made = report.Made(campaign, rows, found, drawn, folder.code, notes, command)
    rerun = [report.rerun_command(campaign, run, arguments.runs) for run in found.worst]
    path = folder.path / REPORT
    try:
        write_whole(path, report.page(made, rerun).encode())
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written: {error.strerror}; the results are kept: --resume") from error
    return report.readme_table(found)


def _table(campaign, folder, wanted, planned: int) -> int:
    """Print the README's table from results that are there."""
    from sil_plant.campaigning.statistics import summary
    from sil_plant.reports.campaign_report import readme_table

    if not folder.path.is_dir():
        raise ConfigError(f"{folder.path}: has no results; run the campaign first")
    with closing(folder):
        folder.open(resume=True, fresh=False)
        todo, _ = folder.missing(wanted)
        if todo:
            raise ConfigError(f"{folder.path}: {len(todo)} of {len(wanted)} batches are missing; finish it: --resume")
        show(readme_table(summary(campaign, folder.collect(wanted), planned)))
    return 0


def _rerun(campaign, arms, folder, number: int) -> int:
    """Run one arm again, print its figures, draw it, and hold it against the results that are there."""
    import pyarrow.parquet as pq

    from sil_plant.bus.protocol import worst_case_bus_load
    from sil_plant.campaigning.arm_run import row_of, run_arm, warm_up
    from sil_plant.campaigning.results import ALL_ROWS
    from sil_plant.loop import results
    from sil_plant.reports import campaign_report as report
    from sil_plant.reports import figures

    if not 1 <= number <= len(arms):
        raise ConfigError(f"--rerun {number}: the campaign has runs 1 to {len(arms)}")
    arm = arms[number - 1]
    warm_up(campaign.base)
    run = run_arm(campaign.base, arm)
    row = row_of(campaign.base, arm, run)
    show(f"run {number} of {campaign.name}: {run.status}{f', {run.reason}' if run.reason else ''}")
    for variable in campaign.variables:
        show(f"  {variable.label:<32}{arm.draws[variable.label]:.6g}")
    show(report.run_text(row))
    if run.operation is not None:
        show(results.table(run.operation.result, worst_case_bus_load()))
        show(f"  trace_sha256      {row['trace_sha256']}")
    before = folder.path / ALL_ROWS
    if before.is_file():
        there = pq.read_table(before, filters=[("run", "=", number)]).to_pylist()
        same = bool(there) and all(there[0].get(name) == value for name, value in row.items())
        show(f"  {'the same, to the last bit, as' if same else 'NOT the same as'} in {before}")
    trace = report.trace_of_run(run)
    if trace is not None:
        path = folder.path / f"run-{number}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        result = run.operation.result if run.operation else None
        load = result.load_true_kg if result else 0.0
        figures.save_png(
            figures.trace_figure(
                trace,
                figures.run_title(
                    f"{campaign.name}, run {number}",
                    campaign.base.machine.name,
                    round(load, 3),
                    campaign.base.controller,
                    arm.seed,
                ),
            ),
            path,
        )
        show(f"  wrote {path}")
    return 0


def _with_progress(results: Iterator, planned: int, done: int, quiet: bool) -> Iterator:
    """Pass results on, and show how far it is and how long it will take."""
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    console = Console(stderr=True)
    first: int | None = None
    start = said = time.monotonic()
    bar = Progress(
        TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TextColumn("left"),
        TimeRemainingColumn(), console=console, transient=True, disable=quiet or not console.is_terminal,
        speed_estimate_period=120.0,
    )  # fmt: skip
    with bar:
        task = bar.add_task("arms", total=planned, completed=done)
        for batch, rows in results:
            yield batch, rows
            done += len(batch.arms)
            bar.update(task, completed=done)
            now = time.monotonic()
            if first is None:  # the time until the first batch is the workers' start
                first, start = done, now
            if not quiet and not console.is_terminal and now - said > SAY_EVERY_S:
                said = now
                left = f", about {(planned - done) * (now - start) / (done - first):.0f} s left" if done > first else ""
                say(f"campaign.py: {done} of {planned} runs{left}")


def _tell(text: str) -> None:
    say(f"campaign.py: {text}")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
