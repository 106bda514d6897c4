"""Decoded pictures of the operator's side as ROS topics, with the intrinsics of the delivered pictures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from runner.core.intrinsics import Intrinsics, delivered_intrinsics
from runner.core.model import Camera, Roi
from runner.records.vehicle import CameraState
from runner.ros.inputs import check_names, ros_name
from runner.ros.process import NodeProcess, check_discovery
from runner.settings import Setup


class DecodedPictures:
    """A node that publishes pictures, from `start` until `close`.

    on_report  called with one line on what is wrong, from any thread
    raises     UserError
    """

    def __init__(self, setup: Setup, on_report: Callable[[str], None]) -> None:
        check_discovery(setup.ros, setup.insecure)
        check_names(setup.vehicle)
        settings = replace(setup.ros, node=f"{setup.ros.node}_operator")
        self._cameras = setup.vehicle.cameras
        self._node = NodeProcess(
            settings, lambda *_: None, lambda _, what: on_report(what), publishes=True, insecure=setup.insecure
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
