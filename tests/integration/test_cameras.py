"""Cameras: colors, capture times, logins.

A V4L2 camera is a device of v4l2loopback; without that in the kernel, only other sources before the same elements.
"""

from __future__ import annotations

import itertools
import json
import re
import signal
import subprocess
from contextlib import ExitStack, contextmanager
from pathlib import Path

import inside
import pytest
import yaml

from rig import CHECKOUT, faults, free_port, ip_camera, process, streaming, until, watching
from runner.configuration.config import configuration
from runner.core.commands import Command
from runner.core.model import Element
from runner.graph import launch
from runner.plans import compile_plans

CAMERA = "front_left"
COLOR = (200, 80, 40)  # red, green, blue
# Devices of v4l2loopback, by an attribute that only they have.
LOOPBACKS = [f"/dev/{path.parent.name}" for path in Path("/sys/class/video4linux").glob("video*/max_openers")]
V4L2 = ("source=v4l2", f"cameras.{CAMERA}.device=/dev/video0", "cameras.front_left.fps=15")


def turn(side, **values):
    side.turn([Command(CAMERA, knob, value) for knob, value in values.items()])


def colored(*between):
    """A source of one color, as a camera that delivers it by these elements."""
    argb = int.from_bytes(bytes((255, *COLOR)))
    pattern = f"{{is-live: true, pattern: solid-color, foreground-color: {argb}}}"
    raw = "{name: raw, element: capsfilter, properties: {caps: '{raw_caps}'}}"
    elements = [f"{{name: source, element: videotestsrc, properties: {pattern}}}", *between, raw]
    return ("source=test", f"source.elements=[{', '.join(elements)}]")


MJPEG = [
    "{name: rgb, element: capsfilter, properties: {caps: 'video/x-raw,format=RGB'}}",
    "{name: full, element: videoconvert}",
    "{name: small, element: capsfilter, properties: {caps: 'video/x-raw,width=640,height=360,colorimetry=1:4:0:0'}}",
    "{name: camera, element: jpegenc}",
    *(
        f"{{name: {element}, element: {element}}}"
        for element in ("decodebin", "videoconvert", "videoscale", "videorate")
    ),
]


@pytest.mark.parametrize("graph", ["h264_rtsp", "openh264_rtsp"])
@pytest.mark.parametrize("between", [[], MJPEG], ids=["raw", "MJPEG"])
def test_colors_are_right_at_every_size(graph, between):
    """Without colorimetry, decoders assume BT.601 for small pictures and BT.709 for large ones."""
    with (
        streaming(*colored(*between), f"graph={graph}", "cameras.front_left.fps=15") as (side, _, (plan,), _),
        watching(plan, pictures=True) as client,
    ):
        for size in ((480, 260), (1920, 1040)):
            turn(side, sending=True, size=size, bitrate=4000)
            until(lambda size=size: client.sizes[-1:] == [size])
            until(lambda size=size: is_right(client.picture(), size), seconds=20)


