"""What fewer pictures a second cost and gain at the same bitrate: each is better, but is shown for longer. Pure."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from math import gcd
from statistics import fmean

from runner.core.frame_rate import sent_rate
from runner.core.model import Camera
from runner.lanes import Lane
from runner.rate_quality.choice import Choice
from runner.rate_quality.curves import Point

ROUNDED = Fraction(1_000_001, 1_000_000)  # 8.333333 Hz of a file are 25/3
BITRATES = 5  # at which rates are compared, at most


@dataclass(frozen=True, slots=True)
class RatePoint:
    """Quality at a rate of pictures, and a bitrate.

    delivered  of the pictures that are sent, each compared with itself: what a still scene looks like
    held       at each picture of the source, of the last one that was sent, without any latency: what a moving scene
               looks like. It contains no age of pictures beyond their interval
    """

    kbps: int
    delivered: float
    held: float


Rates = Mapping[Fraction, tuple[RatePoint, ...]]  # by Hz, falling from the source's rate


def every_nth(camera: Camera, wanted: Sequence[Fraction]) -> list[int]:
    """1, and each n for which every nth picture gives a wanted rate, Hz; empty if no lower rate is wanted."""
    found = {int(camera.fps / sent_rate(camera, rate * ROUNDED)) for rate in wanted} - {1}
    return [1, *sorted(found)] if found else []


def rate_stride(stride: int, every: Iterable[int]) -> int:
    """The largest interval between scored frames up to `stride` which meets each phase of every nth picture alike."""
    every = list(every)
    return next(step for step in range(stride, 0, -1) if all(gcd(step, nth) == 1 for nth in every))


def rate_lanes(choice: Choice, kbps: Sequence[int], nth: int) -> list[Lane]:
    """Encodings of every nth picture at some of these bitrates up to b_full, with the factors that were chosen."""
    usable = [each for each in kbps if each <= choice.b_full] or list(kbps[:1])
    step = max(1, -(-len(usable) // BITRATES))
    return [Lane(choice.scaling[bisect_right(choice.b_min, each) - 1], each, nth) for each in usable[::-step][::-1]]


def rate_points(metric: str, groups: Sequence[Sequence[Point]], nth: int, stride: int) -> dict[int, RatePoint]:
    """By bitrate, quality of every nth picture over some clips; without bitrates that an encoder exceeds.

    groups  of each clip, the points of all bitrates
    """
    by_kbps: dict[int, list[Point]] = {}
    for point in (point for group in groups for point in group):
        by_kbps.setdefault(point.target_kbps, []).append(point)
    return {
        kbps: _rate_point(kbps, [point.scores[metric] for point in points], nth, stride)
        for kbps, points in sorted(by_kbps.items())
        if all(point.meets_target for point in points)
    }


def _rate_point(kbps: int, clips: Sequence[Sequence[float]], nth: int, stride: int) -> RatePoint:
    """clips: scores of every stride-th frame, from the middle of the first stride on, as `Task.scored` says"""
    frames = [list(enumerate(scores)) for scores in clips]
    sent = [score for clip in frames for at, score in clip if (stride // 2 + at * stride) % nth == 0]
    return RatePoint(kbps, fmean(sent), fmean(score for clip in clips for score in clip))


def compared(found: Mapping[Fraction, Mapping[int, RatePoint]]) -> Rates:
    """The rates at the bitrates that all of them hold."""
    common = set.intersection(*(set(points) for points in found.values())) if found else set()
    return {fps: tuple(points[kbps] for kbps in sorted(common)) for fps, points in found.items()} if common else {}


def rate_table(rates: Rates) -> list[str]:
    """Lines that show, by rate and bitrate, the quality of delivered pictures and, behind a stroke, what is held."""
    if not rates:
        return []
    first = next(iter(rates.values()))
    lines = ["quality of a delivered picture / held until the next one, at kbit/s:"]
    lines.append(" " * 10 + "".join(f"{point.kbps:>16}" for point in first))
    for fps, points in rates.items():
        cells = (f"{f'{point.delivered:.4f}/{point.held:.4f}':>16}" for point in points)
        lines.append(f"{float(fps):>7.3g} Hz{''.join(cells)}")
    return lines
