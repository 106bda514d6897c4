"""Each encoded picture says which part of the full image it shows, compared with the content of the decoded picture."""

from __future__ import annotations

import os
import random
import threading
import time
from itertools import pairwise

import numpy as np
import pytest

from rig import streaming, until
from runner.core.commands import Command
from runner.core.events import parse
from runner.core.model import Roi
from runner.core.step import start, step
from runner.h264.access_unit import nal_units

pytestmark = pytest.mark.gst
cv2 = pytest.importorskip("cv2")

WIDTH, HEIGHT = 160, 96  # of the full image
FULL = Roi(0, 0, WIDTH, HEIGHT)
SIZE = (80, 48)  # of the encoded pictures
CAMERA = "front_left"
WORDS = ("source=appsrc", f"cameras.{CAMERA}.width_px={WIDTH}", f"cameras.{CAMERA}.height_px={HEIGHT}")
CHANGES, SEED = int(os.environ.get("TOD_NEW_REGIONS", "60")), 7
DETAIL_PX = 1.5


def texture():
    """A grey picture that is different everywhere, in details of a few px."""
    noise = np.random.default_rng(SEED).uniform(0, 255, (HEIGHT, WIDTH)).astype(np.float32)
    return cv2.normalize(cv2.GaussianBlur(noise, None, DETAIL_PX), None, 30, 220, cv2.NORM_MINMAX).astype(np.uint8)


def alike(picture, image, roi):
    """Correlation of a picture with a region of the image."""
    part = image[roi.y : roi.y + roi.height, roi.x : roi.x + roi.width].astype(np.float32)
    scaled = cv2.resize(part, picture.shape[1::-1], interpolation=cv2.INTER_AREA)
    return np.corrcoef(scaled.ravel(), picture[..., 0].astype(np.float32).ravel())[0, 1]


def beside(roi):
    """Regions that are one px away."""
    for x, y in [(-1, 0), (1, 0), (0, -1), (0, 1)]:
        if 0 <= roi.x + x <= WIDTH - roi.width and 0 <= roi.y + y <= HEIGHT - roi.height:
            yield Roi(roi.x + x, roi.y + y, roi.width, roi.height)


