"""An IP camera whose bitrate a command sets: what it delivers follows what it is asked for."""

from __future__ import annotations

import time
from contextlib import contextmanager

import pytest
from told_camera import told_camera

from rig import faults, streaming, until, watching
from runner.core.commands import Command

pytestmark = [pytest.mark.gst, pytest.mark.timed]

CAMERA = (
    "videotestsrc is-live=true pattern=snow ! video/x-raw,format=I420,width=320,height=240,framerate=25/1"
    " ! x264enc name=encoder tune=zerolatency speed-preset=ultrafast bitrate=2000 vbv-buf-capacity=200 key-int-max=25"
    " ! rtph264pay name=pay0 pt=96"
)


@contextmanager
def passing(camera, command, *words):
    """A robot whose rear camera is passed on. Yields (side, plan, reported)."""
    knob = f"graph.knobs.bitrate=[{{command: {command}, every_s: 0.3, within_s: 5}}]"
    of_robot = ("vehicle=delivery_robot", "source=rtsp", "graph=pass_through", "fps_max=25")
    with streaming(*of_robot, f'source.address="{camera.rtsp}"', knob, *words, cameras=("rear",)) as parts:
        side, _, plans, reported = parts
        side.turn([Command("rear", "sending", True)])
        yield side, plans[0], reported


def kbps(side, seconds=2.0):
    """What the camera delivers now."""
    before, began = side.read()["rear"].encoded.bytes, time.monotonic()
    time.sleep(seconds)
    return 8 * (side.read()["rear"].encoded.bytes - before) / (time.monotonic() - began) / 1000


def ask(side, value):
    side.turn([Command("rear", "bitrate", value)])


def test_what_it_delivers_follows_the_command():
    with told_camera(CAMERA) as camera:
        command = f'[curl, -fsS, "{camera.http}/encoder/bitrate/{{kbps}}"]'
        with passing(camera, command) as (side, plan, reported), watching(plan) as client:
            until(lambda: len(client.sizes) > 20)
            assert "bitrate" not in side.read()["rear"].applied
            for asked in (400, 1600):
                ask(side, asked)
                until(lambda: side.read()["rear"].applied.get("bitrate") == asked)  # noqa: B023
                until(lambda: 0.7 * asked < kbps(side) < 1.3 * asked)  # noqa: B023
            assert not [line for line in reported if "bitrate" in line]
            assert set(client.sizes) == {(320, 240)}


def test_pictures_go_on_while_it_fails():
    with told_camera(CAMERA) as camera:
        command = f'[curl, -fsS, "{camera.http}/nothing/bitrate/{{kbps}}"]'
        with passing(camera, command) as (side, plan, reported), watching(plan) as client:
            until(lambda: len(client.sizes) > 20)
            ask(side, 400)
            until(lambda: any("its bitrate cannot be set: curl: status 52: curl: (52)" in line for line in reported))
            seen = len(client.sizes)
            until(lambda: len(client.sizes) > seen + 20)
            assert "bitrate" not in side.read()["rear"].applied
            assert faults(reported)[0] == "rear: pipeline built"
