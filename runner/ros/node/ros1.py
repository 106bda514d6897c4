"""The ROS 1 node, based on rospy.

rospy calls the ROS master without a timeout, and repeats the call until it answers. So everything that needs the master
happens in the main thread, once the master has answered within a timeout; other threads work on without it.
"""

from __future__ import annotations

import os
import queue
import socket
import threading
import time
import uuid
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from functools import partial
from http.client import HTTPConnection, HTTPException
from importlib import import_module
from typing import Any, NamedTuple
from urllib.parse import urlsplit
from xml.parsers.expat import ExpatError
from xmlrpc.client import Error, ServerProxy, Transport

from .inputs import NEWEST, SERVICES, TYPES, InputTopic
from .pictures import LATE_NS, POLL_S, SECOND_NS, PictureQueue, PictureTopic, image_fields, info_fields
from .port import NodeError, Port

IMAGE, COMPRESSED = "sensor_msgs/Image", "sensor_msgs/CompressedImage"
DEPTH = 10  # pictures of a topic that wait to be passed on; the oldest are dropped first
BUFFER_BYTES = 1 << 24  # large enough to read everything that has arrived, including the newest
ANSWER_S = 5.0  # timeout for a master or node on a busy machine
RECONNECT_S = 2.0  # between two attempts to reach a publisher, which rospy makes once
CALL_S = 30.0  # timeout for the answer of the other side of the port to a service call
UNREACHABLE = (OSError, Error, HTTPException, ExpatError)  # raised if a peer does not answer, or not as ROS does
ANY_LOOPBACK = "127.255.255.254"  # answered only by a server that listens on all addresses


class Registrations(NamedTuple):
    """The registrations of a ROS master: names of nodes by topic or service, and the types of topics."""

    publishers: dict[str, list[str]]
    subscribers: dict[str, list[str]]
    services: dict[str, list[str]]
    types: dict[str, str]


class _LimitedTransport(Transport):
    def make_connection(self, host: Any) -> HTTPConnection:
        connection = super().make_connection(host)
        connection.timeout = ANSWER_S
        return connection


class RosMaster:
    """The ROS master, which may be unreachable, and may restart without registrations. Used in one thread.

    node       full name of this node
    admit_all  whether it may admit any node on the network
    raises     NodeError
    """

    def __init__(self, port: Port, uri: str, node: str, admit_all: bool) -> None:
        self._port, self._uri, self._node, self._admit_all = port, uri, node, admit_all
        self._proxy = proxy(uri)
        self._is_down = False  # as reported

    def query(self) -> Registrations | None:
        """Its registrations; None: it does not answer, which is reported once."""
        known = None
        with suppress(*UNREACHABLE):
            publishers, subscribers, services = (dict(pairs) for pairs in self._call("getSystemState"))
            known = Registrations(publishers, subscribers, services, dict(self._call("getTopicTypes")))
        if (known is None) != self._is_down:
            self._is_down = known is None
            self._port.report(f"the ROS master at {self._uri} {'does not answer' if self._is_down else 'answers'}")
        return known

    def _call(self, method: str, *words: Any) -> Any:
        """raises  one of UNREACHABLE, also if the master refuses"""
        code, text, value = getattr(self._proxy, method)(self._node, *words)
        if code != 1:
            raise ConnectionError(text)
        return value

    def check(self) -> None:
        """Refuse a master that admits any node on the network.

        raises  NodeError
        """
        if self._admit_all:
            return
        try:
            socket.create_connection((ANY_LOOPBACK, urlsplit(self._uri).port or 80), ANSWER_S).close()
        except OSError:
            return
        rule = "admits any node on the network: start it with ROS_HOSTNAME=127.0.0.1, or give insecure=true"
        raise NodeError(f"the ROS master at {self._uri} {rule}")

    def check_name(self) -> None:
        """Refuse the name of a running node, which the master would shut down.

        raises  NodeError
        """
        try:
            uri = self._call("lookupNode", self._node)
            proxy(uri).getPid(self._node)
        except UNREACHABLE:
            return
        raise NodeError(f"a node named {self._node} is already running at {uri}: give another ros.node")

    def register(self, known: Registrations) -> None:
        """Repeat registrations that the master does not have, since it has been restarted.

        raises  NodeError
        """
        import rospy
        from rospy.impl.registration import get_service_manager, get_topic_manager

        topics, services, uri = get_topic_manager(), get_service_manager(), rospy.get_node_uri()

        def unknown(those: list[list[str]], to: dict[str, list[str]]) -> list[list[str]]:
            return [one for one in those if self._node not in to.get(one[0], ())]

        publications = unknown(topics.get_publications(), known.publishers)
        subscriptions = unknown(topics.get_subscriptions(), known.subscribers)
        offers = unknown(services.get_services(), known.services)
        if publications or subscriptions or offers:
            self.check()
        for name, kind in publications:
            self._call("registerPublisher", name, kind, uri)
        for name, kind in subscriptions:
            publishers = self._call("registerSubscriber", name, kind, uri)
            proxy(uri).publisherUpdate(self._node, name, publishers)  # as the master does
        for name, where in offers:
            self._call("registerService", name, where, uri)


