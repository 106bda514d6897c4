"""The process of the ROS node: starts it, restarts it when it has ended, and receives its messages."""

from __future__ import annotations

import json
import os
import shutil
import socket
import subprocess
import threading
from collections.abc import Callable, Iterable, Mapping
from contextlib import ExitStack, suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from runner.errors import ArgumentError, RunError, UserError
from runner.ros.node.port import MAX_MESSAGE_BYTES, shared_memory
from runner.security.exposure import is_loopback
from runner.settings import RosQos, RosSettings
from runner.system import children
from runner.system.backoff import pause_s

START_S = 30.0  # the node usually starts within a second, but takes much longer while a machine boots
RETRY_S = (1.0, 10.0)  # between two starts: exponential backoff from the first value up to the second
END_S = 2.0
LOCAL = ("off", "localhost")  # ranges in which the node looks for no other on another machine

INSTALL_HINT = {1: "`make ros1` installs it", 2: "`make ros2` creates .venv-ros2"}  # by version of ROS
MASTER = "http://localhost:11311"  # of ROS 1, as in rosgraph

SCRIPT = Path(__file__).parent / "node" / "__main__.py"
PROFILE = Path(__file__).with_name("fastdds.xml")
LOCAL_PROFILE = Path(__file__).with_name("fastdds_local.xml")
PROFILES = ("FASTDDS_DEFAULT_PROFILES_FILE", "FASTRTPS_DEFAULT_PROFILES_FILE")  # Fast DDS 3, and before
OWN_TRANSPORTS = (*PROFILES, "FASTDDS_BUILTIN_TRANSPORTS")

Message = Mapping[str, Any]
NOTHING: Mapping[str, str] = {}
NO_OUTPUTS: Mapping[str, bool] = {}


def check_discovery(settings: RosSettings, insecure: bool) -> None:
    """Refuse to discover unauthenticated nodes on other machines.

    raises  UserError
    """
    if settings.version == 1:
        _check_master(insecure)
        return
    enforced = os.environ.get("ROS_SECURITY_ENABLE") == "true" and os.environ.get("ROS_SECURITY_STRATEGY") == "Enforce"
    if settings.discovery not in LOCAL and not enforced and not insecure:
        rule = "admits any node on the network: set up SROS 2 (ROS_SECURITY_ENABLE=true ROS_SECURITY_STRATEGY=Enforce)"
        raise ArgumentError("ros.discovery", settings.discovery, f"{rule}, or give insecure=true")


def _check_master(insecure: bool) -> None:
    uri = _master_uri()
    try:
        parts = urlsplit(uri)
        is_address = parts.scheme == "http" and bool(parts.hostname and parts.port)
    except ValueError:  # not a valid port
        is_address = False
    if not is_address:
        raise UserError("environment", "ROS_MASTER_URI", uri, "must be http://HOST:PORT")
    if not is_loopback(parts.hostname or "") and not insecure:
        rule = "admits any node on the network, and ROS 1 has no keys: must be on this machine, or give insecure=true"
        raise UserError("environment", "ROS_MASTER_URI", uri, rule)


def _master_uri() -> str:
    return os.environ.get("ROS_MASTER_URI") or MASTER


def environment(settings: RosSettings, insecure: bool, publishes: bool) -> dict[str, str]:
    """Variables added to this process's environment for the node's process."""
    if settings.version == 1:
        own = {"ROS_MASTER_URI": _master_uri(), "ROS_NAMESPACE": settings.namespace}
        return own if insecure else {**own, "ROS_HOSTNAME": "127.0.0.1"}  # listens only there
    own = {"ROS_AUTOMATIC_DISCOVERY_RANGE": settings.discovery.upper()}
    is_local = settings.discovery in LOCAL and not insecure
    if is_local:
        own["ROS_STATIC_PEERS"] = ""  # they would be connected, whatever the range
    if (is_local or publishes) and not any(name in os.environ for name in OWN_TRANSPORTS):
        # The range limits whom this node looks for; only the profile keeps out nodes that look for this one.
        own |= dict.fromkeys(PROFILES, str(LOCAL_PROFILE if is_local else PROFILE))
    return own


