"""Bitrate predictions (pQoS): sources of `BitratePredicted` in front of the pure core.

The paper reads its predictions from a pre-recorded bandwidth map by GPS position (section V). No clock, no threads,
no log here: time comes from the events, and a file is read only while a source is built. Rates are kbit/s.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol

from runner.core.events import BitratePredicted, Event, PositionReported
from runner.core.model import Kbps, ModelError, exact, plain
from runner.pqos.bandwidth_map import BandwidthMap, Way, offset
from runner.pqos.table import RATE, TIME, find_file, number, read_map, read_table

SLOWEST_MPS = 1.0  # below this speed the direction of movement is mostly GPS noise
BASELINE_S = 0.5  # movement is measured over at least this long, otherwise a 20 Hz GPS gives noise again
REACH_M = 10_000.0  # the map's plane fits the Earth about this far; also limits an absurd speed


class Pqos(Protocol):
    """A source of predictions, fed with every event of the run."""

    @property
    def warnings(self) -> tuple[str, ...]:
        """Suspicious findings about map or positions, for the caller to log; may appear while running."""

    def observe(self, event: Event) -> BitratePredicted | None:
        """The prediction that follows from this event, stamped with the event's own t; None: nothing new."""


class _Motion:
    """Speed and heading, as reported or otherwise from the movement between positions."""

    def __init__(self) -> None:
        self._last: PositionReported | None = None
        self._speed = 0.0  # m/s, taken as 0 before the second position
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
        elif elapsed <= 0 or self._course is not None:  # a first guess may come earlier
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
        lowest = self._points.lowest(self._motion.way(event, self._look_ahead_s))
        if lowest is None:
            self.warnings = self.warnings or self._swapped(event)
        kbps = self._off_map if lowest is None else exact(lowest)
        return BitratePredicted(t=event.t, kbps=kbps, valid_s=self._valid_s)

    def _swapped(self, event: PositionReported) -> tuple[str, ...]:
        """A defect that looks like a dead spot: lon and lat swapped in the map or in the reported positions."""
        if abs(event.lon) > 90 or self._points.lowest(Way(event.lon, event.lat)) is None:
            return ()
        return (
            f"position lat {event.lat}, lon {event.lon} is off the map, but lat {event.lon}, lon {event.lat} is on it: "
            f"lon and lat appear swapped in the map or in the positions; predicting {plain(self._off_map)} kbit/s",
        )


class TimedPqos:
    """Predicts from the time alone: when the value changes, and again every `period_s` so that it does not go stale."""

    warnings: tuple[str, ...] = ()

    def __init__(self, kbps_at: Callable[[float], Kbps], period_s: float) -> None:
        self._kbps_at, self._period_s = kbps_at, period_s
        self._last: BitratePredicted | None = None

    def observe(self, event: Event) -> BitratePredicted | None:
        kbps, last = self._kbps_at(event.t), self._last
        # A nanosecond of tolerance: five steps of 0.1 s are half a second.
        if last and last.kbps == kbps and event.t - last.t < self._period_s - 1e-9:
            return None
        self._last = BitratePredicted(t=event.t, kbps=kbps)
        return self._last


class LivePqos:
    """Predicts nothing: predictions arrive as events through the control link."""

    warnings: tuple[str, ...] = ()

    def observe(self, event: Event) -> BitratePredicted | None:
        return None


class WrongPqos:
    """Makes the predictions of a source wrong, for experiments.

    share   factor applied to the rate
    late_s  every prediction comes so much later
    silent  predict nothing
    """

    def __init__(self, source: Pqos, share: Kbps, late_s: float, silent: bool) -> None:
        self._source, self._share, self._late_s, self._silent = source, share, late_s, silent
        self._waiting: deque[BitratePredicted] = deque()

    @property
    def warnings(self) -> tuple[str, ...]:
        return self._source.warnings

    def observe(self, event: Event) -> BitratePredicted | None:
        """The newest prediction that is due."""
        made = self._source.observe(event)
        if made and not self._silent:
            self._waiting.append(made)
        due = None
        while self._waiting and self._waiting[0].t + self._late_s <= event.t + 1e-9:
            due = self._waiting.popleft()
        if due is None:
            return None
        lower = None if due.lower_kbps is None else due.lower_kbps * self._share
        return replace(due, t=event.t, kbps=due.kbps * self._share, lower_kbps=lower)


def trace(path: Path, loop: bool, off_trace: Kbps | None) -> Callable[[float], Kbps]:
    """Rate in force at a time: that of the last row not after it; `off_trace` before the first row and after the end.

    None there: the first and the last rate hold.

    path  CSV with t_s (never decreasing) and a rate; its last row lasts as long as the one before, then a loop restarts
    """
    table = read_table(path, (TIME, RATE))
    if len(table) < 2:
        raise ModelError("file", path, "must have at least two rows, else the duration of a rate is unknown")
    times, rates = table[:, 0].tolist(), [exact(rate) for rate in table[:, 1].tolist()]
    begin, end = times[0], 2 * times[-1] - times[-2]

    def kbps_at(t: float) -> Kbps:
        if t < begin or (t >= end and not loop):
            return off_trace if off_trace is not None else rates[0 if t < begin else -1]
        return rates[bisect_right(times, t if t < end else begin + (t - begin) % (end - begin)) - 1]

    return kbps_at


def build_pqos(settings: Mapping[str, Any], bases: Sequence[Path]) -> Pqos:
    """The source of predictions that the `pqos` section of a configuration describes.

    settings  the composed section: kind and the keys of that kind (schemas/pqos.schema.json)
    bases     directories in which a relative file is looked up, first match wins
    raises    ModelError with the key, the value found and the rule
    """
    source, wrong = _source(settings, bases), settings.get("wrong")
    if not wrong:
        return source
    return WrongPqos(source, exact(wrong.get("share", 1)), float(wrong.get("late_s", 0)), wrong.get("silent", False))


def _source(settings: Mapping[str, Any], bases: Sequence[Path]) -> Pqos:
    match kind := settings.get("kind"):
        case "map":
            lon, lat, kbps = read_map(find_file(settings, "file", bases)).T
            points = BandwidthMap(lat, lon, kbps, number(settings, "radius_m", positive=True))
            look_ahead_s, off_map = number(settings, "look_ahead_s"), exact(number(settings, "off_map_kbps"))
            valid_s = None if settings.get("valid_s") is None else number(settings, "valid_s", positive=True)
            return MapPqos(points, look_ahead_s, off_map, valid_s)
        case "trace":
            path, off_trace = find_file(settings, "file", bases), exact(number(settings, "off_trace_kbps"))
            kbps_at = trace(path, bool(settings.get("loop")), off_trace)
            return TimedPqos(kbps_at, number(settings, "period_s", positive=True))
        case "constant":
            constant = exact(number(settings, "kbps"))
            return TimedPqos(lambda _: constant, number(settings, "period_s", positive=True))
        case "live":
            return LivePqos()
    raise ModelError("kind", kind, "must be map, trace, constant or live")