def proxy(uri: str) -> ServerProxy:
    try:
        return ServerProxy(uri, transport=_LimitedTransport())
    except OSError as error:  # not an HTTP address
        raise NodeError(f"{uri}: {error}") from error


class Worker:
    """A thread that runs tasks one after the other."""

    def __init__(self) -> None:
        self._tasks: queue.SimpleQueue[Callable[[], object]] = queue.SimpleQueue()
        self._failed: Exception | None = None
        threading.Thread(target=self._work, daemon=True).start()

    def add(self, task: Callable[..., object], *arguments: object) -> None:
        """Add a task, from any thread."""
        self._tasks.put(partial(task, *arguments))

    def check(self) -> None:
        """raises what a task has raised; no task runs after that"""
        if self._failed:
            raise self._failed

    def _work(self) -> None:
        try:
            while True:
                self._tasks.get()()
        except Exception as error:
            self._failed = error


class Ros1PictureTopic(PictureTopic):
    """Subscribes once the topic has a publisher. The worker handles pictures and reports."""

    def __init__(self, port: Port, name: str, worker: Worker) -> None:
        import rospy

        super().__init__(port, name, lambda: int(rospy.Time.now().to_nsec()))
        self._worker = worker
        self._subscriber: Any = None
        self._kind, self._began = "", 0.0  # of the subscription
        self._lock = threading.Lock()
        self._waiting: deque[Any] = deque()  # pictures
        self._dropped: list[Any] = []  # identities of pictures that have waited too long

    def update(self, known: Registrations | None) -> None:
        """To be called every POLL_S by the main thread with the master's registrations, if it answers."""
        import rospy

        name = rospy.resolve_name(ros1_name(self.name))
        publishers = known.publishers.get(name, []) if known else []
        if known and publishers:
            self._check_type(known.types.get(name, ""))
        if self._is_connected():
            self._worker.add(self.check_arrivals, "its publisher has sent no picture")
        elif known:  # otherwise it is reported that the master does not answer
            self._worker.add(
                self.check_arrivals, "its publisher has been unreachable" if publishers else "no publisher"
            )

    def _check_type(self, kind: str) -> None:
        if kind in (IMAGE, COMPRESSED):
            self._subscribe(kind)
        else:
            self._worker.add(self.fail, f"has messages of type {kind}, must be {IMAGE} or {COMPRESSED}")

    def _is_connected(self) -> bool:
        return self._subscriber is not None and self._subscriber.get_num_connections() > 0

    def _subscribe(self, kind: str) -> None:
        """Subscribe; again if the type has changed or there is no connection."""
        is_lost = not self._is_connected() and time.monotonic() - self._began > RECONNECT_S
        if self._kind == kind and not is_lost:
            return
        import rospy
        from sensor_msgs.msg import CompressedImage, Image

        if self._subscriber:
            self._subscriber.unregister()
        message = Image if kind == IMAGE else CompressedImage
        own, options = ros1_name(self.name), {"buff_size": BUFFER_BYTES, "tcp_nodelay": True}
        self._subscriber = rospy.Subscriber(own, message, self._on_message, **options)
        self._kind, self._began = kind, time.monotonic()

    def _on_message(self, message: Any) -> None:
        """Called in a thread of the connection, which must not be blocked."""
        with self._lock:
            self._waiting.append(message)
            is_first = len(self._waiting) == 1
            if len(self._waiting) > DEPTH:
                self._dropped.append(identity_of(self._waiting.popleft()))
        if is_first:
            self._worker.add(self._take)

    def _take(self) -> None:
        """Pass on the pictures that wait. If this node runs late, late ones are left out."""
        with self._lock:
            dropped, waiting = tuple(self._dropped), tuple(self._waiting)
            self._dropped.clear()
            self._waiting.clear()
        for identity in dropped:
            self._count(*identity)
            self.losses.late += 1
        newest = waiting[-1].header.stamp.to_nsec()
        for message in waiting:
            self._count(*identity_of(message))
            stamp = message.header.stamp.to_nsec()
            if newest - stamp > LATE_NS:
                self.losses.late += 1
            else:
                self.pass_on(message, stamp)

    def _count(self, publisher: str, number: int) -> None:
        # TCP loses nothing: the publisher has replaced missing pictures by newer ones.
        self.losses.lost_in_transport += self.losses.add(publisher, number)


