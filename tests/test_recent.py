"""A value counts only while it is recent."""

import pytest

from runner.system import recent
from runner.system.recent import CURRENT_S, RecentValue


def test_a_value_expires(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    monkeypatch.setattr(recent.time, "monotonic", lambda: now[0])
    value = RecentValue[float]()
    assert value.get() is None
    value.set(0.0)
    assert value.get() == 0.0
    now[0] += CURRENT_S
    assert value.get() == 0.0
    now[0] += 0.001
    assert value.get() is None
    value.set(7.0)
    assert value.get() == 7.0
