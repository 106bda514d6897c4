"""Operators, a supervisor and a watcher at one vehicle: all pages say the same of who drives, and pass control on."""

from __future__ import annotations

import subprocess
import threading
from contextlib import ExitStack, contextmanager
from types import SimpleNamespace

import pytest

from browser import all_live, opened, send, shot, until
from rig import SMALL_ROBOT, Operator, answers, free_port, needs_browser, process
from runner.core.roles import Role
from runner.mqtt.broker import private_broker
from runner.security.authority import Authority
from runner.settings import Endpoint

pytestmark = [pytest.mark.gst, pytest.mark.alone, needs_browser]

ROBOT = (*SMALL_ROBOT, "source=test", "fps_max=15", "modes=open_loop", "pqos=constant", "pqos.kbps=3000")
HOLDERS = {
    "broker": Role.BROKER,
    "delivery_robot": Role.VEHICLE,
    "alice": Role.CONTROLLER,
    "bob": Role.CONTROLLER,
    "sam": Role.SUPERVISOR,
    "eve": Role.WATCHER,
    "gps": Role.POSITIONER,
}
REPORT_S = 0.2


class Positioner:
    """Reports a position with a speed that a test sets, m/s."""

    def __init__(self, link):
        self.speed_mps, self._link, self._ended = 0.0, link, threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self):
        while not self._ended.wait(REPORT_S):
            self._link.send("gps", event="position_reported", lat=48.26, lon=11.67, speed_mps=self.speed_mps)

    def close(self):
        self._ended.set()
        self._thread.join()
        self._link.link.close()


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    """A vehicle; `station` starts an operator's side and gives the address of its page and its process."""
    keys = tmp_path_factory.mktemp("who") / "keys"
    authority = Authority(keys)
    with authority.opened():
        for name, role in HOLDERS.items():
            authority.issue(name, role, [])
    control = free_port()
    words = (*ROBOT, f"control.port={control}", f"media.port={free_port()}")
    broker = Endpoint("127.0.0.1", control)

    @contextmanager
    def station(name):
        port = free_port()
        own = (f"keys={keys / name}", f"page.port={port}", "log.video=false")
        with process("operator", *words, *own, stdout=subprocess.DEVNULL) as running:
            until(lambda: answers(port))
            yield f"http://127.0.0.1:{port}/", running
            running.terminate()
            running.wait(timeout=20)

    with (
        private_broker(broker, keys / "broker"),
        process("vehicle", *words, f"keys={keys / 'delivery_robot'}", stdout=subprocess.DEVNULL),
        ExitStack() as ending,
    ):
        positioner = Positioner(Operator(broker, keys=keys / "gps"))
        ending.callback(positioner.close)
        yield SimpleNamespace(station=station, positioner=positioner)


@pytest.fixture
def moving(drive):
    """Called once somebody drives; the vehicle stands again afterwards, so that nobody is in control then."""
    yield lambda: setattr(drive.positioner, "speed_mps", 8.0)
    drive.positioner.speed_mps = 0.0


def holder(page):
    return page.inner_text("#holder").partition(" since ")[0]


def says_holder(page, text):
    until(lambda: holder(page) == text)


def says(page, selector, text):
    until(lambda: page.inner_text(selector) == text)


def has_title(page, selector, text):
    until(lambda: page.get_attribute(selector, "title") == text)


def both_palettes(page, name):
    for _ in range(2):
        shot(page, f"who-{name}-{page.evaluate('document.documentElement.dataset.theme')}")
        page.keyboard.press("n")


@contextmanager
def paged(chromium, drive, name):
    with drive.station(name) as (url, running), opened(chromium, url, refused=True) as page:
        page.operator = running
        yield page


