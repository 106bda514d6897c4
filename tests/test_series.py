"""A drive on one time axis: aligned clocks, counters that restart, step functions, panels."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from drives import EPOCH, OPERATOR_LATER_S, Lines, write_drive
from helpers import vehicle

from runner.configuration.compose import compose
from runner.core.events import CameraSwitched
from runner.drive.camera_series import sending_spans
from runner.drive.document import to_json
from runner.drive.figures import totals
from runner.drive.panels import panels
from runner.drive.read import read_drive
from runner.drive.series import series
from runner.drive.statistics import statistics
from runner.drive.tables import camera_rows, uplink_rows
from runner.drive.time_series import TimeSeries, counted, held, mean_held, rate, spans
from runner.drive.uplink_figure import uplinks
from runner.errors import UserError

NAN = float("nan")


def line(*points: tuple[float, float]) -> TimeSeries:
    t, y = np.array(points, dtype=float).reshape(-1, 2).T
    return TimeSeries(t, y)


def test_values_are_in_force_until_the_next() -> None:
    steps = line((1, 10), (3, 20), (3, 30))
    np.testing.assert_array_equal(held(steps, np.array([0.0, 1.0, 2.9, 3.0, 9.0])), [NAN, 10, 10, 30, 30])
    np.testing.assert_array_equal(held(line(), np.array([0.0, 1.0])), [NAN, NAN])


@pytest.mark.parametrize(
    "begin, end, expected",
    [(0, 5, (2 * 10 + 2 * 30) / 4), (2, 4, 20), (1, 2, 10), (4, 5, 30), (0, 1, NAN), (5, 5, NAN)],
)
def test_the_mean_over_time(begin: float, end: float, expected: float) -> None:
    assert mean_held(line((1, 10), (3, 30)), begin, end) == pytest.approx(expected, nan_ok=True)


def test_spans_share_a_stretch_of_time() -> None:
    np.testing.assert_allclose(spans(np.array([0.0, 2.0, 6.0]), 1, 8), [1, 4, 2])


def test_a_counter_that_restarts_continues() -> None:
    np.testing.assert_array_equal(counted(np.array([5.0, 9.0, 2.0, 4.0, 0.0, 1.0])), [5, 9, 11, 13, 13, 14])
    assert counted(np.empty(0)).size == 0


def test_a_rate_is_taken_over_a_second_and_is_unknown_before() -> None:
    t = np.arange(6) * 0.5
    np.testing.assert_allclose(rate(t, t * 1000), [NAN, NAN, 8, 8, 8, 8])


# --- panels -----------------------------------------------------------------------------------------------------------


def test_panels_of_the_papers_vehicle() -> None:
    front, top = panels(compose(["source=test"]).document["cameras"])
    assert front == ("Front and rear", ("front_left", "front_center", "front_right", "rear_center"))
    assert top == ("Top", ("top_front", "top_left", "top_right", "top_rear"))


def test_panels_of_other_vehicles() -> None:
    robot = panels(compose(["source=test", "vehicle=delivery_robot"]).document["cameras"])
    assert robot == (("Front and rear", ("front", "rear")), ("mast", ("mast",)))
    assert panels({"a_1": {}, "b_1": {}}) == (("A and b", ("a_1", "b_1")),)
    many = {f"side_{n}": {"place": {"row": 5 - n, "column": 0}} for n in range(5)}
    assert [panel.cameras for panel in panels(many)] == [("side_4", "side_3", "side_2"), ("side_1", "side_0")]


# --- whole drives -----------------------------------------------------------------------------------------------------


def test_sides_are_joined_by_the_time_they_began(tmp_path: Path) -> None:
    drive = series(read_drive(write_drive(tmp_path / "drive", seconds=20)))
    assert (drive.began, drive.end, drive.measured) == (EPOCH, 20, "received")
    received = drive.cameras["front_left"].received
    assert received is not None
    assert received.t[0] == OPERATOR_LATER_S
    assert OPERATOR_LATER_S <= received.arrival_t[0] < OPERATOR_LATER_S + 0.1
    assert np.isnan(received.kbps[received.t < OPERATOR_LATER_S + 1.9]).all()
    assert np.isfinite(received.kbps[received.t > OPERATOR_LATER_S + 2.5]).all()
    decided = drive.cameras["front_left"].decided
    at_5 = held(TimeSeries(decided.t, decided.kbps), np.array([5.0]))
    assert np.interp(5.0, *drive.cameras["front_left"].actual) == pytest.approx(at_5[0], rel=0.2)


def test_the_vehicle_alone(tmp_path: Path) -> None:
    drive = series(read_drive(write_drive(tmp_path / "drive", ["vehicle"], seconds=20)))
    assert (drive.measured, drive.links) == ("sent", {})
    camera = drive.cameras["top_left"]
    assert camera.received is None
    assert camera.sent is not None
    total = drive.actual.y[-1]
    assert total == pytest.approx(sum(c.actual.y[-1] for c in drive.cameras.values()))
    assert drive.positions is not None
    assert (drive.positions.east[0], drive.positions.north[0]) == (0, 0)
    moved = np.hypot(np.diff(drive.positions.east), np.diff(drive.positions.north)).sum()
    assert moved == pytest.approx(20 * 8, rel=0.01)


def test_lanes_of_a_link_are_drawn_with_their_total(tmp_path: Path) -> None:
    b_only = {"lane": "b", "kbps": 700, "dropped": 3}

    def in_lanes(side: str, lines: Lines) -> Lines:
        return [line | own for line in lines for own in ({"lane": "a"}, b_only)] if side == "link" else lines

    drive = statistics(series(read_drive(write_drive(tmp_path / "drive", seconds=20, change=in_lanes))))
    a, b = (drive.series.links[lane] for lane in "ab")
    assert (set(b.kbps), b.dropped[-1]) == ({700}, 3)
    shown = {curve.label: curve for curve in totals([drive])[0][0].curves}
    assert [*shown][:3] == ["link's rate", "lane a", "lane b"]
    np.testing.assert_array_equal(shown["link's rate"].y, a.kbps + 700)
    (described,) = to_json([drive], {}, [], [])["drives"]
    assert (described["link"], described["lanes"]["b"]["max_kbps"]) == (None, 700)


def test_the_operator_alone(tmp_path: Path) -> None:
    drive = series(read_drive(write_drive(tmp_path / "drive", ["operator"], seconds=20)))
    assert drive.began == EPOCH + OPERATOR_LATER_S
    assert drive.end == pytest.approx(20 - OPERATOR_LATER_S)
    assert list(drive.cameras) == list(vehicle().cameras)
    assert drive.measured == "received"
    assert drive.positions is not None
    assert drive.predicted.t.size > 0
    assert drive.reasons


def test_spans_in_which_a_camera_should_send(tmp_path: Path) -> None:
    off = CameraSwitched(t=5.0, camera="rear_center", on=False)
    on = CameraSwitched(t=9.0, camera="rear_center", on=True)
    drive = series(read_drive(write_drive(tmp_path / "drive", ["vehicle"], seconds=20, events=(off, on))))
    assert sending_spans(drive.cameras["rear_center"].decided, drive.end) == [(0.0, 5.0), (9.0, 20.0)]
    assert sending_spans(drive.cameras["front_left"].decided, drive.end) == [(0.0, 20.0)]
    switched = [(each.t, each.reason) for each in drive.reasons if each.camera == "rear_center"]
    assert (5.0, "switched off") in switched


def test_compared_clocks_align_the_sides_and_bound_the_latencies(tmp_path: Path) -> None:
    """As if the operator's clock had been 3.7 s behind; one latency is below 0, within the bound of 0.4 ms."""

    def behind(side: str, lines: Lines) -> Lines:
        for entry in lines:
            if entry.get("log") == "sample":
                entry |= {"clock_ahead_ms": 3700.0, "clock_bound_ms": 0.4}
        first = next(entry for entry in lines if entry.get("log") == "sample") if side == "operator" else None
        if first:
            first["cameras"]["front_left"]["arrivals"].append([1.0, -0.3])
        return lines

    path = write_drive(tmp_path / "drive", seconds=20, change=behind)
    began, *rest = (path / "operator.jsonl").read_text().splitlines(keepends=True)
    moved = json.loads(began)
    moved["time"] -= 3.7
    (path / "operator.jsonl").write_text("".join([json.dumps(moved) + "\n", *rest]))
    drive = series(read_drive(path))
    plain = series(read_drive(write_drive(tmp_path / "plain", seconds=20)))
    assert drive.warnings == ()
    assert drive.began == plain.began
    for name, camera in drive.cameras.items():
        received, expected = camera.received, plain.cameras[name].received
        assert received is not None
        assert expected is not None
        assert received.t == pytest.approx(expected.t)
        assert set(received.bound_ms) == {0.4}
        assert np.isnan(expected.bound_ms).all()
        assert np.isfinite(received.arrival_ms).all()
        assert received.arrival_ms.min() >= 0
    found = statistics(drive)
    assert (found.arrival.bound, found.cameras["front_left"].decode.bound) == (0.4, 0.4)
    headings, _ = camera_rows(found)
    assert any(heading.startswith("arrival, ms ± 0.4") for heading in headings)


