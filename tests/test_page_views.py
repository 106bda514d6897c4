"""What windows and programs state that they show of each camera: what holds, for how long, and when it is reported."""

from __future__ import annotations

import json
from math import inf, nan
from types import SimpleNamespace
from typing import Any

import pytest
from helpers import vehicle
from msgspec import UNSET

from runner.core.events import Attention
from runner.core.view import NOWHERE, Seen, View
from runner.operator.seen import AGAIN_S, StatedView
from runner.page.viewer import PageViewer
from runner.page.views import KEYS, VALID_S, PageViews
from runner.page.windows import Windows

CAMERAS = list(vehicle("vehicle=delivery_robot").cameras.values())[:2]
FRONT, REAR = (camera.name for camera in CAMERAS)
WIDTH, HEIGHT = CAMERAS[0].width, CAMERAS[0].height
LEFT = Seen(0, 0, 100, 80, 50, 40)
RIGHT = Seen(300, 100, 100, 80, 200, 160)


def json_of(*numbers: Any) -> dict[str, Any]:
    return dict(zip(KEYS, numbers, strict=True))


def stated(seen: Seen) -> dict[str, Any]:
    return json_of(*(getattr(seen, key) for key in KEYS))


class Page:
    """A page in control that somebody watches, its monitors, and what they state to see together."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.seen = StatedView()
        self.windows = Windows(lambda attention: None, lambda shown, is_open: None)
        self.views = PageViews(CAMERAS, self.windows, self.seen)
        self.t = 0.0
        monkeypatch.setattr("runner.page.views.time", SimpleNamespace(monotonic=lambda: self.t))
        self.page = self.open(0, 1)
        self.page.attention = Attention.WATCHING

    def open(self, *cameras: int, monitor: bool = False) -> PageViewer:
        window = PageViewer("monitor" if monitor else "page", cameras, lambda camera: [], "browser", monitor)
        self.windows.add(window)
        self.windows.opened(window, None)
        return window

    def close(self, window: PageViewer) -> None:
        self.views.forget(window)
        self.windows.closed(window)

    @property
    def view(self) -> View:
        self.views.state()
        return self.seen.view


@pytest.fixture
def page(monkeypatch: pytest.MonkeyPatch) -> Page:
    return Page(monkeypatch)


def test_cameras_that_no_window_has_are_not_seen_and_those_that_one_does_not_name_are_seen_in_full(page: Page) -> None:
    assert page.view == {}
    page.views.take(page.page, {"view": {FRONT: stated(LEFT)}})
    assert page.view == {FRONT: LEFT}
    monitor = page.open(1, monitor=True)
    page.views.take(monitor, {"view": {REAR: stated(RIGHT)}})
    assert page.view == {FRONT: LEFT}
    page.views.take(page.page, {"view": {FRONT: stated(LEFT), REAR: stated(NOWHERE)}})
    assert page.view == {FRONT: LEFT, REAR: RIGHT}
    page.views.take(monitor, {"view": {}})
    assert page.view == {FRONT: LEFT}


def test_windows_of_a_page_are_united_and_each_expires_for_itself(page: Page) -> None:
    monitor = page.open(0, monitor=True)
    page.views.take(page.page, {"view": {FRONT: stated(LEFT), REAR: stated(NOWHERE)}})
    page.t = 1.0
    page.views.take(monitor, {"view": {FRONT: stated(RIGHT)}})
    page.t = VALID_S - 0.01
    both = Seen(0, 0, 400, 180, 800, 360)
    assert page.view == {FRONT: both, REAR: NOWHERE}
    page.t = VALID_S
    assert page.view == {}
    page.views.take(page.page, {"view": {FRONT: stated(LEFT), REAR: stated(NOWHERE)}})
    page.t = 1.0 + VALID_S
    assert page.view == {REAR: NOWHERE}  # the monitor, which has expired, has no other camera
    page.close(monitor)
    assert page.view == {FRONT: LEFT, REAR: NOWHERE}


@pytest.mark.parametrize("attention", [each for each in (*Attention, None) if each is not Attention.WATCHING])
def test_while_nobody_watches_everything_counts_as_seen(page: Page, attention: Attention | None) -> None:
    page.views.take(page.page, {"view": {FRONT: stated(LEFT)}})
    page.page.attention = attention
    assert page.view == {}
    page.page.attention = Attention.WATCHING
    assert page.view == {FRONT: LEFT}


NUMBERS = f"must have {', '.join(KEYS)}, and no other key"
INTEGER = "must be an integer from 0 to 65535"
OUTSIDE = f"must lie inside the image of {WIDTH}x{HEIGHT} px"
HOSTILE = [
    (None, "view: must be an object, by camera, and the only key"),
    ([], "view: must be an object, by camera, and the only key"),
    ({"old": json_of(*[0] * 6)}, "view: 'old': this window shows no such camera"),
    ({REAR: json_of(*[0] * 6)}, f"view: {REAR!r}: this window shows no such camera"),
    ({FRONT: None}, f"view: {FRONT}: {NUMBERS}"),
    ({FRONT: {"x": 0}}, f"view: {FRONT}: {NUMBERS}"),
    ({FRONT: json_of(*[0] * 6) | {"zoom": 1}}, f"view: {FRONT}: {NUMBERS}"),
    ({FRONT: json_of(nan, 0, 1, 1, 1, 1)}, f"view: {FRONT}: x: {INTEGER}"),
    ({FRONT: json_of(0, inf, 1, 1, 1, 1)}, f"view: {FRONT}: y: {INTEGER}"),
    ({FRONT: json_of(0, 0, -1, 1, 1, 1)}, f"view: {FRONT}: width: {INTEGER}"),
    ({FRONT: json_of(0, 0, True, 1, 1, 1)}, f"view: {FRONT}: width: {INTEGER}"),
    ({FRONT: json_of(0, 0, 1, "1", 1, 1)}, f"view: {FRONT}: height: {INTEGER}"),
    ({FRONT: json_of(0, 0, 1, 1, 65536, 1)}, f"view: {FRONT}: screen_width: {INTEGER}"),
    ({FRONT: json_of(0, 0, WIDTH + 1, 1, 1, 1)}, f"view: {FRONT}: {OUTSIDE}"),
    ({FRONT: json_of(0, HEIGHT - 60, 1, 61, 1, 1)}, f"view: {FRONT}: {OUTSIDE}"),
    (
        {FRONT: json_of(0, 0, 1, 1, 0, 0)},
        f"view: {FRONT}: width, height and both sides on the screen: all or none must be 0",
    ),
]


@pytest.mark.parametrize(("view", "problem"), HOSTILE)
def test_a_window_whose_statement_is_refused_sees_everything(page: Page, view: Any, problem: str) -> None:
    monitor = page.open(0, monitor=True)
    page.views.take(page.page, {"view": {FRONT: stated(LEFT), REAR: stated(NOWHERE)}})
    page.views.take(monitor, {"view": {FRONT: stated(LEFT)}})
    assert page.view == {FRONT: LEFT, REAR: NOWHERE}
    page.views.take(monitor, {"view": view})
    assert page.view == {REAR: NOWHERE}
    assert problem in json.dumps(
        [json.loads(str(text))["reason"] for text in popped(monitor) if "refused" in str(text)]
    )


def popped(window: PageViewer) -> list[str | bytes]:
    return list(iter(window.pop, None))


def test_a_statement_with_another_key_is_refused(page: Page) -> None:
    page.views.take(page.page, {"view": {FRONT: stated(LEFT)}, "event": "x"})
    assert page.view == {}


def test_the_smallest_region_is_no_problem(page: Page) -> None:
    page.views.take(page.page, {"view": {FRONT: json_of(WIDTH - 1, HEIGHT - 1, 1, 1, 1, 1)}})
    assert page.view == {FRONT: Seen(WIDTH - 1, HEIGHT - 1, 1, 1, 1, 1)}


def test_what_is_stated_is_reported_on_change_and_again_while_unchanged() -> None:
    seen = StatedView()
    assert seen.report(0) is UNSET  # as before anybody states anything
    seen.state({FRONT: LEFT})
    assert seen.report(0) == {FRONT: LEFT}
    assert [seen.report(t) for t in (0.04, AGAIN_S - 0.01)] == [UNSET, UNSET]
    assert seen.report(AGAIN_S) == {FRONT: LEFT}
    seen.state({FRONT: RIGHT})
    assert seen.report(AGAIN_S + 0.04) == {FRONT: RIGHT}
    seen.state(None)
    assert seen.report(AGAIN_S + 0.08) == {}  # at once: a view that widens must not wait until the last one expires
    assert seen.report(9) is UNSET


def test_whoever_reports_is_woken_once_something_else_is_stated_than_was_reported() -> None:
    seen, woken = StatedView(), list[int]()
    seen.on_change = lambda: woken.append(1)
    seen.state(None)
    assert not woken
    seen.state({FRONT: LEFT})
    assert len(woken) == 1
    seen.report(0)
    seen.state({FRONT: LEFT})
    assert len(woken) == 1  # the page repeats what is unchanged
    seen.state({FRONT: RIGHT})
    assert len(woken) == 2


def test_a_statement_holds_as_long_as_it_says() -> None:
    seen = StatedView()
    seen.state({FRONT: LEFT}, 60)
    assert seen.view == {FRONT: LEFT}
    seen.state({FRONT: LEFT}, 0)
    assert seen.view == {}
