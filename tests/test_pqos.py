"""Sources of predictions: grid look-up against brute force, heading, predictions off the map, traces over time."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Mapping
from fractions import Fraction
from math import log
from pathlib import Path
from statistics import median, stdev
from typing import Any

import jsonschema
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from omegaconf import OmegaConf
from shared_data import ROOT, shared

from runner.core.events import BitratePredicted, ClockAdvanced, OperatorConnected, PositionReported
from runner.core.model import ModelError
from runner.pqos import Pqos, build_pqos
from runner.pqos.bandwidth_map import EARTH_M, BandwidthMap, Way, offset
from runner.pqos.on_map import MapPqos

CONF = ROOT / "conf"
SCHEMA = json.loads((ROOT / "schemas" / "pqos.schema.json").read_text())
LAT, LON = 48.0, 11.0


def degrees(east: float, north: float) -> tuple[float, float]:
    """lat, lon of a place m east and north of the origin."""
    return LAT + math.degrees(north / EARTH_M), LON + math.degrees(east / EARTH_M / math.cos(math.radians(LAT)))


def at(t: float, east: float = 0, north: float = 0, speed: float | None = None, heading: float | None = None) -> Any:
    lat, lon = degrees(east, north)
    return PositionReported(t=t, lat=lat, lon=lon, speed_mps=speed, heading_deg=heading)


def make_map(points: list[tuple[float, float, float]], radius_m: float = 10, look_ahead_s: float = 0) -> MapPqos:
    """pQoS from points (m east, m north, kbit/s); 700 kbit/s off the map."""
    lat, lon = np.array([degrees(east, north) for east, north, _ in points]).T
    rates = np.array([float(kbps) for _, _, kbps in points])
    return MapPqos(BandwidthMap(lat, lon, rates, radius_m), look_ahead_s, Fraction(700))


def kbps(pqos: Pqos, event: Any) -> Fraction:
    found = pqos.observe(event)
    assert found is not None and found.t == event.t
    return found.kbps


# --- the grid ---------------------------------------------------------------------------------------------------------


def brute_force(places: Any, rates: Any, radius_m: float, way: Way) -> float | None:
    """The same answer from the definition alone, one point at a time."""
    best = None
    for (lat, lon), rate in zip(places, rates, strict=True):
        x = math.radians(lon - way.lon) * EARTH_M * math.cos(math.radians(way.lat))
        y = math.radians(lat - way.lat) * EARTH_M
        square = way.east**2 + way.north**2
        share = min(max((x * way.east + y * way.north) / square, 0), 1) if square else 0
        if math.hypot(x - share * way.east, y - share * way.north) <= radius_m and (best is None or rate < best):
            best = float(rate)
    return best


@given(
    seed=st.integers(0, 2**32 - 1),
    count=st.integers(1, 200),
    centre=st.sampled_from([(0.0, 0.0), (48.0, 11.0), (-33.9, -70.6), (69.7, 179.99), (89.9, -179.9), (-90.0, 0.0)]),
    sizes_m=st.tuples(
        st.sampled_from([0.5, 30.0, 400.0, 5000.0, 400_000.0]),
        st.sampled_from([0.3, 5.0, 25.0, 300.0]),
        st.sampled_from([0.0, 1e-9, 7.0, 120.0, 3000.0]),
    ),
    angle=st.one_of(st.sampled_from([0.0, 90.0, 180.0, 270.0]), st.floats(0, 360)),
)
def test_grid_equals_brute_force(seed: int, count: int, centre: Any, sizes_m: Any, angle: float) -> None:
    size_m, radius_m, ahead_m = sizes_m
    random = np.random.default_rng(seed)
    extent = math.degrees(size_m / EARTH_M)
    lat = np.clip(centre[0] + random.uniform(-extent, extent, count), -90, 90)
    wider = max(math.cos(math.radians(centre[0])), 0.1)
    lon = np.clip(centre[1] + random.uniform(-extent, extent, count) / wider, -180, 180)
    rates = random.integers(0, 20, count).astype(float)
    points = BandwidthMap(lat, lon, rates, radius_m)
    for _ in range(3):
        here = random.integers(count)  # from a point of the map, so that some are near
        way = Way(
            float(lat[here]),
            float(lon[here]),
            ahead_m * math.sin(math.radians(angle)),
            ahead_m * math.cos(math.radians(angle)),
        )
        assert points.lowest(way) == brute_force(np.column_stack([lat, lon]), rates, radius_m, way)


def test_a_map_states_how_far_its_lowest_point_is_from_the_truth(tmp_path: Path) -> None:
    (tmp_path / "map.csv").write_text(
        "lon,lat,kbps,bias,error\n11,48,900,0.3,0.2\n11,48,3000,0,0.1\n12,48,5000,0,0.1\n"
    )
    settings = {"kind": "map", "file": "map.csv", "radius_m": 10, "look_ahead_s": 0, "off_map_kbps": 500}
    pqos = build_pqos(settings, [tmp_path])
    here, elsewhere = (pqos.observe(PositionReported(t=0, lat=48, lon=lon)) for lon in (11, 13))
    assert here and (here.kbps, here.bias, here.error) == (900, 0.3, 0.2)
    assert elsewhere and (elsewhere.kbps, elsewhere.bias, elsewhere.error) == (500, None, None)


def test_map_over_degrees_keeps_its_radius() -> None:
    """A point 9.9 m east is near and one 10.1 m east is not, at every latitude of one map."""
    lats = np.arange(-80.0, 81.0, 10.0)
    for distance, found in ((9.9, 5000.0), (10.1, None)):
        lon = np.degrees(distance / EARTH_M / np.cos(np.radians(lats)))
        points = BandwidthMap(lats, lon, np.full(len(lats), 5000.0), 10)
        assert {points.lowest(Way(float(lat), 0.0)) for lat in lats} == {found}


@pytest.mark.parametrize("lat, lon", [(90, 0), (-90, 180), (0, 180), (0, -180), (48, 11)])
@pytest.mark.parametrize("speed", [0, 1e308])
def test_no_position_crashes(lat: float, lon: float, speed: float) -> None:
    pqos = make_map([(0, 0, 5000)], look_ahead_s=5)
    assert kbps(pqos, PositionReported(t=0, lat=lat, lon=lon, speed_mps=speed, heading_deg=45)) in (700, 5000)


def test_the_antimeridian_is_not_a_detour() -> None:
    assert offset(0, 179.9999, 0, -179.9999)[0] == pytest.approx(22.26, abs=0.01)


@pytest.mark.parametrize("extent_m", [600, 100_000])
def test_a_million_points_are_looked_up_quickly(extent_m: float) -> None:
    """Limits are in processor time; bench/pqos_map.py measures."""
    random = np.random.default_rng(1)
    lat, lon = 48 + random.uniform(0, extent_m, (2, 1_000_000)) / 111_000
    start = time.process_time()
    points = BandwidthMap(lat, lon, random.uniform(0, 9000, len(lat)), 15)
    assert time.process_time() - start < 3
    ways = [Way(float(lat[i]), float(lon[i]), 53, 53) for i in range(200)]
    start = time.process_time()
    for way in ways:
        points.lowest(way)
    assert (time.process_time() - start) / len(ways) < 0.005


# --- positions to predictions -----------------------------------------------------------------------------------------

ROAD = [(east, 0.0, 5000.0) for east in range(0, 100, 5)] + [(100.0, 0.0, 3000.0)]


def test_lowest_within_radius() -> None:
    pqos = make_map([(0, 0, 8000), (9, 0, 4000), (0, 9.9, 6000), (0, -10.1, 1000)])
    assert kbps(pqos, at(0)) == 4000
    assert kbps(pqos, at(1, 0, -10.2)) == 1000


@pytest.mark.parametrize(
    "east, speed, heading, expected",
    [
        (39, 10, 90, 5000),  # sees the 50 m ahead and 10 m more, not the point at 100 m
        (41, 10, 90, 3000),
        (50, 10, 270, 5000),  # looks the other way
        (50, 10, 0, 5000),
        (50, 0, 90, 5000),  # standstill
        (89, 0, 90, 5000),
        (91, 0, 90, 3000),
    ],
)
def test_look_ahead(east: float, speed: float, heading: float, expected: int) -> None:
    assert kbps(make_map(ROAD, look_ahead_s=5), at(0, east, 0, speed, heading)) == expected


def test_heading_and_speed_from_movement() -> None:
    pqos = make_map(ROAD, look_ahead_s=5)
    assert kbps(pqos, at(0, 40)) == 5000  # no movement is known yet
    assert kbps(pqos, at(1, 50)) == 3000  # 10 m/s eastwards
    assert kbps(pqos, at(2, 40)) == 5000  # and back


def test_fast_gps_scatter_is_no_movement() -> None:
    """20 Hz at standstill, 0.2 m of scatter: 4 m/s from one position to the next, though the car does not move."""
    pqos = make_map(ROAD, look_ahead_s=5)
    found = [kbps(pqos, at(i / 20, 80 + 0.1 * (-1) ** i)) for i in range(100)]
    assert set(found[11:]) == {5000}  # the first half second has no longer baseline to judge by


def test_heading_is_held_below_1_mps() -> None:
    pqos = make_map(ROAD, radius_m=4, look_ahead_s=10)
    assert kbps(pqos, at(0, 88, 0, 5, 90)) == 3000
    assert kbps(pqos, at(1, 88, 0, 0.9, 270)) == 3000  # 9 m ahead, still eastwards
    assert kbps(pqos, at(2, 88, 0, 1.0, 270)) == 5000
    assert kbps(pqos, at(3, 88, 0, 0.9, 90)) == 5000


@given(
    east=st.floats(-500, 500),
    north=st.floats(-500, 500),
    speed=st.one_of(st.none(), st.floats(0, 60)),
    heading=st.one_of(st.none(), st.floats(0, 360)),
)
def test_off_the_map_never_more_than_the_fallback(east: float, north: float, speed: Any, heading: Any) -> None:
    pqos = make_map(ROAD, look_ahead_s=3)
    found = kbps(pqos, at(0, east, north, speed, heading))
    near = min(math.hypot(east - x, north) for x, _, _ in ROAD)
    assert found in (3000, 5000) if near < 9.9 else found in (700, 3000, 5000)
    ahead = (speed or 0) * 3 if heading is not None else 0
    if near > 10.1 + ahead:
        assert found == 700


def test_more_look_ahead_or_radius_never_predicts_more_on_the_map() -> None:
    random = np.random.default_rng(3)
    points = [(float(x), float(y), float(r)) for x, y, r in random.uniform(0, 200, (300, 3))]
    sizes = [(30, 0), (30, 2), (30, 4), (45, 4), (60, 8)]
    found = [kbps(make_map(points, radius, ahead), at(0, 100, 100, 10, 30)) for radius, ahead in sizes]
    assert found == sorted(found, reverse=True)


def test_rate_is_exact_and_validity_is_passed_on(tmp_path: Path) -> None:
    (tmp_path / "map.csv").write_text("lon,lat,kbps\n11,48,0.1\n")
    pqos = build_pqos({**MAP, "file": "map.csv", "valid_s": 2}, [tmp_path])
    assert pqos.observe(at(3)) == BitratePredicted(t=3, kbps=Fraction(1, 10), valid_s=2.0)
    assert pqos.observe(ClockAdvanced(t=4)) is None


def test_swapped_map_is_reported_once() -> None:
    lat, lon = degrees(0, 0)
    pqos = MapPqos(BandwidthMap(np.array([lon]), np.array([lat]), np.array([9000.0]), 10), 2, Fraction(700))
    assert pqos.warnings == ()
    for t in range(3):
        assert kbps(pqos, at(t)) == 700
    assert pqos.warnings == (
        "position lat 48.0, lon 11.0 is off the map, but lat 11.0, lon 48.0 is on it: "
        "lon and lat appear swapped in the map or in the positions; predicting 700 kbit/s",
    )


@pytest.mark.parametrize("lat, lon", [(48.1, 11.0), (11.0, 11.0), (11.0, 120.0)])
def test_a_dead_spot_is_not_reported(lat: float, lon: float) -> None:
    pqos = make_map([(0, 0, 9000)])
    assert kbps(pqos, PositionReported(t=0, lat=lat, lon=lon)) == 700
    assert pqos.warnings == ()


# --- over time --------------------------------------------------------------------------------------------------------

MAP = {"kind": "map", "file": "maps/demo_loop.csv", "radius_m": 15, "look_ahead_s": 2, "off_map_kbps": 1000}
TRACE = {"kind": "trace", "file": "trace.csv", "loop": False, "off_trace_kbps": 200, "period_s": 0.5}


def predictions(pqos: Pqos, times: Any) -> list[tuple[float, float]]:
    """A source's predictions on clock events, as (t, kbit/s)."""
    found = (pqos.observe(ClockAdvanced(t=float(t))) for t in times)
    return [(event.t, float(event.kbps)) for event in found if event]


