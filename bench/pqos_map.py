"""Time to look up a place in a bandwidth map of a million points, and to build it.

python bench/pqos_map.py [points]
"""

from __future__ import annotations

import math
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from table import Row, show, spread

from runner.core.events import PositionReported
from runner.pqos import build_pqos
from runner.pqos.bandwidth_map import EARTH_M

LAT, LON = 48.0, 11.0
SETTINGS = {"kind": "map", "radius_m": 15, "look_ahead_s": 5, "off_map_kbps": 1000}
LOOKUPS = 2000


def degrees(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Longitude and latitude of places x m east and y m north of the origin."""
    return np.column_stack([LON + np.degrees(x / EARTH_M / math.cos(math.radians(LAT))), LAT + np.degrees(y / EARTH_M)])


def loop(count: int, random: np.random.Generator) -> np.ndarray:
    """A circle of 2 km with 2 m of GPS scatter: hundreds of points per metre."""
    angle, radius = random.uniform(0, 2 * math.pi, count), 1000 / math.pi + random.normal(0, 2, count)
    return degrees(radius * np.cos(angle), radius * np.sin(angle))


def scattered(count: int, random: np.random.Generator) -> np.ndarray:
    """Anywhere in 100 km by 100 km."""
    return degrees(*random.uniform(0, 100_000, (2, count)))


def measure(name: str, places: np.ndarray, random: np.random.Generator, file: Path) -> list[Row]:
    rates = random.uniform(1000, 9000, len(places)).round()
    np.savetxt(file, np.column_stack([places, rates]), "%.7f,%.7f,%.0f", header="lon,lat,kbps", comments="")
    start = time.perf_counter()
    pqos = build_pqos({**SETTINGS, "file": str(file)}, [])
    built = time.perf_counter() - start
    spent = []
    for t, place in enumerate(places[random.integers(len(places), size=LOOKUPS)]):
        event = PositionReported(
            t=t, lat=float(place[1]), lon=float(place[0]), speed_mps=15, heading_deg=float(random.uniform(0, 360))
        )
        start = time.perf_counter()
        pqos.observe(event)
        spent.append(1000 * (time.perf_counter() - start))
    what = f"bandwidth map of {name}, {len(places)} points"
    return [Row(f"{what}: built", built, "s"), spread(f"{what}: look-up", spent, "ms")]


def rows(count: int = 1_000_000) -> list[Row]:
    random = np.random.default_rng(0)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "map.csv"
        return [
            *measure("2 km", loop(count, random), random, file),
            *measure("100 km", scattered(count, random), random, file),
        ]


if __name__ == "__main__":
    show(rows(*map(int, sys.argv[1:])))
