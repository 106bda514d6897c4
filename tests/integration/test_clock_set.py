"""A vehicle whose clock is set while it drives, as one that starts in 1970: its log is read with the right times."""

from __future__ import annotations

import json
import time

import pytest

from rig import ROBOT, clock_ahead, free_port, needs_compiler, process, set_clock, until
from runner.drive.captures import files, received
from runner.drive.read import read_drive
from runner.drive.series import series
from runner.drive.statistics import statistics
from runner.records.lines import ClockSet

YEAR_S = 365.25 * 86400
IN_1970_S = 100.0


@pytest.fixture(scope="module")
def driven(tmp_path_factory):
    """A drive of 7 s with its video, whose clock is set right after 3 s, and when it began."""
    clock, path = tmp_path_factory.mktemp("clock"), tmp_path_factory.mktemp("drives") / "drive"
    env = clock_ahead(clock, IN_1970_S - time.time())
    ports = (f"media.port={free_port()}", f"control.port={free_port()}")
    words = (*ROBOT, *ports, f"log={path}", "log.video=true", "duration_s=7")
    with process("demo", *words, env=env) as demo:
        until(lambda: (path / "operator.jsonl").exists() or demo.poll() is not None)
        began = time.time()
        time.sleep(3)
        set_clock(clock, 0.0)
        output, _ = demo.communicate(timeout=60)
    assert demo.returncode == 0, output
    return path, began


@needs_compiler
def test_the_start_of_a_drive_in_1970_is_corrected(tod, driven, tmp_path):
    path, began = driven
    drive = read_drive(path)
    vehicle, operator = drive.sides["vehicle"], drive.sides["operator"]
    (was,) = vehicle.of(ClockSet)
    assert vehicle.began.time < IN_1970_S + YEAR_S < was.by_s
    assert abs(vehicle.began_s - began) < 5
    assert abs(operator.began_s - operator.began.time) < 0.1
    over_time = series(drive)
    assert (over_time.began, over_time.measured) == (vehicle.began_s, "received")
    (warning,) = over_time.warnings
    assert "/drive.jsonl: the clock was set by +" in warning
    assert statistics(over_time).share > 0.2  # of a test picture, which needs little
    # Capture times of the pictures of both sides, before and after the clock was set.
    until_s = vehicle.began_s + vehicle.end
    for side in (vehicle, operator):
        for recorded in files(side)["front"]:
            assert all(vehicle.began_s - 1 < ns / 1e9 < until_s for _, ns in recorded.times)
    known = [unit.captured / 1e9 for unit in received(operator, "front")]
    assert len(known) > 60
    assert all(vehicle.began_s < captured < until_s for captured in known)
    _check_export(tod, path, tmp_path, vehicle)
    # The operator's log alone knows the clock by the messages exchanged.
    (path / "drive.jsonl").rename(tmp_path / "drive.jsonl")
    alone = read_drive(path).sides["operator"]
    (tmp_path / "drive.jsonl").rename(path / "drive.jsonl")
    assert abs(alone.began_s - operator.began.time) < 0.1


def _check_export(tod, path, tmp_path, vehicle):
    pytest.importorskip("mcap")
    from mcap.reader import make_reader

    exported = tod("export", str(path), f"output={tmp_path / 'drive.mcap'}")
    assert exported.status == 0, exported.err
    with (tmp_path / "drive.mcap").open("rb") as file:
        reader = make_reader(file)
        summary = reader.get_summary()
        (began,) = (each.metadata for each in reader.iter_metadata() if each.name == "vehicle began")
    first, last = (ns / 1e9 for ns in (summary.statistics.message_start_time, summary.statistics.message_end_time))
    assert vehicle.began_s - 1 < first < last < vehicle.began_s + vehicle.end + 1
    assert abs(json.loads(began["time"]) - vehicle.began_s) < 1e-3
