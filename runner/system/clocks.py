"""The difference between the clocks of two machines, with bounds from the messages that they exchange. Pure."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

SECOND_NS = 1_000_000_000
MOST_DRIFT = 5e-4  # of two clocks: crystals drift by 100 ppm; adjtime(3) slews a clock by 500 ppm
SET_S = 5e-4  # a clock that moved by more than this plus the drift between two exchanges was set or slewed faster
STEP_S = 5e-3  # one that moved by this much was set, perhaps in the middle of an exchange
KEPT_S = 10.0  # how long an exchange is used; without a newer one the difference is unknown


class Exchange(NamedTuple):
    """A message to the other machine and its answer, as in RFC 5905, figure 15; s since 1970.

    sent, returned      by this machine's clock
    received, answered  by the other's
    set_s               how far each clock, this machine's and the other's, is ahead of one that is never set
    errors_s            sum of both kernels' stated errors against a common time; None if one is not synchronised
    """

    sent: float
    received: float
    answered: float
    returned: float
    set_s: tuple[float, float] = (0.0, 0.0)
    errors_s: float | None = None


class ClockDifference(NamedTuple):
    """How far the other machine's clock is ahead of this one's, s, and the error bound of that."""

    ahead_s: float
    bound_s: float


class _Interval(NamedTuple):
    """Bounds of the difference at a time, s."""

    at: float
    least: float
    most: float


class ClockComparison:
    """Compares two clocks by exchanged messages.

    No message arrives before it was sent: the request bounds the difference from above, the answer from below. Each
    exchange yields such an interval, whatever the delay in either direction, and the true difference is in all of them.
    The interval of an exchange t seconds ago is widened by the drift since then. Once either clock has been set, or
    slewed faster, only later exchanges count.

    The next exchange shows that a clock was set. Until then, times read from it since the last exchange may be wrong by
    any amount: see `held`.
    """

    def __init__(self) -> None:
        self._set_at = float("-inf")  # when a clock was found to have been set
        self._last_sent = float("-inf")
        self._intervals: deque[_Interval] = deque()
        self._set_s: tuple[float, float] | None = None

    def add(self, at: float, exchange: Exchange) -> None:
        """Add an exchange that was completed at time `at`, s, by a clock that is never set.

        raises  ValueError if the times contradict each other
        """
        if exchange.answered < exchange.received:
            raise ValueError(f"answered {exchange.received - exchange.answered:g} s before it was received")
        interval = _interval(at, exchange)
        if interval.least > interval.most:
            raise ValueError("answered after the answer arrived: a clock was set meanwhile, or its times are wrong")
        before, self._set_s = self._set_s or exchange.set_s, exchange.set_s
        allowed = SET_S + MOST_DRIFT * (at - self._intervals[-1].at if self._intervals else 0.0)
        moved = max(abs(now - then) for now, then in zip(exchange.set_s, before, strict=True))
        if moved > allowed:
            self._intervals.clear()
            self._set_at = at
        if moved < STEP_S:  # otherwise it may have moved in the middle of this exchange
            self._intervals.append(interval)
            self._last_sent = max(self._last_sent, at - (exchange.returned - exchange.sent))

    def was_set_since(self, begin: float) -> bool:
        """Whether a clock is known to have been set after a time, by the same clock."""
        return self._set_at >= begin

    def held(self, begin: float, end: float) -> bool:
        """Whether no clock was set between two times, by the same clock; then `difference` is valid in between."""
        return not self.was_set_since(begin) and end <= self._last_sent

    @property
    def was_set(self) -> bool:
        """Whether a clock was set after the newest exchange that counts."""
        return self._set_at > self._last_sent

    @property
    def last_sent(self) -> float:
        """When the newest exchange that counts was sent, by the same clock."""
        return self._last_sent

    def difference(self, now: float) -> ClockDifference | None:
        """The difference at a time, by the same clock; None if nothing was exchanged for KEPT_S."""
        while self._intervals and now - self._intervals[0].at > KEPT_S:
            self._intervals.popleft()
        if not self._intervals:
            return None
        least, most = float("-inf"), float("inf")
        for interval in reversed(self._intervals):
            drift = MOST_DRIFT * abs(now - interval.at)  # answers may overtake each other
            low, high = max(least, interval.least - drift), min(most, interval.most + drift)
            if low > high:  # a clock has been set in between: only later exchanges count
                break
            least, most = low, high
        return ClockDifference((least + most) / 2, (most - least) / 2)


def _interval(at: float, exchange: Exchange) -> _Interval:
    """Bounds of the difference by one exchange, and by both kernels if these are synchronised and agree with it."""
    drift = MOST_DRIFT * max(0.0, exchange.returned - exchange.sent)
    least = exchange.answered - exchange.returned - drift
    most = exchange.received - exchange.sent + drift
    if exchange.errors_s is not None and -exchange.errors_s <= most and least <= exchange.errors_s:
        least, most = max(least, -exchange.errors_s), min(most, exchange.errors_s)
    return _Interval(at, least, most)
