"""Knobs of real pipelines, turned while they play."""

from __future__ import annotations

import random
import socket
import subprocess
import sys
import time
from contextlib import ExitStack
from fractions import Fraction

import inside
import numpy as np
import pytest

from rig import CLIPS, NOISE, Client, faults, rejected, streaming, until, watching
from runner.core.commands import Command
from runner.core.model import Roi
from runner.errors import RunError
from runner.gst.knobs import KnobPanel
from runner.gst.picture_rate import PictureRate
from runner.gst.pushed import PushedPictures

CAMERA = "front_left"


def turn(side, **knobs):
    side.turn([Command(CAMERA, knob, value) for knob, value in knobs.items()])


def test_size_changes_without_a_break():
    with streaming() as (side, _, (plan,), reported):
        turn(side, size=(480, 260), bitrate=545)
        with watching(plan) as client:
            until(lambda: len(client.sizes) > 10)
            assert set(client.sizes) == {(480, 260)}
            for size in ((960, 520), (240, 130), (480, 260)):
                turn(side, size=size)
                until(lambda size=size: client.sizes[-1] == size)
            assert client.errors == []
            assert side.read()[CAMERA].applied == {"size": (480, 260), "bitrate": 545}
            assert not rejected(reported)


def test_a_knob_turned_while_a_pipeline_is_built_is_set(monkeypatch):
    """A pipeline is built for the first viewer, and takes milliseconds, in which a decision may change."""
    set_now = KnobPanel.set_now

    def turned_meanwhile(self, values):
        set_now(self, values)
        turn(sides[0], bitrate=777, size=(240, 130))

    sides = []
    with streaming() as (side, _, (plan,), _reported):
        sides.append(side)
        turn(side, size=(480, 260), bitrate=545)
        monkeypatch.setattr(KnobPanel, "set_now", turned_meanwhile)
        with watching(plan) as client:
            until(lambda: client.sizes[-1:] == [(240, 130)])
            assert side.read()[CAMERA].applied["bitrate"] == 777


def test_a_fault_while_looking_at_one_camera_is_named_and_leaves_the_others_alone(monkeypatch):
    look, looked = PictureRate.look, []

    def failing(rate, *words):
        looked.append(rate)
        if rate is looked[0]:
            raise ValueError("no such property")
        look(rate, *words)

    with streaming(cameras=(CAMERA, "front_right")) as (side, _, plans, reported), ExitStack() as stack:
        stack.enter_context(watching(plans[0]))
        until(lambda: side.sent_frames().get(CAMERA))
        turn(side, bitrate=500)
        inside.camera(side, CAMERA).knobs.pace = 4.0
        monkeypatch.setattr(PictureRate, "look", failing)
        until(lambda: f"{CAMERA}: its pictures are not counted: ValueError: no such property" in reported)
        until(lambda: inside.camera(side, CAMERA).knobs.pace == 1)
        stack.enter_context(watching(plans[1]))
        until(lambda: side.sent_frames().get("front_right"))
        side.sent_frames()
        sent = []
        until(lambda: sent.extend(side.sent_frames()["front_right"]) or len(sent) > 1)
    assert sum("not counted" in line for line in reported) == 1


def sent_in_frames(side, count):
    """Bytes in which the encoder outputs a number of frames."""
    before = side.read()[CAMERA].encoded
    now = until(lambda: (sent := side.read()[CAMERA].encoded).frames >= before.frames + count and sent)
    return (now.bytes - before.bytes) * count / (now.frames - before.frames)


def test_bitrate_is_read_back_and_on_the_wire():
    with streaming("source=file", f"source.clip={CLIPS[1]}") if CLIPS else streaming() as (side, _, (plan,), _reported):
        turn(side, size=(960, 520), bitrate=3000)
        with watching(plan) as client:
            until(lambda: len(client.sizes) > 40)
            turn(side, bitrate=500)
            until(lambda: side.read()[CAMERA].applied.get("bitrate") == 500)
            assert sent_in_frames(side, 80) * 8 / 2 < 1.3 * 500_000  # two seconds at 40 Hz


