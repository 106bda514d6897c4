"""ROS topics as sources of a real vehicle, with real rclpy and rospy: pixels, capture times, faults, recovery."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from contextlib import contextmanager, suppress
from dataclasses import replace
from fractions import Fraction
from http.client import HTTPException
from pathlib import Path
from xmlrpc.client import ServerProxy

import numpy as np
import pytest
from bags import filmed
from machines import cable, machines
from numbered import BITS, HEIGHT, WIDTH, encoded, number_of
from ros_domain import MARKS, ROS2_PYTHON, SCRIPT, running
from shared_data import shared

from rig import children_named, free_port, run, streaming, until, watching
from runner.bag.pictures import ENCODINGS
from runner.core.commands import Command
from runner.operator.frames import live_frames
from runner.ros.topics import picture_topics

pytestmark = MARKS
RATE = 15


class Publisher:
    """A process with cameras that publish; see ros_publisher.py.

    large  it has shared memory for many pictures
    """

    def __init__(self, ros, size=(WIDTH, HEIGHT), large=True):
        self.process = ros.start("ros_publisher.py", *map(str, (*size, BITS)), large=large)
        self.sent = []  # topic, number, stamp
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self):
        for line in self.process.stdout:
            self.sent.append(json.loads(line))

    def publish(self, topic, fps=RATE, **settings):
        self.process.stdin.write(json.dumps({"topic": topic, "fps": fps, **settings}) + "\n")
        self.process.stdin.flush()


@contextmanager
def publishing(ros, publisher=None, **cameras):
    """A publisher with one topic /NAME/image for each camera; the values are its settings."""
    publisher = publisher or Publisher(ros)
    try:
        for name, settings in cameras.items():
            publisher.publish(f"/{name}/image", **settings)
        yield publisher
    finally:
        publisher.process.stdin.close()
        publisher.process.wait(20)


def robot(ros, *words):
    return (
        *("vehicle=delivery_robot", "source=ros", "~cameras.mast", f"fps_max={RATE}", *ros.words),
        *("cameras.front.topic=/front/image", "cameras.rear.topic=/rear/image"),
        *(f"cameras.front.width_px={WIDTH}", f"cameras.front.height_px={HEIGHT}", "~cameras.front.native"),
        *(f"cameras.rear.width_px={WIDTH}", f"cameras.rear.height_px={HEIGHT}"),
        *words,
    )


@contextmanager
def subscribing(ros, *words):
    """A vehicle's cameras, fed by topics. Yields (vehicle, plans, what was reported)."""
    from runner.vehicle.live import ros_cameras

    with streaming(*robot(ros, *words), cameras=()) as (side, setup, plans, reported):
        cameras = ros_cameras(setup, side.push_shared, reported.append)
        cameras.start()
        try:
            knobs = (("sending", True), ("size", (WIDTH, HEIGHT)), ("bitrate", 3000))
            side.turn([Command(name, *knob) for name in setup.vehicle.cameras for knob in knobs])
            yield setup, plans, reported
        finally:
            cameras.close()


def matching(reported, part):
    return [line for line in reported if part in line]


def calm(reported):
    """The lines without those that a busy machine adds."""
    return [line for line in reported if not re.search("a second|pictures were lost|pictures are lost", line)]


@contextmanager
def watched(plans, reported):
    """Viewers of both cameras, once both have pictures."""
    until(lambda: len(matching(reported, ": pictures are ")) == 2)
    with watching(plans[0]) as front, watching(plans[1]) as rear:
        until(lambda: min(front.frames_with_retry(), rear.frames_with_retry()) > 10)
        yield front, rear


# --- pixels -----------------------------------------------------------------------------------------------------------