def test_trace(tmp_path: Path) -> None:
    (tmp_path / "trace.csv").write_text("t_s,lat,lon,uplink_kbps\n1,,,5000\n2,,,6000\n2.4,,,3000\n")
    once = build_pqos({**TRACE, "period_s": 10}, [tmp_path])
    assert predictions(once, [0, 0.9, 1, 1.999, 2, 2.3, 2.4, 2.79, 2.9, 9]) == [
        (0, 200), (1, 5000), (2, 6000), (2.4, 3000), (2.9, 200),
    ]  # fmt: skip
    loop = build_pqos({**TRACE, "period_s": 10, "loop": True}, [tmp_path])
    assert predictions(loop, [0, 1, 2, 2.4, 2.81, 3.81, 4.21]) == [
        (0, 200), (1, 5000), (2, 6000), (2.4, 3000), (2.81, 5000), (3.81, 6000), (4.21, 3000),
    ]  # fmt: skip


@pytest.mark.parametrize("kind", ["constant", "trace"])
def test_unchanged_is_repeated_each_period(tmp_path: Path, kind: str) -> None:
    (tmp_path / "trace.csv").write_text("t_s,kbps\n0,5000\n100,5000\n")
    constant = {"kind": "constant", "kbps": 5000, "period_s": 0.5}
    pqos = build_pqos(constant if kind == "constant" else TRACE, [tmp_path])
    assert [t for t, _ in predictions(pqos, np.arange(21) * 0.1)] == pytest.approx([0, 0.5, 1, 1.5, 2])
    assert pqos.observe(OperatorConnected(t=2.2)) is None
    assert pqos.observe(OperatorConnected(t=2.6)) == BitratePredicted(t=2.6, kbps=Fraction(5000))


