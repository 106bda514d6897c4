"""An IP camera whose bitrate a command sets: what it delivers follows what it is asked for."""

from __future__ import annotations

import threading
import time
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from types import SimpleNamespace

import pytest
from odd_camera import Habits, odd_camera
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
            until(lambda: any("its bitrate cannot be set: curl: status 22: curl: (22)" in line for line in reported))
            seen = len(client.sizes)
            until(lambda: len(client.sizes) > seen + 20)
            assert "bitrate" not in side.read()["rear"].applied
            assert faults(reported)[0] == "rear: pipeline built"


def test_a_camera_whose_stream_ends_with_each_change_comes_back():
    with odd_camera(Habits()) as camera, told_to(camera.drop) as address:
        words = (f'source.address="{camera.address}"', "fps_max=15")
        with passing(SimpleNamespace(rtsp=camera.address), f'[curl, -fsS, "{address}/{{kbps}}"]', *words) as parts:
            side, plan, reported = parts
            with watching(plan) as client:
                until(lambda: client.frames_with_retry() > 10)
                ask(side, 400)
                until(lambda: any("works again" in line for line in reported))
                seen = len(client.sizes)
                until(lambda: len(client.sizes) > seen + 20)
                assert side.read()["rear"].applied["bitrate"] == 400


@contextmanager
def told_to(do):
    """An HTTP server that does something at each request. Yields its address."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self):
            do()
            self.send_response(200)
            self.send_header("Content-Length", "0")
            self.end_headers()

        def log_message(self, *_):
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_port}"
    finally:
        server.shutdown()
        server.server_close()
