"""Refresh waves are as rare as losses allow."""

from __future__ import annotations

import pytest
from helpers import Drive

WORDS = ("vehicle=delivery_robot", "mode=collective", "modes.collective.waves_by_loss={loss: 0.01, calm_s: 10}")


@pytest.fixture
def drive():
    return Drive(*WORDS)


def measure(drive, begin, end, loss):
    evidence = dict.fromkeys(
        ("busy_kbit", "busy_s", "train_kbit", "train_s", "idle_kbit", "kbit", "wait_s", "longest_s"), 0.0
    )
    evidence |= dict.fromkeys(("shorter_s", "growth", "lost_kbit", "age_s", "silent_s"), 0.0)
    evidence |= {"trains": 0, "idle": 0, "unqueued": 0, "backlog": False}
    for tenth in range(round(10 * begin), round(10 * end)):
        link = {"kbps": 2000, "queue_ms": 0, "loss": loss, "state": "clear", "rtt_ms": 30, "evidence": evidence}
        drive.accept("link_measured", t=tenth / 10, **link)


def intervals(drive):
    return {float(drive[name].wave_s) for name in drive.vehicle.cameras}


def test_waves_are_frequent_until_the_link_is_measured_without_loss(drive):
    assert intervals(drive) == {1.5}
    drive.accept("operator_connected", t=0)
    measure(drive, 0, 1, 0.0)
    assert intervals(drive) == {6.0}
    assert "refresh waves every 6 s: 0 % of the packets lost" in drive["rear"].reason


def test_loss_brings_them_back_at_once_and_they_go_after_ten_seconds_without(drive):
    drive.accept("operator_connected", t=0)
    measure(drive, 0, 1, 0.0)
    measure(drive, 1, 1.1, 0.02)
    assert intervals(drive) == {1.5}
    measure(drive, 1.1, 10.9, 0.0)
    assert intervals(drive) == {1.5}
    measure(drive, 10.9, 11.2, 0.0)
    assert intervals(drive) == {6.0}
    measure(drive, 12, 12.1, 0.005)
    assert intervals(drive) == {3.5}


def test_a_vehicle_without_the_rule_has_its_encoders_make_them():
    drive = Drive(*WORDS[:2])
    assert drive["rear"].wave_s is None
    assert drive.vehicle.cameras["rear"].graph.settings.key_interval_s == 1.5


def test_who_waits_for_a_wave_waits_for_the_longest_interval(drive):
    settings = drive.vehicle.cameras["rear"].graph.settings
    assert (settings.shortest_wave_s, settings.key_interval_s) == (1.5, 6.0)
