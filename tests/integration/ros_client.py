"""usage: python ros_client.py NODE TOPIC ...

Run by a Python that has rclpy: a node that subscribes to topics of type std_msgs/String. Each line on standard input is
JSON with topic and one of text, number, fix ([latitude, longitude, status]), to be published once somebody has
subscribed to it. Each message is told on standard output as JSON: topic, text. Ends with its input.
"""

from __future__ import annotations

import json
import sys
import threading
from functools import partial

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import NavSatFix
from std_msgs.msg import Float64, String


def message_of(order: dict) -> String | Float64 | NavSatFix:
    if "text" in order:
        return String(data=order["text"])
    if "number" in order:
        return Float64(data=order["number"])
    fix = NavSatFix(latitude=order["fix"][0], longitude=order["fix"][1])
    fix.status.status = order["fix"][2]
    return fix


def main(name: str, *topics: str) -> None:
    rclpy.init()
    node = rclpy.create_node(name)
    executor, ended = SingleThreadedExecutor(), threading.Event()
    executor.add_node(node)
    orders, publishers = [], {}

    def tell(topic: str, message: String) -> None:
        print(json.dumps([topic, message.data]), flush=True)

    for topic in topics:
        kept = "url" in topic or "state" in topic
        durability = DurabilityPolicy.TRANSIENT_LOCAL if kept else DurabilityPolicy.VOLATILE
        node.create_subscription(String, topic, partial(tell, topic), QoSProfile(depth=10, durability=durability))

    def obey() -> None:
        for order in tuple(orders):
            message, topic = message_of(order), order["topic"]
            if topic not in publishers:
                publishers[topic] = node.create_publisher(type(message), topic, 10)
            if publishers[topic].get_subscription_count():
                publishers[topic].publish(message)
                orders.remove(order)

    def read() -> None:
        for line in sys.stdin:
            orders.append(json.loads(line))
        ended.set()

    node.create_timer(0.02, obey)
    threading.Thread(target=read, daemon=True).start()
    while not ended.is_set():
        executor.spin_once(timeout_sec=0.5)
    rclpy.try_shutdown()


main(*sys.argv[1:])
