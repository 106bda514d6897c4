"""Pictures of a ROS topic, without ROS: which are passed on, and what is reported."""

from __future__ import annotations

import os
import re
import socket
import sys
import threading
from dataclasses import replace
from itertools import count

import numpy as np
import pytest

from runner.configuration.config import configuration
from runner.errors import ConfigError, UserError
from runner.ros.cameras import CameraStream
from runner.ros.inputs import check_names
from runner.ros.node import pictures, ros1
from runner.ros.process import NodeProcess, check_discovery
from runner.settings import RosSettings
from runner.system.clocks import SECOND_NS

WORDS = ["vehicle=delivery_robot", "source=ros", "fps_max=10"]
TOPICS = [f"cameras.{name}.topic=/{name}" for name in ("front", "rear", "mast")]
RAW = {"encoding": "bgr8", "width": 1920, "height": 1080, "step": 5760, "big": False, "size": 5760 * 1080}


class Topic:
    """A camera's topic that receives pictures at given times, s."""

    def __init__(self):
        camera = configuration([*WORDS, *TOPICS]).vehicle().cameras["front"]
        self.reports = []
        self._stream = CameraStream(camera, lambda name, what: self.reports.append(f"{name}: {what}"))
        self.memory = os.memfd_create("picture")

    def get(self, at, age=0.0, **form):
        """The capture time of a picture, s; None if it is left out."""
        age_ns = None if age is None else round(age * SECOND_NS)
        message = {"at": round(at * SECOND_NS), "age": age_ns, **(form or RAW)}
        picture = self._stream.add(message, self.memory)
        return picture and picture.captured / SECOND_NS

    def take_reports(self):
        reports, self.reports[:] = [line.removeprefix("front: /front: ") for line in self.reports], []
        return reports


def test_capture_times_are_those_of_stamps_unless_a_clock_is_wrong():
    topic = Topic()
    assert topic.get(10, 0.25) == 9.75
    topic.take_reports()
    assert topic.get(10.1, 1.0) is None  # earlier than the one before
    assert topic.take_reports() == ["a picture is not later than the one before: such pictures are skipped"]
    assert topic.get(11, -0.02) == 11  # never from the future
    assert topic.take_reports() == []
    for at, age in ((11.1, 1.01), (11.2, -0.021), (11.3, None)):
        assert topic.get(at, age) == at
    assert topic.take_reports() == ["a stamp is 1.01 s old: the latency of these pictures is unknown"]
    assert topic.get(11.5, 0.1) == 11.4
    assert topic.take_reports() == ["stamps are correct again"]
    topic.get(11.6, None)
    assert topic.take_reports() == ["pictures have no stamp: their latency is unknown"]
    topic.get(11.7)
    topic.get(11.8, -3600)
    assert topic.take_reports()[1:] == ["a stamp is 3600.00 s in the future: the latency of these pictures is unknown"]


def test_each_size_and_format_is_reported_once():
    topic = Topic()
    topic.get(1), topic.get(1.1)
    assert topic.take_reports() == ["pictures are BGR 1920x1080"]
    small = {**RAW, "encoding": "mono8", "width": 100, "height": 50, "step": 100}
    topic.get(1.2, **small), topic.get(1.3, **small)
    assert topic.take_reports() == [
        "pictures are GRAY8 100x50, scaled up to the camera's 1280x960; they were BGR 1920x1080"
    ]


@pytest.mark.parametrize(
    "wrong, rule",
    [
        ({"encoding": "64FC1"}, "encoding '64FC1' is not supported; expected one of mono8, "),
        ({"step": 100}, "a picture of 1920x1080 with rows of 100 bytes, must be at least 5760"),
        ({"size": 100}, "a picture of 100 bytes, must have 6220800: 1080 rows of 5760"),
        ({"height": 0}, "a picture of 1920x0 with rows of 5760 bytes, must be at least 5760"),
    ],
)
def test_pictures_that_cannot_be_shown_are_left_out(wrong, rule):
    topic = Topic()
    topic.get(1)
    topic.take_reports()
    assert [topic.get(at, **{**RAW, **wrong}) for at in (2, 3)] == [None, None]
    assert topic.get(4) == 4
    assert topic.get(5, **{**RAW, **wrong}) is None
    first, again = topic.take_reports()
    assert first == again
    assert first.startswith(rule)
    assert first.endswith(": such pictures are skipped")


