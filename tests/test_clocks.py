"""Ages of pictures by two machines' clocks: which are reported and which are unknown."""

from __future__ import annotations

from dataclasses import dataclass, replace

import pytest

from runner.system.clocks import TRUSTED_AGAIN_S, Clocks


@dataclass(frozen=True)
class Sample:
    frames: int = 0
    latency_ms: float | None = None


def ages(clocks: Clocks, t: float, **samples: Sample) -> list[float | None]:
    return [sample.latency_ms for sample in clocks.checked(t, samples).values()]


def test_ages_are_reported_while_none_is_negative() -> None:
    clocks = Clocks()
    assert ages(clocks, 0.0, front=Sample(), rear=Sample()) == [None, None]
    assert ages(clocks, 0.25, front=Sample(3, 40.0), rear=Sample(3, 0.0)) == [40.0, 0.0]
    assert clocks.ahead_ms is None


def test_a_clock_that_is_ahead_makes_every_age_unknown_for_a_while() -> None:
    clocks = Clocks()
    assert ages(clocks, 0.25, front=Sample(3, 40.0), rear=Sample(3, -60.0)) == [None, None]
    assert clocks.ahead_ms == 60
    assert ages(clocks, 0.5, front=Sample(6, -90.0), rear=Sample(6, 10.0)) == [None, None]
    assert clocks.ahead_ms == 90
    assert ages(clocks, TRUSTED_AGAIN_S, front=Sample(60, 10.0), rear=Sample(60, 10.0)) == [None, None]
    assert ages(clocks, TRUSTED_AGAIN_S + 1, front=Sample(66, 10.0), rear=Sample(66, 10.0)) == [10.0, 10.0]
    assert clocks.ahead_ms is None


@pytest.mark.parametrize(("noise_ms", "expected"), [(-0.4, None), (0.0, 0.0)])
def test_noise_around_zero_is_no_clock_that_is_ahead(noise_ms: float, expected: float | None) -> None:
    clocks = Clocks()
    assert ages(clocks, 0.25, front=Sample(3, noise_ms), rear=Sample(3, 5.0)) == [expected, 5.0]
    assert clocks.ahead_ms is None


def test_the_age_of_the_last_picture_of_a_silent_camera_is_not_reported() -> None:
    clocks, last = Clocks(), Sample(3, 40.0)
    assert ages(clocks, 0.25, front=last) == [40.0]
    assert ages(clocks, 1.25, front=last) == [40.0]
    assert ages(clocks, 1.5, front=last) == [None]
    assert ages(clocks, 1.75, front=replace(last, frames=4)) == [40.0]


def test_a_negative_age_of_a_silent_camera_does_not_count_for_ever() -> None:
    clocks, last = Clocks(), Sample(3, -500.0)
    assert ages(clocks, 0.25, front=last, rear=Sample(3, 10.0)) == [None, None]
    assert ages(clocks, 11.0, front=last, rear=Sample(50, 10.0)) == [None, 10.0]
