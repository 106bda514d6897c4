"""A quantity over time that is constant between two times. Pure."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Iterable, Sequence
from math import inf

GRID_S = 0.01  # a rate given as a function is read this often; the real link follows it every 20 ms


class Steps:
    """times: s, rising from 0; values: from each time on, the last for ever."""

    __slots__ = ("times", "values")

    def __init__(self, times: Sequence[float], values: Sequence[float]) -> None:
        self.times, self.values = list(times), list(values)

    @classmethod
    def of(cls, value_at: Callable[[float], float], duration_s: float) -> Steps:
        """A function of time on a grid of GRID_S, its last value for ever."""
        times, values = [0.0], [float(value_at(0.0))]
        for step in range(1, int(duration_s / GRID_S) + 1):
            value = float(value_at(step * GRID_S))
            if value != values[-1]:
                times.append(step * GRID_S)
                values.append(value)
        return cls(times, values)

    @classmethod
    def total(cls, each: Sequence[Steps]) -> Steps:
        """The sum of several."""
        if len(each) == 1:
            return each[0]
        times = sorted({t for one in each for t in one.times})
        return cls(times, [sum(one.at(t) for one in each) for t in times])

    def without(self, spans: Iterable[tuple[float, float]]) -> Steps:
        """With 0 in these spans, each (begin, end)."""
        spans = list(spans)
        if not spans:
            return self
        times = sorted({*self.times, *(t for span in spans for t in span)})
        return Steps(times, [0.0 if any(a <= t < b for a, b in spans) else self.at(t) for t in times])

    def at(self, t: float) -> float:
        return self.values[max(0, bisect_right(self.times, t + 1e-9) - 1)]

    def mean(self, begin: float, end: float) -> float:
        """Over time."""
        edges = [*self.times, inf]
        parts = zip(edges, edges[1:], self.values, strict=False)
        return sum(max(0.0, min(b, end) - max(a, begin)) * value for a, b, value in parts) / (end - begin)

    def moved(self, by_s: float) -> Steps:
        """The same, that much earlier; times before 0 are cut off."""
        first = max(0, bisect_right(self.times, by_s + 1e-9) - 1)
        return Steps([0.0, *(t - by_s for t in self.times[first + 1 :])], self.values[first:])
