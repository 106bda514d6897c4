"""The operator's page in a real browser, on the real demo."""

from __future__ import annotations

import asyncio
import base64
import io
import json
import re
import socket
import subprocess
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress

import numpy as np
import pytest

from browser import (
    SCREENS,
    SharedPage,
    all_live,
    boxes,
    checked,
    luma,
    measure,
    opened,
    overlap,
    send,
    shot,
    sized,
    state,
    state_when,
    take_control,
    until,
    viewing,
    visit,
    visit_again,
    when,
)
from rig import WAIT_S, answers, free_port, needs_browser, passes, process
from runner.page.server import MAY_ASK

pytestmark = [pytest.mark.gst, needs_browser]
aiohttp = pytest.importorskip("aiohttp")
image = pytest.importorskip("PIL.Image")


SIZES = {  # quarters of the sides, to leave CPU time for the tests
    **dict.fromkeys(("front_left", "front_center", "front_right"), (480, 260)),
    "rear_center": (480, 300),
    **dict.fromkeys(("top_front", "top_left", "top_right", "top_rear"), (320, 200)),
}
TUM = tuple(SIZES)


HEADER = np.dtype(
    [("camera", "u1"), ("flags", "u1"), ("zero", "<u2"), ("sequence", "<u4"), ("captured", "<f8"), ("arrived", "<f8")]
)


@pytest.fixture(scope="module")
def demo():
    """Address of the page of a real demo: eight cameras, the synthetic drive, the map."""
    port = free_port()
    words = (
        f"page.port={port}",
        f"media.port={free_port()}",
        f"control.port={free_port()}",
        "control.expires_s=10",  # a busy machine delays requests ...
        "modes=open_loop",  # ... and packets, which would lower the measured link rate and so the total
        "duration_s=1200",
        "source.render.seconds=6",
        # tiny, and its size never changes
        "cameras.rear_center.rate_quality={scaling: [0.125], b_min_kbps: [0], b_full_kbps: 4000}",
        "fps_max=3",  # demo and page take two thirds of a processor while these tests run, nine tenths at 5 Hz
        *(f"cameras.{name}.width_px={width}" for name, (width, _) in SIZES.items()),
        *(f"cameras.{name}.height_px={height}" for name, (_, height) in SIZES.items()),
        "pqos.position.speed_mps=64",  # one loop in 13 s
    )
    with process("demo", *words, stdout=subprocess.DEVNULL) as child:
        until(lambda: answers(port) or child.poll() is not None, seconds=300)  # the drive may have to be rendered
        yield f"http://127.0.0.1:{port}/"
        child.terminate()
        child.wait(timeout=15)


@pytest.fixture(scope="module")
def shared(chromium, demo):
    shared = SharedPage(chromium, demo)
    yield shared
    shared.close()


@pytest.fixture
def page(shared, request):
    """The page that tests share, in control, and left as it was found."""
    page, failed = shared.open(), request.session.testsfailed
    with checked(page):
        all_live(page)
        if page.evaluate("tod.control") != "you":
            take_control(page)
        yield page
    if request.session.testsfailed > failed:
        shared.close()  # whatever this test has left behind
    else:
        restored(page)


@pytest.fixture
def fresh(shared, request):
    """A page that shows nothing of earlier tests; later ones share it."""
    shared.close()
    return request.getfixturevalue("page")


@pytest.fixture
def unshared(shared):
    """The page that tests share is closed: it takes a third of a processor while it is open."""
    shared.close()


def restored(page):
    viewing(page, "configure")
    choose(page, "automatic")
    page.evaluate("document.activeElement.blur()")
    sized(page, 1280, 800)


def run_in_thread(coroutine):
    """Run to completion in another thread, since this one is the browser's."""
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(asyncio.run, asyncio.wait_for(coroutine, 60)).result()


def pictures_continue(page, counted, pictures=2, seconds=WAIT_S):
    """Wait until every camera has drawn more than so many pictures since `counted`, and no decoder has failed."""

    def waiting():
        return {
            name: (counted[name], camera)
            for name, camera in measure(page).items()
            if camera["drawn"] <= counted[name]["drawn"] + pictures or camera["errors"]
        }

    with suppress(AssertionError):
        until(lambda: not waiting(), seconds)
    assert waiting() == {}


def choose(page, mode):
    """Choose a mode; as a user would, click again if the request expires on a busy machine."""

    def chosen():
        page.locator(f"#mode-{mode}").click()
        with suppress(AssertionError):
            return state_when(page, lambda now: now["mode"] == mode, seconds=10)

    return until(chosen)