def test_operators_hand_control_over_with_pictures(chromium, drive, moving):
    with paged(chromium, drive, "alice") as alice, ExitStack() as stack:
        says_holder(alice, "You are in control")
        moving()
        bob = stack.enter_context(paged(chromium, drive, "bob"))
        says_holder(bob, "Operator alice is in control")
        until(lambda: [choice(bob), choice(alice)] == [["Request control"], ["Release", "Offer …"]])
        why = "alice is in control"
        has_title(bob, "[data-camera=rear] .switch", f"operator {why}; request control (t)")
        assert bob.locator("[data-camera=rear] .switch").is_disabled()
        assert send(bob, event="camera_switched", camera="rear", on=False)["reason"] == why
        both_palettes(bob, "watching")

        bob.keyboard.press("t")
        says(alice, "#hand-over-words", "bob asks for control")
        says(bob, "#hand-over-words", "You ask for control")
        both_palettes(alice, "asked")
        alice.keyboard.press("v")
        both_palettes(alice, "asked-drive")
        alice.keyboard.press("t")
        says(alice, "#hand-over-words", "You offer control to bob; you drive until bob accepts")
        all_live(bob)
        says(bob, "#hand-over-words", "alice offers control to you")
        both_palettes(bob, "offered")
        says_holder(alice, "You are in control")
        # On a busy machine a picture may be late for a moment, and has to be live for a second again.
        until(lambda: holder(bob) == "You are in control" or bob.keyboard.press("t"), every_s=1.0)
        says_holder(alice, "Operator bob is in control")
        assert "CONTROL LOST" not in alice.inner_text("#toasts")
        both_palettes(alice, "handed-over-drive")

        bob.keyboard.press("t")
        until(lambda: "the vehicle must stand before its control is released" in bob.inner_text("#toasts"))
        says_holder(bob, "You are in control")
        drive.positioner.speed_mps = 0.0
        until(lambda: holder(bob) == "Nobody is in control" or bob.keyboard.press("t"), every_s=1.0)
        says_holder(alice, "Nobody is in control")
        alice.keyboard.press("t")
        says_holder(alice, "You are in control")
        says_holder(bob, "Operator alice is in control")


def says_stop(page, who):
    until(lambda: page.inner_text("#hand-over-words").startswith(f"{who} asked to stop at "))
    assert page.inner_text("#hand-over-words").partition(", ")[0].endswith(": advised speed 0")


def is_advised(page, factor):
    return page.evaluate("tod.sample?.speed_factor") == factor


def choice(page):
    """The texts of the buttons about control."""
    return page.locator("#control button").all_inner_texts()


def test_a_supervisor_takes_control_a_watcher_may_not_and_a_driver_is_lost(chromium, drive, moving):
    with paged(chromium, drive, "alice") as alice:
        says_holder(alice, "You are in control")
        with paged(chromium, drive, "eve") as eve:
            says_holder(eve, "Operator alice is in control")
            until(lambda: choice(eve) == ["Request control"])
            has_title(eve, "#take-control", "a watcher may not drive")
            eve.keyboard.press("t")
            until(lambda: "a watcher may not drive" in eve.inner_text("#toasts"))
            eve.keyboard.press("x")
            says_stop(eve, "You")
            eve.keyboard.press("x")  # which lifts nothing
            says_stop(alice, "eve")
            assert not eve.get_by_text("Lift stop").count()
            both_palettes(eve, "stop-asked")
            for view in ("drive", "configure"):
                both_palettes(alice, f"stop-{view}")
                alice.keyboard.press("v")
            until(lambda: is_advised(alice, 0))
            alice.get_by_text("Lift stop").click()
            until(lambda: eve.is_hidden("#hand-over"))
            until(lambda: is_advised(alice, None))
        moving()
        with paged(chromium, drive, "sam") as sam:
            says_holder(sam, "Operator alice is in control")
            sam.get_by_text("Take control", exact=True).first.click()
            says(sam, "#confirm-text", "Operator alice drives, the vehicle goes at 29 km/h. Take control?")
            both_palettes(sam, "confirm")
            sam.locator("#confirm-yes").click()
            says_holder(sam, "You are in control")
            why = "operator sam is in control"
            until(lambda: alice.inner_text("#attention") == f"CONTROL LOST: {why}; request control (t)")
            assert f"CONTROL LOST: {why}" in alice.inner_text("#toasts")
            alice.keyboard.press("t")
            says(sam, "#hand-over-words", "alice asks for control")
            sam.operator.kill()
            says_holder(alice, "Operator sam is lost")
            both_palettes(alice, "lost")
        drive.positioner.speed_mps = 0.0
        says_holder(alice, "You are in control")
