"""The speed that a latency allows."""

from __future__ import annotations

import pytest

from runner.settings import LatencyLimit


@pytest.mark.parametrize(
    ("measured_ms", "factor"),
    [(0, 1), (140, 1), (140.1, 0.9995), (340, 0.5), (1940, 0.1), (None, 0)],
)
def test_the_limit_over_the_total_latency(measured_ms: float | None, factor: float) -> None:
    assert LatencyLimit(limit_ms=200, fixed_ms=60).speed_factor(measured_ms) == pytest.approx(factor)


def test_no_speed_is_advised_while_a_part_is_unknown() -> None:
    assert LatencyLimit().speed_factor(10) is None


def test_no_latency_at_all_is_full_speed() -> None:
    assert LatencyLimit(limit_ms=200, fixed_ms=0).speed_factor(0) == 1
