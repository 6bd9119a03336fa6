"""Who computes the batches: processes of this computer, or the workers of a dask.distributed scheduler.

Processes are spawned, not forked: the one that starts them has threads (progress bar, Arrow), also later, when a
worker that has died is replaced, and a fork would inherit their locks as they are at that moment. Compiled code comes
from numba's cache, which is warm by then.
"""

from __future__ import annotations

import itertools
import multiprocessing
import os
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from concurrent.futures.process import BrokenProcessPool
from typing import TYPE_CHECKING, Any

from pebble import ProcessExpired, ProcessPool

from sil_plant.campaigning.arm_run import OtherCodeError, run_batch
from sil_plant.campaigning.results import Batch
from sil_plant.campaigning.spec import Base
from sil_plant.config import ConfigError

if TYPE_CHECKING:
    from distributed import Client

Rows = list[dict[str, Any]]
Say = Callable[[str], None]
QUEUED_PER_WORKER = 4  # batches, so that none is ever idle, and the queue stays short however long the campaign
IDLE_DEATHS_MOST = 5  # in a row, with nothing finished in between: then they die at their start
DEATHS_MOST = 2  # a batch whose workers die so often is given up
CONNECT_S = 10.0
LOOK_S = 0.1  # how often the cluster is looked at while nothing is finished
NO_WORKERS_S = 30.0  # a scheduler that has no workers for so long has gone wrong


class WorkersLostError(Exception):
    """The scheduler, or all workers, went away; says what is kept."""


def in_processes(
    work: Callable[..., Any], jobs: Sequence[tuple[Any, tuple[Any, ...]]], workers: int, say: Say, name: Callable
) -> Iterator[tuple[Any, Any]]:
    """Call ``work`` with each job's arguments in some processes; yields the jobs and what they gave, as they finish.

    A job whose worker dies is given to another; one that does so twice yields None. A worker that dies while none is
    known to have a job takes the pool with it; then all are replaced.

    Parameters
    ----------
    work : callable
        A function of a module.
    jobs : list
        Pairs of what a job is called and its arguments.
    workers : int
        How many processes.
    say : callable
        Told of every worker that died.
    name : callable
        Makes a text of what a job is called.

    Raises
    ------
    WorkersLostError
        When workers die and none comes to anything.
    """
    left = dict.fromkeys(range(len(jobs)))  # an ordered set
    deaths = [0] * len(jobs)
    idle_deaths = 0
    while left:
        pool = ProcessPool(
            min(workers, len(left)),
            context=multiprocessing.get_context("spawn"),
            initializer=_leave_ctrl_c_to_the_parent,
        )
        try:
            for n, result in _in_one_pool(pool, work, jobs, list(left), workers, deaths, say, name):
                del left[n]
                idle_deaths = 0
                yield jobs[n][0], result
            pool.close()
        except BrokenProcessPool as broken:
            idle_deaths += 1
            if idle_deaths > IDLE_DEATHS_MOST:
                raise WorkersLostError("the workers die before they begin; is there memory left?") from broken
            say("a worker has died between two batches; all are replaced")
        finally:
            if pool.active:
                pool.stop()
            pool.join()


def _in_one_pool(
    pool: ProcessPool,
    work: Callable[..., Any],
    jobs: Sequence[tuple[Any, tuple[Any, ...]]],
    todo: Sequence[int],
    workers: int,
    deaths: list[int],
    say: Say,
    name: Callable,
) -> Iterator[tuple[int, Any]]:
    """The numbers of the jobs in ``todo`` and what they gave; BrokenProcessPool when nothing more can come of it."""
    waiting = iter(todo)
    running: dict[Future, int] = {}
    seen: set[int] = set()  # workers
    told: set[int] = set()  # of them, whose death a job has shown

    def schedule(n: int) -> None:
        try:
            running[pool.schedule(work, jobs[n][1])] = n
        except RuntimeError as error:
            raise BrokenProcessPool(str(error)) from error

    while True:
        for n in itertools.islice(waiting, max(QUEUED_PER_WORKER * workers - len(running), 0)):
            schedule(n)
        alive = {process.pid for process in multiprocessing.active_children()}
        seen |= alive
        if not running:
            for pid in sorted(seen - alive - told):
                say(f"the worker {pid} has died between two batches; it was replaced")
            return
        finished, _ = wait(running, return_when=FIRST_COMPLETED)
        for future in finished:
            n = running.pop(future)
            try:
                result = future.result()
            except ProcessExpired as death:
                told.add(death.pid)
                deaths[n] += 1
                again = deaths[n] < DEATHS_MOST
                say(
                    f"the worker {death.pid} has died ({_cause(death.exitcode)}) with {name(jobs[n][0])}; it is "
                    "replaced, "
                    f"{'they are computed again' if again else f'they have killed {DEATHS_MOST} and are left out'}"
                )
                if again:
                    schedule(n)
                    continue
                result = None
            yield n, result


