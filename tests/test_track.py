"""Positions without a GPS: routes through the points of a map in any order, recorded tracks, looping and ending."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from shared_data import ROOT, shared

from runner.core.events import PositionReported
from runner.core.model import ModelError
from runner.pqos import build_pqos, build_track
from runner.pqos.bandwidth_map import EARTH_M, offset
from runner.pqos.route import THIN_M, route
from runner.pqos.table import read_map
from runner.pqos.track import Track, track_on_map

CONF = ROOT / "conf"
ROUTE = {"kind": "route", "speed_mps": 8, "loop": True}
MAP = {"kind": "map", "file": "maps/demo_loop.csv", "position": ROUTE}


def places(x: Any, y: Any) -> Any:
    """Rows of lon, lat for m east and north of a place at 48 degrees."""
    east = 11 + np.degrees(np.asarray(x) / EARTH_M / math.cos(math.radians(48)))
    return np.column_stack([east, 48 + np.degrees(np.asarray(y) / EARTH_M)])


def oval(count: int = 400, length_m: float = 1200, laps: int = 1, scatter_m: float = 0) -> Any:
    angle, radius = np.linspace(0, 2 * math.pi * laps, count, endpoint=False), length_m / 2 / math.pi
    scatter = np.random.default_rng(0).normal(0, scatter_m, (2, count))
    return places(radius * np.cos(angle) + scatter[0], 0.6 * radius * np.sin(angle) + scatter[1])


def hops(points: Any, order: Any) -> Any:
    lon, lat = points[order, :2].T
    return np.array([math.hypot(*offset(*hop)) for hop in zip(lat[:-1], lon[:-1], lat[1:], lon[1:], strict=True)])


def distance(a: PositionReported, b: PositionReported) -> float:
    return math.hypot(*offset(a.lat, a.lon, b.lat, b.lon))


def furthest(points: Any, order: Any) -> float:
    """m between the route and the map point that is furthest from it."""
    x, y = (np.radians(points[:, i]) * EARTH_M * (math.cos(math.radians(48)), 1)[i] for i in (0, 1))
    return float(np.hypot(x[:, None] - x[order], y[:, None] - y[order]).min(axis=1).max())


# --- the order of a map's points --------------------------------------------------------------------------------------


def test_driving_order_is_kept() -> None:
    for points in (oval(), oval()[::-1], oval(1500, laps=3, scatter_m=0.5)):
        order = route(points)
        assert order[0] == order[-1] == 0 and (np.diff(order[:-1]) > 0).all()
        assert hops(points, order).max() < 8


@settings(max_examples=25)
@given(st.integers(0, 2**32 - 1), st.integers(200, 600))
def test_any_order_gives_the_loop(seed: int, count: int) -> None:
    points = np.random.default_rng(seed).permutation(oval(count))
    order = route(points)
    found = hops(points, order)
    length = hops(oval(count), np.append(np.arange(count), 0)).sum()
    assert order[0] == order[-1] == 0
    assert found.max() < 20 and found.sum() < 1.1 * length
    # A point is left out for another in its cell, at most a diagonal away; that one for a third, less than THIN_M away.
    assert furthest(points, order) <= (math.sqrt(2) + 1) * THIN_M


def test_scattered_laps_give_no_jumps() -> None:
    points = np.random.default_rng(5).permutation(oval(3000, laps=5, scatter_m=1.5))
    order = route(points)
    assert hops(points, order).max() < 20 and furthest(points, order) < 8


def test_crossing_roads_are_driven_along() -> None:
    """A crossing has four ends: only driving back along a road reaches all of them without a jump."""
    line = np.arange(-100, 101, 5.0)
    cross = places(np.append(line, 0 * line), np.append(0 * line, line))
    points = np.random.default_rng(2).permutation(cross)
    order = route(points)
    assert hops(points, order).max() < 16 and furthest(points, order) < 8


def test_road_that_does_not_close() -> None:
    points = places(np.arange(0, 1000, 5.0), np.zeros(200))
    order = route(points)
    assert order[0] == 0 and order[-1] == 199
    there, back = track_on_map(points, 10, loop=False), track_on_map(points, 10, loop=True)
    assert there.duration_s == pytest.approx(99.5) and back.duration_s == pytest.approx(199)
    assert distance(back.at(99.5 + 20), back.at(99.5 - 20)) == pytest.approx(0, abs=0.01)
    assert back.at(120).heading_deg == pytest.approx(270, abs=0.1)


@pytest.mark.slow
def test_the_order_is_found_quickly() -> None:
    """Limits are in processor time."""
    random = np.random.default_rng(0)
    for points in (places(*random.uniform(0, 1000, (2, 3000))), random.permutation(oval(1_000_000, 2000, 9, 1.5))):
        start = time.process_time()
        route(points)
        assert time.process_time() - start < 3


def test_one_place_is_no_route() -> None:
    with pytest.raises(ModelError) as raised:
        route(places([0, 1, 1], [0, 1, 0]))
    assert str(raised.value) == "file: all points within 4 m: a route needs two places or more"


def test_road_with_a_standstill_in_the_middle() -> None:
    """A recorder at standstill wrote many equal points: time must still increase."""
    x = np.concatenate([np.arange(0, 200, 3.0), np.full(50, 200.0), np.arange(200, 0, -3.0)])
    track = track_on_map(places(x, 0 * x), 8, loop=True)
    assert all(math.isfinite(track.at(t / 10).lon) for t in range(600))


# --- a track over time ------------------------------------------------------------------------------------------------


def simple(loop: bool, speed: Any = None) -> Track:
    """East 10 m/s for 10 s, 5 s standstill, then north 5 m/s for 10 s."""
    lon, lat = places([0, 100, 100, 100], [0, 0, 0, 50]).T
    return Track(np.array([3.0, 13, 18, 28]), lat, lon, speed, loop)


def test_track_between_rows() -> None:
    track = simple(loop=False)
    found = track.at(5)
    assert distance(found, track.at(0)) == pytest.approx(50, abs=0.1)
    assert (found.t, found.speed_mps) == (5, pytest.approx(10, abs=0.01)) and found.heading_deg == pytest.approx(90)
    standing = track.at(12)
    assert standing.speed_mps == 0 and standing.heading_deg == pytest.approx(90)  # held
    assert track.at(20).heading_deg == pytest.approx(0, abs=0.01)


def test_track_ends_or_loops() -> None:
    once, loop = simple(loop=False), simple(loop=True)
    assert distance(once.at(1000), once.at(25)) == 0 and once.at(1000).speed_mps == 0 and once.at(1000).t == 1000
    assert distance(loop.at(25 + 5), loop.at(5)) == pytest.approx(0) and loop.at(30).t == 30
    assert distance(once.at(-1), once.at(0)) == 0


def test_recorded_speed_is_used(tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_text("t_s,lat,lon,speed_mps\n0,48,11,4\n1,48.0001,11,6\n")
    track = build_track({"kind": "live", "position": {"kind": "track", "file": "t.csv", "loop": False}}, [tmp_path])
    assert track is not None and track.at(0.5).speed_mps == 5


@pytest.mark.parametrize("speed", [3.0, 8.0, 30.0])
def test_demo_drive(speed: float) -> None:
    track = build_track({**MAP, "position": {**ROUTE, "speed_mps": speed}}, [CONF])
    assert track is not None and track.duration_s == pytest.approx(700 / speed, rel=0.02)
    at = [track.at(i / 10) for i in range(int(20 * track.duration_s))]  # two laps
    moved = [distance(a, b) for a, b in pairwise(at)]
    assert max(moved) < 1.01 * speed / 10 and min(moved) > 0.9 * speed / 10
    assert [event.speed_mps for event in at] == pytest.approx([speed] * len(at), rel=1e-6)


def test_demo_drive_predicts_as_the_paper_shows() -> None:
    """At 8 m/s, one lap: dips near 15 s and 55 s, a shallow one from 70 s on, never off the map."""
    track = build_track(MAP, [CONF])
    pqos = build_pqos({**MAP, "radius_m": 15, "look_ahead_s": 2, "off_map_kbps": 1000}, [CONF])
    assert track is not None
    found = [pqos.observe(track.at(i / 10)) for i in range(870)]
    rates = np.array([float(event.kbps) for event in found if event])
    assert len(rates) == 870 and rates.min() >= 3000 and rates.max() <= 8000
    low = np.flatnonzero(rates < 3300) / 10
    assert set(np.round(low).astype(int)) >= {15, 55} and not ((low > 25) & (low < 45)).any() and low.max() < 65
    assert 5230 < rates[700:].min() < 5600


@pytest.mark.parametrize(
    "section, message",
    [
        ({**MAP, "position": {"kind": "rout"}}, "position.kind: rout: must be route, track or live"),
        ({**MAP, "kind": "trace"}, "position.kind: route: needs kind: map, whose points it drives through"),
        ({**MAP, "position": {**ROUTE, "speed_mps": 0}}, "position.speed_mps: 0: must be a number above 0"),
        ({**MAP, "file": "no.csv"}, f"file: no.csv: no such file in {CONF}"),
        (
            {"kind": "live", "position": {"kind": "track", "file": "no.csv"}},
            f"position.file: no.csv: no such file in {CONF}",
        ),
        (
            {"kind": "live", "position": {"kind": "track", "file": "maps/demo_loop.csv"}},
            f"position.file: {CONF}/maps/demo_loop.csv:1: no column t_s: "
            "must be a header with the columns t_s, lat, lon",
        ),
    ],
)
def test_mistakes(section: Mapping[str, Any], message: str) -> None:
    with pytest.raises(ModelError) as raised:
        build_track(section, [CONF])
    assert str(raised.value) == message


def test_one_row_is_no_track(tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_text("t_s,lat,lon\n0,48,11\n")
    with pytest.raises(ModelError) as raised:
        build_track({"position": {"kind": "track", "file": "t.csv"}}, [tmp_path])
    assert str(raised.value) == f"position.file: {tmp_path}/t.csv: must have at least two rows"


@pytest.mark.parametrize("section", [{"kind": "live"}, {"kind": "map", "position": {"kind": "live", "speed_mps": 3}}])
def test_live_has_no_track(section: Mapping[str, Any]) -> None:
    assert build_track(section, []) is None


# --- recordings -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", [None, 0, 1, 2, 3, 4, 5, 6, 7])
def test_map_of_the_papers_implementation(seed: int | None) -> None:
    """Three roads between two crossings, points in no order: every road is driven, no hop leaves the roads."""
    points = read_map(shared("traces/raw/tum_bandwidth_map.yaml"))
    if seed is not None:
        points = np.random.default_rng(seed).permutation(points)
    order = route(points)
    found = hops(points, order)
    assert order[0] == order[-1] == 0 and found.max() < 15 and 900 < found.sum() < 1900
    assert furthest(points, order) < 8


def test_map_of_the_papers_implementation_is_driven_on_the_map() -> None:
    section = {**MAP, "file": str(shared("traces/raw/tum_bandwidth_map.yaml"))}
    track = build_track(section, [])
    pqos = build_pqos({**section, "radius_m": 15, "look_ahead_s": 2, "off_map_kbps": 1000}, [])
    assert track is not None
    found = [pqos.observe(track.at(i / 10)) for i in range(int(track.duration_s * 10))]
    assert {float(event.kbps) for event in found if event} == {8000, 4500, 2500}


def test_recorded_gps_track() -> None:
    path = shared("traces/tidy/comma2k19_example1_gps_track_20hz.csv")
    track = build_track({"position": {"kind": "track", "file": str(path), "loop": True}}, [])
    assert track is not None and track.duration_s == pytest.approx(59.949)
    at = [track.at(i / 7) for i in range(419)]
    assert max(distance(a, b) for a, b in pairwise(at)) < 21 / 7
    for a, b in zip(at, at[7:], strict=False):  # speed is that of the recording, heading that of the movement
        assert a.speed_mps is not None and abs(distance(a, b) - a.speed_mps) < 3
    headings = [event.heading_deg for event in at]
    turns = [abs(math.remainder(a - b, 360)) for a, b in pairwise(headings) if a and b]
    assert None not in headings and max(turns) < 15
