"""The page with a camera that encodes by itself: it crops the picture, and requests nothing."""

from __future__ import annotations

import io
import math
import subprocess

import numpy as np
import pytest
from told_camera import told_camera

from browser import all_live, measure, opened, shot, until
from rig import answers, free_port, needs_browser, process

pytestmark = [pytest.mark.gst, needs_browser]
image = pytest.importorskip("PIL.Image")

# Eight bars of colours, which a picture's place tells.
CAMERA = (
    "videotestsrc name=pattern is-live=true pattern=smpte75 ! videoscale"
    " ! capsfilter name=size caps=video/x-raw,format=I420,width=640,height=360,framerate=10/1"
    " ! x264enc name=encoder tune=zerolatency speed-preset=ultrafast bitrate=1000 key-int-max=10"
    " ! rtph264pay name=pay0 pt=96"
)


@pytest.fixture(scope="module")
def camera():
    with told_camera(CAMERA) as camera:
        yield camera


@pytest.fixture(scope="module")
def address(camera):
    """Of the page of a demo with this camera."""
    port = free_port()
    ports = [f"{key}={free_port()}" for key in ("media.port", "control.port")]
    words = [f"camera={camera.rtsp}", "graph=pass_through", "fps_max=10", "duration_s=600", f"page.port={port}"]
    sizes = [
        "cameras.camera.width_px=640",
        "cameras.camera.height_px=360",
        "cameras.camera.rate_quality.b_full_kbps=600",
    ]
    with process("demo", *words, *sizes, *ports, stdout=subprocess.DEVNULL) as child:
        until(lambda: answers(port) or child.poll() is not None, seconds=120)
        yield f"http://127.0.0.1:{port}/"
        child.terminate()
        child.wait(timeout=15)


@pytest.fixture
def page(chromium, address):
    with opened(chromium, address, 1280, 800) as page:
        all_live(page)
        yield page


def colours(page):
    """Of the middle of the picture's left and right part, as it is on the screen."""
    taken = np.asarray(image.open(io.BytesIO(page.locator("[data-camera=camera] canvas").first.screenshot())))
    height, width = taken.shape[:2]
    return [taken[height // 3, round(place * width), :3].astype(int) for place in (0.06, 0.94)]


def shows(page, *expected):
    """Whether the left and the right part are of these colours."""
    seen = colours(page)
    return all(np.abs(colour - np.array(wanted)).max() < 40 for colour, wanted in zip(seen, expected, strict=True))


WHITE, YELLOW, BLUE = (191, 191, 191), (191, 191, 0), (0, 0, 191)


def test_the_page_alone_shows_a_region(page):
    def at(x, y):
        box = page.locator("[data-camera=camera] .picture").bounding_box()
        return box["x"] + x * box["width"], box["y"] + y * box["height"]

    shown = page.locator("[data-camera=camera] .shown")
    until(lambda: shows(page, WHITE, BLUE))
    for _ in range(2):  # each to a half of the sides, the first bars stay
        page.mouse.move(*at(0, 0.1))
        page.mouse.wheel(0, -500 * math.log(2))
        page.wait_for_timeout(1000)  # the wheel begins anew
    until(lambda: "6 % of its image shown, by this page" in shown.inner_text())
    until(lambda: shows(page, WHITE, YELLOW))
    shot(page, "passed-region")
    assert page.evaluate("tod.requests.pending") == []
    assert page.inner_text("#toasts").strip("×\n") in ("", "You are in control")
    assert measure(page)["camera"]["width"] == 640
    assert page.evaluate("tod.state").get("cameras")["camera"]["roi"]["width"] == 640
    page.locator("[data-camera=camera]").click()
    until(lambda: "This page alone shows 6 % of the image" in page.inner_text("#region-part"))
    shot(page, "passed-panel")
    page.locator("[data-control=roi-full]").click()
    until(lambda: shows(page, WHITE, BLUE))
    assert "by this page" not in shown.inner_text()


def test_a_camera_that_changes_its_size_stays_live(page, camera):
    camera.tell("size", "caps", "video/x-raw,format=I420,width=320,height=180,framerate=10/1")
    until(lambda: measure(page)["camera"]["width"] == 320)
    drawn = measure(page)["camera"]["drawn"]
    until(lambda: measure(page)["camera"]["drawn"] > drawn + 20)
    all_live(page)
    camera.tell("size", "caps", "video/x-raw,format=I420,width=640,height=360,framerate=10/1")
    until(lambda: measure(page)["camera"]["width"] == 640)
    all_live(page)


def test_one_that_sends_more_than_is_stated_is_named_and_costs_what_it_sends(page, camera):
    def decided():
        return page.evaluate("tod.state")["cameras"]["camera"]

    camera.tell("pattern", "pattern", "snow")
    until(lambda: "as the camera encodes it, more than its b_full of 600" in decided()["reason"])
    until(lambda: 800 < decided()["kbps"] < 1500)
    camera.tell("pattern", "pattern", "smpte75")
    until(lambda: decided()["kbps"] < 500)
    assert "more than" not in decided()["reason"]
