"""Shared by the tests with ROS: both versions, isolated from other nodes of this machine, and nodes to control."""

from __future__ import annotations

import json
import os
import random
import shutil
import subprocess
import sys
import threading
from contextlib import contextmanager
from pathlib import Path
from xmlrpc.client import ServerProxy

import pytest

from rig import CHECKOUT, answers, free_port, until
from runner.settings import RosSettings

NODE = "/tod_runner"
SCRIPT = "ros/node"  # in the command line of the node
HERE = Path(__file__).parent
PROFILE = CHECKOUT / "runner/ros/fastdds.xml"
MARKS = [pytest.mark.gst, pytest.mark.ros, pytest.mark.soak]
ROS2_PYTHON = CHECKOUT / ".venv-ros2/bin/python"
MISSING = {  # by version, why it cannot be tested
    1: "" if shutil.which("rosmaster") else "needs ROS 1: make ros1",
    2: "" if ROS2_PYTHON.is_file() else "needs ROS 2 in .venv-ros2: make ros2",
}


class Ros:
    """A version of ROS.

    python   of the scripts of tests, which need numpy, too
    master   of ROS 1
    words    overrides by which a side uses it
    """

    def __init__(self, version, monkeypatch, logs):
        self.version, self.monkeypatch = version, monkeypatch
        self.python = {1: sys.executable, 2: str(ROS2_PYTHON)}[version]
        python = {1: "/usr/bin/python3", 2: self.python}[version]
        self.words = [f"ros.version={version}", f"ros.python={python}"]
        self.settings = RosSettings(version=version, python=python)
        if version == 2:
            monkeypatch.setenv("ROS_DOMAIN_ID", str(random.SystemRandom().randrange(1, 100)))
            monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        else:
            self.master = Master(logs)
            monkeypatch.setenv("ROS_MASTER_URI", self.master.uri)
            monkeypatch.setenv("ROS_HOSTNAME", "127.0.0.1")
            monkeypatch.setenv("ROS_LOG_DIR", str(logs))

    def type(self, package, name):
        """The name of a message type, as ROS writes it."""
        return f"{package}/{name}" if self.version == 1 else f"{package}/msg/{name}"

    def simulated(self):
        """Overrides for a simulated clock that nobody publishes: it stays at 0."""
        if self.version == 2:
            return ["ros.use_sim_time=true"]
        self.master.call("setParam", "/use_sim_time", True)
        return []

    def start(self, script, *words, large=True, inside=None):
        """A script, which may use `ros_either`.

        large   it has shared memory for many pictures
        inside  machine on which it runs, if not this one
        """
        profile = {"FASTDDS_DEFAULT_PROFILES_FILE": str(PROFILE)} if large else {}
        return subprocess.Popen(
            [*(inside.command if inside else ()), self.python, str(HERE / script), *words],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "PYTHONPATH": str(HERE), **profile},
        )

    @contextmanager
    def client(self, name, *topics, inside=None):
        node = RosClient(self.start("ros_client.py", name, *topics, large=not inside, inside=inside))
        try:
            yield node
        finally:
            node.process.stdin.close()
            node.process.wait(20)


class Master:
    """The ROS 1 master, on a port of its own, which can end and start again."""

    def __init__(self, logs):
        self.port, self._logs = free_port(), logs
        self.uri = f"http://127.0.0.1:{self.port}"
        self.process = None

    def start(self, host="127.0.0.1"):
        """host: None for a master that listens on all addresses."""
        environment = {**os.environ, "ROS_LOG_DIR": str(self._logs)}
        environment.pop("ROS_HOSTNAME", None)
        environment |= {"ROS_HOSTNAME": host} if host else {}
        command = ["rosmaster", "--core", "-p", str(self.port)]
        quiet = subprocess.DEVNULL
        self.process = subprocess.Popen(command, env=environment, stdout=quiet, stderr=quiet)
        until(lambda: answers(self.port))
        return self

    def kill(self):
        if self.process:
            self.process.kill()
            self.process.wait(20)

    def call(self, method, *words):
        code, text, value = getattr(ServerProxy(self.uri), method)("/test", *words)
        assert code == 1, text
        return value


@contextmanager
def running(version, logs):
    """A version of ROS, with its master, for the duration of the block."""
    if MISSING[version]:
        pytest.skip(MISSING[version])
    with pytest.MonkeyPatch.context() as monkeypatch:
        ros = Ros(version, monkeypatch, logs)
        try:
            if version == 1:
                ros.master.start()
            yield ros
        finally:
            if version == 1:
                ros.master.kill()


def whole(name):
    """The full name of a topic or service of the bridge."""
    return name if name.startswith("/") else f"{NODE}/{name}"


class RosClient:
    """A node in its own process; see ros_client.py."""

    def __init__(self, process):
        self.process = process
        self.messages = []  # topic, text
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self):
        for line in self.process.stdout:
            self.messages.append(tuple(json.loads(line)))

    def publish(self, topic, **value):
        self.process.stdin.write(json.dumps({"topic": topic, **value}) + "\n")
        self.process.stdin.flush()

    def texts(self, topic):
        return [text for name, text in tuple(self.messages) if name == whole(topic)]

    def newest(self, topic):
        return json.loads(until(lambda: self.texts(topic))[-1])

    def call(self, service, value=None):
        """Success and message of an answer."""
        before = len(self.texts(service))
        self.publish(whole(service), call=value)
        return until(lambda: self.texts(service)[before:])[0]

    def set(self, topic, **value):
        """The reply to a message."""
        before = len(self.texts("reply"))
        self.publish(whole(topic), **value)
        return json.loads(until(lambda: self.texts("reply")[before:])[0])

    def ask(self, **event):
        before = len(self.texts("reply"))
        self.publish(f"{NODE}/request", text=json.dumps(event))
        return json.loads(until(lambda: self.texts("reply")[before:])[0])
