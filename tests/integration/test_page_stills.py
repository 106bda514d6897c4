"""The page in a real browser, with still pictures in place of a drive: lines on the ground, gamepads, attention."""

from __future__ import annotations

import io
import json
import math
import shutil
import subprocess
import threading
import time
from contextlib import contextmanager
from dataclasses import asdict
from types import SimpleNamespace

import numpy as np
import pytest
from painted import CAMERAS, CAR, SIZE, WITHIN_PX, ends_of, found, native_pictures, paint

from browser import PADS, all_live, opened, shot, until
from rig import free_port
from runner.configuration.config import configuration
from runner.core.events import parse
from runner.core.model import plain
from runner.core.step import start, step
from runner.h264.access_unit import read_unit
from runner.page.server import PageServer
from runner.records import CameraState, Sample, VehicleState, applied_to_json

pytestmark = [
    pytest.mark.gst,
    pytest.mark.soak,  # builds a street
    pytest.mark.skipif(not shutil.which("chromium"), reason="needs chromium"),
]
image = pytest.importorskip("PIL.Image")
pytest.importorskip("cv2")
pytest.importorskip("numba")

FPS = 1  # as the page knows it; pictures come more often, so that none is late on a busy machine
EVERY_S = 0.4


class Station(SimpleNamespace):
    """What the page needs of the operator's side: a vehicle in mode S, of which each camera sends one picture."""

    def __init__(self, vehicle, pictures):
        self.vehicle, self.run = vehicle, start(vehicle)
        for name, camera in CAMERAS.items():
            self.step(event="camera_configured", camera=name, kbps=4000, scaling=camera.factor)
            if camera.roi:
                roi = dict(zip(("x", "y", "width", "height"), camera.roi, strict=True))
                self.step(event="roi_set", camera=name, **roi)
        self.units = {name: self.encoded(name, picture) for name, picture in pictures.items()}
        super().__init__(state=self.published(), note=print, answer_s=1.0, attention=None)

    def step(self, **event):
        self.run = step(self.vehicle, self.run, parse({"t": 0, **event}))
        assert not self.run.refused

    def published(self):
        run = self.run
        cameras = {
            name: CameraState.at(setting, 1, applied_to_json(name, run.commanded[name]), None)
            for name, setting in run.decision.settings.items()
        }
        return VehicleState(1.0, "", run.decision.mode, plain(run.decision.total), cameras)

    def encoded(self, name, picture):
        """A key frame of what the vehicle would send of a native picture: cropped, scaled, as H.264."""
        (width, height), setting = CAMERAS[name].native, self.run.decision.settings[name]
        roi, top = setting.roi, CAMERAS[name].top
        edges = (f"left={roi.x}", f"right={width - roi.x - roi.width}")
        edges += (f"top={top + roi.y}", f"bottom={height - top - roi.y - roi.height}")
        size = f"video/x-raw,width={setting.width},height={setting.height},pixel-aspect-ratio=1/1"
        stream = "video/x-h264,stream-format=byte-stream,alignment=au,profile=constrained-baseline"
        line = ["gst-launch-1.0", "-q", "fdsrc", "fd=0", "!", "rawvideoparse", "format=i420", f"width={width}"]
        line += [
            f"height={height}",
            f"framerate={FPS}/1",
            "!",
            "videocrop",
            *edges,
            "!",
            "videoscale",
            "add-borders=false",
        ]
        line += ["!", size, "!", "x264enc", "tune=zerolatency", "bitrate=8000", "!", stream, "!", "fdsink", "fd=1"]
        done = subprocess.run(line, input=picture, capture_output=True, check=True, timeout=60)
        return done.stdout

    def captured_here(self, camera, captured):
        return captured

    def ask(self, document, on_reply):
        self.asked = document


@pytest.fixture(scope="module")
def station(tmp_path_factory):
    place = tmp_path_factory.mktemp("stills")
    paint(place / "world")
    conf = place / "conf"
    (conf / "vehicle").mkdir(parents=True)
    (conf / "vehicle" / "marks.yaml").write_text(f"# @package _global_\n{json.dumps(vehicle_file())}\n")
    words = ["vehicle=marks", "source=test", "mode=single", f"page.port={free_port()}"]
    words += ["inputs.keys.view=x", "inputs.buttons.view=7"]
    return Station(configuration(words, conf).vehicle(), dict(native_pictures(place / "world")))


