"""Campaigns from the command line: the same rows however they come about, and nothing lost when something fails."""

from __future__ import annotations

import errno
import math
import os
import re
import resource
import signal
import socket
import sys
import time
from collections.abc import Callable
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

import psutil
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from sil_plant.campaigning import pool, results
from sil_plant.campaigning.arm_run import code_hash, run_batch, warm_up
from sil_plant.campaigning.results import ResultFolder, batches
from sil_plant.campaigning.sampling import arms
from sil_plant.campaigning.spec import CAMPAIGNS, Campaign, load_campaign
from sil_plant.config import ROOT, ConfigError
from tests.sil.campaign_specs import VARY_LOAD_AND_BORE

CAMPAIGN_PY = ROOT / "tools" / "campaign.py"
LIMIT_S = 110.0
RUNS = 24
SCENARIO = """duration_s = 2.5
repeat = true
[[load]]
time_s = 0.0
load_kg = 3.0
[[swing.segment]]
target_rad = 0.4
duration_s = 1.0
[[swing.segment]]
target_rad = 0.0
duration_s = 1.0
[[wrist.segment]]
target_rad = 0.5
duration_s = 1.0
[[wrist.segment]]
target_rad = 0.0
duration_s = 1.0
"""
SPEC = f"""name = "small"
runs = {RUNS}
batch = 1
commission = false
scenario = "scenario.toml"
[limits]
load_err_kg = 0.05
{VARY_LOAD_AND_BORE}[[vary]]
key = "effects.pressure_gain_error"
distribution = "uniform"
low = 0
high = 0.005
[[vary]]
key = "effects.sensor_set"
distribution = "integer"
low = 1
high = 1000
"""


