"""Worker processes: the terminal's signals do not reach them, and they end with their parent or with an error in it."""

from __future__ import annotations

import ctypes
import signal
import time
from multiprocessing.connection import Connection

import pytest

from runner.rate_quality.workers import open_executor
from runner.system.spawned import FROM_TERMINAL, WorkerContext

PR_GET_PDEATHSIG = 2  # linux/prctl.h

pytestmark = pytest.mark.slow  # starts processes


def describe(pipe: Connection) -> None:
    """Send the signals that this process blocks, and the one that it gets at its parent's end."""
    number = ctypes.c_int()
    ctypes.CDLL(None).prctl(PR_GET_PDEATHSIG, ctypes.byref(number), 0, 0, 0)
    pipe.send((signal.pthread_sigmask(signal.SIG_BLOCK, ()), number.value))


def test_a_worker_leaves_signals_to_its_parent_and_ends_with_it() -> None:
    before = signal.pthread_sigmask(signal.SIG_BLOCK, ())
    context = WorkerContext()
    ours, theirs = context.Pipe()
    worker = context.Process(target=describe, args=(theirs,))
    worker.start()
    assert signal.pthread_sigmask(signal.SIG_BLOCK, ()) == before
    assert ours.poll(60)
    blocked, at_end = ours.recv()
    worker.join()
    assert blocked >= set(FROM_TERMINAL)
    assert at_end == signal.SIGKILL


def test_an_interrupt_does_not_wait_for_running_tasks() -> None:
    began = time.monotonic()
    with pytest.raises(KeyboardInterrupt), open_executor("processes", None, 1) as pool:
        pool.submit(time.sleep, 60)
        raise KeyboardInterrupt
    assert time.monotonic() - began < 30