def is_right(picture, size):
    """Once it has the new size, and the encoder has refined it."""
    if picture.shape[:2] != size[::-1]:
        return False
    center = picture[size[1] // 2, size[0] // 2]
    return all(abs(int(seen) - true) <= 6 for seen, true in zip(center, COLOR, strict=True))


@pytest.mark.parametrize("fps", [15, 30])
def test_frames_of_a_v4l2_camera_keep_their_capture_times(fps):
    """Also of a camera at twice the rate, whose every second frame is dropped."""
    from runner.gst import Gst

    (plan,) = (p for p in compile_plans(configuration([*V4L2]).setup()) if p.camera.name == CAMERA)
    caps = f"video/x-raw,format=I420,width=1920,height=1040,framerate={fps}/1"
    stand_in = Element("source", "appsrc", {"format": "time", "is-live": True, "caps": caps})
    pipeline = Gst.parse_launch(f"{launch((stand_in, *plan.source[1:]))} ! appsink name=sink sync=false")
    source, sink = map(pipeline.get_by_name, ("source", "sink"))
    pipeline.set_state(Gst.State.PLAYING)
    captured = [Gst.SECOND + round((k / fps + 0.0007 * (k * 7 % 5)) * Gst.SECOND) for k in range(40)]
    for time in captured:
        frame = Gst.Buffer.new_allocate(None, 1920 * 1040 * 3 // 2, None)
        frame.pts = time
        source.emit("push-buffer", frame)
    source.emit("end-of-stream")
    seen = []
    while sample := sink.emit("try-pull-sample", 5 * Gst.SECOND):
        seen.append(sample.get_buffer().pts)
    pipeline.set_state(Gst.State.NULL)
    assert set(seen) <= set(captured)
    assert len(seen) >= 40 * 15 // fps - 2


@pytest.mark.skipif(not LOOPBACKS, reason="no device of v4l2loopback: modprobe v4l2loopback")
def test_a_v4l2_device_is_streamed_with_the_times_of_its_driver():
    """The device is checked, its format is requested, and its frames arrive one by one."""
    from runner.apply import check_machine
    from runner.gst import Gst

    (device, *_), captured = LOOPBACKS, []
    caps = "video/x-raw,format=YUY2,width=640,height=360,framerate=15/1"
    writer = Gst.parse_launch(f"videotestsrc is-live=true pattern=ball ! {caps} ! v4l2sink device={device} sync=false")
    capture = "{format: YUY2, width: 640, height: 360, fps: 15}"
    words = (f"cameras.{CAMERA}.device={device}", f"+cameras.{CAMERA}.capture={capture}", f"cameras.{CAMERA}.fps=15")
    writer.set_state(Gst.State.PLAYING)
    try:
        assert writer.get_state(10 * Gst.SECOND)[0] == Gst.StateChangeReturn.SUCCESS
        with (
            streaming("source=v4l2", *words, cameras=(CAMERA,)) as (side, _, (plan,), reported),
            watching(plan) as client,
        ):
            assert check_machine([plan]) == {}
            turn(side, sending=True, size=(480, 260), bitrate=500)
            until(lambda: client.frames_with_retry() > 10)
            pad = inside.sender(side, CAMERA).get_by_name("raw").get_static_pad("src")
            pad.add_probe(Gst.PadProbeType.BUFFER, lambda _, info: noted(captured, info.get_buffer().pts))
            until(lambda: len(captured) > 15)
            assert set(client.sizes[-5:]) == {(480, 260)}
            assert faults(reported) == [f"{CAMERA}: pipeline built"]
    finally:
        writer.set_state(Gst.State.NULL)
    assert all(earlier < later for earlier, later in itertools.pairwise(captured))
    assert len({later - earlier for earlier, later in itertools.pairwise(captured)}) > 1  # not rounded to a rate


def test_a_camera_that_is_unplugged_comes_back_when_it_is_plugged_in_again(tmp_path):
    """Shared memory stands in for the device: it fails like one that is unplugged, and cannot be opened for a while."""
    socket = tmp_path / "device"
    elements = yaml.safe_load((CHECKOUT / "conf/source/v4l2.yaml").read_text())["elements"]
    properties = {"socket-path": str(socket), "is-live": True, "do-timestamp": True}
    elements[0] = {"name": "source", "element": "shmsrc", "properties": properties}
    flow = re.sub(r'"([\w-]+)": ', r"\1: ", json.dumps(elements))  # Hydra does not quote keys
    capture = f"+cameras.{CAMERA}.capture={{format: I420, width: 640, height: 360, fps: 15}}"
    words = (*V4L2, "source.frozen_s=1", f"source.elements={flow}", capture)
    with ExitStack() as until_unplugged:
        until_unplugged.enter_context(plugged_in(socket))
        with streaming(*words) as (side, _, (plan,), reported), watching(plan) as client:
            turn(side, sending=True, size=(480, 260), bitrate=500)
            until(lambda: client.frames_with_retry() > 10)
            until_unplugged.close()
            until(lambda: side.read()[CAMERA].fault)
            with plugged_in(socket):
                until(lambda: side.read()[CAMERA].fault is None)
                before = len(client.sizes)
                until(lambda: len(client.sizes) > before + 10)
                assert client.errors == []
                messages = [line.removeprefix(f"{CAMERA}: ") for line in faults(reported)]
    assert messages[0] == "pipeline built"  # once: viewers stay
    assert messages[1].startswith("source: ")
    assert messages[-1].startswith("works again after ")
    assert not any("built" in message for message in messages[1:])


@contextmanager
def plugged_in(socket):
    """A process that sends pictures through shared memory until the end of the context."""
    caps = "video/x-raw,format=I420,width=640,height=360,framerate=15/1"
    sink = f"shmsink socket-path={socket} shm-size=20000000 wait-for-connection=false"
    command = ["gst-launch-1.0", "-q", *f"videotestsrc is-live=true pattern=ball ! {caps} ! {sink}".split()]
    with subprocess.Popen(command) as writer:
        try:
            until(socket.exists)
            yield
        finally:
            writer.send_signal(signal.SIGINT)  # a killed one would leave its shared memory
            writer.wait(10)
            socket.unlink(missing_ok=True)


def noted(times, time):
    from runner.gst import Gst

    times.append(time)
    return Gst.PadProbeReturn.OK


@pytest.fixture
def credentials(tmp_path):
    file = tmp_path / "rear camera"
    file.write_text("viewer:se:same7\n")
    file.chmod(0o600)
    return file


def rear(address, *words):
    return ("vehicle=delivery_robot", "source=rtsp", "fps_max=15", f'source.address="{address}"', *words)


def test_a_camera_that_asks_for_a_password_gets_it_from_a_file(credentials):
    with ip_camera(free_port(), "viewer", "se:same7") as (address, _):
        words = rear(address, f'source.credentials="{credentials}"', "source.frozen_s=10")
        with streaming(*words, cameras=("rear",)) as (side, _, (plan,), reported), watching(plan) as client:
            knobs = {"sending": True, "size": (424, 240), "bitrate": 500}
            side.turn([Command("rear", knob, value) for knob, value in knobs.items()])
            until(lambda: client.frames_with_retry() > 10)
            assert "same7" not in plan.pipeline
            assert faults(reported) == ["rear: pipeline built"]


@pytest.mark.parametrize(
    ("text", "mode", "why"),
    [
        ("viewer:wrong", 0o600, "Unauthorized"),
        ("viewer:se:same7", 0o640, "credentials FILE: others may read it (mode 640); chmod 600"),
        ("viewer", 0o600, "credentials FILE: must contain one line user:password"),
        (None, 0o600, "credentials FILE: no such file"),
    ],
)
def test_problems_with_credentials_are_reported(credentials, text, mode, why):
    credentials.unlink()
    if text:
        credentials.write_text(text)
        credentials.chmod(mode)
    with ip_camera(free_port(), "viewer", "se:same7") as (address, _):
        words = rear(address, f'source.credentials="{credentials}"')
        with streaming(*words, cameras=("rear",)) as (_, _, (plan,), reported), watching(plan):
            until(lambda: any(why.replace("FILE", str(credentials)) in line for line in reported))
            assert not any("same7" in line for line in reported)


def test_a_strict_vehicle_whose_credentials_are_missing_does_not_start(tmp_path):
    words = rear(
        "rtsp://127.0.0.1:1/x", f'source.credentials="{tmp_path}/none"', "strict=true", f"media.port={free_port()}"
    )
    with process("vehicle", *words, cwd=CHECKOUT) as vehicle:
        output, _ = vehicle.communicate(timeout=60)
    assert vehicle.returncode == 1
    assert output.splitlines() == [
        f"camera {name}: credentials {tmp_path}/none: no such file" for name in ("front", "rear", "mast")
    ]
