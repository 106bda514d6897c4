"""Messages about a camera that fails repeatedly."""

from __future__ import annotations

import pytest

from runner.gst.outage import Outage

pytestmark = pytest.mark.gst  # the package runner.gst loads it


def test_each_reason_is_reported_once_and_the_recovery_with_the_duration():
    messages = []
    outage = Outage(messages.append)
    assert outage.reason is None
    outage.report_failure("no frame for 1 s", 10.0)
    for second in range(12, 30):
        outage.report_failure("refused" if second % 2 else "no frame for 1 s", float(second))
    assert outage.reason == "no frame for 1 s"
    assert messages == ["no frame for 1 s", "refused"]
    outage.report_recovery(30.2)
    assert messages[2:] == ["works again after 20 s"]
    assert outage.reason is None


def test_a_new_failure_is_reported_again():
    messages = []
    outage = Outage(messages.append)
    for began in (0.0, 10.0):
        outage.report_failure("refused", began)
        outage.report_recovery(began + 1)
    assert messages == ["refused", "works again after 1 s"] * 2


def test_nothing_is_reported_if_nothing_failed():
    messages = []
    Outage(messages.append).report_recovery(1.0)
    assert messages == []