def test_automatic_the_drop_of_the_map_lowers_factors(fresh):
    page = fresh
    choose(page, "automatic")
    high = state_when(page, lambda now: now["total_kbps"] > 6500, seconds=60)
    low = state_when(page, lambda now: now["total_kbps"] < 4000, seconds=60)
    lower = [name for name in TUM if low["cameras"][name]["scaling"] < high["cameras"][name]["scaling"]]
    assert {"front_left", "front_right"} <= set(lower)
    assert "front_center" not in lower
    sizes = {name: (low["cameras"][name]["height"], low["cameras"][name]["width"]) for name in lower}
    until(lambda: state(page)["total_kbps"] > 4000 or all(luma(page, name)[0].shape == sizes[name] for name in lower))
    note = r"Prediction \d+ kbit/s: .*front_left, front_right smaller, at quarter size"
    until(lambda: re.search(note, page.evaluate("document.querySelector('#news').innerText")))


def test_eight_pictures_move(page):
    before = {name: luma(page, name)[0] for name in TUM}
    pictures_continue(page, measure(page), pictures=10)
    for name in TUM:
        now, _ = luma(page, name)
        assert now.shape != before[name].shape or (now != before[name]).mean() > 0.1, name
    shot(page, "automatic")


def test_a_page_that_opens_shows_no_alarm_in_its_first_seconds(chromium, demo):
    silences = []

    def undisturbed():
        """Marks of a page, unless the vehicle fell silent since the last one: then its pictures are lost, rightly."""
        log, count = marks_of_opening(chromium, demo)
        silences.append(count)
        return log if silences[-2:] == [count, count] else None

    log = until(undisturbed)
    for camera in SIZES:
        marks = [(ms, mark) for ms, name, mark in log if name == camera]
        (began, first), live = marks[0], next(ms for ms, mark in marks if mark == "live")
        assert first == "synchronising"
        alarms = [(ms, mark) for ms, mark in marks if ms < live and mark in ("late", "damaged", "frozen")]
        assert all(ms - began >= 2900 for ms, _ in alarms), marks  # a machine may be that busy


def marks_of_opening(chromium, demo):
    """Of a page that opens, until all are live; and how often the vehicle has fallen silent by then."""
    with opened(chromium, demo) as page:
        all_live(page)
        log = page.evaluate("tod.measure()")["status_log"]
        return log, page.text_content("#news").count("the vehicle has been silent for")


def test_single_a_dragged_region_changes_the_received_picture(page):
    choose(page, "single")
    tile = page.locator("[data-camera=front_center] canvas[role=img]").bounding_box()
    full, _ = luma(page, "front_center")

    def at(x, y):
        return tile["x"] + x * tile["width"], tile["y"] + y * tile["height"]

    page.mouse.move(*at(0.25, 0.25))
    page.mouse.down()
    page.mouse.move(*at(0.5, 0.6), steps=4)
    page.mouse.move(*at(0.75, 0.75), steps=4)
    page.mouse.up()
    camera = state_when(page, lambda now: now["cameras"]["front_center"]["roi"]["x"] > 0)["cameras"]["front_center"]
    roi = camera["roi"]
    width, height = SIZES["front_center"]
    assert abs(roi["x"] - width / 4) < 8
    assert abs(roi["width"] - width / 2) < 10
    assert abs(roi["height"] - height / 2) < 10
    size = (camera["height"], camera["width"])
    assert size[0] < full.shape[0]
    until(lambda: luma(page, "front_center")[0].shape == size)
    shot(page, "single")
    # The picture is the middle of the previous one, as sharp as the factor allows.
    middle = full[full.shape[0] // 4 : -full.shape[0] // 4, full.shape[1] // 4 : -full.shape[1] // 4]
    assert middle.shape[0] == pytest.approx(size[0], abs=8)
    applied = state_when(page, lambda now: now["cameras"]["front_center"]["applied"]["roi"] == roi)
    assert applied["cameras"]["front_center"]["applied"]["size"] == {"width": size[1], "height": size[0]}
    reply = send(page, event="roi_set", camera="front_center", x=0, y=0, width=width, height=height)
    assert reply["result"] == "applied"
    until(lambda: luma(page, "front_center")[0].shape == full.shape)


def test_a_button_released_outside_the_picture_leaves_no_drag_behind(page):
    """The next click must not send a region of the smallest size."""
    choose(page, "single")
    tile = page.locator("[data-camera=front_center] canvas[role=img]").bounding_box()
    x, y = tile["x"] + tile["width"] / 2, tile["y"] + 2
    before = state(page)["cameras"]["front_center"]["roi"]
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x, tile["y"] - 100)
    page.mouse.up()
    page.mouse.move(x, y + 40, steps=4)
    page.mouse.move(x, y + 80, steps=4)
    page.mouse.click(x, y + 80)
    assert send(page, event="weights_set", weights={"front_center": 1})["result"] == "applied"  # after any region
    assert state(page)["cameras"]["front_center"]["roi"] == before


