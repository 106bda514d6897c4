"""The page in a real browser with still pictures: lines on the ground, lens, gamepads, attention."""

from __future__ import annotations

import math
import time
from contextlib import contextmanager

import numpy as np
import pytest
from painted import CAMERAS, SIZE, STEERED, STEERED_RAD, WITHIN_PX, ends_of, found, native_pictures, paint
from stills import MARKS, Station, on_screen, serving, steering

from browser import PADS, all_live, measure, opened, shot, until
from runner.core.events import Gear
from runner.records.operator import Sample

pytestmark = MARKS


@pytest.fixture(scope="module")
def station(tmp_path_factory):
    place = tmp_path_factory.mktemp("stills")
    paint(place / "world")
    pictures = dict(native_pictures(place / "world"))
    return Station(
        place,
        CAMERAS,
        pictures,
        SIZE,
        ["fisheye"],
        ["inputs.keys.view=z", "inputs.buttons.view=7", "inputs.buttons.help=6"],
    )


@pytest.fixture
def served(station):
    with serving(station) as page:
        yield page


@pytest.fixture
def page(chromium, served):
    """The Drive view of the page in control."""
    with opened(chromium, served.url, 1920, 1080) as page:
        all_live(page)
        until(lambda: page.evaluate("tod.control") == "you")
        page.locator("body").press("z")
        yield page


def guides(page, name):
    return page.evaluate(f"tod.guides('{name}')")


def test_lines_end_at_the_marks_on_the_ground(page):
    until(lambda: guides(page, "mirrored"))
    assert not guides(page, "fisheye"), "not calibrated"
    page.locator("body").press("g")
    until(lambda: guides(page, "fisheye"))
    page.add_style_tag(content=".tile .head { visibility: hidden; }")
    apart = {}
    for name, camera in CAMERAS.items():
        if name != "scaled":
            enlarge(page, name)
        on, lines = seen(page, name)
        shot(page, f"guides-{name}")
        with without_guides(page):
            off, _ = seen(page, name, guided=False)
        ends = ends_of(lines, camera.ends)
        for key, end in ends.items():
            mark = found(off, end, [other for other in ends.values() if other is not end])
            apart[name, *key] = round(math.dist(mark, end) / scale_of(page, name, camera), 2)
        for line in lines:
            for piece in line["pieces"]:
                assert is_drawn(on - off, piece) is not False, (name, line["kind"], line["metres"])
    print(apart)
    assert {key: value for key, value in apart.items() if value > WITHIN_PX} == {}


def test_lines_match_marks_in_a_straightened_fisheye_which_accepts_no_region(page, station):
    number = list(CAMERAS).index("fisheye") + 1
    for key in (str(number), "Enter", "g", "l"):
        page.locator("body").press(key)
    until(lambda: page.inner_text("[data-camera=fisheye] .shown") == "straight, 100° of 130°")
    until(lambda: scale_of(page, "fisheye", CAMERAS["fisheye"]) > 1)
    until(lambda: page.evaluate("tod.measure()")["cameras"]["fisheye"]["straight"])
    page.add_style_tag(content=".tile .head { visibility: hidden; }")
    on, lines = seen(page, "fisheye")
    shot(page, "straight")
    with without_guides(page):
        off, _ = seen(page, "fisheye", guided=False)
    scale, ends = scale_of(page, "fisheye", CAMERAS["fisheye"]), ends_of(lines, CAMERAS["fisheye"].ends)
    marks = {key: found(off, end, [other for other in ends.values() if other is not end]) for key, end in ends.items()}
    apart = {key: round(math.dist(mark, ends[key]) / scale, 2) for key, mark in marks.items()}
    print(apart)
    assert {key: value for key, value in apart.items() if value > WITHIN_PX} == {}
    for side in (0, -1):
        near, middle, far = (np.array(marks[1, metres, side]) for metres in (5, 10, 15))
        across = (far - near)[::-1] * (1, -1) / math.dist(far, near)
        assert abs(across @ (middle - near)) / scale < WITHIN_PX, "three places in a line"
    for line in lines:
        for piece in line["pieces"]:
            assert is_drawn(on - off, piece) is not False, (line["kind"], line["metres"])
    station.last_request = None
    box = page.locator("[data-camera=fisheye] .picture").bounding_box()
    drag(page, (box["x"] + 300, box["y"] + 200), (box["x"] + 500, box["y"] + 400))
    until(lambda: "no ROI can be chosen on a straightened picture" in page.inner_text("#toasts"))
    assert station.last_request is None
    page.locator("body").press("l")
    until(lambda: page.inner_text("[data-camera=fisheye] .shown") == "")


