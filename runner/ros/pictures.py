"""Decoded pictures of the operator's side as topics of ROS, with the intrinsics of what was delivered."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from runner.core.intrinsics import Intrinsics, delivered_intrinsics
from runner.core.model import Camera, Roi, Vehicle
from runner.records import CameraState
from runner.ros.inputs import ros_name
from runner.ros.process import NodeProcess, check_discovery


class DecodedPictures:
    """A node that publishes pictures, from `start` until `close`.

    on_report  called with one line on what is wrong, from any thread
    raises     UserError
    """

    def __init__(self, vehicle: Vehicle, on_report: Callable[[str], None]) -> None:
        check_discovery(vehicle.ros, vehicle.insecure)
        settings = replace(vehicle.ros, node=f"{vehicle.ros.node}_operator")
        self._cameras = vehicle.cameras
        self._node = NodeProcess(
            settings, lambda *_: None, lambda _, what: on_report(what), publishes=True, insecure=vehicle.insecure
        )

    def start(self) -> None:
        """raises RunError if the node does not start"""
        self._node.start()

    def close(self) -> None:
        self._node.close()

    def put(
        self, name: str, captured: float | None, width: int, height: int, data: bytes, state: CameraState | None
    ) -> None:
        """Publish a picture.

        captured  s since 1970 by the vehicle's clock, its stamp; None: unknown, which is a stamp of 0
        data      rows of RGB, of any length
        state     the camera's, as the vehicle published it last
        """
        lens = intrinsics_of(self._cameras[name], state, width, height)
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


def intrinsics_of(camera: Camera, state: CameraState | None, width: int, height: int) -> Intrinsics | None:
    """Of a picture of that size; None while it is not of the size and region that the vehicle states as applied."""
    applied = state.applied if state else {}
    if applied.get("size") != {"width": width, "height": height} or "roi" not in applied:
        return None
    return delivered_intrinsics(camera, Roi(**applied["roi"]), width, height)
