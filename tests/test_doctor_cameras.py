"""`doctor cameras`: what V4L2 devices and ROS offer, with YAML that is ready to paste; `demo camera=` takes one."""

from __future__ import annotations

import errno
import re
import threading
from collections.abc import Iterator
from fractions import Fraction
from functools import partial
from pathlib import Path
from xmlrpc.server import SimpleXMLRPCServer

import pytest
import yaml
from helpers import Command
from test_v4l2 import METADATA, NULL, Kernel

from runner.core.capture import Capture
from runner.ros.topics import Topic, picture_topics
from runner.settings import RosSettings
from runner.system import v4l2
from runner.system.v4l2 import Connected, Format, Size, Span, connected, preferred
from runner.verbs import doctor_cameras, own_camera

HD = Capture("mjpeg", 1280, 720, Fraction(30_000, 1001))


@pytest.fixture
def devices(tmp_path: Path) -> Path:
    """Two nodes, of which the first has a name that stays, and no others."""
    for name in ("video0", "video10", "video2", "null"):
        (tmp_path / name).symlink_to(NULL)
    return tmp_path


@pytest.fixture
def listed(monkeypatch: pytest.MonkeyPatch, devices: Path) -> Path:
    """The same as the devices of this machine."""
    monkeypatch.setattr(doctor_cameras, "connected", partial(connected, devices, Kernel()))
    return devices


def size(width: int, height: int, *rates: int) -> Size:
    return Size(Span(Fraction(width), Fraction(width)), Span(Fraction(height), Fraction(height)), spans(*rates))


def spans(*rates: int) -> tuple[Span, ...]:
    return tuple(Span(Fraction(rate), Fraction(rate)) for rate in rates)


def test_devices_are_listed_by_number_with_what_they_offer(devices: Path) -> None:
    found = list(connected(devices, Kernel()))
    assert [each.node.name for each in found] == ["video0", "video2", "video10"]
    assert {(each.card, each.problem) for each in found} == {("HD Pro Webcam C920", None)}
    assert [each.name for each in found[0].formats] == ["YUY2", "mjpeg"]


def test_nodes_that_capture_nothing_are_left_out(devices: Path) -> None:
    assert list(connected(devices, Kernel(METADATA))) == []
    assert list(connected(devices)) == []  # /dev/null answers no question


def test_a_device_in_use_is_listed_as_such(devices: Path) -> None:
    first, *_ = connected(devices, Kernel(busy=True))
    assert first.problem is not None and first.problem.startswith("is in use by ") and first.formats