def test_single_numbers_and_sliders_set_one_camera(page):
    choose(page, "single")
    page.locator("[data-camera=top_left] .head b").click()
    field = page.locator("input[type=number][data-control=kbps]")
    field.fill("777")
    field.press("Enter")
    state_when(page, lambda now: now["cameras"]["top_left"]["applied"].get("bitrate") == 777)
    page.keyboard.press("1")  # is no further digit of the number
    assert page.evaluate("tod.selected") == TUM[0]
    before = until(field.input_value)  # empty while the vehicle is offline
    field.fill("999")
    field.press("Escape")
    assert page.evaluate("document.activeElement.tagName") == "BODY"
    until(lambda: field.input_value() == before)
    page.keyboard.press("2")
    page.keyboard.press("1")
    until(lambda: field.input_value() == before)  # nothing was sent


@pytest.mark.parametrize("mode", ["automatic", pytest.param("collective", marks=pytest.mark.soak)])
def test_a_camera_switched_off_frees_its_share(page, mode):
    before = choose(page, mode)
    toggle = page.locator("[data-camera=rear_center] .switch")
    toggle.click()
    off = state_when(page, lambda now: not now["cameras"]["rear_center"]["on"])
    shares = [now["cameras"]["front_left"]["kbps"] / now["total_kbps"] for now in (before, off)]
    assert shares[1] > shares[0] * 1.05
    until(lambda: measure(page)["rear_center"]["status"] == "off")
    shot(page, f"{mode}-rear-off")
    toggle.click()
    state_when(page, lambda now: now["cameras"]["rear_center"]["on"])
    until(lambda: measure(page)["rear_center"]["status"] == "live")


def test_collective_the_slider_changes_all(page):
    before = choose(page, "collective")
    slider = page.locator("[data-control=total-slider]")
    slider.click()  # as a drag ends
    assert slider.evaluate("range => range !== document.activeElement"), "arrow keys select cameras"
    slider.focus()
    for _ in range(3):
        slider.press("PageDown")
    state_when(page, lambda now: now["total_kbps"] < before["total_kbps"] / 2)
    after = state_when(
        page, lambda now: now["total_kbps"] == page.evaluate("+document.querySelector('#total-kbps').value")
    )
    assert all(after["cameras"][name]["kbps"] < before["cameras"][name]["kbps"] for name in TUM)
    state_when(page, lambda now: all(c["applied"].get("bitrate") == c["kbps"] for c in now["cameras"].values()))
    shot(page, "collective")


def test_a_reload_keeps_control_history_and_mode(page):
    choose(page, "collective")
    before = page.evaluate("tod.history.time.length")
    visit_again(page)
    when(page, "window.tod && tod.state && tod.history")
    all_live(page)
    assert page.evaluate("tod.history.time.length") >= before
    until(lambda: page.evaluate("tod.control") == "you")
    assert state(page)["mode"] == "collective"


def test_charts_and_map_are_drawn(page):
    page.set_viewport_size({"width": 1920, "height": 1080})
    until(lambda: page.evaluate("document.querySelectorAll('.js-plotly-plot').length >= 4"))
    shot(page, "wide")
    page.locator("#theme").click()
    time.sleep(1.0)  # until redrawn
    shot(page, "wide-other-theme")
    page.locator("#theme").click()


def test_invalid_requests_are_refused_with_a_reason(page):
    choose(page, "automatic")
    wrong = [
        ({"event": "total_set", "kbps": 3000}, "total_set is accepted in mode collective only, the mode is automatic"),
        (
            {"event": "camera_switched", "camera": "rear_centre", "on": True},
            "unknown camera 'rear_centre', did you mean rear_center?",
        ),
        ({"event": "weights_set", "weights": {"rear_center": -1}}, "weights.rear_center: -1: must be at least 0"),
        (
            {"event": "operator_disconnected"},
            f"event: 'operator_disconnected': must be one of {', '.join(sorted(MAY_ASK))}",
        ),
    ]
    for event, reason in wrong:
        reply = send(page, **event)
        assert (reply["result"], reply["reason"]) == ("refused", reason)
    choose(page, "single")
    reply = send(page, event="roi_set", camera="front_left", x=420, y=0, width=100, height=100)
    assert reply["result"] == "refused"
    assert "ROI 100x100 at 420,0" in reply["reason"]