@given(st.lists(st.integers(0, 5), min_size=2, max_size=8), st.lists(st.floats(0, 20), min_size=1, max_size=30))
def test_the_last_rate_of_a_trace_is_in_force(tmp_path_factory: Any, rates: list[int], times: list[float]) -> None:
    folder = tmp_path_factory.mktemp("trace")
    (folder / "trace.csv").write_text("t_s,kbps\n" + "".join(f"{t},{rate}\n" for t, rate in enumerate(rates)))
    pqos, last = build_pqos({**TRACE, "loop": True}, [folder]), None
    for t in sorted(times):
        last = pqos.observe(ClockAdvanced(t=t)) or last
        assert last is not None and last.kbps == rates[int(t) % len(rates)] and t - last.t < 0.5


def test_live_predicts_nothing() -> None:
    pqos = build_pqos({"kind": "live"}, [])
    assert pqos.observe(at(0)) is None and pqos.warnings == ()


@pytest.mark.parametrize(
    "section, message",
    [
        ({"kind": "maps"}, "kind: maps: must be map, trace, constant or live"),
        ({}, "kind: None: must be map, trace, constant or live"),
        ({**MAP, "radius_m": 0}, "radius_m: 0: must be a number above 0"),
        ({**MAP, "look_ahead_s": -1}, "look_ahead_s: -1: must be a number of 0 or more"),
        ({**MAP, "off_map_kbps": None}, "off_map_kbps: None: must be a number of 0 or more"),
        ({**MAP, "valid_s": 0}, "valid_s: 0: must be a number above 0"),
        ({**MAP, "file": "no.csv"}, f"file: no.csv: no such file in {CONF}"),
        ({**TRACE, "period_s": 0, "file": "traces/demo_dips.csv"}, "period_s: 0: must be a number above 0"),
        ({"kind": "constant", "kbps": "fast", "period_s": 1}, "kbps: fast: must be a number of 0 or more"),
    ],
)
def test_settings_mistakes(section: Mapping[str, Any], message: str) -> None:
    with pytest.raises(ModelError) as raised:
        build_pqos(section, [CONF])
    assert str(raised.value) == message


