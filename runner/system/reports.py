"""Reports of what peers can cause in any number: they must not fill a log, a disk or an operator's screen."""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable

REPEAT_S = 10.0
PERIOD_S = 3600.0
MOST = 100  # texts in a period; further ones, and repeated ones, are only counted
MOST_OF_PEER = 10  # of these
LONGEST = 1000  # characters of a text


class RepeatedReports:
    """Passes on a text that is repeated, such as an ongoing fault, at most every REPEAT_S. To be used in one thread."""

    def __init__(self, on_report: Callable[[str], None]) -> None:
        self._on_report = on_report
        self._reported: dict[str, float] = {}  # by text, when it was last passed on

    def __call__(self, text: str) -> None:
        now = time.monotonic()
        self._reported = {known: at for known, at in self._reported.items() if now - at < REPEAT_S}
        if text not in self._reported:
            self._reported[text] = now
            self._on_report(text)


class LimitedReports:
    """Passes on each text once in a period, and MOST of them. May be called from any thread.

    A peer chooses part of its texts, such as a path: it has only MOST_OF_PEER, so that others are reported, too. An
    ongoing problem stays visible: the first text of a later period comes with the number left out before it.

    on_report  called with a text
    clock      returns the time, s
    """

    def __init__(self, on_report: Callable[[str], None], clock: Callable[[], float] = time.monotonic) -> None:
        self._on_report, self._clock = on_report, clock
        self._lock = threading.Lock()
        self._ends = float("-inf")  # of this period
        self._passed_on: set[str] = set()  # in this period
        self._of_peer: Counter[str] = Counter()  # number of these by peer
        self._suppressed = 0  # since the last text that was passed on in a new period

    def __call__(self, text: str, peer: str) -> None:
        text, suppressed = text[:LONGEST], 0
        with self._lock:
            if self._clock() >= self._ends:
                self._ends = self._clock() + PERIOD_S
                self._passed_on.clear()
                self._of_peer.clear()
                suppressed, self._suppressed = self._suppressed, 0
            most = len(self._passed_on) >= MOST or self._of_peer[peer] >= MOST_OF_PEER
            if most or text in self._passed_on:
                self._suppressed += 1
                return
            self._passed_on.add(text)
            self._of_peer[peer] += 1
        if suppressed:
            self._on_report(f"{suppressed} similar reports were suppressed before this one")
        self._on_report(text)
