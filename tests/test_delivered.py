"""Which picture was displayed at a moment, and which picture of a clip it shows."""

from pathlib import Path

from drives import EPOCH, Lines, write_drive
from helpers import vehicle
from hypothesis import given
from hypothesis import strategies as st

from runner.drive.captures import SAME_NS, RecordedVideo, UnitTimes, arrivals, matched, unfiled
from runner.drive.delivered import displayed_units, measure
from runner.drive.read import read_drive
from runner.drive.videos import Videos
from runner.h264.access_unit import coded_picture

MS = 1_000_000
DEADLINE = 300 * MS


def units(*times: tuple[int, int]) -> list[UnitTimes]:
    """Capture times and delays in ms."""
    return [UnitTimes(at * MS, (at + delay) * MS) for at, delay in times]


def test_a_picture_that_arrived_in_time_is_displayed_at_its_moment() -> None:
    log = units((0, 30), (100, 30), (200, 30))
    assert displayed_units([0, 100 * MS, 200 * MS], log, DEADLINE) == [0, 1, 2]


def test_times_of_both_sides_may_differ_by_less_than_half_a_frame() -> None:
    log = units((0, 30), (100, 30))
    assert displayed_units([100 * MS - SAME_NS // 2], log, DEADLINE) == [1]
    assert displayed_units([100 * MS - SAME_NS], log, DEADLINE) == [0]


def test_a_late_picture_leaves_the_older_one_displayed() -> None:
    log = units((0, 30), (100, 301), (200, 300))
    assert displayed_units([0, 100 * MS, 200 * MS], log, DEADLINE) == [0, 0, 2]


def test_without_new_pictures_the_last_one_stays_displayed() -> None:
    log = units((0, 30), (1000, 30))
    assert displayed_units([500 * MS, 900 * MS, 1000 * MS], log, DEADLINE) == [0, 0, 1]


def test_before_the_first_picture_nothing_is_displayed() -> None:
    assert displayed_units([-1000 * MS, 0], units((0, 400)), DEADLINE) == [-1, -1]


@given(st.lists(st.tuples(st.integers(0, 5000), st.integers(0, 1000)), max_size=30), st.integers(0, 6000))
def test_the_displayed_picture_was_captured_by_then_and_had_arrived(times: list[tuple[int, int]], at: int) -> None:
    log = sorted(units(*times))
    (number,) = displayed_units([at * MS], log, DEADLINE)
    fits = [n for n, u in enumerate(log) if u.captured <= at * MS + SAME_NS // 2 and u.arrived <= at * MS + DEADLINE]
    assert number == (fits[-1] if fits else -1)


def test_capture_times_are_those_of_identical_sent_pictures() -> None:
    """Whatever times the file states; one picture was damaged."""
    sent = {b"a": [0], b"b": [66 * MS, 6600 * MS], b"c": [133 * MS], b"e": [266 * MS]}
    filed = [ns * MS + 85 * MS for ns in (0, 66, 133, 200)] + [266 * MS + 10 * MS]
    assert list(matched(sent, [b"a", b"b", b"c", b"?", b"e"], filed)) == [ns * MS for ns in (0, 66, 133, 200, 266)]
    assert list(matched({}, [b"a"], [5 * MS])) == [5 * MS]


def test_arrivals_are_found_despite_an_apparent_clock_difference() -> None:
    """By 85 ms at first, then less and less; two pictures, one of them the first, are missing from the log."""
    captured = [100 * n * MS for n in range(30)]
    ahead = [max(0, 85 - 5 * n) * MS for n in range(30)]
    log = [UnitTimes(captured[n] + ahead[n], captured[n] + 200 * MS) for n in range(30) if n not in (0, 12)]
    assert arrivals(captured, log) == [
        UnitTimes(ns, ns + 200 * MS) for n, ns in enumerate(captured) if n not in (0, 12)
    ]
    assert arrivals(captured, []) == []


def test_pictures_that_arrived_and_are_in_no_file_are_found() -> None:
    """The clocks seem 40 ms apart; the file lacks a picture, and its end."""
    log = [UnitTimes(100 * n * MS + 40 * MS, 100 * n * MS + 90 * MS) for n in range(30)]
    filed = [100 * n * MS for n in range(20) if n != 7]
    absent = [UnitTimes(100 * n * MS, 100 * n * MS + 90 * MS) for n in (7, *range(20, 30))]
    assert unfiled(arrivals(filed, log), log) == absent
    assert unfiled(log, log) == unfiled([], []) == []


def test_a_video_without_pictures_of_the_vehicle_is_reported(tmp_path: Path) -> None:
    """Files that were cut off before their first complete picture, while pictures arrived."""

    def recorded(side: str, lines: Lines) -> Lines:
        video = {"t": 0.0, "log": "video", "camera": "front_left", "file": f"{side}.ts", "captured": EPOCH}
        return [video, *lines]

    drive = read_drive(write_drive(tmp_path, ["vehicle", "operator"], seconds=5, change=recorded))
    warnings: list[str] = []
    cameras = {"front_left": vehicle().cameras["front_left"]}
    videos = Videos(tmp_path, lambda _: iter(()), lambda *_, **__: iter(()))
    measure(drive, videos, cameras, {}, on_warning=warnings.append)
    ends = "the vehicle's video ends at 0.0 s, what arrived at 5.0 s"
    assert warnings == [f"front_left: {ends}: scored up to its end"]


def test_times_of_a_file_are_those_of_its_last_shift() -> None:
    """In ms: a pause of 5 s after the frame at 200, during which the clock ran on; then a receiver was 30 behind."""
    file = RecordedVideo("front", "front.ts", ((0, 1000 * MS), (300 * MS, 6300 * MS), (500 * MS, 6530 * MS)))
    assert [file.captured(after * MS) // MS for after in (0, 200, 300, 400, 500, 900)] == [
        1000,
        1200,
        6300,
        6400,
        6530,
        6930,
    ]
    assert file.captured(300 * MS - 5000) == 6300 * MS - 5000, "the file counts in 1/90000 s"


def test_parameter_sets_and_start_codes_do_not_distinguish_pictures() -> None:
    slices = b"\x41\x9a\x01", b"\x01\x9b\x02"
    sent = b"\0\0\0\1\x67\x42\0\0\0\1\x68\xce\0\0\1" + slices[0] + b"\0\0\1" + slices[1]
    arrived = b"\0\0\0\1" + slices[0] + b"\0\0\0\1" + slices[1] + b"\0"
    assert coded_picture(sent, "h264") == coded_picture(arrived, "h264") != b""
    assert coded_picture(sent.replace(b"\x9b", b"\x9c"), "h264") != coded_picture(arrived, "h264")
    assert coded_picture(b"\0\0\1\x67\x42", "h264") == b""