def test_invalid_messages_do_not_disturb_the_streams(page, demo):
    async def attack():
        answers = []
        async with (
            aiohttp.ClientSession() as session,
            session.ws_connect(f"{demo}live?viewer=stranger", origin=demo.rstrip("/"), max_msg_size=0) as ws,
        ):
            for text in (
                "",
                "{",
                "[1]",
                '{"id": "1"}',
                '{"id": 7, "event": "total_set"}',
                '{"id": "x", "event": ["a"]}',
                '{"id": "1", "event": "mode_selected", "mode": "single"}',
                "[" * 60_000,
                "x" * 100_000,
                '{"resync": "nobody"}',
                '{"clock": NaN}',
                '{"clock": "now"}',
                '{"take_control": "yes"}',
            ):
                await ws.send_str(text)
            await ws.send_bytes(b"\xff\x00")  # as if it spoke, which is not answered
            while len(answers) < 13:
                message = await asyncio.wait_for(ws.receive(), 10)
                if message.type == aiohttp.WSMsgType.TEXT and '"reply"' in message.data:
                    answers.append(json.loads(message.data))
            with suppress(ConnectionError):  # closed before all of it is sent
                await ws.send_bytes(b"x" * 2_000_000)
            while (message := await asyncio.wait_for(ws.receive(), 10)).type not in (
                aiohttp.WSMsgType.CLOSE,
                aiohttp.WSMsgType.CLOSED,
            ):
                pass
            return answers, ws.close_code

    counted = measure(page)
    answers, code = run_in_thread(attack())
    assert {answer["result"] for answer in answers} == {"refused"}
    assert answers[6]["reason"] == "this page does not hold control; take it first"
    assert answers[8]["reason"] == "100000 bytes: must be at most 65536"
    assert code in (1009, 1006)  # message too big, or closed while it was being sent
    pictures_continue(page, counted)
    until(lambda: page.evaluate("tod.control") == "you")


def test_a_viewer_that_does_not_read_disturbs_no_other(page, demo):
    counted = measure(page)
    with upgraded(demo, "lazy"):
        time.sleep(6)
    pictures_continue(page, counted, pictures=20)


def test_another_page_watches_and_may_take_control(chromium, demo, page):
    with opened(chromium, demo) as other:
        all_live(other)
        until(lambda: other.evaluate("tod.control") == "another")
        assert (
            send(other, event="mode_selected", mode="single")["reason"]
            == "this page does not hold control; take it first"
        )
        shot(other, "watching")
        take_control(other)
        until(lambda: page.evaluate("tod.control === 'another'"))
    until(lambda: page.evaluate("tod.control === 'nobody'"))
    take_control(page)


def test_a_duplicated_page_only_watches(page):
    with page.expect_popup() as opening:
        page.evaluate("void open(location.href)")  # copies the storage of its tab, as duplicating a tab does
    copy = opening.value
    until(lambda: copy.evaluate("window.tod?.state"))
    until(lambda: copy.evaluate("tod.control") == "another")
    copy.close()
    until(lambda: page.evaluate("tod.control") == "you")


def test_keys_choose_modes_cameras_and_help(page):
    page.locator("body").press("Shift+C")
    state_when(page, lambda now: now["mode"] == "collective")
    page.locator("body").press("4")
    page.locator("body").press("o")
    state_when(page, lambda now: not now["cameras"]["rear_center"]["on"])
    page.locator("body").press("o")
    state_when(page, lambda now: now["cameras"]["rear_center"]["on"])
    page.locator("body").press("?")
    page.wait_for_selector("dialog[open]")
    shot(page, "help")
    page.keyboard.press("Escape")
    page.wait_for_selector("dialog[open]", state="hidden")


NAMED = (
    "article",
    "button",
    "dialog",
    "figure",
    "image",
    "radio",
    "radiogroup",
    "slider",
    "spinbutton",
    "switch",
    "tab",
)


