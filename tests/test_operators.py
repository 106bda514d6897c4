"""Presence of operators, and which requests are too old."""

from __future__ import annotations

import pytest

from runner.mqtt.messages import MAX_ROUND_TRIP_S
from runner.vehicle.operators import DELAYS, MAX_OPERATORS, SILENT_S, Operators


def test_an_operator_leaves_only_by_its_own_silence_or_sign_off() -> None:
    operators = Operators(1.0)
    assert operators.connected("a", 0.0)
    assert operators.connected("b", 0.0)
    assert not operators.disconnected("stranger", 0.0)
    assert operators.disconnected("b", 0.0)
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


def test_the_operator_who_has_been_present_longest_is_in_control() -> None:
    operators = Operators(1.0)
    assert operators.in_control == ""
    operators.connected("b", 0.0)
    operators.connected("a", 0.5)
    operators.message_received("b", 1.2)
    assert operators.in_control == "b"
    operators.expire_silent(2.0)  # a
    operators.message_received("a", 2.1)
    operators.disconnected("b", 2.1)
    operators.message_received("b", 2.2)
    assert operators.in_control == "a"


def test_control_outlasts_an_outage_of_all_operators() -> None:
    """The first to return must not get the streams of the one that drives."""
    operators = Operators(1.0)
    operators.connected("driver", 0.0)
    operators.connected("onlooker", 0.0)
    operators.expire_silent(3.0)
    assert (operators.present, operators.in_control) == (frozenset(), "")
    operators.message_received("onlooker", 5.0)
    assert operators.in_control == ""
    operators.message_received("driver", 5.3)
    assert operators.in_control == "driver"


def test_control_passes_when_only_its_holder_is_silent() -> None:
    operators = Operators(1.0)
    operators.connected("driver", 0.0)
    for quarter in range(1, 6):
        operators.connected("onlooker", quarter / 4)
    operators.expire_silent(1.26)
    assert operators.in_control == "onlooker"
    operators.message_received("driver", 1.3)
    assert operators.in_control == "onlooker"


def test_control_passes_when_its_holder_may_no_longer_have_it() -> None:
    """An operator whose keys were revoked may go on sending reports until the broker drops it."""
    revoked = set[str]()
    operators = Operators(1.0, lambda name: name not in revoked)
    operators.connected("driver", 0.0)
    operators.connected("other", 1.0)
    revoked.add("driver")
    operators.message_received("driver", 5.0)
    assert operators.in_control == "other"


def test_control_passes_after_an_outage_if_its_holder_does_not_return() -> None:
    operators = Operators(1.0)
    operators.connected("driver", 0.0)
    operators.connected("onlooker", 0.0)
    operators.expire_silent(3.0)
    operators.message_received("onlooker", 5.0)
    operators.message_received("onlooker", 5.9)
    assert operators.in_control == ""
    operators.expire_silent(5.0 + SILENT_S)
    assert operators.in_control == "onlooker"


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


def test_control_outlasts_a_broken_connection_but_not_a_sign_off() -> None:
    """The broker publishes the last will of a connection that a new one of the same operator replaces."""
    operators = Operators(1.0)
    operators.connected("driver", 0.0)
    operators.connected("onlooker", 0.0)
    operators.message_received("driver", 0.9)
    operators.disconnected("driver", 1.0, signed_off=False)
    operators.message_received("onlooker", 1.1)
    operators.connected("driver", 1.3)
    assert operators.in_control == "driver"
    operators.disconnected("driver", 1.4, signed_off=False)
    operators.message_received("onlooker", 1.4 + SILENT_S)
    assert operators.in_control == "onlooker"
    operators.connected("driver", 4.0)
    operators.disconnected("onlooker", 4.1)
    assert operators.in_control == "driver"


def test_events_of_the_vehicles_own_program_keep_nobody_out_of_control() -> None:
    operators = Operators(1.0)
    for t in range(50):
        operators.message_received("", t / 10)
    operators.connected("driver", 5.0)
    assert operators.in_control == "driver"
