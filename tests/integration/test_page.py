"""The operator's page in a real browser, on the real demo."""

from __future__ import annotations

import asyncio
import base64
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path

import numpy as np
import pytest

import rig
from rig import CHECKOUT, CHROMIUM_FLAGS, answers, free_port, process
from runner.core.model import Endpoint
from runner.mqtt.broker import private_broker
from runner.page.server import EVENTS

pytestmark = [pytest.mark.gst, pytest.mark.skipif(not shutil.which("chromium"), reason="needs chromium")]
aiohttp = pytest.importorskip("aiohttp")
sync_api = pytest.importorskip("playwright.sync_api")

SCREENSHOTS = Path(os.environ.get("TOD_SCREENSHOTS", "/tmp/tod-runner-screenshots"))
TUM = ("front_left", "front_center", "front_right", "rear_center", "top_front", "top_left", "top_right", "top_rear")
ROBOT = ("vehicle=delivery_robot", "source=test", "fps_max=15", "pqos=constant", "pqos.kbps=3000")
HEADER = np.dtype(
    [("camera", "u1"), ("flags", "u1"), ("zero", "<u2"), ("sequence", "<u4"), ("captured", "<f8"), ("arrived", "<f8")]
)


until = partial(rig.until, every_s=0.1)  # asking a browser costs it time


@pytest.fixture(scope="module")
def chromium():
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=CHROMIUM_FLAGS)
        yield browser
        browser.close()


@pytest.fixture(scope="module")
def demo():
    """Address of the page of a real demo: eight cameras, the synthetic drive, the map."""
    port = free_port()
    words = (
        f"page.port={port}",
        f"media.port={free_port()}",
        f"control.port={free_port()}",
        "duration_s=1200",
        "fps_max=5",
        "pqos.position.speed_mps=16",  # the loop in half a minute
    )
    # 5 Hz: two cores that also run the tests have time to spare, so that counts say something
    with process("demo", *words, stdout=subprocess.DEVNULL) as child:
        until(lambda: answers(port) or child.poll() is not None, seconds=300)  # the drive may have to be rendered
        yield f"http://127.0.0.1:{port}/"
        child.terminate()
        child.wait(timeout=15)


@contextmanager
def opened(browser, url, width=1280, height=800, refused=False, **context):
    """A page in a browser of its own, which must stay free of errors and ask no other host.

    refused  the station goes away meanwhile, which the browser tells for each request
    """
    with browser.new_context(viewport={"width": width, "height": height}, **context) as tab:
        page = tab.new_page()
        wrong, own = [], (url.partition("#")[0], "data:", "blob:")
        page.on("pageerror", lambda error: wrong.append(str(error)))
        page.on("console", lambda message: wrong.append(message.text) if message.type == "error" else None)
        page.on("request", lambda asked: asked.url.startswith(own) or wrong.append(asked.url))
        page.goto(url)
        until(lambda: page.evaluate("window.tod !== undefined"))
        yield page
        expected = ("WebSocket connection", *(["net::ERR_CONNECTION_REFUSED"] if refused else []))
        assert [text for text in wrong if not any(each in text for each in expected)] == []


@pytest.fixture
def page(chromium, demo):
    with opened(chromium, demo) as page:
        all_live(page)
        if page.evaluate("tod.control") != "you":
            take_control(page)
        yield page
        choose(page, "automatic")


def apart(coroutine):
    """Run to its end in a thread of its own, since this one is the browser's."""
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(asyncio.run, coroutine).result(timeout=60)


def take_control(page):
    def taken():
        """A person would click again where the page was just connecting."""
        if (holder := page.evaluate("tod.control")) == "you":
            return True
        page.locator("#take-control").click()
        if holder == "another":  # asked once more
            page.locator("#confirm-yes").click()
        return rig.passes(lambda: page.evaluate("tod.control === 'you'"), seconds=2)

    until(taken)


def measure(page):
    return until(lambda: page.evaluate("tod.measure()")["cameras"])  # empty before the introduction