def test_one_row_is_no_trace(tmp_path: Path) -> None:
    path = tmp_path / "trace.csv"
    path.write_text("t_s,kbps\n0,5000\n")
    with pytest.raises(ModelError) as raised:
        build_pqos(TRACE, [tmp_path])
    rule = "must have at least two rows, otherwise the duration of a rate is unknown"
    assert str(raised.value) == f"file: {path}: {rule}"


# --- the packaged configuration and its schema ------------------------------------------------------------------------


def mistakes(section: Any) -> list[str]:
    errors = jsonschema.Draft202012Validator(SCHEMA).iter_errors(section)
    return [error.message for error in errors]


@pytest.mark.parametrize("path", sorted((CONF / "pqos").glob("*.yaml")), ids=lambda path: path.stem)
def test_packaged_files(path: Path) -> None:
    assert path.read_text().splitlines()[0] == "# yaml-language-server: $schema=../../schemas/pqos.schema.json"
    section = OmegaConf.to_container(OmegaConf.load(path))
    assert isinstance(section, dict) and section["kind"] == path.stem and mistakes(section) == []
    build_pqos({str(key): value for key, value in section.items()}, [CONF])
    for line in path.read_text().splitlines():
        assert line.startswith("#") or "#" in line or line.startswith(("kind:", "file:")), f"no comment: {line}"


