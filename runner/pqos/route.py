"""The order in which to drive through the points of a bandwidth map, whose file may list them in any order."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from runner.core.model import ModelError
from runner.pqos.bandwidth_map import EARTH_M, Floats, Ints

THIN_M = 4.0  # points closer together make a route jitter
POINTS = 3000  # a larger map is thinned further before it is ordered, so that ordering stays below 1 s
HOPS = 3.0  # in usual distances between neighbours: points further apart are not on the same road
STRAIGHT = 2.0  # extra cost of a hop that turns off at a right angle, in multiples of its length


def route(points: Floats) -> Ints:
    """Order in which to drive through the points of a map; equal first and last indices mean that it is closed.

    points   rows of lon, lat in degrees
    returns  indices of rows; points closer than a few metres to others are left out
    raises   ModelError for a map of only one place

    A map whose points are in driving order keeps that order, its direction and its first point. Through any other map
    a closed route is found by driving: straight on while there are new points ahead, then along known ones to the
    nearest new one, and finally back to the first. So the route does not jump where roads cross or join.
    """
    x, y = _plane(points)
    near = _thin(x, y)
    if len(near) < 2:
        raise ModelError("file", f"all points within {THIN_M:g} m", "a route needs two places or more")
    distance = np.hypot(x[near, None] - x[near], y[near, None] - y[near])
    hop = float(np.median(np.partition(distance, 1, axis=1)[:, 1]))
    steps = np.hypot(np.diff(x), np.diff(y))
    # The second condition is for large maps: thinned to long hops, they hide that the file jumps between nearby roads.
    if steps.mean() <= 2 * hop and np.median(np.diag(distance, 1)) <= 2 * hop:
        return _as_given(x, y, steps, HOPS * hop)
    return near[_drive(x[near], y[near], distance, HOPS * hop)]


def _plane(points: Floats) -> tuple[Floats, Floats]:
    """Metres east and north of the first point, on a plane for the map's middle latitude."""
    lon, lat = np.radians(points[:, 0]), np.radians(points[:, 1])
    return (lon - lon[0]) * np.cos(lat.mean()) * EARTH_M, (lat - lat[0]) * EARTH_M


def _thin(x: Floats, y: Floats) -> Ints:
    """Indices, increasing from 0, of points that are at least a few metres apart, and not too many."""
    index, step = np.arange(len(x)), THIN_M
    while True:
        cell = (np.floor(x[index] / step) * 2**26 + np.floor(y[index] / step)).astype(np.int64)
        index = np.sort(index[np.unique(cell, return_index=True)[1]])  # the first point of each cell
        if len(index) <= POINTS:
            break
        step *= 2
    free = np.ones(len(index), dtype=bool)
    for i, k in enumerate(index):
        if free[i]:
            later = index[i + 1 :]
            free[i + 1 :] &= np.hypot(x[later] - x[k], y[later] - y[k]) >= step
    return index[free]


def _as_given(x: Floats, y: Floats, steps: Floats, reach: float) -> Ints:
    """The order of the file, thinned along the way; closed if its ends meet."""
    driven = np.append(0.0, np.cumsum(steps)) // THIN_M
    kept = np.flatnonzero(np.append(True, np.diff(driven) > 0))
    gap = np.hypot(x[kept[-1]] - x[0], y[kept[-1]] - y[0])
    return np.append(kept, 0) if gap <= reach else kept


def _drive(x: Floats, y: Floats, distance: Floats, reach: float) -> Ints:
    """Closed route through points in m; a hop is longer than `reach` only if no point lies between."""
    new = np.ones(len(x), dtype=bool)
    driven, east, north = [0], x[1] - x[0], y[1] - y[0]  # starts in the direction of the file
    new[0] = False
    while new.any():
        here = driven[-1]
        ahead = ((x - x[here]) * east + (y - y[here]) * north) / np.hypot(east, north)
        cost = distance[here] + STRAIGHT * (distance[here] - ahead)
        cost[~new | (distance[here] > reach)] = np.inf
        best = int(cost.argmin())
        driven += [best] if cost[best] < np.inf else _way(distance, here, new)
        new[driven[-1]] = False
        east, north = x[driven[-1]] - x[driven[-2]], y[driven[-1]] - y[driven[-2]]
    return np.array(driven + _way(distance, driven[-1], np.arange(len(x)) == 0))


def _way(distance: Floats, start: int, goals: NDArray[np.bool_]) -> list[int]:
    """Points after `start` up to the nearest goal, in many short hops (Dijkstra; a hop costs its length squared)."""
    best, before = np.full(len(distance), np.inf), np.full(len(distance), start)
    done: NDArray[np.bool_] = np.zeros(len(distance), dtype=bool)
    best[start], k = 0.0, start
    while not goals[k] or k == start:
        done[k] = True
        cost = best[k] + distance[k] ** 2
        better = cost < best
        best[better], before[better] = cost[better], k
        k = int(np.argmin(np.where(done, np.inf, best)))
    way = [k]
    while before[way[-1]] != start:
        way.append(int(before[way[-1]]))
    return way[::-1]
