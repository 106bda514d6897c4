"""A camera that encodes by itself and whose stream changes, or is damaged, while it runs."""

from __future__ import annotations

import time
from contextlib import contextmanager

import inside
import pytest
from told_camera import told_camera

from rig import faults, streaming, until, watching
from runner.core.commands import Command

pytestmark = [pytest.mark.gst, pytest.mark.timed]

CAMERA = (
    "videotestsrc is-live=true ! videoscale ! videoconvert"
    " ! capsfilter name=size caps=video/x-raw,format=I420,width=320,height=240,framerate=25/1"
    " ! x264enc name=encoder tune=zerolatency speed-preset=ultrafast key-int-max=25 ! rtph264pay name=pay0 pt=96"
)


@contextmanager
def passing(camera, *words):
    """A robot whose rear camera is passed on. Yields (side, plan, reported)."""
    of_robot = ("vehicle=delivery_robot", "source=rtsp", "graph=pass_through", "fps_max=25")
    sizes = ("cameras.rear.width_px=320", "cameras.rear.height_px=240")
    with streaming(*of_robot, *sizes, f'source.address="{camera.rtsp}"', *words, cameras=("rear",)) as parts:
        side, _, plans, reported = parts
        side.turn([Command("rear", "sending", True), Command("rear", "bitrate", 500)])
        yield side, plans[0], reported


def form(width, height, raw="I420"):
    return f"video/x-raw,format={raw},width={width},height={height},framerate=25/1"


def test_another_size_is_said_and_shown_without_a_break():
    with told_camera(CAMERA) as camera, passing(camera) as (side, plan, reported), watching(plan) as client:
        until(lambda: len(client.sizes) > 20)
        for size in ((480, 360), (320, 240), (640, 360)):
            camera.tell("size", "caps", form(*size))
            until(lambda: client.sizes[-1] == size)  # noqa: B023
            seen = len(client.sizes)
            until(lambda: len(client.sizes) > seen + 20)  # noqa: B023
        stated = "but width_px and height_px say 320x240: correct them, or set the camera"
        assert faults(reported) == [
            "rear: pipeline built",
            f"rear: sends 480x360, {stated}",
            "rear: sends what is expected again: 320x240, profile constrained-baseline",
            f"rear: sends 640x360, {stated}",
        ]
        assert side.read()["rear"].fault is None


def test_another_profile_is_said_and_decoded_where_that_is_possible():
    with told_camera(CAMERA) as camera, passing(camera) as (_, plan, reported), watching(plan) as client:
        until(lambda: len(client.sizes) > 20)
        camera.tell("size", "caps", form(320, 240, "Y444"))
        until(lambda: any("sends H.264 of profile high-4:4:4, which browsers do not play" in line for line in reported))
        seen = len(client.sizes)
        until(lambda: len(client.sizes) > seen + 20)
        camera.tell("size", "caps", form(320, 240))
        until(lambda: any("sends what is expected again: 320x240, profile" in line for line in reported))
        seen = len(client.sizes)
        until(lambda: len(client.sizes) > seen + 20)


LONG = (  # ten seconds between key pictures
    "videotestsrc is-live=true pattern=snow ! video/x-raw,format=I420,width=320,height=240,framerate=25/1"
    " ! x264enc name=encoder tune=zerolatency speed-preset=ultrafast bitrate=1000 key-int-max=250"
    " option-string=scenecut=0 ! rtph264pay pt=96"
    ' ! capssetter name=pay0 caps="application/x-rtp,rtcp-fb-nack-pli=(boolean){feedback}"'
)


@pytest.mark.parametrize("feedback", [True, False])
def test_a_damaged_picture_is_marked_until_a_key_picture_which_is_asked_for(feedback, monkeypatch):
    """One that takes requests (RTP profile AVPF) sends it at once; another's next one may be ten seconds away."""
    from runner.apply import OperatorSide

    due = []  # a packet to lose
    inside.losing(
        monkeypatch, "rtpjitterbuffer", "sink", lambda packet: packet.get_size() > 200 and bool(due and due.pop())
    )
    units = []
    media = LONG.format(feedback=str(feedback).lower())
    with (
        told_camera(media, feedback=feedback) as camera,
        passing(camera, "graph.retransmission_ms=0") as (side, plan, _),
    ):
        operator = OperatorSide([plan], lambda *_: None, lambda _, unit: units.append(unit.damaged))
        try:
            until(lambda: units and not units[-1])
            asked = camera.key_pictures_asked
            due.append(True)
            until(lambda: units[-1])
            began = len(units)
            while units[-1]:
                side.send_key_frames(["rear"])  # as the vehicle does while an operator reports damage
                time.sleep(0.5)
            healed = units.index(False, began)
        finally:
            operator.stop()
        assert not any(units[healed:])
        assert (camera.key_pictures_asked > asked) == feedback
        assert (healed - began < 100) == feedback  # of 250 pictures from one to the next
