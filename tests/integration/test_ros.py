"""Topics of ROS 2 as sources of a real vehicle, against real rclpy: pixels, capture times, faults, recovery."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import threading
import time
from contextlib import contextmanager
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from bags import filmed
from numbered import BITS, HEIGHT, WIDTH, encoded, number_of
from ros_domain import MARKS, PYTHON, domain  # noqa: F401
from shared_data import shared

from rig import CHECKOUT, children_named, free_port, run, streaming, until, watching
from runner.bag.pictures import FORMATS
from runner.core.commands import Command
from runner.core.model import RosSettings
from runner.operator.frames import live_frames

pytestmark = MARKS
RATE = 15
PROFILE = CHECKOUT / "runner/ros/fastdds.xml"


class Publisher:
    """A process with cameras that publish; see ros_publisher.py.

    large  it has shared memory for many pictures
    """

    def __init__(self, size=(WIDTH, HEIGHT), large=True):
        script = Path(__file__).with_name("ros_publisher.py")
        self.process = subprocess.Popen(
            [str(PYTHON), "-P", str(script), *map(str, (*size, BITS))],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, **({"FASTDDS_DEFAULT_PROFILES_FILE": str(PROFILE)} if large else {})},
        )
        self.sent = []  # topic, number, stamp
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self):
        for line in self.process.stdout:
            self.sent.append(json.loads(line))

    def publish(self, topic, fps=RATE, **wishes):
        self.process.stdin.write(json.dumps({"topic": topic, "fps": fps, **wishes}) + "\n")
        self.process.stdin.flush()


@contextmanager
def publishing(publisher=None, **cameras):
    """A publisher, with one topic /NAME/image for each camera, whose value are its wishes."""
    publisher = publisher or Publisher()
    try:
        for name, wishes in cameras.items():
            publisher.publish(f"/{name}/image", **wishes)
        yield publisher
    finally:
        publisher.process.stdin.close()
        publisher.process.wait(20)


def robot(*words):
    return (
        *("vehicle=delivery_robot", "source=ros", "~cameras.mast", f"fps_max={RATE}", f"ros.python={PYTHON}"),
        *("cameras.front.topic=/front/image", "cameras.rear.topic=/rear/image"),
        *(f"cameras.front.width_px={WIDTH}", f"cameras.front.height_px={HEIGHT}", "~cameras.front.native"),
        *(f"cameras.rear.width_px={WIDTH}", f"cameras.rear.height_px={HEIGHT}"),
        *words,
    )


@contextmanager
def subscribing(*words):
    """A vehicle's cameras, fed by topics. Yields (vehicle, plans, what was reported)."""
    from runner.vehicle.live import ros_cameras

    with streaming(*robot(*words), cameras=()) as (side, vehicle, plans, reported):
        cameras = ros_cameras(vehicle, side.push_shared, reported.append)
        cameras.start()
        try:
            knobs = (("sending", True), ("size", (WIDTH, HEIGHT)), ("bitrate", 3000))
            side.turn([Command(name, *knob) for name in vehicle.cameras for knob in knobs])
            yield vehicle, plans, reported
        finally:
            cameras.close()


def told(reported, part):
    return [line for line in reported if part in line]


def calm(reported):
    """Without what a busy machine adds."""
    return [line for line in reported if not re.search("a second|pictures were lost|pictures are lost", line)]


@contextmanager
def watched(plans, reported):
    """Viewers of both cameras, once these have pictures: one that comes earlier may be turned away."""
    until(lambda: len(told(reported, ": pictures are ")) == 2)
    with watching(plans[0]) as front, watching(plans[1]) as rear:
        until(lambda: min(len(front.sizes), len(rear.sizes)) > 10)
        yield front, rear


# --- pixels -----------------------------------------------------------------------------------------------------------


def shown(picture):
    """What GStreamer makes of a shared picture, as RGB."""
    from runner.gst import Gst
    from runner.gst.shared import push_shared

    pipeline = Gst.parse_launch(
        "appsrc name=source format=time is-live=true ! decodebin ! videoconvert ! video/x-raw,format=RGB "
        "! appsink name=sink sync=false"
    )
    pipeline.set_state(Gst.State.PLAYING)
    try:
        assert push_shared(pipeline.get_by_name("source"), replace(picture, captured=time.monotonic_ns()), Fraction(25))
        sample = pipeline.get_by_name("sink").emit("try-pull-sample", 20 * Gst.SECOND)
        caps, buffer = sample.get_caps().get_structure(0), sample.get_buffer()
        width, height = caps.get_int("width")[1], caps.get_int("height")[1]
        rows = np.frombuffer(buffer.extract_dup(0, buffer.get_size()), np.uint8).reshape(height, -1)
        return rows[:, : 3 * width].reshape(height, width, 3)
    finally:
        pipeline.set_state(Gst.State.NULL)


