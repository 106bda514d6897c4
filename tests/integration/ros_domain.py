"""What the tests with ROS 2 share: its Python, their marks, and a domain of their own."""

from __future__ import annotations

import random

import pytest

from rig import CHECKOUT

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
