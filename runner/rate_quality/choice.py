"""From the points of a camera to its rate-quality model: its factors, their bitrate bounds, b_full. Pure."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from math import ceil
from statistics import fmean

from runner.core.hull import concave
from runner.core.model import plain
from runner.rate_quality.curves import (
    Crossing,
    Curves,
    Ladder,
    Point,
    best_ladder,
    bitrate_for_quality,
    build_ladder,
    crossings,
    draw_curves,
    mean_score,
    quality_drops,
)

WHOLE = {"mssim": 1.0, "vmaf": 100.0}  # metrics that are a share of this
FEW_FRAMES = 40  # with fewer scored frames a mean is uncertain


@dataclass(frozen=True, slots=True)
class ChoiceCriteria:
    """Criteria for the choice between points; see conf/study/paper.yaml.

    metric  the deciding one; sign: -1 if lower is better
    good    quality at which b_full is set
    cores   largest share of a core that an encoder may need; None: no limit
    fps     of the sequence
    """

    metric: str
    sign: int
    tolerance: float
    narrowest: float
    good: float
    cores: float | None
    fps: Fraction


@dataclass(frozen=True, slots=True)
class ShownChoice:
    """The same for a screen that shows fewer px than the full image: factors, bounds and quality as in `Choice`."""

    scaling: tuple[Fraction, ...]
    b_min: tuple[int, ...]
    quality: tuple[tuple[float, float], ...]


@dataclass(frozen=True, slots=True)
class Choice:
    """A rate-quality model and the evidence for it.

    b_min      whole kbit/s, increasing from 0
    quality    concave hull of bitrate (kbit/s) and quality (of 1) with these factors; empty: the metric is no share
    dropped    by factor, why it was dropped
    table      for each number of factors, the best choice and what it loses
    cores      by factor, share of a core that its encoder needs, the maximum over all bitrates
    warnings   caveats for the user
    shown      by factor of the image's size at which a screen shows it
    """

    scaling: tuple[Fraction, ...]
    b_min: tuple[int, ...]
    b_full: int
    quality: tuple[tuple[float, float], ...]
    ladder: Ladder
    crossings: tuple[Crossing, ...]
    dropped: Mapping[Fraction, str]
    table: tuple[Ladder, ...]
    cores: Mapping[Fraction, float]
    warnings: tuple[str, ...]
    shown: Mapping[Fraction, ShownChoice] = field(default_factory=dict)


def choose(points: Sequence[Point], criteria: ChoiceCriteria) -> Choice:
    """Choose factors, bounds and b_full from points.

    raises  ValueError if no factor is left
    """
    score = mean_score(criteria.metric, criteria.sign)
    cores = cores_needed(points, criteria.fps)
    dropped: dict[Fraction, str] = {}
    if criteria.cores is not None:
        dropped = {
            f: f"needs {c:.2f} of a core, allowed {criteria.cores:g}" for f, c in cores.items() if c > criteria.cores
        }
    left = [point for point in points if point.scaling not in dropped]
    if not left:
        raise ValueError(f"no factor's encoder needs at most {criteria.cores:g} of a core")
    curves = draw_curves(left, score)
    ladder, table = best_ladder(curves, criteria.tolerance, criteria.narrowest)
    warnings = list(_warnings(left, curves, ladder, criteria))
    b_full, unreached = _b_full(curves, ladder, criteria)
    warnings += unreached
    ladder = _below(curves, ladder, b_full)
    dropped |= {
        factor: _why_dropped(factor, curves, b_full) for factor in curves.quality if factor not in ladder.scaling
    }
    kept = [point for point in left if point.scaling in ladder.scaling]
    return Choice(
        scaling=ladder.scaling,
        b_min=(0, *(round(bound) for bound in ladder.bounds)),
        b_full=b_full,
        quality=_hull(kept, criteria),
        ladder=ladder,
        crossings=tuple(crossings(kept, ladder, criteria.metric, criteria.sign)),
        dropped=dict(sorted(dropped.items())),
        table=tuple(table),
        cores=cores,
        warnings=tuple(warnings),
    )


def choose_shown(points: Sequence[Point], criteria: ChoiceCriteria, b_full: int) -> ShownChoice:
    """Choose factors and bounds for a screen; its metric is that of the pictures that the screen shows.

    raises  ValueError as `choose`
    """
    cores = cores_needed(points, criteria.fps)
    left = [point for point in points if criteria.cores is None or cores[point.scaling] <= criteria.cores]
    curves = draw_curves(left, mean_score(criteria.metric, criteria.sign))
    ladder = _below(curves, best_ladder(curves, criteria.tolerance, criteria.narrowest)[0], b_full)
    kept = [point for point in left if point.scaling in ladder.scaling]
    return ShownChoice(ladder.scaling, (0, *(round(bound) for bound in ladder.bounds)), _hull(kept, criteria))


def _hull(points: Iterable[Point], criteria: ChoiceCriteria) -> tuple[tuple[float, float], ...]:
    """The best quality at each bitrate, as far as more of them gains."""
    whole = WHOLE.get(criteria.metric.partition("@")[0])
    if whole is None:
        return ()
    score, best = mean_score(criteria.metric), dict[float, float]()
    for point in (point for point in points if point.meets_target):
        best[point.target_kbps] = max(best.get(point.target_kbps, 0.0), score(point) / whole)
    return concave([(kbps, round(quality, 4)) for kbps, quality in best.items()])


def pooled(groups: Sequence[Sequence[Point]]) -> list[Point]:
    """Points of several cameras merged into those of one: the mean over all their frames."""
    by_lane: dict[tuple[Fraction, int], list[Point]] = {}
    for point in (point for group in groups for point in group):
        by_lane.setdefault((point.scaling, point.target_kbps), []).append(point)
    return [_mean_point(points) for points in by_lane.values() if len(points) == len(groups)]


def _mean_point(points: Sequence[Point]) -> Point:
    return replace(
        points[0],
        actual_kbps=fmean(point.actual_kbps for point in points),
        second_kbps=max(point.second_kbps for point in points),
        encode_ms=fmean(point.encode_ms for point in points),
        scores={name: tuple(s for point in points for s in point.scores[name]) for name in points[0].scores},
    )


def cores_needed(points: Iterable[Point], fps: Fraction) -> dict[Fraction, float]:
    """By factor, the largest share of a core that its encoder needed."""
    found: dict[Fraction, float] = {}
    for point in points:
        found[point.scaling] = max(found.get(point.scaling, 0.0), point.encode_ms * float(fps) / 1000)
    return dict(sorted(found.items()))


def _b_full(curves: Curves, ladder: Ladder, criteria: ChoiceCriteria) -> tuple[int, list[str]]:
    """The bitrate at which the quality is good enough; the largest measured one if it never is."""
    reached = bitrate_for_quality(curves, ladder, criteria.sign * criteria.good)
    if reached is not None:
        return ceil(reached), []
    largest = round(float(curves.kbps[-1]))
    best = criteria.sign * float(curves.best[-1])
    warning = (
        f"b_full: {criteria.metric} {criteria.good:g} is not reached, {best:.4g} at {largest} kbit/s, which is used"
    )
    return largest, [warning]


def _below(curves: Curves, ladder: Ladder, b_full: int) -> Ladder:
    """Without the factors that no bitrate below b_full would choose."""
    used = [bound for bound in ladder.bounds if round(bound) < b_full]
    return build_ladder(curves, ladder.scaling[: len(used) + 1]) or ladder


def _why_dropped(factor: Fraction, curves: Curves, b_full: int) -> str:
    wins = curves.kbps[curves.quality[factor] >= curves.best]
    if not wins.size:
        return "never the best"
    if wins[0] >= b_full:
        return f"the best from {wins[0]:.0f} kbit/s only, above b_full"
    return f"the best from {wins[0]:.0f} to {wins[-1]:.0f} kbit/s, where it gains too little over the others"


def _warnings(points: Sequence[Point], curves: Curves, ladder: Ladder, criteria: ChoiceCriteria) -> Iterable[str]:
    score = mean_score(criteria.metric, criteria.sign)
    scored = len(points[0].scores[criteria.metric])
    if scored < FEW_FRAMES:
        yield f"only {scored} frames were scored; use a longer sequence"
    if len(ladder.scaling) == 1:
        low, high = curves.kbps[0], curves.kbps[-1]
        yield f"the curves never cross between {low:.0f} and {high:.0f} kbit/s: {_shown(ladder.scaling[0])} is the best"
    if ladder.regret_max > criteria.tolerance:
        warning = f"{ladder.regret_max:.2g} of {criteria.metric}, more than the {criteria.tolerance:g} allowed"
        yield f"no choice of factors whose ranges are wide enough loses less than {warning}"
    fallen = quality_drops(points, score, criteria.tolerance)
    if fallen:
        worst = max(fallen, key=lambda pair: score(pair[0]) - score(pair[1]))
        pair = " to ".join(str(point.target_kbps) for point in worst)
        where = f"worst for {_shown(worst[0].scaling)} from {pair} kbit/s, by {score(worst[0]) - score(worst[1]):.2g}"
        yield f"more bitrate looks worse in {len(fallen)} place{'' if len(fallen) == 1 else 's'}; {where}"
    for factor in curves.quality:
        over = [point for point in points if point.scaling == factor and not point.meets_target]
        if over:
            top = max(over, key=lambda point: point.target_kbps)
            actual = f"{top.actual_kbps:.0f} at a target of {top.target_kbps} kbit/s"
            yield f"{_shown(factor)} exceeds {len(over)} of its targets: it reaches {actual}; excluded there"
        met = [point for point in points if point.scaling == factor and point.meets_target]
        uneven = [point for point in met if not point.holds_target]
        if uneven:
            most = max(uneven, key=lambda point: point.second_kbps / point.target_kbps)
            actual = f"{most.second_kbps:.0f} at a target of {most.target_kbps} kbit/s"
            yield f"{_shown(factor)} exceeds {len(uneven)} of its targets in some second: it reaches {actual}"


def _shown(factor: Fraction) -> str:
    return f"factor {plain(factor)}"