def shown(picture):
    """A shared picture as GStreamer converts it, as RGB."""
    from runner.gst import Gst
    from runner.gst.caps import structure
    from runner.gst.shared import push_shared

    pipeline = Gst.parse_launch(
        "appsrc name=source format=time is-live=true ! decodebin ! videoconvert ! video/x-raw,format=RGB "
        "! appsink name=sink sync=false"
    )
    pipeline.set_state(Gst.State.PLAYING)
    try:
        assert push_shared(pipeline.get_by_name("source"), replace(picture, captured=time.monotonic_ns()), Fraction(25))
        sample = pipeline.get_by_name("sink").emit("try-pull-sample", 20 * Gst.SECOND)
        caps, buffer = structure(sample.get_caps()), sample.get_buffer()
        width, height = caps.get_int("width")[1], caps.get_int("height")[1]
        rows = np.frombuffer(buffer.extract_dup(0, buffer.get_size()), np.uint8).reshape(height, -1)
        return rows[:, : 3 * width].reshape(height, width, 3)
    finally:
        pipeline.set_state(Gst.State.NULL)


def road():
    return filmed(shared("video/forward_highway_day_540p25_A.mp4"), 1, (96, 54))[0]


def published(tmp_path, encoding, padding, big=False):
    """Settings for a publisher of a road in an encoding, and the RGB that it represents."""
    data, rgb = encoded(road(), encoding)
    rows = data.reshape(len(data), -1)
    if big:
        rows = rows.reshape(54, -1, 2)[..., ::-1].reshape(54, -1)
    rows = np.pad(rows, ((0, 0), (0, padding)))
    file = tmp_path / f"{encoding}{big}"
    file.write_bytes(rows.tobytes())
    form = {"encoding": encoding, "width": 96, "height": 54, "step": rows.shape[1], "big": big}
    return {"file": str(file), **form}, rgb


def test_pixels_of_each_encoding(ros, tmp_path):
    """With rows of any length; and JPEG and PNG."""
    import cv2

    wanted = {}
    with publishing(ros) as publisher:
        for number, encoding in enumerate(ENCODINGS):
            settings, rgb = published(tmp_path, encoding, padding=number % 4 * 3)
            wanted[encoding] = rgb
            publisher.publish(f"/{encoding}/image", fps=5, **settings)
        settings, wanted["big"] = published(tmp_path, "mono16", 0, big=True)
        publisher.publish("/big/image", fps=5, **settings)
        for kind in ("png", "jpg"):
            (tmp_path / kind).write_bytes(cv2.imencode(f".{kind}", road())[1].tobytes())
            wanted[kind] = road()[..., ::-1]
            publisher.publish(f"/{kind}/image", fps=5, file=str(tmp_path / kind), format=kind)
        pictures = {}

        def push(name, picture):
            if name in pictures:
                os.close(picture.memory)
            pictures.setdefault(name, picture)

        with camera_feed(ros, wanted, push) as reported:
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


def test_pictures_arrive_in_order_with_the_times_of_their_stamps(ros):
    with publishing(ros, front={}, rear={"late_s": 0.2}) as publisher, subscribing(ros) as (setup, _, reported):
        seen = {"front": [], "rear": []}
        with live_frames([*robot(ros), f"media.port={setup.media.port}"]) as received:
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


def test_faults_of_a_topic_are_reported_once_and_others_continue(ros):
    unknown, size = "encoding 'bayer_rggb8' is not supported", "pictures are BGR 192x108"
    with (
        publishing(ros, front={}, rear={}) as publisher,
        subscribing(ros) as (_, plans, reported),
        watched(plans, reported) as (front, rear),
    ):
        publisher.publish("/front/image", encoding="bayer_rggb8")
        until(lambda: matching(reported, unknown))
        before = len(rear.sizes)
        until(lambda: len(rear.sizes) > before + 2 * RATE)
        publisher.publish("/front/image")
        goes_on(front)
        publisher.publish("/front/image", half=True)
        until(lambda: matching(reported, size))
        goes_on(front)
        publisher.publish("/front/image", late_s=3)
        until(lambda: matching(reported, "a stamp is 3.0"))
        goes_on(front)
        publisher.publish("/front/image", late_s=-3)  # stays in doubt: not told again
        goes_on(front)
        publisher.publish("/front/image", late_s=None)
        goes_on(front)
        publisher.publish("/front/image")
        until(lambda: matching(reported, "stamps are correct again"))
        publisher.publish("/front/image", reliability="best_effort")
        goes_on(front)
        publisher.publish("/front/image", fps=0)
        until(lambda: matching(reported, "/front/image: no publisher for 5 s"))
        until(lambda: matching(reported, "front: source: no frame for 1 s"))
        publisher.publish("/front/image")
        until(lambda: matching(reported, "/front/image: pictures arrive again, after "))
        goes_on(front)
    lines = [line.removeprefix("front: /front/image: ") for line in reported if "/front/image" in line]
    assert [re.sub(r"[0-9.]+ s", "N s", line) for line in calm(lines)] == [
        "pictures are BGR 384x216",
        f"{unknown}; expected one of {', '.join(ENCODINGS)}: such pictures are skipped",
        f"{size}, scaled up to the camera's 384x216; they were BGR 384x216",
        "a stamp is N s old: the latency of these pictures is unknown",
        "pictures are BGR 384x216; they were BGR 192x108",
        "stamps are correct again",
        "no publisher for N s",
        "pictures arrive again, after N s",
    ]
    assert calm(matching(reported, "/rear/image")) == ["rear: /rear/image: pictures are BGR 384x216"]


