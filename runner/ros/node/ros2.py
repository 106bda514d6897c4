"""The ROS 2 node, based on rclpy."""

from __future__ import annotations

import os
import threading
import uuid
from array import array
from collections.abc import Iterable
from functools import partial
from importlib import import_module
from typing import TYPE_CHECKING, Any

from .inputs import NEWEST, SERVICES, TYPES, InputTopic
from .pictures import LATE_NS, POLL_S, SECOND_NS, PictureQueue, PictureTopic, image_fields, info_fields
from .port import Port

if TYPE_CHECKING:
    from rclpy.node import Node
    from rclpy.qos import QoSProfile

IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
UNKNOWN_NODE = "_NODE_NAME_UNKNOWN_"  # of rmw: the topic has been discovered, but not yet its node


class Ros2PictureTopic(PictureTopic):
    """Subscribes once the topic has a publisher, and again if its publishers offer something else.

    requested  reliability, durability, depth to request; None: what the publishers offer
    """

    def __init__(self, node: Node, port: Port, name: str, requested: dict[str, Any]) -> None:
        super().__init__(port, name, lambda: int(node.get_clock().now().nanoseconds))
        self._node, self._requested = node, requested
        self._subscribed: tuple[str, QoSProfile] | None = None
        self._subscription: Any = None

    def update(self) -> None:
        """To be called every POLL_S."""
        publishers = self._node.get_publishers_info_by_topic(self.name)
        kinds = sorted({publisher.topic_type for publisher in publishers})
        kind = next((kind for kind in (IMAGE, COMPRESSED) if kind in kinds), None)
        if kind:
            self._subscribe(kind, self._profile([p for p in publishers if p.topic_type == kind]))
        elif kinds:
            self.fail(f"has messages of type {', '.join(kinds)}, must be {IMAGE} or {COMPRESSED}")
        self.check_arrivals("its publisher has sent no picture" if publishers else "no publisher")

    def _profile(self, publishers: list[Any]) -> QoSProfile:
        """The requested profile; where nothing is requested, what all publishers offer."""
        from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

        offered = {publisher.qos_profile.reliability for publisher in publishers}
        best = ReliabilityPolicy.RELIABLE if offered == {ReliabilityPolicy.RELIABLE} else ReliabilityPolicy.BEST_EFFORT
        reliability, durability = self._requested["reliability"], self._requested["durability"]
        return QoSProfile(
            depth=self._requested["depth"],
            reliability=ReliabilityPolicy[reliability.upper()] if reliability else best,
            durability=DurabilityPolicy[(durability or "volatile").upper()],
        )

    def _subscribe(self, kind: str, profile: QoSProfile) -> None:
        if self._subscribed == (kind, profile):
            return
        from rclpy.event_handler import SubscriptionEventCallbacks
        from sensor_msgs.msg import CompressedImage, Image

        if self._subscription:
            self._node.destroy_subscription(self._subscription)
        message = Image if kind == IMAGE else CompressedImage
        on = {"incompatible_qos": self._on_incompatible, "message_lost": self._on_lost}
        events = SubscriptionEventCallbacks(**on, use_default_callbacks=False)
        subscription = self._node.create_subscription(message, self.name, self._take, profile, event_callbacks=events)
        self._subscription = subscription
        self._subscribed = kind, profile

    def _on_incompatible(self, event: Any) -> None:
        from rclpy.qos import qos_policy_name_from_kind

        policy = qos_policy_name_from_kind(event.last_policy_kind).lower()
        if requested := self._requested.get(policy):  # otherwise the next update subscribes with the new offer
            self.fail(f"ros.qos requests {policy}={requested}, but the publisher does not offer it")

    def _on_lost(self, event: Any) -> None:
        self.losses.lost_in_transport += event.total_count_change

    def _take(self, message: Any, info: dict[str, Any]) -> None:
        """Pass on a picture and those that wait behind it. If this node runs late, late ones are left out."""
        waiting, handle = [(message, info)], self._subscription.handle
        with handle:
            while len(waiting) < self._requested["depth"] and (newer := handle.take_message(type(message), False)):
                waiting.append(newer)
        newest = waiting[-1][1]["source_timestamp"]
        for picture, about in waiting:
            publisher = about.get("publisher_gid")
            self.losses.add(publisher and publisher["data"], about.get("publication_sequence_number"))
            if newest - about["source_timestamp"] > LATE_NS:
                self.losses.late += 1
            else:
                stamp = picture.header.stamp
                self.pass_on(picture, stamp.sec * SECOND_NS + stamp.nanosec)


class Ros2InputTopic(InputTopic):
    def __init__(self, node: Node, port: Port, name: str, kind: str) -> None:
        from rclpy.qos import QoSProfile, ReliabilityPolicy

        super().__init__(port, name, kind)
        self._node = node
        package, type_name = TYPES[kind]
        self._type = f"{package}/msg/{type_name}"
        each = QoSProfile(depth=10)
        newest = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)  # compatible with any publisher
        message = getattr(import_module(f"{package}.msg"), type_name)
        node.create_subscription(message, name, self.on_message, newest if kind in NEWEST else each)

    def update(self) -> None:
        """To be called every POLL_S."""
        publishers = self._node.get_publishers_info_by_topic(self.name)
        self.check_types((publisher.topic_type for publisher in publishers), self._type)

    def publishing_nodes(self, message: Any) -> list[str]:
        publishers = self._node.get_publishers_info_by_topic(self.name)
        nodes = {f"{p.node_namespace.rstrip('/')}/{p.node_name}" for p in publishers}
        return [] if any(UNKNOWN_NODE in name for name in nodes) else sorted(nodes)