def identity_of(message: Any) -> tuple[str, int]:
    """The publisher of a picture, and the sequence number that the publisher's library gave it."""
    return message._connection_header.get("callerid", ""), message.header.seq


def ros1_name(name: str) -> str:
    """A name in ROS 1, which writes ~name where ROS 2 writes ~/name."""
    return f"~{name[2:]}" if name.startswith("~/") else name


class Ros1InputTopic(InputTopic):
    def __init__(self, port: Port, name: str, kind: str) -> None:
        import rospy

        super().__init__(port, name, kind)
        package, type_name = TYPES[kind]
        self._type = f"{package}/{type_name}"
        self._publishers: list[str] = []  # names of nodes, as last reported by the master
        message = getattr(import_module(f"{package}.msg"), type_name)
        size = 1 if kind in NEWEST else None
        self._subscriber = rospy.Subscriber(
            ros1_name(name), message, self.on_message, queue_size=size, tcp_nodelay=True
        )

    def update(self, known: Registrations) -> None:
        """To be called every POLL_S with the master's registrations."""
        name = self._subscriber.resolved_name
        self._publishers = known.publishers.get(name, [])
        self.check_types([known.types.get(name, self._type)] if self._publishers else [], self._type)

    def publishing_nodes(self, message: Any) -> list[str]:
        return sorted({message._connection_header.get("callerid", ""), *self._publishers})


class Ros1Services:
    """Services whose calls the other side of the port answers.

    kinds  by name, see SERVICES
    """

    def __init__(self, port: Port, kinds: dict[str, str]) -> None:
        import rospy

        self._port = port
        self._waiting: dict[str, Future[tuple[bool, str]]] = {}
        for name, kind in kinds.items():
            package, type_name = SERVICES[kind]
            service = getattr(import_module(f"{package}.srv"), type_name)
            rospy.Service(ros1_name(name), service, partial(self._call, name))

    def _call(self, name: str, request: Any) -> tuple[bool, str]:
        """Called in a thread of the call."""
        call = uuid.uuid4().hex
        answer: Future[tuple[bool, str]] = Future()
        self._waiting[call] = answer
        self._port.send("call", topic=name, call=call, value=getattr(request, "data", None))
        try:
            return answer.result(CALL_S)
        finally:
            self._waiting.pop(call, None)

    def answer(self, order: dict[str, Any]) -> None:
        """Answer a call, unless it has timed out."""
        if answer := self._waiting.pop(order["call"], None):
            answer.set_result((order["success"], order["text"]))


