"""Worker processes of `multiprocessing` that leave signals of the terminal to their parent and do not outlive it."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import active_children, parent_process, resource_tracker
from multiprocessing.context import SpawnContext, SpawnProcess
from typing import TYPE_CHECKING

from runner.system.bound import die_with

if TYPE_CHECKING:
    from concurrent.futures import Executor

FROM_TERMINAL = (signal.SIGINT, signal.SIGHUP)  # sent to all processes of a terminal


class _Worker(SpawnProcess):
    def start(self) -> None:
        """Start it with the terminal's signals blocked: it could ignore them only once it has loaded its modules."""
        resource_tracker.ensure_running()  # its first start unblocks SIGINT
        before = signal.pthread_sigmask(signal.SIG_BLOCK, FROM_TERMINAL)
        try:
            super().start()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)

    def run(self) -> None:
        parent = parent_process()
        assert parent and parent.pid
        die_with(parent.pid)
        super().run()


class WorkerContext(SpawnContext):
    """Starts fresh interpreters: a fork of a process that has used GStreamer or threads may hang.

    The thread that starts a worker must stay alive as long as the worker.
    """

    Process = _Worker


@contextmanager
def process_pool(workers: int) -> Iterator[Executor]:
    """A pool of worker processes that ends with the block."""
    from concurrent.futures import ProcessPoolExecutor

    with ending(ProcessPoolExecutor(workers, WorkerContext())) as pool:
        yield pool


@contextmanager
def ending(pool: Executor) -> Iterator[Executor]:
    """End a pool with the block. An error, or Ctrl-C, kills its processes, whose tasks may take minutes."""
    before = active_children()
    try:
        yield pool
    except BaseException:
        for worker in active_children():
            if worker not in before:
                worker.kill()
        raise
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
