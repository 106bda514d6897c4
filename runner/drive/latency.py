"""Latencies and freezes over a drive, from its log. Pure."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from runner.drive.series import Series
from runner.drive.time_series import FloatSeries

FREEZE_GAPS = 30  # gaps over which the mean is taken (W3C webrtc-stats, freezeCount)
FREEZE_FACTOR = 3.0  # of the mean gap
FREEZE_MORE_S = 0.15  # over the mean gap
FREEZE_STALLED_S = 2.0  # a stream that stops for this long before the criterion applies
FREEZE_FIRST = 5  # gaps before a gap can be judged; the specification leaves it open, libwebrtc uses the same
SECOND_S = 1.0
NAN = float("nan")
UNKNOWN: FloatSeries = np.empty(0)


class Freeze(NamedTuple):
    """A frozen picture: its start, s, and duration, s."""

    t: float
    seconds: float


class Latency(NamedTuple):
    """Percentiles of latencies, ms.

    bound  by how much each may be wrong, for 95 % of the time; nan if unknown
    """

    median: float = NAN
    p95: float = NAN
    p99: float = NAN
    bound: float = NAN


class PerSecond(NamedTuple):
    """Latency of the frames of all cameras in each second: its start, s; median and 95th percentile, ms."""

    t: FloatSeries
    median: FloatSeries
    p95: FloatSeries


def latency(values: FloatSeries, bounds: FloatSeries = UNKNOWN) -> Latency:
    """Median, 95th and 99th percentile by linear interpolation; nan if there are none.

    bounds  by how much they may be wrong, at the times of the samples
    """
    known, measured = values[np.isfinite(values)], bounds[np.isfinite(bounds)]
    if not known.size:
        return Latency()
    median, p95, p99 = map(float, np.percentile(known, (50, 95, 99)))
    return Latency(median, p95, p99, float(np.percentile(measured, 95)) if measured.size else NAN)


def freezes(arrivals: FloatSeries, sending: Iterable[tuple[float, float]]) -> list[Freeze]:
    """The freezes of a picture.

        gap >= max(3 * mean, mean + 150 ms)      mean: of the last 30 gaps before it    (W3C webrtc-stats, freezeCount)

    arrivals  s, increasing: arrival of each access unit; they replace the rendered frames that the definition counts
    sending   when the camera should have been sending; gaps do not span pauses, after which the mean starts again
    returns   the whole gap of each, as in totalFreezesDuration

    The definition counts a freeze when the next frame arrives. A stream that stops for good while it should be sent is
    counted too, up to the end of the span, and one that begins late or never: otherwise the worst case would look
    perfect.
    """
    found = []
    for begin, until in sending:
        inside = arrivals[np.searchsorted(arrivals, begin) : np.searchsorted(arrivals, until, "right")]
        if not inside.size:
            found += [Freeze(begin, until - begin)] if until - begin >= FREEZE_STALLED_S else []
            continue
        if inside[0] - begin >= FREEZE_STALLED_S:
            found.append(Freeze(begin, float(inside[0] - begin)))
        ends = np.append(inside[1:], until)
        gaps = ends - inside
        sums = np.concatenate([[0.0], np.cumsum(gaps)])
        index = np.arange(len(gaps))
        first = np.maximum(index - FREEZE_GAPS, 0)
        means = (sums[index] - sums[first]) / np.maximum(index - first, 1)
        frozen = (gaps >= np.maximum(FREEZE_FACTOR * means, means + FREEZE_MORE_S) - 1e-9) & (index >= FREEZE_FIRST)
        frozen[-1] |= gaps[-1] >= FREEZE_STALLED_S
        found += [Freeze(float(inside[i]), float(gaps[i])) for i in np.flatnonzero(frozen)]
    return found


def per_second(drive: Series) -> PerSecond:
    """Latency over time across all cameras: to arrival if arrivals were logged, otherwise to decode."""
    times, values = latencies(drive)
    edges = np.arange(0.0, drive.end + SECOND_S, SECOND_S)
    order = np.argsort(times, kind="stable")
    groups = np.split(values[order], np.searchsorted(times[order], edges[1:-1]))
    found = [latency(group) for group in groups]
    return PerSecond(edges[:-1], np.array([f.median for f in found]), np.array([f.p95 for f in found]))


def latencies(drive: Series, camera: str | None = None) -> tuple[FloatSeries, FloatSeries]:
    """Time and latency, s and ms, of each frame of one or of all cameras whose latency is known."""
    chosen = [drive.cameras[camera]] if camera else list(drive.cameras.values())
    received = [c.received for c in chosen if c.received]
    if to_arrival(drive):
        times, values = ([got.arrival_t for got in received], [got.arrival_ms for got in received])
    else:
        times, values = ([got.t for got in received], [got.latency_ms for got in received])
    t, ms = concatenated(times), concatenated(values)
    known = np.isfinite(ms) & (t >= 0)
    return t[known], ms[known]


def to_arrival(drive: Series) -> bool:
    """Whether latencies to arrival are known; otherwise they are those of sampled frames to decode."""
    received = (c.received for c in drive.cameras.values())
    return any(got is not None and bool(np.isfinite(got.arrival_ms).any()) for got in received)


def concatenated(values: Iterable[FloatSeries]) -> FloatSeries:
    return np.concatenate([np.empty(0), *values])