class Ros2Services:
    """Services whose calls the other side of the port answers.

    kinds  by name, see SERVICES
    """

    def __init__(self, node: Node, port: Port, kinds: dict[str, str]) -> None:
        self._port = port
        self._waiting: dict[str, Any] = {}
        for name, kind in kinds.items():
            package, type_name = SERVICES[kind]
            service = getattr(import_module(f"{package}.srv"), type_name)
            node.create_service(service, name, partial(self._call, name))

    async def _call(self, name: str, request: Any, response: Any) -> Any:
        from rclpy.task import Future

        call = uuid.uuid4().hex
        self._waiting[call] = answer = Future()
        self._port.send("call", topic=name, call=call, value=getattr(request, "data", None))
        response.success, response.message = await answer
        return response

    def answer(self, order: dict[str, Any]) -> None:
        """Answer a call, unless it came from an earlier node process."""
        if answer := self._waiting.pop(order["call"], None):
            answer.set_result((order["success"], order["text"]))


class Ros2Outputs:
    """Publishers of std_msgs/String.

    latched  by topic, whether the newest text is latched for late subscribers
    """

    def __init__(self, node: Node, latched: dict[str, bool]) -> None:
        from rclpy.qos import DurabilityPolicy, QoSProfile
        from std_msgs.msg import String

        volatile = QoSProfile(depth=10)
        transient_local = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._publishers = {
            topic: node.create_publisher(String, topic, transient_local if latch else volatile)
            for topic, latch in latched.items()
        }

    def publish(self, order: dict[str, Any]) -> None:
        publisher = self._publishers[order["topic"]]
        publisher.publish(publisher.msg_type(data=order["text"]))


class Ros2Pictures(PictureQueue):
    """Publishers of sensor_msgs/Image and CameraInfo, made with the first picture for their topics."""

    def __init__(self, node: Node) -> None:
        super().__init__()
        self._node, self._publishers = node, dict[str, tuple[Any, Any]]()

    def publish(self, topic: str) -> None:
        """Publish the picture that waits."""
        order, memory = self.take(topic)
        try:
            image, info = self._publishers_of(topic)
            if image.get_subscription_count():
                message = stamped(image.msg_type(**image_fields(order)), order)
                data = array("B", bytes(order["step"] * order["height"]))
                os.preadv(memory, [data], 0)
                message.data = data
                image.publish(message)
            if info.get_subscription_count():
                fields = {key.lower(): value for key, value in info_fields(order).items()}
                info.publish(stamped(info.msg_type(**fields), order))
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


def stamped(message: Any, order: dict[str, Any]) -> Any:
    message.header.frame_id = order["frame_id"]
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(order["stamp"], SECOND_NS)
    return message


def run(port: Port, task: dict[str, Any]) -> None:
    """Be the node until the other side of the port closes it."""
    import rclpy
    from rclpy.executors import SingleThreadedExecutor

    node = new_node(task)
    topics = [Ros2PictureTopic(node, port, name, requested) for name, requested in task["pictures"].items()]
    inputs = [Ros2InputTopic(node, port, name, kind) for name, kind in task["inputs"].items()]
    outputs, pictures = Ros2Outputs(node, task["outputs"]), Ros2Pictures(node)
    services = Ros2Services(node, port, task["services"])
    every: Iterable[Ros2PictureTopic | Ros2InputTopic] = (*topics, *inputs)

    def update_topics() -> None:
        for topic in every:
            topic.update()

    node.create_timer(POLL_S, update_topics, clock=rclpy.clock.Clock(clock_type=rclpy.clock.ClockType.STEADY_TIME))
    executor, closed = SingleThreadedExecutor(), threading.Event()
    executor.add_node(node)

    def serve_orders() -> None:
        for order, memory in port.orders():
            if memory < 0:
                executor.create_task(services.answer if "call" in order else outputs.publish, order)
            elif pictures.put(order, memory):
                executor.create_task(pictures.publish, order["picture"])
        closed.set()
        executor.wake()

    port.send("ready")
    threading.Thread(target=serve_orders, daemon=True).start()
    update_topics()
    while not closed.is_set():
        executor.spin_once(timeout_sec=POLL_S)
    node.destroy_node()
    rclpy.try_shutdown()


def new_node(task: dict[str, Any]) -> Node:
    import rclpy
    from rclpy.signals import SignalHandlerOptions

    words = [word for pair in task["remap"].items() for word in ("-r", ":=".join(pair))]
    simulated = ["-p", f"use_sim_time:={str(task['use_sim_time']).lower()}"]
    rclpy.init(args=["--ros-args", *words, *simulated], signal_handler_options=SignalHandlerOptions.NO)
    return rclpy.create_node(task["node"], namespace=task["namespace"])
