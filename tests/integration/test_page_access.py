"""The page for other people's eyes and hands: screen readers, the keyboard alone, the browser's zoom."""

from __future__ import annotations

import time
from dataclasses import replace
from itertools import combinations

import pytest
from test_page_layouts import EVERY_S, FITS, OWNERS, controlling, picture, served, wide  # noqa: F401

from browser import all_live, barriers, boxes, needs_axe, opened, overlap, shot, until, viewing
from rig import needs_browser
from runner.configuration.layout import Layouts
from runner.core.model import Mode

pytestmark = [pytest.mark.gst, needs_browser]


@pytest.fixture
def sides(chromium, picture, tmp_path):  # noqa: F811
    """The page of the operator in control, with what serves it."""
    with (
        served(picture, Layouts(tmp_path)) as (server, station),
        opened(chromium, server.url, 1366, 768) as page,
    ):
        all_live(page)
        controlling(page)
        page.click("#offer-no")
        yield page, server, station


@pytest.fixture
def page(sides):
    return sides[0]


@needs_axe
def test_no_view_has_a_serious_barrier(page):
    found = []

    def look(view):
        for theme in ("day", "night"):
            page.evaluate("theme => (document.documentElement.dataset.theme = theme)", theme)
            found.extend(f"{view}, {theme}: {each}" for each in barriers(page))

    for tab in ("camera", "latency", "charts", "map", "news"):
        page.click(f"#tab-{tab}")
        look(f"Configure, {tab}")
    page.click("#edit-layout")
    look("editing the layout")
    page.keyboard.press("Escape")
    for key, what in (("?", "help"), ("w", "monitors")):
        page.keyboard.press(key)
        page.wait_for_selector("dialog[open]")
        look(what)
        page.keyboard.press("Escape")
    viewing(page, "drive")
    look("Drive")
    page.keyboard.press("d")
    look("drawer")
    page.goto(page.url.partition("?")[0] + "static/login.html")
    look("login")
    assert sorted(set(found)) == []


# Controls that are shown and can be used, in the order of the document, by the part of the page that they are in; a
# group with one stop, within which arrow keys move, is one control.
CONTROLS = """() => {
  const parts = ["header", "messages", "tiles", "drive", "below", "side"];
  const partOf = (each) => parts.find((part) => each.closest(`#${part}`)) ?? "elsewhere";
  const root = document.querySelector("dialog[open]") ?? document.body;
  const all = [...root.querySelectorAll("a[href], button, input, select, summary, [tabindex]")];
  const isUsable = (each) => each.checkVisibility({ visibilityProperty: true }) && !each.disabled && each !== root;
  const stopOf = (each) => each.closest("[role=radiogroup], [role=tablist]") ?? each;
  globalThis.nameOf = (each) => {
    const stop = stopOf(each);
    return `${partOf(stop)}: ${stop.id || stop.getAttribute("aria-label") || stop.textContent.trim()}`;
  };
  return [...new Set(all.filter(isUsable).map(nameOf))];
}"""
FOCUSED = "() => document.activeElement === document.body ? null : nameOf(document.activeElement)"
FROM_THE_TOP = """() => {
  document.body.tabIndex = -1;
  document.body.focus();
  document.body.removeAttribute("tabindex");
}"""


def stops(page):
    """What Tab reaches from the top of the page, in this order, and all controls; messages come and go."""
    page.evaluate(CONTROLS)
    page.evaluate(FROM_THE_TOP)
    found = []
    while True:
        page.keyboard.press("Tab")
        name = page.evaluate(FOCUSED)
        if name is None or name in found:
            break
        found.append(name)
    controls = page.evaluate(CONTROLS)  # the panel is that of the camera with the focus
    return tuple([name for name in names if not name.startswith("messages: ")] for names in (found, controls))


def are_in_order(reached, *parts):
    """Whether Tab passes these parts of the page, in this order."""
    return list(dict.fromkeys(name.partition(":")[0] for name in reached)) == list(parts)


def test_the_keyboard_alone_reaches_every_control_in_a_stated_order(sides):
    page, server, station = sides
    page.click("#tab-camera")
    until(page.locator("#sound-configure").is_hidden)  # the browser lets sound play from a click on, but not at once
    for mode in (Mode.SINGLE, Mode.COLLECTIVE, Mode.AUTOMATIC):
        server.on_state(replace(station.state, mode=mode))
        page.wait_for_selector(f"#mode-{mode}[aria-checked=true]")
        for tab in ("camera", "charts", "news"):
            page.click(f"#tab-{tab}")
            reached, controls = stops(page)
            assert reached == controls, (mode, tab)
            assert are_in_order(reached, "header", "tiles", "below", "side"), reached
    page.click("#tab-camera")
    page.locator("#tab-camera").focus()  # a click leaves it to the keys of the cameras
    for tab in ("latency", "charts", "map", "news"):
        page.keyboard.press("ArrowRight")
        assert page.get_attribute(f"#tab-{tab}", "aria-selected") == "true"
    viewing(page, "drive")
    reached, controls = stops(page)
    assert reached == controls and are_in_order(reached, "tiles", "drive"), reached
    page.keyboard.press("d")
    reached, controls = stops(page)
    assert reached == controls and are_in_order(reached, "header", "tiles", "drive", "side"), reached
    page.keyboard.press("?")
    page.wait_for_selector("dialog[open]")
    page.keyboard.press("Tab")
    assert page.evaluate("document.activeElement.closest('body > :not(dialog[open])')") is None, "behind an open dialog"


# By percent, a window of 1920x1080 px at that zoom of the browser, in its CSS px.
ZOOMED = {percent: (192000 // percent, 108000 // percent) for percent in (80, 90, 110, 125, 150, 175, 200)}
SMALL = (1000, 680)  # CSS px; below either, Configure scrolls


@pytest.mark.soak
def test_all_sizes_follow_the_zoom_of_the_browser(chromium, picture):  # noqa: F811
    with served(picture, None, vehicle=OWNERS["paper"]) as (server, station):
        server.sample = wide(station.state.cameras)
        for percent, (width, height) in ZOOMED.items():
            with opened(chromium, server.url, width, height, device_scale_factor=percent / 100) as page:
                until(lambda page=page: page.evaluate("window.tod?.control") is not None)
                all_live(page)
                for view in ("configure", "drive"):
                    viewing(page, view)
                    time.sleep(EVERY_S)  # for the picture of the screen
                    shot(page, f"zoom-{percent}-{view}")
                    pictures, wrong = boxes(page)
                    assert [pair for pair in combinations(pictures.values(), 2) if overlap(*pair)] == [], (
                        view,
                        percent,
                    )
                    assert page.evaluate("document.scrollingElement.scrollWidth <= innerWidth + 1"), (view, percent)
                    if view == "configure" and (width < SMALL[0] or height < SMALL[1]):
                        wrong = {**wrong, "outside": [], "scrolls": False}
                    assert wrong == FITS, (view, percent)