def goes_on(client):
    before = len(client.sizes)
    until(lambda: len(client.sizes) > before + RATE)


def test_topics_with_pictures_are_listed(ros):
    """Those of ROS 2 with what arrives on them."""
    picture = {"file": str(Path(__file__)), "format": "jpeg"}
    with publishing(ros, front={}, rear=picture, quiet={"fps": 0}):
        found = until(lambda: [*filter(None, [_listed(ros)])], seconds=60)[0]
    front, rear = found
    assert (front.name, front.kind) == ("/front/image", ros.type("sensor_msgs", "Image"))
    assert (rear.name, rear.kind) == ("/rear/image", ros.type("sensor_msgs", "CompressedImage"))
    if ros.version == 2:
        assert (front.encoding, front.width, front.height) == ("bgr8", WIDTH, HEIGHT)
        assert (rear.encoding, rear.width) == ("jpeg", 0)
        assert front.hz > 1


def _listed(ros):
    found = picture_topics(ros.settings, insecure=False)
    return found if len(found) == 2 and all(topic.hz for topic in found if ros.version == 2) else None


def test_a_killed_node_is_restarted(ros):
    with (
        publishing(ros, front={}, rear={}),
        subscribing(ros) as (_, plans, reported),
        watched(plans, reported) as (front, _),
    ):
        (node,) = children_named(os.getpid(), SCRIPT)
        os.kill(node, signal.SIGKILL)
        until(lambda: matching(reported, "the ROS node ended: killed by SIGKILL; starting it again"))
        until(lambda: matching(reported, "the ROS node works again"))
        goes_on(front)
        (again,) = children_named(os.getpid(), SCRIPT)
        assert again != node
    until(lambda: not Path(f"/proc/{again}").exists())


def test_incompatible_qos(ros2):
    words = ["ros.qos={/front/image: {reliability: reliable}, /rear/image: {durability: transient_local}}"]
    with (
        publishing(ros2, front={"reliability": "best_effort"}, rear={}),
        subscribing(ros2, *words) as (_, _, reported),
    ):
        for name, policy in (("front", "reliability=reliable"), ("rear", "durability=transient_local")):
            why = f"ros.qos requests {policy}, but the publisher does not offer it"
            until(lambda line=f"{name}: /{name}/image: {why}": line in reported)


def test_a_topic_of_another_type(ros):
    log = {1: "rosgraph_msgs/Log", 2: "rcl_interfaces/msg/Log"}[ros.version]
    topics = ("cameras.front.topic=/rosout", "cameras.rear.topic=/never")
    with publishing(ros), subscribing(ros, *topics) as (_, _, reported):
        image, compressed = (ros.type("sensor_msgs", name) for name in ("Image", "CompressedImage"))
        until(lambda: f"front: /rosout: has messages of type {log}, must be {image} or {compressed}" in reported)
        until(lambda: matching(reported, "rear: /never: no publisher for 5 s"))
        assert len(reported) == 2


