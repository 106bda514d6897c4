"""Decoded pictures of the operator's side as ROS topics, and what their subscribers show of them."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

from runner.core.intrinsics import Intrinsics, delivered_intrinsics
from runner.core.model import Camera, Roi
from runner.core.view import KEYS, NOWHERE, Seen, View
from runner.records.vehicle import CameraState
from runner.ros.inputs import check_names, ros_name
from runner.ros.process import NodeProcess, check_discovery
from runner.settings import Setup
from runner.system.reports import LimitedReports

SEEN_S = 2.0  # what a message says is shown holds for so long


class DecodedPictures:
    """A node that publishes pictures, from `start` until `close`.

    on_report  called with one line on what is wrong, from any thread
    on_seen    called with what subscribers state that they show, and for how long that holds, s, from another thread;
               cameras that are not named are shown in full
    raises     UserError
    """

    def __init__(self, setup: Setup, on_report: Callable[[str], None], on_seen: Callable[[View, float], None]) -> None:
        check_discovery(setup.ros, setup.insecure)
        check_names(setup.vehicle)
        settings = replace(setup.ros, node=f"{setup.ros.node}_operator")
        self._cameras, self._on_seen = setup.vehicle.cameras, on_seen
        self._report = LimitedReports(on_report)  # a display states what it shows many times a second
        self._topics = {f"~/camera/{ros_name(name)}/seen": name for name in self._cameras}
        self._shown: dict[str, tuple[Seen, float]] = {}  # by camera, and until when: time.monotonic
        self._node = NodeProcess(
            settings,
            self._on_message,
            lambda _, what: on_report(what),
            inputs=dict.fromkeys(self._topics, "seen"),
            publishes=True,
            insecure=setup.insecure,
        )

    def start(self) -> None:
        """raises RunError if the node does not start"""
        self._node.start()

    def close(self) -> None:
        self._node.close()

    def put(
        self,
        name: str,
        captured: float | None,
        width: int,
        height: int,
        data: bytes,
        state: CameraState | None,
        region: Roi | None = None,
    ) -> None:
        """Publish a picture.

        captured  the stamp, s since 1970 by the vehicle's clock; None: unknown, published as a stamp of 0
        data      rows of RGB, of any length
        state     the camera's state, as last published by the vehicle
        region    that the picture states; None: none
        """
        lens = intrinsics_of(self._cameras[name], state, width, height, region)
        self._node.publish_picture(
            f"~/camera/{ros_name(name)}",
            data,
            frame_id=f"{ros_name(name)}_optical_frame",
            stamp=0 if captured is None else round(captured * 1e9),
            encoding="rgb8",
            width=width,
            height=height,
            step=len(data) // height,
            intrinsics=lens._asdict() if lens else None,
        )

    def _on_message(self, message: Mapping[str, Any], memory: int) -> None:
        """What a camera's subscribers show."""
        camera = self._cameras[self._topics[message["topic"]]]
        shown, now = seen_of(message, camera), time.monotonic()
        if problem := shown.problem(camera):
            topic = message["topic"]
            self._report(f"{camera.name}: {topic}: {problem}; it counts as seen in full", topic)
            self._shown.pop(camera.name, None)
        else:
            self._shown[camera.name] = shown, now + SEEN_S
        self._shown = {name: (each, until) for name, (each, until) in self._shown.items() if now < until}
        view: View = {name: each for name, (each, _) in self._shown.items()}
        first = min((until for _, until in self._shown.values()), default=now)
        self._on_seen(view, first - now)


def seen_of(message: Mapping[str, Any], camera: Camera) -> Seen:
    """What a sensor_msgs/CameraInfo states: `roi` of the full image, all zeros for the whole, on width x height px."""
    x, y, width, height, *screen = (message[key] for key in KEYS)
    if not any(screen):
        return NOWHERE
    return Seen(x, y, width, height, *screen) if width or height else Seen(0, 0, camera.width, camera.height, *screen)


def intrinsics_of(
    camera: Camera, state: CameraState | None, width: int, height: int, region: Roi | None = None
) -> Intrinsics | None:
    """Intrinsics of a picture of this size.

    region   that the picture states; None: none
    returns  None while pictures that state none differ from the size and region that the vehicle applied
    """
    if state and state.placed:
        return delivered_intrinsics(camera, region or camera.full_roi, width, height)
    applied = state.applied if state else {}
    if applied.get("size") != {"width": width, "height": height} or "roi" not in applied:
        return None
    return delivered_intrinsics(camera, Roi(**applied["roi"]), width, height)