def test_bytes_determine_the_type_of_compressed_pictures():
    cv2 = pytest.importorskip("cv2")
    topic = Topic()
    os.write(topic.memory, b"GIF89a")
    assert topic.get(1, size=6, stated="jpeg") is None
    assert topic.take_reports() == ["format 'jpeg' is not supported; expected JPEG or PNG: such pictures are skipped"]
    png = cv2.imencode(".png", np.zeros((960, 1280), np.uint8))[1].tobytes()
    os.pwrite(topic.memory, png, 0)
    assert topic.get(2, size=len(png), stated="jpeg") == 2
    assert topic.take_reports() == ["pictures are png 1280x960"]
    assert topic.get(3, size=len(png) - 9, stated="jpeg") is None
    assert topic.get(4, size=0, stated="jpeg") is None
    assert topic.take_reports() == [
        "a PNG picture that is cut off or damaged: such pictures are skipped",
        "an empty picture: such pictures are skipped",
    ]


def test_a_rate_below_the_cameras_is_reported_once():
    topic = Topic()
    for number in range(200):
        topic.get(1 + number / 10)
    assert topic.take_reports() == ["pictures are BGR 1920x1080"]
    for number in range(100):
        topic.get(30 + number / 5)
    for number in range(200):
        topic.get(60 + number / 10)
    slow, again = topic.take_reports()
    assert slow.endswith(" pictures a second, the camera's fps is 10")
    assert again == "10.0 pictures a second, the camera's fps is 10"


def test_a_camera_needs_a_topic():
    with pytest.raises(
        ConfigError, match=r"topic: null: must be given: source\.topic=, or topic of each mounted camera"
    ):
        configuration([*WORDS, *TOPICS[:2]]).vehicle()


def test_the_name_of_a_topic_is_checked():
    with pytest.raises(ConfigError, match=r"cameras\.front\.topic: '/front camera': must be the name of a topic: "):
        configuration([*WORDS, *TOPICS[1:], "cameras.front.topic='/front camera'"]).vehicle()


def test_the_first_element_must_take_pictures():
    with pytest.raises(ConfigError, match="must be appsrc: the pictures of a topic are pushed into the first element"):
        configuration([*WORDS, *TOPICS, "source.elements.0.element=videotestsrc"]).vehicle()


def test_nodes_of_other_machines_need_keys(monkeypatch):
    monkeypatch.delenv("ROS_SECURITY_ENABLE", raising=False)
    monkeypatch.delenv("ROS_SECURITY_STRATEGY", raising=False)
    settings = RosSettings()
    check_discovery(settings, insecure=False)
    open_to_all = replace(settings, discovery="subnet")
    check_discovery(open_to_all, insecure=True)
    with pytest.raises(UserError, match=r"ros.discovery: subnet: admits any node on the network: set up SROS 2"):
        check_discovery(open_to_all, insecure=False)
    monkeypatch.setenv("ROS_SECURITY_ENABLE", "true")
    with pytest.raises(UserError):
        check_discovery(open_to_all, insecure=False)
    monkeypatch.setenv("ROS_SECURITY_STRATEGY", "Enforce")
    check_discovery(open_to_all, insecure=False)


@pytest.mark.parametrize(
    "uri, rule",
    [
        ("http://10.0.0.1:11311", "admits any node on the network, and ROS 1 has no keys: must be on this machine, or"),
        ("http://robot:11311/", "admits any node on the network, and ROS 1 has no keys: must be on this machine, or"),
        ("10.0.0.1:11311", "must be http://HOST:PORT"),
        ("http://localhost", "must be http://HOST:PORT"),
        ("http://localhost:master", "must be http://HOST:PORT"),
    ],
)
def test_a_master_of_another_machine_needs_insecure(monkeypatch, uri, rule):
    settings = RosSettings(version=1)
    monkeypatch.delenv("ROS_MASTER_URI", raising=False)
    check_discovery(settings, insecure=False)
    for own in ("", "http://127.0.0.1:1", "http://localhost:11311/"):
        monkeypatch.setenv("ROS_MASTER_URI", own)
        check_discovery(settings, insecure=False)
    monkeypatch.setenv("ROS_MASTER_URI", uri)
    with pytest.raises(UserError, match=re.escape(f"environment: ROS_MASTER_URI: {uri}: {rule}")):
        check_discovery(settings, insecure=False)
    check_discovery(RosSettings(), insecure=False)
    if rule.startswith("admits"):
        check_discovery(settings, insecure=True)


def test_version_1_refuses_all_keys_of_ros_2_together():
    words = ["ros.qos={/front: {depth: 1}}", "ros.discovery=subnet", "ros.use_sim_time=true"]
    assert configuration([*WORDS, *TOPICS, *words]).setup().ros.interpreter == ".venv-ros2/bin/python"
    assert configuration([*WORDS, *TOPICS, "ros.version=1"]).setup().ros.interpreter == "/usr/bin/python3"
    with pytest.raises(ConfigError) as failed:
        configuration([*WORDS, *TOPICS, *words, "ros.version=1"]).vehicle()
    assert str(failed.value).splitlines() == [
        "command line: ros.use_sim_time: has no effect with ros.version=1: "
        "a node follows the parameter /use_sim_time of its master",
        "command line: ros.discovery: has no effect with ros.version=1: "
        "ROS_MASTER_URI names the master, which knows all nodes",
        "command line: ros.qos: has no effect with ros.version=1: subscribers cannot request QoS",
        "3 problems, nothing was started",
    ]