def regions():
    """Some move, some zoom, some change one edge alone, some show the full image."""
    chance, region = random.Random(SEED), FULL
    for number in range(CHANGES):
        if number % 10 == 0:
            region = FULL
        elif number % 3 == 0 and region.x + region.width < WIDTH:
            region = Roi(region.x, region.y, WIDTH - region.x, region.height)
        else:
            width, height = 2 * chance.randint(40, 79), 2 * chance.randint(24, 47)
            x, y = 2 * chance.randint(0, (WIDTH - width) // 2), 2 * chance.randint(0, (HEIGHT - height) // 2)
            region = Roi(x, y, width, height)
        yield region


class Received:
    """Access units and decoded pictures by capture time."""

    def __init__(self):
        self.units, self.pictures, self.lock = {}, {}, threading.Lock()

    def on_unit(self, _camera, unit):
        with self.lock:
            self.units[unit.captured] = unit

    def on_picture(self, _camera, captured, width, height, data, region):
        rows = np.frombuffer(data, np.uint8).reshape(height, -1)[:, : 3 * width]
        with self.lock:
            self.pictures[captured] = rows.reshape(height, width, 3).copy(), region


def test_each_picture_says_what_it_shows_through_changes_of_region():
    from runner.apply import OperatorSide

    received = Received()
    with streaming(*WORDS) as (side, _, plans, reported):
        side.turn([Command(CAMERA, "size", SIZE), Command(CAMERA, "bitrate", 2000)])
        station = OperatorSide(plans, lambda camera, what: reported.append(what), received.on_unit, received.on_picture)
        image, ended = texture(), threading.Event()

        def push():
            while not ended.wait(0.03):
                side.push(CAMERA, image)

        pushing = threading.Thread(target=push)
        pushing.start()
        try:
            until(lambda: station.sample({CAMERA: True}) and len(received.pictures) > 5)
            for region in regions():
                side.turn([Command(CAMERA, "roi", region)])
                time.sleep(0.1)
        finally:
            ended.set()
            pushing.join()
            station.stop()
    compared = [(received.units[at], shown) for at, (shown, _) in received.pictures.items() if at in received.units]
    handed = {at: region for at, (_, region) in received.pictures.items() if at in received.units}
    assert handed == {at: received.units[at].region for at in handed}
    assert len(compared) > CHANGES
    stated = {unit.region for unit, _ in compared}
    assert len(stated) > CHANGES / 3
    assert None in stated
    assert FULL not in stated
    found = [(number, unit.region or FULL, shown) for number, (unit, shown) in enumerate(compared)]
    # Half a px: none that is one px away is more alike.
    wrong = [
        (number, roi, own, beyond)
        for number, roi, shown in found
        if (own := alike(shown, image, roi))
        <= (beyond := max([0.9, *(alike(shown, image, each) for each in beside(roi))]))
    ]
    assert not wrong, (len(wrong), len(compared), wrong[:5])
    kinds = [[header & 0x1F for header, _ in nal_units(unit.data)] for unit, _ in compared if unit.region is None]
    waves = [unit.recovery is not None for unit, _ in compared if unit.region is None]
    assert all(kind.count(6) <= 1 + wave for kind, wave in zip(kinds, waves, strict=True))


def starts(received):
    """How often the encoder has started: x264 gives its parameter sets another number each time."""
    with received.lock:
        units = [received.units[at] for at in sorted(received.units)]
    sets = [unit.data[at : at + 5] for unit in units for header, at in nal_units(unit.data) if header & 0x1F == 7]
    return 1 + sum(one != other for one, other in pairwise(sets))


def test_a_pan_and_a_zoom_restart_no_encoder():
    from runner.apply import OperatorSide

    always = f"cameras.{CAMERA}.always={{x: 300, y: 160, width: 32, height: 32}}"
    size = (f"cameras.{CAMERA}.width_px=640", f"cameras.{CAMERA}.height_px=360")
    received = Received()
    with streaming("source=test", "fps_max=15", "modes=seen", "mode=collective", *size, always) as (
        side,
        setup,
        plans,
        _,
    ):
        station = OperatorSide(plans, lambda camera, what: None, received.on_unit, received.on_picture)
        run, keys = start(setup.vehicle), ("x", "y", "width", "height", "screen_width", "screen_height")

        def feed(event, **more):
            nonlocal run
            run = step(setup.vehicle, run, parse({"t": run.state.t + 0.1, "event": event} | more))
            side.turn(run.commands)

        def look(*region):
            feed("view_reported", view={CAMERA: dict(zip(keys, (*region, 640, 360), strict=True))})
            time.sleep(0.1)

        def sends(region, picture_size):
            """The newest picture is of this region and size."""
            with received.lock:
                picture, stated = list(received.pictures.values())[-1]
            return stated == region and picture.shape[1::-1] == picture_size

        def rests(seconds):
            for _ in range(round(10 * seconds)):
                feed("clock_advanced")
            setting = run.decision.settings[CAMERA]
            until(lambda: received.pictures and sends(setting.roi, (setting.width, setting.height)))

        try:
            feed("total_set", kbps=8000)
            feed("attention_changed", attention="watching")
            look(64, 64, 320, 180)
            rests(10)
            before, regions = starts(received), set()
            for tenth in range(30):
                look(64 + 8 * tenth, 64, 320, 180)
                regions.add(run.decision.settings[CAMERA].roi)
            for tenth in range(10):
                look(296 - 4 * tenth, 64, 320 + 4 * tenth, 180 + 2 * tenth)
                regions.add(run.decision.settings[CAMERA].roi)
            rests(2)
            assert starts(received) == before
            assert len(regions) > 8
            look(300, 160, 32, 32)
            rests(2)
            assert starts(received) == before + 1, "this size suits it too badly"
        finally:
            station.stop()
    stated = {unit.region for unit in received.units.values()}
    assert len(stated & regions) > 5