def test_only_a_fisheye_of_this_vehicle_is_straightened_by_an_earlier_choice(page):
    page.evaluate("localStorage['tod-straight:another'] = 'fisheye'")
    page.evaluate("localStorage['tod-straight:marks'] = 'cropped'")  # it was a fisheye then
    page.reload()
    all_live(page)
    assert not any(camera["straight"] for camera in measure(page).values())
    page.evaluate("localStorage['tod-straight:marks'] = 'cropped fisheye'")
    page.reload()
    until(lambda: [name for name, camera in measure(page).items() if camera["straight"]] == ["fisheye"])


def test_the_wheel_zooms_the_region_the_middle_button_moves_it_and_its_aspect_may_be_locked(page, station):
    def requested_roi():
        roi = until(lambda: getattr(station, "last_request", None))
        station.last_request = None
        until(lambda: page.evaluate("tod.requests.pending") == [])  # the stub executes nothing
        assert (roi.pop("event"), roi.pop("camera")) == ("roi_set", name)
        return roi

    def at(x, y):
        box = page.locator(f"[data-camera={name}] .picture").bounding_box()
        return box["x"] + x * box["width"], box["y"] + y * box["height"]

    station.last_request = None
    name = "scaled"
    page.mouse.move(*at(0.25, 0.5))
    page.mouse.wheel(0, -500 * math.log(2))
    assert requested_roi() == pytest.approx({"x": 160, "y": 180, "width": 640, "height": 360}, abs=4)
    page.locator("body").press("d")
    page.locator("[data-control=roi-aspect]").click()
    page.locator("body").press("d")
    drag(page, at(0.2, 0.2), at(0.6, 0.9))
    roi = requested_roi()
    assert roi == pytest.approx({"x": 256, "y": 144, "width": 512, "height": 288}, abs=4)
    name = "mirrored"
    drag(page, at(0.5, 0.5), at(0.6, 0.5), button="middle")
    until(
        lambda: (getattr(station, "last_request", None) or {}).get("x") == pytest.approx(328, abs=4)
    )  # only the last region
    roi = requested_roi()
    assert (roi["y"], roi["width"], roi["height"]) == (60, 880, 495)


def test_two_fingers_zoom_and_move_the_region(page, station):
    """As a wheel does: the point between the fingers stays between them."""
    box = page.locator("[data-camera=scaled] .picture").bounding_box()
    touch_screen = page.context.new_cdp_session(page)

    def touch(kind, *fingers):
        points = [
            {"id": number, "x": box["x"] + x * box["width"], "y": box["y"] + y * box["height"]}
            for number, (x, y) in enumerate(fingers)
        ]
        touch_screen.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})

    def is_requested(**roi):
        request = getattr(station, "last_request", None) or {}
        return request == {"event": "roi_set", "camera": "scaled"} | {
            key: pytest.approx(at, abs=4) for key, at in roi.items()
        }

    station.last_request = None
    touch("touchStart", (0.2, 0.5))
    touch("touchStart", (0.2, 0.5), (0.3, 0.5))
    for apart in (0.06, 0.08, 0.1):
        touch("touchMove", (0.25 - apart, 0.5), (0.25 + apart, 0.5))
    until(lambda: is_requested(x=160, y=180, width=640, height=360))
    touch("touchMove", (0.2, 0.5), (0.4, 0.5))
    until(lambda: is_requested(x=128, y=180, width=640, height=360))
    touch("touchEnd", (0.2, 0.5))
    touch("touchMove", (0.3, 0.7))  # one finger is no pinch
    touch("touchEnd")
    until(lambda: page.evaluate("tod.requests.pending") == [])
    assert is_requested(x=128, y=180, width=640, height=360)


def test_a_picture_of_a_region_shows_where_it_lies_in_the_full_image(page):
    def frame(name):
        return page.locator(f"[data-camera={name}] .picture .diagram")

    enlarge(page, "mirrored")
    assert [name for name in CAMERAS if frame(name).is_visible()] == ["mirrored"]
    full, part = (each.bounding_box() for each in (frame("mirrored"), frame("mirrored").locator(".is")))
    (x, y, wide, high), (width, height) = CAMERAS["mirrored"].roi, SIZE
    shares = [(part[side] - full[side]) / full[of] for side, of in (("x", "width"), ("y", "height"))]
    shares += [part[side] / full[side] for side in ("width", "height")]
    assert shares == pytest.approx([(width - x - wide) / width, y / height, wide / width, high / height], abs=0.03)
    shot(page, "region")


