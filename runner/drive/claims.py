"""Claims of publications about a drive, checked against a logged one. Pure."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from runner.drive.checks import ClaimCheck
from runner.drive.series import Series
from runner.drive.time_series import FloatSeries, TimeSeries, held, spans

SHORTEST_S = 5.0  # length from which a drive is checked
STEP_S = 0.1  # interval at which step functions are sampled
DIPS_S = (15.0, 55.0)  # "around 15 and 55 s"
NEAR_S = 5.0
SEVERAL_S = 3.0
DEEP_KBPS = 3300.0  # below it every camera but front center takes a lower factor (Table I)
SHALLOW_S = (70.0, 90.0)
TOO_SHORT = "the drive is too short"
RANGE_KBPS = (3000.0, 8000.0)
SIDES, CENTER = ("front_left", "front_right"), "front_center"


class Span(NamedTuple):
    """Part of a drive: from begin to end, s."""

    begin: float
    end: float


def driving_test(drive: Series) -> list[ClaimCheck]:
    """Section V-B of the paper: a drive of about 100 s in mode A, its bitrates and factors."""
    known = {name for name in (*SIDES, CENTER) if name in drive.cameras}
    if known != {*SIDES, CENTER} or len(drive.panels) < 2:
        return [ClaimCheck("The paper's vehicle is driven", f"cameras {', '.join(drive.cameras)}", False)]
    if drive.end < SHORTEST_S:
        return [_length(drive)]
    return [
        _length(drive),
        _range(drive, drive.predicted, "predicted"),
        _range(drive, drive.actual, drive.measured or "measured"),
        _sides_get_more(drive),
        _tops_are_equal(drive),
        _tops_get_less(drive),
        *(_dip(drive, at) for at in DIPS_S),
        _shallow(drive),
    ]


CLAIMS: Mapping[str, Callable[[Series], list[ClaimCheck]]] = {"driving_test": driving_test}


def claims(drive: Series) -> list[ClaimCheck]:
    """The checked claims that the drive's experiment names; empty if it names none."""
    named = str((drive.config.get("experiment") or {}).get("claims"))
    return CLAIMS[named](drive) if named in CLAIMS else []


def _length(drive: Series) -> ClaimCheck:
    return ClaimCheck("The test takes approximately 100 s", f"{drive.end:.0f} s", abs(drive.end - 100) <= 10)


def _range(drive: Series, line: TimeSeries, what: str) -> ClaimCheck:
    claim = f"The total bitrate ranges from 3000 to 8000 kbit/s ({what})"
    known = line.y[np.isfinite(line.y) & (line.t > 1)]
    if not known.size:
        return ClaimCheck(claim, "not logged", None)
    low, high = float(np.min(known)), float(np.max(known))
    wide = low < RANGE_KBPS[0] * 1.2 and high > RANGE_KBPS[1] * 0.8
    inside = what != "predicted" or (low >= RANGE_KBPS[0] and high <= RANGE_KBPS[1])
    return ClaimCheck(claim, f"{low:.0f} to {high:.0f} kbit/s", wide and inside)


def _sides_get_more(drive: Series) -> ClaimCheck:
    claim = "Front left and right are always allocated higher bitrates than the other cameras"
    others = [name for name in drive.cameras if name not in SIDES]
    ratios = [_kbps(drive, side) / np.maximum(_kbps(drive, other), 1) for side in SIDES for other in others]
    least = float(np.min(ratios))
    return ClaimCheck(claim, f"at least {least:.2f} times as much", least > 1)


def _tops_are_equal(drive: Series) -> ClaimCheck:
    tops = drive.panels[1].cameras
    allocated = np.array([_kbps(drive, name) for name in tops])
    apart = float((allocated.max(axis=0) - allocated.min(axis=0)).max())
    return ClaimCheck(
        "The bitrates of the top views are controlled equally", f"at most {apart:.0f} kbit/s apart", apart <= 1
    )


