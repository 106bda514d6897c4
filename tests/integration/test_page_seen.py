"""What the page says is seen, in a real browser, as a real vehicle notices and logs it."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import subprocess
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import pytest

from browser import all_live, opened, sized, take_control, until, viewing
from rig import ROBOT_SIZES, SMALL_ROBOT, answers, free_port, needs_browser, process
from runner.core.view import NOWHERE, Seen

pytestmark = [pytest.mark.gst, needs_browser]
aiohttp = pytest.importorskip("aiohttp")

WORDS = (
    *SMALL_ROBOT,
    "source=test",
    "fps_max=5",
    "modes=open_loop",
    "pqos=constant",
    "pqos.kbps=2000",
    "duration_s=1200",
    "cameras.rear.framing=fill",
)


class View(dict):
    """By camera, what is seen; of one that is not named, more than any screen shows: a busy page states nothing."""

    def __missing__(self, name):
        return Seen(0, 0, *[2**16 - 1] * 4)


class Log:
    """The drive log of the vehicle."""

    def __init__(self, directory):
        self._directory = directory

    @property
    def views(self):
        """Each view that the vehicle has noticed."""
        (file,) = self._directory.glob("vehicle*/drive.jsonl") if not (own := self._own()) else [own]
        found = [json.loads(line) for line in file.read_text().splitlines() if '"view_reported"' in line]
        return [View({name: Seen(**seen) for name, seen in line["view"].items()}) for line in found]

    def _own(self):
        return next((path for path in self._directory.rglob("*.jsonl") if '"view_reported"' in path.read_text()), None)

    @property
    def view(self):
        """The last one; empty: everything is seen in full."""
        return self.views[-1] if self._own() else View()


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    """Address of the page of a robot with three cameras, and the vehicle's log."""
    port, place = free_port(), tmp_path_factory.mktemp("seen")
    ports = (f"page.port={port}", f"media.port={free_port()}", f"control.port={free_port()}")
    with process("demo", *WORDS, *ports, f"log={place / 'drive'}", stdout=subprocess.DEVNULL) as child:
        until(lambda: answers(port) or child.poll() is not None, seconds=300)
        yield f"http://127.0.0.1:{port}/", Log(place)
        child.terminate()
        child.wait(timeout=15)


@pytest.fixture
def page(chromium, demo):
    with opened(chromium, demo[0], 1280, 720) as page:
        all_live(page)
        if page.evaluate("tod.control") != "you":
            take_control(page)
        yield page


def tile(page, name):
    """Size of a picture's box, and how the picture is placed in it."""
    return page.evaluate(
        """name => {
          const box = document.querySelector(`.tile[data-camera="${name}"] .picture`);
          if (getComputedStyle(box).visibility === "hidden") return [0, 0, ""];
          const { objectFit } = box.querySelector("canvas").style;
          return [box.clientWidth, box.clientHeight, objectFit];
        }""",
        name,
    )


def expected(page, name):
    """What a tile shows of a test picture, computed from its box."""
    (wide, high, fit), (width, height) = tile(page, name), ROBOT_SIZES[name]
    if not wide or not high:
        return (0, 0, 0, 0)
    scale = max(wide / width, high / height) if fit == "cover" else min(wide / width, high / height)
    return (min(width, wide / scale), min(height, high / scale), min(wide, width * scale), min(high, height * scale))


def shows(page, log):
    """The vehicle notices what the tiles show now, centred in the images."""
    view = log.view
    if set(view) != set(ROBOT_SIZES):
        return False
    for name, seen in view.items():
        found = (seen.width, seen.height, seen.screen_width, seen.screen_height)
        if any(abs(a - b) > 3 for a, b in zip(found, expected(page, name), strict=True)):
            return False
        width, height = ROBOT_SIZES[name]
        if seen != NOWHERE and max(abs(2 * seen.x + seen.width - width), abs(2 * seen.y + seen.height - height)) > 2:
            return False
    return True


def test_the_vehicle_notices_what_each_view_of_the_page_shows(page, demo):
    _, log = demo
    viewing(page, "configure")
    until(lambda: shows(page, log))
    wide = log.view["front"].screen_width
    viewing(page, "drive")
    until(lambda: shows(page, log) and log.view["front"].screen_width > wide)
    large = log.view["front"].screen_width
    sized(page, 900, 600)
    until(lambda: shows(page, log) and log.view["front"].screen_width < large)
    style = page.add_style_tag(content='.tile[data-camera="rear"] .picture { width: 90px }')  # it fills a narrow box
    until(lambda: shows(page, log) and log.view["rear"].x > 0 and log.view["rear"].height == ROBOT_SIZES["rear"][1])
    style.evaluate("element => element.remove()")
    page.locator("body").press("e")  # bird's-eye view beside the front camera, of the mast's camera
    until(lambda: log.view.get("mast") not in (None, NOWHERE) and page.evaluate("tod.birdseye()")["on"])
    until(lambda: (mast := log.view["mast"]).y > 0 and mast.width > 100 and mast.screen_width > 10)
    sized(page, 1280, 720)
    viewing(page, "configure")
    page.locator('.tile[data-camera="rear"] .picture').dblclick()  # the others are hidden
    until(lambda: shows(page, log) and log.view["front"] == log.view["mast"] == NOWHERE != log.view["rear"])


