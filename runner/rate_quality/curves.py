"""From measured points to a ladder of scaling factors: curves over bitrate, crossings, factors worth keeping. Pure.

Quality is signed so that higher is better. Bitrates are the targets that an encoder was given, since the allocation
commands targets; an encoding that exceeds its target is excluded.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import combinations, pairwise

import numpy as np
from numpy.typing import NDArray

from runner.core.model import plain

Values = NDArray[np.float64]

GRID = 400  # bitrates at which curves are compared, log-spaced
MAX_OVERSHOOT = 1.1  # largest ratio of actual to target bitrate at which an encoding meets its target
SATURATED = 0.8  # below this ratio the encoder cannot use more bitrate
RESAMPLED = 200  # bootstrap samples for the confidence of a crossing
BLOCKS = 8  # time blocks that are resampled
CONFIDENCE = (5, 95)  # percentiles


@dataclass(frozen=True, slots=True)
class Point:
    """One encoding of a sequence.

    actual_kbps  output of the encoder
    second_kbps  the same in the second in which it was highest
    encode_ms    CPU time of the encoder for each frame
    scores       by metric, the quality of each sampled frame
    """

    scaling: Fraction
    target_kbps: int
    actual_kbps: float
    second_kbps: float
    encode_ms: float
    scores: Mapping[str, tuple[float, ...]]

    @property
    def meets_target(self) -> bool:
        return self.actual_kbps <= MAX_OVERSHOOT * self.target_kbps

    @property
    def holds_target(self) -> bool:
        """Whether it meets its target in each second, not just in the mean."""
        return self.second_kbps <= MAX_OVERSHOOT * self.target_kbps

    @property
    def saturated(self) -> bool:
        return self.actual_kbps < SATURATED * self.target_kbps


Score = Callable[[Point], float]  # quality of a point, higher is better


@dataclass(frozen=True, slots=True)
class Curves:
    """Quality of each factor over bitrate.

    kbps     grid, log-spaced
    quality  by factor, on the grid; -inf where the factor exceeds its target or was not measured
    """

    kbps: Values
    quality: Mapping[Fraction, Values]

    @property
    def best(self) -> Values:
        """Envelope over all factors (paper, section III)."""
        return np.asarray(np.max(list(self.quality.values()), axis=0))


@dataclass(frozen=True, slots=True)
class Ladder:
    """A choice of factors and the bitrates from which each is used.

    scaling      increasing
    bounds       kbit/s, one entry fewer: from bounds[i] on, scaling[i + 1] is used
    regret_max   largest loss of quality compared with the best of all factors
    regret_mean  the same on average over log bitrate
    width_min    narrowest range: ratio of its end to its beginning
    """

    scaling: tuple[Fraction, ...]
    bounds: tuple[float, ...]
    regret_max: float
    regret_mean: float
    width_min: float


@dataclass(frozen=True, slots=True)
class Crossing:
    """The bitrate at which the larger of two factors begins to look better.

    low, high  its 5th and 95th percentile over resampled time blocks of the sequence
    """

    lower: Fraction
    upper: Fraction
    kbps: float
    low: float
    high: float


def mean_score(metric: str, sign: int = 1) -> Score:
    """Mean over the sampled frames; sign -1 if lower is better."""
    return lambda point: sign * float(np.mean(point.scores[metric]))


def draw_curves(points: Iterable[Point], score: Score) -> Curves:
    """Curves through the points, see `interpolated`.

    raises  ValueError if no point meets its target
    """
    measured = sorted(points, key=lambda p: (p.scaling, p.target_kbps))
    valid: dict[Fraction, list[Point]] = {}
    for point in measured:
        if point.meets_target:
            valid.setdefault(point.scaling, []).append(point)
    targets = [point.target_kbps for group in valid.values() for point in group]
    if not targets:
        best = min(measured, key=lambda point: point.actual_kbps / point.target_kbps)
        reached = f"factor {plain(best.scaling)} reaches {best.actual_kbps:.0f} at {best.target_kbps} kbit/s"
        raise ValueError(f"no encoding meets its target bitrate; the nearest: {reached}")
    kbps = np.geomspace(min(targets), max(targets), GRID)
    return Curves(kbps, {factor: _curve(group, score, kbps) for factor, group in valid.items()})


def interpolated(kbps: Values, quality: Values, at_kbps: Values) -> Values:
    """Quality between measured bitrates: piecewise cubic in log bitrate, monotone where the points are (PCHIP; F. N.
    Fritsch, J. Butland, SIAM J. Sci. Stat. Comput. 5(2), 1984); beyond them that of the nearest.

    kbps     increasing, above 0
    quality  measured there
    """
    x, y = np.log(kbps), np.asarray(quality, float)
    at = np.clip(np.log(at_kbps), x[0], x[-1])
    if len(x) == 1:
        return np.full(at.shape, y[0])
    step, slope = np.diff(x), np.diff(y) / np.diff(x)
    tangent = _tangents(step, slope)
    i = np.clip(np.searchsorted(x, at, side="right") - 1, 0, len(step) - 1)
    u, h = (at - x[i]) / step[i], step[i]
    curved = (3 * slope[i] - 2 * tangent[i] - tangent[i + 1]) * h, (tangent[i] + tangent[i + 1] - 2 * slope[i]) * h
    return np.asarray(y[i] + u * (tangent[i] * h + u * (curved[0] + u * curved[1])))


def _tangents(step: Values, slope: Values) -> Values:
    """At each point: inside, the weighted harmonic mean of the slopes beside it; 0 at an extremum."""
    if len(slope) == 1:
        return np.repeat(slope, 2)
    before, after = 2 * step[1:] + step[:-1], step[1:] + 2 * step[:-1]
    with np.errstate(divide="ignore", invalid="ignore"):
        inside = (before + after) / (before / slope[:-1] + after / slope[1:])
    inside[slope[:-1] * slope[1:] <= 0] = 0.0
    ends = (_end_tangent(*step[:2], *slope[:2]), _end_tangent(*step[:-3:-1], *slope[:-3:-1]))
    return np.concatenate([ends[:1], inside, ends[1:]])


def _end_tangent(step: float, next_step: float, slope: float, next_slope: float) -> float:
    """Of a parabola through three points, limited so that the curve keeps their shape."""
    tangent = ((2 * step + next_step) * slope - step * next_slope) / (step + next_step)
    if tangent * slope <= 0:
        return 0.0
    return 3 * slope if slope * next_slope <= 0 and abs(tangent) > 3 * abs(slope) else tangent


def _curve(points: Sequence[Point], score: Score, kbps: Values) -> Values:
    at = np.array([point.target_kbps for point in points], float)
    quality = np.array([score(point) for point in points])
    inside = (kbps >= at[0] * (1 - 1e-9)) & (kbps <= at[-1] * (1 + 1e-9))
    y = np.full(kbps.shape, -np.inf)
    if len(points) > 1:
        y[inside] = interpolated(at, quality, kbps[inside])
    if points[-1].saturated:
        y[kbps > at[-1]] = quality[-1]
    return y


def cross(curves: Curves, lower: Fraction, upper: Fraction) -> float | None:
    """The bitrate from which the larger factor looks better; None if one of the two wins throughout.

    Noisy curves may cross more than once: the bound chosen loses least quality, summed over log bitrate.
    """
    gain = _gain(curves.quality[upper], curves.quality[lower])
    lost_below = np.concatenate([[0.0], np.cumsum(np.maximum(gain, 0))])  # by using the lower factor up to here
    lost_above = np.concatenate([np.cumsum(np.maximum(-gain, 0)[::-1])[::-1], [0.0]])
    at = int(np.argmin(lost_below + lost_above))
    if at in (0, len(gain)):
        return None
    before, after = gain[at - 1], gain[at]
    share = -before / (after - before) if before < 0 < after else 0.5
    x = np.log(curves.kbps)
    return float(np.exp(x[at - 1] + share * (x[at] - x[at - 1])))


def _gain(upper: Values, lower: Values) -> Values:
    """Gain of the larger factor, made finite: a large value if only one of them works."""
    return np.nan_to_num(upper - lower, nan=0.0, posinf=1e3, neginf=-1e3)


def best_ladder(curves: Curves, tolerance: float, narrowest: float) -> tuple[Ladder, list[Ladder]]:
    """The smallest set of factors that loses no more than `tolerance` at any bitrate.

    tolerance  quality, see `Metric.tolerance`
    narrowest  least ratio of the end of a range to its beginning; in a narrower one its factor is not worth a switch
    returns    the ladder, and for each number of factors the best one, to show what fewer factors would lose

    If no set meets both, the one that loses least is returned.
    raises  ValueError if no factor has two points that meet their targets
    """
    ladders = [ladder for chosen in _choices(curves) if (ladder := build_ladder(curves, chosen)) is not None]
    if not ladders:
        raise ValueError("no factor has two encodings that meet their target bitrates: add bitrates_kbps")
    wide = [ladder for ladder in ladders if ladder.width_min >= narrowest] or ladders
    by_size: dict[int, Ladder] = {}
    for ladder in sorted(wide, key=lambda one: (one.regret_max, one.regret_mean)):
        by_size.setdefault(len(ladder.scaling), ladder)
    best = [by_size[size] for size in sorted(by_size)]
    fits = (ladder for ladder in best if ladder.regret_max <= tolerance)
    return next(fits, min(best, key=lambda ladder: ladder.regret_max)), best


def _choices(curves: Curves) -> Iterator[tuple[Fraction, ...]]:
    """All choices among the factors that are the best at any bitrate."""
    winners = sorted({factor for factor, y in curves.quality.items() if np.any((y >= curves.best) & np.isfinite(y))})
    for size in range(1, len(winners) + 1):
        yield from combinations(winners, size)


def build_ladder(curves: Curves, scaling: Sequence[Fraction]) -> Ladder | None:
    """The ladder of these factors; None if one of them would have no range."""
    bounds = [cross(curves, lower, upper) for lower, upper in pairwise(scaling)]
    found = [bound for bound in bounds if bound is not None]
    if len(found) < len(bounds) or any(a >= b for a, b in pairwise(found)):
        return None
    quality = ladder_quality(curves, scaling, found)
    best = curves.best
    regret = (best - quality)[np.isfinite(best)]
    # The first range reaches down to 0 and the last has no end: only those in between can be narrow.
    width = min((b / a for a, b in pairwise(found)), default=np.inf)
    return Ladder(tuple(scaling), tuple(found), float(np.max(regret)), float(regret.mean()), width)


def ladder_quality(curves: Curves, scaling: Sequence[Fraction], bounds: Sequence[float]) -> Values:
    """Quality on the grid if each factor is used in its range."""
    taken = np.searchsorted(bounds, curves.kbps, side="right")
    return np.asarray(np.choose(taken, [curves.quality[factor] for factor in scaling]))


def crossings(points: Sequence[Point], ladder: Ladder, metric: str, sign: int) -> list[Crossing]:
    """Bounds of a ladder with their confidence: the sequence is resampled in time blocks (block bootstrap).

    All points were scored at the same frames, so that differences between factors are paired.
    """
    frames = len(next(iter(points)).scores[metric])
    draws: dict[int, list[float]] = {number: [] for number in range(len(ladder.bounds))}
    for weights in _resampled(frames):
        curves = draw_curves(points, lambda p, w=weights: sign * float(np.dot(p.scores[metric], w)))  # type: ignore[misc]
        for number, (lower, upper) in enumerate(pairwise(ladder.scaling)):
            bound = cross(curves, lower, upper)
            if bound is not None:
                draws[number].append(bound)
    found = []
    for number, (lower, upper) in enumerate(pairwise(ladder.scaling)):
        kbps = ladder.bounds[number]
        low, high = np.percentile([*draws[number], kbps], CONFIDENCE)
        found.append(Crossing(lower, upper, kbps, min(float(low), kbps), max(float(high), kbps)))
    return found


def _resampled(frames: int) -> Iterator[Values]:
    """Weights of the frames, summing to 1, for each bootstrap sample; the same in every run."""
    random = np.random.default_rng(0)
    block = np.arange(frames) * min(BLOCKS, frames) // frames
    sizes = np.bincount(block)
    for _ in range(RESAMPLED):
        counts = np.bincount(random.integers(0, len(sizes), len(sizes)), minlength=len(sizes))
        weights = counts[block].astype(float)
        yield weights / weights.sum()


def bitrate_for_quality(curves: Curves, ladder: Ladder, quality: float) -> float | None:
    """The smallest bitrate from which a ladder keeps a quality; None if there is none."""
    below = np.flatnonzero(ladder_quality(curves, ladder.scaling, ladder.bounds) < quality)
    if not below.size:
        return float(curves.kbps[0])
    first = int(below[-1]) + 1
    return float(curves.kbps[first]) if first < len(curves.kbps) else None


def quality_drops(points: Iterable[Point], score: Score, tolerance: float) -> list[tuple[Point, Point]]:
    """Pairs of neighbouring points of a factor where the higher bitrate looks worse."""
    found = []
    ordered = sorted(points, key=lambda p: (p.scaling, p.target_kbps))
    for before, after in pairwise(ordered):
        if before.scaling == after.scaling and score(after) < score(before) - tolerance:
            found.append((before, after))
    return found