def all_live(page, seconds=30):
    """Every camera has been live; on a busy machine hardly ever all at the very same moment."""
    waiting = set(measure(page))

    def seen():
        waiting.difference_update(name for name, camera in measure(page).items() if camera["status"] == "live")
        return not waiting

    if not rig.passes(seen, seconds):
        assert {name: camera for name, camera in measure(page).items() if name in waiting} == {}, page.evaluate(
            "[tod.state, tod.sample, tod.measure()]"
        )


def goes_on(page, counted, pictures=2, seconds=5):
    """Every camera draws more than so many pictures after it was counted, and no decoder fails."""

    def waiting():
        return {
            name: (counted[name], camera)
            for name, camera in measure(page).items()
            if camera["drawn"] <= counted[name]["drawn"] + pictures or camera["errors"]
        }

    with suppress(AssertionError):
        until(lambda: not waiting(), seconds)
    assert waiting() == {}


def state(page):
    return page.evaluate("tod.state")


def state_when(page, wanted, seconds=15):
    return until(lambda: (now := state(page)) and now["online"] and wanted(now) and now, seconds)


def choose(page, mode):
    page.locator(f"#mode-{mode}").click()
    return state_when(page, lambda now: now["mode"] == mode)


def luma(page, camera):
    """The picture that was drawn last: its luma, and when it was captured, ms."""
    picture = page.evaluate(f"tod.picture('{camera}')")
    width, height = picture["width"], picture["height"]
    data = np.frombuffer(base64.b64decode(picture["luma"]), np.uint8)
    return data.reshape(height, width), picture["captured"]


def shot(page, name):
    SCREENSHOTS.mkdir(parents=True, exist_ok=True)
    page.screenshot(path=SCREENSHOTS / f"{name}.png")


def send(page, **event):
    """A request as the page sends it; its answer."""
    return page.evaluate("event => tod.request(event)", event)


def test_eight_pictures_move(page):
    before = {name: luma(page, name)[0] for name in TUM}
    goes_on(page, measure(page), pictures=10)
    for name in TUM:
        now, _ = luma(page, name)
        assert now.shape != before[name].shape or (now != before[name]).mean() > 0.1, name
    shot(page, "automatic")


