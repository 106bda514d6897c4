"""Requests queued for the loop: order, fairness, bounds."""

from __future__ import annotations

import time
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from runner.vehicle import inbox as module
from runner.vehicle.inbox import MAX_PER_ROUND, MAX_QUEUED, MAX_SENDERS, MEASUREMENTS, Inbox, Request


def make_request(sender: str, event: str, **keys: Any) -> Request:
    return Request(sender, {"event": event, **keys})


def all_of(inbox: Inbox, rounds: int = 1) -> list[Request]:
    taken = []
    while request := inbox.get(time.monotonic() + (rounds - 1) * 2 * module.ROUND_S):
        taken.append(request)
    return taken


def test_senders_are_served_round_robin() -> None:
    inbox = Inbox()
    for number in range(3):
        inbox.put(make_request("a", "total_set", kbps=number))
    inbox.put(make_request("b", "total_set", kbps=9))
    assert [(r.sender, r.document["kbps"]) for r in all_of(inbox)] == [("a", 0), ("b", 9), ("a", 1), ("a", 2)]


def test_senders_with_queued_items_are_listed() -> None:
    inbox = Inbox()
    assert inbox.senders() == frozenset()
    for sender in ("a", "b", "a"):
        inbox.put(make_request(sender, "total_set", kbps=1))
    inbox.get(time.monotonic())
    assert inbox.senders() == {"a", "b"}


def test_a_measurement_supersedes_an_older_one_but_not_across_a_change_of_the_mode() -> None:
    inbox = Inbox()
    first = make_request("a", "bitrate_predicted", kbps=1)
    assert inbox.put(first) is None
    assert inbox.put(make_request("a", "total_set", kbps=5)) is None
    assert inbox.put(make_request("a", "steering_reported", rad=0.1)) is None
    assert inbox.put(make_request("a", "bitrate_predicted", kbps=2)) is first
    assert inbox.put(make_request("b", "bitrate_predicted", kbps=7)) is None
    assert inbox.put(make_request("b", "bitrate_predicted", kbps=7, uplink="x")) is None
    inbox.put(make_request("a", "mode_selected", mode="single"))
    assert inbox.put(make_request("a", "bitrate_predicted", kbps=3)) is None
    own = [r.document for r in all_of(inbox) if r.sender == "a"]
    assert [(d["event"], d.get("kbps")) for d in own] == [
        ("total_set", 5),
        ("steering_reported", None),
        ("bitrate_predicted", 2),
        ("mode_selected", None),
        ("bitrate_predicted", 3),
    ]


def test_excess_requests_are_refused_and_others_are_not_affected() -> None:
    inbox = Inbox()
    requests = [make_request("flood", "total_set", kbps=n) for n in range(MAX_QUEUED + 5)]
    assert [inbox.put(r) is r for r in requests] == [False] * MAX_QUEUED + [True] * 5
    assert inbox.put(make_request("a", "total_set", kbps=1)) is None
    for number in range(2 * MAX_SENDERS):
        inbox.put(make_request(f"stranger{number}", "total_set", kbps=1))
    assert len(all_of(inbox, rounds=2)) == MAX_QUEUED + MAX_SENDERS - 1


@given(st.lists(st.tuples(st.sampled_from("abc"), st.sampled_from([*MEASUREMENTS, "total_set", "mode_selected"]))))
def test_requests_are_never_merged_or_reordered(puts: list[tuple[str, str]]) -> None:
    inbox = Inbox()
    kept = [r for n, (sender, event) in enumerate(puts) if inbox.put(r := make_request(sender, event, n=n)) is not r]
    taken = all_of(inbox, rounds=2 if len(puts) > MAX_PER_ROUND else 1)
    for sender in "abc":
        numbers = [r.document["n"] for r in taken if r.sender == sender]
        assert numbers == sorted(numbers)
        wanted = [r.document["n"] for r in kept if r.sender == sender and r.measures is None]
        assert [r.document["n"] for r in taken if r.sender == sender and r.measures is None] == wanted


def test_a_flood_is_throttled_and_others_are_served_in_between(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "ROUND_S", 1.0)
    inbox = Inbox()
    for number in range(MAX_QUEUED):
        inbox.put(make_request("flood", "total_set", kbps=number))
    assert len(all_of(inbox)) == MAX_PER_ROUND
    inbox.put(make_request("a", "total_set", kbps=1))
    assert [request.sender for request in all_of(inbox)] == ["a"]
    assert len(all_of(inbox, rounds=2)) == MAX_QUEUED - MAX_PER_ROUND


def test_waking_ends_the_wait() -> None:
    inbox = Inbox()
    inbox.wake()
    assert inbox.get(time.monotonic() + 60) is None
