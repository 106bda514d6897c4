"""Topics whose messages are passed on unchanged."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from .port import Port

MAX_TEXT = 20_000  # characters, which JSON may write as six bytes each

# By kind of input, package and name of its type. Every message of EACH is passed on, of NEWEST only the newest.
REGION = ("sensor_msgs", "RegionOfInterest")
EACH = {"text": ("std_msgs", "String"), "number": ("std_msgs", "Float64"), "region": REGION}
NEWEST = {
    "fix": ("sensor_msgs", "NavSatFix"),
    "newest_number": ("std_msgs", "Float64"),
    "sign": ("std_msgs", "Empty"),
    "seen": ("sensor_msgs", "CameraInfo"),
}
TYPES = {**EACH, **NEWEST}
SERVICES = {"trigger": ("std_srvs", "Trigger"), "switch": ("std_srvs", "SetBool")}  # by kind of their calls


class InputTopic:
    """A topic that is subscribed to while the node runs.

    kind  of its messages, see TYPES
    """

    def __init__(self, port: Port, name: str, kind: str) -> None:
        self._port, self.name, self.kind = port, name, kind
        self._unexpected: list[str] = []

    def publishing_nodes(self, message: Any) -> list[str]:
        """Names of all nodes that publish the topic when a message arrives; empty while one is unknown."""
        raise NotImplementedError

    def check_types(self, found: Iterable[str], expected: str) -> None:
        """Report unexpected types of publishers, once each time they change."""
        unexpected = sorted(set(found) - {expected})
        if unexpected and unexpected != self._unexpected:
            self._port.report(f"has messages of type {', '.join(unexpected)}, must be {expected}", self.name)
        self._unexpected = unexpected

    def on_message(self, message: Any) -> None:
        match self.kind:
            case "fix":
                self._pass_on(lat=message.latitude, lon=message.longitude, fixed=message.status.status >= 0)
            case "newest_number":
                self._pass_on(number=message.data, nodes=self.publishing_nodes(message))
            case "number":
                self._pass_on(number=message.data)
            case "region":
                self._pass_on(**_region(message))
            case "seen":
                self._pass_on(**_region(message.roi), screen_width=message.width, screen_height=message.height)
            case "sign":
                self._pass_on()
            case _ if len(message.data) <= MAX_TEXT:
                self._pass_on(text=message.data)
            case _:
                self._port.report(f"dropped a text longer than {MAX_TEXT} characters", self.name)

    def _pass_on(self, **values: Any) -> None:
        self._port.send(self.kind, topic=self.name, **values)


def _region(message: Any) -> dict[str, int]:
    """Of sensor_msgs/RegionOfInterest."""
    return {"x": message.x_offset, "y": message.y_offset, "width": message.width, "height": message.height}
