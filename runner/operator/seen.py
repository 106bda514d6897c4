"""What this process shows of the cameras: stated by the page or by a program, for reports to the vehicle."""

from __future__ import annotations

import threading
import time
from math import inf

from msgspec import UNSET, UnsetType

from runner.core.view import View

AGAIN_S = 0.5  # what is unchanged is reported again after so long: the vehicle takes it as outdated after 2 s


class StatedView:
    """From any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._view: View = {}
        self._until = -inf  # time.monotonic
        self._reported: View = {}
        self._reported_at = -inf

    def state(self, view: View | None, for_s: float = inf) -> None:
        """State what is shown, until the next call.

        view   by camera; those not named are shown in full. None: nothing is stated, as without a call
        for_s  how long it holds at most, s
        """
        with self._lock:
            self._view, self._until = view or {}, time.monotonic() + for_s

    @property
    def view(self) -> View:
        """By camera; those not named: in full."""
        with self._lock:
            return self._view if time.monotonic() < self._until else {}

    def report(self, now: float) -> View | UnsetType:
        """What to report, on change and again while it is unchanged; UNSET: nothing. By one thread."""
        view = self.view
        if view == self._reported and (not view or now - self._reported_at < AGAIN_S):
            return UNSET
        self._reported, self._reported_at = view, now
        return view
