"""usage: python -P node.py SOCKET

A node of ROS 2 that subscribes to topics, offers services, and publishes text. Run by a Python that has rclpy; apart
from that it needs the standard library alone. SOCKET is the number of an open socket to the process that starts it
(AF_UNIX, SOCK_SEQPACKET), over which JSON passes.

To the node: first its task, then orders: texts to publish, each with topic and whether it is kept for late
subscribers, pictures to publish, and answers to calls of services. From the node: messages with the key "kind". Either
way a picture comes with a file descriptor of the memory that holds its data. The node ends with its socket.
"""

from __future__ import annotations

import json
import os
import socket
import sys
import threading
import time
import uuid
from array import array
from collections.abc import Iterator
from contextlib import suppress
from functools import partial
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
COUNT_S, MOST_LOST = 5.0, 0.05  # pictures are counted over so long; if more of them are lost, that is reported


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
        memory = shared_memory(data)
        try:
            message = json.dumps({"kind": "picture", **values}).encode()
            socket.send_fds(self._socket, [message], [memory], socket.MSG_DONTWAIT)
        except BlockingIOError:
            pass
        finally:
            os.close(memory)

    def orders(self) -> Iterator[tuple[dict[str, Any], int]]:
        """What is to be published or answered, until the other side closes the connection, or is gone.

        yields  with the memory of a picture, to be closed; -1: it is none
        """
        with suppress(OSError):
            while True:
                order, memory, _, _ = socket.recv_fds(self._socket, MAX_MESSAGE_BYTES, 1, socket.MSG_CMSG_CLOEXEC)
                if not order:
                    return
                yield json.loads(order), memory[0] if memory else -1


def shared_memory(data: memoryview | bytes) -> int:
    """The file descriptor of new memory without a name that holds some data.

    raises  OSError
    """
    memory, data = os.memfd_create("picture"), memoryview(data)
    try:
        while data:
            data = data[os.write(memory, data) :]
    except OSError:
        os.close(memory)
        raise
    return memory


