"""Which encodings to make next, given the existing ones. Pure: a plan is called again until it requests no more."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterable, Sequence
from fractions import Fraction
from itertools import pairwise

import numpy as np

from runner.lanes import Lane
from runner.rate_quality.curves import Curves, Ladder, Point, Score, best_ladder, draw_curves, ladder_quality

FIRST_RATES = 4  # of the adaptive plan, for each factor
CLOSE = 1.05  # a crossing is known once both factors were encoded within this ratio of it
SHARE = 3  # the adaptive plan makes at most one in this many encodings of the full one


def full(scalings: Sequence[Fraction], rates: Sequence[int], points: Iterable[Point]) -> list[Lane]:
    """Every factor at every bitrate (paper, section V-A)."""
    return _missing([Lane(factor, kbps) for factor in scalings for kbps in rates], points)


def adaptive(
    scalings: Sequence[Fraction],
    rates: Sequence[int],
    points: Sequence[Point],
    scores: Sequence[Score],
    tolerance: float,
    narrowest: float,
) -> list[Lane]:
    """A few bitrates for each factor, then both factors at each crossing until it stays where it was predicted.

    rates      of the full plan, increasing; their ends are kept, and no more than a third of its encodings are made,
               and a sixth for each further score
    scores     of the models that these encodings are for
    tolerance, narrowest  as `curves.best_ladder` takes them
    """
    first = _missing([Lane(factor, kbps) for factor in scalings for kbps in spread(rates, FIRST_RATES)], points)
    if first or len(rates) <= FIRST_RATES:
        return first
    most = len(scalings) * len(rates) * (1 + len(scores)) // (2 * SHARE)
    left = max(0, min(most, len(scalings) * len(rates)) - len(points))
    wanted: list[Lane] = []
    for score in scores:
        curves = draw_curves(points, score)
        ladder, _ = best_ladder(curves, tolerance, narrowest)
        wanted += _unknown(_crossings(ladder), points) or _unknown(_near_best(curves, ladder, tolerance), points)
    return list(dict.fromkeys(wanted))[:left]


def _crossings(ladder: Ladder) -> list[Lane]:
    """Both factors at each predicted crossing."""
    pairs = zip(pairwise(ladder.scaling), ladder.bounds, strict=True)
    return [Lane(factor, round(kbps)) for neighbours, kbps in pairs for factor in neighbours]


def _near_best(curves: Curves, ladder: Ladder, tolerance: float) -> list[Lane]:
    """Dropped factors that are nearly as good, where they come closest, with the factor kept there."""
    kept = ladder_quality(curves, ladder.scaling, ladder.bounds)
    near: list[tuple[float, list[Lane]]] = []
    for factor, quality in curves.quality.items():
        gain = np.where(np.isfinite(kept) & np.isfinite(quality), quality - kept, -np.inf)
        at = int(np.argmax(gain))
        if factor not in ladder.scaling and gain[at] > -tolerance:
            kbps = float(curves.kbps[at])
            taken = ladder.scaling[bisect_right(ladder.bounds, kbps)]
            near.append((float(gain[at]), [Lane(factor, round(kbps)), Lane(taken, round(kbps))]))
    return [lane for _, lanes in sorted(near, key=lambda one: -one[0]) for lane in lanes]


def _unknown(lanes: Iterable[Lane], points: Sequence[Point]) -> list[Lane]:
    """Lanes that have no encoding near enough."""
    return [
        lane
        for lane in dict.fromkeys(lanes)
        if not any(p.scaling == lane.scaling and 1 / CLOSE <= p.target_kbps / lane.kbps <= CLOSE for p in points)
    ]


def spread(rates: Sequence[int], count: int) -> list[int]:
    """Some of the bitrates, including both ends, as evenly spaced in log bitrate as possible."""
    goals = np.geomspace(rates[0], rates[-1], min(count, len(rates)))
    return sorted({min(rates, key=lambda rate: float(abs(np.log(rate / goal)))) for goal in goals})


def _missing(lanes: Sequence[Lane], points: Iterable[Point]) -> list[Lane]:
    encoded = {(point.scaling, point.target_kbps) for point in points}
    return [lane for lane in lanes if (lane.scaling, lane.kbps) not in encoded]
