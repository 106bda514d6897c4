"""Where tasks run: threads or processes of this machine, or a cluster, all behind Python's executor interface."""

from __future__ import annotations

import gc
import os
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from typing import ParamSpec, TypeVar

from runner.errors import RunError
from runner.system.extras import how_to_install
from runner.system.spawned import ending, process_pool

P = ParamSpec("P")
T = TypeVar("T")

SCHEDULER_S = 10  # timeout for the answer of a Dask scheduler


def parallel_tasks(requested: int | None) -> int:
    """How many tasks run in parallel on this machine; each has many threads of its own."""
    return requested or max(1, (os.cpu_count() or 1) // 2)


@contextmanager
def open_executor(workers: str, scheduler: str | None, parallel: int) -> Iterator[Executor]:
    """Where tasks run.

    workers  threads or processes of this machine, or dask: a cluster
    raises   RunError if Dask is not installed or its scheduler does not answer
    """
    if workers == "dask":
        with _dask(scheduler, parallel) as executor:
            yield executor
        return
    with ending(ThreadPoolExecutor(parallel)) if workers == "threads" else process_pool(parallel) as pool:
        yield pool


@contextmanager
def _dask(scheduler: str | None, parallel: int) -> Iterator[Executor]:
    """An executor on a cluster: tasks of a lost worker are run by another."""
    try:
        from distributed import Client, LocalCluster
    except ImportError:
        raise RunError(f"workers=dask needs Dask: {how_to_install('cluster')}") from None
    with ExitStack() as stack:
        try:
            own = {"n_workers": parallel, "threads_per_worker": 1, "dashboard_address": None}
            address = scheduler or stack.enter_context(LocalCluster(**own))
            client = stack.enter_context(Client(address, timeout=SCHEDULER_S))
        except OSError as error:
            raise RunError(f"the Dask scheduler {scheduler or ''} does not answer: {error}") from None
        yield _Cluster(client.get_executor())


class _Cluster(Executor):
    """A cluster whose tasks run without cyclic garbage collection."""

    def __init__(self, executor: Executor) -> None:
        self._executor = executor

    def submit(self, function: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        return self._executor.submit(without_cycle_collection, function, *args, **kwargs)


class _Collector:
    """Keeps Python's cyclic garbage collector off while any thread of the process requires it."""

    def __init__(self) -> None:
        self._lock, self._users, self._was_on = threading.Lock(), 0, False

    def __enter__(self) -> None:
        with self._lock:
            if not self._users:
                self._was_on = gc.isenabled()
                gc.disable()
            self._users += 1

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._users -= 1
            if not self._users and self._was_on:
                gc.enable()


_collector = _Collector()


def without_cycle_collection(function: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> T:
    """Call a function without cyclic garbage collection; it resumes after the last such call of the process.

    A Dask worker inspects the frames of its threads every few milliseconds. If cycles are collected at that moment and
    a thread of GStreamer enters Python for the first time, early releases of Python 3.11, Debian 12's among them,
    deadlock (https://github.com/python/cpython/issues/106883). Tasks last seconds to minutes and leave few cycles,
    however many frames they process.
    """
    with _collector:
        return function(*args, **kwargs)
