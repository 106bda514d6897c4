"""Pictures that say which part of the image they show, in a real browser: each is drawn in its place."""

from __future__ import annotations

import base64
import io
import os
import random
import shutil
import subprocess
import time
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest
from test_page_layouts import WORDS, Station

from browser import opened, shot, until
from rig import SMALL_ROBOT, free_port, needs_browser, repeating
from runner.configuration.config import configuration
from runner.core.model import Roi
from runner.h264.access_unit import read_unit
from runner.h264.region import with_region
from runner.page import documents
from runner.page.server import PageServer

pytestmark = [pytest.mark.gst, needs_browser]
pytest.importorskip("aiohttp")
image = pytest.importorskip("PIL.Image")
cv2 = pytest.importorskip("cv2")

WIDTH, HEIGHT = 320, 180  # of the full image of the front camera
FULL, MIDDLE = Roi(0, 0, WIDTH, HEIGHT), Roi(80, 46, 160, 90)
SIZE = (160, 90)  # of the encoded pictures
CHANGES, SEED = int(os.environ.get("TOD_NEW_REGIONS", "60")), 5
FRONT = "front"


def texture():
    """A grey image that is different everywhere, in details of a few px."""
    noise = np.random.default_rng(SEED).uniform(0, 255, (HEIGHT, WIDTH)).astype(np.float32)
    return cv2.normalize(cv2.GaussianBlur(noise, None, 3), None, 30, 220, cv2.NORM_MINMAX).astype(np.uint8)


def part_of(whole, roi, size):
    # It is smooth: linear interpolation keeps it, and does not move it where one side is enlarged, as INTER_AREA does.
    return cv2.resize(whole[roi.y : roi.y + roi.height, roi.x : roi.x + roi.width], size)


