"""Timers in GLib's main loop."""

from __future__ import annotations

from collections.abc import Callable

from gi.repository import GLib


def every(interval_ms: int, work: Callable[[], None], on_fault: Callable[[str], None]) -> int:
    """Call a function at intervals, in GLib's thread, whatever it raises: PyGObject would end the timer.

    on_fault  called with an exception in words; again only if it changes, or returns after the work has succeeded
    returns   the timer, for `GLib.source_remove`
    """
    fault = ""

    def call() -> bool:
        nonlocal fault
        before, fault = fault, ""
        try:
            work()
        except Exception as error:
            fault = f"{type(error).__name__}: {error}"
            if fault != before:
                on_fault(fault)
        return True

    return int(GLib.timeout_add(interval_ms, call))
