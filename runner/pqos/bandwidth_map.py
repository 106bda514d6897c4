"""Finds the points of a bandwidth map near a path."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

EARTH_M = 6378137.0  # WGS-84 equatorial radius; the ground's curvature differs from it by 0.7 % at most
COLUMNS = 1 << 27  # more than the cells of 1 m around the equator

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


def offset(lat0: float, lon0: float, lat: float, lon: float) -> tuple[float, float]:
    """Metres east and north from one position to another: equirectangular projection, accurate within a few km."""
    east = math.radians(math.remainder(lon - lon0, 360)) * math.cos(math.radians(lat0)) * EARTH_M
    return east, math.radians(lat - lat0) * EARTH_M


class Way(NamedTuple):
    """Straight path from a position (degrees) to where the vehicle will be (m east and north of it)."""

    lat: float
    lon: float
    east: float = 0.0
    north: float = 0.0


class Point(NamedTuple):
    """Of a map: kbit/s; and mean and deviation of ln(capacity / kbps), None if they are not stated."""

    kbps: float
    bias: float | None = None
    error: float | None = None


class BandwidthMap:
    """Rates by position, looked up in a sorted grid.

    lat, lon, kbps  one value per point: degrees, degrees, kbit/s
    radius_m        how far from a path a point still counts
    errors          bias and error of each point; None: they are not stated

    The rows of the grid are bands of latitude, each divided into its own columns, so that cells have the same size
    at every latitude. Points are sorted by cell, then by rate: a dense map answers from the first point of most cells.
    """

    def __init__(self, lat: Floats, lon: Floats, kbps: Floats, radius_m: float, errors: Floats | None = None) -> None:
        self._radius = radius_m
        self._cell = max(radius_m / 4, 1.0)  # many cells are fully inside the radius; few are cut by its edge
        row = np.floor(np.radians(lat) * EARTH_M / self._cell).astype(np.int64)
        key = self._key(row, lon)
        order = np.lexsort((kbps, key))
        self._lat, self._lon, self._kbps = lat[order], lon[order], kbps[order]
        self._errors = None if errors is None else errors[order]
        self._keys, first = np.unique(key[order], return_index=True)
        self._first = np.append(first, len(order)).astype(np.int64)
        self._rows = int(np.min(row)), int(np.max(row))

    def lowest(self, way: Way) -> float | None:
        """Lowest rate, in kbit/s, of the points within the radius of a path; None: the path is off the map."""
        point = self.lowest_point(way)
        return None if point is None else point.kbps

    def lowest_point(self, way: Way) -> Point | None:
        """The point within the radius of a path whose rate is lowest; None: the path is off the map."""
        cells = self._cells(way)
        first = self._first[cells]
        inside = self._inside(first, way)
        found = first[inside]
        best = np.min(self._kbps[found], initial=np.inf)
        # The first point of a cell is its lowest: only if it is outside can a later one be inside and lower.
        cells = cells[~inside & (self._kbps[first] < best)]
        rest = _spans(self._first[cells] + 1, self._first[cells + 1])
        rest = rest[self._kbps[rest] < best]
        found = np.concatenate([found, rest[self._inside(rest, way)]])
        if not found.size:
            return None
        at = found[np.argmin(self._kbps[found])]
        return Point(float(self._kbps[at]), *(() if self._errors is None else self._errors[at].tolist()))

    def _key(self, row: Ints, lon: Floats) -> Ints:
        """Number of the cell at a longitude of a row; increasing with the longitude within a row."""
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
        """Which points are within the radius of the path: distance to a segment in the plane around its start."""
        x = np.radians(self._lon[index] - way.lon) * (EARTH_M * math.cos(math.radians(way.lat)))
        y = np.radians(self._lat[index] - way.lat) * EARTH_M
        square = way.east**2 + way.north**2
        if square > 0:
            share = np.clip((x * way.east + y * way.north) / square, 0, 1)
            x, y = x - share * way.east, y - share * way.north
        near: NDArray[np.bool_] = x * x + y * y <= self._radius**2
        return near


def _spans(begin: Ints, end: Ints) -> Ints:
    """All numbers of the half-open ranges [begin, end), one range after the other."""
    length = end - begin
    before = np.cumsum(length) - length
    spans: Ints = np.arange(length.sum()) + np.repeat(begin - before, length)
    return spans
