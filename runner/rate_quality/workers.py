"""Where tasks run: threads or processes of this machine, or a cluster, all behind Python's executor interface."""

from __future__ import annotations

import os
from collections.abc import Iterator
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from multiprocessing import get_context

from runner.errors import RunError

SCHEDULER_S = 10  # a Dask scheduler that has not answered by then is not there


def parallel_tasks(wanted: int | None) -> int:
    """How many tasks run at once on this machine; each has many threads of its own."""
    return wanted or max(1, (os.cpu_count() or 1) // 2)


@contextmanager
def open_executor(workers: str, scheduler: str | None, parallel: int) -> Iterator[Executor]:
    """Where tasks run.

    workers  threads or processes of this machine, or dask: a cluster
    raises   RunError where Dask is not installed or its scheduler does not answer
    """
    if workers == "dask":
        with _dask(scheduler, parallel) as executor:
            yield executor
        return
    # GStreamer's threads do not survive a fork.
    pool = ThreadPoolExecutor(parallel) if workers == "threads" else ProcessPoolExecutor(parallel, get_context("spawn"))
    try:
        yield pool
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


@contextmanager
def _dask(scheduler: str | None, parallel: int) -> Iterator[Executor]:
    """An executor on a cluster: tasks of a worker that is lost are run by another."""
    try:
        from distributed import Client, LocalCluster
    except ImportError:
        raise RunError("workers=dask needs Dask: pip install 'tod-runner[cluster]'") from None
    with ExitStack() as stack:
        try:
            own = {"n_workers": parallel, "threads_per_worker": 1, "dashboard_address": None}
            address = scheduler or stack.enter_context(LocalCluster(**own))
            client = stack.enter_context(Client(address, timeout=SCHEDULER_S))
        except OSError as error:
            raise RunError(f"the Dask scheduler {scheduler or ''} does not answer: {error}") from None
        yield client.get_executor()