def test_single_a_dragged_region_changes_what_is_received(page):
    choose(page, "single")
    tile = page.locator("[data-camera=front_center] canvas").bounding_box()
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
    assert abs(roi["x"] - 480) < 30
    assert abs(roi["width"] - 960) < 40
    assert abs(roi["height"] - 520) < 40
    size = (camera["height"], camera["width"])
    assert size[0] < full.shape[0]
    until(lambda: luma(page, "front_center")[0].shape == size)
    shot(page, "single")
    # What is seen is the middle of what was seen, as sharp as the factor allows.
    middle = full[full.shape[0] // 4 : -full.shape[0] // 4, full.shape[1] // 4 : -full.shape[1] // 4]
    assert middle.shape[0] == pytest.approx(size[0], abs=16)
    applied = state_when(page, lambda now: now["cameras"]["front_center"]["applied"]["roi"] == roi)
    assert applied["cameras"]["front_center"]["applied"]["size"] == {"width": size[1], "height": size[0]}
    reply = send(page, event="roi_set", camera="front_center", x=0, y=0, width=1920, height=1040)
    assert reply["result"] == "applied"
    until(lambda: luma(page, "front_center")[0].shape == full.shape)


def test_single_numbers_and_sliders_set_one_camera(page):
    choose(page, "single")
    page.locator("[data-camera=top_left] .head b").click()
    field = page.locator("input[type=number][data-control=kbps]")
    field.fill("777")
    field.press("Enter")
    state_when(page, lambda now: now["cameras"]["top_left"]["applied"].get("bitrate") == 777)


@pytest.mark.parametrize("mode", ["automatic", "collective"])
def test_a_camera_that_is_off_frees_its_share(page, mode):
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


def test_automatic_the_drop_of_the_map_lowers_factors(page):
    choose(page, "automatic")
    high = state_when(page, lambda now: now["total_kbps"] > 6500, seconds=60)
    low = state_when(page, lambda now: now["total_kbps"] < 4000, seconds=60)
    lower = [name for name in TUM if low["cameras"][name]["scaling"] < high["cameras"][name]["scaling"]]
    assert {"front_left", "front_right"} <= set(lower)
    assert "front_center" not in lower
    sizes = {name: (low["cameras"][name]["height"], low["cameras"][name]["width"]) for name in lower}
    until(lambda: state(page)["total_kbps"] > 4000 or all(luma(page, name)[0].shape == sizes[name] for name in lower))
    note = r"Prediction \d+ kbit/s: .*front_left, front_right 0\.5 -> 0\.25"
    until(lambda: re.search(note, page.evaluate("document.querySelector('#news').innerText")))


def test_a_page_opened_in_the_middle_of_a_drive_begins_with_true_pictures(chromium, demo):
    """The first drawn picture of each camera against a clean decode, in mode single: sizes stay."""
    single = ({"take_control": True}, {"id": "1", "event": "mode_selected", "mode": "single"})
    with recorded(demo, *single, viewer="holder"):
        time.sleep(1.5)  # what changes its size just then has done so
        with recorded(demo) as units:
            time.sleep(4)
            with opened(chromium, f"{demo}#measure") as late:
                until(lambda: all(camera["first_drawn_ms"] for camera in measure(late).values()))
                first = {name: camera["first_drawn_ms"] for name, camera in measure(late).items()}
                assert max(first.values()) < 10_000, first  # ten times what it takes
                pictures = {name: luma_first(late, name) for name in TUM}
                assert late.evaluate("tod.control") == "another"
            time.sleep(0.5)
    errors = {}
    for number, name in enumerate(TUM):
        drawn, captured = pictures[name]
        clean = decoded([data for _, data in units[number]], drawn.shape)
        at = next(n for n, (ms, _) in enumerate(units[number]) if abs(ms - captured) < 0.01)
        errors[name] = np.mean((clean[at].astype(float) - drawn) ** 2)
    assert max(errors.values()) < 255**2 / 10**4, errors  # 40 dB


def luma_first(page, camera):
    """The first picture that was ever drawn of a camera."""
    picture = page.evaluate(f"tod.first('{camera}')")
    data = np.frombuffer(base64.b64decode(picture["luma"]), np.uint8)
    return data.reshape(picture["height"], picture["width"]), picture["captured"]


@contextmanager
def recorded(url, *orders, viewer="recorder"):
    """Every unit of every camera as a watching page gets it: by camera, (captured ms, data)."""
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
    """Luma of every unit, decoded by another decoder."""
    command = ["ffmpeg", "-v", "error", "-threads", "1", "-f", "h264", "-i", "-", "-fps_mode", "passthrough"]
    command += ["-f", "rawvideo", "-pix_fmt", "yuv420p", "-"]
    data = subprocess.run(command, input=b"".join(units), capture_output=True, check=True).stdout
    height, width = shape
    pictures = np.frombuffer(data, np.uint8).reshape(-1, height * width * 3 // 2)
    assert len(pictures) == len(units)
    return pictures[:, : height * width].reshape(-1, height, width)


def test_a_reload_loses_nothing(page):
    choose(page, "collective")
    before = page.evaluate("tod.history.time.length")
    page.reload()
    until(lambda: page.evaluate("window.tod !== undefined && tod.state && tod.history"))
    all_live(page)
    assert page.evaluate("tod.history.time.length") >= before
    assert page.evaluate("tod.control") == "you"
    assert state(page)["mode"] == "collective"


def test_charts_and_map_are_drawn(page):
    page.set_viewport_size({"width": 1920, "height": 1080})
    until(lambda: page.evaluate("document.querySelectorAll('.js-plotly-plot').length >= 4"), seconds=30)
    time.sleep(3)
    shot(page, "wide")
    page.locator("#theme").click()
    time.sleep(1.5)
    shot(page, "wide-other-theme")
    page.locator("#theme").click()


def test_requests_that_are_wrong_are_refused_with_the_reason(page):
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
            f"event: 'operator_disconnected': must be one of {', '.join(EVENTS)}",
        ),
    ]
    for event, reason in wrong:
        reply = send(page, **event)
        assert (reply["result"], reply["reason"]) == ("refused", reason)
    choose(page, "single")
    reply = send(page, event="roi_set", camera="front_left", x=1900, y=0, width=100, height=100)
    assert reply["result"] == "refused"
    assert "ROI 100x100 at 1900,0" in reply["reason"]