def enlarge(page, name):
    for key in ("Escape", str(list(CAMERAS).index(name) + 1), "Enter"):
        page.locator("body").press(key)
    until(lambda: page.locator(f"[data-camera={name}] .picture").bounding_box()["width"] > SIZE[0] / 2)


def drag(page, begin, end, button="left"):
    page.mouse.move(*begin)
    page.mouse.down(button=button)
    page.mouse.move(*end, steps=4)
    page.mouse.up(button=button)


def seen(page, name, guided=True):
    """Luma of a camera's box on the screen while its picture is live, and its guides, shown or not."""

    def camera():
        return page.evaluate("tod.measure()")["cameras"][name]

    def live():
        lines = guides(page, name)
        return (lines if guided else not lines) if camera()["status"] == "live" else None

    # Size and guides apply from the next picture on, which is on the screen at the latest with the one after it.
    due = camera()["drawn"] + 2
    until(lambda: live() and camera()["drawn"] >= due)
    return on_screen(page.locator(f"[data-camera={name}] .picture"), live)


@contextmanager
def without_guides(page):
    """The pictures alone: guides are a part of them."""
    names = [name for name in CAMERAS if guides(page, name)]
    page.evaluate("boot.worker.postMessage({order: 'guided', names: []})")
    yield
    page.evaluate("names => boot.worker.postMessage({order: 'guided', names})", names)


def scale_of(page, name, camera):
    """CSS px on the screen per px of the full image."""
    box = page.locator(f"[data-camera={name}] .picture").bounding_box()
    width, height = camera.roi[2:] if camera.roi else SIZE
    sides = (box["width"] / width, box["height"] / height)
    return max(sides) if name == "cropped" else min(sides)


def is_drawn(difference, points):
    """Whether the screen changes along a line where guides are switched off; None: it is outside the picture."""
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
        on, lines = seen(page, "scaled")
        with without_guides(page):
            off, _ = seen(page, "scaled", guided=False)
        drawn = [is_drawn(on - off, piece) for line in lines if line["kind"] == "path" for piece in line["pieces"]]
        assert drawn and all(drawn)
    until(lambda: kinds() == {"width", "distance"})


def test_a_driver_sees_steering_and_gear_once_they_are_reported(page, served):
    figures = {name: page.locator(f"#{name}-now") for name in ("steering", "gear", "heading")}
    assert page.locator("#speed-now").is_visible()
    assert not any(figure.is_visible() for figure in figures.values())
    with steering(served, -0.1, Gear.REVERSE):
        until(lambda: page.inner_text("#steering") == "6° right" and page.inner_text("#gear") == "R")
        shot(page, "drive-steering")
    until(lambda: page.inner_text("#steering") == page.inner_text("#gear") == "–")
    assert not figures["heading"].is_visible(), "nobody reports it"


def test_the_path_passes_the_marks_where_the_wheels_will_go(page, served):
    page.add_style_tag(content=".tile .head { visibility: hidden; }")

    def paths():
        return [line["pieces"][0] for line in guides(page, "scaled") if line["kind"] == "path" and line["pieces"]]

    with steering(served, STEERED_RAD):
        until(lambda: len(paths()) == 2)
        points = [paths()[-side][-1 - before] for before, side, _ in STEERED]
        with without_guides(page):
            picture, _ = seen(page, "scaled", guided=False)
    drawn = [(point["x"], point["y"]) for point in points]
    marks = [found(picture, each, [other for other in drawn if other is not each]) for each in drawn]
    scale = scale_of(page, "scaled", CAMERAS["scaled"])
    apart = [round(math.dist(*pair) / scale, 2) for pair in zip(drawn, marks, strict=True)]
    print(apart)
    assert max(apart) < WITHIN_PX