def test_every_control_has_a_name_for_screen_readers(page):
    """In both views; screen readers ignore the name of an element without a role."""
    reader = page.context.new_cdp_session(page)

    def nameless(least):
        nodes = reader.send("Accessibility.getFullAXTree")["nodes"]
        found = [node for node in nodes if not node["ignored"] and node["role"]["value"] in NAMED]
        assert len(found) >= least
        return [described(node) for node in found if not node.get("name", {}).get("value", "").strip()]

    def described(node):
        element = reader.send("DOM.describeNode", {"backendNodeId": node["backendDOMNodeId"]})["node"]
        return node["role"]["value"], element["nodeName"], element.get("attributes")

    without_role = page.locator("[aria-label]:is(div, span, p, i, b):not([role])")
    assert without_role.evaluate_all("all => all.map(({ outerHTML }) => outerHTML.slice(0, 99))") == []
    page.locator("#tab-charts").click()
    assert nameless(least=40) == []
    viewing(page, "drive")
    page.locator("body").press("d")
    assert nameless(least=40) == []
    page.locator("body").press("?")
    page.wait_for_selector("dialog[open]")
    assert nameless(least=2) == []
    page.keyboard.press("Escape")
    page.wait_for_selector("dialog[open]", state="hidden")
    page.locator("#tab-camera").click()


def whole(page):
    """Boxes of the pictures, after checking that none overlap and nothing is cut off."""
    pictures, wrong = boxes(page)
    assert wrong == {"outside": [], "cut": [], "low": [], "scrolls": False}, page.viewport_size
    assert set(pictures) == set(TUM)
    assert [(a, b) for a in TUM for b in TUM if a < b and overlap(pictures[a], pictures[b])] == []
    return pictures


def test_drive_the_front_camera_is_large_and_nothing_is_cut_off(fresh):
    page = fresh
    page.locator("#offer-drive").click()
    assert page.locator("#offer").is_hidden()
    assert page.evaluate("tod.view") == "drive"
    for width, height in SCREENS[:2]:  # the others in test_a_view_fits_every_screen
        sized(page, width, height)
        front = whole(page)["front_center"]
        assert front["width"] * front["height"] >= 0.4 * width * height, (width, height)
        page.locator("body").press("d")
        assert page.locator("#side").is_visible()
        whole(page)
        page.locator("body").press("d")
        assert not page.locator("#side").is_visible()
    sized(page, 1920, 1080)
    shot(page, "drive")


def test_drive_shows_what_a_driver_must_not_miss(page):
    viewing(page, "drive")
    until(lambda: re.fullmatch(r"\d+ ± \d+ ms", page.inner_text("#worst")))
    until(lambda: page.inner_text("#worst-of").removeprefix("worst: ").replace(" ", "_") in TUM)
    until(lambda: page.inner_text("#driven") == "230 km/h")  # 64 m/s
    until(lambda: re.fullmatch(r"[NESW]{1,2} \d+°", page.inner_text("#heading")))
    assert page.inner_text("#advised") == "no speed advised"
    shape = """level => {
      const figure = document.querySelector("#speed-now");
      figure.dataset.level = level;
      return getComputedStyle(figure.firstElementChild, "::after").content;
    }"""
    assert [page.evaluate(shape, level) for level in ("fine", "near")] == ["none", '" ▲"'], "not by colour alone"
    until(lambda: re.match(r"Automatic · \d+( of \d+)? kbit/s · \w+", page.inner_text("#line")))

    def reports_its_return():
        """The browser may focus the page by itself meanwhile, when a page of another test is closed."""
        page.evaluate("dispatchEvent(new Event('blur'))")
        # On a busy machine the page may be slow at any time, which takes precedence.
        until(lambda: page.inner_text("#attention") == "OUT OF FOCUS: keys do not reach this page; click it")
        time.sleep(0.6)  # a shorter absence is not reported
        page.evaluate("dispatchEvent(new Event('focus'))")
        until(page.locator("#attention").is_hidden)
        return passes(lambda: re.search(r"No key reached this page for \d+ s", page.inner_text("#toasts")), seconds=2)

    until(reports_its_return)


def test_drive_is_offered_once_and_only_the_driver_changes_the_view(chromium, demo, fresh):
    page = fresh
    offer = page.locator("#offer")
    offer.wait_for(state="visible")
    page.locator("#offer-no").click()
    assert offer.is_hidden()
    with opened(chromium, demo) as other:
        take_control(other)
        until(lambda: page.evaluate("tod.control") == "another")
    take_control(page)
    assert (offer.is_hidden(), page.evaluate("tod.view")) == (True, "configure")
    page.keyboard.down("v")
    page.keyboard.down("v")  # held: a repeated key
    page.keyboard.up("v")
    assert page.evaluate("tod.view") == "drive"
    page.locator("#drive-control").click()
    until(lambda: "the vehicle must stand before its control is released" in page.inner_text("#toasts"))
    page.reload()
    when(page, "window.tod?.control === 'you'")
    assert (offer.is_hidden(), page.evaluate("tod.view")) == (True, "drive")
    page.locator("#to-configure").click()
    assert (offer.is_hidden(), page.evaluate("tod.view")) == (True, "configure")


