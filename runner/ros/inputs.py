"""Operator inputs as ROS topics and services, and the event that each requests of the vehicle. Pure."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from runner.core.model import Camera, Mode, Vehicle
from runner.errors import UserError

InputValues = Mapping[str, Any]
PRESENCE = "~/operator_connected"


class OperatorInput(NamedTuple):
    """A topic or service.

    kind   number: std_msgs/Float64, region: sensor_msgs/RegionOfInterest; services: trigger: std_srvs/Trigger, switch:
           std_srvs/SetBool
    event  what a message or call with these values requests
           raises ValueError with the rule that a value breaks
    """

    kind: str
    event: Callable[[InputValues], dict[str, Any]]


def ros_name(camera: str) -> str:
    """A camera's name as part of a topic name, which may not contain hyphens or begin with a digit."""
    name = camera.replace("-", "_")
    return f"_{name}" if name[0].isdigit() else name


def check_names(vehicle: Vehicle) -> None:
    """Check that no two cameras have the same name in ROS; raises UserError."""
    taken: dict[str, str] = {}
    for camera in vehicle.cameras:
        other = taken.setdefault(ros_name(camera), camera)
        if other != camera:
            raise UserError("cameras", camera, None, f"has the same name in ROS as {other}: rename one of them")


def input_topics(vehicle: Vehicle) -> dict[str, OperatorInput]:
    topics = {"~/total_kbps": _number("total_set", "kbps")}
    for name, camera in vehicle.cameras.items():
        below = f"~/camera/{ros_name(name)}"
        for key in ("kbps", "scaling"):
            topics[f"{below}/{key}"] = _number("camera_configured", key, camera=name)
        topics[f"{below}/roi"] = OperatorInput("region", _region(camera))
    return topics


def input_services(vehicle: Vehicle) -> dict[str, OperatorInput]:
    services = {f"~/mode/{mode}": OperatorInput("trigger", _mode(mode)) for mode in Mode}
    for name in vehicle.cameras:
        services[f"~/camera/{ros_name(name)}/switch"] = OperatorInput("switch", _switch(name))
    return services


def _mode(mode: Mode) -> Callable[[InputValues], dict[str, Any]]:
    return lambda _: {"event": "mode_selected", "mode": mode.value}


def _switch(camera: str) -> Callable[[InputValues], dict[str, Any]]:
    return lambda values: {"event": "camera_switched", "camera": camera, "on": values["value"]}


def _number(name: str, key: str, **more: str) -> OperatorInput:
    def event(values: InputValues) -> dict[str, Any]:
        if not math.isfinite(values["number"]):
            raise ValueError(f"{values['number']}: must be a number")
        return {"event": name, **more, key: values["number"]}

    return OperatorInput("number", event)


def _region(camera: Camera) -> Callable[[InputValues], dict[str, Any]]:
    def event(values: InputValues) -> dict[str, Any]:
        """All zeros mean the whole picture, as in sensor_msgs/RegionOfInterest."""
        region = {key: values[key] for key in ("x", "y", "width", "height")}
        if not any(region.values()):
            region = camera.full_roi.to_json()
        return {"event": "roi_set", "camera": camera.name, **region}

    return event