def test_buttons_act_once_and_a_pad_that_disconnects_is_announced(page, station):
    page.evaluate(PADS)
    page.evaluate("plug('Wheel')")

    def hold(button, seconds=0.2):
        page.evaluate(f"pads[0].buttons[{button}].pressed = true")
        time.sleep(seconds)
        page.evaluate(f"pads[0].buttons[{button}].pressed = false")
        time.sleep(0.1)
        return page.locator(".tile.selected").get_attribute("data-camera")

    time.sleep(0.1)  # a button held while connecting does not count
    assert [hold(button) for button in (14, 12, 13)] == ["cropped", "scaled", "mirrored"]
    hold(3)
    assert page.evaluate("tod.view") == "drive", "this button changes the view by default only"
    hold(7, seconds=1)
    assert page.evaluate("tod.view") == "configure", "a held button counts once"
    hold(7)
    assert page.evaluate("tod.view") == "drive"
    hold(4)
    assert until(lambda: getattr(station, "last_request", None)) == {"event": "mode_selected", "mode": "automatic"}
    until(lambda: page.locator(".tile.selected").get_attribute("data-camera") == "mirrored")
    page.evaluate("unplug()")
    until(lambda: "Wheel disconnected" in page.inner_text("#toasts"))
    until(lambda: "▲ GAMEPAD DISCONNECTED Wheel" in page.inner_text("#alarms"))
    polls = page.evaluate("plug('Wheel'), pads[0].buttons[12].pressed = true, polls")
    until(lambda: page.evaluate("polls") > polls + 2)
    assert "GAMEPAD DISCONNECTED" not in page.inner_text("#alarms")
    assert page.locator(".tile.selected").get_attribute("data-camera") == "mirrored", "held while it connected"
    page.keyboard.press("?")
    polls = page.evaluate("pads[0].axes[1] = -1, polls")
    until(lambda: page.evaluate("polls") > polls + 2)
    assert page.inner_text("#pressed") == "Pressed: axis1-, hat1-up"
    shot(page, "pressed")
    assert page.locator(".tile.selected").get_attribute("data-camera") == "mirrored", "a dialog is open"
    hold(1)
    assert page.locator("dialog[open]").count() == 1, "the list of keys shows what is pressed"
    hold(6)  # help
    page.wait_for_selector("dialog[open]", state="hidden")
    page.evaluate("unplug()")
    assert "Wheel disconnected" in page.locator("#news").text_content()


def test_keys_follow_the_configuration(page, station):
    def selected_by(key):
        page.keyboard.press(key)
        return page.locator(".tile.selected").get_attribute("data-camera")

    page.keyboard.press("v")
    assert page.evaluate("tod.view") == "drive", "another key is assigned to the view"
    assert [selected_by(key) for key in ("ArrowLeft", "ArrowUp", "ArrowDown")] == ["cropped", "scaled", "mirrored"]
    for key, expected in (("Shift+C", "collective"), ("Shift+A", "automatic")):
        station.last_request = None
        page.keyboard.press(key)
        assert until(lambda: station.last_request) == {"event": "mode_selected", "mode": expected}
    page.keyboard.press("?")
    page.wait_for_selector("dialog[open]")
    assert "Drive or Configure view" in page.locator("#help tr", has=page.locator("th", has_text="z")).inner_text()
    page.keyboard.press("Escape")
    page.wait_for_selector("dialog[open]", state="hidden")


def test_a_pad_vibrates_for_a_picture_that_is_lost(page, station, served):
    page.evaluate(PADS)
    page.evaluate("plug('Pad')")
    served.on_state(None)  # the vehicle is offline
    until(lambda: page.evaluate("vibrations"))
    assert page.evaluate("vibrations") == [["dual-rumble", 600]], "once for all pictures"


def test_a_pad_vibrates_more_gently_for_a_picture_that_is_late(page, served):
    page.evaluate(PADS)
    page.evaluate("plug('Pad')")
    served.on_sample(Sample(1.0, None, 0, 0.0, None, 0, {}, clock_bound_ms=1.0))  # ages are known
    time.sleep(1)
    assert page.evaluate("vibrations") == []
    served.behind_s = 0.5
    until(lambda: page.evaluate("vibrations"))
    assert page.evaluate("vibrations")[0] == ["dual-rumble", 200]


def test_a_hidden_or_unfocused_page_is_reported_to_the_vehicle(page, station):
    until(lambda: station.attention in ("watching", "unfocused"))
    page.evaluate("dispatchEvent(new Event('focus'))")
    until(lambda: station.attention == "watching")
    page.evaluate("dispatchEvent(new Event('blur'))")
    until(lambda: station.attention == "unfocused")
    until(lambda: "OUT OF FOCUS" in page.inner_text("#attention"))  # a busy machine may be slow at first
    page.evaluate("Object.defineProperty(document, 'hidden', {get: () => true, configurable: true})")
    page.evaluate("document.dispatchEvent(new Event('visibilitychange'))")
    until(lambda: station.attention == "hidden")
    page.evaluate("delete document.hidden")
    page.evaluate("dispatchEvent(new Event('focus'))")
    until(lambda: station.attention == "watching")
