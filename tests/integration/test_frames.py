"""Decoded pictures for programs, from a real vehicle."""

from __future__ import annotations

import time

import numpy as np
import pytest

from rig import LOOPBACK6, SMALL_ROBOT, streaming, until
from runner.core.commands import Command
from runner.errors import UserError
from runner.operator.frames import live_frames

pytestmark = pytest.mark.gst


@pytest.fixture
def robot():
    host = f"media.host={LOOPBACK6}"
    with streaming(*SMALL_ROBOT, "fps_max=15", host, cameras=()) as (side, setup, _, _):
        knobs = (("size", (450, 260)), ("bitrate", 900))
        side.turn([Command(name, *knob) for name in setup.vehicle.cameras for knob in knobs])
        yield (
            side,
            [
                *SMALL_ROBOT,
                "fps_max=15",
                host,
                f"media.port={setup.media.port}",
            ],
        )


def test_pictures_come_with_name_capture_time_and_true_colours(robot):
    _, overrides = robot
    seen = {}
    with live_frames(overrides) as frames:
        until(lambda: (frame := frames.next()) and seen.update({frame.camera: frame}) is None and len(seen) == 3)
        later = next(frame for frame in frames if frame.camera == "front")
    for frame in seen.values():
        assert frame.image.shape == (260, 450, 3)  # a width whose rows are padded
        assert frame.image.dtype == np.uint8
        assert 0 < time.time() - frame.captured < 15
    # videotestsrc begins with bars in white and yellow, and ends with blue.
    red, green, blue = later.image[60, 20].tolist()
    assert min(red, green, blue) > 150
    red, green, blue = later.image[60, 430].tolist()
    assert blue > 150 > max(red, green)
    assert later.captured > seen["front"].captured


def test_a_slow_program_gets_the_newest_and_ends_when_it_is_closed(robot):
    _, overrides = robot
    with live_frames(overrides, cameras=["rear"]) as frames:
        first = until(frames.next)
        time.sleep(1)
        assert frames.next().captured - first.captured > 0.2  # the next one in a queue is 0.07 s newer
        assert first.camera == "rear"
    assert list(frames) == []


def test_a_camera_that_is_off_is_not_reconnected_repeatedly(robot, monkeypatch):
    monkeypatch.setattr("runner.operator.frames.RETRY_S", 1.0)
    side, overrides = robot
    side.turn([Command("mast", "sending", False)])
    reports = []
    with live_frames(overrides, cameras=["mast"], report=lambda *what: reports.append(what)) as frames:
        time.sleep(4)  # long enough for a rebuild, after 2 s
        assert reports == []
        side.turn([Command("mast", "sending", True)])
        assert until(frames.next).camera == "mast"


def test_an_unknown_camera_is_reported(robot):
    _, overrides = robot
    with (
        pytest.raises(UserError, match=r"raer: unknown camera, did you mean rear\?"),
        live_frames(overrides, cameras=["raer"]),
    ):
        pass
