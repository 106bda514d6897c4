"""Refuses requests, and counts what is refused: a flood costs the vehicle little."""

from __future__ import annotations

from collections.abc import Callable

from runner.records.vehicle import Outcome
from runner.schema import shortened
from runner.system.reports import LimitedReports
from runner.vehicle.inbox import Request

REFUSALS = 10  # answered per sender between two ticks; further ones are only counted


class Refusals:
    """May be used from any thread.

    now        returns the vehicle's time, s
    is_full    whether another request of a sender would probably be refused
    on_report  called with requests that their sender may not make, a limited number of each
    """

    def __init__(
        self, now: Callable[[], float], is_full: Callable[[str], bool], on_report: Callable[[str], None]
    ) -> None:
        self._report_denial = LimitedReports(on_report)
        self._now, self._is_full = now, is_full
        self.count = 0
        self._recent: dict[str, int] = {}  # by sender, since the last tick

    def tick(self) -> None:
        self._recent = {}

    def overrun(self, sender: str, *, reports: bool = False) -> bool:
        """Whether a sender floods the vehicle, so that its message is only counted, not parsed.

        reports  of reception reports, which are not answered: an invalid report counts like an excess one
        """
        if self._recent.get(sender, 0) < REFUSALS or not (reports or self._is_full(sender)):
            return False
        self.count += 1
        return True

    def reject(self, sender: str) -> int:
        """Count an invalid or excess reception report; returns how many of the sender were refused since the tick."""
        self.count += 1
        recent = self._recent[sender] = self._recent.get(sender, 0) + 1
        return recent

    def refuse(self, request: Request, problem: str) -> None:
        """Refuse a request; answers to one sender between two ticks are limited."""
        recent = self.reject(request.sender)
        if request.answer and (not request.sender or recent <= REFUSALS):
            request.answer(Outcome(self._now(), "refused", problem))

    def deny(self, request: Request, event: str, why: str) -> None:
        """Refuse a request that its sender may not make, and report it."""
        self._report_denial(f"refused {shortened(event)} of {request.sender}: {why}", request.sender)
        self.refuse(request, why)