@pytest.fixture(scope="module")
def spec(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small spec that takes some seconds."""
    folder = tmp_path_factory.mktemp("spec")
    (folder / "scenario.toml").write_text(SCENARIO, encoding="utf-8")
    (folder / "small.toml").write_text(SPEC, encoding="utf-8")
    return folder / "small.toml"


@pytest.fixture(scope="module")
def campaign(spec: Path) -> Campaign:
    """The small spec, read, and what it runs compiled."""
    found = load_campaign(spec)
    warm_up(found.base)
    return found


@pytest.fixture(scope="module")
def truth(campaign: Campaign) -> pa.Table:
    """What every way of running the small spec has to give: one process, one arm after the other."""
    rows = run_batch(campaign.base, arms(campaign), code_hash())
    return pa.Table.from_pylist(rows, results.schema(campaign))


def argv(*arguments: object) -> list[str]:
    """Command line of campaign.py."""
    return [sys.executable, str(CAMPAIGN_PY), *map(str, arguments)]


def rows_in(folder: Path) -> pa.Table:
    """The rows that a campaign has written, without the key of its folder."""
    return pq.read_table(folder / "runs.parquet").replace_schema_metadata(None)


def wait_for(condition: Callable[[], object], what: str, limit_s: float = LIMIT_S) -> None:
    """Wait until something is true; fails at the limit."""
    end = time.monotonic() + limit_s
    while not condition():
        assert time.monotonic() < end, f"{what} did not come within {limit_s} s"
        time.sleep(0.02)


def shards(folder: Path) -> list[Path]:
    """The shards that are written."""
    return list((folder / "shards").glob("*.parquet"))


def test_rows_differ_after_a_worker_died_or_with_two_workers(
    spec: Path, truth: pa.Table, tmp_path: Path, start
) -> None:
    out = tmp_path / "out"
    run = start(argv(spec, "--workers", 2, "--out", out), "campaign")
    wait_for(lambda: shards(out), "the first batch")
    workers = [c for c in psutil.Process(run.process.pid).children() if "spawn_main" in " ".join(c.cmdline())]
    assert len(workers) == 2
    busiest = max(workers, key=lambda worker: worker.cpu_times().user)  # the other may not have begun yet
    busiest.kill()
    assert run.wait(LIMIT_S) == 0, run.err.read_text()
    assert rows_in(out).equals(truth)
    assert re.search(
        rf"the worker {busiest.pid} has died (\(SIGKILL\) with run \d+; it is|between two batches; it was) replaced"
        "|died between two batches; all are replaced",
        run.err.read_text(),
    )


def test_worker_that_dies_without_a_job_takes_the_others_work_with_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """GIVEN a pool that breaks, as it does when a worker dies between two jobs WHEN it is made anew THEN every job is
    done once, and it is said; WHEN every one breaks THEN that is an error, not a loop.
    """
    breaks = 1

    class Pool(pool.ProcessPool):
        def schedule(self, *arguments, **options):
            nonlocal breaks
            if breaks == 0:
                return super().schedule(*arguments, **options)
            breaks -= 1
            future = Future()
            future.set_exception(BrokenProcessPool("All workers expired"))
            return future

    monkeypatch.setattr(pool, "ProcessPool", Pool)
    said: list[str] = []
    jobs = [(k, (k,)) for k in range(5)]
    done = dict(pool.in_processes(math.factorial, jobs, 2, said.append, str))
    assert done == {k: math.factorial(k) for k in range(5)}
    assert len(said) == 1 and "all are replaced" in said[0]
    breaks = 10**6
    with pytest.raises(pool.WorkersLostError, match="die before they begin"):
        dict(pool.in_processes(math.factorial, jobs, 2, said.append, str))


def test_rows_differ_or_work_is_lost_after_a_kill(spec: Path, truth: pa.Table, tmp_path: Path, start) -> None:
    out = tmp_path / "out"
    first = start(argv(spec, "--workers", 1, "--out", out), "first")
    wait_for(lambda: len(shards(out)) >= 3, "some batches")
    children = psutil.Process(first.process.pid).children()
    first.process.kill()
    first.process.wait()
    kept = {path.name: path.read_bytes() for path in shards(out)}
    assert 3 <= len(kept) < RUNS
    wait_for(lambda: not any(c.is_running() and c.status() != "zombie" for c in children), "the end of its workers")
    (out / "shards" / "000023.parquet.part").write_bytes(b"half a batch")
    damaged = sorted(kept)[0]
    (out / "shards" / damaged).write_bytes(kept[damaged][:100])

    second = start(argv(spec, "--workers", 1, "--out", out, "--resume"), "second")
    assert second.wait(LIMIT_S) == 0, second.err.read_text()
    assert f"{damaged}: is damaged; its runs are computed again" in second.err.read_text()
    assert rows_in(out).equals(truth)
    assert not list(out.rglob("*.part"))
    assert f"{RUNS - len(kept) + 1} runs in" in second.out.read_text()  # what was there was not run again

    rerun = start(argv(spec, "--out", out, "--rerun", 7), "rerun")
    assert rerun.wait(LIMIT_S) == 0, rerun.err.read_text()
    said = rerun.out.read_text()
    assert "the same, to the last bit, as" in said and truth["trace_sha256"][6].as_py() in said
    assert (out / "run-7.png").stat().st_size > 10_000


def free_port() -> int:
    """A port of loopback that nobody listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@pytest.fixture
def cluster(start, tmp_path: Path) -> Callable[..., tuple[str, list]]:
    """Start a scheduler and workers as processes of their own; their address and they."""

    def begin(workers: int) -> tuple[str, list]:
        address = f"tcp://127.0.0.1:{free_port()}"
        dask = ["env", f"PYTHONPATH={ROOT}", sys.executable, "-m", "dask"]
        port = address.rpartition(":")[2]
        found = [start([*dask, "scheduler", "--host", "127.0.0.1", "--port", port, "--no-dashboard"], "scheduler")]
        for n in range(workers):
            options = ["--nthreads", "1", "--no-dashboard", "--no-nanny", "--local-directory", str(tmp_path)]
            found.append(start([*dask, "worker", address, *options], f"worker{n}"))
        wait_for(lambda: _listens(address), "the scheduler")
        return address, found

    return begin


def _listens(address: str) -> bool:
    host, _, port = address.removeprefix("tcp://").partition(":")
    with socket.socket() as probe:
        return probe.connect_ex((host, int(port))) == 0


def test_rows_of_a_cluster_differ_or_a_lost_scheduler_loses_work(
    spec: Path, truth: pa.Table, tmp_path: Path, start, cluster
) -> None:
    out = tmp_path / "out"
    address, processes = cluster(2)
    run = start(argv(spec, "--cluster", address, "--out", out), "lost")
    wait_for(lambda: shards(out) or run.process.poll() is not None, "the first batch")
    for process in processes:
        process.process.kill()
    status = run.wait(LIMIT_S)
    assert status == 1, run.err.read_text()
    assert "has gone away; finished batches are kept, continue with --resume" in run.err.read_text()
    assert "Traceback" not in run.err.read_text()
    kept = len(shards(out))
    assert 0 < kept < RUNS

    address, processes = cluster(2)
    run = start(argv(spec, "--cluster", address, "--out", out, "--resume"), "resumed")
    assert run.wait(LIMIT_S) == 0, run.err.read_text()
    assert rows_in(out).equals(truth)


def test_missing_scheduler_is_not_said(
    spec: Path, campaign: Campaign, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pool, "CONNECT_S", 1.0)
    address = f"tcp://127.0.0.1:{free_port()}"
    todo = batches(arms(campaign), 4)
    with pytest.raises(ConfigError, match="no scheduler answers there"):
        next(pool.on_cluster(campaign.base, todo, code_hash(), address, print))
    with pytest.raises(ConfigError, match="no scheduler answers there"):
        next(pool.on_cluster(campaign.base, todo, code_hash(), "here:there", print))


def test_batch_that_kills_its_workers_stops_the_campaign() -> None:
    said: list[str] = []
    jobs = [(n, (text,)) for n, text in enumerate(["1 + 1", "__import__('os')._exit(7)", "2 + 2"])]
    done = dict(pool.in_processes(eval, jobs, 1, said.append, lambda n: f"runs {n}"))
    assert done == {0: 2, 1: None, 2: 4}
    assert len(said) == 2 and "with runs 1; it is replaced, they are computed again" in said[0]
    assert "exit status 7" in said[1] and "left out" in said[1]


def test_results_of_something_else_are_overwritten(campaign: Campaign, spec: Path, tmp_path: Path) -> None:
    first = ResultFolder(tmp_path, campaign, "code")
    first.open(resume=False, fresh=False)
    batch = batches(arms(campaign), 2)[0]
    rows = [dict.fromkeys(results.schema(campaign).names) | {"run": arm.run} for arm in batch.arms]
    first.write(batch, rows)
    with pytest.raises(ConfigError, match="another campaign is writing there"):
        ResultFolder(tmp_path, campaign, "code").open(resume=True, fresh=False)
    first.close()
    with pytest.raises(ConfigError, match="of this very campaign; continue with --resume"):
        first.open(resume=False, fresh=False)
    first.close()

    other_spec = ResultFolder(tmp_path, load_campaign(spec, RUNS + 1), "code")
    with pytest.raises(ConfigError, match=r"results of another spec.* --out FOLDER, or remove .* --fresh"):
        other_spec.open(resume=True, fresh=False)
    other_spec.close()
    other_code = ResultFolder(tmp_path, campaign, "changed")
    with pytest.raises(ConfigError, match="results of other code"):
        other_code.open(resume=True, fresh=False)
    assert len(shards(tmp_path)) == 1
    other_code.open(resume=False, fresh=True)
    assert not shards(tmp_path)
    other_code.close()

    (tmp_path / "campaign.json").unlink()
    with pytest.raises(ConfigError, match="is not empty, and no campaign's"):
        ResultFolder(tmp_path, campaign, "code").open(resume=False, fresh=True)


def test_full_disk_leaves_half_a_batch(campaign: Campaign, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = ResultFolder(tmp_path, campaign, "code")
    folder.open(resume=False, fresh=False)
    one, two = batches(arms(campaign), 1)[:2]

    def rows_of(batch: results.Batch) -> list[dict]:
        return [dict.fromkeys(folder.schema.names) | {"run": arm.run} for arm in batch.arms]

    folder.write(one, rows_of(one))
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, limits[1]))  # less than a batch
    try:
        with pytest.raises(ConfigError, match=r"000001.parquet: cannot be written: .*--resume"):
            folder.write(two, rows_of(two))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)

    def no_room(_: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr(results.os, "fsync", no_room)
        with pytest.raises(ConfigError, match="No space left on device; make room"):
            folder.write(two, rows_of(two))
    assert [path.name for path in (tmp_path / "shards").iterdir()] == ["000000.parquet"]
    assert folder.missing([one, two]) == ([two], [])
    folder.close()


def test_arm_of_the_committed_campaign_fails() -> None:
    production = load_campaign(CAMPAIGNS / "production.toml")
    (row,) = run_batch(production.base, arms(production)[:1], code_hash())
    assert row["status"] == "ok", row["reason"]
    assert abs(row["load_err_kg"]) < 0.2 and row["ticks"] > 10_000
    assert row["gain error of swing.bore"] != 0.0


def test_worker_computes_with_other_code(campaign: Campaign) -> None:
    from sil_plant.campaigning.arm_run import OtherCodeError

    with pytest.raises(OtherCodeError):
        run_batch(campaign.base, arms(campaign)[:1], "0" * 64)


def test_signal_that_ends_a_campaign_is_taken_for_an_error(spec: Path, tmp_path: Path, start) -> None:
    run = start(argv(spec, "--workers", 1, "--out", tmp_path / "out"), "campaign")
    wait_for(lambda: shards(tmp_path / "out"), "the first batch")
    run.process.send_signal(signal.SIGINT)
    assert run.wait(LIMIT_S) == 130
    assert "finished batches are kept, continue with --resume" in run.err.read_text()
    assert "Traceback" not in run.err.read_text()
