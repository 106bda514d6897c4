"""The page's server with still pictures in place of a drive."""

from __future__ import annotations

import io
import json
import subprocess
import time
from contextlib import contextmanager
from dataclasses import asdict
from types import SimpleNamespace

import numpy as np
import pytest
from painted import CAR

from browser import until
from rig import free_port, needs_browser, repeating
from runner.configuration.config import configuration
from runner.core.events import parse
from runner.core.model import plain
from runner.core.step import start, step
from runner.h264.access_unit import read_unit
from runner.operator.seen import StatedView
from runner.operator.station import LinkState
from runner.page.server import PageServer
from runner.records.vehicle import CameraReading, CameraState, VehicleState

MARKS = [
    pytest.mark.gst,
    pytest.mark.soak,  # builds a street
    needs_browser,
]
image = pytest.importorskip("PIL.Image")
pytest.importorskip("cv2")
pytest.importorskip("numba")

FPS = 1  # as the page knows it; pictures are sent more often, so that none is late on a busy machine
EVERY_S = 0.4


class Station(SimpleNamespace):
    """A stub of the operator's side: a vehicle in mode S whose cameras each send one picture.

    place     directory for its configuration
    cameras   by name, as in painted.py
    pictures  by name, I420 of the native size
    size      of the full images, px
    """

    def __init__(self, place, cameras, pictures, size, estimated=(), words=()):
        self.cameras, self.silent = cameras, set()
        (place / "conf" / "vehicle").mkdir(parents=True)
        document = vehicle_file(cameras, size, estimated)
        (place / "conf" / "vehicle" / "marks.yaml").write_text(f"# @package _global_\n{json.dumps(document)}\n")
        words = ["vehicle=marks", "source=test", "mode=single", f"page.port={free_port()}", *words]
        self.setup = configuration(words, place / "conf").setup()
        self.vehicle = self.setup.vehicle
        self.run = start(self.vehicle)
        for name, camera in cameras.items():
            self.step(event="camera_configured", camera=name, kbps=4000, scaling=camera.factor)
            if camera.roi:
                roi = dict(zip(("x", "y", "width", "height"), camera.roi, strict=True))
                self.step(event="roi_set", camera=name, **roi)
        self.step(event="operator_connected", operator="anna", role="controller")
        self.units = {name: self.encoded(name, picture) for name, picture in pictures.items()}
        told = {
            "note": print,
            "own_time": float,
            "identity": "anna",
            "answer_s": 1.0,
            "attention": None,
            "link_state": LinkState(),
            "seen": StatedView(),
        }
        latency = SimpleNamespace(captured=lambda camera, at: at)  # both clocks are one
        super().__init__(state=self.published(), latency=latency, **told)

    def step(self, **event):
        self.run = step(self.vehicle, self.run, parse({"t": 0, **event}))
        assert not self.run.refused

    def published(self):
        run = self.run
        cameras = {
            name: CameraState.at(setting, 1, name, CameraReading(run.commanded[name]))
            for name, setting in run.decision.settings.items()
        }
        totals = (plain(run.decision.total), plain(run.decision.asked))
        return VehicleState(1.0, "", run.decision.mode, *totals, cameras, driving=run.state.driving)

    def encoded(self, name, picture):
        """An H.264 keyframe of a native picture, cropped and scaled as the vehicle would send it."""
        (width, height), setting = self.cameras[name].native, self.run.decision.settings[name]
        roi, top = setting.roi, self.cameras[name].top
        edges = (f"left={roi.x}", f"right={width - roi.x - roi.width}")
        edges += (f"top={top + roi.y}", f"bottom={height - top - roi.y - roi.height}")
        size = f"video/x-raw,width={setting.width},height={setting.height},pixel-aspect-ratio=1/1"
        stream = "video/x-h264,stream-format=byte-stream,alignment=au,profile=constrained-baseline"
        line = ["gst-launch-1.0", "-q", "fdsrc", "fd=0", "!", "rawvideoparse", "format=i420", f"width={width}"]
        line += [
            f"height={height}",
            f"framerate={FPS}/1",
            "!",
            "videocrop",
            *edges,
            "!",
            "videoscale",
            "add-borders=false",
        ]
        line += ["!", size, "!", "x264enc", "tune=zerolatency", "bitrate=8000", "!", stream, "!", "fdsink", "fd=1"]
        done = subprocess.run(line, input=picture, capture_output=True, check=True, timeout=60)
        return done.stdout

    def ask(self, document, on_reply):
        self.last_request = document


def vehicle_file(cameras, size, estimated):
    """estimated: names of the cameras that are not calibrated"""
    described = {
        name: {
            "width_px": size[0],
            "height_px": size[1],
            "fps": FPS,
            "native": {"width_px": camera.native[0], "height_px": camera.native[1], "top_px": camera.top},
            "lens": camera.lens,
            "fov_deg": camera.fov_deg,
            "calibrated": name not in estimated,
            "rate_quality": {"scaling": [0.5, 1.0], "b_min_kbps": [0, 100], "b_full_kbps": 8000},
            "pose": asdict(camera.pose),
        }
        for name, camera in cameras.items()
    }
    return {"name": "marks", "dimensions": asdict(CAR), "cameras": described}


@contextmanager
def serving(station):
    """The page's server, sending the pictures of all cameras except the silent ones."""
    page = PageServer(station.setup, station)
    page.behind_s = 0.0  # how long ago pictures were captured

    def send():
        for name, data in station.units.items():
            if name not in station.silent:
                page.show(name, read_unit(data, time.time() - page.behind_s, time.time()))

    page.start()
    try:
        with repeating(send, EVERY_S):
            yield page
    finally:
        page.stop()


def on_screen(locator, before, mode="L"):
    """A screenshot in a PIL mode, and what `before` returned, truthy and equal, both before and after it."""

    def pictured():
        known = before()
        png = locator.screenshot()
        return png, known, before()

    png, known, _ = until(lambda: (taken := pictured())[1] and taken[1] == taken[2] and taken)
    return np.asarray(image.open(io.BytesIO(png)).convert(mode), float), known


def steering(served, rad, gear=None):
    """Report the steering angle, and the gear, 20 times a second."""
    return repeating(lambda: served.on_steering(time.time(), rad, gear), 0.05)