def test_names_are_those_of_the_node_and_ages_are_by_its_clock(ros):
    """A simulated clock that nobody publishes stays at 0."""
    words = ("ros.namespace=/front", "cameras.front.topic=image", "ros.remap={/seen: /rear/image}")
    simulated = ("cameras.rear.topic=/seen", *ros.simulated())
    with publishing(ros, front={}, rear={}), subscribing(ros, *words, *simulated) as (_, _, reported):
        for name in ("front: image", "rear: /seen"):
            until(lambda line=f"{name}: pictures are BGR 384x216": line in reported)
            (line,) = matching(reported, f"{name}: a stamp is ")
            assert line.endswith(" s in the future: the latency of these pictures is unknown")


def test_both_versions_one_after_the_other(tmp_path):
    """A single key selects the version."""
    for version in (1, 2):
        with running(version, tmp_path) as ros, publishing(ros, front={}, rear={}):
            ros.words = [f"ros.version={version}"]
            with subscribing(ros) as (_, plans, reported), watched(plans, reported) as (front, rear):
                goes_on(front)
                goes_on(rear)
        assert {line.partition(": ")[2] for line in calm(reported) if "/image" in line} == {
            *("/front/image: pictures are BGR 384x216", "/rear/image: pictures are BGR 384x216")
        }


# --- ROS 1: a master that knows the nodes -----------------------------------------------------------------------------


def test_a_master_that_dies_and_returns(ros1):
    """Pictures continue without it; the next one brings topics of publishers that register there."""
    down, up = (f"the ROS master at {ros1.master.uri} {what}" for what in ("does not answer", "answers"))
    with subscribing(ros1) as (_, plans, reported):
        with publishing(ros1, front={}, rear={}), watched(plans, reported) as (front, rear):
            (node,) = children_named(os.getpid(), SCRIPT)
            for times in (1, 2):
                ros1.master.kill()
                until(lambda times=times: len(matching(reported, down)) == times)
                goes_on(front)
                goes_on(rear)
                ros1.master.start()
                until(lambda times=times: len(matching(reported, up)) == times)
            known = until(lambda: {"/front/image", "/rear/image"} <= subscribed(ros1) and subscribed(ros1))
            assert "/clock" not in known
            assert matching(reported, "no publisher") == []
        until(lambda: len(matching(reported, "/image: no publisher for 5 s")) == 2)
        with publishing(ros1, front={}, rear={}):
            until(lambda: len(matching(reported, "/image: pictures arrive again")) == 2)
            with watching(plans[0]) as front:
                goes_on(front)
        assert children_named(os.getpid(), SCRIPT) == [node]
    assert matching(reported, "the ROS node") == []


def subscribed(ros1):
    """Topics that the vehicle's node subscribes to, as the master knows it."""
    return {topic for topic, nodes in ros1.master.call("getSystemState")[1] if "/tod_runner" in nodes}


def test_a_master_that_starts_late(ros1):
    ros1.master.kill()
    with subscribing(ros1) as (_, plans, reported):
        until(lambda: f"the ROS master at {ros1.master.uri} does not answer" in reported)
        ros1.master.start()
        with publishing(ros1, front={}, rear={}), watched(plans, reported) as (front, _):
            goes_on(front)
    assert len(matching(reported, "the ROS master")) == 2


def test_a_master_that_hangs(ros1):
    with (
        publishing(ros1, front={}, rear={}),
        subscribing(ros1) as (_, plans, reported),
        watched(plans, reported) as (front, _),
    ):
        ros1.master.process.send_signal(signal.SIGSTOP)
        until(lambda: matching(reported, "does not answer"))
        goes_on(front)
        ros1.master.process.send_signal(signal.SIGCONT)
        until(lambda: matching(reported, f"the ROS master at {ros1.master.uri} answers"))
        goes_on(front)