def vehicle_file():
    cameras = {
        name: {
            "width_px": SIZE[0],
            "height_px": SIZE[1],
            "fps": FPS,
            "native": {"width_px": camera.native[0], "height_px": camera.native[1], "top_px": camera.top},
            "lens": camera.lens,
            "fov_deg": camera.fov_deg,
            "calibrated": name != "fisheye",
            "rate_quality": {"scaling": [0.5, 1.0], "b_min_kbps": [0, 100], "b_full_kbps": 8000},
            "pose": asdict(camera.pose),
        }
        for name, camera in CAMERAS.items()
    }
    return {"name": "marks", "dimensions": asdict(CAR), "cameras": cameras}


@pytest.fixture
def served(station):
    """The page's server, which sends the pictures."""
    page, ended = PageServer(station.vehicle, station), threading.Event()
    page.behind_s = 0.0  # how long ago pictures were captured

    def send():
        while not ended.wait(EVERY_S):
            for name, data in station.units.items():
                page.show(name, read_unit(data, time.time() - page.behind_s, time.time()))

    page.start()
    sending = threading.Thread(target=send)
    sending.start()
    try:
        yield page
    finally:
        ended.set()
        sending.join()
        page.stop()


@pytest.fixture
def page(chromium, served):
    """The Drive view of the page in control."""
    with opened(chromium, served.url, 1920, 1080) as page:
        all_live(page)
        until(lambda: page.evaluate("tod.control") == "you")
        page.locator("body").press("x")
        yield page


def guides(page, name):
    return page.evaluate(f"tod.guides('{name}')")


def test_lines_end_where_marks_on_the_ground_are(page):
    until(lambda: guides(page, "mirrored"))
    assert not guides(page, "fisheye"), "not calibrated"
    page.locator("body").press("g")
    until(lambda: guides(page, "fisheye"))
    page.add_style_tag(content=".tile .head, .drawn-off canvas.guides { visibility: hidden; }")
    apart = {}
    for number, (name, camera) in enumerate(CAMERAS.items(), 1):
        if name in ("mirrored", "fisheye"):
            for key in ("Escape", str(number), "Enter"):
                page.locator("body").press(key)
            until(lambda n=name: page.locator(f"[data-camera={n}] .picture").bounding_box()["width"] > SIZE[0] / 2)
        on, lines = seen(page, name)
        shot(page, f"guides-{name}")
        page.evaluate("document.body.classList.add('drawn-off')")
        off, _ = seen(page, name)
        page.evaluate("document.body.classList.remove('drawn-off')")
        ends = ends_of(lines, camera.ends)
        for key, end in ends.items():
            mark = found(off, end, [other for other in ends.values() if other is not end])
            apart[name, *key] = round(math.dist(mark, end) / scale_of(page, name, camera), 2)
        for line in lines:
            for piece in line["pieces"]:
                assert is_drawn(on - off, piece) is not False, (name, line["kind"], line["metres"])
    print(apart)
    assert {key: value for key, value in apart.items() if value > WITHIN_PX} == {}


def seen(page, name):
    """Luma of a camera's box on the screen while its picture is live, and its guides."""

    def live():
        return page.evaluate("tod.measure()")["cameras"][name]["status"] == "live" and guides(page, name)

    def pictured():
        before = live()
        png = page.locator(f"[data-camera={name}] .picture").screenshot()
        return png, before, live()

    png, lines, _ = until(lambda: (taken := pictured())[1] and taken[1] == taken[2] and taken)
    return np.asarray(image.open(io.BytesIO(png)).convert("L"), float), lines


def scale_of(page, name, camera):
    """CSS px of the screen for one of the full image."""
    box = page.locator(f"[data-camera={name}] .picture").bounding_box()
    width, height = camera.roi[2:] if camera.roi else SIZE
    sides = (box["width"] / width, box["height"] / height)
    return max(sides) if name == "cropped" else min(sides)


def is_drawn(difference, points):
    """Whether the screen changes along a line where guides are switched off; None: it is outside of the picture."""
    height, width = difference.shape
    at = [(int(point["y"]), int(point["x"])) for point in points]
    inside = [(row, column) for row, column in at if 0 <= row < height and 0 <= column < width]
    if len(inside) < 3:
        return None
    return bool(np.mean([abs(difference[row, column]) > 15 for row, column in inside]) > 0.5)


def test_the_path_follows_the_steering_and_disappears_with_it(page, served):
    def kinds():
        return {line["kind"] for line in guides(page, "scaled")}

    until(lambda: kinds() == {"width", "distance"})
    with steering(served, 0.1):
        until(lambda: "path" in kinds())
        paths = [line["pieces"][0] for line in guides(page, "scaled") if line["kind"] == "path" and line["pieces"]]
        middle = page.locator("[data-camera=scaled] .picture").bounding_box()["width"] / 2
        assert len(paths) == 2 and max(path[-1]["x"] for path in paths) < middle, "to the left"
        shot(page, "guides-steering")
    until(lambda: kinds() == {"width", "distance"})


