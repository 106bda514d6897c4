"""Intrinsics of the pictures on the operator's side, after crop, region of interest and scaling."""

from __future__ import annotations

import math
from typing import NamedTuple

from runner.core.model import Camera, Roi

PINHOLE_DEG = 180.0  # upper bound of a pinhole's field of view


class Intrinsics(NamedTuple):
    """Projection of a point in the camera's axes (x right, y down, z forward) into a picture, px.

    plumb_bob    u = fx * x / z + cx, v = fy * y / z + cy
    equidistant  the same with x / z and y / z times theta / tan(theta), where theta is the angle to the optical axis

    Without distortion. Pixels are counted as ROS and OpenCV do: (0, 0) is the centre of the first one.
    """

    model: str
    fx: float
    fy: float
    cx: float
    cy: float


def focal_px(lens: str, fov_deg: float, width: int) -> float:
    """Focal length: px per unit of tangent (pinhole) or per radian (equidistant fisheye).

    fov_deg  horizontal field of view of a picture of that width
    """
    half = math.radians(fov_deg / 2)
    return width / 2 / (half if lens == "fisheye" else math.tan(half))


def delivered_intrinsics(camera: Camera, roi: Roi, width: int, height: int) -> Intrinsics | None:
    """Intrinsics of a delivered picture, assuming its camera's configured lens and field of view.

    roi            cut out of the full image
    width, height  of the picture, px
    returns        None for a pinhole of 180 degrees and more

    With the offset x0 of crop and region, and the scale s = width / roi.width:

        fx' = s fx,  cx' = s (W / 2 - x0) - 1 / 2

    since edges of pixels scale, not their centres; the same for y.
    """
    if camera.lens != "fisheye" and camera.fov_deg >= PINHOLE_DEG:
        return None
    native_width, native_height = camera.source_size
    across, down = width / roi.width, height / roi.height
    focal = focal_px(camera.lens, camera.fov_deg, native_width)
    return Intrinsics(
        "equidistant" if camera.lens == "fisheye" else "plumb_bob",
        focal * across,
        focal * down,
        (native_width / 2 - camera.in_source.x - roi.x) * across - 0.5,
        (native_height / 2 - camera.in_source.y - roi.y) * down - 0.5,
    )
