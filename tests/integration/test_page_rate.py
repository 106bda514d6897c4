"""A vehicle that stands sends fewer pictures: the page says so, and they stay live; in a real browser."""

from __future__ import annotations

import subprocess

import pytest

from browser import all_live, measure, opened, shot, state, take_control, until
from rig import SMALL_ROBOT, Operator, answers, free_port, needs_browser, process
from runner.settings import Endpoint

pytestmark = [pytest.mark.gst, needs_browser]
pytest.importorskip("aiohttp")

HZ, STANDING_HZ = 15, 5
WORDS = (
    *(*SMALL_ROBOT, "source=test", f"fps_max={HZ}", "modes=motion", "modes.collective.follow_link.reports=ignored"),
    *("mode=collective", "pqos=constant", "pqos.kbps=3000", "duration_s=1200"),
    *(f"modes.collective.while_standing.{side}_fps={STANDING_HZ}" for side in ("front", "rear")),
)
# By camera, how often it had each status, in looks 50 times a second.
WATCH = """() => {
  globalThis.seen = {};
  globalThis.watch = setInterval(async () => {
    for (const [name, camera] of Object.entries((await tod.measure()).cameras)) {
      const own = (seen[name] ??= {});
      own[camera.status] = (own[camera.status] ?? 0) + 1;
    }
  }, 20);
}"""


def rates(page):
    return {name: camera.get("fps") for name, camera in state(page)["cameras"].items()}


def drive(page, positions, speed, wanted):
    """Report a speed, until the cameras are sent at their rates, and arrive so."""

    def is_followed():
        positions.send("gps", event="position_reported", lat=48.0, lon=11.0, speed_mps=speed)
        is_sent = set(rates(page).values()) == {wanted}
        return is_sent and abs(page.evaluate("tod.sample.cameras.rear.fps") - wanted) <= 1

    until(is_followed, every_s=0.1)


@pytest.mark.alone
def test_fewer_pictures_are_live_and_the_page_says_how_many(chromium):
    ports = {key: free_port() for key in ("page.port", "media.port", "control.port")}
    words = (*WORDS, *(f"{key}={port}" for key, port in ports.items()))
    with process("demo", *words, stdout=subprocess.DEVNULL) as child:
        until(lambda: answers(ports["page.port"]) or child.poll() is not None, seconds=300)
        with opened(chromium, f"http://127.0.0.1:{ports['page.port']}/", 1280, 720) as page:
            all_live(page)
            if page.evaluate("tod.control") != "you":
                take_control(page)
            page.evaluate(WATCH)
            positions = Operator(Endpoint("127.0.0.1", ports["control.port"]))
            for speed, wanted in ((1.0, HZ), (0.0, STANDING_HZ), (1.0, HZ), (0.0, STANDING_HZ)):
                drive(page, positions, speed, wanted)
            positions.link.close()
            shown = {name: page.locator(f".tile[data-camera='{name}']").text_content() for name in measure(page)}
            shot(page, "standing")
            assert all(f"of {STANDING_HZ} fps" in text for text in shown.values())
            # A tile that still judged by 15 pictures a second would be frozen for half of the time.
            assert all(20 * own.get("frozen", 0) < own["live"] for own in page.evaluate("seen").values())
        child.terminate()
        child.wait(timeout=15)
