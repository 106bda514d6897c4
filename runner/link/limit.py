"""What a limited link does to packets, stated once for both kinds of link. Pure.

Sizes are bytes as each kind counts them: netns the Ethernet frame, the relay the IP packet (14 bytes less).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

FRAME_BYTES = 1514  # the largest Ethernet frame of an MTU of 1500
BURST_S = 0.002  # what a link that was idle passes on at once; below it timers of a busy machine would cost rate
SLOWEST_KBPS = 1.0  # tbf knows no standstill; at this rate one packet passes in 10 s


@dataclass(frozen=True)
class Limit:
    """What the link does to everything that goes from the vehicle to the operator.

    kbps_at   rate in force t seconds after the start of the drive; below 1 kbit/s it is 1 kbit/s
    queue_ms  what would wait longer is dropped
    delay_ms  one way, on top of the wait
    """

    kbps_at: Callable[[float], float]
    queue_ms: float
    delay_ms: float

    def kbps(self, t: float) -> float:
        """The rate that is set, kbit/s; before the start that of the start."""
        return max(SLOWEST_KBPS, float(self.kbps_at(max(0.0, t))))


@dataclass(frozen=True, slots=True)
class LinkCounters:
    """What a link has done since it was made.

    queue_ms  wait of a packet that comes now
    bytes     passed on from vehicle to operator
    packets   of these
    dropped   packets
    """

    queue_ms: float
    bytes: int
    packets: int
    dropped: int


class Shaper(Protocol):
    """Where rates are set and counters read."""

    def limit(self, kbps: float) -> LinkCounters:
        """Set the rate; what has passed so far. raises RunError where the link is gone"""

    def check(self) -> None:
        """raises RunError where the link is gone"""


def burst_bytes(kbps: float) -> int:
    """Size of the token bucket: two full frames, or 2 ms of the rate."""
    return max(2 * FRAME_BYTES, round(kbps * 1000 / 8 * BURST_S))


def queue_bytes(kbps: float, queue_ms: float) -> int:
    """What may wait at a rate: queue_ms of it, and never less than the bucket, or a slow link would pass nothing."""
    return max(burst_bytes(kbps), round(kbps * queue_ms / 8))
