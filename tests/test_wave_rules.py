"""Refresh waves are as rare as losses allow."""

from __future__ import annotations

import pytest
from helpers import Drive

from runner.core.graph_settings import NEVER_S
from runner.vehicle.repair import KeyFrames

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


def test_without_a_longest_interval_there_are_none_without_loss_and_with_loss_as_many_as_it_asks_for():
    drive = Drive(*WORDS, "graph.longest_wave_s=0")
    settings = drive.vehicle.cameras["rear"].graph.settings
    assert (settings.shortest_wave_s, settings.key_interval_s, settings.may_have_no_waves) == (1.5, None, True)
    assert intervals(drive) == {1.5}
    drive.accept("operator_connected", t=0)
    measure(drive, 0, 1, 0.0)
    assert intervals(drive) == {NEVER_S}
    assert "no refresh waves: 0 % of the packets lost" in drive["rear"].reason
    measure(drive, 12, 12.1, 0.0025)
    assert intervals(drive) == {6.0}
    measure(drive, 12.1, 12.2, 0.02)
    assert intervals(drive) == {1.5}


def test_key_pictures_are_sent_to_who_asks_for_them_and_more_rarely_to_who_only_watches():
    drive = Drive(*WORDS, "graph.longest_wave_s=0")
    drive.accept("operator_connected", t=0)
    measure(drive, 0, 1, 0.0)
    frames, decision = KeyFrames(), drive.run.decision

    def sent(t, drives):
        return frames.to_repair(["rear", "unknown"], decision, t, drives)

    assert [sent(t, True) for t in (1.0, 1.4, 1.5)] == [["rear"], [], ["rear"]]
    assert [sent(t, False) for t in (2.5, 4.5, 5.0, 7.9)] == [[], ["rear"], [], ["rear"]]
    with_waves = Drive(*WORDS)
    assert KeyFrames().to_repair(["rear"], with_waves.run.decision, 1.0, False) == []