def test_a_device_that_may_not_be_opened_is_listed_with_the_remedy(
    devices: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(v4l2, "Device", refuse)
    first, *_ = connected(devices)
    assert re.fullmatch(
        r"does not open: permission denied(; it is open to the group \w+: sudo .*)?", first.problem or ""
    )


def test_a_name_that_stays_is_preferred(devices: Path, tmp_path: Path) -> None:
    node = tmp_path / "real0"
    node.touch()
    (devices / "video0").unlink()
    (devices / "video0").symlink_to(node)
    stays = devices / "v4l/by-path/pci-0-usb-0:2:1.0-video-index0"
    stays.parent.mkdir(parents=True)
    stays.symlink_to(devices / "video0")
    first, second, _ = connected(devices, Kernel())
    assert (first.path, second.path) == (stays, devices / "video2")


@pytest.mark.parametrize(
    ("formats", "capture"),
    [
        ([Format("YUY2", (size(640, 480, 30), size(1280, 720, 10))), Format("mjpeg", (size(1280, 720, 30),))], "mjpeg"),
        ([Format("mjpeg", (size(1280, 720, 30),)), Format("YUY2", (size(1280, 720, 60, 30),))], "YUY2"),
        ([Format("h264", (size(1280, 720, 30),)), Format("mjpeg", (size(1280, 720, 30),))], "mjpeg"),
        ([Format("Z16 ", (size(1280, 720, 30),)), Format("NV12", (size(640, 360, 30),))], "NV12"),
    ],
)
def test_the_capture_nearest_to_720p_at_30_hz_is_preferred(formats: list[Format], capture: str) -> None:
    found = preferred(formats)
    assert (found.format, found.fps) == (capture, 30)
    assert (found.width, found.height) == ((640, 360) if capture == "NV12" else (1280, 720))


def test_ranges_and_unknown_rates_have_a_preferred_capture_too() -> None:
    wide, high = Span(Fraction(16), Fraction(1920), Fraction(16)), Span(Fraction(16), Fraction(1080), Fraction(2))
    stepped = Format("NV12", (Size(wide, high, (Span(Fraction(1), Fraction(60)),)),))
    assert preferred([stepped]) == Capture("NV12", 1280, 720, Fraction(30))
    assert preferred([Format("NV12", (Size(wide, high, ()),))]) == Capture("NV12", 1280, 720)
    assert preferred([]) == preferred([Format("Z16 ", ())]) == Capture()


def test_each_device_is_shown_with_formats_sizes_and_rates(tod: Command, listed: Path) -> None:
    status, out, _ = tod("doctor", "cameras")
    lines = out.splitlines()
    begin = lines.index(f"{listed / 'video0'}  HD Pro Webcam C920")
    assert status == 0
    assert [line.rstrip() for line in lines[begin + 1 : begin + 5]] == [
        "  YUY2   640x480 at 30, 15, 5 Hz",
        "  mjpeg  1920x1080 at 30, 15, 5 Hz",
        "         1280x720 at 30, 15, 5 Hz",
        f"  tod-runner demo camera={listed / 'video0'}",
    ]
    assert out.count("HD Pro Webcam C920") == 3


def pasted(out: str, directory: Path) -> None:
    """The YAML of the first camera, in the files that its comments name."""
    _, first, *_ = out.split("\n\n\n")
    _, *parts = re.split(r"^# (?=cameras/|vehicle/)", first, flags=re.MULTILINE)
    kind, defaults, mount = (part.partition("\n")[2] for part in parts)
    name = re.match(r"cameras/(\w+)\.yaml", parts[0])
    assert name
    for folder in ("cameras", "vehicle"):
        (directory / folder).mkdir(parents=True)
    (directory / f"cameras/{name[1]}.yaml").write_text(kind)
    head = "# @package _global_\nname: own\n"
    (directory / "vehicle/own.yaml").write_text(f"{head}defaults:\n{defaults.rstrip()}\n  - _self_\ncameras:\n{mount}")


def test_the_yaml_of_a_device_is_valid_as_printed(tod: Command, listed: Path, tmp_path: Path) -> None:
    pasted(tod("doctor", "cameras").out, tmp_path / "conf")
    words = (f"conf={tmp_path / 'conf'}", "vehicle=own")
    checked = tod("validate", *words)
    assert checked.status == 0, checked.err
    line = next(line for line in tod("print", *words).out.splitlines() if line.startswith("gst-launch"))
    assert f"device={listed / 'video0'}" in line
    assert "caps=image/jpeg,width=1280,height=720,framerate=30/1" in line
    document = yaml.safe_load((tmp_path / "conf/cameras/hd_pro_webcam_c920.yaml").read_text())
    assert (document["width_px"], document["height_px"], document["fps"]) == (1280, 720, 30)


def test_the_yaml_of_a_topic_is_valid_as_printed(tod: Command, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    topics = [Topic("/front/image_raw", "sensor_msgs/msg/Image", "bgr8", 640, 480, 14.9)]
    monkeypatch.setattr(doctor_cameras, "picture_topics", lambda *_: topics)
    out = tod("doctor", "cameras").out
    assert "/front/image_raw  sensor_msgs/msg/Image\n  bgr8 640x480 at 14.9 Hz\n" in out
    pasted(out, tmp_path)
    checked = tod("print", f"conf={tmp_path}", "vehicle=own")
    assert checked.status == 0, checked.err
    assert yaml.safe_load((tmp_path / "vehicle/own.yaml").read_text())["cameras"] == {
        "front": {"topic": "/front/image_raw"}
    }


def test_a_machine_without_cameras_is_told_so(tod: Command, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(doctor_cameras, "connected", partial(connected, tmp_path))
    status, out, _ = tod("doctor", "cameras", "ros.python=/nowhere/python")
    assert status == 1
    assert "no V4L2 device captures pictures here" in out
    assert "no ROS topics: ros.python: /nowhere/python: no such program; `make ros2`" in out


def test_doctor_mentions_cameras_that_it_finds(tod: Command, monkeypatch: pytest.MonkeyPatch, devices: Path) -> None:
    line = "V4L2 cameras: 3; `tod-runner doctor cameras` lists them, with their YAML"
    assert line not in tod("doctor", "vehicle", "vehicle=delivery_robot", "source=test").out
    monkeypatch.setattr("runner.verbs.doctor.connected", partial(connected, devices, Kernel()))
    assert f"ok      {line}" in tod("doctor", "vehicle", "vehicle=delivery_robot", "source=test").out


@pytest.fixture
def master(monkeypatch: pytest.MonkeyPatch) -> Iterator[SimpleXMLRPCServer]:
    """Answers getPublishedTopics as the master of ROS 1."""
    topics = [["/rear/compressed", "sensor_msgs/CompressedImage"], ["/rosout", "rosgraph_msgs/Log"]]
    topics.append(["/front/image", "sensor_msgs/Image"])
    with SimpleXMLRPCServer(("127.0.0.1", 0), logRequests=False) as server:
        server.register_function(lambda _node, _below: [1, "current topics", topics], "getPublishedTopics")
        monkeypatch.setenv("ROS_MASTER_URI", f"http://127.0.0.1:{server.server_address[1]}")
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield server
        server.shutdown()
        thread.join()


@pytest.mark.usefixtures("master")
def test_topics_of_ros_1_need_no_installation() -> None:
    found = picture_topics(RosSettings(version=1, python="/nowhere/python"), insecure=False)
    assert found == [
        Topic("/front/image", "sensor_msgs/Image"),
        Topic("/rear/compressed", "sensor_msgs/CompressedImage"),
    ]


@pytest.mark.parametrize(
    ("camera", "found"),
    [
        ("/dev/video99", "no such device; `tod-runner doctor cameras` lists what is connected"),
        ("/dev/null", "is no camera: it does not answer as a V4L2 device"),
        ("/", "is not a device file"),
        ("clip.mp4", f"no such file; must be as {own_camera.EXAMPLES}"),
    ],
)
@pytest.mark.gst
def test_a_wrong_camera_is_named_before_anything_starts(tod: Command, camera: str, found: str) -> None:
    assert tod("demo", f"camera={camera}")[::2] == (2, f"command line: camera: {camera}: {found}\n")


@pytest.mark.gst
def test_a_camera_of_ones_own_is_a_vehicle(tod: Command) -> None:
    rule = "must not be given with experiment=: it is a vehicle of one camera"
    assert tod("demo", "camera=/dev/null", "experiment=loss").err == f"command line: camera: /dev/null: {rule}\n"


@pytest.mark.parametrize(
    ("camera", "words"),
    [
        ("rtsp://10.0.0.11/a,b=c", ["source=rtsp", 'cameras.camera.address="rtsp://10.0.0.11/a,b=c"']),
        ("ros:/front/image_raw", ["source=ros", 'cameras.camera.topic="/front/image_raw"']),
    ],
)
def test_other_cameras_are_named_by_their_source(tod: Command, camera: str, words: list[str]) -> None:
    own = own_camera.camera_words(camera)
    assert own == ["vehicle=one_camera", *words]
    assert tod("print", *own).status == 0


def test_a_device_is_asked_for_what_it_offers(tod: Command, monkeypatch: pytest.MonkeyPatch, devices: Path) -> None:
    monkeypatch.setattr(own_camera, "Device", lambda path: v4l2.Device(path, Kernel()))
    words = own_camera.camera_words(str(devices / "video0"))
    status, out, err = tod("print", *words, "graph=h264_rtsp")
    assert status == 0, err
    assert "# camera: 1280x720" in out and "caps=image/jpeg,width=1280,height=720,framerate=30/1" in out
    changed = tod("print", *words, "cameras.camera.capture.format=h264").out
    assert "caps=video/x-h264,width=1280" in changed


def test_a_device_that_is_in_use_is_listed_with_its_yaml(tod: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    device = Connected(Path("/dev/video4"), Path("/dev/video4"), "Cam: Cam", [], "is in use by cheese (7)")
    monkeypatch.setattr(doctor_cameras, "connected", lambda: [device])
    out = tod("doctor", "cameras").out
    assert "/dev/video4  Cam: Cam\n  is in use by cheese (7)\n" in out and "# cameras/cam.yaml" in out
