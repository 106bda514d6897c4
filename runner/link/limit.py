"""What a limited link does to packets, defined once for both kinds of link. Pure.

Sizes are bytes as each kind counts them: netns the Ethernet frame, the relay the IP packet (14 bytes less).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

FRAME_BYTES = 1514  # the largest Ethernet frame of an MTU of 1500
BURST_S = 0.002  # of data that an idle link passes at once; with less, late timers on a busy machine would cost rate
SLOWEST_KBPS = 1.0  # tbf cannot stop completely; at this rate one packet passes in 10 s


@dataclass(frozen=True)
class Reverse:
    """The direction from operator to vehicle: a constant rate, kbit/s, and otherwise as in `Limit`."""

    kbps: float
    queue_ms: float
    delay_ms: float
    loss: float = 0.0
    burst: float = 1.0


@dataclass(frozen=True)
class Limit:
    """What the link does to all traffic from the vehicle to the operator.

    kbps_at   rate in force t seconds after the start of the drive; below 1 kbit/s it is 1 kbit/s
    queue_ms  packets that would wait longer are dropped
    delay_ms  one way, in addition to the wait
    loss      share of UDP packets that are lost after the queue
    burst     mean number of packets that are lost in a row
    reverse   what it does to traffic from the operator to the vehicle; None: nothing
    """

    kbps_at: Callable[[float], float]
    queue_ms: float
    delay_ms: float
    loss: float = 0.0
    burst: float = 1.0
    reverse: Reverse | None = None

    def kbps(self, t: float) -> float:
        """The rate to set, kbit/s; before the start, the rate at the start."""
        return max(SLOWEST_KBPS, float(self.kbps_at(max(0.0, t))))


@dataclass(frozen=True, slots=True)
class LinkCounters:
    """Counters of a link since it was set up.

    queue_ms  wait of a packet that arrives now
    bytes     forwarded from vehicle to operator
    packets   of these
    dropped   packets that found the queue full
    lost      packets lost after the queue
    """

    queue_ms: float
    bytes: int
    packets: int
    dropped: int
    lost: int = 0


class Shaper(Protocol):
    """Sets rates and reads counters."""

    def limit(self, kbps: float) -> LinkCounters:
        """Set the rate; returns the counters. raises RunError if the link is gone"""

    def check(self) -> None:
        """raises RunError if the link is gone"""


def burst_bytes(kbps: float) -> int:
    """Size of the token bucket: two full frames, or 2 ms of the rate."""
    return max(2 * FRAME_BYTES, round(kbps * 1000 / 8 * BURST_S))


def queue_bytes(kbps: float, queue_ms: float) -> int:
    """Length of the queue at a rate: queue_ms of it, but at least the bucket, or a slow link would pass nothing."""
    return max(burst_bytes(kbps), round(kbps * queue_ms / 8))