@pytest.mark.parametrize("set_at, operator_until", [(9.0, 20.0), (15.0, 8.0), (1.0, 20.0)])
def test_a_vehicle_that_began_in_1970_is_shown_when_it_drove(
    tmp_path: Path, set_at: float, operator_until: float
) -> None:
    """Its clock is set during, after or before the operator's log."""
    by_s = EPOCH - 100.0

    def is_set(side: str, lines: Lines) -> Lines:
        for entry in (entry for entry in lines if entry.get("log") == "sample"):
            is_right = entry["t"] + OPERATOR_LATER_S >= set_at
            entry |= {"clock_ahead_ms": 0.0 if is_right else -1000.0 * by_s, "clock_bound_ms": 0.4}
        if side == "operator":
            return [entry for entry in lines if entry["t"] < operator_until]
        return sorted([*lines, {"t": set_at, "log": "clock_set", "by_s": by_s}], key=lambda entry: entry["t"])

    path = write_drive(tmp_path / "drive", ["vehicle", "operator"], seconds=20, change=is_set, ended=False)
    log = path / "drive.jsonl"
    log.write_text(log.read_text().replace(f'"time": {EPOCH}', '"time": 100.0', 1))
    read = read_drive(path)
    drive = series(read)
    received = drive.cameras["front_left"].received
    assert received is not None
    assert drive.began == EPOCH
    assert received.t[0] == pytest.approx(OPERATOR_LATER_S)
    vehicle, operator = read.sides["vehicle"], read.sides["operator"]
    assert (vehicle.corrected(100.0, 0.0), vehicle.corrected(EPOCH + 16, 16.0)) == (EPOCH, EPOCH + 16)
    assert operator.began_s == pytest.approx(EPOCH + OPERATOR_LATER_S)
    assert "earlier times are corrected" in "".join(drive.warnings)