@pytest.mark.parametrize("kbps", [3, *(pytest.param(kbps, marks=pytest.mark.soak) for kbps in (9, 26))])
def test_the_lowest_bitrates_limit_the_encoder_too(kbps):
    """x264 treats a buffer below 1 kbit as unlimited from its next restart on: 40 Hz of noise."""
    with streaming(*NOISE) as (side, _, (plan,), reported), watching(plan) as client:
        turn(side, size=(240, 130), bitrate=500)
        until(lambda: len(client.sizes) > 20)
        turn(side, bitrate=kbps)
        until(lambda: side.read()[CAMERA].applied.get("bitrate") == kbps)
        for size in ((256, 138), (240, 130)):  # the encoder restarts
            turn(side, size=size)
            until(lambda size=size: client.sizes[-1] == size)
        side.send_key_frames([CAMERA])
        assert sent_in_frames(side, 80) * 8 / 2 < 60_000  # x264 needs 20 kbit/s for noise, otherwise uses 7000
        assert not rejected(reported)


def test_all_knobs_of_a_change_act_between_the_same_two_frames():
    """Sides and size of the crop go together: no frame has the new crop and the old size."""
    with streaming() as (side, _, (plan,), _reported):
        whole, half = Roi(0, 0, 1920, 1040), Roi(0, 0, 960, 1040)
        turn(side, roi=whole, size=(480, 260), bitrate=500)
        with watching(plan) as client:
            until(lambda: len(client.sizes) > 10)
            for n in range(40):
                roi, size = ((half, (240, 260)), (whole, (480, 260)))[n % 2]
                turn(side, roi=roi, size=size)
                until(lambda size=size: client.sizes[-1] == size)
            assert set(client.sizes) == {(480, 260), (240, 260)}
            assert client.errors == []