def _leave_ctrl_c_to_the_parent() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _cause(exitcode: int | None) -> str:
    if exitcode is not None and exitcode < 0:
        try:
            return signal.Signals(-exitcode).name
        except ValueError:
            return f"signal {-exitcode}"
    return f"exit status {exitcode}"


def default_workers() -> int:
    """One for each processor that this process may use."""
    return len(os.sched_getaffinity(0))


def on_processes(
    base: Base, todo: Sequence[Batch], code: str, workers: int, say: Say
) -> Iterator[tuple[Batch, Rows | None]]:
    """The batches and their rows as they finish; None for one that killed its worker twice."""
    jobs = [(batch, (base, batch.arms, code)) for batch in todo]
    yield from in_processes(run_batch, jobs, workers, say, lambda batch: batch.name)


# ---- a cluster -------------------------------------------------------------------------------------


def on_cluster(
    base: Base, todo: Sequence[Batch], code: str, address: str, say: Say
) -> Iterator[tuple[Batch, Rows | None]]:
    """As :func:`on_processes`, by the workers of a scheduler that is there.

    Raises
    ------
    ConfigError
        When there is no such scheduler, or its workers cannot do it.
    WorkersLostError
        When the scheduler or all workers go away.
    """
    client = _connect(address)
    try:
        yield from _compute(client, base, todo, code, address, say)
    finally:
        client.close(timeout=2)


def _connect(address: str) -> Client:
    try:
        import logging

        from distributed import Client
    except ImportError as error:
        raise ConfigError(
            'the package distributed is missing; install the extra: .venv/bin/pip install ".[cluster]"'
        ) from error
    for logger in [name for name in logging.root.manager.loggerDict if name.startswith("distributed")]:
        logging.getLogger(logger).setLevel(logging.CRITICAL + 1)  # what happens to the cluster is said here
    try:
        return Client(address, timeout=CONNECT_S, set_as_default=False, name="diarc-campaign")
    except (OSError, TimeoutError, ValueError) as error:
        raise ConfigError(
            f"--cluster {address}: no scheduler answers there within {CONNECT_S:g} s; start one with "
            "`dask scheduler`, and workers with `dask worker tcp://HOST:8786 --nthreads 1`"
        ) from error


def _compute(
    client: Client, base: Base, todo: Sequence[Batch], code: str, address: str, say: Say
) -> Iterator[tuple[Batch, Rows | None]]:
    from distributed import CancelledError, KilledWorker
    from distributed.comm import CommClosedError

    waiting = iter(todo)
    running: dict[Any, Batch] = {}
    known = _workers(client, address)
    alone_since: float | None = None
    while True:
        room = QUEUED_PER_WORKER * max(len(known), 1) - len(running)
        for batch in itertools.islice(waiting, max(room, 0)):
            running[client.submit(run_batch, base, batch.arms, code, pure=False)] = batch
        if not running:
            break
        finished = [future for future in running if future.done()]
        if not finished:
            time.sleep(LOOK_S)
            if client.status != "running":
                raise WorkersLostError(f"the scheduler at {address} has gone away")
            there = _workers(client, address)
            for gone in sorted(known - there):
                say(f"the worker {gone} has gone; what it had is given to others")
            known = there
            alone_since = None if there else (alone_since or time.monotonic())
            if alone_since is not None and time.monotonic() - alone_since > NO_WORKERS_S:
                raise WorkersLostError(f"the scheduler at {address} has had no workers for {NO_WORKERS_S:g} s")
        for future in finished:
            batch = running.pop(future)
            try:
                yield batch, future.result()
            except (CancelledError, CommClosedError) as error:
                raise WorkersLostError(f"the scheduler at {address} has gone away") from error
            except KilledWorker:
                say(f"{batch.name} killed their workers and are left out")
                yield batch, None
            except OtherCodeError as error:
                raise ConfigError(
                    f"--cluster {address}: a worker {error}; bring it in step with this folder"
                ) from error
            except ModuleNotFoundError as error:
                raise ConfigError(
                    f"--cluster {address}: a worker cannot import {error.name}; start scheduler and workers in the "
                    "project's folder and its environment, with PYTHONPATH=."
                ) from error


def _workers(client: Client, address: str) -> set[str]:
    """Addresses of the workers that the scheduler has."""
    try:
        return set(client.scheduler_info(n_workers=-1)["workers"])
    except (OSError, TimeoutError) as error:
        raise WorkersLostError(f"the scheduler at {address} has gone away") from error