@pytest.mark.parametrize(
    "by_s, set_at, begins, ends",
    [
        *((sign * by_s, 9.0, OPERATOR_LATER_S, 19.0) for by_s in (1.2, 5, 60) for sign in (1, -1)),
        *((sign * by_s, 20.0, OPERATOR_LATER_S, 15.0) for by_s in (1.2, 5, 60) for sign in (1, -1)),
        *((sign * 60, at, 100.0, 300.0) for at in (50.0, 200.0, 350.0) for sign in (1, -1)),
        (-5, 13.0, 9.0, 19.0),  # the clock shows 9 to 13 s twice: only the later comparisons tell which of them it was
        (-5, 7.0, 9.0, 19.0),
    ],
)
def test_the_operators_log_keeps_its_place_when_the_vehicles_clock_is_set(
    tmp_path: Path, by_s: float, set_at: float, begins: float, ends: float
) -> None:
    """Also by a step that is much shorter than the drive."""
    stretch = 20 if ends > 20 else 1

    def is_set(side: str, lines: Lines) -> Lines:
        for entry in lines:
            entry["t"] *= stretch
        if side == "vehicle":
            return sorted([*lines, {"t": set_at, "log": "clock_set", "by_s": by_s}], key=lambda entry: entry["t"])
        logged = [entry for entry in lines if entry["log"] == "sample" and begins <= entry["t"] < ends]
        for entry in logged:
            entry |= {"clock_ahead_ms": 1000.0 * by_s * (entry["t"] >= set_at), "clock_bound_ms": 0.4}
            entry["t"] -= begins
        return logged

    path = write_drive(tmp_path / "drive", ["vehicle", "operator"], seconds=20, change=is_set, ended=False)
    log = path / "operator.jsonl"
    log.write_text(log.read_text().replace(f'"time": {EPOCH + OPERATOR_LATER_S}', f'"time": {EPOCH + begins}', 1))
    read = read_drive(path).sides
    assert read["vehicle"].began_s == pytest.approx(EPOCH + by_s)
    assert read["operator"].began_s - read["vehicle"].began_s == pytest.approx(begins)


