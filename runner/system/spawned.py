"""Worker processes of `multiprocessing` that leave signals of the terminal to their parent and do not outlive it."""

from __future__ import annotations

import signal
from multiprocessing import parent_process, resource_tracker
from multiprocessing.context import SpawnContext, SpawnProcess

from runner.system.bound import die_with

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
