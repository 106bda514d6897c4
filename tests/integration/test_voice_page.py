"""The operator speaks at the page of a real browser, whose microphone hears a tone, and is heard at the vehicle."""

from __future__ import annotations

import math
import signal
import struct
import time
import wave
from contextlib import contextmanager

import pytest

from browser import opened, shot, until
from rig import BROWSER, CHROMIUM_FLAGS, SMALL_ROBOT, answers, free_port, needs_browser, process
from runner.mqtt.broker import private_broker
from runner.settings import Endpoint

pytestmark = [pytest.mark.gst, needs_browser]
ROBOT = (*SMALL_ROBOT, "source=test", "fps_max=10", "modes=open_loop", "pqos=constant", "pqos.kbps=3000")
RATE = 48_000
TALKING, KEY = "() => tod.talking()", "i"
END_S = 0.5


@contextmanager
def microphone(chromium, tmp_path):
    """A browser whose microphone hears a tone."""
    file = tmp_path / "tone.wav"
    with wave.open(str(file), "wb") as out:
        out.setnchannels(1)
        out.setsampwidth(2)
        out.setframerate(RATE)
        out.writeframes(b"".join(struct.pack("<h", round(8000 * math.sin(i / 17.4))) for i in range(2 * RATE)))
    fake = [
        "--use-fake-device-for-media-stream",
        "--use-fake-ui-for-media-stream",
        f"--use-file-for-fake-audio-capture={file}",
    ]
    browser = chromium.browser_type.launch(executable_path=BROWSER, args=[*CHROMIUM_FLAGS, *fake])
    try:
        yield browser
    finally:
        browser.close()


@contextmanager
def sides(heard, *of_vehicle):
    """Vehicle and operator as two processes. Yields the page's address, and the operator's process."""
    control, media, port = (free_port() for _ in range(3))
    words = (*ROBOT, "voice=file", f"control.port={control}", f"media.port={media}", f"page.port={port}")
    with (
        private_broker(Endpoint("127.0.0.1", control)),
        process("operator", *words, "sound=test") as operator,
        process("vehicle", *words, "sound=test", f"voice.file={heard}", *of_vehicle),
    ):
        until(lambda: answers(port))
        yield f"http://127.0.0.1:{port}/", operator


def written(heard):
    return heard.stat().st_size if heard.exists() else 0


def connect(page):
    """In control, as the only page is, and connected to the loudspeaker."""
    page.click("#vehicle")
    until(lambda: page.evaluate(TALKING)["why"] == "")


def speaks(page):
    """Hold the key until it is heard; on a busy machine the vehicle may be silent meanwhile, which ends a press."""

    def is_heard():
        if not page.evaluate(TALKING)["held"]:
            page.keyboard.up(KEY)
            page.keyboard.down(KEY)
        return page.inner_text("#talking") == "SPEAKING"

    until(is_heard)


def is_silent(page):
    return not page.evaluate("() => tod.state.voice.speaking")


def test_a_held_key_is_heard_at_the_vehicle_and_mutes_its_sound_here(chromium, tmp_path):
    heard = tmp_path / "heard"
    with (
        microphone(chromium, tmp_path) as browser,
        sides(heard) as (url, operator),
        opened(browser, url, permissions=["microphone"]) as page,
    ):
        connect(page)
        until(lambda: page.evaluate("() => tod.hearing()")["gain"] > 0.9)
        speaks(page)
        until(lambda: written(heard) > 2 * RATE)
        until(lambda: page.evaluate("() => tod.hearing()")["gain"] < 0.01)
        shot(page, "voice-speaking")
        page.keyboard.up(KEY)
        until(lambda: is_silent(page))
        until(lambda: page.inner_text("#talking") == "Speak")
        until(lambda: page.evaluate("() => tod.hearing()")["gain"] > 0.9)
        samples = struct.unpack(f"<{RATE // 2}h", heard.read_bytes()[-RATE:])
        assert max(samples) > 1000  # the browser's own processing changes its level
        page.keyboard.press("v")
        until(lambda: page.evaluate("tod.view") == "drive")
        speaks(page)
        shot(page, "voice-drive")
        page.evaluate("() => dispatchEvent(new Event('blur'))")
        until(lambda: is_silent(page))
        speaks(page)
        operator.send_signal(signal.SIGSTOP)
        at_end = written(heard)
        until(lambda: settled(heard))
        assert written(heard) - at_end < END_S * 2 * RATE
        operator.send_signal(signal.SIGCONT)
        page.keyboard.up(KEY)


def settled(heard):
    """Whether nothing has been written for a second."""
    before = written(heard)
    time.sleep(1)
    return written(heard) == before


def test_without_a_microphone_the_page_says_so(chromium, tmp_path):
    with sides(tmp_path / "heard") as (url, _), opened(chromium, url) as page:
        connect(page)
        page.keyboard.down(KEY)
        until(lambda: page.evaluate(TALKING)["why"] in REASONS)
        assert page.inner_text("#talking") == "✕ Speak"
        page.keyboard.up(KEY)


REASONS = ("the browser gives this page no microphone", "there is no microphone")


def test_a_loudspeaker_that_does_not_open_is_named(chromium, tmp_path):
    missing = tmp_path / "missing" / "heard"
    with sides(missing) as (url, _), opened(chromium, url) as page:
        page.click("#vehicle")
        until(lambda: f"filesink {missing}: Could not open file" in page.evaluate(TALKING)["why"])
