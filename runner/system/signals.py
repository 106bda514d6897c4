"""SIGINT, SIGTERM and SIGHUP, the same for every verb; with `nohup`, SIGHUP stays ignored.

The first signal asks the verb to end. It raises KeyboardInterrupt in the main thread or, after `stopping`, sets a
`Stop` that the verb checks. A second signal ends the process immediately, and so does a shutdown that exceeds its
time limit; files are still complete or absent, since `urgent` registers the necessary cleanup.

This does not happen in signal handlers. The interpreter writes the number of each signal to a pipe
(signal.set_wakeup_fd), and a thread reads it: a second signal cannot interrupt the handling of the first, and a main
thread that is busy in a C library delays nothing. Only the exception comes from a handler. Python discards one that is
raised in a destructor or a callback of a weak reference, as of each module that is imported; it is then raised again.

A process with a lifeline (see `runner.system.children`) treats the end of its parent as SIGTERM.
"""

from __future__ import annotations

import os
import select
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType

LIFELINE = "TOD_RUNNER_LIFELINE"  # environment variable: descriptor of a pipe whose other end is open in the parent
TWICE_S = 0.2  # the same signal again within this time is one: `timeout` sends its own to the process and to its group
AGAIN_S = 0.01  # after a discarded exception: by then Python has reported it
END_S = 2.0  # how long an orderly shutdown may take
URGENT_S = 0.5  # how long cleanup may take without an orderly shutdown
NUMBERS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)

Action = Callable[[], object]


class Stop:
    """Set when the verb must end. May be used from any thread.

    limit_s  how long the shutdown may take from then on; None: unlimited
    action   called once when it is set, from another thread
    """

    def __init__(self, limit_s: float | None = END_S, action: Action = lambda: None) -> None:
        self.limit_s, self._action = limit_s, action
        self._event = threading.Event()

    def is_set(self) -> bool:
        return self._event.is_set()

    @property
    def status(self) -> int:
        """Exit status of a verb that ends normally: 130 after Ctrl-C, otherwise 0."""
        return 128 + signal.SIGINT if self.is_set() and _watch.number == signal.SIGINT else 0

    def set(self) -> None:
        if not self._event.is_set():
            self._event.set()
            self._action()

    def wait(self, timeout_s: float) -> bool:
        """Wait until it is set or the timeout has passed; returns whether it is set."""
        return self._event.wait(timeout_s)


class _Watch:
    """The signals that this process has received so far, and the thread that reads them."""

    def __init__(self) -> None:
        self.number = 0  # of the first signal
        self.stop: Stop | None = None
        self.urgent: list[Action] = []
        self.delivered = False  # whether the main thread has been notified
        self.interrupted = False  # whether the main thread was interrupted by an exception
        self._discarded = False  # whether Python has discarded that exception
        self._taken = (0, 0.0)  # the last signal that was read, and when
        self._repeated = 0  # signals that this process sends itself and that have not been read yet
        self._deadline: float | None = None

    @contextmanager
    def handled(self) -> Iterator[None]:
        """Handle the signals, and restore the previous handlers at the end."""
        self.number, self.stop, self._deadline = 0, Stop(), None
        self.delivered = self.interrupted = self._discarded = False
        self._repeated = 0
        read, write = os.pipe()
        os.set_blocking(write, False)
        self._wakeup, self._over = write, False
        ignored = {signal.SIGHUP} if signal.getsignal(signal.SIGHUP) == signal.SIG_IGN else set()
        before = {number: signal.signal(number, self._on_signal) for number in NUMBERS if number not in ignored}
        wakeup = signal.set_wakeup_fd(write, warn_on_full_buffer=False)
        self._report_unraisable, sys.unraisablehook = sys.unraisablehook, self._on_unraisable
        thread = threading.Thread(target=self._run, args=(read, _lifeline()), name="signals", daemon=True)
        thread.start()
        try:
            yield
        finally:
            self._over = True
            self._wake()
            # Joined first: it may still receive a signal, and Python reports one whose handler has been removed.
            thread.join(END_S)
            sys.unraisablehook = self._report_unraisable
            signal.set_wakeup_fd(wakeup)
            for number, handler in before.items():
                signal.signal(number, handler)
            if not thread.is_alive():
                os.close(write)
                os.close(read)

    def _on_signal(self, number: int, _frame: FrameType | None) -> None:
        """Called by the interpreter in the main thread, before or after the thread has read the number."""
        self.number = self.number or number  # the thread may not have read it yet
        if self.stop is None and not self.delivered:
            self.delivered = self.interrupted = True
            raise KeyboardInterrupt

    def _on_unraisable(self, unraisable: sys.UnraisableHookArgs) -> None:
        """Called by the interpreter with an exception that it discards."""
        if self.interrupted and unraisable.exc_type is KeyboardInterrupt:
            self._discarded = True
            self._wake()
        else:
            self._report_unraisable(unraisable)

    def _interrupt_again(self) -> None:
        time.sleep(AGAIN_S)
        self._discarded = self.delivered = False
        self._repeated += 1
        signal.pthread_kill(threading.main_thread().ident or 0, self.number)

    def _run(self, wakeup: int, lifeline: int | None) -> None:
        ready = select.poll()
        ready.register(wakeup, select.POLLIN)
        if lifeline is not None:
            ready.register(lifeline, select.POLLIN)
        while not self._over:
            found = {number for number, _ in ready.poll(self._left_ms())}
            if lifeline in found and lifeline is not None:
                ready.unregister(lifeline)
                if not self.number:
                    os.kill(os.getpid(), signal.SIGTERM)
            if wakeup in found:
                for number in filter(NUMBERS.__contains__, os.read(wakeup, 64)):
                    self._take(number)
            if self._discarded:
                self._interrupt_again()
            if self._deadline is not None and time.monotonic() >= self._deadline:
                self._end("shutdown timed out: ending now")

    def _take(self, number: int) -> None:
        if self._repeated:
            self._repeated -= 1
            return
        (last, at), self._taken = self._taken, (number, time.monotonic())
        if number == last and self._taken[1] - at < TWICE_S:
            return
        if self._deadline is not None or (self.stop and self.stop.is_set()):
            self._end("second signal: ending now")
        self.number = self.number or number
        self.begin_shutdown()

    def begin_shutdown(self) -> None:
        """Ask the verb to end: its time limit starts now. May be called from any thread."""
        stop = self.stop
        limit_s = stop.limit_s if stop else END_S
        self._deadline = None if limit_s is None else time.monotonic() + limit_s
        self._wake()
        if stop:
            self.delivered = True
            stop.set()

    def _wake(self) -> None:
        """Make the thread check what has changed."""
        with suppress(BlockingIOError):  # the pipe is full: it is about to check anyway
            os.write(self._wakeup, b"\0")

    def _left_ms(self) -> float | None:
        return None if self._deadline is None else max(0.0, 1000 * (self._deadline - time.monotonic())) + 1

    def _end(self, why: str) -> None:
        """End the process immediately, without waiting for threads or calling libraries."""
        cleaning = threading.Thread(target=self._clean, daemon=True)
        cleaning.start()
        cleaning.join(URGENT_S)
        if select.select([], [2], [], 0)[1]:  # skipped if its reader is stalled
            with suppress(OSError):
                os.write(2, f"{why}\n".encode())
        os._exit(128 + self.number)

    def _clean(self) -> None:
        for action in reversed(self.urgent):
            with suppress(Exception):
                action()


