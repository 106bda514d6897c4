"""The page's layouts, monitors and colours in a real browser, with one picture in place of a vehicle's video."""

from __future__ import annotations

import asyncio
import io
import re
import subprocess
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from types import SimpleNamespace

import pytest
from msgspec import UNSET

from browser import (
    SCREENS,
    SOUND_BLOCKED,
    all_live,
    boxes,
    has_started,
    loaded,
    measure,
    opened,
    overlap,
    send,
    shot,
    sized,
    take_control,
    until,
    viewing,
    visit,
    visit_again,
    when,
)
from rig import SMALL_ROBOT, answers, free_port, needs_browser, passes, process
from runner.configuration.config import configuration
from runner.configuration.layout import HEADER, NOWHERE, Layouts
from runner.core import events
from runner.core.decision import Believed
from runner.core.events import parse
from runner.core.model import plain
from runner.core.roles import Role
from runner.core.step import start, step
from runner.h264.access_unit import read_unit
from runner.operator.seen import StatedView
from runner.operator.station import LinkState
from runner.page.login import Visitor
from runner.page.server import PageServer
from runner.page.viewer import PageViewer
from runner.records.decisions import UplinkDecision
from runner.records.operator import CameraSample, LatencyStages, Sample
from runner.records.vehicle import CameraReading, CameraState, Outcome, Position, UplinkMeasured, VehicleState

pytestmark = [pytest.mark.gst, needs_browser]
aiohttp = pytest.importorskip("aiohttp")
image = pytest.importorskip("PIL.Image")

WORDS = ("source=test", "modes=paper", "fps_max=1")  # as the page knows it; pictures are sent more often
CAMERAS = ("front", "rear", "mast")
EVERY_S = 0.3
BELIEVED = Believed(31999, 0.1, 0.2, -0.44, 0.35, 0.31, None)  # in as many words as it gets
UNCHANGED = SimpleNamespace(captured=lambda camera, at: at)  # both clocks are one


OWN = "anna"  # this station's operator


class Station(SimpleNamespace):
    """A stub of the operator's side: a vehicle in mode A that applies every request immediately.

    `happens` is an event of the vehicle about who drives, by its own rules; the page learns of it.
    """

    def __init__(self, vehicle):
        run = step(vehicle, start(vehicle), parse({"t": 0, "event": "bitrate_predicted", "kbps": 3000}))
        run = step(vehicle, run, parse({"t": 1, "event": "operator_connected", "operator": OWN, "role": "supervisor"}))
        cameras = {
            name: CameraState.at(setting, 1, name, CameraReading(run.commanded[name]))
            for name, setting in run.decision.settings.items()
        }
        totals = (plain(run.decision.total), plain(run.decision.asked))
        state = VehicleState(1.0, "", run.decision.mode, *totals, cameras, driving=run.state.driving, believed=BELIEVED)
        own = {
            "identity": OWN,
            "answer_s": 1.0,
            "link_state": LinkState(),
            "latency": UNCHANGED,
            "own_time": float,
            "seen": StatedView(),
        }
        super().__init__(
            state=state, note=print, attention=None, requests=[], attentions=[], vehicle=vehicle, run=run, **own
        )

    def ask(self, document, on_reply):
        self.requests.append(document)
        refused = self.happens(**document, operator=OWN) if "control_" in document["event"] else None
        on_reply(Outcome(0.0, "refused" if refused else "applied", refused or ""))

    def happens(self, **event):
        self.run = step(self.vehicle, self.run, parse({"t": self.run.state.driving.since + 1, **event}))
        self.state = replace(self.state, driving=self.run.state.driving)
        self.page.on_state(self.state)
        return self.run.refused


def over_two_uplinks(state):
    """The state of a vehicle with two uplinks, one of which has stalled."""
    believed = "capacity of the link, believed to be 4321"
    uplinks = {"modem_1": UplinkDecision(15999, False, believed), "modem_2": UplinkDecision(50, True, believed)}
    cameras = {name: replace(each, uplinks=("modem_1", "modem_2")) for name, each in state.cameras.items()}
    return replace(state, cameras=cameras, uplinks=uplinks, believed=UNSET)


@pytest.fixture(scope="module")
def picture():
    """An H.264 keyframe."""
    size = "video/x-raw,width=320,height=180,pixel-aspect-ratio=1/1"
    stream = "video/x-h264,stream-format=byte-stream,alignment=au,profile=constrained-baseline"
    line = f"videotestsrc num-buffers=1 pattern=white ! {size} ! x264enc tune=zerolatency ! {stream} ! fdsink fd=1"
    return subprocess.run(["gst-launch-1.0", "-q", *line.split()], capture_output=True, check=True, timeout=60).stdout


@contextmanager
def served(picture, layouts, *words, vehicle=SMALL_ROBOT, conf=None):
    """A vehicle's page with pictures: its server and the station."""
    setup = configuration([*vehicle, *WORDS, f"page.port={free_port()}", *words], conf).setup()
    vehicle = setup.vehicle
    station = Station(vehicle)
    page, ended = PageServer(setup, station, layouts=layouts), threading.Event()
    station.page = page
    page.silent = set()  # names of cameras that send nothing
    page.behind_s = 0.0  # how long ago pictures were captured
    page.sample = None  # sent with each picture

    def send():
        while not ended.wait(EVERY_S):
            station.attentions.append(station.attention)
            for name in vehicle.cameras:
                if name not in page.silent:
                    page.show(name, read_unit(picture, time.time() - page.behind_s, time.time()))
            if page.sample:
                page.on_sample(replace(page.sample, t=time.time()))

    page.start()
    sending = threading.Thread(target=send)
    sending.start()
    try:
        yield page, station
    finally:
        ended.set()
        sending.join()
        page.stop()


def controlling(page):
    when(page, "window.tod?.control === 'you'")


def pulled(page, selector, right, down):
    """Drag something by so many px."""
    x, y = middle(page.locator(selector).bounding_box())
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + right / 2, y + down / 2)
    page.mouse.move(x + right, y + down, steps=2)
    assert page.locator(".target").is_visible()
    page.mouse.up()
    assert page.locator(".target").is_hidden()


def middle(box):
    return box["x"] + box["width"] / 2, box["y"] + box["height"] / 2


def where(page, camera):
    return page.get_attribute(f"[data-mover={camera}]", "aria-label").partition(": ")[2]


def saved_without_places(page, file):
    """Reset the layout that is being edited, and save it."""
    page.click("#layout-reset")
    page.click("#layout-save")
    page.wait_for_selector("#layout-bar", state="hidden")
    assert file.read_text() == f"{HEADER}vehicles: {{}}\n"


def edges(page, selector="article"):
    """By camera, the box of its tile, or of another element."""
    return {name: page.locator(f"{selector}[data-camera={name}]").bounding_box() for name in CAMERAS}