@pytest.mark.parametrize(
    "change, message",
    [
        ({"raduis_m": 5}, "Additional properties are not allowed ('raduis_m' was unexpected)"),
        ({"kbps": 5}, "Additional properties are not allowed ('kbps' was unexpected)"),
        ({"radius_m": 0}, "0 is less than or equal to the minimum of 0"),
        ({"off_map_kbps": -1}, "-1 is less than the minimum of 0"),
        ({"position": {"kind": "track", "loop": True}}, "'file' is a required property"),
        ({"position": {"kind": "route", "speed_mps": 0, "loop": True}}, "0 is less than or equal to the minimum of 0"),
    ],
)
def test_schema_names_one_mistake_of_the_right_kind(change: Mapping[str, Any], message: str) -> None:
    assert mistakes({**MAP, **change}) == [message]


def test_schema_kind_and_route() -> None:
    assert mistakes({"kind": "no"}) == ["'no' is not one of ['map', 'trace', 'constant', 'live']"]
    route = {"kind": "route", "speed_mps": 8, "loop": True}
    assert mistakes({"kind": "live", "position": route}) == ["'route' is not one of ['track', 'live']"]


def test_every_schema_property_is_described() -> None:
    jsonschema.Draft202012Validator.check_schema(SCHEMA)
    objects = [SCHEMA, *(d for name, d in SCHEMA["$defs"].items() if "without_map" not in name)]
    for found in objects:
        undescribed = {key for key, p in found["properties"].items() if not {"description", "$ref"} & p.keys()}
        assert undescribed <= {"kind"}  # described once, for all kinds
    assert all(d["additionalProperties"] is False for d in objects[1:])


def test_demo_loop_is_the_drive_it_describes() -> None:
    """Rates from 3000 to 8000, below 3300 in two stretches of 5 s at 10 m/s, a long shallow one above 5230."""
    lon, lat, rates = np.loadtxt(CONF / "maps" / "demo_loop.csv", delimiter=",", skiprows=1).T
    steps = [math.hypot(*offset(*step)) for step in zip(lat[:-1], lon[:-1], lat[1:], lon[1:], strict=True)]
    driven = np.append(0, np.cumsum(steps))
    assert 650 < driven[-1] < 710 and max(steps) < 3.2 and rates.min() >= 3000 and rates.max() <= 8000
    low = driven[rates < 3300] / 8
    first, second = low[low < 35], low[low > 35]
    assert first.min() < 15 < first.max() < 22 and second.min() < 55 < second.max() < 60
    assert min(np.ptp(first), np.ptp(second)) * 0.8 > 5
    shallow = rates[driven / 8 > 62]
    assert 5230 < shallow.min() < 5600


