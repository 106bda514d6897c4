"""The bird's-eye view in a real browser, measured on the screen: marks on the ground, the vehicle, lost pictures."""

from __future__ import annotations

import io
import math

import numpy as np
import pytest
from painted import ALL_AROUND, CAR, FINER, TOP_CAMERAS, TOP_SIZE, Mounted, corner, native_pictures, paint
from stills import MARKS, Station, image, on_screen, serving, steering

from browser import all_live, opened, shot, until
from rig import BROWSER, CHROMIUM_FLAGS
from runner.core.mounting import Pose

pytestmark = MARKS

WITHIN_M = 0.05
SEARCH_M = 0.3  # search radius around the expected place of a mark
MAX_MARK_M = 0.65  # compared part of a mark: the view ends 1 m beyond the last marks
FRONT = Mounted(Pose(2.0, 0.0, 1.5, 0, 5), (), native=TOP_SIZE)
BODY = (0x39, 0x43, 0x4D)
AMBER = (0xFF, 0xB0, 0x00)
PATH = (0x5C, 0xD6, 0xFF)


@pytest.fixture(scope="module")
def station(tmp_path_factory):
    place = tmp_path_factory.mktemp("above")
    paint(place / "world", ALL_AROUND)
    cameras = {"front": FRONT, **TOP_CAMERAS}
    pictures = dict(native_pictures(place / "world", cameras, FINER))
    # Without a GPU it is drawn 5 times a second, and all pictures come together: some wait 0.2 s for the next drawing.
    return Station(place, cameras, pictures, TOP_SIZE, estimated=["top_rear"], words=["page.late_ms=2000"])


@pytest.fixture
def served(station):
    with serving(station) as page:
        yield page


@pytest.fixture
def page(chromium, station, served):
    """The Drive view, large, without the bird's-eye view: one of its cameras is not calibrated."""
    with opened(chromium, served.url, 1280, 800) as page:
        all_live(page)
        page.locator("body").press("v")
        page.add_style_tag(content="#attention, #toasts { visibility: hidden; }")  # they may appear on a busy machine
        yield page
        station.silent.clear()


def above(page):
    return page.evaluate("tod.birdseye()")


def shown_large(page):
    """Show the bird's-eye view in place of the front camera, all pictures live; returns its placement."""
    page.locator("body").press("e")
    small = until(lambda: (view := above(page))["on"] and view)
    page.locator("body").press("e")
    return until(lambda: moves(view := above(page)) and view["px_per_m"] > 1.5 * small["px_per_m"] and view)


def moves(view, stalled=()):
    """Whether it shows live pictures of all cameras except the stalled ones."""
    assert view["why"] == ""
    wanted = ["LOST" if name in stalled else "" for name in TOP_CAMERAS]
    return view["on"] and all([words[:4] for words in view[key]] == wanted for key in ("drawn", "states"))


def placement(view):
    return {key: view[key] for key in ("px_per_m", "x", "y")}


def seen(page, mode="RGB", stalled=()):
    """A screenshot with live pictures of all cameras except the stalled ones, and its placement."""

    def steady():
        view = above(page)
        changes = [change for change in page.evaluate("tod.measure()")["status_log"] if change[1] in TOP_CAMERAS]
        return moves(view, stalled) and (placement(view), changes)

    pixels, (view, _) = on_screen(page.locator("#birdseye"), steady, mode)
    return pixels, view


def test_marks_on_the_ground_appear_within_5_cm_of_their_place(page):
    shown_large(page)
    page.add_style_tag(content="#birdseye-lines, #birdseye .head { visibility: hidden; }")
    picture, scale = seen(page, "L")
    shot(page, "birdseye-marks")
    px, apart = scale["px_per_m"], {}
    for mark in ALL_AROUND:
        there = (scale["x"] - px * mark.y, scale["y"] - px * mark.x)
        half = (px * min(0.8 * mark.aside, MAX_MARK_M), px * min(0.8 * mark.along, MAX_MARK_M))
        apart[mark.x, mark.y] = round(math.dist(corner(picture, there, half, SEARCH_M * px), there) / px, 3)
    print(px, apart)
    assert {place: metres for place, metres in apart.items() if metres > WITHIN_M} == {}


def test_it_is_off_by_default_and_labelled_if_a_camera_is_not_calibrated(page):
    assert page.locator("#birdseye").is_hidden() and not above(page)["on"]
    assert page.locator("[data-camera=top_rear]").is_visible()
    page.locator("#to-birdseye").click()
    until(lambda: moves(above(page)))
    assert page.locator("#birdseye").is_visible()
    assert page.locator("[data-camera=top_rear]").is_hidden()
    assert share(colours(page)[-60:, :200], AMBER) > 0.02, "ESTIMATED"
    page.reload()
    until(lambda: moves(above(page)))
    for _ in range(2):  # large, then off
        page.locator("body").press("e")
    assert page.locator("#birdseye").is_hidden()
    assert page.locator("[data-camera=top_rear]").is_visible()
    chosen = "Object.entries(localStorage).filter(([key]) => key.startsWith('tod-birdseye:'))"
    assert [choice for _, choice in page.evaluate(chosen)] == ["off"]


def colours(page):
    png = page.locator("#birdseye").screenshot()
    return np.asarray(image.open(io.BytesIO(png)).convert("RGB"), float)


def share(pixels, colour):
    return (np.abs(pixels - colour).max(axis=-1) < 8).mean()


def test_the_vehicle_is_drawn_to_scale(page):
    shown_large(page)
    until(lambda: is_to_scale(page))  # on a busy machine a label may briefly cover it
    shot(page, "birdseye")