def test_random_rois_never_stop_the_stream():
    chance = random.Random(1)
    with streaming() as (side, _, (plan,), reported), watching(plan) as client:
        until(lambda: len(client.sizes) > 10)
        for n in range(2000):
            width, height = chance.randrange(16, 1921), chance.randrange(16, 1041)
            roi = Roi(chance.randrange(1921 - width), chance.randrange(1041 - height), width, height)
            size = (max(16, 2 * (width // 8)), max(16, 2 * (height // 8)))
            turn(side, roi=roi, size=size)
            if n % 10 == 0:
                time.sleep(0.01)  # some coincide with a frame in flight, some do not
        turn(side, roi=Roi(0, 0, 1920, 1040), size=(480, 260))
        until(lambda: client.sizes[-1] == (480, 260))
        assert client.errors == []
        assert faults(reported) == [f"{CAMERA}: pipeline built"]


def test_switching_off_stops_the_encoder_and_on_resumes_it():
    with streaming() as (side, _, (plan,), reported), watching(plan) as client:
        turn(side, sending=True, size=(240, 130), bitrate=200)
        until(lambda: len(client.sizes) > 10)
        for _ in range(100):
            turn(side, sending=False)
            turn(side, sending=True)
        count = len(client.sizes)
        until(lambda: len(client.sizes) > count + 10)
        turn(side, sending=False)
        until(lambda: side.read()[CAMERA].applied["sending"] is False)

        def stands_still():
            frames = side.read()[CAMERA].encoded.frames
            time.sleep(0.5)
            return side.read()[CAMERA].encoded.frames == frames

        until(stands_still)  # a last frame may be in the encoder
        frames = side.read()[CAMERA].encoded.frames
        turn(side, sending=True)
        until(lambda: side.read()[CAMERA].encoded.frames > frames + 10)
        assert client.errors == []
        assert faults(reported) == [f"{CAMERA}: pipeline built"]


def describe(endpoint, path, seconds=20.0):
    """First line of the answer to an RTSP DESCRIBE."""
    with socket.create_connection((endpoint.host, endpoint.port), timeout=seconds) as link:
        link.settimeout(seconds)
        url = f"rtsp://{endpoint.host}:{endpoint.port}/{path}"
        link.sendall(f"DESCRIBE {url} RTSP/1.0\r\nCSeq: 1\r\nAccept: application/sdp\r\n\r\n".encode())
        return link.recv(4096).decode().splitlines()[0]


def test_a_camera_that_is_off_before_the_first_client_answers_at_once():
    with streaming() as (side, setup, (plan,), reported):
        turn(side, sending=False)
        assert describe(setup.media, CAMERA) == "RTSP/1.0 200 OK"
        until(lambda: f"{CAMERA}: pipeline stopped" in reported)  # the server refuses clients at this moment
        with watching(plan) as client:
            until(lambda: side.read()[CAMERA].applied.get("sending") is False)
            turn(side, sending=True, size=(240, 130), bitrate=200)
            until(lambda: (240, 130) in client.sizes)


def test_a_rebuilt_pipeline_gets_the_settings_in_force():
    with streaming() as (side, _, (plan,), reported):
        turn(side, size=(480, 260), bitrate=545)
        with watching(plan) as client:
            until(lambda: len(client.sizes) > 5)
        until(lambda: f"{CAMERA}: pipeline stopped" in reported)
        turn(side, size=(240, 130), bitrate=300)
        with watching(plan) as client:
            until(lambda: len(client.sizes) > 5)
            assert set(client.sizes) == {(240, 130)}
            assert side.read()[CAMERA].applied == {"size": (240, 130), "bitrate": 300}


def test_a_second_viewer_does_not_disturb_the_first():
    with streaming() as (side, _, (plan,), reported), watching(plan) as first:
        turn(side, size=(240, 130), bitrate=200)
        until(lambda: len(first.sizes) > 10)
        with watching(plan) as second:
            until(lambda: len(second.sizes) > 10)
        count = len(first.sizes)
        until(lambda: len(first.sizes) > count + 20)
        assert first.errors == []
        assert faults(reported) == [f"{CAMERA}: pipeline built"]


def quadrants(width, height):
    """An I420 frame: top left bright, top right red, bottom left blue, bottom right dark."""
    import numpy as np

    def plane(w, h, values):
        made = np.empty((h, w), np.uint8)
        for (top, left), value in zip(((0, 0), (0, 1), (1, 0), (1, 1)), values, strict=True):
            made[top * h // 2 : (top + 1) * h // 2, left * w // 2 : (left + 1) * w // 2] = value
        return made.tobytes()

    luma = plane(width, height, (210, 80, 60, 30))
    u, v = (128, 90, 200, 128), (128, 220, 110, 128)
    return luma + plane(width // 2, height // 2, u) + plane(width // 2, height // 2, v)


BRIGHT, RED, BLUE, DARK = "bright", "red", "blue", "dark"


def colour(pixel):
    red, green, blue = (int(value) for value in pixel)
    if red > 150 and green > 150:
        return BRIGHT
    return RED if red > blue + 40 else BLUE if blue > red + 40 else DARK


def received(side, plan, camera, frame):
    """The picture that arrives while a frame is pushed repeatedly."""
    client = Client(plan, pictures=True)

    def pushed():
        time.sleep(0.02)
        return side.push(camera, frame) and client.frames_with_retry() > 5

    try:
        until(pushed)
        return client.picture()
    finally:
        client.close()


@pytest.mark.parametrize(
    ("roi", "size", "corners"),
    [
        pytest.param(Roi(0, 0, 1920, 1040), (480, 260), (BRIGHT, RED, BLUE, DARK), marks=pytest.mark.soak),
        (Roi(0, 0, 960, 1040), (240, 260), (BRIGHT, BRIGHT, BLUE, BLUE)),  # left half
        (Roi(0, 0, 1920, 260), (480, 66), (BRIGHT, RED, BRIGHT, RED)),  # top strip
        (Roi(960, 520, 960, 520), (480, 260), (DARK, DARK, DARK, DARK)),
    ],
)
def test_an_roi_shows_its_region(roi, size, corners):
    frame = quadrants(1920, 1040)
    with streaming("source=appsrc") as (side, _, (plan,), _reported):
        turn(side, roi=roi, size=size, bitrate=2000)
        picture = received(side, plan, CAMERA, frame)
        assert picture.shape[1::-1] == size
        height, width = picture.shape[:2]
        rows, columns = (height // 8, -height // 8), (width // 8, -width // 8)
        assert tuple(colour(picture[row, column]) for row in rows for column in columns) == corners


def test_a_native_crop_comes_before_the_roi():
    """The robot's front camera cuts 120 px off the top of 960: its full image begins there."""
    frame = quadrants(1280, 960)
    words = ("vehicle=delivery_robot", "source=appsrc", "cameras.front.native.top_px=240")
    with streaming(*words, cameras=("front",)) as (side, _, (plan,), _reported):
        commands = {"roi": Roi(0, 0, 1280, 720), "size": (640, 360), "bitrate": 2000}
        side.turn([Command("front", knob, value) for knob, value in commands.items()])
        picture = received(side, plan, "front", frame)
        # Rows 240 to 960 of the native picture: the border between top and bottom at 480 is a third from the top.
        assert [colour(picture[row, 100]) for row in (20, 100, 140, 340)] == [BRIGHT, BRIGHT, BLUE, BLUE]


def test_arrays_are_pushed_by_shape_and_format_with_their_capture_times():
    red = np.zeros((1040, 1920, 3), np.uint8)
    red[..., 0] = 220
    with streaming("source=appsrc") as (side, _, (plan,), _reported):
        turn(side, size=(480, 260), bitrate=2000)

        def shown(frame, **more):
            while True:
                until(lambda: time.sleep(0.02) or side.push(CAMERA, frame, captured=time.time() - 0.5, **more))
                yield colour(client.picture()[130, 240]) if client.frames_with_retry() > 5 else None

        client = Client(plan, pictures=True)
        try:
            for frame, more, expected in (
                (red, {"form": "rgb"}, RED),
                (red[::-1, ::-1], {"form": "bgr"}, BLUE),
                (np.full((1040, 1920), 230, np.uint8), {}, BRIGHT),
                (quadrants(1920, 1040), {}, DARK),
            ):
                pictures = shown(frame, **more)
                until(lambda pictures=pictures, expected=expected: next(pictures) == expected)
            capture_ms, _ = until(lambda: (next(pictures), side.stages().get(CAMERA))[1])
            assert 500 <= capture_ms < 1500
            assert not side.push(CAMERA, red, "rgb", captured=time.time() - 5)  # older than the last one
        finally:
            client.close()


@pytest.mark.parametrize(
    ("frame", "more", "rule"),
    [
        (np.zeros((2, 3, 3), np.uint8), {}, r"shape \(2, 3, 3\) needs format='bgr' or format='rgb'"),
        (np.zeros((2, 3, 3), np.uint8), {"form": "bgr"}, r"\(2, 3, 3\) must have \(1040, 1920, 3\), BGR of 1920x1040"),
        (np.zeros((1040, 1920)), {}, r"numbers of 8 bytes must have numbers of one byte \(uint8\)"),
        (b"", {"form": "yuv"}, r"format: 'yuv': must be one of i420, bgr, rgb, grey"),
        (
            np.zeros((1040, 1920), np.uint8),
            {"captured": 17.0},
            r"captured: 17.0: must be s since 1970, within",
        ),
    ],
)
def test_frames_that_are_refused(frame, more, rule):
    with pytest.raises(ValueError, match=rule):
        PushedPictures((1920, 1040), Fraction(40)).push(None, frame, more.get("form"), more.get("captured"))


def test_a_frame_of_another_size_is_refused():
    rule = "front_left: a frame of 3 bytes must have 2995200, I420 of 1920x1040"
    with (
        streaming("source=appsrc") as (side, _, (plan,), _reported),
        watching(plan),
        pytest.raises(ValueError, match=rule),
    ):
        until(lambda: side.push(CAMERA, b"abc"))


def test_a_frame_of_a_misspelt_camera_is_refused():
    rule = "camera 'front_lfet': no such camera, did you mean front_left"
    with streaming("source=appsrc") as (side, _, _plans, _reported), pytest.raises(ValueError, match=rule):
        side.push("front_lfet", b"abc")


def test_a_port_in_use_is_reported_in_one_line():
    from runner.system.ports import check_port_free

    with streaming() as (_, setup, _, _reported), pytest.raises(RunError) as raised:
        check_port_free(setup.media)
    where = f"127.0.0.1:{setup.media.port}"
    assert str(raised.value) == f"cannot listen on {where}: address already in use; choose another port"


def test_other_libraries_may_throw_exceptions_after_gstreamer_is_loaded():
    # GStreamer loads libunwind; a C++ exception that unwinds through it ends the process.
    pytest.importorskip("cv2")
    pytest.importorskip("matplotlib")
    script = "import cv2, runner.apply, matplotlib.ft2font as module; print(hasattr(module, 'nothing'))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False, timeout=60)
    assert (done.returncode, done.stdout) == (0, "False\n")
