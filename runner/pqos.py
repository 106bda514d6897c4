"""Predictions of the bitrate (pQoS): sources of `BitratePredicted` in front of the pure core.

The paper reads its predictions from a pre-recorded bandwidth map by GPS position (section V). No clock, no threads,
no log here: time comes from the events, and a file is read only while a source is built. Rates are kbit/s.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from runner.events import BitratePredicted, Event, PositionReported
from runner.model import Kbps, ModelError, exact, plain
from runner.table import RATE, TIME, find_file, number, read_map, read_table

EARTH_M = 6378137.0  # WGS-84 equatorial radius; the ground's curvature differs from it by 0.7 % at most
SLOWEST_MPS = 1.0  # below this speed the direction of movement is mostly GPS noise
BASELINE_S = 0.5  # movement is taken over at least this long, else a 20 Hz GPS gives noise again
REACH_M = 10_000.0  # the plane below fits the Earth about that far; an absurd speed ends here, too
COLUMNS = 1 << 27  # more than the cells of 1 m around the equator

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


class Pqos(Protocol):
    """A source of predictions, fed with every event of the run."""

    @property
    def warnings(self) -> tuple[str, ...]:
        """What is suspicious about map or positions, for the caller to log; may appear while running."""

    def observe(self, event: Event) -> BitratePredicted | None:
        """What this event makes known, stamped with the event's own t; None: nothing new."""


class Way(NamedTuple):
    """Straight path from a place (degrees) to where the vehicle will be (m east and north of it)."""

    lat: float
    lon: float
    east: float = 0.0
    north: float = 0.0


class BandwidthMap:
    """Rates by place, found through a grid that is searched in sorted order.

    lat, lon, kbps  one value per point: degrees, degrees, kbit/s; radius_m: how far from a path a point still counts

    The rows of the grid are bands of latitude, each divided into columns of its own, so that a cell measures the same
    at every latitude. Points are sorted by cell, then by rate: a dense map answers from the first point of most cells.
    """

    def __init__(self, lat: Floats, lon: Floats, kbps: Floats, radius_m: float) -> None:
        self._radius = radius_m
        self._cell = max(radius_m / 4, 1.0)  # many cells lie fully inside the radius; few are cut by its edge
        row = np.floor(np.radians(lat) * EARTH_M / self._cell).astype(np.int64)
        key = self._key(row, lon)
        order = np.lexsort((kbps, key))
        self._lat, self._lon, self._kbps = lat[order], lon[order], kbps[order]
        self._keys, first = np.unique(key[order], return_index=True)
        self._first = np.append(first, len(order)).astype(np.int64)
        self._rows = int(row.min()), int(row.max())

    def lowest(self, way: Way) -> float | None:
        """Lowest rate, in kbit/s, of the points within the radius of a path; None: the path is off the map."""
        cells = self._cells(way)
        first = self._first[cells]
        inside = self._inside(first, way)
        best = self._kbps[first[inside]].min(initial=np.inf)
        # The first point of a cell is its lowest: only where it lies outside may a later one lie inside and be lower.
        cells = cells[~inside & (self._kbps[first] < best)]
        rest = _spans(self._first[cells] + 1, self._first[cells + 1])
        rest = rest[self._kbps[rest] < best]
        best = min(best, self._kbps[rest[self._inside(rest, way)]].min(initial=np.inf))
        return None if best == np.inf else float(best)

    def _key(self, row: Ints, lon: Floats) -> Ints:
        """Number of the cell at a longitude of a row; rising with the longitude within a row."""
        parallel = np.maximum(np.cos((row + 0.5) * self._cell / EARTH_M), 0.0)
        column: Ints = np.floor(np.radians(lon + 180) * EARTH_M * parallel / self._cell).astype(np.int64)
        return row * COLUMNS + column

    def _cells(self, way: Way) -> Ints:
        """Occupied cells that may hold points within the radius of the path: one span of columns in each row."""
        reach = self._radius + 0.01  # rounding must not lose a point on the edge
        here = math.radians(way.lat) * EARTH_M
        low = math.floor((here + min(way.north, 0) - reach) / self._cell)
        high = math.floor((here + max(way.north, 0) + reach) / self._cell)
        row = np.arange(max(low, self._rows[0]), min(high, self._rows[1]) + 1)
        south = row * self._cell - here - reach
        along = np.clip(np.array([south, south + self._cell + 2 * reach]) / (way.north or 1e-9), 0, 1) * way.east
        degrees = math.degrees(1 / (EARTH_M * max(math.cos(math.radians(way.lat)), 1e-6)))
        west = np.clip(way.lon + (along.min(axis=0) - reach) * degrees, -180, 180)
        east = np.clip(way.lon + (along.max(axis=0) + reach) * degrees, -180, 180)
        first, last = self._key(row, west), self._key(row, east)
        return _spans(self._keys.searchsorted(first, "left"), self._keys.searchsorted(last, "right"))

    def _inside(self, index: Ints, way: Way) -> NDArray[np.bool_]:
        """Which points lie within the radius of the path: distance to a segment in the plane around its start."""
        x = np.radians(self._lon[index] - way.lon) * (EARTH_M * math.cos(math.radians(way.lat)))
        y = np.radians(self._lat[index] - way.lat) * EARTH_M
        square = way.east**2 + way.north**2
        if square > 0:
            share = np.clip((x * way.east + y * way.north) / square, 0, 1)
            x, y = x - share * way.east, y - share * way.north
        near: NDArray[np.bool_] = x * x + y * y <= self._radius**2
        return near


