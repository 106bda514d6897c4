"""usage: python -P node.py SOCKET

A node of ROS 2 that subscribes to topics, and publishes text. Run by a Python that has rclpy; apart from that it needs
the standard library alone. SOCKET is the number of an open socket to the process that starts it (AF_UNIX,
SOCK_SEQPACKET), over which JSON passes.

To the node: first its task, then what it is to publish, each with topic, text and whether that is kept for late
subscribers. From the node: messages with the key "kind"; a picture comes with a file descriptor of the memory that
holds its data, see `Port.send_picture`. The node ends with its socket.
"""

from __future__ import annotations

import json
import os
import socket
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rclpy.node import Node
    from rclpy.qos import QoSProfile

IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
MAX_MESSAGE_BYTES = 131_072
MAX_TEXT = 20_000  # characters, which JSON may write as six bytes each
LOOK_S = 0.5  # how often topics are looked for
CLOSE_NS, TRIES = 100_000, 10  # clocks read within this count as read at once, or else the closest of so many readings
UNKNOWN_NODE = "_NODE_NAME_UNKNOWN_"  # of rmw: the topic has been discovered, its node not yet
ABSENT_S = 5.0  # a topic without a picture for so long is reported
LATE_NS = 200_000_000  # of pictures that wait for this node, those so much older than the newest are left out
COUNT_S, MOST_LOST = 5.0, 0.01  # pictures are counted over so long; if more of them are lost, that is reported


class Port:
    """The socket to the process that started this one."""

    def __init__(self, number: int) -> None:
        self._socket = socket.socket(fileno=number)

    def task(self) -> dict[str, Any]:
        task: dict[str, Any] = json.loads(self._socket.recv(MAX_MESSAGE_BYTES))
        return task

    def say(self, kind: str, **values: Any) -> None:
        self._socket.send(json.dumps({"kind": kind, **values}).encode())

    def send_picture(self, data: memoryview, **values: Any) -> None:
        """Copy a picture into memory of its own, and pass that on. The other side frees it, however it ends.

        If the other side is behind, the picture is lost: later ones count more.
        """
        memory = os.memfd_create("picture")
        try:
            while data:
                data = data[os.write(memory, data) :]
            message = json.dumps({"kind": "picture", **values}).encode()
            socket.send_fds(self._socket, [message], [memory], socket.MSG_DONTWAIT)
        except BlockingIOError:
            pass
        finally:
            os.close(memory)

    def orders(self) -> Iterator[dict[str, Any]]:
        """What is to be published, until the other side closes the connection, or is gone."""
        with suppress(OSError):
            while order := self._socket.recv(MAX_MESSAGE_BYTES):
                yield json.loads(order)


class Losses:
    """Counts the pictures of a topic that come to this node, and those that are lost before it passes them on."""

    def __init__(self) -> None:
        self._newest: dict[bytes, int] = {}  # by publisher, number of its newest picture
        self._since = time.monotonic()
        self._lossy = False  # as reported
        self._begin()

    def _begin(self) -> None:
        self._came = self._missing = 0  # the latter by the publishers' numbers
        self.untransported = 0  # of those missing, as far as the middleware knows
        self.late = 0  # of those that came

    def add(self, info: dict[str, Any]) -> None:
        """What comes with a picture. Not every middleware numbers pictures."""
        self._came += 1
        publisher, number = info.get("publisher_gid"), info.get("publication_sequence_number")
        if publisher and number is not None:
            last = self._newest.get(publisher["data"], number - 1)
            self._missing += max(0, number - last - 1)
            self._newest[publisher["data"]] = number

    def take_news(self) -> str:
        """Whether pictures are lost, and where; "" if nothing has changed. To be called every LOOK_S."""
        if time.monotonic() - self._since < COUNT_S:
            return ""
        self._since = time.monotonic()
        missing = max(self._missing, self.untransported)
        lost, all_of_them = missing + self.late, missing + self._came
        were, self._lossy = self._lossy, lost > MOST_LOST * all_of_them
        here = lost - self.untransported
        where = f"{self.untransported} between publisher and node, {here} since the node ran late"
        self._begin()
        if self._lossy and not were:
            return f"{lost} of {all_of_them} pictures were lost, {where}; docs/ros.md states what helps"
        return "no pictures are lost any more" if were and not self._lossy else ""


