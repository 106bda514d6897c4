"""Who may watch a camera over the uplink."""

from __future__ import annotations

import pytest

from runner.gst.viewers import (
    STATED_S,
    RefusedViewers,
    StreamViewer,
    admit,
    limit_words,
    operator_of,
    over_uplink,
    too_many,
    user_agent,
)

LOCAL, ANNA, BERT, ANYONE = (
    StreamViewer("127.0.0.1"),
    StreamViewer("192.0.2.7", "anna"),
    StreamViewer("192.0.2.8", "bert"),
    StreamViewer("192.0.2.9"),
)


@pytest.mark.parametrize(
    ("address", "leaves"),
    [
        ("127.0.0.1", False),
        ("127.8.8.8", False),
        ("::1", False),
        ("::ffff:127.0.0.1", False),
        ("192.0.2.7", True),
        ("::ffff:192.0.2.7", True),
        ("fe80::1%eth0", True),
    ],
)
def test_only_loopback_costs_no_uplink(address, leaves):
    assert over_uplink(address) is leaves


@pytest.mark.parametrize(
    ("viewers", "newcomer", "limit", "drivers", "leaving"),
    [
        ([], ANYONE, 1, (), []),
        ([ANYONE], LOCAL, 1, (), []),
        ([LOCAL, LOCAL], ANYONE, 1, (), []),
        ([ANYONE], BERT, 1, (), None),
        ([ANYONE], ANYONE, 2, (), []),
        ([ANYONE, BERT], ANYONE, 2, (), None),
        ([ANYONE], BERT, 1, ("anna",), None),
        ([BERT], ANNA, 1, ("anna",), [BERT]),
        ([ANYONE, BERT], ANNA, 2, ("anna",), [BERT]),  # the newest
        ([ANNA], BERT, 1, ("anna",), None),
        ([ANNA, BERT], ANNA, 2, ("anna",), [BERT]),
        ([ANNA], ANNA, 1, ("anna",), [ANNA]),  # whose address changed
        (
            [ANYONE],
            StreamViewer("192.0.2.9"),
            1,
            (),
            None,
        ),  # without a controller, an anonymous viewer is not taken for it
        ([LOCAL, ANYONE], ANNA, 1, ("anna",), [ANYONE]),
        ([ANNA], BERT, 1, ("anna", "bert"), []),  # control is offered to him
        ([ANNA, ANYONE], BERT, 2, ("anna", "bert"), [ANYONE]),
        ([ANNA, ANYONE], BERT, 3, ("anna", "bert"), []),
        ([ANNA, BERT], BERT, 1, ("anna", "bert"), [BERT]),  # whose address changed
        ([ANNA], ANYONE, 1, ("anna", "bert"), None),
        ([ANYONE, ANYONE._replace(since=1)], ANNA, 2, ("anna",), [ANYONE._replace(since=1)]),
    ],
)
def test_which_viewers_are_admitted_and_which_are_disconnected(viewers, newcomer, limit, drivers, leaving):
    assert admit(viewers, newcomer, limit, drivers) == leaving


@pytest.mark.parametrize(
    ("viewers", "limit", "drivers", "leaving"),
    [
        ([ANNA, BERT], 1, ("anna", "bert"), []),
        ([ANNA, BERT], 1, ("bert",), [ANNA]),  # he has accepted control
        ([ANNA, BERT], 1, ("anna",), [BERT]),  # he has declined it
        ([ANNA, BERT], 2, ("anna",), []),
        ([ANNA, LOCAL], 1, ("bert",), []),
        ([ANYONE, ANNA, BERT], 2, ("bert",), [ANNA]),
    ],
)
def test_who_leaves_once_control_has_passed(viewers, limit, drivers, leaving):
    assert too_many(viewers, limit, drivers) == leaving


@pytest.mark.parametrize(
    ("agent", "operator"),
    [(user_agent("anna"), "anna"), ("ffmpeg/5.1", ""), (None, ""), ("", ""), (user_agent(""), "")],
)
def test_an_operator_is_known_by_its_user_agent(agent, operator):
    assert operator_of(agent) == operator


def test_a_refusal_names_the_key_and_who_watches():
    assert limit_words(1, [LOCAL, ANNA]) == "one viewer per camera: media.max_viewers; anna watches"
    assert limit_words(2, [BERT, ANNA]) == "2 viewers per camera: media.max_viewers; anna and bert watch"
    assert limit_words(1, [ANYONE]) == "one viewer per camera: media.max_viewers"


def test_a_refusal_is_stated_until_the_viewer_is_admitted_or_asks_no_more():
    refused = RefusedViewers()
    assert refused.add("front", BERT, "full", 0)
    assert not refused.add("front", BERT, "full", 30)  # is known
    assert refused.add("front", ANYONE, "full", 30)  # states no operator: it is reported, but asks for nothing
    assert refused.stated(30 + STATED_S - 1) == {"front": {"bert": "full"}}
    assert refused.stated(30 + STATED_S) == {}
    refused.add("front", BERT, "full", 100)
    refused.remove("front", BERT)
    assert refused.stated(100) == {}


def test_refused_viewers_with_ever_new_names_use_bounded_memory():
    refused = RefusedViewers()
    for number in range(1000):
        refused.add("front", StreamViewer("192.0.2.7", f"name{number}"), "full", 0)
    stated = refused.stated(0)["front"]
    assert len(stated) == 50
    assert "name999" in stated