def test_whatever_a_socket_sends_the_streams_go_on(page, demo):
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
            await ws.send_bytes(b"\xff\x00")
            while len(answers) < 14:
                message = await asyncio.wait_for(ws.receive(), 10)
                if message.type == aiohttp.WSMsgType.TEXT and '"reply"' in message.data:
                    answers.append(json.loads(message.data))
            with suppress(ConnectionError):  # cut off before it has been sent to its end
                await ws.send_bytes(b"x" * 2_000_000)
            while (message := await asyncio.wait_for(ws.receive(), 10)).type not in (
                aiohttp.WSMsgType.CLOSE,
                aiohttp.WSMsgType.CLOSED,
            ):
                pass
            return answers, ws.close_code

    counted = measure(page)
    answers, code = apart(attack())
    assert {answer["result"] for answer in answers} == {"refused"}
    assert answers[6]["reason"] == "this page does not hold control; take it first"
    assert answers[8]["reason"] == "100000 bytes: must be at most 65536"
    assert code in (1009, 1006)  # message too big, or cut off while it was still being sent
    goes_on(page, counted)
    assert page.evaluate("tod.control") == "you"


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({}, 200),
        ({"Origin": "http://evil.example"}, 403),
        ({"Host": "evil.example"}, 403),
    ],
)
def test_only_pages_of_this_server_may_look(demo, headers, status):
    async def ask():
        async with aiohttp.ClientSession() as session, session.get(demo, headers=headers) as answer:
            return answer.status, answer.headers.get("Content-Security-Policy")

    answered, policy = apart(ask())
    assert answered == status
    if status == 200:
        assert "default-src 'self'" in policy


def test_a_viewer_that_does_not_read_harms_nobody(page, demo):
    counted = measure(page)
    with upgraded(demo, "lazy"):
        time.sleep(6)
    goes_on(page, counted, pictures=20)


def test_another_page_watches_and_may_take_control(chromium, demo, page):
    with opened(chromium, demo) as other:
        all_live(other)
        assert other.evaluate("tod.control") == "another"
        assert (
            send(other, event="mode_selected", mode="single")["reason"]
            == "this page does not hold control; take it first"
        )
        shot(other, "watching")
        take_control(other)
        until(lambda: page.evaluate("tod.control === 'another'"))
    until(lambda: page.evaluate("tod.control === 'nobody'"))
    take_control(page)


def test_a_copy_of_a_page_only_watches(page):
    with page.expect_popup() as opening:
        page.evaluate("void open(location.href)")  # takes the storage of its tab with it, as a duplicated tab does
    copy = opening.value
    until(lambda: copy.evaluate("window.tod?.state"))
    until(lambda: copy.evaluate("tod.control") == "another")
    copy.close()
    assert page.evaluate("tod.control") == "you"


def test_without_webcodecs_one_sentence_says_what_it_needs(chromium, demo):
    with chromium.new_context() as tab:
        tab.add_init_script("delete window.VideoDecoder")
        blind = tab.new_page()
        blind.goto(demo)
        until(lambda: "WebCodecs" in blind.inner_text("body"))
        assert "Chromium" in blind.inner_text("body")


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


@contextmanager
def sides(*overrides, log="log.video=false"):
    """Vehicle and operator as two processes. Yields the page's address, a way to start the vehicle, the operator.

    log  argument of the operator's side
    """
    control, media, port = (free_port() for _ in range(3))
    words = (*ROBOT, *overrides, f"control.port={control}", f"media.port={media}", f"page.port={port}")
    with private_broker(Endpoint("127.0.0.1", control)), process("operator", *words, log) as operator:
        until(lambda: answers(port))
        yield f"http://127.0.0.1:{port}/", partial(process, "vehicle", *words), operator