def road():
    return filmed(shared("video/forward_highway_day_540p25_A.mp4"), 1, (96, 54))[0]


def published(tmp_path, encoding, padding, big=False):
    """Wishes for a publisher of a road in an encoding, and the RGB that it stands for."""
    data, rgb = encoded(road(), encoding)
    rows = data.reshape(54, -1)
    if big:
        rows = rows.reshape(54, -1, 2)[..., ::-1].reshape(54, -1)
    rows = np.pad(rows, ((0, 0), (0, padding)))
    file = tmp_path / f"{encoding}{big}"
    file.write_bytes(rows.tobytes())
    form = {"encoding": encoding, "width": 96, "height": 54, "step": rows.shape[1], "big": big}
    return {"file": str(file), **form}, rgb


def test_pixels_of_each_encoding(tmp_path):
    """With rows of any length; and JPEG and PNG."""
    import cv2

    wanted = {}
    with publishing() as publisher:
        for number, encoding in enumerate(FORMATS):
            wishes, rgb = published(tmp_path, encoding, padding=number % 4 * 3)
            wanted[encoding] = rgb
            publisher.publish(f"/{encoding}/image", fps=5, **wishes)
        wishes, wanted["big"] = published(tmp_path, "mono16", 0, big=True)
        publisher.publish("/big/image", fps=5, **wishes)
        for kind in ("png", "jpg"):
            (tmp_path / kind).write_bytes(cv2.imencode(f".{kind}", road())[1].tobytes())
            wanted[kind] = road()[..., ::-1]
            publisher.publish(f"/{kind}/image", fps=5, file=str(tmp_path / kind), format=kind)
        pictures = {}

        def push(name, picture):
            if name in pictures:
                os.close(picture.memory)
            pictures.setdefault(name, picture)

        with camera_feed(wanted, push) as reported:
            until(lambda: len(pictures) == len(wanted))
    for name, rgb in wanted.items():
        found = shown(pictures[name])
        if name == "jpg":
            assert np.abs(found.astype(int) - rgb).mean() < 3
        else:
            assert np.abs(found.astype(int) - rgb).max() <= (4 if "u" in name else 2), name
    assert "rgb8: /rgb8/image: pictures are RGB 96x54, scaled up to the camera's 384x216" in reported
    assert all("scaled up" in line for line in reported)


# --- a vehicle --------------------------------------------------------------------------------------------------------


def take(received, seen):
    if (frame := received.next(1)) and frame.captured and (number := number_of(frame.image)) is not None:
        seen[frame.camera].append((number, frame.captured, time.time()))
    return True


def test_pictures_arrive_in_order_with_the_times_of_their_stamps():
    with publishing(front={}, rear={"late_s": 0.2}) as publisher, subscribing() as (vehicle, _, reported):
        seen = {"front": [], "rear": []}
        with live_frames([*robot(), f"media.port={vehicle.media.port}"]) as received:
            until(lambda: take(received, seen) and min(map(len, seen.values())) > 60)
    for name, pictures in seen.items():
        stamps = [(number, stamp / 1e9) for topic, number, stamp in publisher.sent if topic == f"/{name}/image"]
        for number, captured, at in pictures:
            own = min((stamp for n, stamp in stamps if n == number), key=lambda stamp: abs(stamp - captured))
            assert captured == pytest.approx(own, abs=0.005)
            assert (0.2 if name == "rear" else 0) < at - captured
        times = [captured for _, captured, _ in pictures]
        assert times == sorted(set(times))
    assert {line.partition(": ")[2] for line in calm(reported)} == {
        *("pipeline built", "pipeline stopped"),
        *(f"/{name}/image: pictures are BGR 384x216" for name in seen),
    }


