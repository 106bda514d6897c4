"""Cameras whose pictures are passed on, with habits that were reported in public, see docs/sources.md."""

from __future__ import annotations

import itertools
import time
from contextlib import contextmanager

import pytest
from odd_camera import ENCODER, FPS, VIDEO, Habits, odd_camera

from rig import free_port, ip_camera, streaming, until, watching
from runner.core.commands import Command

pytestmark = [pytest.mark.gst, pytest.mark.timed, pytest.mark.soak, pytest.mark.sources]

SESSION = ("v=0", "o=- 1 1 IN IP4 127.0.0.1", "s=camera", "t=0 0", "a=control:*")
WHOLE = ENCODER.replace("tune=zerolatency", "tune=zerolatency threads=1")
SLICED = ENCODER.replace("tune=zerolatency", "tune=zerolatency threads=2 sliced-threads=true")


def described(form):
    """A session description with these parameters of the format."""
    return (*SESSION, *(line.replace("packetization-mode=1", form) for line in VIDEO))


HABITS = {
    "no parameter sets in the description": Habits(
        description=described("profile-level-id=4D0014;packetization-mode=0")
    ),
    "empty parameter sets in the description": Habits(
        description=described("packetization-mode=1;sprop-parameter-sets=")
    ),
    "no picture parameter set in the description": Habits(
        description=described("packetization-mode=1;sprop-parameter-sets=Z0IAH5WoPASaEAAAcIAAFfkIQA==,")
    ),
    "slices": Habits(encoder=SLICED),
    "a marker bit for each NAL unit": Habits(encoder=WHOLE, marks_each=True),
    "no marker bits": Habits(marks=False),
    "slices, without marker bits": Habits(encoder=SLICED, marks=False),
    "aggregated packets": Habits(encoder=SLICED, aggregates="zero-latency"),
    "fields": Habits(encoder=f"{ENCODER} interlaced=true"),
    "key pictures 10 s apart, joined between two": Habits(encoder=ENCODER.replace("max=15", "max=150"), early=True),
}


@contextmanager
def passed(address):
    words = ("vehicle=delivery_robot", "source=rtsp", "graph=pass_through", "fps_max=15", f'source.address="{address}"')
    with streaming(*words, cameras=("rear",)) as (side, _, (plan,), reported), watching(plan) as client:
        side.turn([Command("rear", "sending", True), Command("rear", "bitrate", 500)])
        yield side, client, reported


def streams_on(client, seconds=6):
    """For some seconds: at the camera's rate, without a gap above 1 s."""
    until(lambda: client.frames_with_retry() > 10)
    began, seen = time.monotonic(), len(client.times)
    time.sleep(seconds)
    lasted, times = time.monotonic() - began, client.times[seen:]
    assert 0.8 * FPS * lasted < len(times) < 1.2 * FPS * lasted, len(times) / lasted
    assert max(later - earlier for earlier, later in itertools.pairwise(times)) < 1
    assert client.errors == []


@pytest.mark.parametrize("habit", HABITS)
def test_a_camera_with_a_habit_streams_on(habit):
    with odd_camera(HABITS[habit]) as camera, passed(camera.address) as (_, client, reported):
        streams_on(client)
        assert camera.connections <= 2, reported
        assert [line for line in reported if "no frame" in line] == []


def test_slices_that_are_marked_as_pictures_are_named():
    with odd_camera(Habits(encoder=SLICED, marks_each=True)) as camera, passed(camera.address) as (_, client, reported):
        until(lambda: client.frames_with_retry() > 30)
        assert any("sends pictures in pieces, as if each were one" in line for line in reported)


def test_parameter_sets_that_only_the_description_has():
    media = (
        "videotestsrc is-live=true ! video/x-raw,format=I420,width=320,height=240,framerate=15/1"
        " ! x264enc tune=zerolatency speed-preset=ultrafast key-int-max=15 ! video/x-h264,stream-format=avc"
        " ! rtph264pay name=pay0 pt=96 config-interval=0"
    )
    with ip_camera(free_port(), media=media) as (address, _), passed(address) as (_, client, _):
        streams_on(client)
