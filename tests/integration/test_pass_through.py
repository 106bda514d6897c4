"""Cameras that encode by themselves: their pictures are passed on as they come."""

from __future__ import annotations

from contextlib import contextmanager

import inside
import pytest

from rig import faults, free_port, ip_camera, streaming, until, watching
from runner.core.commands import Command
from runner.h264.access_unit import IDR, SLICE, nal_units
from runner.h264.sps import SPS

pytestmark = [pytest.mark.gst, pytest.mark.timed]

FORM = "video/x-raw,format={form},width=320,height=240,framerate=25/1"
# Two slices a picture, and parameter sets before each slice of a key picture, as GStreamer's payloader repeats them.
SLICED = "x264enc tune=zerolatency speed-preset=ultrafast threads=2 sliced-threads=true key-int-max=10"
PAYLOADER = "rtph264pay name=pay0 pt=96 config-interval=-1"
B_FRAMES = "x264enc speed-preset=veryfast bframes=2 b-adapt=false rc-lookahead=4 ! video/x-h264,profile=main"
HIGH_444 = "x264enc tune=zerolatency speed-preset=ultrafast ! video/x-h264,profile=high-4:4:4"


def media(encoder: str = SLICED, payloader: str = PAYLOADER, form: str = "I420") -> str:
    return f"videotestsrc is-live=true ! {FORM.format(form=form)} ! {encoder} ! {payloader}"


@contextmanager
def passing(sent: str, graph: str = "pass_through"):
    """A robot whose rear camera is passed on. Yields (side, plan, reported)."""
    words = ("vehicle=delivery_robot", "source=rtsp", f"graph={graph}", "fps_max=25")
    with (
        ip_camera(free_port(), media=sent) as (address, _),
        streaming(*words, f'source.address="{address}"', cameras=("rear",)) as (side, _, plans, reported),
    ):
        side.turn([Command("rear", "sending", True), Command("rear", "bitrate", 500)])
        yield side, plans[0], reported


def test_the_vehicle_neither_decodes_nor_encodes_and_knows_what_it_sends():
    with passing(media()) as (side, plan, reported), watching(plan) as client:
        until(lambda: len(client.sizes) > 20)
        kinds = [each.get_factory() for each in inside.sender(side, "rear").iterate_recurse()]
        words = {word for kind in kinds if kind for word in kind.get_metadata("klass").split("/")}
        assert not words & {"Decoder", "Encoder"}
        assert set(client.sizes) == {(320, 240)}
        assert side.read()["rear"].encoded.frames > 20
        size = "rear: sends 320x240, but width_px and height_px say 848x480: correct them, or set the camera"
        until(lambda: faults(reported) == ["rear: pipeline built", size])


def test_h265_is_passed_on_too():
    sent = media("x265enc tune=zerolatency speed-preset=ultrafast key-int-max=10", "rtph265pay name=pay0 pt=96")
    with passing(sent, "pass_through_h265") as (_, plan, _), watching(plan) as client:
        until(lambda: len(client.sizes) > 20)
        assert set(client.sizes) == {(320, 240)}


def test_a_key_picture_of_several_slices_arrives_whole_with_its_parameter_sets():
    with passing(media()) as (_, plan, _):
        units = list(received(plan, 26))[1:]  # it may join in the middle of one
    pictures = [[kind for kind in unit if kind in (SLICE, IDR)] for unit in units]
    assert {len(slices) for slices in pictures} == {2}
    keys = [unit for unit in units if IDR in unit]
    assert len(keys) >= 2
    assert all(unit.index(SPS) < unit.index(IDR) and unit[-2:] == [IDR, IDR] for unit in keys)


def received(plan, count):
    """The types of the NAL units of the first pictures that an operator receives."""
    from runner.gst import Gst

    head, _, _ = plan.receiver.partition(" ! identity name=received")
    pipeline = Gst.parse_launch(f"{head} ! appsink name=sink sync=false")
    pipeline.set_state(Gst.State.PLAYING)
    try:
        for _ in range(count):
            sample = pipeline.get_by_name("sink").emit("try-pull-sample", 10 * Gst.SECOND)
            buffer = sample.get_buffer()
            yield [header & 0x1F for header, _ in nal_units(buffer.extract_dup(0, buffer.get_size()))]
    finally:
        pipeline.set_state(Gst.State.NULL)


@pytest.mark.parametrize(
    "sent, said",
    [
        (media(B_FRAMES), "sends B-frames: its pictures come late and out of order; switch them off in the camera"),
        (media(HIGH_444, form="Y444"), "sends H.264 of profile high-4:4:4, which browsers do not play: set the camera"),
    ],
)
def test_what_viewers_will_have_trouble_with_is_said(sent, said):
    with passing(sent) as (_, plan, reported), watching(plan):
        until(lambda: any(said in line for line in reported))


def test_doctor_looks_at_the_first_pictures(tod):
    robot = ("vehicle=delivery_robot", "+source@cameras.rear.source=rtsp", "+graph@cameras.rear.graph=pass_through")
    with ip_camera(free_port(), media=media(B_FRAMES)) as (address, _):
        result = tod("doctor", "vehicle", *robot, f"+cameras.rear.address={address}")
    line = next(line for line in result.out.splitlines() if "camera rear" in line)
    assert line.startswith(f"MISSING camera rear: {address}: ")
    assert "sends B-frames: its pictures come late and out of order; switch them off in the camera" in line
    assert "sends 320x240, but width_px and height_px say 848x480" in line


@pytest.mark.parametrize(
    "sent, found",
    [
        (media("x265enc tune=zerolatency speed-preset=ultrafast", "rtph265pay name=pay0 pt=96"), "H265"),
        (media("jpegenc", "rtpjpegpay name=pay0 pt=26"), "JPEG"),
    ],
)
def test_another_format_is_refused_in_one_line(sent, found):
    why = f"the camera sends {found}, and the graph passes on H264: set the camera to that, or decode it"
    with passing(sent) as (side, plan, reported), watching(plan):
        until(lambda: side.read()["rear"].lost == why)
        assert f"rear: {why}" in reported