def encoded(whole, roi, size=SIZE):
    """A region as an H.264 key picture that says so."""
    width, height = size
    grey = part_of(whole, roi, size).tobytes() + bytes([128]) * (width * height // 2)
    stream = "video/x-h264,stream-format=byte-stream,alignment=au,profile=constrained-baseline"
    line = f"fdsrc fd=0 ! rawvideoparse format=i420 width={width} height={height} framerate=25/1 "
    line += f"! x264enc tune=zerolatency bitrate=8000 ! {stream} ! fdsink fd=1"
    run = subprocess.run(
        ["gst-launch-1.0", "-q", *line.split()], input=grey, capture_output=True, check=True, timeout=60
    )
    return run.stdout if roi == FULL else with_region(run.stdout, roi)


@contextmanager
def served():
    words = [*SMALL_ROBOT, *WORDS, "fps_max=15", "page.late_ms=5000", f"page.port={free_port()}"]
    setup = configuration(words).setup()
    station = Station(setup.vehicle)
    station.unit = b""
    station.page = PageServer(setup, station)
    station.page.start()
    try:
        yield station
    finally:
        station.page.stop()


def decided(station, roi, chosen=FULL):
    """The vehicle decides on a region, and says that its pictures say what they show."""
    front = replace(station.state.cameras[FRONT], roi=roi, chosen=chosen, placed=True, applied={"roi": roi.to_json()})
    station.state = replace(station.state, cameras={**station.state.cameras, FRONT: front})
    station.page.on_state(station.state)


def send(station, unit):
    if received := read_unit(unit, time.time(), time.time()):
        station.page.show(FRONT, received)


def decoded(text):
    """The luma of a picture as the page describes it."""
    return np.frombuffer(base64.b64decode(text), np.uint8).reshape(SIZE[::-1])


def on_screen(page):
    """The front camera's picture on the screen, as large as the full image."""
    box = page.locator(f'.tile[data-camera="{FRONT}"] .picture canvas').first
    grey = np.asarray(image.open(io.BytesIO(box.screenshot())).convert("L"))
    return cv2.resize(grey, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)


def alike(one, other):
    return np.corrcoef(one.ravel().astype(float), other.ravel().astype(float))[0, 1]


def inner(picture, roi, margin=6):
    return picture[roi.y + margin : roi.y + roi.height - margin, roi.x + margin : roi.x + roi.width - margin]


@pytest.fixture
def as_with_gpu(monkeypatch, tmp_path):
    """The page takes Chromium's WebGL in software for a GPU."""
    static = tmp_path / "static"
    shutil.copytree(documents.STATIC, static)
    worker = static / "warp_worker.js"
    text = worker.read_text()
    assert text.count("return !SOFTWARE.test(name);") == 1
    worker.write_text(text.replace("return !SOFTWARE.test(name);", "return name !== '';"))
    monkeypatch.setattr(documents, "STATIC", static)


@pytest.mark.parametrize("gpu", [False, True])
def test_a_part_is_drawn_in_its_place_and_the_rest_is_marked_as_not_sent(chromium, gpu, request):
    if gpu:
        request.getfixturevalue("as_with_gpu")
    whole = texture()
    part, full = encoded(whole, MIDDLE), encoded(whole, FULL)
    with (
        served() as station,
        repeating(lambda: send(station, station.unit), 0.05),
        opened(chromium, station.page.url, 1280, 720) as page,
    ):
        until(lambda: page.evaluate("tod.measure()")["gpu"] == gpu)
        page.add_style_tag(content="#attention, #toasts, .diagram { visibility: hidden; }")

        def shows(unit, region, note):
            station.unit = unit
            measured = page.evaluate("tod.measure()")["cameras"].get(FRONT)
            picture = page.evaluate(f"tod.picture('{FRONT}')")
            return picture and picture["region"] == region and measured["note"] == note

        def fills(expected):
            return alike(inner(on_screen(page), MIDDLE), inner(expected, MIDDLE)) > 0.9

        decided(station, FULL)
        until(lambda: shows(full, None, ""))
        until(lambda: fills(whole))
        decided(station, MIDDLE)
        until(lambda: shows(part, MIDDLE.to_json(), "PART NOT SENT"))

        def is_placed():
            screen = on_screen(page)
            own = alike(inner(screen, MIDDLE), inner(whole, MIDDLE))
            moved = [np.roll(whole, (y, x), (0, 1)) for x, y in [(-1, 0), (1, 0), (0, -1), (0, 1)]]
            beside = max(alike(inner(screen, MIDDLE), inner(other, MIDDLE)) for other in moved)
            outside = np.concatenate([screen[60:120, 10:70].ravel(), screen[60:120, 250:310].ravel()])
            return own > 0.9 and own > beside and outside.mean() < 90

        until(is_placed)
        shot(page, f"part-not-sent{'-gpu' * gpu}")

        def drawn_px():
            return page.evaluate("tod.measure()")["cameras"][FRONT]["drawn_size"]["width"]

        # As large as on the screen, or left to the browser, unless a busy machine's picture is frozen for a moment.
        until(lambda: (drawn_px() > WIDTH) == gpu)
        squeezed = encoded(whole, MIDDLE, (96, 128)), encoded(whole, FULL, (96, 128))  # pixels that are not square
        until(lambda: shows(squeezed[0], MIDDLE.to_json(), "PART NOT SENT"))
        until(is_placed)
        until(lambda: shows(squeezed[1], None, ""))
        until(lambda: fills(whole))
        decided(station, MIDDLE, chosen=MIDDLE)  # the operator has chosen this part: it fills the tile
        until(lambda: shows(part, MIDDLE.to_json(), ""))
        until(lambda: fills(part_of(whole, MIDDLE, (WIDTH, HEIGHT))))


def test_each_drawn_picture_has_its_own_region_through_changes_at_ten_a_second(chromium):
    whole, chance = texture(), random.Random(SEED)
    regions = [FULL]
    while len(regions) < 20:
        width = 2 * chance.randint(45, 150)
        height = 2 * round(width * 9 / 32)
        x, y = 2 * chance.randint(0, (WIDTH - width) // 2), 2 * chance.randint(0, (HEIGHT - height) // 2)
        regions.append(Roi(x, y, width, height))
    units = [encoded(whole, region) for region in regions]
    with served() as station, opened(chromium, station.page.url, 1280, 720) as page:
        decided(station, FULL)
        until(lambda: (send(station, units[0]) or True) and page.evaluate(f"tod.picture('{FRONT}')"))
        known, drawn, partly = {}, 0, 0
        for number in range(CHANGES):
            at, changed = number % len(regions), time.monotonic()
            decided(station, regions[at])
            for _ in range(2):
                send(station, units[at])
                # Of whatever picture is drawn now, an earlier one or this one.
                ask = f"tod.picture('{FRONT}')"
                picture, measured, later = page.evaluate(f"Promise.all([{ask}, tod.measure(), {ask}])")
                front = measured["cameras"][FRONT]
                if picture["region"] and later["sequence"] == picture["sequence"] and front["status"] == "live":
                    partly += 1
                    assert front["note"] == "PART NOT SENT"
                region = Roi(**picture["region"]) if picture["region"] else FULL
                key = (picture["luma"], region)
                drawn += picture["sequence"] not in known
                known[picture["sequence"]] = key
            time.sleep(max(0.0, changed + 0.1 - time.monotonic()))
        assert drawn > CHANGES / 2
        assert partly > CHANGES / 4
        assert len({region for _, region in known.values()}) == len(regions)
        for text, region in set(known.values()):
            (own,) = [other for other in regions if other == region]
            found = decoded(text)
            others = [alike(found, part_of(whole, other, SIZE)) for other in regions if other != own]
            assert alike(found, part_of(whole, own, SIZE)) > max(0.9, *others), region


def catmull_rom(picture, width, height):
    """A picture enlarged by definition: Keys's kernel with a = -1/2, its rim repeated."""

    def matrix(small, large):
        at = (np.arange(large) + 0.5) * small / large - 0.5
        weights = np.zeros((large, small))
        for tap in range(-1, 3):
            place = np.floor(at).astype(int) + tap
            off = np.abs(at - place)
            near, far = 1.5 * off**3 - 2.5 * off**2 + 1, -0.5 * off**3 + 2.5 * off**2 - 4 * off + 2
            np.add.at(weights, (np.arange(large), place.clip(0, small - 1)), np.where(off <= 1, near, far))
        return weights

    high, wide = picture.shape
    return matrix(high, height) @ picture @ matrix(wide, width).T


def test_the_gpu_s_kernel_is_cubic_and_leaves_the_picture_in_place(chromium):
    """Two pictures in turn, the second one smaller."""
    noise = np.random.default_rng(SEED).integers(0, 256, (9, 12), dtype=np.uint8)
    with served() as station, opened(chromium, station.page.url) as page:
        for picture, (width, height) in ((noise, (60, 45)), (noise[:5, :7], (28, 20))):
            high, wide = picture.shape
            pixels = np.repeat(picture[..., None], 4, axis=2)
            pixels[..., 3] = 255
            found = page.evaluate(f"""import("/static/enlarger.js").then(({{ Enlarger }}) => {{
              globalThis.enlarger ??= new Enlarger();
              const image = new ImageData(Uint8ClampedArray.from({pixels.ravel().tolist()}), {wide}, {high});
              const upload = (gl) => gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, image);
              const context = new OffscreenCanvas({width}, {height}).getContext("2d", {{ willReadFrequently: true }});
              enlarger.paint(context, {{ upload }}, {{ x: 0, y: 0, width: {width}, height: {height} }});
              return Array.from(context.getImageData(0, 0, {width}, {height}).data.filter((_, i) => i % 4 === 1));
            }})""")
            expected = catmull_rom(picture, width, height).clip(0, 255)
            assert np.abs(np.reshape(found, (height, width)) - expected).max() <= 1.5
