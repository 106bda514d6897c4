"""Copies of messages that come by several connections, and what one of these held and then delivers."""

from __future__ import annotations

import tracemalloc

from runner.mqtt.copies import FirstCopies, Newest
from runner.mqtt.messages import MqttMessage

REQUEST = MqttMessage("tod/q7/request/alice", b'{"id": "1", "event": "total_set", "kbps": 900}', False)
WILL = MqttMessage("tod/q7/request/alice", b'{"id": "will 7", "event": "operator_disconnected"}', False)


def test_the_first_copy_counts_by_whichever_connection_it_comes() -> None:
    copies = FirstCopies()
    other = REQUEST._replace(topic="tod/q7/request/bob")
    assert copies.is_first("b", REQUEST, 0.0)
    assert not copies.is_first("a", REQUEST, 0.5)
    assert not copies.is_first("c", REQUEST, 59.0)
    assert copies.is_first("a", other, 59.0)


def test_what_its_sender_repeats_is_new() -> None:
    """The last will of a process whose connection breaks twice; the second time, one connection is behind."""
    copies = FirstCopies()
    came = [("a", 0.0), ("b", 0.2), ("a", 9.0), ("a", 20.0), ("b", 20.1), ("b", 20.2), ("b", 30.0)]
    assert [copies.is_first(by, WILL, at) for by, at in came] == [True, False, True, True, False, False, True]


def test_a_repeated_message_is_known_from_when_it_last_came() -> None:
    copies = FirstCopies()
    assert copies.is_first("a", WILL, 0.0)
    assert copies.is_first("a", WILL, 59.9)
    assert [copies.is_first("b", WILL, 60.1) for _ in range(2)] == [False, False]
    assert [copies.is_first(by, WILL, 121.0) for by in "ba"] == [True, False]


def test_a_flood_is_not_kept() -> None:
    copies, long = FirstCopies(), bytes(10_000)
    tracemalloc.start()
    for number in range(12_000):
        copies.is_first("a", REQUEST._replace(payload=b"%d%s" % (number, long)), 0.0)
    held, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert held < 8e6
    assert not copies.is_first("b", REQUEST._replace(payload=b"11999%s" % long), 0.0)


def test_older_messages_of_a_vehicle_are_ignored_while_it_is_heard() -> None:
    newest = Newest()
    came = [("state", 5.0, 10.0), ("telemetry", 5.1, 10.1), ("telemetry", 5.1, 10.2), ("telemetry", 5.5, 10.5)]
    assert [newest.takes(*each) for each in came] == [True, True, False, True]
    assert not newest.takes("state", 5.0, 11.1)  # resent once its uplink was back
    assert newest.takes("state", 5.6, 11.1)


def test_a_vehicle_that_was_restarted_is_heard_once_the_old_one_was_silent() -> None:
    newest = Newest()
    assert newest.takes("state", 500.0, 10.0)
    assert newest.takes("telemetry", 500.1, 10.0)
    assert [newest.takes("telemetry", 0.2 * n, 10.2 + 0.2 * n) for n in range(4)] == [False, False, False, True]
    assert newest.takes("state", 0.7, 11.0)
