"""Each of several uplinks in figures. Pure.

Bitrates are kbit/s; `nan` is unknown.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypedDict

from runner.core.limits import Count, NonNegative, Share
from runner.drive.latency import latency
from runner.drive.time_series import mean, mean_held, ratio
from runner.drive.uplink_series import Arrived, UplinkSeries


@dataclass(frozen=True, slots=True)
class UplinkStatistics:
    """One of several uplinks over a drive.

    allowed, received  means, kbit/s
    share       of the packets that arrived by all of them, copies included
    lost        share of its packets: what it alone would have lost
    twins       share of its packets that came after their copies by another
    stalled_s, longest_s  duration of all stalls, and of the longest
    """

    allowed: float
    received: float
    share: float
    lost: float
    twins: float
    stalls: int
    stalled_s: float
    longest_s: float
    queue_p95_ms: float
    came: int
    left: int


class UplinkDocument(TypedDict):
    """One of several uplinks, as report.json says it; None: unknown.

    allowed_kbps, received_kbps  means, the second with packet headers
    share         of the packets that arrived by all uplinks
    lost          share of its packets that it alone would have lost
    twins         share of its packets that came after their copies by another
    queue_p95_ms  95th percentile of the queue in front of it, ms
    stalls        how often nothing arrived over it
    stalled_s, longest_s  duration of all stalls and of the longest, s
    came, left    how often a camera moved to it, and from it
    """

    allowed_kbps: float | None
    received_kbps: float | None
    share: Share | None
    lost: Share | None
    twins: Share | None
    queue_p95_ms: float | None
    stalls: Count
    stalled_s: NonNegative
    longest_s: NonNegative
    came: Count
    left: Count


def uplink_statistics(uplinks: Mapping[str, UplinkSeries], end: float) -> Mapping[str, UplinkStatistics]:
    """By uplink. end: of the drive, s."""
    arrived = {name: each.arrived or Arrived() for name, each in uplinks.items()}
    total = sum(each.packets for each in arrived.values())
    return {name: _statistics(each, arrived[name], total, end) for name, each in uplinks.items()}


def _statistics(uplink: UplinkSeries, arrived: Arrived, total: int, end: float) -> UplinkStatistics:
    seconds = [each for _, each in uplink.stalls]
    return UplinkStatistics(
        allowed=mean_held(uplink.allowed, 0.0, end),
        received=mean(uplink.received.y),
        share=ratio(arrived.packets, total),
        lost=ratio(arrived.lost, arrived.packets + arrived.lost),
        twins=ratio(arrived.twins, arrived.packets),
        stalls=len(seconds),
        stalled_s=sum(seconds),
        longest_s=max(seconds, default=0.0),
        queue_p95_ms=latency(uplink.queue_ms.y).p95,
        came=uplink.came,
        left=uplink.left,
    )
