"""The rate at which a camera's pictures arrive, as an encoder and the driver are told."""

from __future__ import annotations

import random
from bisect import bisect_right
from itertools import accumulate, pairwise

import pytest

from runner.gst.picture_rate import PictureRate

pytestmark = pytest.mark.gst  # the package runner.gst loads it
LOOK_S = 0.02


def looked(*parts: tuple[float, float], fps: float = 40.0, stalls: tuple[tuple[float, float], ...] = ()):
    """(time, pace, slow rate) at each look while a camera delivers. parts: Hz, s. stalls: nothing runs from, to."""
    arrivals, at = [], 0.0
    for hz, seconds in parts:
        arrivals += [at + n / hz for n in range(1, int(hz * seconds) + 1)] if hz else []
        at += seconds
    rate, seen = PictureRate(fps), []
    for look in range(1, int(at / LOOK_S)):
        now = look * LOOK_S
        if not any(began <= now < ended for began, ended in stalls):
            rate.look(now, sum(arrival <= now for arrival in arrivals))
            seen.append((now, rate.pace, rate.slow_fps))
    return seen


def paces(seen):
    return [(round(now, 1), round(pace, 1)) for (_, before, _), (now, pace, _) in pairwise(seen) if pace != before]


def test_an_encoder_learns_a_lower_rate_within_seconds_and_a_higher_one_within_two_pictures():
    seen = looked((40, 4), (10, 5), (40, 2))
    assert all(pace == 1 for now, pace, _ in seen if now < 4)
    assert all(pace == pytest.approx(4, rel=0.15) for now, pace, _ in seen if 6.3 < now < 9)
    assert all(pace == 1 for now, pace, _ in seen if now > 9.1)


@pytest.mark.parametrize(("hz", "pace"), [(20, 2), (5, 8), (3, 8), (60, 2 / 3), (38, 1)])
def test_the_pace_is_the_camera_s_rate_by_the_one_that_arrives_within_limits(hz, pace):
    seen = looked((hz, 6))
    assert seen[-1][1] == pytest.approx(pace, rel=0.1)


@pytest.mark.parametrize("length", [0.3, 0.6, 0.9])
def test_a_stall_is_no_lower_rate(length):
    seen = looked((40, 3), (0, length), (40, 3))
    assert {pace for _, pace, _ in seen} == {1.0}
    assert {slow for _, _, slow in seen} == {None}
    held_up = looked((40, 6), stalls=((3, 3 + length),))
    assert {pace for _, pace, _ in held_up} == {1.0}
    assert {slow for _, _, slow in held_up} == {None}


def test_the_driver_is_told_after_two_seconds_until_the_rate_is_back():
    seen = looked((40, 3), (12, 5), (40, 3))
    told = [(now, slow) for now, _, slow in seen if slow]
    assert 5 < told[0][0] < 6.6
    assert 8 < told[-1][0] < 10
    assert all(slow == pytest.approx(12, abs=0.7) for now, slow in told if 6 < now < 8)


def test_a_rate_of_three_quarters_is_not_told():
    assert {slow for _, _, slow in looked((30, 6))} == {None}


def test_nothing_is_known_of_a_silent_camera():
    seen = looked((10, 6), (0, 3))
    assert (seen[-1][1], seen[-1][2]) == (1.0, None)


def test_a_low_rate_that_varies_a_little_is_told_once():
    """Each other number would be published with the whole state of the vehicle."""
    chance, rate, told = random.Random(1), PictureRate(40.0), []
    arrivals = list(accumulate(chance.uniform(0.9, 1.1) / 11.5 for _ in range(11 * 30)))
    for look in range(int(arrivals[-1] / LOOK_S)):
        rate.look(look * LOOK_S, bisect_right(arrivals, look * LOOK_S))
        told.append(rate.slow_fps)
    assert len(set(told)) <= 3  # None, then the rate
    assert told[-1] == pytest.approx(11.5, abs=1)


def test_a_camera_that_falls_silent_is_not_back_at_its_rate():
    rate = PictureRate(40.0)
    for look in range(400):
        rate.look(look * LOOK_S, min(look, 300) // 5)
        assert not (look > 100 and rate.is_steady)
    assert rate.slow_fps is None


def test_pictures_that_the_network_holds_up_are_not_the_camera_s():
    rate = PictureRate(40.0)
    for look in range(500):
        rate.look(look * LOOK_S, look // 5, is_held_up=look % 5 == 4)
        assert (rate.pace, rate.slow_fps) == (1.0, None)