def test_what_a_topic_may_do_wrong_is_told_once_and_others_go_on():
    unknown, size = "encoding 'bayer_rggb8' is not supported", "pictures are BGR 192x108"
    with (
        publishing(front={}, rear={}) as publisher,
        subscribing() as (_, plans, reported),
        watched(plans, reported) as (front, rear),
    ):
        publisher.publish("/front/image", encoding="bayer_rggb8")
        until(lambda: told(reported, unknown))
        before = len(rear.sizes)
        until(lambda: len(rear.sizes) > before + 2 * RATE)
        publisher.publish("/front/image")
        goes_on(front)
        publisher.publish("/front/image", half=True)
        until(lambda: told(reported, size))
        goes_on(front)
        publisher.publish("/front/image", late_s=3)
        until(lambda: told(reported, "a stamp is 3.0"))
        goes_on(front)
        publisher.publish("/front/image", late_s=-3)  # stays in doubt: not told again
        goes_on(front)
        publisher.publish("/front/image", late_s=None)
        goes_on(front)
        publisher.publish("/front/image")
        until(lambda: told(reported, "stamps are right again"))
        publisher.publish("/front/image", reliability="best_effort")
        goes_on(front)
        publisher.publish("/front/image", fps=0)
        until(lambda: told(reported, "/front/image: no publisher for 5 s"))
        until(lambda: told(reported, "front: source: no frame for 1 s"))
        publisher.publish("/front/image")
        until(lambda: told(reported, "/front/image: pictures come again, after "))
        goes_on(front)
    lines = [line.removeprefix("front: /front/image: ") for line in reported if "/front/image" in line]
    assert [re.sub(r"[0-9.]+ s", "N s", line) for line in calm(lines)] == [
        "pictures are BGR 384x216",
        f"{unknown}; expected one of {', '.join(FORMATS)}: such pictures are left out",
        f"{size}, scaled up to the camera's 384x216; they were BGR 384x216",
        "a stamp is N s old: the latency of these pictures is unknown",
        "pictures are BGR 384x216; they were BGR 192x108",
        "stamps are right again",
        "no publisher for N s",
        "pictures come again, after N s",
    ]
    assert calm(told(reported, "/rear/image")) == ["rear: /rear/image: pictures are BGR 384x216"]


def goes_on(client):
    before = len(client.sizes)
    until(lambda: len(client.sizes) > before + RATE)


def test_a_node_that_dies_is_started_again():
    with publishing(front={}, rear={}), subscribing() as (_, plans, reported), watched(plans, reported) as (front, _):
        (node,) = children_named(os.getpid(), "node.py")
        os.kill(node, signal.SIGKILL)
        until(lambda: told(reported, "the ROS node ended: killed by SIGKILL; starting it again"))
        until(lambda: told(reported, "the ROS node works again"))
        goes_on(front)
        (again,) = children_named(os.getpid(), "node.py")
        assert again != node
    until(lambda: not Path(f"/proc/{again}").exists())


def test_incompatible_qos_and_a_topic_of_another_type():
    words = ["ros.qos={/front/image: {reliability: reliable}, /rear/image: {durability: transient_local}}"]
    with publishing(front={"reliability": "best_effort"}, rear={}), subscribing(*words) as (_, _, reported):
        for name, policy in (("front", "reliability reliable"), ("rear", "durability transient_local")):
            why = f"incompatible QoS: ros.qos asks for {policy}, its publisher offers less"
            until(lambda line=f"{name}: /{name}/image: {why}": line in reported)
    with publishing(), subscribing("cameras.front.topic=/rosout", "cameras.rear.topic=/never") as (_, _, reported):
        kind = "has messages of type rcl_interfaces/msg/Log, must be sensor_msgs/msg/Image or "
        until(lambda: told(reported, f"front: /rosout: {kind}sensor_msgs/msg/CompressedImage"))
        until(lambda: told(reported, "rear: /never: no publisher for 5 s"))
        assert len(reported) == 2


def test_names_are_those_of_the_node_and_ages_are_by_its_clock():
    """A clock of a simulation that nobody publishes stands at 0."""
    words = ("ros.namespace=/front", "cameras.front.topic=image", "ros.remap={/seen: /rear/image}")
    simulated = ("cameras.rear.topic=/seen", "ros.use_sim_time=true")
    with publishing(front={}, rear={}), subscribing(*words, *simulated) as (_, _, reported):
        for name in ("front: image", "rear: /seen"):
            until(lambda line=f"{name}: pictures are BGR 384x216": line in reported)
            (line,) = told(reported, f"{name}: a stamp is ")
            assert line.endswith(" s in the future: the latency of these pictures is unknown")