def settled_edges(page):
    """The boxes of the tiles, unless they change: they adapt to a new height of the page at the next frame."""
    before = edges(page)
    page.evaluate("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
    return before if edges(page) == before else None


def test_a_layout_is_dragged_moved_by_keys_saved_and_reset(chromium, picture, tmp_path):
    file = tmp_path / "layout" / "alice.yaml"
    with served(picture, Layouts(tmp_path, "alice")) as (server, station), opened(chromium, server.url) as page:
        controlling(page)
        page.click("#offer-no")
        before = until(lambda: settled_edges(page))
        page.click("#edit-layout")
        assert page.evaluate("document.activeElement.dataset.mover") == "front"
        assert where(page, "mast") == "row 1, column 2, 1 high, 1 wide"
        cell = edges(page)
        down = cell["rear"]["y"] - cell["front"]["y"]
        pulled(page, "[data-mover=mast]", cell["rear"]["x"] - cell["mast"]["x"], down)
        assert [where(page, name) for name in ("mast", "rear")] == [
            "row 2, column 1, 1 high, 1 wide",
            "row 1, column 2, 1 high, 1 wide",
        ], "they swap"
        page.focus("[data-mover=front]")
        page.keyboard.press("Shift+ArrowRight")
        assert where(page, "front") == "row 1, column 1, 1 high, 2 wide"
        assert where(page, "rear") == "row 2, column 2, 1 high, 1 wide", "it makes room"
        assert page.evaluate("document.activeElement.dataset.mover") == "front", "the next key moves the same picture"
        assert page.inner_text("#announcer") == "front: row 1, column 1, 1 high, 2 wide"
        pulled(page, "[data-mover=front] .grip", 0, edges(page)["mast"]["y"] - edges(page)["front"]["y"])
        assert where(page, "front") == "row 1, column 1, 2 high, 2 wide"
        shot(page, "edit-layout")
        page.click("#layout-save")
        page.wait_for_selector("#layout-bar", state="hidden")
        saved = "    front: {row: 0, column: 0, row_span: 2, column_span: 2}\n    rear: {row: 2, column: 1}\n"
        expected = f"{HEADER}vehicles:\n  delivery_robot:\n{saved}    mast: {{row: 2, column: 0}}\n"
        assert file.read_text() == expected
        large = edges(page)
        assert large["front"]["height"] == pytest.approx(2 * large["mast"]["height"] + 8, abs=1)
        assert large["mast"]["x"] < large["rear"]["x"]
        pictures, wrong = boxes(page)
        assert wrong == {"outside": [], "cut": [], "low": [], "scrolls": False}
        assert set(pictures) == set(CAMERAS)
        shot(page, "layout")
        visit_again(page)
        controlling(page)
        until(lambda: edges(page) == large)
        page.click("#edit-layout")
        page.keyboard.press("ArrowDown")
        page.keyboard.press("Escape")
        assert page.locator("#layout-bar").is_hidden()
        assert edges(page) == large, "cancelled"
        page.click("#edit-layout")
        saved_without_places(page, file)
        until(lambda: edges(page) == before)
        assert station.requests == [], "no region was dragged, no camera switched"


def test_places_of_the_drive_view_are_dragged_moved_by_keys_saved_and_reset(chromium, picture, tmp_path):
    file = tmp_path / "layout" / "alice.yaml"
    with served(picture, Layouts(tmp_path, "alice")) as (server, station), opened(chromium, server.url) as page:
        controlling(page)
        page.click("#offer-drive")
        page.keyboard.press("d")  # the drawer has the button
        page.wait_for_selector("#edit-drive")
        before = until(lambda: settled_edges(page))
        page.click("#edit-drive")
        assert [where(page, name) for name in CAMERAS] == ["middle", "mirror", "row, number 1"]
        cell = until(lambda: settled_edges(page))
        (x, y), (left, top) = (middle(cell[name]) for name in ("front", "mast"))
        pulled(page, "[data-mover=mast]", x - left, y - top)
        assert [where(page, name) for name in CAMERAS] == ["row, number 1", "mirror", "middle"], "they swap"
        page.focus("[data-mover=front]")
        page.keyboard.press("ArrowLeft")
        assert where(page, "front") == "left"
        assert page.evaluate("document.activeElement.dataset.mover") == "front", "the next key moves the same picture"
        assert page.inner_text("#announcer") == "front: left"
        assert page.evaluate(
            "tiles.getBoundingClientRect().bottom <= document.querySelector('#layout-bar').getBoundingClientRect().top"
        )
        shot(page, "edit-drive")
        page.click("#layout-save")
        page.wait_for_selector("#layout-bar", state="hidden")
        assert file.read_text() == (
            f"{HEADER}vehicles: {{}}\ndrive:\n  delivery_robot: {{front: mast, left: front, rear: rear}}\n"
        )
        page.keyboard.press("d")
        large = until(lambda: settled_edges(page))
        assert large["front"]["x"] < large["rear"]["x"] and large["front"]["y"] < large["mast"]["y"]
        assert large["mast"]["width"] > 2 * large["front"]["width"]
        page.keyboard.press("ArrowLeft")
        assert page.evaluate("document.querySelector('.tile.selected').dataset.camera") == "front"
        shot(page, "drive-places")
        visit_again(page)
        controlling(page)
        until(lambda: edges(page) == large)
        page.keyboard.press("d")
        page.click("#edit-drive")
        page.focus("[data-mover=rear]")
        page.keyboard.press("Enter")
        assert [where(page, name) for name in CAMERAS] == ["left", "middle", "mirror"]
        page.keyboard.press("Escape")
        page.click("#edit-drive")
        saved_without_places(page, file)
        until(lambda: edges(page) == before)
        assert station.requests == [], "no region was dragged, no camera switched"


@pytest.mark.soak  # tests/test_page_parts.py covers the station's replies
def test_why_a_layout_cannot_be_edited_or_saved(chromium, picture, tmp_path):
    with served(picture, None) as (server, _), opened(chromium, server.url) as page:
        controlling(page)
        page.click("#edit-layout")
        assert NOWHERE in page.inner_text("#toasts")
        assert page.locator("#layout-bar").is_hidden()
    (tmp_path / "layout").touch()
    with served(picture, Layouts(tmp_path, "alice")) as (server, _), opened(chromium, server.url) as page:
        controlling(page)
        page.click("#edit-layout")
        page.keyboard.press("ArrowDown")
        page.click("#layout-save")
        until(lambda: "alice.yaml: cannot be written: " in page.inner_text("#toasts"))
        assert where(page, "front") == "row 2, column 1, 1 high, 1 wide", "the draft is kept"


@pytest.mark.parametrize(
    "module",
    ["boot.js", "tiles.js", *(pytest.param(name, marks=pytest.mark.soak) for name in ("video.js", "stream.js"))],
)
def test_a_page_whose_modules_fail_to_load_loads_again(chromium, picture, module):
    """The last two are those of the worker."""
    with served(picture, None) as (server, _), chromium.new_context() as tab:
        page, failed = tab.new_page(), []

        def fail_once(route):
            if failed:
                return route.continue_()
            failed.append(route.request.url)
            return route.abort("connectionreset")

        tab.route(f"**/static/{module}", fail_once)
        visit(page, server.url)
        when(page, "window.tod?.state")
        assert failed
        all_live(page)


BUSY = """([keys, seconds]) => {
  for (const key of keys) document.body.dispatchEvent(new KeyboardEvent("keydown", { key, bubbles: true }));
  const end = performance.now() + 1000 * seconds;
  while (performance.now() < end);
  return performance.timeOrigin + end;
}"""


def drawn_while_busy(page, keys, seconds):
    """Press keys, and keep the page's main thread busy.

    Returns the names of the cameras whose pictures were drawn in the second half of that time, and when it ended.
    """
    ended = page.evaluate(BUSY, [keys, seconds])
    drawn = {name: [times[-1] for times in stages] for name, stages in page.evaluate("tod.stages()").items()}
    begun = ended - 500 * seconds
    return {name for name, times in drawn.items() if any(begun < time <= ended for time in times)}, ended


@pytest.mark.soak
def test_a_busy_page_delays_neither_pictures_nor_alarms_even_as_webgl_starts(chromium, picture):
    """Without a GPU, some functions of canvases and WebGL wait for the page's main thread."""
    mast = {"lens": "fisheye", "width_px": 320, "height_px": 180, "calibrated": "false"}  # as large as the picture
    words = [f"cameras.mast.{key}={value}" for key, value in mast.items()]
    with served(picture, None, *words) as (server, station), opened(chromium, server.url) as page:
        all_live(page)
        page.keyboard.press("v")
        server.silent.add("mast")
        until(lambda: station.attention in ("watching", "unfocused"))
        station.attentions.clear()
        drawn, ended = drawn_while_busy(page, "", 8)  # the GPU is detected 3 s after the start
        assert "slow" in station.attentions, "keys do nothing meanwhile"
        until(lambda: station.attention in ("watching", "unfocused"))
        assert drawn == {"front", "rear"}
        marks = [
            mark for at, name, mark in page.evaluate("tod.measure()")["status_log"] if name == "mast" and at < ended
        ]
        assert marks[-1] == "lost"
        server.silent.clear()
        until(lambda: measure(page)["mast"]["status"] == "live")
        assert {"front", "rear"} <= drawn_while_busy(page, "e3l", 5)[0]
        until(lambda: page.evaluate("tod.birdseye()")["drawn"] == [""])
        page.keyboard.press("v")

        def is_labelled():
            """ESTIMATED: its plate, beside the letters. The frame of a picture that is not live covers it."""
            mast = measure(page)["mast"]
            return mast["straight"] and mast["status"] == "live" and colour_at(page, "mast", 0.005, 0.985) == AMBER

        if not passes(is_labelled):
            shot(page, "busy-unlabelled")
            said = page.evaluate("Promise.all([JSON.stringify(localStorage), tod.measure()])")
            pytest.fail(f"{page.inner_text('#toasts')} {said}")


AMBER = (255, 176, 0)


def colour_at(page, camera, across, down):
    """The colour of a pixel of a camera's box on the screen, in fractions of its sides."""
    png = page.locator(f"[data-camera={camera}] .picture").screenshot()
    shown = image.open(io.BytesIO(png)).convert("RGB")
    return shown.getpixel((round(across * shown.width), round(down * shown.height)))


COUNT_TONES = """void (OscillatorNode = class extends OscillatorNode {
  start(at) { globalThis.tones = (globalThis.tones ?? 0) + 1; super.start(at); }
})"""


def tones(page):
    """Four for a lost picture; on a busy machine there may be others."""
    return page.evaluate("globalThis.tones ?? 0")


@pytest.mark.parametrize("pressed", ["Space", pytest.param("b", marks=pytest.mark.soak)])
def test_a_driver_is_warned_in_either_view(chromium, picture, pressed):
    """Out of focus, a picture that was lost before, another page that takes control."""
    with served(picture, None) as (server, _), opened(chromium, server.url, script=SOUND_BLOCKED) as page:
        all_live(page)
        controlling(page)
        page.evaluate(COUNT_TONES)
        assert page.inner_text("#sound-configure") == "Allow sound"
        shot(page, "sound-blocked")
        if pressed == "Space":
            page.focus("#sound-configure")
        page.keyboard.press(pressed)  # which allows sound, and must not mute it at once
        until(page.locator("#sound-configure").is_hidden)
        assert page.evaluate("localStorage.getItem('tod-muted')") is None
        page.evaluate("dispatchEvent(new Event('blur'))")
        until(lambda: "OUT OF FOCUS" in page.inner_text("#attention"))
        time.sleep(0.6)  # a shorter absence is not reported
        page.evaluate("dispatchEvent(new Event('focus'))")
        until(lambda: "No key reached this page" in page.inner_text("#toasts"))
        assert page.evaluate("tod.view") == "configure"

        before = tones(page)
        page.evaluate("Object.defineProperty(document, 'hidden', {get: () => true, configurable: true})")
        page.evaluate("document.dispatchEvent(new Event('visibilitychange'))")
        until(lambda: tones(page) >= before + 4)
        time.sleep(0.6)
        page.evaluate("delete document.hidden; document.dispatchEvent(new Event('visibilitychange'))")
        until(lambda: "check every picture" in page.text_content("#alarms"))
        page.keyboard.press("t")
        until(lambda: page.evaluate("tod.control") == "free")
        server.silent.add("rear")
        until(lambda: measure(page)["rear"]["status"] == "lost")
        before = tones(page)
        take_control(page)
        until(lambda: tones(page) >= before + 4)
        server.silent.clear()
        all_live(page)
        before = tones(page)
        with opened(chromium, server.url) as other:
            take_control(other)
            until(lambda: page.inner_text("#attention") == "CONTROL LOST: this page only watches; take control (t)")
            assert "CONTROL LOST: another page is in control" in page.inner_text("#toasts")
            until(lambda: tones(page) >= before + 4)
            shot(page, "control-lost-configure")
            page.keyboard.press("v")
            shot(page, "control-lost-drive")
        take_control(page, "#drive-control")
        until(lambda: "CONTROL LOST" not in page.inner_text("#attention"))


def test_a_driver_is_warned_if_the_vehicle_has_another_operator_in_control(chromium, picture):
    with served(picture, None) as (server, station), opened(chromium, server.url) as page:
        all_live(page)
        controlling(page)
        page.evaluate(COUNT_TONES)
        page.keyboard.press("v")
        server.on_state(None)
        before = tones(page)
        server.on_state(station.state)
        station.happens(event="operator_connected", operator="eve", role="supervisor")
        station.happens(event="control_taken", operator="eve")
        until(lambda: page.inner_text("#attention") == "CONTROL LOST: operator eve is in control; request control (t)")
        assert "CONTROL LOST: operator eve is in control" in page.inner_text("#toasts")
        until(lambda: tones(page) >= before + 4)
        assert page.inner_text("#drive-holder").startswith("Operator eve is in control since ")
        shot(page, "other-operator-drive")
        page.keyboard.press("v")
        assert page.inner_text("#holder").startswith("Operator eve is in control since ")
        assert page.locator("[data-camera=front] .switch").is_disabled()
        assert page.get_attribute("[data-camera=front] .switch", "title") == (
            "operator eve is in control; request control (t)"
        )
        shot(page, "other-operator-configure")
        station.happens(event="control_offered", operator="eve", to=OWN)
        until(lambda: page.inner_text("#hand-over-words") == "eve offers control to you")
        page.keyboard.press("t")
        until(page.locator("#attention").is_hidden)
        until(lambda: page.inner_text("#holder").startswith("You are in control"))
        before = tones(page)
        station.happens(event="operator_disconnected", operator=OWN, departure="has been silent for 1 s")
        unheard = "the vehicle receives nothing from this station"
        until(lambda: page.inner_text("#attention") == f"CONTROL LOST: {unheard}")
        assert page.inner_text("#holder").startswith("Vehicle does not receive you")
        assert page.inner_text("#connection") == "✕ vehicle receives nothing"
        assert f"CONTROL LOST: {unheard}" in page.inner_text("#toasts")
        until(lambda: tones(page) >= before + 4)
        viewing(page, "drive")
        until(lambda: page.inner_text("#line").endswith("vehicle receives nothing"))
        before = tones(page)
        paused = {name: replace(camera, sending=False) for name, camera in station.state.cameras.items()}
        station.happens(event="operator_connected", operator=OWN, role="supervisor")
        server.on_state(replace(station.state, cameras=paused))
        until(lambda: page.inner_text("#alarms") == "❚❚ PAUSED front, rear, mast")
        until(lambda: page.inner_text("#worst-of") == "3 of 3 pictures not live")
        until(lambda: tones(page) >= before + 4)
        shot(page, "paused-drive")
        sample = Sample(1.0, None, 0, 0.0, Position(49.0, 8.4, 10.0), 0, {}, speed_factor=0.5)
        until(lambda: server.on_sample(sample) or page.inner_text("#driven") == "36 km/h")
        until(lambda: page.inner_text("#driven") == "– km/h")  # no further sample
        assert page.inner_text("#advised") == "no speed advised"
        until(lambda: "No measurements from the station" in page.inner_text("#warning"))


def test_control_is_offered_to_an_operator_who_has_not_asked(chromium, picture):
    with served(picture, None) as (server, station), opened(chromium, server.url) as page:
        controlling(page)
        assert page.locator("#control button").all_inner_texts() == ["Release"], "nobody else is here"
        for name, role in (("bob", "controller"), ("eve", "watcher")):
            station.happens(event="operator_connected", operator=name, role=role)
        page.click("#control button >> text=Offer …")
        shot(page, "offer-to")
        assert page.locator("#takers button").all_inner_texts() == ["bob"], "a watcher may not drive"
        page.click("#takers button")
        until(lambda: page.inner_text("#hand-over-words") == "You offer control to bob; you drive until bob accepts")
        page.keyboard.press("t")
        until(page.locator("#hand-over").is_hidden)
        assert [each["to"] for each in station.requests] == ["bob", ""]


def test_a_driver_is_alerted_to_a_picture_lost_in_a_monitor_only(chromium, picture, monkeypatch):
    withheld, show = set(), PageViewer.show

    def show_others(viewer, camera, unit):
        if not (viewer.monitor and camera in withheld):
            show(viewer, camera, unit)

    monkeypatch.setattr(PageViewer, "show", show_others)
    with served(picture, None) as (server, _), opened(chromium, server.url) as page:
        all_live(page)
        controlling(page)
        page.evaluate(COUNT_TONES)
        viewing(page, "drive")
        monitor = page.context.new_page()
        visit(monitor, f"{server.url}?show=front,mast")
        all_live(monitor)
        before = tones(page)
        withheld.add(2)
        until(lambda: page.inner_text("#alarms") == "✕ LOST mast (monitor)")
        until(lambda: page.inner_text("#worst-of") == "1 of 3 pictures not live")
        until(lambda: tones(page) >= before + 4)
        page.bring_to_front()
        shot(page, "lost-in-a-monitor")
        withheld.clear()
        until(lambda: page.inner_text("#alarms") == "")
        withheld.add(2)
        until(lambda: page.inner_text("#alarms") == "✕ LOST mast (monitor)")
        viewing(page, "configure")
        until(lambda: page.inner_text("#hidden-alarms") == "✕ LOST mast (monitor)")
        monitor.evaluate("dispatchEvent(new Event('pagehide'))")
        monitor.evaluate("new Promise((done) => setTimeout(done, 1000))")  # its worker and its timer go on for a moment
        until(page.locator("#hidden-alarms").is_hidden)
        monitor.evaluate("dispatchEvent(new Event('pageshow'))")
        until(lambda: page.inner_text("#hidden-alarms") == "✕ LOST mast (monitor)")
        monitor.close(run_before_unload=True)
        until(page.locator("#hidden-alarms").is_hidden)
        assert "no longer responds" not in page.inner_text("#toasts")


def test_a_driver_is_alerted_to_a_monitor_that_crashed(chromium, picture):
    with served(picture, None) as (server, _), opened(chromium, server.url) as page:
        all_live(page)
        controlling(page)
        page.evaluate(COUNT_TONES)
        monitor = page.context.new_page()
        visit(monitor, f"{server.url}?show=front,mast")
        all_live(monitor)
        before = tones(page)
        monitor.evaluate("BroadcastChannel.prototype.postMessage = () => {}")  # all that the page sees of a crash
        until(lambda: "a monitor no longer responds: reload it" in page.inner_text("#toasts"))
        until(lambda: tones(page) >= before + 4)
        until(lambda: "▲ MONITOR NOT RESPONDING front, mast" in page.text_content("#alarms"))
        for holder in ("free", "you"):
            page.keyboard.press("t")
            until(lambda holder=holder: monitor.evaluate("tod.control") == holder)
            assert "CONTROL LOST" not in monitor.inner_text("#attention"), "the driver has released it"
        page.close()
        until(lambda: monitor.inner_text("#attention") == "CONTROL LOST: the page of this monitor is closed")


def test_keys_act_on_the_cameras_after_a_button_was_clicked(chromium, picture):
    remapped = ("inputs.keys.view=z", "inputs.keys.theme=null", "inputs.keys.camera_3=j")
    with served(picture, None, *remapped) as (server, _), opened(chromium, server.url) as page:
        all_live(page)
        controlling(page)
        assert page.inner_text("#offer-drive") == "Drive view (z)"
        titles = [page.get_attribute(f"#{name}", "title") for name in ("to-drive", "theme", "take-control")]
        assert titles == ["Drive view: pictures first (z)", "Day or night", "Release (t)"]
        for key, camera in (("j", "mast"), ("ArrowDown", "rear"), ("1", "front"), ("3", "front")):
            page.keyboard.press(key)
            assert page.evaluate("tod.selected") == camera, key
        page.dblclick("[data-camera=mast] .picture")
        page.keyboard.press("z")
        usual = edges(page)
        assert usual["front"]["width"] > 2 * usual["mast"]["width"], "the enlarged picture stayed large"
        for holder in ("free", "you"):
            page.click("#drive-control")
            until(lambda holder=holder: page.evaluate("tod.control") == holder)
        page.keyboard.press("ArrowDown")
        assert page.evaluate("tod.selected") == "rear"
        page.click("#drawer")
        page.click("#mode-collective")
        page.keyboard.press("ArrowUp")
        assert page.evaluate("tod.selected") == "front", "no other mode has the focus"
        page.keyboard.press("ArrowDown")
        page.click("#drawer")
        page.keyboard.press("Enter")
        until(lambda: edges(page)["rear"]["width"] == usual["front"]["width"])
        page.click("#drive-control")
        until(lambda: page.evaluate("tod.control") == "free")
        page.focus("#drive-control")
        page.evaluate("void (globalThis.clicks = 0, addEventListener('click', () => clicks++))")
        for _ in range(3):
            page.keyboard.down("Enter")  # a focused button is pressed, once however long the key is held
        page.keyboard.up("Enter")
        until(lambda: page.evaluate("tod.control") == "you")
        assert page.evaluate("clicks") == 1
        spoken = """() => {
          const spoken = [];
          const announcer = document.getElementById("announcer");
          new MutationObserver(() => spoken.push(announcer.textContent)).observe(announcer, { childList: true });
          return import("/static/store.js").then(async ({ publish }) => {
            for (let turn = 0; turn < 2; turn++) {
              for (const camera of ["front", "rear"]) publish("status", { camera, status: "late" });
              await new Promise((done) => setTimeout(done, 150));
            }
            return spoken;
          });
        }"""
        assert page.evaluate(spoken) == ["front late, rear late"] * 2, "the same words again"


LIMITED = """async () => {
  const { publish, store } = await import("/static/store.js");
  const why = "measured link: 1800 kbit/s arrive, 250 ms of queue, 12 % lost, falling since 3 s";
  for (const each of Object.values(store.state.cameras)) each.reason = `total 1800 of 3000: ${why}`;
  publish("state", Object.assign(store.state, { asked_kbps: 30000 }));
}"""


def wide(cameras):
    """A sample in which captions, stages and totals are as long as they get."""
    stages = LatencyStages(100.5, 100.5, 100.5, 100.5, 100.5)
    rates = {"fps": 40.0, "kbps": 5999.0, "allocated_kbps": 5999, "demand_kbps": 5999, "scaling": 0.125}
    size = {"width": 1920, "height": 1200}
    counted = {"lost": 12345, "rebuilt": 12, "frames": 0, "bytes": 0, "damaged": 0, "arrivals": ()}
    one = CameraSample(**rates, **size, latency_ms=1250.0, **counted, buffer_ms=120, stages_ms=stages)
    figures = {"cameras": dict.fromkeys(cameras, one), "speed_factor": 0.85, "clock_bound_ms": 120.0}
    figures["uplinks"] = {"modem_1": UplinkMeasured(15999.0, 1234.0, 0.125, events.LinkState.FILLING, 30.0)}
    return Sample(0.0, 31999, 31999, 31999.0, Position(49.0, 8.4, 100.0), 0, **figures)


INSIDE = """() => [...document.querySelectorAll("#drive > :not(#drive-map), #messages")].every((panel) => {
  const { top, bottom } = panel.getBoundingClientRect();
  const seen = [...panel.children].filter((each) => each.checkVisibility()).map((each) => each.getBoundingClientRect());
  return seen.every((each) => each.top >= top - 1 && each.bottom <= bottom + 1);
})"""


TRUCK = """
# @package _global_
name: truck
dimensions: {wheelbase_m: 3.8, track_m: 2.1, width_m: 2.55, front_m: 5.2, rear_m: 1.1}
cameras:
  cab:
    {width_px: 1920, height_px: 1080, fps: 30, fov_deg: 100, calibrated: true,
     pose: {x_m: 5, y_m: 0, z_m: 2.4, yaw_deg: 0, pitch_deg: 8}, rate_quality: &curve
     {scaling: [0.5, 1.0], b_min_kbps: [0, 600], b_full_kbps: 3000}}
  left_mirror_of_the_cab:
    {width_px: 720, height_px: 1280, fps: 30, pose: {x_m: 4.5, y_m: 1.4, z_m: 2.2, yaw_deg: 165}, rate_quality: *curve}
  trailer:
    {width_px: 1280, height_px: 960, fps: 25, pose: {x_m: -9, y_m: 0, z_m: 2, yaw_deg: 180}, rate_quality: *curve}
"""
FITS = {"outside": [], "cut": [], "low": [], "scrolls": False}
OWNERS = {"paper": ["vehicle=tum_q7"], "robot": ["vehicle=delivery_robot"], "truck": ["vehicle=truck"]}
TWO_UPLINKS = ("paper", "robot")  # those of the owners


@pytest.mark.soak
@pytest.mark.parametrize("view", ("configure", "drive"))
@pytest.mark.parametrize("owner", OWNERS)
def test_a_view_fits_every_screen(chromium, picture, tmp_path, owner, view):
    (tmp_path / "vehicle").mkdir()
    (tmp_path / "vehicle" / "truck.yaml").write_text(TRUCK.lstrip())
    with (
        served(picture, None, "page.late_ms=1500", vehicle=OWNERS[owner], conf=tmp_path) as (server, station),
        opened(chromium, server.url, 1920, 1080) as page,
    ):
        server.behind_s, server.sample = 1.25, wide(station.state.cameras)
        if owner in TWO_UPLINKS:
            station.state = over_two_uplinks(station.state)
            server.on_state(station.state)
        controlling(page)
        all_live(page)
        front = next(name for name in station.state.cameras if name in ("front_center", "front", "cab"))
        viewing(page, view)
        for width, height in SCREENS:
            sized(page, width, height)
            until(lambda: has_wide_figures(page, view))
            time.sleep(EVERY_S)  # for the picture of the screen
            shot(page, f"{owner}-{view}-{width}")
            pictures, wrong = boxes(page)
            assert wrong == FITS, (view, width, height)
            assert set(pictures) == set(station.state.cameras)
            share = pictures[front]["width"] * pictures[front]["height"] / (width * height)
            assert view == "configure" or width < height or share >= 0.4, (view, width, height)
            for status in OTHERS:
                page.evaluate(ALL_AS, status)
                assert boxes(page)[1] == FITS, (status, view, width, height)
            page.evaluate(ALL_AS, "live")
            if view == "drive":
                page.click("#drawer")
                shot(page, f"{owner}-drawer-{width}")
            for tab in ("latency", "charts", "map", "camera"):
                if page.locator(f"#tab-{tab}").is_visible():
                    page.click(f"#tab-{tab}")
                    assert boxes(page)[1] == FITS, (tab, view, width, height)
            if view == "drive":
                page.click("#drawer")
            page.keyboard.press("?")
            shot(page, f"{owner}-help-{width}")
            assert boxes(page)[1] == FITS, ("help", width, height)
            page.keyboard.press("Escape")


OTHERS = ("synchronising", "late", "damaged", "frozen", "lost", "refused", "unsupported", "off", "paused")

# Show all pictures with a status, until that changes.
ALL_AS = """async (status) => {
  const { publish, store } = await import("/static/store.js");
  for (const camera of Object.keys(store.status)) {
    store.status[camera] = status;
    publish("status", { camera, status });
  }
}"""


def has_wide_figures(page, view):
    """Whether the page shows the ages of pictures, with long numbers."""
    if view == "drive":
        return re.fullmatch(r"1[23]\d\d ± 1\d\d ms", page.inner_text("#worst"))
    captions = page.locator(".caption .form").all_inner_texts()
    return captions and all(re.search(r" 1[23]\d\d ± 1\d\d ms · 12345 lost", each) for each in captions)


NO_PLACE = "one viewer per camera: media.max_viewers; anna watches"


def test_refused_pictures_say_why_and_are_no_failure(chromium, picture):
    """The station of an operator who does not drive gets none of the vehicle's uplink."""
    with served(picture, None) as (server, station), opened(chromium, server.url) as page:
        controlling(page)
        driving = replace(station.state.driving, holder="bert")
        server.on_state(replace(station.state, driving=driving))
        server.silent.update(CAMERAS)
        sample = wide(station.state.cameras)
        refused = {name: replace(camera, refused=NO_PLACE) for name, camera in sample.cameras.items()}
        server.sample = replace(sample, cameras=refused)
        for view in ("configure", "drive"):
            viewing(page, view)
            until(lambda: page.locator(".tile[data-status=refused]").count() == len(CAMERAS))
            assert {text.strip() for text in page.locator(".tile .refused").all_inner_texts()} == {NO_PLACE}
            assert page.locator(".tile .refused:visible").count() == len(CAMERAS)
            assert "REFUSED" not in page.inner_text("#alarms")
            assert boxes(page)[1] == FITS, view
            shot(page, f"refused-{view}")


def test_a_watchers_page_requests_nothing_and_the_drivers_page_says_who_watches(chromium, picture, monkeypatch):
    with served(picture, None) as (server, station), opened(chromium, server.url) as driver:
        controlling(driver)
        monkeypatch.setattr("runner.page.access.OPERATOR", Visitor("carol_from_the_control_room", Role.WATCHER))
        with opened(chromium, server.url) as page:
            all_live(page)
            assert page.inner_text("#watching") == "Watching as carol_from_the_control_room"
            assert not page.locator("#take-control").is_visible()
            page.keyboard.press("t")
            until(lambda: "you may only watch" in page.inner_text("#toasts"))
            assert send(page, event="mode_selected", mode="single") == {
                "result": "refused",
                "reason": "carol_from_the_control_room may only watch",
            }
            for view in ("configure", "drive"):
                viewing(page, view)
                assert not page.locator("#drive-control").is_visible()
                assert boxes(page)[1] == FITS, view
                shot(page, f"watcher-{view}")
            until(lambda: driver.inner_text("#watching") == "1 watching")
            assert driver.get_attribute("#watching", "title") == "carol_from_the_control_room"
            shot(driver, "watched")
        until(lambda: not driver.locator("#watching").is_visible())
        assert station.requests == []


def test_eight_lost_pictures_are_named_in_full(chromium, picture):
    with served(picture, None, vehicle=["vehicle=tum_q7"]) as (server, station):
        server.silent.update(station.state.cameras)
        with opened(chromium, server.url, 1280, 720) as page:
            controlling(page)
            page.keyboard.press("v")
            until(lambda: page.inner_text("#worst-of") == "8 of 8 pictures not live")
            server.on_state(over_two_uplinks(station.state))
            until(lambda: page.locator("#drive-uplinks .uplink").count() == 2)
            page.evaluate(LIMITED)
            for width, height in ((1280, 720), (1024, 768), (1920, 1080)):
                page.set_viewport_size({"width": width, "height": height})
                until(lambda width=width: page.evaluate("innerWidth") == width)
                until(lambda: page.evaluate(INSIDE))  # resized words
                shot(page, f"eight-lost-{width}")
                assert boxes(page)[1] == {"outside": [], "cut": [], "low": [], "scrolls": False}, (width, height)


def test_a_page_without_webcodecs_shows_no_picture_as_live_and_is_reported_as_slow(chromium, picture):
    with served(picture, None) as (server, station), chromium.new_context() as tab:
        tab.add_init_script("delete window.VideoDecoder")
        page = tab.new_page()
        visit(page, server.url)
        controlling(page)
        until(lambda: page.locator(".tile[data-status=unsupported]").count() == 3)
        assert "no WebCodecs" in page.inner_text("[data-camera=front] .refused")
        until(lambda: station.attention == "slow")


def test_a_monitor_passes_on_keys_for_what_only_the_page_shows(chromium, picture):
    with served(picture, None) as (server, _), opened(chromium, server.url) as page:
        all_live(page)
        controlling(page)
        monitor = page.context.new_page()
        visit(monitor, f"{server.url}?show=front,mast")
        controlling(monitor)
        page.keyboard.press("1")
        until(lambda: monitor.evaluate("tod.selected") == "front")
        monitor.keyboard.press("v")
        until(lambda: page.evaluate("tod.view") == "drive")
        usual = edges(page)
        monitor.keyboard.press("r")  # reverse
        until(lambda: page.evaluate("tod.selected") == "rear")
        until(lambda: edges(page)["rear"]["width"] == usual["front"]["width"])
        monitor.keyboard.press("Escape")
        until(lambda: edges(page) == usual)
        page.keyboard.press("1")
        until(lambda: monitor.evaluate("tod.selected") == "front")
        monitor.keyboard.press("2")  # it does not show the rear camera
        until(lambda: [each.evaluate("tod.selected") for each in (page, monitor)] == ["rear", "rear"])
        monitor.keyboard.press("Enter")
        until(lambda: edges(page)["rear"]["width"] == usual["front"]["width"])
        monitor.keyboard.press("Escape")
        until(lambda: edges(page) == usual)
        monitor.keyboard.press("+")  # the total of all cameras, not of those that it shows
        until(lambda: "choose C to set it" in page.inner_text("#toasts"))
        monitor.keyboard.press("l")
        until(lambda: "rear: lines are already straight" in page.inner_text("#toasts"))
        for muted in ("yes", "no"):
            monitor.keyboard.press("b")
            until(lambda muted=muted: page.evaluate("localStorage.getItem('tod-muted')") == muted)
            until(lambda muted=muted: (page.inner_text("#sound") == "Unmute tones") == (muted == "yes"))
            words = f"alarm tones of the page {'muted' if muted == 'yes' else 'on'}"
            until(lambda words=words: words in monitor.inner_text("#toasts"))
        monitor.keyboard.press("w")
        page.wait_for_selector("#monitors[open]")


def test_monitors_share_selection_control_and_attention_with_their_page(chromium, picture):
    with served(picture, None) as (server, station), opened(chromium, server.url) as page:
        all_live(page)
        controlling(page)
        page.keyboard.press("w")
        addresses = page.locator("#monitors a").evaluate_all("each => each.map((a) => a.getAttribute('href'))")
        assert addresses == ["/?show=front,mast", "/?show=front", "/?show=rear", "/?show=mast"]
        shot(page, "monitors")
        with page.context.expect_page() as opening:
            page.locator("#monitors a").first.click()
        page.keyboard.press("Escape")
        monitor = opening.value
        assert passes(lambda: has_started(monitor)), loaded(monitor)
        all_live(monitor)
        assert set(measure(monitor)) == {"front", "mast"}
        controlling(monitor)
        assert page.evaluate("tod.control") == "you"
        assert monitor.locator("#header").is_hidden() and monitor.locator("#side").is_hidden()
        pictures, wrong = boxes(monitor)
        assert wrong == {"outside": [], "cut": [], "low": [], "scrolls": False}
        assert sum(box["width"] for box in pictures.values()) > 0.9 * monitor.evaluate("innerWidth")
        shot(monitor, "monitor")

        page.click("[data-camera=front] .picture")
        monitor.click("[data-camera=mast] .picture")
        until(lambda: page.evaluate("tod.selected") == "mast")
        # Otherwise the front camera would be selected again when the page's window is activated.
        assert page.evaluate("document.activeElement.dataset.camera") == "mast"
        page.keyboard.press("2")
        until(lambda: monitor.evaluate("tod.selected") == "rear")
        monitor.keyboard.press("o")
        assert until(lambda: station.requests) == [{"event": "camera_switched", "camera": "rear", "on": False}]
        monitor.keyboard.press("t")
        until(lambda: "not its monitors" in monitor.inner_text("#toasts"))
        assert page.evaluate("tod.control") == "you"

        until(lambda: station.attention in ("watching", "unfocused"))
        monitor.evaluate("Object.defineProperty(document, 'hidden', {get: () => true, configurable: true})")
        monitor.evaluate("document.dispatchEvent(new Event('visibilitychange'))")
        until(lambda: station.attention == "hidden")
        until(lambda: page.inner_text("#attention") == "HIDDEN: another window of this page cannot be seen")
        with opened(chromium, server.url) as other:
            take_control(other)
            until(lambda: monitor.inner_text("#attention") == "CONTROL LOST: take control on the page of this monitor")
            until(lambda: page.evaluate("tod.control") == "another")
            until(lambda: station.attention in ("watching", "unfocused"))
        take_control(page)
        until(lambda: station.attention == "hidden")
        monitor.close()
        until(lambda: station.attention in ("watching", "unfocused"))
        wrong = page.context.new_page()
        visit(wrong, f"{server.url}?show=front,raer")
        wrong.wait_for_selector("#no-such-camera")
        assert wrong.inner_text("#no-such-camera") == "delivery_robot has no camera raer; cameras are front, rear, mast"


def test_a_monitor_in_the_tab_of_a_page_has_no_control(chromium, picture):
    """The page that had it is gone; it has it again when the operator goes back."""
    with served(picture, None) as (server, _), opened(chromium, server.url) as page:
        controlling(page)
        visit(page, f"{server.url}?show=front")
        when(page, "window.tod?.control === 'nobody'")
        time.sleep(0.5)
        assert page.evaluate("tod.control") == "nobody"
        visit(page, server.url)
        controlling(page)


def test_an_enlarged_picture_hides_no_alarm(chromium, picture):
    with served(picture, None) as (server, _), opened(chromium, server.url) as page:
        all_live(page)
        page.locator("[data-camera=front]").dblclick()
        until(lambda: page.locator("[data-camera=rear]").is_hidden())
        until(page.locator("#hidden-alarms").is_hidden)  # a busy machine may make a picture late
        server.silent.update(["rear", "front"])
        until(lambda: page.locator("#hidden-alarms").inner_text() == "✕ LOST rear")
        shot(page, "enlarged-alarm")
        box, tile = (page.locator(each).bounding_box() for each in ("#hidden-alarms", "[data-camera=front]"))
        assert tile["y"] + tile["height"] <= box["y"], "it covers the line"
        page.locator("[data-camera=front]").dblclick()
        until(page.locator("#hidden-alarms").is_hidden)


def test_a_layout_survives_a_restart_of_the_operators_process(broker, tmp_path):
    port, layout = free_port(), {"rear": {"row": 0, "column": 0, "row_span": 1, "column_span": 2}}

    async def exchange(messages):
        url = f"http://127.0.0.1:{port}"
        async with aiohttp.ClientSession() as session, session.ws_connect(f"{url}/live?viewer=me", origin=url) as ws:
            places = (await ws.receive_json(timeout=20))["layout"]["places"]
            for message in messages:
                await ws.send_json({"id": "1", **message})
                while (reply := await ws.receive_json(timeout=20))["kind"] != "reply":
                    pass
                assert reply["result"] == "applied", reply
            return places

    words = (*SMALL_ROBOT, *WORDS, f"control.port={broker.port}", f"media.port={free_port()}", f"page.port={port}")
    for messages in ([{"layout": layout}], []):
        with process("operator", *words, f"conf={tmp_path}", stdout=subprocess.DEVNULL):
            until(lambda: answers(port))
            with ThreadPoolExecutor(1) as pool:  # this thread is the browser's
                places = pool.submit(asyncio.run, exchange(messages)).result(timeout=60)
    assert (tmp_path / "layout" / "operator.yaml").is_file()
    assert places == {"front": None, "rear": layout["rear"], "mast": None}


# WCAG 2.2, 1.4.3: text needs a contrast of 4.5 : 1, large text 3 : 1; over a picture, with any colour below it.
CONTRAST = """([root, theme, states]) => {
  document.documentElement.dataset.theme = theme;
  const parsed = (text) => {
    const [r, g, b, a = 1] = text.match(/[\\d.]+/g).map(Number);
    return { r, g, b, a };
  };
  const over = (top, below) => {
    const mixed = (key) => top.a * top[key] + (1 - top.a) * below[key];
    return { r: mixed("r"), g: mixed("g"), b: mixed("b"), a: 1 };
  };
  const linear = (value) => (value / 255 <= 0.04045 ? value / 255 / 12.92 : ((value / 255 + 0.055) / 1.055) ** 2.4);
  const luminance = ({ r, g, b }) => 0.2126 * linear(r) + 0.7152 * linear(g) + 0.0722 * linear(b);
  const ratio = (a, b) => {
    const [low, high] = [luminance(a), luminance(b)].sort((x, y) => x - y);
    return (high + 0.05) / (low + 0.05);
  };
  const pictures = document.body.dataset.view === "configure" ? ".picture" : ".picture, .tile";
  const grey = (value) => ({ r: value, g: value, b: value, a: 1 });
  const grounds = (element) => {
    const layers = [];
    let below = [grey(255)];
    for (let it = element; it; it = it.parentElement) {
      if (it.matches(pictures)) {
        below = [grey(0), grey(128), grey(255)];
        break;
      }
      const colour = parsed(getComputedStyle(it).backgroundColor);
      layers.push(colour);
      if (colour.a === 1) break;
    }
    return below.map((one) => layers.reduceRight((ground, layer) => over(layer, ground), one));
  };
  const seen = (element) => {
    const { width, height } = element.getBoundingClientRect();
    const isShown = element.checkVisibility({ opacityProperty: true, visibilityProperty: true });
    return isShown && width > 1 && height > 1 && !element.closest(":disabled, [aria-disabled=true], .unseen, svg");
  };
  const bad = [];
  let [measured, bordered] = [0, 0];
  const look = (element) => {
    if (!seen(element)) return;
    measured++;
    const { color, fontSize, fontWeight } = getComputedStyle(element);
    const [size, bold] = [parseFloat(fontSize), +fontWeight >= 700];
    const needed = size >= 24 || (bold && size >= 18.66) ? 3 : 4.5;
    const found = Math.min(...grounds(element).map((ground) => ratio(over(parsed(color), ground), ground)));
    const name = element.id || element.className || element.tagName;
    if (found < needed) bad.push(`${theme} ${name} "${element.textContent.trim().slice(0, 30)}": ${found.toFixed(2)}`);
  };
  const lookAtBorder = (input) => {
    if (!seen(input)) return;
    bordered++;
    const colour = parsed(getComputedStyle(input).borderTopColor);
    const found = Math.min(...grounds(input.parentElement).map((ground) => ratio(over(colour, ground), ground)));
    if (found < 3) bad.push(`${theme} border of ${input.getAttribute("aria-label")}: ${found.toFixed(2)}`);
  };
  const lookBelow = (top) => {
    const walker = document.createTreeWalker(top, NodeFilter.SHOW_TEXT);
    const parents = new Set();
    while (walker.nextNode()) if (walker.currentNode.data.trim()) parents.add(walker.currentNode.parentElement);
    parents.forEach(look);
    for (const input of top.querySelectorAll("input:not([type=range])")) {
      look(input);
      lookAtBorder(input);
    }
  };
  lookBelow(document.querySelector(root));
  for (const [selector, attribute, values] of states) {
    for (const element of document.querySelectorAll(selector)) {
      const { hidden } = element;
      const before = element.getAttribute(attribute);
      const text = element.childElementCount || element.textContent.trim() ? null : element.textContent;
      if (text !== null) element.textContent = "words";
      element.hidden = false;
      for (const value of values) {
        element.setAttribute(attribute, value);
        lookBelow(element);
      }
      if (before === null) element.removeAttribute(attribute);
      else element.setAttribute(attribute, before);
      if (text !== null) element.textContent = text;
      element.hidden = hidden;
    }
  }
  return [measured, bad, bordered];
}"""
LEVELS = ["fine", "near", "late", "unknown", "none"]
STATUSES = ["live", "late", "damaged", "frozen", "lost", "off", "refused", "unsupported"]
# Elements that a page shows only at times, by selector and attribute.
STATES = [
    *(
        [f"#{name}", "data-test", ["shown"]]
        for name in ("banner", "warning", "offer", "hand-over", "attention", "no-such-camera")
    ),
    ["#latency", "data-level", LEVELS],
    ["#speed-now", "data-level", LEVELS],
    ["#alarms", "data-level", ["near", "late"]],
    ["#sound", "data-level", ["near", "fine"]],
    ["#holder", "data-holder", ["you", "another", "nobody"]],
    ["#connection", "data-state", ["fine", "bad"]],
    [".tile", "data-status", STATUSES],
    [".caption span", "data-differs", [""]],
    [".refused", "data-test", ["shown"]],
]


@pytest.mark.soak
def test_every_text_is_readable_by_day_and_by_night(chromium, picture, tmp_path):
    with served(picture, Layouts(tmp_path)) as (server, station), opened(chromium, server.url) as page:
        all_live(page)
        controlling(page)
        server.on_state(over_two_uplinks(station.state))
        until(lambda: page.locator("#uplinks .uplink").count() == 2)
        found = []

        def look(view, root="body", on=page):
            for theme in ("day", "night"):
                measured, bad, bordered = on.evaluate(CONTRAST, [root, theme, STATES if root == "body" else []])
                assert measured > 3 and (bordered > 0 or view != "configure"), view
                found.extend(f"{view}: {each}" for each in bad)

        look("configure")
        page.click("#offer-no")
        page.click("#edit-layout")
        look("edit")
        shot(page, "edit-layout-night")
        page.keyboard.press("Escape")
        for key, dialog in (("w", "#monitors"), ("?", "#help")):
            page.keyboard.press(key)
            look(dialog, dialog)
            page.keyboard.press("Escape")
        page.keyboard.press("v")
        look("drive")
        page.keyboard.press("d")
        look("drawer")
        monitor = page.context.new_page()
        visit(monitor, f"{server.url}?show=front,rear")
        assert passes(lambda: has_started(monitor)), loaded(monitor)
        all_live(monitor)
        look("monitor", on=monitor)
        assert sorted(set(found)) == []


def test_no_message_moves_a_picture_of_the_drive_view(chromium, picture):
    """Alarms, warnings and toasts have a place of their own."""
    with served(picture, None) as (server, _), opened(chromium, server.url, 1920, 1080) as page:
        controlling(page)
        page.click("#offer-drive")
        all_live(page)
        before = until(lambda: settled_edges(page))
        panel = page.locator("#messages").bounding_box()
        server.on_state(None)
        until(lambda: "VEHICLE OFFLINE" in page.inner_text("#banner"))
        until(lambda: page.inner_text("#alarms").startswith("✕ LOST"))
        page.evaluate("dispatchEvent(new Event('blur'))")
        page.evaluate('import("/static/requests.js").then(({ showProblem }) => showProblem("words ".repeat(20)))')
        until(lambda: page.locator(".toast").count() == 1)
        shot(page, "drive-offline")
        assert until(lambda: settled_edges(page)) == before
        assert page.locator("#messages").bounding_box() == panel
        assert page.locator("#banner").is_visible()
        assert [name for name in CAMERAS if overlap(panel, before[name])] == []


@pytest.mark.parametrize("size", [(412, 915), (915, 412), (768, 1024)])
def test_a_narrow_page_has_one_column(chromium, picture, size):
    with served(picture, None, vehicle=["vehicle=tum_q7"]) as (server, _), opened(chromium, server.url, *size) as page:
        all_live(page)
        page.click("#offer-no")
        tiles = [page.locator(".tile").nth(i).bounding_box() for i in range(8)]
        *above, side = (page.locator(each).bounding_box() for each in ("#header", "#scene", "#below", "#side"))
        assert [(a, b) for i, a in enumerate(tiles) for b in tiles[:i] if overlap(a, b)] == []
        assert all(each["y"] + each["height"] <= side["y"] + 1 for each in above)
        assert all(each["width"] >= 290 and each["x"] + each["width"] <= size[0] for each in tiles)
        _, wrong = boxes(page)
        assert (wrong["cut"], wrong["scrolls"]) == ([], True)
        page.locator("#tab-news").click()  # at its end
        shot(page, f"narrow-{size[0]}")
        viewing(page, "drive")
        assert boxes(page)[1] == FITS