def test_keys_of_the_drive_view(page):
    viewing(page, "drive")
    box = {name: page.locator(f"[data-camera={name}]").bounding_box() for name in TUM}

    def selected_by(key):
        page.keyboard.press(key)
        return page.locator(".tile.selected").get_attribute("data-camera")

    def is_at(camera, place):
        """Waits, since a banner may still move the pictures."""
        until(lambda: page.locator(f"[data-camera={camera}]").bounding_box() == box[place])

    keys = ("ArrowLeft", "ArrowUp", "ArrowRight", "ArrowDown")
    assert [selected_by(key) for key in keys] == ["front_left", "front_center", "front_right", "rear_center"]
    page.keyboard.press("Enter")
    is_at("rear_center", "front_center")
    is_at("front_center", "rear_center")
    page.keyboard.press("Escape")
    is_at("rear_center", "rear_center")
    for front, rear in (("rear_center", "front_center"), ("front_center", "rear_center")):  # backwards, and forwards
        assert selected_by("r") == front
        is_at(front, "front_center")
        is_at(rear, "rear_center")
    page.keyboard.press("r")
    assert selected_by("ArrowLeft") == "front_left"  # a look aside
    page.wait_for_timeout(200)
    is_at("rear_center", "front_center")
    is_at("front_left", "front_left")
    page.keyboard.press("Escape")
    is_at("rear_center", "rear_center")
    page.keyboard.press("p")
    assert page.locator("#map-panel").is_visible()
    page.keyboard.press("p")
    assert not page.locator("#map-panel").is_visible()
    page.evaluate("navigator.keyboard.lock = async (keys) => void (globalThis.locked = keys)")
    page.keyboard.press("Shift+F")
    until(lambda: page.evaluate("document.fullscreenElement !== null"))
    until(lambda: page.evaluate("globalThis.locked") == ["Escape"])
    page.keyboard.press("Shift+F")
    until(lambda: page.evaluate("document.fullscreenElement === null"))


@pytest.mark.soak  # 13 s; tests/js/framing.test.js covers the arithmetic
def test_regions_dragged_in_mirrored_pictures_map_to_the_image(page):
    choose(page, "single")
    viewing(page, "drive")
    sized(page, 1920, 1080)
    until(lambda: likeness(page, "rear_center", mirrored=True) > 0.8 > likeness(page, "rear_center", mirrored=False))
    assert drag(page, "rear_center", (0.1, 0.2), (0.4, 0.7)) == pytest.approx([288, 60, 144, 150], abs=6)
    assert page.inner_text("[data-camera=front_left] .shown") == "", "it is whole"
    assert drag(page, "front_left", (0.25, 0.25), (0.75, 0.75)) == pytest.approx([120, 65, 240, 130], abs=6)
    plain, mirrored = (lost_alarm(page, is_mirrored) for is_mirrored in ("false", "true"))
    assert np.abs(plain - mirrored[:, ::-1]).mean() < 0.1 * np.abs(plain - mirrored).mean()


def likeness(page, camera, mirrored):
    """Correlation of a camera's picture with its screenshot; low if the picture has changed in between."""
    picture, _ = luma(page, camera)
    png = page.locator(f"[data-camera={camera}] canvas[role=img]").screenshot()
    seen = np.asarray(image.open(io.BytesIO(png)).convert("L").resize(picture.shape[::-1]), float)
    return np.corrcoef(seen.ravel(), (picture[:, ::-1] if mirrored else picture).ravel())[0, 1]


def drag(page, camera, begin, end):
    """Drag a region between two points of the box, in fractions of its sides; returns the region and resets it."""
    box = page.locator(f"[data-camera={camera}] .picture").bounding_box()
    a, b = ((box["x"] + x * box["width"], box["y"] + y * box["height"]) for x, y in (begin, end))
    page.mouse.move(*a)
    page.mouse.down()
    page.mouse.move(*b, steps=4)
    page.mouse.up()
    full = dict(zip(("width", "height"), SIZES[camera], strict=True))
    roi = state_when(page, lambda now: now["cameras"][camera]["roi"]["width"] < full["width"])["cameras"][camera]["roi"]
    assert send(page, event="roi_set", camera=camera, x=0, y=0, **full)["result"] == "applied"
    return [roi[side] for side in ("x", "y", "width", "height")]