def test_while_the_driver_cannot_see_the_page_everything_counts_as_seen(page, demo):
    _, log = demo
    until(lambda: shows(page, log))
    page.evaluate("dispatchEvent(new Event('blur'))")
    until(lambda: log.view == {})
    page.evaluate("dispatchEvent(new Event('focus'))")
    until(lambda: shows(page, log))
    page.evaluate("Object.defineProperty(document, 'hidden', { value: true, configurable: true })")
    page.evaluate("document.dispatchEvent(new Event('visibilitychange'))")
    until(lambda: log.view == {})
    page.evaluate("delete document.hidden")
    page.evaluate("document.dispatchEvent(new Event('visibilitychange'))")
    until(lambda: shows(page, log))


def test_a_monitor_is_united_with_its_page(page, demo):
    url, log = demo
    viewing(page, "configure")
    page.locator('.tile[data-camera="rear"] .picture').dblclick()
    until(lambda: shows(page, log) and log.view["front"] == NOWHERE)
    monitor = page.context.new_page()
    monitor.set_viewport_size({"width": 640, "height": 400})
    monitor.goto(f"{url}?show=front")
    until(lambda: (log.view["front"].x, log.view["front"].width) == (0, 320) and log.view["mast"] == NOWHERE)
    monitor.close()
    page.bring_to_front()
    until(lambda: shows(page, log) and log.view["front"] == NOWHERE)


def renderers():
    """Processes of the browsers' pages."""
    found = subprocess.run(["pgrep", "-f", "type=renderer"], capture_output=True, text=True, check=False).stdout.split()
    return {int(pid) for pid in found if _is_ours(int(pid))}


@contextmanager
def stopped(others=frozenset()):
    """All pages of the browsers are stopped, but those of other processes."""
    pids = renderers() - others
    assert pids
    try:
        for pid in pids:
            os.kill(pid, signal.SIGSTOP)
        yield
    finally:
        for pid in pids:
            os.kill(pid, signal.SIGCONT)


def _is_ours(pid):
    """Whether a process descends from this one."""
    while pid > 1:
        if pid == os.getpid():
            return True
        with open(f"/proc/{pid}/stat") as stat:
            pid = int(stat.read().rpartition(")")[2].split()[1])
    return False


def test_a_page_that_is_stopped_counts_as_seeing_everything(page, demo):
    _, log = demo
    until(lambda: shows(page, log))
    with stopped():
        until(lambda: log.view == {}, seconds=10)
    until(lambda: shows(page, log))


@pytest.fixture
def spoken(demo):
    """Messages of hostile pages, sent over a WebSocket of their own; each list is from one page in control."""

    async def speak(messages):
        url = demo[0]
        async with (
            aiohttp.ClientSession() as session,
            session.ws_connect(f"{url}live?viewer=hostile", origin=url[:-1]) as ws,
        ):
            await ws.send_json({"take_control": True})
            await ws.send_json({"attention": "watching", "focused": True})
            for message in messages:
                await ws.send_str(message if isinstance(message, str) else json.dumps(message))
                await asyncio.sleep(0.1)
            await asyncio.sleep(0.5)

    def speak_aside(messages):
        """In a thread: that of the browser's has a loop of its own."""
        with ThreadPoolExecutor(1) as aside:
            aside.submit(lambda: asyncio.run(speak(messages))).result(60)

    return speak_aside


def view(*numbers):
    keys = ("x", "y", "width", "height", "screen_width", "screen_height")
    return {"view": {name: dict(zip(keys, numbers, strict=True)) for name in ROBOT_SIZES}}


def test_hostile_views_are_refused_or_taken_at_their_word_and_end_with_their_page(page, demo, spoken):
    _, log = demo
    until(lambda: shows(page, log))
    before = len(log.views)
    good, one = view(0, 0, 160, 90, 80, 45), view(0, 0, 1, 1, 1, 1)
    spoken(
        [
            good,
            '{"view": {"front": {"x": NaN}}}',
            good,
            {"view": {"gone": {}}},
            good,
            view(0, 0, 9999, 1, 1, 1),
            {"view": None},
        ]
    )
    until(lambda: log.view == {})
    spoken([good, one] * 10)  # alternating at 10 Hz
    until(lambda: log.view == {})
    noticed = log.views[before:]
    assert {seen.width for each in noticed for seen in each.values()} - {160, 1} <= {
        seen.width for seen in log.views[before - 1].values()
    }
    take_control(page)
    until(lambda: shows(page, log))