def test_the_path_of_the_wheels_turns_as_they_do(page, served):
    def beside():
        """Share of pixels in the path's colour, to the left and right of the lane straight ahead."""
        pixels, view = on_screen(page.locator("#birdseye"), lambda: placement(above(page)), "RGB")
        px, half = view["px_per_m"], CAR.width_m / 2 + 0.5
        ahead = slice(round(view["y"] - px * (CAR.front_m + 8)), round(view["y"] - px * CAR.front_m))
        columns = [slice(*sorted(round(view["x"] - side * px * metres) for metres in (half, 8))) for side in (1, -1)]
        return [share(pixels[ahead, each], PATH) for each in columns]

    shown_large(page)
    until(lambda: beside() == [0, 0])
    for rad in (0.3, -0.3):
        with steering(served, rad):
            until(lambda rad=rad: np.sign(np.diff(beside())) == -np.sign(rad))
            shot(page, f"birdseye-steering-{'left' if rad > 0 else 'right'}")
            left, right = beside()
            assert min(left, right) == 0 and max(left, right) > 0.001, (rad, left, right)
    until(lambda: beside() == [0, 0])


def is_to_scale(page):
    pixels, view = on_screen(page.locator("#birdseye"), lambda: placement(above(page)), "RGB")
    px, half = view["px_per_m"], CAR.width_m / 2
    row, column = round(view["y"]), round(view["x"] + 0.8 * px * half)  # next to the wedge that points ahead
    found = [*run(pixels[row], column), *run(pixels[:, column], row)]
    expected = [view["x"] - px * half, view["x"] + px * half, view["y"] - px * CAR.front_m, view["y"] + px * CAR.rear_m]
    print(found, expected)
    return found == pytest.approx(expected, abs=2)


def run(line, at):
    """Where the vehicle's colour begins and ends along a line of pixels, around one of them."""
    others = np.flatnonzero(np.abs(line - BODY).max(axis=-1) >= 3)
    after = np.searchsorted(others, at)
    return others[after - 1] + 1, others[after]


def test_a_stalled_picture_is_not_shown(page, station):
    shown_large(page)
    left, right = sides(*seen(page))
    assert min(bright(left), bright(right)) > 0.06
    assert max(red(left), red(right)) < 0.001
    station.silent.add("top_left")
    left, right = sides(*seen(page, stalled=["top_left"]))
    shot(page, "birdseye-lost")
    assert (red(left) > 0.2, red(right)) == (True, 0)
    assert bright(left) < 0.02, "words and lines"
    station.silent.clear()
    assert red(sides(*seen(page))[0]) == 0


def test_pictures_that_stalled_together_are_shown_again(page, station):
    """Only what was drawn counts: with all of them stalled, nothing is drawn that shows that they move again."""
    shown_large(page)
    for _ in range(3):
        station.silent.update(TOP_CAMERAS)
        until(lambda: all(words.startswith("LOST 2 s") for words in above(page)["states"]))  # beyond FROZEN
        station.silent.clear()
        until(lambda: moves(above(page)))
    page.locator("body").press("e")  # off, and on again: no picture counts as frozen meanwhile
    before = len(page.evaluate("tod.measure()")["status_log"])
    shown_large(page)
    marks = page.evaluate("tod.measure()")["status_log"][before:]
    assert not [mark for _, name, mark in marks if name in TOP_CAMERAS and mark in ("frozen", "lost")]


def test_all_fisheyes_may_be_straightened_beside_it(page):
    """Chromium drops the oldest of more than four WebGL contexts of a worker."""
    shown_large(page)
    page.locator("body").press("v")
    for number in range(2, 2 + len(TOP_CAMERAS)):
        for key in (str(number), "l"):
            page.locator("body").press(key)
    until(lambda: all(page.evaluate("tod.measure()")["cameras"][name]["straight"] for name in TOP_CAMERAS))
    page.locator("body").press("v")
    until(lambda: moves(above(page)))
    assert "dropped" not in page.locator("#toasts").text_content()


def test_without_webgl_the_cameras_own_pictures_are_shown_and_not_straightened(chromium, station):
    flags = [*CHROMIUM_FLAGS, "--disable-software-rasterizer"]
    other = chromium.browser_type.launch(executable_path=BROWSER, args=flags)
    try:
        with serving(station) as served, opened(other, served.url, 1280, 720) as page:
            all_live(page)
            for key in "ve":
                page.locator("body").press(key)
            why = "The bird's-eye view cannot be drawn: this browser has no WebGL 2"
            until(lambda: why in page.inner_text("#toasts"))
            assert page.locator("#birdseye").is_hidden() and page.locator("[data-camera=top_rear]").is_visible()
            shot(page, "birdseye-failed")
            page.locator("body").press("e")
            assert page.locator("#birdseye").is_hidden()
            assert why in page.locator("#news").text_content()
            for key in "2l":
                page.locator("body").press(key)
            until(lambda: "cannot be straightened: this browser has no WebGL 2" in page.inner_text("#toasts"))
            until(lambda: page.evaluate("tod.measure()")["cameras"]["top_front"]["status"] == "live")
    finally:
        other.close()


def sides(pixels, view):
    """The ground to the left and right of the vehicle, below the labels."""
    px = view["px_per_m"]
    rows = slice(*(round(view["y"] - px * metres) for metres in (1.5, -0.5)))
    columns = (sorted(round(view["x"] - side * px * metres) for metres in (2, 8)) for side in (1, -1))
    return [pixels[rows, slice(*each)] for each in columns]


def bright(pixels):
    """Share of pixels as bright as a white field."""
    return (pixels.min(axis=-1) > 150).mean()


def red(pixels):
    return ((pixels[..., 0] > 120) & (pixels[..., 1] < 60)).mean()
