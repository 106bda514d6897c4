"""The queue in front of a link: when each packet has left it. Pure.

Packets are put one by one, in the order in which they are sent, so each departure is known at once: nothing is
simulated between two packets. Times are s, sizes bytes of IP packets.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from math import ceil, inf
from typing import Protocol

from runner.link.limit import LinkCounters, burst_bytes, queue_bytes
from runner.link.policer import Policer
from runner.simulation.steps import Steps

OPPORTUNITY_BYTES = 1500  # that leave at each recorded opportunity
KBIT = 8 / 1000  # of a byte
SLOWEST_KBPS = 0.001  # of a link that never carries anything again


class Queue(Protocol):
    """A queue of packets."""

    def put(self, t: float, size: int) -> float | None:
        """When a packet sent at t, which never falls, has left; None: it was dropped."""

    def wait_s(self, t: float) -> float:
        """How long a packet sent now would wait."""

    def counters(self, t: float) -> LinkCounters:
        """What it has passed and dropped so far."""


class RateQueue:
    """The queue of `runner.link.bucket`: a token bucket behind a drop-tail queue.

    The rate adds up to what could have left by a time, and packets to what has to leave: the difference of both is what
    waits, whatever the rate was meanwhile.

    rates     kbit/s over time; 0: nothing leaves
    queue_ms  packets that would wait longer at the present rate are dropped
    bursts    whether an idle link passes two packets, or 2 ms, at once, as the real link of `link=` does
    slot_s    packets are delivered at the ends of slots of this length; 0: there are none
    """

    def __init__(
        self,
        rates: Steps,
        queue_ms: float,
        *,
        bursts: bool = True,
        slot_s: float = 0.0,
        policer: Policer | None = None,
    ) -> None:
        self.dropped = self._packets = self._bytes = 0  # packets dropped; packets and bytes put
        self._slot_s, self._policer = slot_s, policer
        self._begins, self._ends = rates.times, [*rates.times[1:], inf]
        self._rates = [*rates.values[:-1], max(SLOWEST_KBPS, rates.values[-1])]
        self._limits = [KBIT * queue_bytes(rate, queue_ms) for rate in self._rates]
        self._bursts = [KBIT * burst_bytes(rate) if bursts else 0.0 for rate in self._rates]
        self._carried = [0.0]  # kbit that could have left by each begin
        for begin, end, rate in zip(self._begins, self._ends, self._rates, strict=True):
            self._carried.append(self._carried[-1] + rate * (end - begin))
        self._now = self._then = 0  # the steps in which packets are put, and leave
        self._level = -self._bursts[0]  # kbit that have to leave: those that have left, and those that wait

    def put(self, t: float, size: int) -> float | None:
        if self._policer and not self._policer.passes(size, t):
            self.dropped += 1
            return None
        now = self._now
        if t >= self._ends[now]:
            now = self._advance(t)
        carried = self._carried[now] + self._rates[now] * (t - self._begins[now])
        kbit = size * KBIT
        level = self._level
        if level - carried + kbit > self._limits[now]:
            self.dropped += 1
            return None
        self._packets += 1
        self._bytes += size
        earliest = carried - self._bursts[now]
        self._level = level = (level if level > earliest else earliest) + kbit
        left = t if level <= carried else self._when(level)
        return ceil(left / self._slot_s - 1e-9) * self._slot_s if self._slot_s else left

    def wait_s(self, t: float) -> float:
        if t >= self._ends[self._now]:
            self._advance(t)
        carried = self._carried[self._now] + self._rates[self._now] * (t - self._begins[self._now])
        return max(0.0, self._when(self._level) - t) if self._level > carried else 0.0

    def counters(self, t: float) -> LinkCounters:
        wait_s = self.wait_s(t)
        waiting = wait_s and self._level - self._carried[self._now] - self._rates[self._now] * (
            t - self._begins[self._now]
        )
        return LinkCounters(round(1000 * wait_s, 1), self._bytes - round(waiting / KBIT), self._packets, self.dropped)

    def _advance(self, t: float) -> int:
        while t >= self._ends[self._now]:
            self._now += 1
        return self._now

    def _when(self, level: float) -> float:
        """When so much could have left."""
        then = self._then
        while self._carried[then + 1] < level:
            then += 1
        self._then = then
        return self._begins[then] + (level - self._carried[then]) / self._rates[then]


class _WaitingQueue:
    """A queue whose packets each have a time at which they leave; those that would wait too long are dropped."""

    def __init__(self, queue_ms: float, policer: Policer | None) -> None:
        self._queue_s, self._policer = queue_ms / 1000, policer
        self._free = 0.0  # when the newest packet has left
        self._dropped = self._packets = self._bytes = 0

    def put(self, t: float, size: int) -> float | None:
        policed = self._policer and not self._policer.passes(size, t)
        left = None if policed or self._free - t > self._queue_s else self._serve(t, size)
        if left is None:
            self._dropped += 1
            return None
        self._packets += 1
        self._bytes += size
        return left

    def wait_s(self, t: float) -> float:
        return max(0.0, self._free - t)

    def counters(self, t: float) -> LinkCounters:
        return LinkCounters(round(1000 * self.wait_s(t), 1), self._bytes, self._packets, self._dropped)

    def _serve(self, t: float, size: int) -> float | None:
        raise NotImplementedError


class OpportunityQueue(_WaitingQueue):
    """Packets leave at recorded opportunities to send, 1500 bytes at each; one that finds no packet is lost.

    As mahimahi's `mm-link` (Netravali et al., USENIX ATC 2015). times: s, rising
    """

    def __init__(self, times: Sequence[float], queue_ms: float, policer: Policer | None = None) -> None:
        super().__init__(queue_ms, policer)
        self._times, self._next, self._left = times, 0, OPPORTUNITY_BYTES

    def _serve(self, t: float, size: int) -> float | None:
        times = self._times
        if self._next < len(times) and times[self._next] < t:
            self._next, self._left = bisect_left(times, t, self._next), OPPORTUNITY_BYTES
        while self._next < len(times):
            if self._left >= size:
                self._left -= size
                self._free = times[self._next]
                return self._free
            size -= self._left
            self._next, self._left = self._next + 1, OPPORTUNITY_BYTES
        return None


class CreditQueue(_WaitingQueue):
    """A scheduler that saves credit while idle and then serves a burst faster, and that a burst waits for.

    peak      how many times as fast as the rate it serves while there is credit
    credit_s  of the rate that it saves at most
    grant_s   that a packet waits which found the queue empty
    slot_s    packets are delivered at the ends of slots of this length; 0: there are none
    """

    def __init__(
        self,
        rates: Steps,
        queue_ms: float,
        *,
        peak: float,
        credit_s: float,
        grant_s: float,
        slot_s: float = 0.0,
        policer: Policer | None = None,
    ) -> None:
        super().__init__(queue_ms, policer)
        self._rates, self._ends = rates.values, [*rates.times[1:], inf]
        self._peak, self._credit_s, self._grant_s, self._slot_s = peak, credit_s, grant_s, slot_s
        self._step, self._credit, self._served = 0, 0.0, 0.0

    def _serve(self, t: float, size: int) -> float:
        at, kbit = max(t, self._served), size * KBIT
        if t > self._served:
            rate = self._rate(t)
            self._credit = min(self._credit_s * rate, self._credit + rate * (t - self._served))
            at += self._grant_s
        while kbit > 1e-9:
            rate = self._rate(at)
            fast = rate * self._peak if self._credit > 1e-9 else rate
            spent = self._credit / (fast - rate) if fast > rate else inf
            span = min(self._ends[self._step] - at, kbit / fast, spent)
            self._credit = max(0.0, self._credit - (fast - rate) * span)
            kbit -= fast * span
            at += span
        self._served = at
        self._free = ceil(at / self._slot_s - 1e-9) * self._slot_s if self._slot_s else at
        return self._free

    def _rate(self, t: float) -> float:
        while t >= self._ends[self._step]:
            self._step += 1
        return max(SLOWEST_KBPS, self._rates[self._step])
