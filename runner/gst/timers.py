"""Timers in GLib's main loop."""

from __future__ import annotations

import heapq
import itertools
import threading
import time
import traceback
from collections.abc import Callable

from gi.repository import GLib

TICK_MS = 20  # by which a delayed call may be late


class Delayed:
    """A call that is due later."""

    def __init__(self, work: Callable[[], None]) -> None:
        self.work: Callable[[], None] | None = work

    def cancel(self) -> None:
        self.work = None


class Guarded:
    """Calls a function again and again, whatever it raises.

    on_fault  called with an exception in words; again only if it changes, or returns after the work has succeeded
    """

    def __init__(self, work: Callable[[], None], on_fault: Callable[[str], None]) -> None:
        self._work, self._on_fault, self._fault = work, on_fault, ""

    def __call__(self) -> None:
        before, self._fault = self._fault, ""
        try:
            self._work()
        except Exception as error:
            self._fault = f"{type(error).__name__}: {error}"
            if self._fault != before:
                self._on_fault(self._fault)


class _Delays:
    """Calls that are due later. They share one timer, since each would leak memory: runner/gst/probes.py."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._calls: list[tuple[float, int, Delayed]] = []  # a heap: when due, a number, the call
        self._numbers = itertools.count()
        self._timer = 0

    def add(self, delay_s: float, call: Delayed) -> None:
        with self._lock:
            heapq.heappush(self._calls, (time.monotonic() + delay_s, next(self._numbers), call))
            if not self._timer:
                self._timer = GLib.timeout_add(TICK_MS, self._on_tick)

    def _on_tick(self) -> bool:
        for call in self._due():
            try:
                if call.work:
                    call.work()
            except Exception:
                traceback.print_exc()
        return True

    def _due(self) -> list[Delayed]:
        now, due = time.monotonic(), []
        with self._lock:
            while self._calls and self._calls[0][0] <= now:
                due.append(heapq.heappop(self._calls)[2])
        return due


_delays = _Delays()


def later(delay_s: float, work: Callable[[], None]) -> Delayed:
    """Call a function once in GLib's thread, after a delay. May be called from any thread."""
    call = Delayed(work)
    _delays.add(delay_s, call)
    return call


def every(interval_ms: int, work: Callable[[], None], on_fault: Callable[[str], None]) -> int:
    """Call a function at intervals, in GLib's thread, whatever it raises: PyGObject would end the timer.

    on_fault  as of `Guarded`
    returns   the timer, for `GLib.source_remove`
    """
    guarded = Guarded(work, on_fault)

    def call() -> bool:
        guarded()
        return True

    return int(GLib.timeout_add(interval_ms, call))
