"""How much quality each kbit/s buys, and the shares of a total that buy most. Pure."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import inf
from typing import TypeVar

STEPS = 14  # of the search for the level of the worst: each one leaves 0.62 of the interval
GOLDEN = (5**0.5 - 1) / 2

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Curve:
    """Quality over bitrate: concave, piecewise linear, from nothing at 0, constant after its last point.

    kbps     increasing, above 0
    quality  increasing, above 0; each step gains less for its bits than the one before
    """

    kbps: tuple[float, ...]
    quality: tuple[float, ...]

    def at(self, kbps: float) -> float:
        """Quality at a bitrate."""
        i = bisect_right(self.kbps, kbps)
        if i == len(self.kbps):
            return self.quality[-1]
        b, q = (self.kbps[i - 1], self.quality[i - 1]) if i else (0.0, 0.0)
        return q + (kbps - b) * (self.quality[i] - q) / (self.kbps[i] - b)

    def needs(self, quality: float) -> float:
        """The bitrate of a quality; of more than it reaches, that of its last point."""
        i = bisect_right(self.quality, quality)
        if i == len(self.quality):
            return self.kbps[-1]
        b, q = (self.kbps[i - 1], self.quality[i - 1]) if i else (0.0, 0.0)
        return b + (quality - q) * (self.kbps[i] - b) / (self.quality[i] - q)

    def stretched(self, factor: float) -> Curve:
        """The same qualities at bitrates times a factor."""
        return Curve(tuple(factor * kbps for kbps in self.kbps), self.quality)

    @property
    def slopes(self) -> tuple[float, ...]:
        """Quality gained per kbit/s, of each step."""
        steps = pairwise(zip((0.0, *self.kbps), (0.0, *self.quality), strict=True))
        return tuple((q - p) / (b - a) for (a, p), (b, q) in steps)


def concave(points: Sequence[tuple[float, float]]) -> tuple[tuple[float, float], ...]:
    """The upper concave hull of measured points, from (0, 0) to the first with the best quality.

    points  kbit/s above 0, quality
    """
    hull = [(0.0, 0.0)]
    for b, q in sorted(points):
        if q <= hull[-1][1]:
            continue
        while len(hull) > 1 and _slope(hull[-2], hull[-1]) <= _slope(hull[-1], (b, q)):
            hull.pop()
        hull.append((b, q))
    return tuple(hull[1:])


def _slope(one: tuple[float, float], other: tuple[float, float]) -> float:
    return (other[1] - one[1]) / (other[0] - one[0]) if other[0] > one[0] else inf


@dataclass(frozen=True, slots=True)
class Contender:
    """Who takes part in the sharing of a total.

    weight       of its quality; 0: it gets no more than the least
    least, most  kbit/s; the least comes first
    """

    curve: Curve
    weight: float
    least: float
    most: float


def best_shares(contenders: Sequence[Contender], total: float, worst: float = 0.0) -> tuple[list[float], float]:
    """Shares of a total that give the most quality.

        maximise  (1 - worst) sum_i w_i Q_i(b_i) / sum_i w_i + worst min_i Q_i(b_i)
        with      sum_i b_i <= total,  least_i <= b_i <= most_i

    Without `worst` the steps of all curves are bought in the order of w_i dQ_i/db_i, which is exact, since the curves
    are concave. With it, a level that no quality may fall below is searched, in which the maximum is concave.

    total    kbit/s; below the sum of the least, these are reduced in proportion
    worst    share of the worst quality in the sum, 0 to 1
    returns  kbit/s each; and the slope at which the total was used up, w dQ/db, 0 if some of it is left
    """
    least = [min(each.least, each.most) for each in contenders]
    if (needed := sum(least)) >= total:
        return [total / needed * own for own in least] if needed else least, inf
    steps = _steps(contenders)
    weights = [one.weight for one in contenders]
    if not worst or not any(weights):
        return _bought(contenders, steps, least, total)

    def floors(level: float) -> list[float]:
        return [min(one.most, max(own, one.curve.needs(level))) for one, own in zip(contenders, least, strict=True)]

    def judged(level: float) -> tuple[float, tuple[list[float], float]]:
        found = _bought(contenders, steps, floors(level), total)
        quality = [one.curve.at(own) for one, own in zip(contenders, found[0], strict=True)]
        mean = sum(w * q for w, q in zip(weights, quality, strict=True)) / sum(weights)
        return (1 - worst) * mean + worst * min(quality), found

    return _at_maximum(
        judged, _highest(lambda level: sum(floors(level)) <= total, max(c.curve.quality[-1] for c in contenders))
    )


def _steps(contenders: Sequence[Contender]) -> list[tuple[float, int, float]]:
    """Slope, contender, and bitrate at its end, of all steps of all curves, the steepest first."""
    steps = (
        (each.weight * slope, number, end)
        for number, each in enumerate(contenders)
        for slope, end in zip(each.curve.slopes, each.curve.kbps, strict=True)
    )
    return sorted(steps, key=lambda step: -step[0])


def _bought(
    contenders: Sequence[Contender], steps: Sequence[tuple[float, int, float]], least: Sequence[float], total: float
) -> tuple[list[float], float]:
    """What each gets of a total beyond the least, and the slope at which it was used up."""
    shares, left = list(least), total - sum(least)
    for slope, number, end in steps:
        wanted = min(end, contenders[number].most) - shares[number]
        if wanted <= 0:
            continue
        if wanted >= left:
            shares[number] += left
            return shares, slope
        shares[number] += wanted
        left -= wanted
    return shares, 0.0


def _highest(fits: Callable[[float], bool], most: float) -> float:
    """The highest level up to `most` that fits, to within 2^-STEPS."""
    if fits(most):
        return most
    low, high = 0.0, most
    for _ in range(STEPS):
        middle = (low + high) / 2
        low, high = (middle, high) if fits(middle) else (low, middle)
    return low


def _at_maximum(judged: Callable[[float], tuple[float, T]], high: float) -> T:
    """What belongs to the maximum of a concave function between 0 and `high` (golden section search)."""
    low = 0.0
    a, b = high - GOLDEN * (high - low), low + GOLDEN * (high - low)
    at_a, at_b = judged(a), judged(b)
    for _ in range(STEPS):
        if at_a[0] < at_b[0]:
            low, a, at_a = a, b, at_b
            b = low + GOLDEN * (high - low)
            at_b = judged(b)
        else:
            high, b, at_b = b, a, at_a
            a = high - GOLDEN * (high - low)
            at_a = judged(a)
    return max(at_a, at_b, judged(high), key=lambda found: found[0])[1]