_watch = _Watch()


@contextmanager
def handled() -> Iterator[None]:
    """Within the block signals are handled and interrupt `interruptible` code. No effect outside the main thread."""
    if threading.current_thread() is threading.main_thread():
        with _watch.handled():
            yield
    else:
        yield


@contextmanager
def stopping(limit_s: float | None = END_S, action: Action = lambda: None) -> Iterator[Stop]:
    """From here on a signal only sets the yielded `Stop`, without interrupting, and the verb shuts down cleanly.

    Code after the block counts as part of that shutdown, unless it is `interruptible`.

    limit_s, action  see `Stop`
    """
    stop = _watch.stop = Stop(limit_s, action)
    if _watch.number:  # a signal arrived just before
        _watch.begin_shutdown()
    try:
        yield stop
    finally:
        stop.limit_s = END_S if limit_s is None else limit_s
        if _watch.number and limit_s is None:
            _watch.begin_shutdown()


@contextmanager
def interruptible() -> Iterator[None]:
    """Within the block a signal raises KeyboardInterrupt; one received earlier does so immediately.

    C libraries may turn it into other exceptions, which are treated as KeyboardInterrupt.
    """
    stop, _watch.stop = _watch.stop, None
    try:
        if _watch.number:
            _watch.delivered = True
            raise KeyboardInterrupt
        yield
    except Exception:
        if _watch.interrupted:
            raise KeyboardInterrupt from None
        raise
    finally:
        _watch.stop = stop


def hold() -> None:
    """From here on a signal raises no exception before the next `check`.

    For code before `stopping` that uses PyGObject, which crashes if an exception is raised inside it.
    """
    _watch.stop = Stop()
    if _watch.number:
        _watch.begin_shutdown()


@contextmanager
def urgent(action: Action) -> Iterator[None]:
    """Within the block, register a quick action to run, from any thread, if there is no clean shutdown."""
    _watch.urgent.append(action)
    try:
        yield
    finally:
        _watch.urgent.remove(action)


def check() -> None:
    """For loops that wait while signals do not interrupt, after `hold` and `stopping`.

    raises  KeyboardInterrupt, only in the main thread, if the verb must end
    """
    if _watch.stop and _watch.stop.is_set() and threading.current_thread() is threading.main_thread():
        raise KeyboardInterrupt


def received() -> int:
    """The first signal received, 0 for none."""
    return _watch.number


def _lifeline() -> int | None:
    """The descriptor passed by the parent, which children of this process do not inherit."""
    number = os.environ.pop(LIFELINE, "")
    return int(number) if number.isdecimal() else None
