"""Whatever a page in control says that it shows, what is always sent arrives, and is live: seen on another page."""

from __future__ import annotations

import asyncio
import json
import os
import subprocess
import threading
from contextlib import contextmanager
from itertools import count

import pytest
from test_page_seen import WORDS, renderers, stopped, view

from browser import all_live, measure, opened, take_control, until, viewing
from rig import BROWSER, CHROMIUM_FLAGS, ROBOT_SIZES, answers, free_port, needs_browser, process
from runner.core.model import Roi
from runner.core.view import enclosing

pytestmark = [pytest.mark.gst, needs_browser]
aiohttp = pytest.importorskip("aiohttp")

SOON_S = float(os.environ.get("TOD_SOON_S", "25"))  # 2.5 on a machine that has nothing else to do
STAYS = 10  # looks in a row
FULL = {name: Roi(0, 0, *size) for name, size in ROBOT_SIZES.items()}
KEPT = {name: Roi(w // 4, h // 4, -(-w // 2), -(-h // 2)) for name, (w, h) in ROBOT_SIZES.items()}  # by default


@pytest.fixture(scope="module")
def url(tmp_path_factory):
    port = free_port()
    ports = (f"page.port={port}", f"media.port={free_port()}", f"control.port={free_port()}")
    words = (*(word for word in WORDS if not word.startswith("modes=")), "modes=seen", *ports)
    with process("demo", *words, "fps_max=10", stdout=subprocess.DEVNULL) as child:
        until(lambda: answers(port) or child.poll() is not None, seconds=300)
        yield f"http://127.0.0.1:{port}/"
        child.terminate()
        child.wait(timeout=15)


@pytest.fixture
def page(chromium, url):
    """It watches the pictures of all cameras; others are in control."""
    with opened(chromium, url, 1280, 720) as page:
        all_live(page)
        viewing(page, "configure")
        yield page


async def _speak(url, tab, ended):
    """A tab of a page in control, ten times a second, until it is ended."""
    async with (
        aiohttp.ClientSession() as session,
        session.ws_connect(f"{url}live?viewer=hostile", origin=url[:-1]) as ws,
    ):
        await ws.send_json({"take_control": True})
        for number in count():
            await ws.send_json({"attention": "watching", "focused": True})
            message = tab[number % len(tab)]
            await ws.send_str(message if isinstance(message, str) else json.dumps(message))
            await asyncio.sleep(0.1)
            if ended.is_set():
                return


@contextmanager
def spoken(url, tabs):
    ended = threading.Event()
    threads = [threading.Thread(target=lambda tab=tab: asyncio.run(_speak(url, tab, ended))) for tab in tabs]
    for thread in threads:
        thread.start()
    try:
        yield
    finally:
        ended.set()
        for thread in threads:
            thread.join(10)


def sent(page):
    """By camera, the region that its picture on the screen shows."""
    found = page.evaluate(f"Promise.all({json.dumps(list(ROBOT_SIZES))}.map((name) => tod.picture(name)))")
    return {name: Roi(**one["region"]) if one["region"] else FULL[name] for name, one in zip(FULL, found, strict=True)}


def is_shown(page, region):
    """Whether each camera is live and its picture shows a region."""
    shown, live = sent(page), measure(page)
    return all(live[name]["status"] == "live" for name in FULL) and all(
        enclosing(shown[name], region[name]) == shown[name] for name in FULL
    )


def misses(page):
    """What is always sent, of a camera whose picture does not show it now."""
    return {name: roi for name, roi in sent(page).items() if enclosing(roi, KEPT[name]) != roi}


NOTHING, DOT, CORNER = view(0, 0, 0, 0, 0, 0), view(0, 0, 1, 1, 1, 1), view(316, 176, 4, 4, 2, 2)
NAN = '{"view": {"front": {"x": NaN, "y": 0, "width": 9, "height": 9, "screen_width": 9, "screen_height": 9}}}'
OLD = {"layout": 1, "view": {"left": [0, 0, 100, 100], "front": {"x": 0, "y": 0, "width": 64, "height": 64}}}
HOSTILE = {  # by name: what each tab of a page states in turn, and what must be shown
    "empty": ([[{"view": {}}]], FULL),
    "nothing is shown": ([[NOTHING]], KEPT),
    "1x1": ([[DOT]], KEPT),
    "1x1, enlarged": ([[view(0, 0, 1, 1, 65535, 65535)]], KEPT),
    "NaN": ([[NAN]], FULL),
    "old layout": ([[OLD]], FULL),
    "alternating at 10 Hz": ([[DOT, CORNER]], KEPT),
    "right and wrong at 10 Hz": ([[NOTHING, NAN]], KEPT),
    "two tabs that disagree": ([[DOT], [CORNER]], KEPT),
    "two tabs, one wrong": ([[DOT], [NAN]], FULL),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_what_is_always_sent_arrives_with_every_hostile_view(page, url, case):
    tabs, expected = HOSTILE[case]
    with spoken(url, [[NOTHING]]):
        until(lambda: all(roi.pixels < FULL[name].pixels for name, roi in sent(page).items()))
    with spoken(url, tabs):
        until(lambda: is_shown(page, expected), seconds=SOON_S)
        for _ in range(STAYS):
            assert misses(page) == {}
        until(lambda: is_shown(page, expected), seconds=SOON_S)


def test_what_is_always_sent_arrives_while_the_page_in_control_is_stopped(chromium, page, url):
    others = renderers()
    second = chromium.browser_type.launch(executable_path=BROWSER, args=CHROMIUM_FLAGS)
    try:
        with opened(second, url, 1280, 720) as driver:
            all_live(driver)
            take_control(driver)
            viewing(driver, "configure")
            driver.locator('.tile[data-camera="rear"] .picture').dblclick()  # the others are hidden
            until(lambda: sent(page)["front"].pixels < FULL["front"].pixels)
            with stopped(others):
                until(lambda: is_shown(page, FULL), seconds=SOON_S)
                assert misses(page) == {}
    finally:
        second.close()
