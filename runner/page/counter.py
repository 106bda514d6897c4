"""A page's readings of the counter that a camera films, and the latency they show. Pure.

The camera films a screen that shows a clock as black and white cells (`static/counter.js`). The page reads the cells in
each picture that it draws and compares them with the clock of the same machine, so clock offsets play no part. The
difference is the whole delay that a driver experiences: the screen's, which pictures on the page have as well, the
camera's, and the time from capture to drawing. Only the last part is what the page shows as latency.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import median, quantiles
from typing import Any

MAX_ELAPSED_MS = 10_000  # a longer time is a misread counter
MIN_READINGS = 10  # for a median


@dataclass(frozen=True, slots=True)
class CounterReading:
    """One picture that a page has drawn.

    elapsed_ms  since the screen showed this counter value; None: no counter found in the picture
    age_ms      from capture to drawing, as the page states it, accurate to within bound_ms; None: unknown
    """

    camera: str
    elapsed_ms: float | None
    age_ms: float | None
    bound_ms: float | None


def counter_reading(message: Mapping[str, Any]) -> CounterReading | None:
    """The reading in a page's message; None if it is invalid."""
    camera, times = message.get("camera"), [message.get(key) for key in ("elapsed_ms", "age_ms", "bound_ms")]
    if not isinstance(camera, str) or not all(time is None or type(time) in (int, float) for time in times):
        return None
    return CounterReading(camera, *times)


@dataclass(frozen=True, slots=True)
class GlassToGlass:
    """Latency from the screen through the camera to the page, ms.

    pictures, read      pictures drawn, and those in which a counter was found
    median, p95         glass to glass
    stated, bound       capture to drawing, as the page states it, and its error bound, medians; None: unknown
    decoded             capture to decoding, which the operator's side reports to the vehicle, median; None: unknown
    """

    pictures: int
    read: int
    median: float
    p95: float
    stated: float | None
    bound: float | None
    decoded: float | None

    @property
    def camera_and_screen(self) -> float | None:
        """The delay that camera and screen add, if the stated latency is right."""
        return None if self.stated is None else self.median - self.stated

    @property
    def fixed(self) -> float | None:
        """`latency.fixed_ms`: the part that the reported latency does not include."""
        return None if self.decoded is None else self.median - self.decoded


def glass_to_glass(readings: Sequence[CounterReading], decoded_ms: Sequence[float]) -> GlassToGlass | None:
    """The latency that the readings show; None if too few of them contain a counter.

    decoded_ms  capture to decoding at the same time
    """
    found = [reading for reading in readings if reading.elapsed_ms is not None and reading.elapsed_ms < MAX_ELAPSED_MS]
    if len(found) < MIN_READINGS:
        return None
    elapsed = [reading.elapsed_ms for reading in found if reading.elapsed_ms is not None]
    ages = [reading.age_ms for reading in found if reading.age_ms is not None]
    bounds = [reading.bound_ms for reading in found if reading.bound_ms is not None]
    return GlassToGlass(
        pictures=len(readings),
        read=len(found),
        median=median(elapsed),
        p95=quantiles(elapsed, n=20, method="inclusive")[-1],
        stated=median(ages) if ages else None,
        bound=median(bounds) if ages and bounds else None,
        decoded=median(decoded_ms) if decoded_ms else None,
    )
