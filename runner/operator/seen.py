"""What this process shows of the cameras: stated by the page or by a program, for reports to the vehicle."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from math import inf

from msgspec import UNSET, UnsetType

from runner.core.view import View, together

AGAIN_S = 0.5  # what is unchanged is reported again after so long: the vehicle takes it as outdated after 2 s


class StatedView:
    """What the page, a program and others show together. From any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._views: dict[str, tuple[View, float]] = {}  # and until when each holds: time.monotonic
        self._reported: View = {}
        self._reported_at = -inf
        self.on_change: Callable[[], None] = lambda: None  # called when something else is stated than was reported

    def state(self, view: View | None, for_s: float = inf, *, by: str = "program") -> None:
        """State what is shown, until the next call.

        view   by camera; those not named are shown in full. None: nothing is stated; all is shown in full
        for_s  how long it holds at most, s; then all is shown in full
        by     by whom; from the first call on, whatever others show is sent as well
        """
        with self._lock:
            self._views[by] = view or {}, time.monotonic() + for_s
        if self.view != self._reported:
            self.on_change()

    @property
    def view(self) -> View:
        """By camera; those not named: in full."""
        now = time.monotonic()
        with self._lock:
            return together(view if now < until else {} for view, until in self._views.values())

    def report(self, now: float) -> View | UnsetType:
        """What to report, on change and again while it is unchanged; UNSET: nothing. By one thread."""
        view = self.view
        if view == self._reported and (not view or now - self._reported_at < AGAIN_S):
            return UNSET
        self._reported, self._reported_at = view, now
        return view
