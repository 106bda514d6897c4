"""Presence of operators, and which requests are too old."""

from __future__ import annotations

import pytest

from runner.mqtt.messages import MAX_ROUND_TRIP_S
from runner.vehicle.operators import DELAYS, MAX_OPERATORS, SILENT_S, Operators

BROKE = "a connection broke: silence shows whether the operator has gone"


def test_an_operator_leaves_only_by_its_own_silence_or_sign_off() -> None:
    operators = Operators(1.0)
    assert operators.connected("a", 0.0)
    assert operators.connected("b", 0.0)
    assert not operators.signed_off("stranger")
    assert operators.signed_off("b")
    assert operators.present == {"a"}
    assert operators.expire_silent(SILENT_S) == []
    assert operators.expire_silent(SILENT_S + 0.1) == ["a"]
    assert operators.expire_silent(100) == []  # already offline
    assert operators.present == frozenset()


def test_any_message_of_its_own_brings_an_operator_back() -> None:
    operators = Operators(1.0)
    operators.connected("a", 0.0)
    operators.expire_silent(5.0)
    assert not operators.message_received("b", 6.0)
    assert operators.present == frozenset()
    assert operators.message_received("a", 6.0)
    assert not operators.message_received("a", 6.1)
    assert operators.present == {"a"}


def test_a_sender_without_announcement_is_no_operator() -> None:
    operators = Operators(1.0)
    assert not operators.message_received("predictor", 0.0)
    assert operators.present == frozenset()


def test_an_operator_with_queued_messages_is_not_silent() -> None:
    operators = Operators(1.0)
    operators.connected("driver", 0.0)
    assert operators.expire_silent(5.0, {"driver"}) == []
    assert operators.expire_silent(5.0, {"onlooker"}) == ["driver"]


def test_the_longest_absent_is_forgotten_first() -> None:
    operators = Operators(1.0)
    operators.connected("driver", 0.0)
    for number in range(10 * MAX_OPERATORS):
        operators.message_received(f"stranger{number}", float(number))
    assert operators.present == {"driver"}


@pytest.mark.parametrize(
    "delays, delay, expired",
    [
        ([], 0.99, None),
        ([], 1.01, "1.01 s old, limit 1.00 s"),
        ([0.2, 0.3], 1.19, None),  # besides the round trip, the smallest delay so far
        ([0.2, 0.3], 1.21, "1.21 s old, limit 1.20 s"),
        ([6.0, 6.0], 6.0, f"6.00 s old, limit {1 + MAX_ROUND_TRIP_S:.2f} s"),
        ([0.01] + [0.4] * DELAYS, 1.39, None),  # the path has become longer
        ([], -0.05, None),
        ([], -0.2, "as_of 100.2 is ahead of the vehicle's time, 100"),
    ],
)
def test_a_request_expires(delays: list[float], delay: float, expired: str | None) -> None:
    operators = Operators(1.0)
    for earlier in delays:
        operators.expired("a", 50.0, 50.0 - earlier)
        operators.expired("b", 50.0, 50.0)  # another operator's path does not matter
    assert operators.expired("a", 100.0, 100.0 - delay) == expired


def test_an_operator_stays_while_another_process_of_it_reports_or_only_a_connection_broke() -> None:
    """The broker publishes the last will of a connection that a new one of the same operator replaces."""
    operators = Operators(1.0)
    operators.connected("a", 0.0)
    operators.reported("a", 0.0, run=1)
    assert operators.stays("a", 0.5, ended=1, will=False) is None
    assert operators.stays("a", 0.5, ended=2, will=False) == "another process of this operator goes on"
    assert operators.stays("a", 1.5, ended=2, will=False) is None
    assert operators.stays("a", 1.5, ended=None, will=True) == BROKE
    assert operators.stays("stranger", 1.5, ended=None, will=False) is None


def test_an_operator_may_be_present_to_watch_only() -> None:
    operators = Operators(1.0)
    operators.connected("station", 0.0, watching=True)
    operators.connected("driver", 0.0)
    assert (operators.present, operators.watching) == ({"station", "driver"}, {"station"})
    operators.message_received("station", 0.5)  # such as a report
    assert operators.watching == {"station"}
    operators.connected("station", 1.0)
    assert operators.watching == set()