def test_a_publisher_that_is_killed(ros1):
    """The master still lists it."""
    publisher = Publisher(ros1)
    with subscribing(ros1) as (_, plans, reported):
        for name in ("front", "rear"):
            publisher.publish(f"/{name}/image")
        until(lambda: len(matching(reported, ": pictures are ")) == 2)
        publisher.process.kill()
        publisher.process.wait(20)
        until(lambda: "front: /front/image: its publisher has been unreachable for 5 s" in reported)
        with publishing(ros1, front={}, rear={}):
            until(lambda: matching(reported, "front: /front/image: pictures arrive again, after "))
            with watching(plans[0]) as front:
                goes_on(front)


def test_a_master_that_any_machine_can_reach_is_refused(ros1):
    ros1.master.kill()
    ros1.master.start(host=None)
    status, lines = refused(ros1)
    assert (status, lines[-1]) == (
        1,
        f"the ROS node does not start: the ROS master at {ros1.master.uri} admits any node on the network: "
        "start it with ROS_HOSTNAME=127.0.0.1, or give insecure=true",
    )


def test_a_name_that_is_taken_is_refused(ros1):
    """The master would shut down the running node."""
    with publishing(ros1, front={}), subscribing(ros1) as (_, _, reported):
        until(lambda: matching(reported, "pictures are"))
        status, lines = refused(ros1)
        why = "the ROS node does not start: a node named /tod_runner is already running at http://127.0.0.1:"
        assert (status, lines[-1][: len(why)]) == (1, why)
        assert lines[-1].endswith(": give another ros.node")
        assert matching(reported, "the ROS node") == []


def test_a_node_that_is_shut_down_over_ros_is_restarted(ros1):
    with (
        publishing(ros1, front={}, rear={}),
        subscribing(ros1) as (_, plans, reported),
        watched(plans, reported) as both,
    ):
        with suppress(OSError, HTTPException):  # it may end before it answers
            ServerProxy(ros1.master.call("lookupNode", "/tod_runner")).shutdown("/test", "as rosnode kill does")
        why = "another node of the same name has started, or it was shut down over ROS"
        until(lambda: f"the ROS node ended: {why}; starting it again" in reported)
        until(lambda: matching(reported, "the ROS node works again"))
        goes_on(both[0])


def test_a_node_of_ros_1_leaves_no_files(ros1, monkeypatch, tmp_path):
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.delenv("ROS_LOG_DIR")
    with subscribing(ros1) as (_, _, reported):
        until(lambda: matching(reported, "/front/image: no publisher for 5 s"))
    assert not (tmp_path / "home/.ros").exists()


@contextmanager
def camera_feed(ros, names, push):
    """The topics /NAME/image of some cameras, without a vehicle. Yields what was reported."""
    from runner.configuration.config import configuration
    from runner.ros.cameras import RosCameras

    one, reported = configuration(robot(ros), runnable=False).vehicle().cameras["front"], []
    cameras = [replace(one, name=name, mount={"topic": f"/{name}/image"}) for name in names]
    subscriber = RosCameras(ros.settings, cameras, push, lambda name, what: reported.append(f"{name}: {what}"))
    subscriber.start()
    try:
        yield reported
    finally:
        subscriber.close()


# --- pictures that are lost -------------------------------------------------------------------------------------------


@contextmanager
def counted(ros, publisher, names):
    """Topics of a publisher. Yields by name how late their pictures arrived, s, and what was reported."""
    late_s = {name: [] for name in names}

    def push(name, picture):
        os.close(picture.memory)
        late_s[name].append((time.monotonic_ns() - picture.captured) / 1e9)

    with publishing(ros, publisher, **{name: {"fps": 0} for name in names}), camera_feed(ros, names, push) as reported:
        yield late_s, reported


def test_eight_topics_arrive(ros2):
    """480x270 at 10 Hz from one process, of which the middleware's default settings lose pictures."""
    names, fps, seconds = [f"camera_{number}" for number in range(8)], 10, 30
    publisher = Publisher(ros2, (480, 270))
    with counted(ros2, publisher, names) as (late_s, reported):
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
    assert [line for line in matching(reported, "were lost") if " lost, 0 between publisher and node" not in line] == []


