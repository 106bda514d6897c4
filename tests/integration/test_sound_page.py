"""The vehicle's sound on the operator's page, in a real browser."""

from __future__ import annotations

from contextlib import contextmanager
from functools import partial

import pytest

from browser import SOUND_BLOCKED, opened, shot, until
from rig import SMALL_ROBOT, answers, free_port, needs_browser, process
from runner.mqtt.broker import private_broker
from runner.settings import Endpoint

pytestmark = [pytest.mark.gst, needs_browser]
ROBOT = (*SMALL_ROBOT, "source=test", "fps_max=10", "modes=open_loop", "pqos=constant", "pqos.kbps=3000")
TONE_DB = -15.05
HEARD = "() => tod.hearing()"


@contextmanager
def sides(*overrides, more=()):
    """Vehicle and operator as two processes. Yields the page's address, and a way to start the vehicle.

    more  words of the operator alone
    """
    control, media, port = (free_port() for _ in range(3))
    words = (*ROBOT, f"control.port={control}", f"media.port={media}", f"page.port={port}")
    with private_broker(Endpoint("127.0.0.1", control)), process("operator", *words, "sound=test", *more):
        until(lambda: answers(port))
        yield f"http://127.0.0.1:{port}/", partial(process, "vehicle", *words, *overrides)


def test_the_page_plays_a_tone_in_step_with_the_pictures_and_mutes_it(chromium, tmp_path):
    recorded = (f"log={tmp_path / 'drive'}", "log.sound=true")
    with sides("sound=test", more=recorded) as (url, vehicle), opened(chromium, url) as page, vehicle():
        page.click("#vehicle")  # browsers play nothing before a press
        until(lambda: page.evaluate(HEARD)["level_db"] == pytest.approx(TONE_DB, abs=1))
        until(lambda: page.evaluate(HEARD)["fault"] == "")
        assert page.evaluate(HEARD)["state"] == "running"
        until(lambda: (page.evaluate(HEARD)["ahead_ms"] or 1000) <= 80)
        until(lambda: page.inner_text("#hearing").startswith("Sound "))
        until(lambda: page.inner_text("#hearing").endswith(" ms · recorded"))
        shot(page, "sound-configure")
        page.click("#hearing")
        until(lambda: page.evaluate(HEARD)["gain"] < 0.01)
        until(lambda: page.inner_text("#hearing") == "✕ Sound muted · recorded")
        until(lambda: page.evaluate(HEARD)["level_db"] == pytest.approx(TONE_DB, abs=1))  # of what would be heard
        page.click("#hearing")
        until(lambda: page.evaluate(HEARD)["gain"] > 0.9)
        page.keyboard.press("v")
        until(lambda: page.evaluate("tod.view") == "drive")
        page.keyboard.press("h")
        until(lambda: page.inner_text("#line").endswith("✕ sound muted"))
        page.keyboard.press("h")
        until(lambda: "sound" not in page.inner_text("#line"))
        shot(page, "sound-drive")


def test_a_browser_that_blocks_sound_and_a_lost_source_are_named(chromium, tmp_path):
    missing = tmp_path / "siren.wav"
    missing.write_bytes(b"")
    with (
        sides("sound=file", f"sound.clip={missing}") as (url, vehicle),
        opened(chromium, url, script=SOUND_BLOCKED) as page,
        vehicle(),
    ):
        source = f"filesrc {missing}"  # on a busy machine, the second
        whys = (f"{source}: Stream contains no data", f"{source} gives no sound within 3 s")
        until(lambda: page.evaluate(HEARD)["fault"] in whys)
        titles = [f"The vehicle's sound: {why}\nmute (h)" for why in whys]
        until(lambda: page.get_attribute("#hearing", "title") in titles)
    with sides("sound=test") as (url, vehicle), opened(chromium, url, script=SOUND_BLOCKED) as page, vehicle():
        until(lambda: page.evaluate(HEARD)["fault"] == "blocked by the browser until a click or key press")
        assert "blocked" in page.inner_text("#hearing")
        page.click("#hearing")
        until(lambda: page.evaluate(HEARD)["fault"] == "")
        assert page.evaluate(HEARD)["gain"] > 0.9  # the press that allowed it has not muted it
