"""A drop-tail queue behind a token bucket: the limit of relay and tunnel. Pure: time is passed in."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from typing import Generic, TypeVar

from runner.link.limit import LinkCounters, burst_bytes, queue_bytes

T = TypeVar("T")


class Bucket(Generic[T]):
    """Packets wait until the bucket has as many tokens (bytes) as they are long; at a rate of 0 they stay.

    Departures are computed, not observed: a late caller gets every packet with its departure time, and a late
    scheduler costs no rate. Times are seconds of any monotonic clock.
    """

    def __init__(self, kbps: float, queue_ms: float, now: float) -> None:
        self._queue_ms = queue_ms
        self._items: deque[tuple[int, T]] = deque()
        self._left: deque[tuple[float, T]] = deque()  # with departure times
        self._backlog = 0  # bytes
        self.reserved = 0  # bytes that only packets to be kept may take
        self._at = now  # time of `_tokens`
        self._passed = self._packets = self._dropped = 0
        self._set(kbps)
        self._tokens: float = self._burst

    def _set(self, kbps: float) -> None:
        self._rate = kbps * 1000 / 8  # bytes/s
        self._burst, self._limit = burst_bytes(kbps), queue_bytes(kbps, self._queue_ms)

    def set_rate(self, kbps: float, now: float) -> None:
        """Change the rate. Queued packets stay, even if they now wait longer than queue_ms."""
        self._advance(now)
        self._fill(now)
        self._set(kbps)

    def has_room(self, size: int) -> bool:
        return self._backlog + size <= self._limit

    def put(self, size: int, item: T, now: float, *, keep: bool = False) -> None:
        """Queue a packet; it is dropped if the queue has no room beside `reserved`, unless it is to be kept."""
        self._advance(now)
        if not (keep or self.has_room(size + self.reserved)):
            self._dropped += 1
            return
        if not self._items:
            self._fill(now)
        self._items.append((size, item))
        self._backlog += size

    def due(self) -> float | None:
        """Departure time of the next packet, which may be in the past; None: the queue is empty."""
        return self._left[0][0] if self._left else self._next()

    def take(self, now: float) -> Iterator[tuple[float, T]]:
        """Packets that have departed by now, each with its departure time."""
        self._advance(now)
        while self._left:
            yield self._left.popleft()

    def counters(self, now: float) -> LinkCounters:
        self._advance(now)
        waiting = max(0.0, self._backlog - self._tokens - max(0.0, now - self._at) * self._rate)
        wait_ms = 1000 * waiting / self._rate if self._rate else self._queue_ms if waiting else 0.0
        return LinkCounters(wait_ms, self._passed, self._packets, self._dropped)

    def _next(self) -> float | None:
        if not self._items:
            return None
        missing = max(0.0, self._items[0][0] - self._tokens)
        if missing and not self._rate:
            return None
        return self._at + (missing / self._rate if missing else 0.0)

    def _advance(self, now: float) -> None:
        """Let all packets depart that are due."""
        while (when := self._next()) is not None and when <= now:
            self._fill(when)
            size, item = self._items.popleft()
            self._tokens -= size
            self._backlog -= size
            self._passed += size
            self._packets += size > 0  # the end of a connection is queued as well, without a packet
            self._left.append((when, item))

    def _fill(self, now: float) -> None:
        # A packet longer than the bucket gets the tokens that it needs, too.
        most = max(self._burst, self._items[0][0]) if self._items else self._burst
        self._tokens = min(most, self._tokens + max(0.0, now - self._at) * self._rate)
        self._at = max(self._at, now)
