"""Positions from bags: as a track, and as a replacement for those in a drive's log."""

from __future__ import annotations

import json

import pytest

pytest.importorskip("rosbags")

from bags import fix, typestore, write_bag
from drives import EPOCH, measured, write_drive

from runner.core.model import ModelError
from runner.drive.positions import reader
from runner.drive.series import series
from runner.errors import UserError
from runner.pqos import build_track
from runner.pqos.track import track_of_bag

BEGAN_NS = round(EPOCH * 1e9)
STORE = typestore("mcap")


def gps(path, *topics, first_s=-2.0, count=60, status=0):
    """Positions twice a second, heading north, from before the drive."""
    times = [BEGAN_NS + round((first_s + n / 2) * 1e9) for n in range(count)]
    fixes = [(ns + 7, fix(STORE, ns, 48.0 + n / 10_000, 11.5, status)) for n, ns in enumerate(times)]
    return write_bag(path, "mcap", dict.fromkeys(topics, fixes))


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    directory = tmp_path_factory.mktemp("logged")
    words = ("vehicle=delivery_robot", "fps_max=5")
    return write_drive(directory / "drive", seconds=20, congested=2.0, overrides=words, change=measured)


def test_a_bag_is_a_track(tmp_path):
    track = track_of_bag(gps(tmp_path / "b", "/gps"), None, loop=False)
    assert track.duration_s == pytest.approx(29.5)
    place = track.at(0.25)
    assert (place.lat, place.lon) == pytest.approx((48.00005, 11.5))
    assert place.speed_mps == pytest.approx(22.2, abs=0.1)  # 11.1 m in half a second
    assert place.heading_deg == pytest.approx(0)


@pytest.mark.slow
def test_a_bag_is_named_as_a_track(tmp_path, tod):
    bag = gps(tmp_path / "b", "/gps", "/rtk/fix")
    position = {"kind": "track", "file": bag.name, "topic": "/gps"}
    assert build_track({"position": position}, [tmp_path]).duration_s == pytest.approx(29.5)
    words = ("source=test", "pqos=constant", f"+pqos.position={{kind: track, file: {bag}, loop: true}}")
    rule = f"conf/pqos/constant.yaml: position.topic: {bag}: must be given: one of /gps, /rtk/fix"
    assert tod("validate", *words).problems == [rule]
    assert tod("validate", *words, "+pqos.position.topic=/gps").status == 0
    (problem,) = tod("validate", *words, "+pqos.position.topic=/gsp").problems
    assert problem.endswith(f"{bag}: /gsp: no such topic with positions, did you mean /gps?")


def test_a_bag_with_one_place_is_no_track(tmp_path):
    with pytest.raises(ModelError, match="must have at least two positions with a fix, at different times"):
        track_of_bag(gps(tmp_path / "b", "/gps", count=1), None, loop=False)


@pytest.mark.parametrize("sides", [("vehicle", "operator"), ("operator",)])
def test_a_drive_has_the_positions_of_a_bag(tmp_path, sides):
    drive = write_drive(tmp_path / "drive", sides, seconds=20, overrides=("vehicle=delivery_robot", "fps_max=5"))
    bag = gps(tmp_path / "b", "/gps")
    positions = series(reader({"positions": str(bag)})(drive)).positions
    later = 1.5 if sides == ("operator",) else 0.0  # its log begins later
    assert positions.t[0] == pytest.approx(0.0, abs=0.5)
    assert positions.t[-1] <= 20
    assert list(positions.lat) == pytest.approx([48.0 + (2 + later + t) * 2 / 10_000 for t in positions.t], abs=1e-9)
    assert len(positions.t) == pytest.approx((20 - later) * 2, abs=2)


def test_a_report_and_a_map_show_the_positions_of_a_bag(tmp_path, tod, drive):
    bag = gps(tmp_path / "b", "/gps", "/other")
    output = tmp_path / "map.csv"
    words = (str(drive), f"output={output}", f"positions={bag}")
    assert tod("map", *words, "topic=/gps").status == 0
    rows = [line.split(",") for line in output.read_text().splitlines()[1:]]
    assert rows
    assert all(48.0 < float(lat) < 48.006 and float(lon) == 11.5 for lon, lat, *_ in rows)
    result = tod("map", *words)
    assert (result.status, result.err) == (2, f"command line: positions: {bag}: must be given: one of /gps, /other\n")


def test_a_replay_has_the_positions_of_a_bag(tmp_path, tod, drive):
    bag = gps(tmp_path / "b", "/gps")
    lines = [json.loads(line) for line in tod("replay", f"input={drive}", f"positions={bag}").out.splitlines()]
    own = [json.loads(line) for line in tod("replay", f"input={drive}").out.splitlines()]
    assert [line["t"] for line in lines] == sorted(line["t"] for line in lines)
    positions = [line for line in lines if line["event"] == "position_reported"]
    assert {line.get("source") for line in positions} == {"bag"}
    assert [line["t"] for line in positions] == [n / 2 for n in range(len(positions))]
    assert 38 <= len(positions) <= 41
    others = [line["t"] for line in own if line["event"] != "position_reported"]
    assert [line["t"] for line in lines if line["event"] != "position_reported"] == others


def test_problems_of_positions_are_reported(tmp_path, tod, drive):
    late, blind = gps(tmp_path / "late", "/gps", first_s=500), gps(tmp_path / "blind", "/gps", status=-1)
    for words, problem in (
        (["topic=/gps"], "command line: positions: must be given with topic: the bag that has it"),
        ([f"positions={tmp_path}/none"], f"command line: positions: {tmp_path}/none: no such file"),
        ([f"positions={blind}"], f"command line: positions: {blind}: /gps: has no position with a fix"),
        (
            [f"positions={late}"],
            f"command line: positions: {late}: /gps: 2026-02-02T02:48:20 to 2026-02-02T02:48:49 UTC: no position falls "
            f"into DRIVE; both must have been recorded by the same clock",
        ),
    ):
        span = "2026-02-02T02:40:00 to 2026-02-02T02:4"
        result = tod("map", str(drive), f"output={tmp_path}/m.csv", *words)
        assert result.status == 2
        begin, _, end = problem.partition("DRIVE")
        assert result.err.startswith(begin + (f"{drive}: {span}" if end else ""))
        assert result.err.endswith(f"{end}\n")
        result = tod("replay", f"input={drive}", f"output={tmp_path}/o", *words)
        assert result.status == 2
        assert result.err.startswith(begin + (f"the input: {span}" if end else ""))


def test_events_alone_have_no_clock(tmp_path, tod):
    events = tmp_path / "events.jsonl"
    events.write_text('{"t": 0, "event": "clock_advanced"}\n')
    bag = gps(tmp_path / "b", "/gps")
    result = tod("replay", f"input={events}", f"positions={bag}")
    rule = "needs a drive as input: events alone do not state when they happened"
    assert (result.status, result.err) == (2, f"command line: positions: {bag}: /gps: {rule}\n")


def test_without_arguments_a_drive_has_its_own_positions(drive):
    positions = series(reader({})(drive)).positions
    assert positions is None or 48.0 not in positions.lat.round(1)
    with pytest.raises(UserError):
        reader({"topic": "/gps"})
