"""Arrays over time: step functions, running counters and rates. Bitrates are kbit/s; `nan` is unknown."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

FloatSeries = NDArray[np.float64]
Flags = NDArray[np.bool_]
RATE_WINDOW_S = 1.0  # rates of sent video are measured over at least this long, as the operator's are


class TimeSeries(NamedTuple):
    """A quantity over time: t s, increasing; y its values."""

    t: FloatSeries
    y: FloatSeries

    @classmethod
    def of(cls, points: Iterable[tuple[float, float | None]]) -> TimeSeries:
        """Of times and values; None: unknown."""
        return cls(*np.array([*points], dtype=float).reshape(-1, 2).T)


EMPTY = TimeSeries(np.empty(0), np.empty(0))


def held(line: TimeSeries, at: FloatSeries) -> FloatSeries:
    """Values of a step function at some times; nan before the first value."""
    index = np.searchsorted(line.t, at, "right") - 1
    return np.where(index >= 0, line.y[np.maximum(index, 0)], np.nan) if line.t.size else np.full(at.shape, np.nan)


def spans(t: FloatSeries, begin: float, end: float) -> FloatSeries:
    """How long each value of a step function is in force within [begin, end], s."""
    edges = np.clip(np.append(t, end), begin, end)
    return np.asarray(np.diff(edges))


def mean_held(line: TimeSeries, begin: float, end: float) -> float:
    """Mean of a step function over time; nan if no value is known."""
    weights = spans(line.t, begin, end)
    known = np.isfinite(line.y) & (weights > 0)
    return float(np.average(line.y[known], weights=weights[known])) if known.any() else float("nan")


def settled(t: FloatSeries, kbps: FloatSeries, frames: FloatSeries) -> FloatSeries:
    """A rate that is nan until its window has filled with video twice: the first includes the backlog."""
    receiving = t[frames > 0]
    return np.where(t >= (receiving[0] if receiving.size else np.inf) + 2 * RATE_WINDOW_S, kbps, np.nan)


def counted(counter: FloatSeries) -> FloatSeries:
    """A running counter that continues where the logged one restarted from 0."""
    if not counter.size:
        return counter
    steps = np.diff(counter)
    return np.asarray(np.cumsum(np.append(counter[0], np.where(steps < 0, counter[1:], steps))))


def rate(t: FloatSeries, sizes: FloatSeries) -> FloatSeries:
    """kbit/s at each time over the second before, from a running counter of bytes; nan in the first second."""
    before = np.searchsorted(t, t - RATE_WINDOW_S + 1e-6, "right") - 1
    known = before >= 0
    first = np.maximum(before, 0)
    seconds = np.where(known, t - t[first], 1.0)
    return np.where(known, (sizes - sizes[first]) * 8 / 1000 / seconds, np.nan)


def mean(values: FloatSeries) -> float:
    """Mean of the known values; nan if there are none."""
    known = values[np.isfinite(values)]
    return float(known.mean()) if known.size else float("nan")


def ratio(part: float, whole: float) -> float:
    return part / whole if whole > 0 else float("nan")
