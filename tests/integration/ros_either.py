"""A node of either ROS version for the scripts that tests start, with the library that their Python has."""

from __future__ import annotations

import os
import sys
import threading
import time
from array import array
from collections.abc import Callable
from typing import Any

try:
    import rclpy
except ImportError:
    import rospy

    STAMP = ("secs", "nsecs")
else:
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

    STAMP = ("sec", "nanosec")


class Ros2Node:
    def __init__(self, name: str) -> None:
        rclpy.init()
        self._node = rclpy.create_node(name)
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self._node)
        self._clients: dict[str, Any] = {}

    def publisher(
        self, kind: type, topic: str, depth: int = 10, reliability: str = "reliable", durability: str = "volatile"
    ) -> Any:
        qos = QoSProfile(
            depth=depth,
            reliability=ReliabilityPolicy[reliability.upper()],
            durability=DurabilityPolicy[durability.upper()],
        )
        return self._node.create_publisher(kind, topic, qos)

    def withdraw(self, publisher: Any) -> None:
        self._node.destroy_publisher(publisher)

    def subscribers(self, publisher: Any) -> int:
        return publisher.get_subscription_count()

    def subscribe(
        self, kind: type, topic: str, take: Callable[[Any], None], kept: bool = False, depth: int = 10
    ) -> None:
        durability = DurabilityPolicy.TRANSIENT_LOCAL if kept else DurabilityPolicy.VOLATILE
        self._node.create_subscription(kind, topic, take, QoSProfile(depth=10, durability=durability))

    def call(self, kind: Any, service: str, values: dict[str, Any], answered: Callable[[Any], None]) -> bool:
        """Call a service, if it is offered; returns whether it is."""
        if service not in self._clients:
            self._clients[service] = self._node.create_client(kind, service)
        client = self._clients[service]
        if not client.service_is_ready():
            return False
        client.call_async(kind.Request(**values)).add_done_callback(lambda future: answered(future.result()))
        return True

    def every(self, seconds: float, do: Callable[[], None]) -> Any:
        return self._node.create_timer(seconds, do)

    def stop(self, timer: Any) -> None:
        self._node.destroy_timer(timer)

    def run(self, ended: threading.Event, at_end: Callable[[], None] = lambda: None) -> None:
        while not ended.is_set():
            self._executor.spin_once(timeout_sec=0.5)
        at_end()
        rclpy.try_shutdown()


class Ros1Node:
    """Its timers use the machine's clock, even if ROS simulates one."""

    def __init__(self, name: str) -> None:
        rospy.init_node(name, disable_signals=True)
        self._timers: list[tuple[float, float, Callable[[], None]]] = []  # due, period

    def publisher(self, kind: type, topic: str, depth: int = 10, **_: str) -> Any:
        return rospy.Publisher(topic, kind, queue_size=depth)

    def withdraw(self, publisher: Any) -> None:
        publisher.unregister()

    def subscribers(self, publisher: Any) -> int:
        return publisher.get_num_connections()

    def subscribe(
        self, kind: type, topic: str, take: Callable[[Any], None], kept: bool = False, depth: int = 10
    ) -> None:
        rospy.Subscriber(topic, kind, take, buff_size=1 << 24)

    def call(self, kind: Any, service: str, values: dict[str, Any], answered: Callable[[Any], None]) -> bool:
        def ask() -> None:
            rospy.wait_for_service(service, 50)
            answered(rospy.ServiceProxy(service, kind)(**values))

        threading.Thread(target=ask, daemon=True).start()
        return True

    def every(self, seconds: float, do: Callable[[], None]) -> Any:
        timer = (time.monotonic() + seconds, seconds, do)
        self._timers.append(timer)
        return do

    def stop(self, timer: Any) -> None:
        self._timers = [one for one in self._timers if one[2] != timer]

    def run(self, ended: threading.Event, at_end: Callable[[], None] = lambda: None) -> None:
        while not ended.is_set():
            due, period, do = min(self._timers, key=lambda timer: timer[0], default=(time.monotonic() + 0.5, 0, None))
            if ended.wait(max(0.0, due - time.monotonic())) or do is None:
                continue
            self._timers = [(due + period, period, do) if one == (due, period, do) else one for one in self._timers]
            do()
        at_end()
        rospy.signal_shutdown("ended")
        os._exit(0)  # threads of rospy may still wait for others


Node = Ros2Node if "rclpy" in sys.modules else Ros1Node


def as_data(data: bytes) -> Any:
    """The data of an Image, in the form that the library accepts without checking each byte."""
    return data if Node is Ros1Node else array("B", data)


def set_stamp(message: Any, ns: int) -> None:
    for key, value in zip(STAMP, divmod(ns, 10**9), strict=True):
        setattr(message.header.stamp, key, value)


def stamp_s(message: Any) -> float:
    seconds, ns = (getattr(message.header.stamp, key) for key in STAMP)
    return seconds + ns / 1e9
