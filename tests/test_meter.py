"""Rates over the last second, and how well reception follows the decision, with hand-made counters."""

from __future__ import annotations

from dataclasses import dataclass

import pytest
from msgspec import UNSET, UnsetType

from runner.operator.meter import MOST_WINDOWS, ReceptionMeter, middle, percentile


@dataclass
class Counters:
    frames: int
    bytes: int
    width: int = 480
    height: int = 260
    latency_ms: float | None = 12.0
    lost: int = 0
    foreign: int = 0
    damaged: int = 0
    buffer_ms: int | None = None
    rebuilt: int = 0


@dataclass
class Decided:
    sending: bool = True
    kbps: int = 800
    width: int = 480
    height: int = 260
    fps: float | UnsetType = UNSET


def feed(meter: ReceptionMeter, seconds: float, fps: int = 20, kbps: int = 800, decided: Decided | None = None) -> None:
    """Four samples a second of a steady stream."""
    for sample in range(int(4 * seconds) + 1):
        t = sample / 4
        rates = meter.add(t, Counters(int(fps * t), int(kbps * 1000 / 8 * t)), decided)
        if sample:
            assert (rates.fps, rates.kbps) == (pytest.approx(fps), pytest.approx(kbps))


def test_rates_are_those_of_the_last_second() -> None:
    meter = ReceptionMeter(fps=20)
    assert meter.add(0.0, Counters(0, 0), None).kbps == 0
    feed(meter, 3)
    for sample in range(1, 5):  # then nothing arrives
        rates = meter.add(3 + sample / 4, Counters(60, 300_000), None)
    assert (rates.fps, rates.kbps) == (0, 0)


def test_windows_count_once_the_decision_is_settled() -> None:
    meter = ReceptionMeter(fps=20)
    feed(meter, 5, decided=Decided())
    assert meter.windows == 4  # at 1.5, 2.5, 3.5 and 4.5 s
    assert list(meter.followed) == [pytest.approx(1.0)] * 4
    assert (meter.short, meter.sizes, list(meter.latencies_ms)) == (0, {(480, 260): 4}, [12.0] * 4)


def test_windows_that_fall_short_of_the_decision_are_counted() -> None:
    meter = ReceptionMeter(fps=40)
    feed(meter, 5, decided=Decided(kbps=1600, width=960, height=520))
    assert list(meter.followed) == [pytest.approx(0.5)] * 4
    assert (meter.short, meter.sizes) == (4, {})


def test_fewer_pictures_than_the_camera_has_are_none_too_few_if_no_more_are_sent() -> None:
    meter = ReceptionMeter(fps=20)
    feed(meter, 10, fps=8, decided=Decided(fps=8.0))
    assert (meter.short, meter.windows > 5) == (0, True)


def test_windows_are_not_compared_while_nothing_is_sent() -> None:
    meter = ReceptionMeter(fps=20)
    feed(meter, 5, decided=Decided(sending=False))
    assert meter.windows == 0


def test_a_new_decision_has_time_to_settle() -> None:
    meter = ReceptionMeter(fps=20)
    for sample in range(13):
        meter.add(sample / 4, Counters(5 * sample, 25_000 * sample), Decided(fps=20.0 + sample // 4))
    assert meter.windows == 0


def test_a_bitrate_that_follows_the_link_hides_neither_latency_nor_missing_frames() -> None:
    meter = ReceptionMeter(fps=20)
    for sample in range(20):
        meter.add(sample / 4, Counters(2 * sample, 25_000 * sample), Decided(kbps=800 + sample // 4))
    assert (meter.windows, meter.short, meter.sized, meter.sizes) == (4, 4, 4, {(480, 260): 4})
    assert (list(meter.latencies_ms), list(meter.followed)) == ([12.0] * 4, [])
    for sample in range(20, 32):
        meter.add(sample / 4, Counters(5 * sample, 25_000 * sample), Decided(width=480 + 2 * sample))
    assert (meter.windows, meter.sized, list(meter.followed)) == (7, 4, [])


def test_memory_does_not_grow_for_weeks() -> None:
    meter = ReceptionMeter(fps=20)
    for t in range(MOST_WINDOWS + 100):
        meter.add(t, Counters(20 * t, 100_000 * t), Decided())
    assert meter.windows > MOST_WINDOWS
    assert len(meter.followed) == len(meter.latencies_ms) == MOST_WINDOWS


def test_percentiles() -> None:
    assert (percentile([], 0.5), middle([])) == (None, None)
    assert percentile(range(100), 0.95) == 95
    assert (percentile([7.0], 0.95), middle([3.0, 1.0, 2.0])) == (7.0, 2.0)
