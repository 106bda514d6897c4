"""Rules on speed and gear: weights and frame rates, smooth, and stated."""

from __future__ import annotations

from fractions import Fraction

import pytest
from helpers import Command, Drive

from runner.core.commands import wanted
from runner.core.frame_rate import sent_rate

WORDS = ("modes=motion", "vehicle=tum_q7", "mode=collective", "cameras.rear_center.fps=40", "cameras.front_left.fps=40")


@pytest.fixture
def drive():
    drive = Drive(*WORDS)
    drive.accept("total_set", kbps=3000)
    return drive


def go(drive, speed, begin, end, gear="D"):
    """Drive at a speed, reported ten times a second."""
    for tenth in range(round(10 * begin), round(10 * end)):
        t = tenth / 10
        drive.accept("position_reported", t=t, lat=48.0, lon=11.0, speed_mps=speed)
        drive.accept("steering_reported", t=t, rad=0.0, gear=gear)
        drive.accept("clock_advanced", t=t)


def test_each_nth_picture_is_sent_never_less_than_five_a_second(drive):
    camera = drive.vehicle.cameras["rear_center"]
    assert [sent_rate(camera, Fraction(hz)) for hz in (100, 40, 39, 20, 15, 10, 1)] == [
        *(40, 40, 20, 20, Fraction(40, 3), 10, 5)
    ]


def test_a_speed_that_nobody_states_changes_nothing(drive):
    plain = Drive(*WORDS[1:])
    plain.accept("total_set", kbps=3000)
    for each in (drive, plain):
        each.accept("clock_advanced", t=30)
    for name, camera in drive.vehicle.cameras.items():
        assert drive[name].kbps == plain[name].kbps
        assert drive[name].fps == camera.fps
        assert plain[name].fps is None
        assert wanted(drive[name])["fps"] == camera.fps
        assert "fps" not in wanted(plain[name])


def test_a_vehicle_that_stands_sends_fewer_pictures_until_it_moves(drive):
    go(drive, 0.0, 0, 2.9)
    assert drive["rear_center"].fps == 40
    go(drive, 0.0, 2.9, 4)
    assert drive["rear_center"].fps == drive["front_left"].fps == 10
    assert "0.3 m/s or less: front 10 Hz, side 10 Hz, rear 10 Hz" in drive["rear_center"].reason
    go(drive, 0.33, 4, 5)  # within the margin
    assert drive["rear_center"].fps == 10
    go(drive, 0.5, 5, 5.1)
    assert drive["rear_center"].fps == 40


def test_in_reverse_weights_blend_and_bits_move_to_the_rear(drive):
    go(drive, 5.0, 0, 1)
    before = {name: drive[name].kbps for name in drive.vehicle.cameras}
    shares = []
    for tenth in range(10, 35):
        go(drive, 5.0, tenth / 10, (tenth + 1) / 10, gear="R")
        shares.append(drive["rear_center"].kbps)
    assert shares == sorted(shares)
    assert len(set(shares)) >= 8  # no jump
    assert shares[-1] > 1.8 * before["rear_center"]
    assert drive["front_left"].kbps < 0.7 * before["front_left"]
    assert "in reverse: front 13.3 Hz" not in drive["rear_center"].reason
    assert "in reverse: front 15 Hz, side weight times 1.5, rear weight times 3" in drive["rear_center"].reason
    go(drive, 5.0, 3.5, 7)
    assert {name: drive[name].kbps for name in drive.vehicle.cameras} == before


def test_a_speed_that_is_no_longer_reported_ends_it(drive):
    go(drive, 30.0, 0, 7)
    assert drive["rear_center"].fps == 20
    drive.accept("clock_advanced", t=9.0)
    assert drive["rear_center"].fps == 40


def test_in_mode_single_every_picture_is_sent_again(drive):
    go(drive, 0.0, 0, 4)
    drive.accept("mode_selected", t=4.1, mode="single")
    assert drive["rear_center"].fps == 40


def test_the_headers_of_pictures_that_are_not_sent_leave_bits_to_video():
    from runner.core.budget import unplaced, video_kbps
    from runner.core.frame_rate import slowed

    camera = Drive(*WORDS).vehicle.cameras["rear_center"]
    more, same = (video_kbps((unplaced(slowed(camera, Fraction(hz))),), Fraction(300)) for hz in (10, 40))
    assert float(more - same) == pytest.approx(30 * 58 * 8 / 1000 / (1 + 58 / 1186), rel=0.01)


def test_no_rate_is_zero(tod: Command):
    result = tod("validate", "modes=motion", "modes.automatic.while_standing.rear_fps=0")
    assert result.problems == ["command line: modes.automatic.while_standing.rear_fps: 0: must be above 0"]