def test_a_killed_vehicle_is_unmistakable_and_comes_back(chromium):
    with sides() as (url, vehicle, _), opened(chromium, url) as page:
        with vehicle() as first:
            all_live(page, seconds=30)
            time.sleep(1)
            first.kill()
            killed = time.time() * 1000
            page.wait_for_selector("#banner:not([hidden])", timeout=1000)
            shot(page, "vehicle-gone")
        log = page.evaluate("tod.measure()")["status_log"]
        for camera in ("front", "rear", "mast"):
            at = next(
                ms for ms, name, status in log if name == camera and ms > killed - 100 and status in ("frozen", "lost")
            )
            assert at - killed < 150, f"{camera}: {at - killed} ms"
        with vehicle():
            state_when(page, lambda now: True, seconds=30)
            online = time.monotonic()
            all_live(page)
            assert time.monotonic() - online < 3
            assert page.locator("#banner").is_hidden()


def test_a_station_that_stands_still_is_left_and_found_again(chromium):
    with sides() as (url, vehicle, operator), vehicle(), opened(chromium, url) as page:
        all_live(page, seconds=30)
        operator.send_signal(signal.SIGSTOP)
        stopped = time.monotonic()
        page.wait_for_selector("#banner:not([hidden])", timeout=10_000)
        assert time.monotonic() - stopped < 3  # 2 s without a word
        assert "NO CONNECTION TO THE STATION" in page.locator("#banner").inner_text()
        until(lambda: page.evaluate("tod.measure()")["attempts"] >= 4, seconds=12)  # each gives up after 1 s
        shot(page, "station-gone")
        operator.send_signal(signal.SIGCONT)
        found_again(page)


def test_a_station_that_starts_again_is_found_at_once(chromium):
    """However many attempts have failed: browsers delay WebSockets that failed often."""
    with sides() as (url, vehicle, operator), vehicle(), opened(chromium, url, refused=True) as page:
        all_live(page, seconds=30)
        operator.kill()
        until(lambda: page.evaluate("tod.measure()")["attempts"] >= 25, seconds=40)
        with process(*operator.args[3:]):
            until(lambda: answers(int(url.rstrip("/").rpartition(":")[2])))
            found_again(page)


def found_again(page):
    back = time.monotonic()
    until(lambda: page.locator("#banner").is_hidden())
    all_live(page)
    assert time.monotonic() - back < 5


def test_a_viewer_that_answers_no_ping_is_dropped(demo):
    with upgraded(demo, "silent") as viewer:
        began = time.monotonic()
        with suppress(ConnectionResetError):
            while viewer.recv(65_536):  # reads, and says nothing
                pass
        assert 1 < time.monotonic() - began < 6


def test_a_viewer_that_reads_slowly_and_answers_stays(demo):
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

    assert apart(watch()) > 100_000


@contextmanager
def upgraded(url, viewer):
    """A bare socket that has become a viewer."""
    host = url.removeprefix("http://").rstrip("/")
    with socket.create_connection(("127.0.0.1", int(host.rpartition(":")[2])), timeout=20) as line:
        line.sendall(
            f"GET /live?viewer={viewer} HTTP/1.1\r\nHost: {host}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
            "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\nSec-WebSocket-Version: 13\r\n\r\n".encode()
        )
        yield line


def test_an_operator_that_starts_beside_another_viewer_shows_pictures(chromium):
    """Such a stream has no IDR to start from."""
    from runner.operator.frames import live_frames

    with sides() as (url, vehicle, _), vehicle() as running:
        media = next(word for word in running.args if word.startswith("media.port="))
        with live_frames([*ROBOT, media]) as frames, opened(chromium, url) as page:
            all_live(page, seconds=30)
            assert frames.next(5)


def test_a_new_size_twice_a_second_breaks_no_decoder(chromium):
    """`make soak` does it for longer."""
    turns = int(os.environ.get("TOD_NEW_SIZES", "20"))
    graphs = ("+graph@cameras.rear.graph=openh264_rtsp",)  # key frames there, refresh waves elsewhere
    with sides("mode=single", *graphs) as (url, vehicle, _), vehicle(), opened(chromium, url) as page:
        all_live(page, seconds=30)
        counted = measure(page)
        for turn in range(turns):
            for camera in ("front", "rear", "mast"):
                reply = send(page, event="camera_configured", camera=camera, scaling=(0.25, 0.5, 1.0)[turn % 3])
                assert reply["result"] == "applied", reply
            time.sleep(0.5)
            for camera in ("front", "rear", "mast"):
                assert luma(page, camera)[0].mean() > 40, f"{camera} is black in turn {turn}"
        measured = measure(page)
        assert {name: camera["errors"] for name, camera in measured.items()} == {"front": 0, "rear": 0, "mast": 0}
        for name, camera in measured.items():
            received, drawn = (camera[key] - counted[name][key] for key in ("received", "drawn"))
            assert received > 5 * turns
            assert drawn > 0.9 * received


