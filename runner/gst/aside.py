"""State changes that may hang, run off the thread that serves all cameras."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from gi.repository import Gst

from runner.gst.memory import give_back

HUNG_S = 5.0  # a state change that takes longer counts as hung
HUNG = f"did not stop within {HUNG_S:g} s, and was abandoned"
HUNG_STARTING = f"did not start within {HUNG_S:g} s"

_workers: set[threading.Thread] = set()
_lock = threading.Lock()


def set_state_in_thread(
    element: Gst.Element,
    state: Gst.State,
    on_hung: Callable[[], None] = lambda: None,
    after: threading.Thread | None = None,
    first: Callable[[], object] = lambda: None,
) -> threading.Thread:
    """Set an element's state as `change_in_thread` does.

    first  called before, in the same thread
    """

    def change() -> None:
        first()
        element.set_state(state)
        if state == Gst.State.NULL:
            give_back()

    return change_in_thread(state.value_nick, change, on_hung, after)


def change_in_thread(
    to: str, change: Callable[[], object], on_hung: Callable[[], None], after: threading.Thread | None = None
) -> threading.Thread:
    """Change an element's state in a separate thread, which ends with the change.

    Network elements can deadlock in a state change, and devices block it for seconds. A thread cannot be killed, so a
    hung one is abandoned.

    to       the new state, for the thread's name
    on_hung  called once, from another thread, when the change has taken HUNG_S
    after    an earlier state change of this element, which must finish first
    """
    watchdog = threading.Timer(HUNG_S, on_hung)
    watchdog.daemon = True

    def work() -> None:
        if after:
            after.join()
        change()
        watchdog.cancel()
        with _lock:
            _workers.discard(worker)

    worker = threading.Thread(target=work, name=f"to {to}", daemon=True)
    watchdog.start()
    with _lock:
        worker.start()
        _workers.add(worker)
    return worker


def settle(limit_s: float) -> None:
    """Wait for all pending changes, up to a time limit."""
    deadline = time.monotonic() + limit_s
    with _lock:
        workers = list(_workers)
    for worker in workers:
        worker.join(max(0.0, deadline - time.monotonic()))
