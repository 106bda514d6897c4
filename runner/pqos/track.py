"""Positions for a drive without GPS: along the points of a bandwidth map, or along a recorded track."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from runner.core.events import PositionReported
from runner.core.model import ModelError
from runner.pqos.bandwidth_map import Floats, offset
from runner.pqos.on_map import SLOWEST_MPS
from runner.pqos.route import route
from runner.pqos.table import LAT, LON, SPEED, TIME, header, read_table


class Track:
    """Position, speed and heading over time.

    times     s, increasing; the first one is the start of the drive
    lat, lon  degrees, interpolated linearly between the rows
    speed     m/s per row; None: derived from the movement
    loop      restart at the end instead of staying there
    """

    def __init__(self, times: Floats, lat: Floats, lon: Floats, speed: Floats | None, loop: bool) -> None:
        self._times, self._lat, self._lon, self._speed, self._loop = times - times[0], lat, lon, speed, loop
        moves = [offset(*move) for move in zip(lat[:-1], lon[:-1], lat[1:], lon[1:], strict=True)]
        seconds = np.diff(times)
        self._pace = np.array([math.hypot(*move) for move in moves]) / seconds
        self._heading: list[float | None] = []
        last: float | None = None
        for (east, north), pace in zip(moves, self._pace, strict=True):
            last = math.degrees(math.atan2(east, north)) % 360 if pace >= SLOWEST_MPS else last
            self._heading.append(last)

    @property
    def duration_s(self) -> float:
        return float(self._times[-1])

    def at(self, t: float) -> PositionReported:
        """Position of the vehicle `t` seconds after the start; while it stands still, it keeps its last heading."""
        now = t % self.duration_s if self._loop else min(max(t, 0.0), self.duration_s)
        row = min(int(np.searchsorted(self._times, now, "right")) - 1, len(self._pace) - 1)
        ended = not self._loop and t > self.duration_s
        speed = self._pace[row] if self._speed is None else np.interp(now, self._times, self._speed)
        return PositionReported(
            t=t,
            lat=float(np.interp(now, self._times, self._lat)),
            lon=float(np.interp(now, self._times, self._lon)),
            speed_mps=0.0 if ended else float(speed),
            heading_deg=self._heading[row],
        )


def read_track(path: Path, loop: bool) -> Track:
    """A recorded drive: CSV with t_s (never decreasing), lat, lon (degrees) and, if it was measured, speed_mps."""
    columns = (TIME, LAT, LON, SPEED) if SPEED.names[0] in header(path) else (TIME, LAT, LON)
    times, lat, lon, *speed = read_table(path, columns).T
    if len(times) < 2:
        raise ModelError("file", path, "must have at least two rows")
    return Track(times, lat, lon, speed[0] if speed else None, loop)


def track_of_bag(path: Path, topic: str | None, loop: bool) -> Track:
    """A drive from a ROS bag: the positions of a topic, or of the only one, at the times of their stamps.

    raises  ModelError
    """
    from runner.bag import POSITIONS, Bag
    from runner.system.clocks import SECOND_NS

    try:
        with Bag(path) as bag:
            found = bag.find(POSITIONS, topic, "positions")
            fixes, where = {fix.ns: fix for fix in sorted(bag.positions(found))}, bag.names(found)
    except ModelError as error:
        raise ModelError("topic" if error.key == "topic" else "file", error.found, error.rule) from None
    if len(fixes) < 2:
        raise ModelError("file", where, "must have at least two positions with a fix, at different times")
    first = next(iter(fixes))
    times, lat, lon = np.array([((fix.ns - first) / SECOND_NS, fix.lat, fix.lon) for fix in fixes.values()]).T
    return Track(times, lat, lon, None, loop)


def track_on_map(points: Floats, speed_mps: float, loop: bool) -> Track:
    """A drive at one speed through the points (lon, lat in degrees, ...) of a map, in the order of `route`."""
    lon, lat = points[route(points), :2].T
    if loop and (lon[0], lat[0]) != (lon[-1], lat[-1]):  # an open road is driven there and back
        lon, lat = np.append(lon, lon[-2::-1]), np.append(lat, lat[-2::-1])
    hops = np.array([math.hypot(*offset(*hop)) for hop in zip(lat[:-1], lon[:-1], lat[1:], lon[1:], strict=True)])
    moved = np.append(True, hops > 0)  # time must increase from row to row
    times = np.append(0.0, np.cumsum(hops))[moved] / speed_mps
    return Track(times, lat[moved], lon[moved], None, loop)