SHIFTED = """\
#define _GNU_SOURCE
#include <dlfcn.h>
#include <sys/time.h>
#include <time.h>
#define AHEAD_S 4
int clock_gettime(clockid_t id, struct timespec *t) {
  static int (*own)(clockid_t, struct timespec *);
  if (!own) own = dlsym(RTLD_NEXT, "clock_gettime");
  int failed = own(id, t);
  if (!failed && id == CLOCK_REALTIME) t->tv_sec += AHEAD_S;
  return failed;
}
int gettimeofday(struct timeval *t, void *zone) {
  struct timespec now;
  clock_gettime(CLOCK_REALTIME, &now);
  t->tv_sec = now.tv_sec, t->tv_usec = now.tv_nsec / 1000;
  return 0;
}
time_t time(time_t *at) {
  struct timespec now;
  clock_gettime(CLOCK_REALTIME, &now);
  if (at) *at = now.tv_sec;
  return now.tv_sec;
}
"""


@pytest.mark.skipif(not shutil.which("cc"), reason="needs a C compiler")
def test_a_vehicle_whose_clock_is_ahead_is_warned_of_and_no_age_is_told(chromium, tmp_path):
    (tmp_path / "shifted.c").write_text(SHIFTED)
    subprocess.run(["cc", "-shared", "-fPIC", "-o", "shifted.so", "shifted.c", "-ldl"], cwd=tmp_path, check=True)
    ahead = {"LD_PRELOAD": str(tmp_path / "shifted.so")}
    log = f"log={tmp_path / 'drive'}"
    with sides(log=log) as (url, vehicle, operator), vehicle(env=ahead), opened(chromium, url) as page:
        all_live(page, seconds=30)
        page.wait_for_selector("#warning:not([hidden])", timeout=10_000)
        told = r"▲ The vehicle's clock is ahead by at least [34]\.\d s: the age of its pictures is unknown; LATE .*"
        assert re.fullmatch(told, page.locator("#warning").inner_text())
        until(lambda: "– ms" in page.locator("[data-camera=front] .form").inner_text())
        assert {camera["latency_ms"] for camera in page.evaluate("tod.sample")["cameras"].values()} == {None}
        assert "late" not in {status for _, _, status in page.evaluate("tod.measure()")["status_log"]}
        shot(page, "clock-ahead")
        operator.terminate()
        said, _ = operator.communicate(timeout=20)
    assert "the vehicle's clock is ahead by at least " in said
    lines = [json.loads(line) for line in (tmp_path / "drive" / "operator.jsonl").read_text().splitlines()]
    samples = [line for line in lines if line.get("log") == "sample"]
    assert 3500 < samples[-1]["clock_ahead_ms"] < 4001
    known = {camera["latency_ms"] for sample in samples for camera in sample["cameras"].values()}
    assert known == {None}


def test_nothing_old_is_shown_of_a_camera_that_is_off_or_lost(chromium):
    with sides() as (url, vehicle, _), opened(chromium, url) as page:
        with vehicle() as running:
            all_live(page, seconds=30)
            until(lambda: "– fps" not in caption(page, "rear"))
            page.locator("[data-camera=rear] .switch").click()
            until(lambda: measure(page)["rear"]["status"] == "off")
            until(lambda: caption(page, "rear") == "– fps · –/0/0 kbit/s – · ×– · – ms")
            page.locator("[data-camera=rear] .head b").click()
            _, decided, applied = page.locator("#camera-panel .facts tbody tr").nth(1).inner_text().split("\t")
            assert decided == "0"
            assert re.fullmatch(r"– \(keeps \d+\)", applied)
            assert page.locator("#camera-panel [data-differs]").count() == 0
            shot(page, "off")
            running.kill()
        until(lambda: measure(page)["front"]["status"] == "lost")
        until(lambda: caption(page, "front") == "– fps · –/–/– kbit/s – · ×– · – ms")
        shot(page, "lost")