@pytest.mark.parametrize("set_s", [30, -30, 2])
def test_setting_the_operators_clock_makes_no_freeze(tmp_path: Path, set_s: int) -> None:
    """Arrivals are logged by the wall clock, samples by the monotonic one."""

    def is_set(side: str, lines: Lines) -> Lines:
        for entry in (entry for entry in lines if entry.get("log") == "sample"):
            after = entry["t"] >= 8
            known = not 8 <= entry["t"] < 9.3  # until the clocks were compared again
            entry |= {"clock_ahead_ms": 5 - 1000.0 * set_s * after if known else None, "clock_bound_ms": 0.4}
            for camera in entry["cameras"].values():
                camera["arrivals"] = [[at + set_s * after, ms] for at, ms in camera["arrivals"]]
        set_at = [{"t": 8.0, "log": "clock_set", "by_s": set_s}] if side == "operator" else []
        return sorted([*lines, *set_at], key=lambda entry: entry["t"])

    drive = series(read_drive(write_drive(tmp_path / "drive", seconds=20, change=is_set)))
    plain = series(read_drive(write_drive(tmp_path / "plain", seconds=20)))
    for name, camera in drive.cameras.items():
        received, expected = camera.received, plain.cameras[name].received
        assert received is not None
        assert expected is not None
        gaps, same = np.diff(received.arrival_t), np.diff(expected.arrival_t)
        assert len(gaps) > 0.9 * len(same)
        assert gaps == pytest.approx(same[: len(gaps)], abs=0.01)


def test_setting_the_clock_of_both_sides_makes_no_freeze(tmp_path: Path) -> None:
    """As of a demo on one machine: the difference of the clocks shows nothing, only the lines of both logs."""

    def is_set(side: str, lines: Lines) -> Lines:
        at = 8.0 if side == "operator" else 8.0 + OPERATOR_LATER_S
        for entry in (entry for entry in lines if entry.get("log") == "sample"):
            entry |= {"clock_ahead_ms": 0.0, "clock_bound_ms": 0.4}
            for camera in entry["cameras"].values():
                camera["arrivals"] = [[t + 3600 * (t >= at), ms] for t, ms in camera["arrivals"]]
        return sorted([*lines, {"t": at, "log": "clock_set", "by_s": 3600}], key=lambda entry: entry["t"])

    drive = series(read_drive(write_drive(tmp_path / "drive", seconds=20, change=is_set)))
    plain = series(read_drive(write_drive(tmp_path / "plain", seconds=20)))
    assert drive.began == EPOCH + 3600
    for name, camera in drive.cameras.items():
        received, expected = camera.received, plain.cameras[name].received
        assert received is not None
        assert expected is not None
        assert received.arrival_t == pytest.approx(expected.arrival_t, abs=1e-3)


# --- drives without a report -----------------------------------------------------------------------------------------


def without(**keys: Any) -> Any:
    def change(side: str, lines: Lines) -> Lines:
        return [entry for entry in lines if not any(entry.get(key) == value for key, value in keys.items())]

    return change


def test_a_drive_that_cannot_be_reported(tmp_path: Path) -> None:
    def problem(name: str) -> str:
        with pytest.raises(UserError) as raised:
            series(read_drive(tmp_path / name))
        return str(raised.value).removeprefix(f"{tmp_path}/")

    write_drive(tmp_path / "empty", seconds=5, change=lambda _side, _lines: [])
    assert problem("empty") == "empty: is empty: only the first line was logged"
    write_drive(tmp_path / "undecided", seconds=5, change=without(log="decision"), sides=["vehicle"])
    assert problem("undecided") == "undecided: contains no decision"
    write_drive(tmp_path / "foreign", seconds=5, change=lambda _side, lines: [*lines, {"t": 1, "log": "decision"}])
    assert problem("foreign").startswith("foreign/drive.jsonl: line 187: cause: missing: must be given; mode: missing")
    state = {"t": 1, "log": "state", "online": True}
    write_drive(tmp_path / "stateless", seconds=5, change=lambda _side, lines: [*lines, state])
    assert "cause: missing: must be given; mode: missing" in problem("stateless")
    assert problem("nowhere") == "nowhere: no such directory"


