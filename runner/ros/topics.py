"""The topics with pictures that nodes publish now."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from pathlib import Path
from typing import Any, NamedTuple

from runner.errors import RunError, reason
from runner.ros.node.port import NodeError
from runner.ros.node.ros1 import COMPRESSED, IMAGE, UNREACHABLE, proxy
from runner.ros.process import INSTALL_HINT, check_discovery, environment
from runner.settings import RosSettings
from runner.system import children

SCRIPT = Path(__file__).parent / "node" / "listing.py"
LISTEN_S = 3.0  # nodes find each other within a second
END_S = 30.0  # rclpy loads within a second, but takes longer while a machine boots


class Topic(NamedTuple):
    """encoding: of a picture that arrived, "" if none did; width, height: px, 0 if not stated; hz: as measured"""

    name: str
    kind: str
    encoding: str = ""
    width: int = 0
    height: int = 0
    hz: float = 0.0


def picture_topics(settings: RosSettings, insecure: bool) -> list[Topic]:
    """Topics of sensor_msgs/Image and CompressedImage; of ROS 1 without what their pictures are like.

    raises  RunError with the remedy if ROS cannot be asked, UserError if it would admit any node of the network
    """
    check_discovery(settings, insecure)
    found = environment(settings, insecure, publishes=False)
    return _of_ros1(found["ROS_MASTER_URI"]) if settings.version == 1 else _of_ros2(settings, found)


def _of_ros1(uri: str) -> list[Topic]:
    try:
        answer: Any = proxy(uri).getPublishedTopics("/tod_runner_doctor", "")
        _, text, pairs = answer
    except (NodeError, *UNREACHABLE) as error:
        why = reason(error) if isinstance(error, OSError) else str(error)
        raise RunError(f"the ROS master at {uri} does not answer: {why}") from None
    if not isinstance(pairs, list):
        raise RunError(f"the ROS master at {uri} refuses: {text}")
    return [Topic(name, kind) for name, kind in sorted(pairs) if kind in (IMAGE, COMPRESSED)]


def _of_ros2(settings: RosSettings, own: dict[str, str]) -> list[Topic]:
    python = settings.interpreter
    if shutil.which(python) is None:
        raise RunError(f"ros.python: {python}: no such program; {INSTALL_HINT[2]}, see docs/ros.md")
    command = children.bound([python, str(SCRIPT), str(LISTEN_S)])
    try:
        done = subprocess.run(
            command, env={**os.environ, **own}, capture_output=True, timeout=LISTEN_S + END_S, check=False
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise RunError(f"ros.python: {python}: {error}") from None
    if done.returncode:
        last = done.stderr.decode(errors="replace").strip().rpartition("\n")[2]
        raise RunError(f"ros.python: {python}: {last or children.ending(done.returncode)}; see docs/ros.md")
    return [Topic(**each) for each in json.loads(done.stdout)]
