"""What a page read of the counter that one of the cameras films, and what that says about latency. Pure.

The camera films a screen that shows a clock as black and white cells (`static/counter.js`). The page reads them out of
each picture that it draws, by the same machine's clock, so that no clocks are compared. The time in between is all that
a driver waits for: the screen's delay, which pictures on the page have, too, the camera's, and the time from capture
to drawing. Only the last part is what the page shows as latency.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import median, quantiles
from typing import Any

LONGEST_MS = 10_000  # a longer time is a misread counter
FEWEST = 10  # readings of which a median is stated


@dataclass(frozen=True, slots=True)
class CounterReading:
    """One picture that a page has drawn.

    elapsed_ms  since the counter in it was shown; None: no counter was found in it
    age_ms      from capture to drawing, as the page states it, right to within bound_ms; None: unknown
    """

    camera: str
    elapsed_ms: float | None
    age_ms: float | None
    bound_ms: float | None


def counter_reading(message: Mapping[str, Any]) -> CounterReading | None:
    """A reading from a page's message; None if it is not a valid one."""
    camera, times = message.get("camera"), [message.get(key) for key in ("elapsed_ms", "age_ms", "bound_ms")]
    if not isinstance(camera, str) or not all(time is None or type(time) in (int, float) for time in times):
        return None
    return CounterReading(camera, *times)


@dataclass(frozen=True, slots=True)
class LightToLight:
    """Latency from the screen through the camera to the page, ms.

    pictures, read      drawn, and those in which a counter was found
    median, p95         glass to glass
    stated, bound       capture to drawing, as the page states it, and by how much that may be wrong, medians; None:
                        unknown
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
    def outside(self) -> float | None:
        """What camera and screen add, if the stated latency is right."""
        return None if self.stated is None else self.median - self.stated

    @property
    def fixed(self) -> float | None:
        """`latency.fixed_ms`: what the reported latency lacks."""
        return None if self.decoded is None else self.median - self.decoded


def light_to_light(readings: Sequence[CounterReading], decoded_ms: Sequence[float]) -> LightToLight | None:
    """The latency that readings show; None if too few of them hold a counter.

    decoded_ms  capture to decoding at the same time
    """
    found = [reading for reading in readings if reading.elapsed_ms is not None and reading.elapsed_ms < LONGEST_MS]
    if len(found) < FEWEST:
        return None
    elapsed = [reading.elapsed_ms for reading in found if reading.elapsed_ms is not None]
    ages = [reading.age_ms for reading in found if reading.age_ms is not None]
    bounds = [reading.bound_ms for reading in found if reading.bound_ms is not None]
    return LightToLight(
        pictures=len(readings),
        read=len(found),
        median=median(elapsed),
        p95=quantiles(elapsed, n=20, method="inclusive")[-1],
        stated=median(ages) if ages else None,
        bound=median(bounds) if ages and bounds else None,
        decoded=median(decoded_ms) if decoded_ms else None,
    )
