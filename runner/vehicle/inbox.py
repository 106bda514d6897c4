"""Requests queued for the vehicle's loop: bounded, fair between senders, in order for each of them."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from runner.records.reception import ReceptionReport
from runner.records.vehicle import Outcome

MAX_QUEUED = 64  # requests of one sender; further ones are refused
ROUND_S = 0.1
MAX_PER_ROUND = 32  # requests processed per sender and round: a flood leaves CPU time for others
MAX_SENDERS = 64  # senders with queued requests; requests of further senders are refused
MODE_CHANGING = "mode_selected"
MEASUREMENTS = ("position_reported", "steering_reported", "bitrate_predicted")  # only the newest one counts

Answer = Callable[[Outcome], None]


class Request(NamedTuple):
    """An event as JSON without `t`, and how to answer it.

    sender  operator's id from the topic; "" for this process
    as_of   see `runner.vehicle.operators`; None for this process, which need not state it
    will    whether the broker sent it as the last will of an operator
    run     the process whose goodbye it is; None: not stated
    """

    sender: str
    document: Mapping[str, Any]
    answer: Answer | None = None
    as_of: float | None = None
    will: bool = False
    run: int | None = None

    def reply(self, outcome: Outcome) -> None:
        if self.answer:
            self.answer(outcome)

    @property
    def queue(self) -> str:
        return self.sender

    @property
    def measures(self) -> tuple[str, object] | None:
        """Its event and uplink, if it measures a quantity, so that a newer measurement supersedes it."""
        name = self.document.get("event")
        return (name, self.document.get("uplink", "")) if name in MEASUREMENTS else None

    @property
    def changes_mode(self) -> bool:
        return self.document.get("event") == MODE_CHANGING


class QueuedReport(NamedTuple):
    """A reception report of an operator. Reports do not supersede each other: each covers the time since the last.

    state_clock  sends the vehicle's clock to the operator; None: it was not requested
    """

    sender: str
    report: ReceptionReport
    state_clock: Callable[[], None] | None = None

    @property
    def queue(self) -> str:
        """Its own queue, so that reports do not displace the sender's requests."""
        return f"{self.sender}/reception"

    @property
    def measures(self) -> None:
        return None

    @property
    def changes_mode(self) -> bool:
        return False


Item = Request | QueuedReport


class Inbox:
    """Requests of all senders, served round-robin. May be used from any thread.

    Requests are never merged or reordered, except that a measurement replaces an older one of the same quantity,
    unless a request in between changes the mode.
    """

    def __init__(self) -> None:
        self._waiting: dict[str, deque[Item]] = {}  # by sender, in the order of their turns
        self._filled = threading.Condition()
        self._woken = False
        self._taken: dict[str, int] = {}  # by sender, in this round
        self._round_ends = 0.0

    def put(self, request: Item) -> Item | None:
        """Queue a request; returns the one that is dropped as a result: itself, an older measurement, or None."""
        with self._filled:
            waiting = self._waiting.get(request.queue)
            if waiting is None:
                if len(self._waiting) >= MAX_SENDERS:
                    return request
                waiting = self._waiting[request.queue] = deque()
            older = _superseded(waiting, request)
            if older is None and len(waiting) >= MAX_QUEUED:
                return request
            superseded = None if older is None else waiting[older]
            if older is not None:
                del waiting[older]
            waiting.append(request)
            self._filled.notify()
            return superseded

    def wake(self) -> None:
        """Make `get` return although nothing has arrived."""
        with self._filled:
            self._woken = True
            self._filled.notify()

    def senders(self) -> frozenset[str]:
        """Senders with queued requests or reports."""
        with self._filled:
            return frozenset(waiting[0].sender for waiting in self._waiting.values())

    def is_full(self, sender: str) -> bool:
        """Whether another request of a sender would probably be refused."""
        return len(self._waiting.get(sender, ())) >= MAX_QUEUED

    def get(self, until: float) -> Item | None:
        """The next request, as soon as there is one; None once woken or after `until`, by `time.monotonic()`."""
        with self._filled:
            while True:
                now = time.monotonic()
                sender = self._next_sender(now)
                if sender is not None or self._woken or now >= until:
                    break
                self._filled.wait(min(until, self._round_ends if self._waiting else until) - now)
            self._woken = False
            if sender is None:
                return None
            waiting = self._waiting.pop(sender)
            request = waiting.popleft()
            if waiting:
                self._waiting[sender] = waiting  # after all others
            self._taken[sender] = self._taken.get(sender, 0) + 1
            return request

    def _next_sender(self, now: float) -> str | None:
        """The sender whose turn it is."""
        if now >= self._round_ends:
            self._taken.clear()
            self._round_ends = now + ROUND_S
        return next((sender for sender in self._waiting if self._taken.get(sender, 0) < MAX_PER_ROUND), None)


def _superseded(waiting: deque[Item], newer: Item) -> int | None:
    """Index of the older measurement of the same quantity since the last change of the mode."""
    if newer.measures is None:
        return None
    for index in range(len(waiting) - 1, -1, -1):
        if waiting[index].changes_mode:
            return None
        if waiting[index].measures == newer.measures:
            return index
    return None