def lost_alarm(page, mirrored):
    """An alarm as drawn into a canvas that is mirrored on the screen or not."""
    found = page.evaluate(f"""import("/static/overlay.js").then(({{ drawOverlay }}) => {{
      const context = new OffscreenCanvas(600, 300).getContext("2d", {{ willReadFrequently: true }});
      drawOverlay(context, {{ x: 0, y: 0, width: 600, height: 300 }}, {mirrored}, "lost", "LOST 7 s", 1);
      return Array.from(context.getImageData(0, 0, 600, 300).data.filter((_, i) => i % 4 === 1));
    }})""")
    return np.reshape(found, (300, 600)).astype(float)


@contextmanager
def upgraded(url, viewer):
    """A raw socket, upgraded to a WebSocket as a viewer."""
    host = url.removeprefix("http://").rstrip("/")
    with socket.create_connection(("127.0.0.1", int(host.rpartition(":")[2])), timeout=20) as line:
        line.sendall(
            f"GET /live?viewer={viewer} HTTP/1.1\r\nHost: {host}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
            "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\nSec-WebSocket-Version: 13\r\n\r\n".encode()
        )
        yield line


CODECS = (
    ("h264", "6742c01e", "avc1.42c01e"),
    ("h264", "67640028", "avc1.640028"),
    ("h265", "42010101600000030090000003000003005d", "hev1.1.6.L93.90"),  # x265, Main
    ("h265", "42010102200000030090000003000003007b", "hev1.2.4.L123.90"),  # x265, Main 10
    ("h265", "420101214000000300b0000003000003009999", "hev1.1.2.H153.B0"),
)


def test_the_codec_string_is_valid_for_webcodecs(page):
    for codec, start, string in CODECS:
        unit = [0, 0, 0, 1, *bytes.fromhex(start), 0xA0]
        words = f"(m) => m.codecOf(m.spsOf(new Uint8Array({unit}), '{codec}'), '{codec}')"
        assert page.evaluate(f"import('/static/codec.js').then({words})") == string


# --- without the page that the tests above share ------------------------------------------------------------------


def test_a_page_opened_mid_drive_starts_with_intact_pictures(chromium, demo, unshared):
    """Compares the first drawn picture of each camera with a clean decode; in mode single sizes do not change."""
    single = ({"take_control": True}, {"id": "1", "event": "mode_selected", "mode": "single"})
    with recorded(demo, *single, viewer="holder"):
        time.sleep(1.5)  # until size changes have settled
        with recorded(demo) as units:
            time.sleep(4)
            with opened(chromium, f"{demo}#measure") as late:
                until(lambda: all(camera["first_drawn_ms"] for camera in measure(late).values()))
                first = {name: camera["first_drawn_ms"] for name, camera in measure(late).items()}
                assert max(first.values()) < 10_000, first  # ten times the normal time
                pictures = {name: luma_first(late, name) for name in TUM}
                until(lambda: late.evaluate("tod.control") == "another")
            time.sleep(0.5)
    errors = {}
    for number, name in enumerate(TUM):
        drawn, captured = pictures[name]
        clean = decoded([data for _, data in units[number]], drawn.shape)
        at = next(n for n, (ms, _) in enumerate(units[number]) if abs(ms - captured) < 0.01)
        errors[name] = np.mean((clean[at].astype(float) - drawn) ** 2)
    assert max(errors.values()) < 255**2 / 10**4, errors  # 40 dB


def luma_first(page, camera):
    """The first picture drawn of a camera."""
    picture = page.evaluate(f"tod.first('{camera}')")
    data = np.frombuffer(base64.b64decode(picture["luma"]), np.uint8)
    return data.reshape(picture["height"], picture["width"]), picture["captured"]


@contextmanager
def recorded(url, *orders, viewer="recorder"):
    """Every unit that a watching page receives: by camera, (captured ms, data)."""
    units, stopped = [[] for _ in TUM], threading.Event()

    async def watch():
        async with (
            aiohttp.ClientSession() as session,
            session.ws_connect(f"{url}live?viewer={viewer}", origin=url.rstrip("/"), max_msg_size=0) as ws,
        ):
            for order in orders:
                await ws.send_json(order)
            while not stopped.is_set():
                message = await ws.receive()
                if message.type == aiohttp.WSMsgType.BINARY:
                    header = np.frombuffer(message.data[: HEADER.itemsize], HEADER)[0]
                    units[header["camera"]].append((float(header["captured"]), message.data[HEADER.itemsize :]))

    thread = threading.Thread(target=lambda: asyncio.run(watch()))
    thread.start()
    try:
        yield units
    finally:
        stopped.set()
        thread.join()


