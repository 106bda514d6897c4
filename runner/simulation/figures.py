"""What a simulated drive showed, as numbers. Pure."""

from __future__ import annotations

from array import array
from bisect import bisect_left
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from itertools import pairwise
from math import nan
from statistics import fmean

from runner.simulation.drive import Drive

SETTLED_S = 3.0  # unless it is to be judged by its start, too, a drive counts from here on
FROZEN_S = 0.3  # between two frames of any camera
CUT, CUT_S = 0.15, 0.2  # a cut: the total falls by more than this share within this time
FIGURES = {  # by name: what the column says, and its digits
    "use": ("use", 2),
    "p50": ("p50 ms", 0),
    "p95": ("p95 ms", 0),
    "p99": ("p99 ms", 0),
    "frozen": ("frozen %", 1),
    "camera": ("a camera %", 1),
    "cuts": ("cuts/min", 1),
    "lost": ("lost", 0),
    "damaged": ("damaged %", 1),
    "tcp": ("TCP kbit/s", 0),
    "lowest": ("lowest", 0),
}
Figures = dict[str, float]


def figures(drive: Drive, since_s: float) -> Figures:
    """use: bytes of cameras, repeated packets and control link that arrived over those that the link could carry

    p50, p95, p99  of each frame's wait in the queue with its own service, ms
    frozen, damaged  share of the time in which no frame came for longer than FROZEN_S, and in which a camera's picture
                   showed a loss, %
    camera         as frozen, of the camera that it concerns most
    cuts           a minute
    lost           packets of the cameras
    tcp            that competing flows got, kbit/s
    lowest         total, kbit/s
    """
    end, seconds = drive.duration_s, drive.duration_s - since_s
    could = drive.capacity.mean(since_s, end) * seconds
    carried = sum(size for some in (drive.frames, drive.others) for t, size in pairs(some) if since_s < t < end)
    waits = sorted(wait for t, wait in pairs(drive.waits) if t > since_s)
    times = _within((t for t, _ in pairs(drive.frames)), since_s, end)
    arrivals = drive.arrivals.values()
    totals = list(pairs(drive.totals))
    before = bisect_left(totals, (since_s,)) - 1
    return {
        "use": carried * 0.008 / max(1.0, could),
        **{f"p{share}": 1000 * percentile(waits, share) for share in (50, 95, 99)},
        "frozen": 100 * _frozen_s(times) / seconds,
        "camera": 100 * max(_frozen_s([since_s, *_within(each, since_s, end), end]) for each in arrivals) / seconds,
        "cuts": 60 * sum(t > since_s for t in cuts(totals)) / seconds,
        "lost": float(sum(t > since_s for t in drive.lost)),
        "damaged": 100 * fmean(drive.damaged_s.values()) / end if drive.damaged_s else 0.0,
        "tcp": drive.tcp_bytes * 0.008 / end,
        "lowest": min((total for _, total in totals[max(0, before) :]), default=nan),
    }


def _within(times: Iterable[float], begin: float, end: float) -> list[float]:
    return sorted(t for t in times if begin < t < end)


def _frozen_s(times: Sequence[float]) -> float:
    """Between times that are further apart than FROZEN_S."""
    return sum(gap for a, b in pairwise(times) if (gap := b - a) > FROZEN_S)


def percentile(rising: Sequence[float], share: float) -> float:
    """The value that this share of all, in percent, does not exceed; nan: there is none."""
    return rising[min(len(rising) - 1, int(share * len(rising) / 100))] if rising else nan


def cuts(totals: Sequence[tuple[float, float]]) -> Iterator[float]:
    """When the total fell by more than CUT within CUT_S; a fall in several steps counts once."""
    recent: deque[tuple[float, float]] = deque()
    last = -CUT_S
    for t, total in totals:
        while len(recent) > 1 and recent[1][0] <= t - CUT_S:  # the one in force at the begin of the time stays
            recent.popleft()
        highest = max((was for _, was in recent), default=total)
        if total < (1 - CUT) * highest:
            if t - last >= CUT_S:
                yield t
            last = t
            recent.clear()
        recent.append((t, total))


def pairs(flat: array[float]) -> Iterator[tuple[float, float]]:
    numbers = iter(flat)
    return zip(numbers, numbers, strict=True)