class Ros1Outputs:
    """Publishers of std_msgs/String.

    latched  by topic, whether the newest text is latched for late subscribers
    """

    def __init__(self, latched: dict[str, bool]) -> None:
        import rospy
        from std_msgs.msg import String

        self._publishers = {
            topic: rospy.Publisher(ros1_name(topic), String, queue_size=10, latch=latch)
            for topic, latch in latched.items()
        }

    def publish(self, order: dict[str, Any]) -> None:
        self._publishers[order["topic"]].publish(order["text"])


class Ros1Pictures(PictureQueue):
    """Publishers of sensor_msgs/Image and CameraInfo, made soon after the first picture for their topics."""

    def __init__(self) -> None:
        super().__init__()
        self._publishers: dict[str, tuple[Any, Any]] = {}
        self._new: set[str] = set()  # topics without publishers

    def publish(self, topic: str) -> None:
        """Publish the picture that waits, unless its topic has no publishers yet."""
        order, memory = self.take(topic)
        try:
            if topic not in self._publishers:
                self._new.add(topic)
                return
            image, info = self._publishers[topic]
            if image.get_num_connections():
                data = os.pread(memory, order["step"] * order["height"], 0)
                image.publish(stamped(image.data_class(data=data, **image_fields(order)), order))
            if info.get_num_connections():
                info.publish(stamped(info.data_class(**info_fields(order)), order))
        finally:
            os.close(memory)

    def advertise(self) -> None:
        """Make the publishers of new topics. Only while the master answers."""
        import rospy
        from sensor_msgs.msg import CameraInfo, Image

        for topic in self._new - self._publishers.keys():
            image, info = (
                rospy.Publisher(ros1_name(f"{topic}/{name}"), kind, queue_size=2, tcp_nodelay=True)
                for kind, name in ((Image, "image"), (CameraInfo, "camera_info"))
            )
            self._publishers[topic] = image, info


def stamped(message: Any, order: dict[str, Any]) -> Any:
    message.header.frame_id = order["frame_id"]
    message.header.stamp.secs, message.header.stamp.nsecs = divmod(order["stamp"], SECOND_NS)
    return message


def run(port: Port, task: dict[str, Any]) -> None:
    """Be the node until the other side of the port closes it.

    raises  NodeError
    """
    import rospy

    master = RosMaster(
        port, os.environ["ROS_MASTER_URI"], f"{task['namespace'].rstrip('/')}/{task['node']}", task["admit_all"]
    )
    while not master.query():
        if port.wait_closed(POLL_S):
            return
    master.check()
    master.check_name()
    rospy.core.configure_logging = lambda *_: None  # would write to ~/.ros; the node reports what matters
    rospy.init_node(task["node"], argv=remappings(task["remap"]), disable_signals=True, disable_rosout=True)
    worker = Worker()
    topics = [Ros1PictureTopic(port, name, worker) for name in task["pictures"]]
    inputs = [Ros1InputTopic(port, name, kind) for name, kind in task["inputs"].items()]
    outputs, pictures = Ros1Outputs(task["outputs"]), Ros1Pictures()
    services = Ros1Services(port, task["services"])

    def serve_orders() -> None:
        for order, memory in port.orders():
            if memory < 0:
                worker.add(services.answer if "call" in order else outputs.publish, order)
            elif pictures.put(order, memory):
                worker.add(pictures.publish, order["picture"])

    port.send("ready")
    threading.Thread(target=serve_orders, daemon=True).start()
    while not port.wait_closed(POLL_S):
        worker.check()
        if rospy.is_shutdown():
            raise NodeError("another node of the same name has started, or it was shut down over ROS")
        update_all(master, topics, inputs, pictures)
    rospy.signal_shutdown("closed")


def update_all(
    master: RosMaster, topics: list[Ros1PictureTopic], inputs: list[Ros1InputTopic], pictures: Ros1Pictures
) -> None:
    known = master.query()
    if known:
        with suppress(*UNREACHABLE):  # the next update reports it
            master.register(known)
        for one in inputs:
            one.update(known)
        pictures.advertise()
    for topic in topics:
        topic.update(known)


def remappings(remap: dict[str, str]) -> list[str]:
    """Remappings as on the command line of a node."""
    return [f"{ros1_name(name)}:={ros1_name(used)}" for name, used in remap.items()]
