"""usage: python ros_client.py NODE TOPIC ...

Run by a Python that has rclpy: a node that subscribes to topics of type std_msgs/String. Each line on standard input is
JSON with topic and one of these:

    text, number, fix ([latitude, longitude, status]), region ([x, y, width, height]), empty
            to be published once somebody has subscribed to the topic
    call    the argument of std_srvs/SetBool, or null for std_srvs/Trigger: a call of that service, once it is offered

Topics that end in /image and /camera_info are of sensor_msgs. Each message is told on standard output as JSON: topic,
text, or a mapping with what matters; each answer: service, [success, message]. Ends with its
input.
"""

from __future__ import annotations

import json
import sys
import threading
from functools import partial

import numpy as np
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import CameraInfo, Image, NavSatFix, RegionOfInterest
from std_msgs.msg import Empty, Float64, String
from std_srvs.srv import SetBool, Trigger


def message_of(order: dict) -> object:
    if "empty" in order:
        return Empty()
    if "region" in order:
        return RegionOfInterest(**dict(zip(("x_offset", "y_offset", "width", "height"), order["region"], strict=True)))
    if "text" in order:
        return String(data=order["text"])
    if "number" in order:
        return Float64(data=order["number"])
    fix = NavSatFix(latitude=order["fix"][0], longitude=order["fix"][1])
    fix.status.status = order["fix"][2]
    return fix


def what(message: object) -> object:
    if isinstance(message, String):
        return message.data
    header = message.header
    stamp = header.stamp.sec + header.stamp.nanosec / 1e9
    known = {"stamp": stamp, "frame_id": header.frame_id, "width": message.width, "height": message.height}
    if isinstance(message, Image):
        rows = np.frombuffer(message.data, np.uint8).reshape(message.height, message.step)
        bright = np.argwhere(rows[:, : 3 * message.width : 3] > 128)
        spot = bright.mean(0)[::-1].tolist() if len(bright) else None  # its centre, x and y
        return {**known, "encoding": message.encoding, "spot": spot}
    return {**known, "model": message.distortion_model, "k": list(message.k), "d": list(message.d)}


def main(name: str, *topics: str) -> None:
    rclpy.init()
    node = rclpy.create_node(name)
    executor, ended = SingleThreadedExecutor(), threading.Event()
    executor.add_node(node)
    orders, publishers, clients = [], {}, {}

    def tell(topic: str, message: object) -> None:
        print(json.dumps([topic, what(message)]), flush=True)

    for topic in topics:
        kept = "url" in topic or "state" in topic
        durability = DurabilityPolicy.TRANSIENT_LOCAL if kept else DurabilityPolicy.VOLATILE
        kind = {"image": Image, "camera_info": CameraInfo}.get(topic.rpartition("/")[2], String)
        node.create_subscription(kind, topic, partial(tell, topic), QoSProfile(depth=10, durability=durability))

    def answered(service: str, future: rclpy.task.Future) -> None:
        print(json.dumps([service, [future.result().success, future.result().message]]), flush=True)

    def call(order: dict) -> None:
        kind, service = Trigger if order["call"] is None else SetBool, order["topic"]
        client = clients.get(service) or node.create_client(kind, service)
        clients[service] = client
        if client.service_is_ready():
            request = kind.Request() if order["call"] is None else kind.Request(data=order["call"])
            client.call_async(request).add_done_callback(partial(answered, service))
            orders.remove(order)

    def obey() -> None:
        for order in tuple(orders):
            if "call" in order:
                call(order)
                continue
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
