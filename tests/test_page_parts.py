"""What the page's server is made of: queues of a viewer, control, history."""

from __future__ import annotations

import json
import math

import pytest

from runner.units import AccessUnit

pytest.importorskip("aiohttp")
from runner.page.control import KEPT_S, Control
from runner.page.history import KEPT, History
from runner.page.viewer import CATCH_UP, HEADER, KEY, RESTART, WAITING_UNITS, Viewer


def unit(number, key=False, captured=None):
    return AccessUnit(bytes([number]), captured, number / 10, key)


def sent(viewer):
    """Everything that waits: texts as their kind, units as (camera, flags, number)."""
    messages = []
    while (message := viewer.pop()) is not None:
        if isinstance(message, str):
            messages.append(json.loads(message)["kind"])
        else:
            camera, flags, _, _, _, _ = HEADER.unpack_from(message)
            messages.append((camera, flags, message[HEADER.size]))
    return messages


def test_a_viewer_begins_with_a_burst_of_which_only_the_last_is_drawn():
    viewer = Viewer("me", 1, lambda camera: [unit(0, key=True), unit(7), unit(8)])
    viewer.show(0, unit(8))  # part of the burst already
    assert sent(viewer) == [(0, KEY | RESTART | CATCH_UP, 0), (0, CATCH_UP, 7), (0, 0, 8)]
    viewer.show(0, unit(9))
    viewer.show(0, unit(10, key=True))
    assert sent(viewer) == [(0, 0, 9), (0, KEY, 10)]


def test_a_burst_of_one_is_drawn_and_none_is_waited_for():
    come = []
    viewer = Viewer("me", 1, lambda camera: come)
    assert sent(viewer) == []
    come.append(unit(0, key=True))
    assert sent(viewer) == [(0, KEY | RESTART, 0)]


def test_texts_go_first_and_cameras_take_turns():
    viewer = Viewer("me", 2, lambda camera: [unit(0, key=True), unit(1)])
    viewer.tell("state", {})
    assert [m if isinstance(m, str) else m[0] for m in sent(viewer)] == ["state", 0, 1, 0, 1]


def test_a_viewer_that_lags_starts_again_and_never_holds_more_than_it_may():
    newest = []
    viewer = Viewer("me", 1, lambda camera: [unit(0, key=True), *newest])
    sent(viewer)
    for number in range(1, 201):
        newest[:] = [unit(number)]
        viewer.show(0, newest[0])
        assert len(viewer._cameras[0].live) <= WAITING_UNITS
    assert sent(viewer) == [(0, KEY | RESTART | CATCH_UP, 0), (0, 0, 200)]


def test_texts_are_bounded_too():
    viewer = Viewer("me", 0, lambda camera: [])
    for _ in range(10_000):
        viewer.tell("sample", {})
    assert len(sent(viewer)) == 500


def test_the_header_states_times_in_ms_and_an_unknown_capture_as_nan():
    viewer = Viewer("me", 1, lambda camera: [unit(5, key=True, captured=0.25)])
    assert HEADER.unpack_from(viewer.pop()) == (0, KEY | RESTART, 0, 1, 250.0, 500.0)
    viewer = Viewer("me", 1, lambda camera: [unit(5, key=True)])
    assert math.isnan(HEADER.unpack_from(viewer.pop())[4])


def test_control_belongs_to_one_page():
    control = Control()
    control.opened("a", 0)
    control.opened("b", 1)
    assert [control.seen_by(page) for page in "ab"] == ["you", "another"]
    control.take("b")
    assert [control.seen_by(page) for page in "ab"] == ["another", "you"]
    control.release("a")  # not its to give
    assert control.seen_by("b") == "you"
    control.release("b")
    assert [control.seen_by(page) for page in "ab"] == ["nobody", "nobody"]


def test_a_reload_keeps_control_and_a_page_that_left_loses_it():
    control = Control()
    control.opened("a", 0)
    control.closed("a", 1)
    control.opened("b", 1 + KEPT_S / 2)
    assert control.seen_by("b") == "nobody"
    control.opened("a", 1 + KEPT_S)
    assert control.seen_by("a") == "you"
    control.closed("a", 10)
    control.opened("c", 11 + KEPT_S)
    assert control.seen_by("c") == "you"
    control.opened("a", 12 + KEPT_S)
    assert control.seen_by("a") == "another"


def sample(time, **more):
    camera = {"kbps": time, "allocated_kbps": 1, "scaling": None}
    totals = {"predicted_kbps": None, "allocated_kbps": 1, "actual_kbps": time, "position": None}
    return {"time": time, **totals, "cameras": {"front": camera}, **more}


def test_history_keeps_a_point_a_second_for_minutes():
    history = History()
    assert history.columns()["time"] == []
    for quarter in range(4 * (KEPT + 50)):
        history.add(sample(quarter / 4))
    columns = history.columns()
    assert len(columns["time"]) == KEPT
    assert columns["time"][-2:] == [KEPT + 48, KEPT + 49]
    assert columns["cameras"]["front"]["kbps"] == columns["time"]


def test_history_has_a_place_for_what_was_not_known():
    history = History()
    history.add(sample(0))
    history.add(sample(1, position={"lat": 48.1, "lon": 11.6}))
    assert history.columns()["lat"] == [None, 48.1]
    assert history.columns()["cameras"]["front"]["scaling"] == [None, None]