class NodeProcess:
    """A node in its own process, from `start` until `close`.

    on_message  called with a message of a topic; for a picture, with properties and the file descriptor of its memory,
                which the callee must close
    on_report   called with a topic and one line about it; "" stands for the node itself
    pictures    topics with pictures, to subscribe to
    inputs      other topics to subscribe to, with the kind of their messages, see `runner.ros.node.inputs`
    outputs     text topics, with whether the newest text is latched for late subscribers
    services    services to offer, with the kind of their calls, see `runner.ros.node.inputs`; answered by `answer`
    publishes   whether it also publishes pictures, for which the middleware needs more shared memory than by default
    insecure    whether unauthenticated nodes on other machines may be discovered

    Both callbacks are called from one thread.
    """

    def __init__(
        self,
        settings: RosSettings,
        on_message: Callable[[Message, int], None],
        on_report: Callable[[str, str], None],
        *,
        pictures: Iterable[str] = (),
        inputs: Mapping[str, str] = NOTHING,
        outputs: Mapping[str, bool] = NO_OUTPUTS,
        services: Mapping[str, str] = NOTHING,
        publishes: bool = False,
        insecure: bool = False,
    ) -> None:
        self._settings, self._on_message, self._on_report = settings, on_message, on_report
        subscriptions = {topic: asdict(settings.qos.get(topic, RosQos())) for topic in pictures}
        own = {key: getattr(settings, key) for key in ("version", "node", "namespace", "use_sim_time")}
        offered = {"inputs": dict(inputs), "outputs": dict(outputs), "services": dict(services)}
        self._task = {**own, "remap": dict(settings.remap), "pictures": subscriptions, **offered, "admit_all": insecure}
        self._outputs = outputs
        self._environment = environment(settings, insecure, publishes)
        self._latched: dict[str, str] = {}  # text by topic
        self._lock = threading.Lock()
        self._socket: socket.socket | None = None  # while there is a process
        self._closing, self._tried = threading.Event(), threading.Event()
        self._is_ready, self._fatal = False, ""  # of the current process
        self._fault = ""  # as reported
        self._patient = False  # whether a node that does not start is tried again
        self._thread = threading.Thread(target=self._run, name="ros", daemon=True)

    def start(self, *, patient: bool = False) -> None:
        """Start the node and wait until it works, or has reported that it waits for the ROS 1 master.

        patient  a node that does not start is reported and tried again
        raises   RunError with the remedy, unless patient
        """
        self._patient = patient
        python = self._settings.interpreter
        if shutil.which(python) is None and not patient:
            raise RunError(f"ros.python: {python}: no such program; {INSTALL_HINT[self._settings.version]}")
        self._thread.start()
        why = "" if self._tried.wait(START_S) else f"not within {START_S:g} s"
        if not (why := why or self._fault):
            return
        if patient:
            self._on_report("", f"the ROS node does not start: {why}; trying again")
            return
        self.close()
        raise RunError(f"the ROS node does not start: {why}")

    def publish(self, topic: str, text: str) -> None:
        """Publish a text as std_msgs/String, from any thread. While no node runs, latched texts wait; others are lost.

        topic  one of the outputs
        """
        with self._lock:
            if self._outputs[topic]:
                self._latched[topic] = text
            self._send(topic=topic, text=text)

    def answer(self, call: str, success: bool, text: str) -> None:
        """Answer a service call, from any thread."""
        with self._lock:
            self._send(call=call, success=success, text=text)

    def publish_picture(self, picture: str, data: bytes, **about: Any) -> None:
        """Publish a picture as PICTURE/image and PICTURE/camera_info, from any thread.

        about  see `runner.ros.node.pictures`: frame_id, stamp, fields of the message, intrinsics
        raises  OSError
        """
        memory = shared_memory(data)
        try:
            with self._lock:
                self._send(memory, picture=picture, **about)
        finally:
            os.close(memory)

    def _send(self, *memory: int, **values: Any) -> None:
        """Send an order to the node; the caller must hold the lock."""
        order = json.dumps(values).encode()
        if self._socket and self._is_ready and len(order) <= MAX_MESSAGE_BYTES:
            with suppress(OSError):  # the node is behind, or has just ended
                socket.send_fds(self._socket, [order], memory, socket.MSG_DONTWAIT)

    def close(self) -> None:
        self._closing.set()
        with self._lock:
            if self._socket:
                self._socket.shutdown(socket.SHUT_RDWR)
        if self._thread.is_alive():
            self._thread.join(2 * END_S)

    def _run(self) -> None:
        """Main loop of the thread; it must live as long as the processes that it starts, see `children.bound`."""
        failed = 0
        while not self._closing.is_set():
            try:
                why = self._run_once()
            except Exception as error:  # the thread must continue: nothing else starts the node again
                why = f"{type(error).__name__}: {error}"
            if self._closing.is_set():
                return
            failed = 0 if self._is_ready else failed + 1
            self._fail(why)
            if not self._tried.is_set():
                self._tried.set()
                if not self._patient:
                    return
            self._closing.wait(pause_s(failed, *RETRY_S))

    def _fail(self, why: str) -> None:
        if why != self._fault:
            self._fault = why
            if self._tried.is_set():
                self._on_report("", f"the ROS node ended: {why}; starting it again")

    def _run_once(self) -> str:
        """Start a process and serve it until it ends; returns why it did."""
        self._is_ready, self._fatal = False, ""
        own, its = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with ExitStack() as stack, own, its:
            own.send(json.dumps(self._task).encode())
            process = subprocess.Popen(
                children.bound([self._settings.interpreter, str(SCRIPT), str(its.fileno())]),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,  # rclpy also writes this to its own log
                env={**os.environ, **self._environment},
                pass_fds=[its.fileno()],
                start_new_session=True,
            )
            stack.callback(children.end, process, END_S)  # once the connection is closed
            its.close()
            with self._lock:
                self._socket = None if self._closing.is_set() else own
            try:
                if self._socket:
                    self._receive(own)
            finally:
                with self._lock:
                    self._socket = None
        return self._fatal or children.ending(process.wait())

    def _receive(self, own: socket.socket) -> None:
        """Receive messages until the process ends, or this one closes the connection."""
        while True:
            with suppress(ConnectionResetError):
                data, memory, _, _ = socket.recv_fds(own, MAX_MESSAGE_BYTES, 1, socket.MSG_CMSG_CLOEXEC)
                if data:
                    self._take(json.loads(data), memory)
                    continue
            return

    def _take(self, message: Message, memory: list[int]) -> None:
        match message["kind"]:
            case "report":
                self._tried.set()  # the node works, though it may wait for the master of ROS 1
                self._on_report(message["topic"], message["text"])
            case "fatal":
                self._fatal = message["text"]
            case "ready":
                with self._lock:
                    self._is_ready = True
                    for topic, text in self._latched.items():
                        self._send(topic=topic, text=text)
                if self._fault:
                    self._fault = ""
                    self._on_report("", "the ROS node works again")
                self._tried.set()
            case _:
                self._on_message(message, memory[0] if memory else -1)