def _tops_get_less(drive: Series) -> ClaimCheck:
    along, tops = (np.array([_kbps(drive, name) for name in panel.cameras]) for panel in drive.panels)
    most = float((tops.max(axis=0) / np.maximum(along.min(axis=0), 1)).max())
    claim = "The top views get less than the front- and rear-mounted cameras"
    return ClaimCheck(claim, f"at most {most:.2f} times as much as the least of these", most < 1)


def _dip(drive: Series, around: float) -> ClaimCheck:
    """Lower factors for several seconds, for all cameras except front center."""
    claim = f"Around {around:.0f} s lower resolutions are selected for all cameras except front center"
    if drive.end < around + NEAR_S:
        return ClaimCheck(claim, TOO_SHORT, None)
    low = [span for span in _below(drive, DEEP_KBPS) if abs((span.begin + span.end) / 2 - around) <= NEAR_S]
    if not low:
        return ClaimCheck(claim, f"the total stays above {DEEP_KBPS:.0f} kbit/s there", False)
    span = low[0]
    lower = [name for name in drive.cameras if _lowest(drive, name, span) < _before(drive, name, span)]
    same = [name for name in drive.cameras if name not in lower]
    outcome = f"from {span.begin:.1f} to {span.end:.1f} s for {len(lower)} cameras, not for {', '.join(same) or 'none'}"
    return ClaimCheck(claim, outcome, same == [CENTER] and span.end - span.begin >= SEVERAL_S)


def _shallow(drive: Series) -> ClaimCheck:
    begin, end = SHALLOW_S
    claim = f"Between {begin:.0f} and {end:.0f} s less is predicted, and no resolution is changed"
    if drive.end < end - 2:
        return ClaimCheck(claim, TOO_SHORT, None)
    at = _times(Span(begin + 2, end - 2))
    inside, elsewhere = held(drive.predicted, at), held(drive.predicted, _times(Span(0, drive.end)))
    less = bool(np.nanmax(inside) < np.nanmedian(elsewhere))
    changed = [name for name in drive.cameras if np.unique(_factor(drive, name, _times(Span(begin, end)))).size > 1]
    outcome = (
        f"{np.nanmin(inside):.0f} to {np.nanmax(inside):.0f} kbit/s, changes of {', '.join(changed) or 'no camera'}"
    )
    return ClaimCheck(claim, outcome, less and not changed)


def _times(span: Span) -> FloatSeries:
    return np.arange(span.begin, span.end, STEP_S)


def _kbps(drive: Series, name: str) -> FloatSeries:
    """Allocation of a camera over the drive except its first second, in which the first prediction arrives."""
    decided = drive.cameras[name].decided
    return held(TimeSeries(decided.t, decided.kbps), _times(Span(1, drive.end)))


def _factor(drive: Series, name: str, at: FloatSeries) -> FloatSeries:
    decided = drive.cameras[name].decided
    return held(TimeSeries(decided.t, decided.scaling), at)


def _lowest(drive: Series, name: str, span: Span) -> float:
    return float(np.nanmin(_factor(drive, name, _times(span))))


def _before(drive: Series, name: str, span: Span) -> float:
    """The factor in force for most of the drive outside a span."""
    decided = drive.cameras[name].decided
    seconds = spans(decided.t, 0, drive.end) - spans(decided.t, span.begin, span.end)
    factors = {factor: float(seconds[decided.scaling == factor].sum()) for factor in np.unique(decided.scaling)}
    return float(max(factors, key=lambda factor: factors[factor]))


def _below(drive: Series, kbps: float) -> Iterator[Span]:
    """Spans in which the predicted total is below a rate."""
    at = _times(Span(1, drive.end))
    low = held(drive.predicted, at) < kbps
    edges = np.flatnonzero(np.diff(np.concatenate(([False], low, [False])).astype(int)))
    for begin, end in pairs(edges):
        yield Span(float(at[begin]), float(at[end - 1]) + STEP_S)


def pairs(edges: Iterable[int]) -> Iterator[tuple[int, int]]:
    """First and second, third and fourth, ..."""
    yield from list(pairwise(edges))[::2]