def _spans(begin: Ints, end: Ints) -> Ints:
    """All numbers of the half open ranges [begin, end), one after the other."""
    length = end - begin
    before = np.cumsum(length) - length
    spans: Ints = np.arange(length.sum()) + np.repeat(begin - before, length)
    return spans


class _Motion:
    """Speed and heading, as reported or else from the movement between positions."""

    def __init__(self) -> None:
        self._last: PositionReported | None = None
        self._speed = 0.0  # m/s, nothing is known to move before the second position
        self._course: float | None = None  # degrees, of the movement
        self._heading: float | None = None  # degrees, the one in force

    def way(self, event: PositionReported, look_ahead_s: float) -> Way:
        """Path from here to where the vehicle will be; without any heading known it is the place alone."""
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
        if elapsed >= BASELINE_S or (elapsed > 0 and self._course is None):
            east, north = offset(last.lat, last.lon, event.lat, event.lon)
            self._speed = math.hypot(east, north) / elapsed
            if self._speed >= SLOWEST_MPS:
                self._course = math.degrees(math.atan2(east, north)) % 360
        if elapsed >= BASELINE_S:
            self._last = event


def offset(lat0: float, lon0: float, lat: float, lon: float) -> tuple[float, float]:
    """Metres east and north from one place to another: equirectangular projection, right for some km."""
    east = math.radians(math.remainder(lon - lon0, 360)) * math.cos(math.radians(lat0)) * EARTH_M
    return east, math.radians(lat - lat0) * EARTH_M


class MapPqos:
    """Predicts, for each position, the lowest rate of the map around the path ahead; off the map a small stated one."""

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
        """Defect that looks like a dead spot: lon and lat exchanged, in the map or in what reports the position."""
        if abs(event.lon) > 90 or self._points.lowest(Way(event.lon, event.lat)) is None:
            return ()
        return (
            f"position lat {event.lat}, lon {event.lon} is off the map, but lat {event.lon}, lon {event.lat} is on it: "
            f"lon and lat look swapped in the map or in the positions; predicting {plain(self._off_map)} kbit/s",
        )


class TimedPqos:
    """Predicts from the time alone: when the value changes, and again each `period_s` so that it does not go stale."""

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


def trace(path: Path, loop: bool, off_trace: Kbps) -> Callable[[float], Kbps]:
    """Rate in force at a time: that of the last row not after it; `off_trace` before the first row and after the end.

    path  CSV with t_s, rising, and a rate column; the last row lasts as long as the one before it, then a loop restarts
    """
    table = read_table(path, (TIME, RATE))
    if len(table) < 2:
        raise ModelError("file", path, "must have two rows or more, else nothing says how long a rate holds")
    times, rates = table[:, 0].tolist(), [exact(rate) for rate in table[:, 1].tolist()]
    begin, end = times[0], 2 * times[-1] - times[-2]

    def kbps_at(t: float) -> Kbps:
        if t < begin or (t >= end and not loop):
            return off_trace
        return rates[bisect_right(times, t if t < end else begin + (t - begin) % (end - begin)) - 1]

    return kbps_at


def build_pqos(settings: Mapping[str, Any], bases: Sequence[Path]) -> Pqos:
    """The source of predictions that the `pqos` section of a configuration describes.

    settings  the composed section: kind and the keys of that kind (schemas/pqos.schema.json)
    bases     directories in which a relative file is looked up, first match wins
    raises    ModelError with the key, what was found and what is right
    """
    match kind := settings.get("kind"):
        case "map":
            lon, lat, kbps = read_map(find_file(settings, "file", bases)).T
            points = BandwidthMap(lat, lon, kbps, number(settings, "radius_m", positive=True))
            look_ahead_s, off_map = number(settings, "look_ahead_s"), exact(number(settings, "off_map_kbps"))
            valid_s = None if settings.get("valid_s") is None else number(settings, "valid_s", positive=True)
            return MapPqos(points, look_ahead_s, off_map, valid_s)
        case "trace":
            off_trace = exact(number(settings, "off_trace_kbps"))
            kbps_at = trace(find_file(settings, "file", bases), bool(settings.get("loop")), off_trace)
            return TimedPqos(kbps_at, number(settings, "period_s", positive=True))
        case "constant":
            constant = exact(number(settings, "kbps"))
            return TimedPqos(lambda _: constant, number(settings, "period_s", positive=True))
        case "live":
            return LivePqos()
    raise ModelError("kind", kind, "must be map, trace, constant or live")
