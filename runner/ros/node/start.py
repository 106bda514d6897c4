"""Run the node of a ROS version, and report why it fails."""

from __future__ import annotations

import sys
from importlib import import_module

from .port import NodeError, Port

LIBRARIES = {1: "rospy", 2: "rclpy"}


def start(number: int) -> int:
    """Be the node until the other side of a socket closes it; returns the exit status."""
    port = Port(number)
    task = port.task()
    version = task["version"]
    try:
        import_module(f".ros{version}", __package__).run(port, task)
    except ImportError as error:
        what = f"{LIBRARIES[version]} for Python {'.'.join(map(str, sys.version_info[:2]))}"
        first = str(error).strip().splitlines()[0]
        port.send("fatal", text=f"ros.python: {sys.executable} cannot load {what}: {first}")
    except (BrokenPipeError, ConnectionResetError):
        return 0  # the other side has ended
    except NodeError as error:
        port.send("fatal", text=str(error))
    except Exception as error:
        port.send("fatal", text=f"{type(error).__name__}: {' '.join(str(error).split())}")
    else:
        return 0
    return 1
