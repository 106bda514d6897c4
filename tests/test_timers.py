"""Timers in GLib's main loop."""

from __future__ import annotations

import pytest

from runner.gst.timers import every

pytestmark = pytest.mark.gst  # the package runner.gst loads it


def test_a_timer_goes_on_after_exceptions_and_each_is_reported_once():
    from gi.repository import GLib

    context, faults, calls = GLib.MainContext.default(), [], []

    def work():
        calls.append(1)
        if len(calls) in (2, 3, 5):
            raise OSError("no access")
        if len(calls) == 6:
            raise KeyError("alice")

    timer = every(1, work, faults.append)
    while len(calls) < 8:
        context.iteration(True)
    assert GLib.source_remove(timer)
    assert faults == ["OSError: no access", "OSError: no access", "KeyError: 'alice'"]