@pytest.mark.parametrize(
    "version, library, remedy",
    [(2, "rclpy", "`make ros2` creates .venv-ros2"), (1, "rospy", "`make ros1` installs it")],
)
def test_doctor_names_how_to_install_the_environment(tod, version, library, remedy):
    done = tod("doctor", "ros", f"ros.version={version}", "ros.python=no/python")
    assert done.status == 1
    why = f"[Errno 2] No such file or directory: 'no/python'; {remedy}, see docs/ros.md"
    assert f"MISSING {library} for ros.python no/python: {why}" in done.out.splitlines()


def test_names_are_translated_for_rospy():
    remap = {"~/state": "/robot/state", "/front": "image", "front": "~/image"}
    assert ros1.remappings(remap) == ["~state:=/robot/state", "/front:=image", "front:=~image"]


def losses(monkeypatch, numbers, *, lost_in_transport=0, late=0, publisher=b"a", counted=None):
    """The report after COUNT_S on pictures with these numbers."""
    counted = counted or pictures.PictureCount()
    for number in numbers:
        counted.add(publisher, number)
    counted.lost_in_transport, counted.late = lost_in_transport, late
    later = pictures.time.monotonic() + pictures.COUNT_S
    monkeypatch.setattr(pictures.time, "monotonic", lambda: later)
    return counted.update()


def test_lost_pictures_are_reported_with_the_place_where_they_were_lost(monkeypatch):
    counted, lost = pictures.PictureCount(), "pictures were lost"
    assert losses(monkeypatch, range(7, 107), counted=counted) == ""
    assert losses(monkeypatch, range(112, 208), counted=counted) == ""  # 5 of 101, not more than one in twenty
    where = "3 between publisher and node, 3 since the node ran late; docs/ros.md states what helps"
    found = losses(monkeypatch, range(212, 311), lost_in_transport=3, late=2, counted=counted)
    assert found == f"6 of 103 {lost}, {where}"
    assert losses(monkeypatch, [320], counted=counted) == ""  # already reported
    assert losses(monkeypatch, [1, 2], publisher=b"b", counted=counted) == "no more pictures are lost"
    assert counted.update() == ""


def test_pictures_that_the_middleware_does_not_number_are_lost_as_far_as_it_knows(monkeypatch):
    counted = pictures.PictureCount()
    for _ in range(9):
        counted.add(None, None)
    lost = "1 of 10 pictures were lost, 1 between publisher and node, 0 since the node ran late"
    assert losses(monkeypatch, [], lost_in_transport=1, counted=counted).startswith(lost)


FAILS_ONCE = """
import pathlib, socket, sys, time
process = socket.socket(fileno=int(sys.argv[-1]))
process.send(b'{"kind": "ready"}')
failing = pathlib.Path(__file__).with_suffix(".failing")
failed = failing.with_suffix(".failed")
if not failed.exists():
    while not failing.exists():
        time.sleep(0.01)
    failed.touch()
    sys.exit(3)
process.recv(1)  # until it is closed
"""


def test_a_node_is_started_again_after_any_error(monkeypatch, tmp_path):
    monkeypatch.setattr("runner.ros.process.RETRY_S", (0.0, 0.0))
    interpreter = tmp_path / "python"
    interpreter.write_text(f"#!{sys.executable}\n{FAILS_ONCE}")
    interpreter.chmod(0o755)
    pairs, settings = count(1), replace(configuration([*WORDS, *TOPICS]).setup().ros, python=str(interpreter))

    def pair(*kind, real=socket.socketpair):
        if next(pairs) == 2:
            raise OSError(24, "Too many open files")
        return real(*kind)

    monkeypatch.setattr(socket, "socketpair", pair)
    reports, again = [], threading.Event()
    node = NodeProcess(settings, print, lambda _, text: reports.append(text) or (len(reports) > 2 and again.set()))
    node.start()
    interpreter.with_suffix(".failing").touch()
    assert again.wait(60)
    node.close()
    assert reports[:3] == [
        "the ROS node ended: status 3; starting it again",
        "the ROS node ended: OSError: [Errno 24] Too many open files; starting it again",
        "the ROS node works again",
    ]


def test_cameras_with_one_name_in_ros_are_refused():
    vehicle = configuration(["vehicle=delivery_robot"]).vehicle()
    front = vehicle.cameras["front"]
    check_names(vehicle)
    with pytest.raises(UserError, match="cameras: a_b: has the same name in ROS as a-b: rename one of them"):
        check_names(replace(vehicle, cameras={"a-b": front, "a_b": front}))
