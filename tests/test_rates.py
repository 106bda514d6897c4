"""What fewer pictures a second look like, from the scores of encodings. Pure."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from math import gcd
from types import SimpleNamespace
from typing import Any

import pytest
from helpers import vehicle

from runner.configuration.config import configuration
from runner.errors import ConfigError
from runner.rate_quality.curves import Point
from runner.rate_quality.rates import (
    RatePoint,
    compared,
    every_nth,
    rate_lanes,
    rate_points,
    rate_stride,
    rate_table,
)

CAMERA = vehicle("vehicle=delivery_robot").cameras["front"]


def point(kbps: int, *scores: float, actual: float = 0.0) -> Point:
    return Point(Fraction(1), kbps, actual or float(kbps), float(kbps), 1.0, {"mssim": scores})


@pytest.mark.parametrize(
    ("fps", "wanted", "every"),
    [(25, (12.5, 8.333333, 5), [1, 2, 3, 5]), (25, (30, 25), []), (40, (1,), [1, 8]), (4, (1,), []), (10, (), [])],
)
def test_only_each_nth_picture_is_evenly_spaced(fps: int, wanted: tuple[float, ...], every: list[int]) -> None:
    assert every_nth(replace(CAMERA, fps=Fraction(fps)), [Fraction(str(each)) for each in wanted]) == every


@pytest.mark.parametrize("stride", range(1, 9))
@pytest.mark.parametrize("every", [[1, 2], [1, 5], [1, 2, 3, 5], [1, 8]])
def test_scored_frames_meet_all_ages_of_a_picture(stride: int, every: list[int]) -> None:
    step = rate_stride(stride, every)
    assert 1 <= step <= stride
    assert all(gcd(step, nth) == 1 for nth in every)


def test_delivered_and_held_are_different_figures() -> None:
    """Of each second picture: frames 0, 2, 4 are sent, 1, 3, 5 show them."""
    moving = point(200, 0.9, 0.5, 0.9, 0.5, 0.9, 0.5)
    assert rate_points("mssim", [[moving]], 2, 1) == {200: RatePoint(200, pytest.approx(0.9), pytest.approx(0.7))}
    third = point(200, 0.5, 0.9, 0.9, 0.5)  # of each third frame from 1 on: 1, 4, 7, 10
    assert rate_points("mssim", [[third]], 2, 3)[200].delivered == pytest.approx((0.9 + 0.5) / 2)
    assert rate_points("mssim", [[moving], [point(200, 0.7, 0.7)]], 2, 1)[200].held == pytest.approx(5.6 / 8)


def test_bitrates_that_a_rate_exceeds_are_compared_at_none() -> None:
    slow = rate_points("mssim", [[point(100, 0.9, 0.8, actual=120), point(200, 0.9, 0.8)]], 2, 1)
    assert list(slow) == [200]
    full = rate_points("mssim", [[point(100, 0.7, 0.7), point(200, 0.8, 0.8)]], 1, 1)
    found = compared({Fraction(20): full, Fraction(10): slow})
    assert {fps: [each.kbps for each in points] for fps, points in found.items()} == {20: [200], 10: [200]}
    assert compared({Fraction(20): {}, Fraction(10): slow}) == {}
    assert rate_table(found)[-1].split() == ["10", "Hz", "0.9000/0.8500"]
    assert rate_table({}) == []


def test_factors_are_those_that_a_vehicle_would_choose() -> None:
    choice: Any = SimpleNamespace(scaling=(Fraction(1, 4), Fraction(1, 2)), b_min=(0, 300), b_full=1000)
    lanes = rate_lanes(choice, range(100, 2100, 100), 2)
    assert [(lane.kbps, float(lane.scaling), lane.nth) for lane in lanes] == [
        *((200, 0.25, 2), (400, 0.5, 2), (600, 0.5, 2), (800, 0.5, 2), (1000, 0.5, 2)),
    ]


def test_a_rule_reads_them_from_the_camera() -> None:
    entry = "{fps: 7.5, delivered: [[150, 0.84], [700, 0.94]], held: [[150, 0.8], [700, 0.86]]}"
    words = ("vehicle=delivery_robot", "source=test", f"cameras.front.rate_quality.rates=[{entry}]")
    rates = configuration(words).setup().vehicle.cameras["front"].rate_quality.rates
    assert rates[Fraction(15, 2)].held == ((150, 0.8), (700, 0.86))
    assert rates[Fraction(15, 2)].delivered[0] == (150, 0.84)
    with pytest.raises(ConfigError, match="held"):
        configuration((*words[:2], "cameras.front.rate_quality.rates=[{fps: 7.5, delivered: [[1, 0.5]]}]")).setup()