def losses(ros, large=True):
    """The report on pictures lost while the node was stopped: in total, in transport, and in the node."""
    publisher = Publisher(ros, large=large)
    with counted(ros, publisher, ["front", "rear"]) as (late_s, reported):
        for name in late_s:
            publisher.publish(f"/{name}/image", fps=10)
        until(lambda: all(late_s.values()))
        (node,) = children_named(os.getpid(), SCRIPT)
        os.kill(node, signal.SIGSTOP)
        before = len(publisher.sent)
        until(lambda: len(publisher.sent) - before >= 14)
        os.kill(node, signal.SIGCONT)
        line = until(lambda: matching(reported, "pictures were lost"))[0]
        until(lambda: matching(reported, "no more pictures are lost"))
    assert max(late for every in late_s.values() for late in every) < 2
    return map(int, re.search(r": (\d+) of .* lost, (\d+) between .*, (\d+) since", line).groups())


def test_pictures_that_were_lost_since_the_node_ran_late_are_reported(ros):
    lost, between, here = losses(ros)
    assert lost == between + here
    assert here > lost / 2


def test_pictures_that_a_small_segment_of_shared_memory_lost_are_reported(ros2):
    """It is overwritten while the node is stopped."""
    lost, between, here = losses(ros2, large=False)
    assert lost == between + here
    assert between > lost / 2


# --- what keeps a vehicle from starting -------------------------------------------------------------------------------


def refused(ros, *words):
    done = run("vehicle", *robot(ros, *words), f"media.port={free_port()}", f"control.port={free_port()}")
    return done.returncode, (done.stdout + done.stderr).splitlines()


def test_a_vehicle_without_the_library_does_not_start(ros):
    remedy = {1: "`make ros1` installs it", 2: "`make ros2` creates .venv-ros2"}[ros.version]
    assert refused(ros, "ros.python=no/python") == (1, [f"ros.python: no/python: no such program; {remedy}"])
    library, other = {1: ("rospy", ROS2_PYTHON), 2: ("rclpy", "/usr/bin/python3")}[ros.version]
    if not shutil.which(other):
        pytest.skip("needs the other version of ROS, too")
    status, lines = refused(ros, f"ros.python={other}")
    assert status == 1
    why = f"the ROS node does not start: ros.python: {other} cannot load {library} for Python 3."
    assert lines[-1].startswith(why)
    assert lines[-1].endswith(f": No module named '{library}'")


def test_unauthenticated_nodes_of_other_machines_are_not_discovered(ros2):
    status, (line,) = refused(ros2, "ros.discovery=subnet")
    assert status == 2
    assert line.startswith("command line: ros.discovery: subnet: admits any node on the network: set up SROS 2 ")


LISTENER = """\
import sys, time
from runner.settings import RosSettings
from runner.ros.process import NodeProcess
node = NodeProcess(RosSettings(python=sys.argv[1]), lambda message, _: print(message["text"], flush=True), print,
                   inputs={"/heard": "text"})
node.start()
sys.stdin.read()
node.close()
"""


def test_a_node_of_another_machine_that_knows_the_address_is_not_connected(ros2, monkeypatch):
    with machines("own", "other") as (own, other):
        cable(own, "link0", other, "link0")
        own.run("ip addr add 10.9.0.1/24 dev link0")
        other.run("ip addr add 10.9.0.2/24 dev link0")
        own.run("ip route add 224.0.0.0/4 dev link0")
        command = [*own.command, sys.executable, "-c", LISTENER, ros2.python]
        with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as listener:
            with ros2.client("local", inside=own) as local:
                monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "SUBNET")
                monkeypatch.setenv("ROS_STATIC_PEERS", "10.9.0.1")
                with ros2.client("foreign", inside=other) as foreign:
                    foreign.publish("/heard", text="foreign")  # waits for a subscriber
                    time.sleep(5)
                    local.publish("/heard", text="local")
                    assert listener.stdout.readline() == "local\n"
                    time.sleep(2)
            assert listener.communicate(timeout=20)[0] == ""


def test_a_camera_without_a_topic(ros):
    status, lines = refused(ros, "~cameras.rear.topic")
    assert status == 2
    assert lines[0].endswith("topic: null: must be given: source.topic=, or topic of each mounted camera")
