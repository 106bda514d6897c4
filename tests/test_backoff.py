"""Pauses between attempts."""

from __future__ import annotations

import pytest

from runner.system.backoff import pause_s


@pytest.mark.parametrize(("failed", "pause"), [(0, 1), (1, 2), (3, 8), (4, 10), (1024, 10), (10**9, 10)])
def test_pauses_double_up_to_the_longest_however_long_an_outage_lasts(failed: int, pause: float) -> None:
    assert pause_s(failed, 1.0, 10.0) == pause
