"""Predictions by position: the rate that a bandwidth map gives for the road ahead."""

from __future__ import annotations

import math

from runner.core.events import BitratePredicted, Event, PositionReported
from runner.core.model import Kbps, exact, plain
from runner.pqos.bandwidth_map import BandwidthMap, Way, offset

SLOWEST_MPS = 1.0  # below this speed the direction of movement is mostly GPS noise
BASELINE_S = 0.5  # movement is measured over at least this long: at 20 Hz, single GPS steps are noise
REACH_M = 10_000.0  # the flat projection is accurate to about this distance; also limits an absurd speed


class _Motion:
    """Speed and heading, as reported, otherwise from the movement between positions."""

    def __init__(self) -> None:
        self._last: PositionReported | None = None
        self._speed = 0.0  # m/s, 0 before the second position
        self._course: float | None = None  # degrees, of the movement
        self._heading: float | None = None  # degrees, the one in force

    def way(self, event: PositionReported, look_ahead_s: float) -> Way:
        """Path from here to where the vehicle will be; just the position if no heading is known."""
        self._measure(event)
        speed = self._speed if event.speed_mps is None else event.speed_mps
        course = self._course if event.heading_deg is None else event.heading_deg
        if speed >= SLOWEST_MPS and course is not None:
            self._heading = course
        if self._heading is None:
            return Way(event.lat, event.lon)
        ahead, angle = min(speed * look_ahead_s, REACH_M), math.radians(self._heading)
        return Way(event.lat, event.lon, ahead * math.sin(angle), ahead * math.cos(angle))

    def _measure(self, event: PositionReported) -> None:
        last = self._last = self._last or event
        elapsed = event.t - last.t
        if elapsed >= BASELINE_S:
            self._last = event
        elif elapsed <= 0 or self._course is not None:  # a first guess is allowed earlier
            return
        east, north = offset(last.lat, last.lon, event.lat, event.lon)
        self._speed = math.hypot(east, north) / elapsed
        if self._speed >= SLOWEST_MPS:
            self._course = math.degrees(math.atan2(east, north)) % 360


class MapPqos:
    """Predicts, for each position, the lowest rate of the map around the path ahead; off the map a small fixed one."""

    def __init__(self, points: BandwidthMap, look_ahead_s: float, off_map: Kbps, valid_s: float | None = None) -> None:
        self._points, self._look_ahead_s, self._off_map, self._valid_s = points, look_ahead_s, off_map, valid_s
        self._motion = _Motion()
        self.warnings: tuple[str, ...] = ()

    def observe(self, event: Event) -> BitratePredicted | None:
        if not isinstance(event, PositionReported):
            return None
        lowest = self._points.lowest_point(self._motion.way(event, self._look_ahead_s))
        if lowest is None:
            self.warnings = self.warnings or self._swap_warning(event)
            return BitratePredicted(t=event.t, kbps=self._off_map, valid_s=self._valid_s)
        kbps, bias, error = lowest
        return BitratePredicted(t=event.t, kbps=exact(kbps), valid_s=self._valid_s, bias=bias, error=error)

    def _swap_warning(self, event: PositionReported) -> tuple[str, ...]:
        """A warning if lon and lat seem swapped in map or positions, which otherwise looks like a dead spot."""
        if abs(event.lon) > 90 or self._points.lowest(Way(event.lon, event.lat)) is None:
            return ()
        return (
            f"position lat {event.lat}, lon {event.lon} is off the map, but lat {event.lon}, lon {event.lat} is on it: "
            f"lon and lat appear swapped in the map or in the positions; predicting {plain(self._off_map)} kbit/s",
        )