def decoded(units, shape):
    """Luma of every unit, decoded by ffmpeg."""
    command = ["ffmpeg", "-v", "error", "-threads", "1", "-f", "h264", "-i", "-", "-fps_mode", "passthrough"]
    command += ["-f", "rawvideo", "-pix_fmt", "yuv420p", "-"]
    data = subprocess.run(command, input=b"".join(units), capture_output=True, check=True).stdout
    height, width = shape
    pictures = np.frombuffer(data, np.uint8).reshape(-1, height * width * 3 // 2)
    assert len(pictures) == len(units)
    return pictures[:, : height * width].reshape(-1, height, width)


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({}, 200),
        ({"Origin": "http://evil.example"}, 403),
        ({"Host": "evil.example"}, 403),
    ],
)
def test_only_pages_of_this_server_have_access(demo, unshared, headers, status):
    async def ask():
        async with aiohttp.ClientSession() as session, session.get(demo, headers=headers) as answer:
            return answer.status, answer.headers.get("Content-Security-Policy")

    answered, policy = run_in_thread(ask())
    assert answered == status
    if status == 200:
        assert "default-src 'self'" in policy


def test_without_webcodecs_a_message_names_the_requirement(chromium, demo, unshared):
    with chromium.new_context() as tab:
        tab.add_init_script("delete window.VideoDecoder")
        blind = tab.new_page()
        visit(blind, demo)
        until(lambda: "WebCodecs" in blind.inner_text("body"))
        assert "Chromium" in blind.inner_text("body")


def test_a_viewer_that_does_not_answer_pings_is_dropped(demo, unshared):
    with upgraded(demo, "silent") as viewer:
        began = time.monotonic()
        with suppress(ConnectionResetError):
            while viewer.recv(65_536):  # reads but sends nothing
                pass
        assert 1 < time.monotonic() - began < 20


def test_a_slow_viewer_that_answers_pings_stays_connected(demo, unshared):
    async def watch():
        read = 0
        async with (
            aiohttp.ClientSession() as session,
            session.ws_connect(f"{demo}live?viewer=slow", origin=demo.rstrip("/"), max_msg_size=0) as ws,
        ):
            until = time.monotonic() + 6
            while time.monotonic() < until:
                message = await ws.receive()
                assert message.type in (aiohttp.WSMsgType.TEXT, aiohttp.WSMsgType.BINARY)
                read += len(message.data)
                await asyncio.sleep(len(message.data) / 50_000)  # 400 kbit/s
        return read

    assert run_in_thread(watch()) > 100_000


@pytest.fixture(scope="module")
def stopped(shared, chromium, demo):
    """A page whose worker was stopped in the drive view; it counts its tones."""
    shared.close()
    with opened(chromium, demo) as page:
        all_live(page)
        take_control(page)
        viewing(page, "drive")  # the key press allows the page to play sound
        count = "start(at) { globalThis.tones = (globalThis.tones ?? 0) + 1; super.start(at); }"
        page.evaluate(f"void (OscillatorNode = class extends OscillatorNode {{ {count} }})")
        until(lambda: page.inner_text("#sound") == "Mute tones")
        page.evaluate("boot.worker.terminate()")
        yield page


def test_stalled_pictures_are_named_and_sounded_in_the_drive_view(stopped):
    page = stopped
    until(lambda: page.inner_text("#worst-of") == "8 of 8 pictures not live")
    until(lambda: page.inner_text("#alarms").startswith("✕ LOST front left, front center"))  # frozen until it is lost
    assert page.inner_text("#worst") == "– ms"
    assert {*page.locator(".tile .status").all_inner_texts()} == {"✕ LOST"}, "the worker cannot mark the pictures"
    frame = "getComputedStyle(document.querySelector('.tile .picture'), '::after').borderTopWidth"
    assert page.evaluate(frame) == "4px"
    assert page.get_attribute("#latency", "data-level") == "late"
    until(lambda: page.evaluate("globalThis.tones >= 4"))


def test_without_its_worker_a_page_shows_no_camera_as_live(stopped):
    page = stopped
    viewing(page, "configure")
    page.wait_for_selector("#banner:not([hidden])")
    expected = "✕ VIDEO STOPPED: the page's worker does not respond; reload the page"
    assert page.inner_text("#banner") == expected
    assert {text.split()[1] for text in page.locator("[data-camera] .status").all_inner_texts()} == {"LOST"}