@contextmanager
def steering(served, rad):
    """The angle reported 20 times a second."""
    ended = threading.Event()

    def report():
        while not ended.wait(0.05):
            served.on_steering(time.time(), rad)

    reporting = threading.Thread(target=report)
    reporting.start()
    try:
        yield
    finally:
        ended.set()
        reporting.join()


def test_buttons_act_once_and_a_pad_that_disappears_is_announced(page, station):
    page.evaluate(PADS)
    page.evaluate("plug('Wheel')")

    def hold(button, seconds=0.2):
        page.evaluate(f"pads[0].buttons[{button}].pressed = true")
        time.sleep(seconds)
        page.evaluate(f"pads[0].buttons[{button}].pressed = false")
        time.sleep(0.1)
        return page.locator(".tile.selected").get_attribute("data-camera")

    time.sleep(0.1)  # what is held when it comes does not count
    assert [hold(button) for button in (14, 12, 13)] == ["cropped", "scaled", "mirrored"]
    hold(3)
    assert page.evaluate("tod.view") == "drive", "of the view in the usual configuration"
    hold(7, seconds=1)
    assert page.evaluate("tod.view") == "configure", "a held button counts once"
    hold(7)
    assert page.evaluate("tod.view") == "drive"
    hold(4)
    assert until(lambda: getattr(station, "asked", None)) == {"event": "mode_selected", "mode": "automatic"}
    page.evaluate("unplug()")
    until(lambda: "Wheel is gone" in page.inner_text("#toasts"))
    assert "Wheel is gone" in page.locator("#news").text_content()


def test_keys_do_what_the_configuration_says(page, station):
    def selected_by(key):
        page.keyboard.press(key)
        return page.locator(".tile.selected").get_attribute("data-camera")

    page.keyboard.press("v")
    assert page.evaluate("tod.view") == "drive", "the key of the view is another"
    assert [selected_by(key) for key in ("ArrowLeft", "ArrowUp", "ArrowDown")] == ["cropped", "scaled", "mirrored"]
    for key, expected in (("Shift+C", "collective"), ("Shift+A", "automatic")):
        station.asked = None
        page.keyboard.press(key)
        assert until(lambda: station.asked) == {"event": "mode_selected", "mode": expected}
    page.keyboard.press("?")
    page.wait_for_selector("dialog[open]")
    assert "Drive or Configure view" in page.locator("#help tr", has=page.locator("th", has_text="x")).inner_text()
    page.keyboard.press("Escape")
    page.wait_for_selector("dialog[open]", state="hidden")


def test_a_pad_vibrates_for_a_picture_that_is_lost(page, station, served):
    page.evaluate(PADS)
    page.evaluate("plug('Pad')")
    served.on_state(None)  # the vehicle is offline
    until(lambda: page.evaluate("shaken"))
    assert page.evaluate("shaken") == [["dual-rumble", 600]], "once for all pictures"


def test_a_pad_vibrates_more_gently_for_a_picture_that_is_late(page, served):
    page.evaluate(PADS)
    page.evaluate("plug('Pad')")
    served.on_sample(Sample(1.0, None, 0, 0.0, None, 0, {}, clock_bound_ms=1.0))  # ages are known
    time.sleep(1)
    assert page.evaluate("shaken") == []
    served.behind_s = 0.5
    until(lambda: page.evaluate("shaken"))
    assert page.evaluate("shaken")[0] == ["dual-rumble", 200]


def test_the_vehicle_is_told_of_a_page_that_is_hidden_or_out_of_focus(page, station):
    until(lambda: station.attention in ("watching", "unfocused"))
    page.evaluate("dispatchEvent(new Event('focus'))")
    until(lambda: station.attention == "watching")
    page.evaluate("dispatchEvent(new Event('blur'))")
    until(lambda: station.attention == "unfocused")
    until(lambda: "OUT OF FOCUS" in page.inner_text("#attention"))  # a busy machine may be slow for a moment
    page.evaluate("Object.defineProperty(document, 'hidden', {get: () => true, configurable: true})")
    page.evaluate("document.dispatchEvent(new Event('visibilitychange'))")
    until(lambda: station.attention == "hidden")
    page.evaluate("delete document.hidden")
    page.evaluate("dispatchEvent(new Event('focus'))")
    until(lambda: station.attention == "watching")
