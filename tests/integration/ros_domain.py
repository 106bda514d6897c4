"""What the tests with ROS 2 share: its Python, their marks, a domain of their own, a node that does as it is told."""

from __future__ import annotations

import json
import random
import subprocess
import threading
from contextlib import contextmanager
from pathlib import Path

import pytest

from rig import CHECKOUT, until

NODE = "/tod_runner"
PYTHON = CHECKOUT / ".venv-ros2/bin/python"
MARKS = [
    pytest.mark.gst,
    pytest.mark.ros,
    pytest.mark.soak,
    pytest.mark.skipif(not PYTHON.is_file(), reason="needs ROS 2 in .venv-ros2: make ros2"),
]


@pytest.fixture(autouse=True)
def domain(monkeypatch):
    """Nodes of other tests, and of the machine, are in other domains."""
    monkeypatch.setenv("ROS_DOMAIN_ID", str(random.SystemRandom().randrange(1, 100)))
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")


def whole(name):
    """The whole name of a topic or service of the bridge."""
    return name if name.startswith("/") else f"{NODE}/{name}"


class Client:
    """A node of ROS 2 in its own process; see ros_client.py."""

    def __init__(self, name, *topics):
        script = Path(__file__).with_name("ros_client.py")
        self.process = subprocess.Popen(
            [str(PYTHON), "-P", str(script), name, *topics], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        self.heard = []  # topic, text
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self):
        for line in self.process.stdout:
            self.heard.append(tuple(json.loads(line)))

    def publish(self, topic, **value):
        self.process.stdin.write(json.dumps({"topic": topic, **value}) + "\n")
        self.process.stdin.flush()

    def texts(self, topic):
        return [text for name, text in tuple(self.heard) if name == whole(topic)]

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


@contextmanager
def client(name, *topics):
    node = Client(name, *topics)
    try:
        yield node
    finally:
        node.process.stdin.close()
        node.process.wait(20)