@contextmanager
def camera_feed(names, push):
    """The topics /NAME/image of some cameras, without a vehicle. Yields what was reported."""
    from runner.configuration.config import configuration
    from runner.ros.cameras import RosCameras

    one, reported = configuration(robot(), runnable=False).vehicle().cameras["front"], []
    cameras = [replace(one, name=name, mount={"topic": f"/{name}/image"}) for name in names]
    settings = RosSettings(python=str(PYTHON))
    subscriber = RosCameras(settings, cameras, push, lambda name, what: reported.append(f"{name}: {what}"))
    subscriber.start()
    try:
        yield reported
    finally:
        subscriber.close()


# --- pictures that are lost -------------------------------------------------------------------------------------------


@contextmanager
def counted(publisher, names):
    """Topics of a publisher. Yields how late their pictures came, s, by name, and what was reported."""
    late_s = {name: [] for name in names}

    def push(name, picture):
        os.close(picture.memory)
        late_s[name].append((time.monotonic_ns() - picture.captured) / 1e9)

    with publishing(publisher, **{name: {"fps": 0} for name in names}), camera_feed(names, push) as reported:
        yield late_s, reported


def test_eight_topics_arrive():
    """480x270 at 10 Hz from one process, which is what the middleware's own settings lose pictures of."""
    names, fps, seconds = [f"camera_{number}" for number in range(8)], 10, 30
    publisher = Publisher((480, 270))
    with counted(publisher, names) as (late_s, reported):
        for name in names:
            publisher.publish(f"/{name}/image", fps=fps)
        until(lambda: all(late_s.values()))
        before, came = len(publisher.sent), sum(map(len, late_s.values()))
        until(lambda: len(publisher.sent) - before >= len(names) * fps * seconds, 10 * seconds)
        for name in names:
            publisher.publish(f"/{name}/image", fps=0)
        sent = len(publisher.sent) - before
        until(lambda: sum(map(len, late_s.values())) - came >= 0.99 * sent)
    late = sorted(late for every in late_s.values() for late in every)
    print(f"{sent} pictures, p95 {1e3 * late[len(late) * 95 // 100]:.1f} ms")
    assert [line for line in told(reported, "were lost") if " lost, 0 between publisher and node" not in line] == []


@pytest.mark.parametrize("large", [True, False])
def test_where_pictures_were_lost_is_reported(large):
    """A node that does not run for 0.7 s: a segment of shared memory that is too small is overwritten meanwhile."""
    publisher = Publisher(large=large)
    with counted(publisher, ["front", "rear"]) as (late_s, reported):
        for name in late_s:
            publisher.publish(f"/{name}/image", fps=10)
        until(lambda: all(late_s.values()))
        (node,) = children_named(os.getpid(), "node.py")
        os.kill(node, signal.SIGSTOP)
        before = len(publisher.sent)
        until(lambda: len(publisher.sent) - before >= 14)
        os.kill(node, signal.SIGCONT)
        line = until(lambda: told(reported, "pictures were lost"))[0]
        until(lambda: told(reported, "no pictures are lost any more"))
    lost, between, here = map(int, re.search(r": (\d+) of .* lost, (\d+) between .*, (\d+) since", line).groups())
    assert lost == between + here
    assert (here if large else between) > lost / 2
    assert max(late for every in late_s.values() for late in every) < 2


# --- what keeps a vehicle from starting -------------------------------------------------------------------------------


def refused(*words):
    done = run("vehicle", *robot(*words), f"media.port={free_port()}", f"control.port={free_port()}")
    return done.returncode, (done.stdout + done.stderr).splitlines()


def test_a_vehicle_without_rclpy_does_not_start(tmp_path):
    assert refused("ros.python=no/python") == (
        1,
        ["ros.python: no/python: no such program; `make ros2` makes .venv-ros2"],
    )
    status, lines = refused("ros.python=/usr/bin/python3")
    assert status == 1
    why = "the ROS node does not start: ros.python: /usr/bin/python3 cannot load rclpy for Python 3."
    assert lines[-1].startswith(why)
    assert lines[-1].endswith(": No module named 'rclpy'")


def test_nodes_of_other_machines_are_not_found_unless_they_prove_who_they_are():
    status, (line,) = refused("ros.discovery=subnet")
    assert status == 2
    assert line.startswith("command line: ros.discovery: subnet: admits any node of the network: set up SROS 2 ")


def test_a_camera_without_a_topic():
    status, lines = refused("~cameras.rear.topic")
    assert status == 2
    assert lines[0].endswith("topic: null: must be given, here or for each mounted camera as topic")