def caption(page, camera):
    parts = (page.locator(f"[data-camera={camera}] .{part}").inner_text() for part in ("rates", "form"))
    return " ".join(parts).replace("\u2009", "")


X265 = """\
element: x265enc
    properties: {tune: zerolatency, speed-preset: ultrafast, key-int-max: "{key_interval_frames}"}
"""


@pytest.fixture
def h265(tmp_path):
    """A user's directory with a graph of H.265, made of the packaged one by element swap."""
    text = (CHECKOUT / "conf" / "graph" / "h264_rtsp.yaml").read_text()
    text = re.sub(r"element: x264enc\n    properties:\n(      .*\n)+", X265, text)
    for old, new in {"h264depay": "h265depay", "h264pay": "h265pay", "x-h264": "x-h265", "=H264": "=H265"}.items():
        text = text.replace(old, new)
    text = text.replace("avdec_h264, properties: {max-threads: 1}", "avdec_h265").replace("vbv_frames: 1.5", "")
    graph = tmp_path / "conf" / "graph" / "h265.yaml"
    graph.parent.mkdir(parents=True)
    graph.write_text(text)
    return f"conf={tmp_path / 'conf'}"


def test_h265_is_played_or_refused_with_the_reason(chromium, h265):
    with sides(h265, "+graph@cameras.rear.graph=h265") as (url, vehicle, _), vehicle(), opened(chromium, url) as page:
        until(lambda: {"live", "unsupported"} >= {camera["status"] for camera in measure(page).values()}, seconds=30)
        until(lambda: page.evaluate("tod.sample").get("cameras", {}).get("rear", {}).get("fps", 0) > 5)
        supported = "VideoDecoder.isConfigSupported({codec: 'hev1.1.6.L90.90'}).then(({supported}) => supported)"
        if page.evaluate(supported):
            all_live(page)
            return
        tile = page.locator("[data-camera=rear]")
        told = r"This browser has no decoder for H\.265 \(hev1\.1\.6\.L\d+\.90\)\. Choose a graph of H\.264, or .*"
        until(lambda: re.fullmatch(told, tile.locator(".refused").inner_text()))
        assert tile.locator(".status").inner_text() == "⊘ NO PICTURE"
        assert not tile.locator(".rates").inner_text().startswith("–")  # its rates are those of what comes
        for camera in ("front", "mast"):
            until(lambda camera=camera: measure(page)[camera]["status"] == "live")
            assert page.locator(f"[data-camera={camera}] .refused").is_hidden()
        assert measure(page)["rear"]["resyncs"] <= 1  # another burst would not help
        tile.locator(".head b").click()
        assert "no decoder for H.265" in page.locator("#camera-panel .why-decided").inner_text()
        received = measure(page)["rear"]["received"]
        until(lambda: measure(page)["rear"]["received"] > received + 60)  # the refusal outlasts other key pictures
        assert tile.locator(".status").inner_text() == "⊘ NO PICTURE"
        shot(page, "h265")


@pytest.mark.parametrize(
    ("codec", "start", "string"),
    [
        ("h264", "6742c01e", "avc1.42c01e"),
        ("h264", "67640028", "avc1.640028"),
        ("h265", "42010101600000030090000003000003005d", "hev1.1.6.L93.90"),  # x265, Main
        ("h265", "42010102200000030090000003000003007b", "hev1.2.4.L123.90"),  # x265, Main 10
        ("h265", "420101214000000300b0000003000003009999", "hev1.1.2.H153.B0"),
    ],
)
def test_the_codec_is_named_as_webcodecs_wants_it(chromium, demo, codec, start, string):
    with opened(chromium, demo) as page:
        unit = [0, 0, 0, 1, *bytes.fromhex(start), 0xA0]
        asked = (
            f"import('/static/codec.js').then((m) => m.codecOf(m.spsOf(new Uint8Array({unit}), '{codec}'), '{codec}'))"
        )
        assert page.evaluate(asked) == string
