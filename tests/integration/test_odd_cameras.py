"""IP cameras as their makers build them: each habit was reported in public, see docs/sources.md."""

from __future__ import annotations

import itertools
import time
from dataclasses import replace

import pytest
from odd_camera import ENCODER, FPS, VIDEO, Habits, odd_camera

from rig import streaming, until, watching
from runner.core.commands import Command

pytestmark = [pytest.mark.gst, pytest.mark.timed]

SESSION = ("v=0", "o=- 1 1 IN IP4 127.0.0.1", "s=camera", "t=0 0")
ONVIF = (
    "m=application 0 RTP/AVP 107",
    "a=control:trackID=9",
    "a=rtpmap:107 vnd.onvif.metadata/90000",
    "a=fmtp:107 DecoderTag=h3c-v3 RTCP=0",
    "a=recvonly",
)
DAY_S = 86400.0


def once_every(pictures, seconds):
    """One picture of so many has an RTP time that is wrong by `seconds`."""
    return lambda picture, _connection: seconds if picture % pictures == pictures - 1 else 0.0


HABITS = {
    "metadata beside the video": Habits(description=(*SESSION, "a=control:*", *ONVIF, *VIDEO)),
    "parameter sets without a usable SPS": Habits(
        description=(
            *SESSION,
            "a=control:*",
            *(line.replace("mode=1", "mode=1;sprop-parameter-sets=Z0IAH5WoPASaEAAAcIAAFfkIQA==,") for line in VIDEO),
        )
    ),
    "a picture 9800 s in the past": Habits(shift=once_every(30, -9800)),
    "a picture 37600 s in the future": Habits(shift=once_every(30, 37600)),
    "a clock that steps back by 3 s": Habits(ntp_shift=lambda seconds: -3.0 if seconds > 2 else 0.0),
    "a clock that steps by a day": Habits(ntp_shift=lambda seconds: DAY_S if seconds > 2 else 0.0),
    "reports anchored at the time of sending": Habits(ntp_shift=lambda seconds: seconds % 2),
    "no sender reports": Habits(ntp_shift=None),
    "key pictures 4 s apart, joined between two": Habits(encoder=ENCODER.replace("max=15", "max=60"), early=True),
    "no control of the session": Habits(description=(*SESSION, *VIDEO)),
    "a base without slash": Habits(content_base="{address}"),
    "no base": Habits(content_base=""),
    "absolute control": Habits(
        description=(*SESSION, "a=control:{address}", *VIDEO[:3], "a=control:{address}/trackID=1")
    ),
    "keep-alives that are never answered": Habits(session="1234;timeout=3", headers={"GET_PARAMETER": None}),
    "a short session": Habits(session="1234;timeout=3"),
    "UDP only": Habits(refused={"TCP": "406 Not Acceptable"}),
    "TCP only": Habits(refused={"UDP": "461 Unsupported Transport", "multicast": "400 Bad Request"}),
    "B pictures": Habits(encoder="x264enc speed-preset=ultrafast bitrate=500 key-int-max=15 bframes=2 rc-lookahead=0"),
    "no marker bits": Habits(marks=False),
    "a content type with a parameter": Habits(headers={"DESCRIBE": "Content-Type: application/sdp; charset=utf-8"}),
}


def rear(address, *words):
    return ("vehicle=delivery_robot", "source=rtsp", "fps_max=15", f'source.address="{address}"', *words)


def knobs(side):
    values = {"sending": True, "size": (424, 240), "bitrate": 500}
    side.turn([Command("rear", knob, value) for knob, value in values.items()])


@pytest.mark.soak
@pytest.mark.sources
@pytest.mark.parametrize("habit", HABITS)
def test_a_camera_with_a_habit_streams_on(habit):
    """For 8 s: at its rate, without a gap above 1 s, without being connected anew, and with times that keep rising."""
    with (
        odd_camera(HABITS[habit]) as camera,
        streaming(*rear(camera.address), cameras=("rear",)) as (side, _, (plan,), reported),
        watching(plan) as client,
    ):
        knobs(side)
        until(lambda: client.frames_with_retry() > 10)
        began, seen = time.monotonic(), len(client.times)
        time.sleep(8)
        lasted = time.monotonic() - began
        times = client.times[seen:]
        assert camera.connections <= 2, reported
        assert [line for line in reported if "no frame" in line] == []
    assert len(times) > 0.8 * FPS * lasted, (len(times), reported)
    assert max(later - earlier for earlier, later in itertools.pairwise(times)) < 1


@pytest.mark.soak
@pytest.mark.sources
def test_times_that_start_again_after_a_reconnection_are_no_step_back():
    habits = replace(Habits(), shift=lambda picture, connection: -0.5 * picture if connection == 1 else 0.0)
    with (
        odd_camera(replace(habits, shift=lambda _, connection: -1e4 * connection)) as camera,
        streaming(*rear(camera.address), cameras=("rear",)) as (side, _, (plan,), reported),
        watching(plan) as client,
    ):
        knobs(side)
        until(lambda: client.frames_with_retry() > 10)
        camera.drop()
        until(lambda: any("works again" in line for line in reported), 20)
        seen, began = len(client.times), time.monotonic()
        until(lambda: len(client.times) > seen + 2 * FPS)
        assert time.monotonic() - began < 4
        assert client.errors == []