class Topic:
    """A topic with pictures: subscribes once it has a publisher, and reports what is wrong with it, once each.

    asked  what to ask for: reliability, durability, depth; None: what the publishers offer
    """

    def __init__(self, node: Node, port: Port, name: str, asked: dict[str, Any]) -> None:
        self._node, self._port, self._name, self._asked = node, port, name, asked
        self._subscribed: tuple[str, QoSProfile] | None = None
        self._subscription: Any = None
        self._heard = time.monotonic()  # when the last picture came
        self._losses = Losses()
        self._faults: set[str] = set()

    def look(self) -> None:
        """To be called every LOOK_S."""
        publishers = self._node.get_publishers_info_by_topic(self._name)
        kinds = sorted({publisher.topic_type for publisher in publishers})
        kind = next((kind for kind in (IMAGE, COMPRESSED) if kind in kinds), None)
        if kind:
            self._subscribe(kind, self._profile([p for p in publishers if p.topic_type == kind]))
        elif kinds:
            self._fail(f"has messages of type {', '.join(kinds)}, must be {IMAGE} or {COMPRESSED}")
        if time.monotonic() - self._heard > ABSENT_S and not self._faults:
            why = "its publisher sends no picture" if publishers else "no publisher"
            self._fail(f"{why} for {ABSENT_S:g} s")
        if news := self._losses.take_news():
            self._port.say("report", topic=self._name, text=news)

    def _profile(self, publishers: list[Any]) -> QoSProfile:
        """What is asked for, otherwise what all publishers can serve."""
        from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

        offered = {publisher.qos_profile.reliability for publisher in publishers}
        best = ReliabilityPolicy.RELIABLE if offered == {ReliabilityPolicy.RELIABLE} else ReliabilityPolicy.BEST_EFFORT
        reliability, durability = self._asked["reliability"], self._asked["durability"]
        return QoSProfile(
            depth=self._asked["depth"],
            reliability=ReliabilityPolicy[reliability.upper()] if reliability else best,
            durability=DurabilityPolicy[(durability or "volatile").upper()],
        )

    def _subscribe(self, kind: str, profile: QoSProfile) -> None:
        """Subscribe, again if the publisher has changed what it offers."""
        if self._subscribed == (kind, profile):
            return
        from rclpy.event_handler import SubscriptionEventCallbacks
        from sensor_msgs.msg import CompressedImage, Image

        if self._subscription:
            self._node.destroy_subscription(self._subscription)
        message = Image if kind == IMAGE else CompressedImage
        on = {"incompatible_qos": self._on_incompatible, "message_lost": self._on_lost}
        events = SubscriptionEventCallbacks(**on, use_default_callbacks=False)
        subscription = self._node.create_subscription(message, self._name, self._take, profile, event_callbacks=events)
        self._subscription = subscription
        self._subscribed = kind, profile

    def _on_incompatible(self, event: Any) -> None:
        from rclpy.qos import qos_policy_name_from_kind

        policy = qos_policy_name_from_kind(event.last_policy_kind).lower()
        if asked := self._asked.get(policy):  # otherwise the next look subscribes with what is offered now
            self._fail(f"incompatible QoS: ros.qos asks for {policy} {asked}, its publisher offers less")

    def _on_lost(self, event: Any) -> None:
        self._losses.untransported += event.total_count_change

    def _take(self, message: Any, info: dict[str, Any]) -> None:
        """Pass on a picture and those that wait behind it. Where this node runs late, the newest win."""
        waiting, handle = [(message, info)], self._subscription.handle
        with handle:
            while len(waiting) < self._asked["depth"] and (newer := handle.take_message(type(message), False)):
                waiting.append(newer)
        newest = waiting[-1][1]["source_timestamp"]
        for picture, about in waiting:
            self._losses.add(about)
            if newest - about["source_timestamp"] > LATE_NS:
                self._losses.late += 1
            else:
                self._pass_on(picture)

    def _pass_on(self, message: Any) -> None:
        """With its age by the node's clock, which may be that of a simulation; None: it has no stamp."""
        at, now = self._read_clocks()
        stamp = message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec
        age = now - stamp if stamp else None
        if self._faults:
            silent_s = time.monotonic() - self._heard
            self._faults.clear()
            self._port.say("report", topic=self._name, text=f"pictures come again, after {silent_s:.0f} s")
        self._heard = time.monotonic()
        data = memoryview(message.data)
        self._port.send_picture(data, topic=self._name, size=len(data), at=at, age=age, **form_of(message))

    def _read_clocks(self) -> tuple[int, int]:
        """CLOCK_MONOTONIC and the node's clock, ns; again if this process did not run between the two."""
        readings: list[tuple[int, int, int]] = []
        while len(readings) < TRIES and min(readings, default=(CLOSE_NS + 1,))[0] > CLOSE_NS:
            before, now, after = time.monotonic_ns(), self._node.get_clock().now().nanoseconds, time.monotonic_ns()
            readings.append((after - before, (before + after) // 2, now))
        return min(readings)[1:]

    def _fail(self, why: str) -> None:
        if why not in self._faults:
            self._faults.add(why)
            self._port.say("report", topic=self._name, text=why)


def form_of(message: Any) -> dict[str, Any]:
    """What is known about the data of an Image or a CompressedImage."""
    if not hasattr(message, "encoding"):
        return {"stated": message.format}
    form = {"encoding": message.encoding, "width": message.width, "height": message.height, "step": message.step}
    return {**form, "big": bool(message.is_bigendian)}


class Input:
    """A topic whose messages are passed on as they come.

    kind  text: std_msgs/String, number: std_msgs/Float64, fix: sensor_msgs/NavSatFix. Of numbers and positions only the
          newest counts
    """

    def __init__(self, node: Node, port: Port, name: str, kind: str) -> None:
        from rclpy.qos import QoSProfile, ReliabilityPolicy
        from sensor_msgs.msg import NavSatFix
        from std_msgs.msg import Float64, String

        self._node, self._port, self._name, self._kind = node, port, name, kind
        newest = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)  # is compatible with any publisher
        message, qos = {
            "text": (String, QoSProfile(depth=10)),
            "number": (Float64, newest),
            "fix": (NavSatFix, newest),
        }[kind]
        node.create_subscription(message, name, self._on_message, qos)

    def _on_message(self, message: Any) -> None:
        if self._kind == "fix":
            self._pass_on(lat=message.latitude, lon=message.longitude, fixed=message.status.status >= 0)
        elif self._kind == "number":
            self._pass_on(number=message.data)
        elif len(message.data) <= MAX_TEXT:
            self._pass_on(text=message.data)
        else:
            self._port.say("report", topic=self._name, text=f"a text is longer than {MAX_TEXT}: left out")

    def _pass_on(self, **values: Any) -> None:
        """With the names of all nodes that publish the topic; none as long as one is unknown."""
        publishers = self._node.get_publishers_info_by_topic(self._name)
        nodes = {f"{p.node_namespace.rstrip('/')}/{p.node_name}" for p in publishers}
        known = not any(UNKNOWN_NODE in name for name in nodes)
        self._port.say(self._kind, topic=self._name, nodes=sorted(nodes) if known else [], **values)


class Outputs:
    """Publishers of std_msgs/String, made with the first text for their topics."""

    def __init__(self, node: Node) -> None:
        self._node, self._publishers = node, dict[str, Any]()

    def publish(self, order: dict[str, Any]) -> None:
        from rclpy.qos import DurabilityPolicy, QoSProfile
        from std_msgs.msg import String

        topic, kept = order["topic"], order["kept"]
        if topic not in self._publishers:
            durability = DurabilityPolicy.TRANSIENT_LOCAL if kept else DurabilityPolicy.VOLATILE
            qos = QoSProfile(depth=1 if kept else 10, durability=durability)
            self._publishers[topic] = self._node.create_publisher(String, topic, qos)
        self._publishers[topic].publish(String(data=order["text"]))


def run(port: Port, task: dict[str, Any]) -> None:
    """Be the node until the other side of the port closes it."""
    import rclpy
    from rclpy.executors import SingleThreadedExecutor

    node = new_node(task)
    topics = [Topic(node, port, name, asked) for name, asked in task["pictures"].items()]
    for name, kind in task["inputs"].items():
        Input(node, port, name, kind)
    outputs = Outputs(node)

    def look() -> None:
        for topic in topics:
            topic.look()

    node.create_timer(LOOK_S, look, clock=rclpy.clock.Clock(clock_type=rclpy.clock.ClockType.STEADY_TIME))
    executor, closed = SingleThreadedExecutor(), threading.Event()
    executor.add_node(node)

    def obey() -> None:
        for order in port.orders():
            executor.create_task(outputs.publish, order)
        closed.set()
        executor.wake()

    port.say("ready")
    threading.Thread(target=obey, daemon=True).start()
    look()
    while not closed.is_set():
        executor.spin_once(timeout_sec=LOOK_S)
    node.destroy_node()
    rclpy.try_shutdown()


def new_node(task: dict[str, Any]) -> Node:
    import rclpy
    from rclpy.signals import SignalHandlerOptions

    words = [word for pair in task["remap"].items() for word in ("-r", ":=".join(pair))]
    simulated = ["-p", f"use_sim_time:={str(task['use_sim_time']).lower()}"]
    rclpy.init(args=["--ros-args", *words, *simulated], signal_handler_options=SignalHandlerOptions.NO)
    return rclpy.create_node(task["node"], namespace=task["namespace"])


def main(number: int) -> int:
    port = Port(number)
    task = port.task()
    try:
        run(port, task)
    except ImportError as error:
        version = ".".join(map(str, sys.version_info[:2]))
        first = str(error).strip().splitlines()[0]
        port.say("fatal", text=f"ros.python: {sys.executable} cannot load rclpy for Python {version}: {first}")
    except (BrokenPipeError, ConnectionResetError):
        return 0  # the other side is gone
    except Exception as error:
        port.say("fatal", text=f"{type(error).__name__}: {' '.join(str(error).split())}")
    else:
        return 0
    return 1


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1])))