def test_a_truncated_drive_is_read_up_to_there(tmp_path: Path) -> None:
    path = write_drive(tmp_path / "drive", seconds=5, ended=False)
    log = path / "drive.jsonl"
    log.write_text(log.read_text()[:-20])
    drive = series(read_drive(path))
    assert drive.ended == {"vehicle": False, "operator": False, "link": False}
    assert json.loads(json.dumps(drive.warnings))


def test_a_whole_number_may_be_written_as_a_float(tmp_path: Path) -> None:
    def rewritten(_side: str, lines: list[dict[str, Any]]) -> list[dict[str, Any]]:
        return [line | {"refused": float(line["refused"])} if line.get("log") == "sample" else line for line in lines]

    path = write_drive(tmp_path / "drive", seconds=5)
    as_floats = write_drive(tmp_path / "floats", seconds=5, change=rewritten)
    assert read_drive(as_floats).sides["operator"].lines == read_drive(path).sides["operator"].lines


def over_two_uplinks(side: str, lines: Lines) -> Lines:
    """What a vehicle with two uplinks logs: b stalls from 5 s to 8 s, and every other camera goes over a meanwhile."""
    found = []
    for line in lines:
        stalled = 5 <= line["t"] + (OPERATOR_LATER_S if side == "operator" else 0) < 8
        measured = {"kbps": 2000, "queue_ms": 10, "loss": 0, "state": "clear", "rtt_ms": 20}
        silent = {**measured, "kbps": 0, "queue_ms": 700, "state": "stalled"} if stalled else {**measured, "kbps": 1000}
        if line.get("log") in ("decision", "state") and "cameras" in line:
            own = [["a"], ["a" if stalled else "b"]]
            cameras = {name: each | {"uplinks": own[n % 2]} for n, (name, each) in enumerate(line["cameras"].items())}
            shares = {name: {"total_kbps": 3000 if name == "a" else 1500, "reason": ""} for name in "ab"}
            line |= {"cameras": cameras, "uplinks": {n: each | {"stalled": False} for n, each in shares.items()}}
        if line.get("log") == "telemetry":
            for name, each in (("a", measured), ("b", silent)):
                found.append({"t": line["t"], "event": "link_measured", "uplink": name, "evidence": {}, **each})
        if line.get("log") == "sample":
            counts = {"packets": int(100 * line["t"]), "lost": 0, "twins": 0, "late": 0}
            received = {"a": counts, "b": counts | {"lost": int(25 * line["t"])}}
            line |= {"cameras": {name: each | {"received": received} for name, each in line["cameras"].items()}}
            line["uplinks"] = {"a": measured, "b": silent}
        found.append(line)
    return found


@pytest.mark.parametrize("sides", [["vehicle", "operator"], ["vehicle"], ["operator"]])
def test_uplinks_over_time_and_in_figures(tmp_path: Path, sides: list[str]) -> None:
    drive = statistics(series(read_drive(write_drive(tmp_path / "drive", sides, seconds=20, change=over_two_uplinks))))
    a, b = (drive.uplinks[name] for name in "ab")
    assert (a.allowed, b.allowed) == (3000, 1500)
    assert (a.stalls, b.stalls, b.stalled_s) == (0, 1, pytest.approx(3, abs=0.3))
    assert (a.received, b.received) == (2000, pytest.approx(1000 * 17 / 20, rel=0.03))
    assert a.queue_p95_ms == b.queue_p95_ms == 10  # what stood in front of a stalled one is unknown
    moved = len(drive.cameras) // 2
    assert (a.came, a.left, b.came, b.left) == (moved, moved, moved, moved)
    if "operator" in sides:
        assert (a.share, a.lost, b.lost) == (0.5, 0, pytest.approx(0.2, rel=0.02))
    else:
        assert math.isnan(a.share)
    (rates,), (queues,) = uplinks([drive]) or ()
    assert [curve.label for curve in rates.curves] == ["a allowed", "a received", "b allowed", "b received"]
    assert queues.shades[1].spans == drive.series.uplinks["b"].stalls
    (described,) = to_json([drive], {}, [], [])["drives"]
    assert described["uplinks"]["b"]["stalls"] == 1
    assert [row[0] for row in uplink_rows(drive)[1]] == ["a", "b"]