class PictureCount:
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
        self._losses = PictureCount()
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

    kind  text: std_msgs/String, number: std_msgs/Float64, region: sensor_msgs/RegionOfInterest, all of which count;
          fix: sensor_msgs/NavSatFix, newest_number: std_msgs/Float64, sign: std_msgs/Empty, of which the newest counts
    """

    def __init__(self, node: Node, port: Port, name: str, kind: str) -> None:
        from rclpy.qos import QoSProfile, ReliabilityPolicy
        from sensor_msgs.msg import NavSatFix, RegionOfInterest
        from std_msgs.msg import Empty, Float64, String

        self._node, self._port, self._name, self._kind = node, port, name, kind
        each = QoSProfile(depth=10)
        newest = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)  # is compatible with any publisher
        message, qos = {
            "text": (String, each),
            "number": (Float64, each),
            "region": (RegionOfInterest, each),
            "newest_number": (Float64, newest),
            "fix": (NavSatFix, newest),
            "sign": (Empty, newest),
        }[kind]
        node.create_subscription(message, name, self._on_message, qos)

    def _on_message(self, message: Any) -> None:
        match self._kind:
            case "fix":
                self._pass_on(lat=message.latitude, lon=message.longitude, fixed=message.status.status >= 0)
            case "newest_number":
                self._pass_on(number=message.data, nodes=self._publishing_nodes())
            case "number":
                self._pass_on(number=message.data)
            case "region":
                corner = {"x": message.x_offset, "y": message.y_offset}
                self._pass_on(**corner, width=message.width, height=message.height)
            case "sign":
                self._pass_on()
            case _ if len(message.data) <= MAX_TEXT:
                self._pass_on(text=message.data)
            case _:
                self._port.say("report", topic=self._name, text=f"a text is longer than {MAX_TEXT}: left out")

    def _pass_on(self, **values: Any) -> None:
        self._port.say(self._kind, topic=self._name, **values)

    def _publishing_nodes(self) -> list[str]:
        """Names of all nodes that publish the topic; none as long as one is unknown."""
        publishers = self._node.get_publishers_info_by_topic(self._name)
        nodes = {f"{p.node_namespace.rstrip('/')}/{p.node_name}" for p in publishers}
        return [] if any(UNKNOWN_NODE in name for name in nodes) else sorted(nodes)


class Services:
    """Services whose calls the other side of the port answers.

    kinds  by name, trigger: std_srvs/Trigger, or switch: std_srvs/SetBool
    """

    def __init__(self, node: Node, port: Port, kinds: dict[str, str]) -> None:
        self._port = port
        self._waiting: dict[str, Any] = {}
        if kinds:
            from std_srvs.srv import SetBool, Trigger

            for name, kind in kinds.items():
                node.create_service(Trigger if kind == "trigger" else SetBool, name, partial(self._call, name))

    async def _call(self, name: str, request: Any, response: Any) -> Any:
        from rclpy.task import Future

        call = uuid.uuid4().hex
        self._waiting[call] = answer = Future()
        self._port.say("call", topic=name, call=call, value=getattr(request, "data", None))
        response.success, response.message = await answer
        return response

    def answer(self, order: dict[str, Any]) -> None:
        """Calls of a node that ended since are left out."""
        if answer := self._waiting.pop(order["call"], None):
            answer.set_result((order["success"], order["text"]))


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


class Pictures:
    """Publishers of sensor_msgs/Image and CameraInfo, made with the first picture for their topics. The newest wins."""

    def __init__(self, node: Node) -> None:
        self._node, self._publishers = node, dict[str, tuple[Any, Any]]()
        self._newest: dict[str, tuple[dict[str, Any], int]] = {}  # by topic: what is known, and the memory
        self._lock = threading.Lock()

    def put(self, order: dict[str, Any], memory: int) -> bool:
        """Take a picture and its memory, from any thread. Returns False if one of its topic waits to be published."""
        with self._lock:
            before = self._newest.pop(order["picture"], None)
            self._newest[order["picture"]] = order, memory
        if before:
            os.close(before[1])
        return not before

    def publish(self, topic: str) -> None:
        """Publish the picture that waits."""
        with self._lock:
            order, memory = self._newest.pop(topic)
        try:
            image, info = self._publishers_of(topic)
            header = {"frame_id": order["frame_id"], "stamp": divmod(order["stamp"], 1_000_000_000)}
            if image.get_subscription_count():
                image.publish(image_message(image.msg_type(), order, memory, header))
            if info.get_subscription_count():
                info.publish(info_message(info.msg_type(), order, header))
        finally:
            os.close(memory)

    def _publishers_of(self, topic: str) -> tuple[Any, Any]:
        from rclpy.qos import QoSProfile
        from sensor_msgs.msg import CameraInfo, Image

        if topic not in self._publishers:
            kinds = ((Image, "image"), (CameraInfo, "camera_info"))
            image, info = (
                self._node.create_publisher(kind, f"{topic}/{name}", QoSProfile(depth=2)) for kind, name in kinds
            )
            self._publishers[topic] = image, info
        return self._publishers[topic]


def fill_header(message: Any, header: dict[str, Any]) -> None:
    message.header.frame_id = header["frame_id"]
    message.header.stamp.sec, message.header.stamp.nanosec = header["stamp"]


def image_message(message: Any, order: dict[str, Any], memory: int, header: dict[str, Any]) -> Any:
    fill_header(message, header)
    message.width, message.height, message.step = order["width"], order["height"], order["step"]
    message.encoding = order["encoding"]
    data = array("B", bytes(order["step"] * order["height"]))
    os.preadv(memory, [data], 0)
    message.data = data
    return message


def info_message(message: Any, order: dict[str, Any], header: dict[str, Any]) -> Any:
    """Of a picture whose intrinsics are unknown K is 0: sensor_msgs/CameraInfo."""
    fill_header(message, header)
    message.width, message.height = order["width"], order["height"]
    if lens := order["intrinsics"]:
        fx, fy, cx, cy = (lens[key] for key in ("fx", "fy", "cx", "cy"))
        message.distortion_model = lens["model"]
        message.d = [0.0] * (4 if lens["model"] == "equidistant" else 5)
        message.k = [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]
        message.r = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
        message.p = [fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0]
    return message


def run(port: Port, task: dict[str, Any]) -> None:
    """Be the node until the other side of the port closes it."""
    import rclpy
    from rclpy.executors import SingleThreadedExecutor

    node = new_node(task)
    topics = [Topic(node, port, name, asked) for name, asked in task["pictures"].items()]
    for name, kind in task["inputs"].items():
        Input(node, port, name, kind)
    outputs, pictures, services = Outputs(node), Pictures(node), Services(node, port, task["services"])

    def look() -> None:
        for topic in topics:
            topic.look()

    node.create_timer(LOOK_S, look, clock=rclpy.clock.Clock(clock_type=rclpy.clock.ClockType.STEADY_TIME))
    executor, closed = SingleThreadedExecutor(), threading.Event()
    executor.add_node(node)

    def obey() -> None:
        for order, memory in port.orders():
            if memory < 0:
                executor.create_task(services.answer if "call" in order else outputs.publish, order)
            elif pictures.put(order, memory):
                executor.create_task(pictures.publish, order["picture"])
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