# --- recordings -------------------------------------------------------------------------------------------------------


def test_map_of_the_papers_implementation() -> None:
    yaml = build_pqos({**MAP, "file": str(shared("traces/raw/tum_bandwidth_map.yaml")), "radius_m": 1}, [])
    csv = shared("traces/tidy/tum_bandwidth_map.csv")
    same = build_pqos({**MAP, "file": str(csv), "radius_m": 1}, [])
    points = np.loadtxt(csv, delimiter=",", skiprows=1)
    found = [
        (kbps(source, PositionReported(t=0, lat=lat, lon=lon)), rate)
        for lon, lat, rate in points.tolist()
        for source in (yaml, same)
    ]
    assert len(found) == 600 and all(predicted <= rate for predicted, rate in found)
    assert {predicted for predicted, _ in found} == {8000, 4500, 2500}
    assert kbps(yaml, PositionReported(t=0, lat=48.3, lon=11.67)) == 1000
    assert kbps(yaml, PositionReported(t=0, lat=11.670006, lon=48.264965)) == 1000 and yaml.warnings


@pytest.mark.parametrize(
    "name",
    ["ATT-LTE-driving-2016", "TMobile-UMTS-driving", "Verizon-LTE-short", "orange-4G-traces-A-up"],
)
def test_recorded_traces(name: str) -> None:
    path = shared(f"traces/tidy/{name}_uplink_1s.csv")
    times, rates = np.genfromtxt(path, delimiter=",", skip_header=1, usecols=(0, 3)).T
    pqos = build_pqos({**TRACE, "file": str(path)}, [])
    assert [rate for _, rate in predictions(pqos, times)] == rates.tolist()
    assert predictions(pqos, [times[-1] + 100]) == [(times[-1] + 100, 200)]


def test_recorded_drive_is_map_and_trace() -> None:
    path = shared("traces/tidy/starlink_autobahn_2024-04-19_leg1_uplink.csv")
    pqos = build_pqos({**MAP, "file": str(path), "look_ahead_s": 0}, [])
    assert kbps(pqos, PositionReported(t=0, lat=52.265172, lon=8.001866)) <= Fraction("12348.1")
    assert predictions(build_pqos({**TRACE, "file": str(path)}, []), [0, 1]) == [(0, 12348.1), (1, 13206)]


def test_downlink_alone_is_refused() -> None:
    path = shared("traces/tidy/Sweden_Telenor_Stockholm_north_Nov2020_downlink.csv")
    with pytest.raises(
        ModelError, match="must be a header with the columns t_s, kbps or bandwidth_kbps or uplink_kbps"
    ):
        build_pqos({**TRACE, "file": str(path)}, [])


def test_wrong_predictions() -> None:
    """Too high and late; the first one comes when it is due."""
    settings = {"kind": "constant", "kbps": 1000, "period_s": 0.5, "wrong": {"share": 1.5, "late_s": 1}}
    source = build_pqos(settings, [])
    made = [source.observe(ClockAdvanced(t=tenth / 10)) for tenth in range(21)]
    assert [(one.t, one.kbps) for one in made if one] == [(1.0, 1500), (1.5, 1500), (2.0, 1500)]
    noisy = build_pqos(settings | {"wrong": {"noise": 0.35}}, [])
    factors = [float(made.kbps) / 1000 for t in range(400) if (made := noisy.observe(ClockAdvanced(t=t)))]
    assert stdev(map(log, factors)) == pytest.approx(0.35, abs=0.05)
    assert 0.9 < median(factors) < 1.1
    silent = build_pqos(settings | {"wrong": {"silent": True}}, [])
    assert not any(silent.observe(ClockAdvanced(t=t)) for t in range(5))
