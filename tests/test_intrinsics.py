"""Intrinsics of delivered pictures: where known points land."""

from __future__ import annotations

from dataclasses import replace
from math import atan, hypot

import pytest

from runner.configuration.config import configuration
from runner.core.intrinsics import delivered_intrinsics, focal_px
from runner.core.model import Roi

# Native 1280x960, of which 1280x720 from row 120 on is the full image.
FRONT = replace(configuration(["vehicle=delivery_robot"]).vehicle().cameras["front"], fov_deg=90.0)
POINTS = [(0.0, 0.0, 1.0), (0.5, -0.25, 1.0), (-2.0, 1.0, 4.0), (0.1, 0.3, 1.0)]


def pixel_of(point, lens, focal):
    """By hand, in the native picture, from its corner."""
    x, y, z = point
    radius = hypot(x, y) / z
    stretch = 1.0 if lens == "pinhole" or not radius else atan(radius) / radius
    return 640 + focal * stretch * x / z, 480 + focal * stretch * y / z


def projected(lens, point):
    """By camera_info, in the delivered picture."""
    x, y, z = point
    radius = hypot(x, y) / z
    stretch = 1.0 if lens.model == "plumb_bob" or not radius else atan(radius) / radius
    return lens.fx * stretch * x / z + lens.cx, lens.fy * stretch * y / z + lens.cy


@pytest.mark.parametrize(
    ("roi", "width", "height"),
    [
        (Roi(0, 0, 1280, 720), 1280, 720),
        (Roi(0, 0, 1280, 720), 640, 360),
        (Roi(320, 180, 640, 360), 640, 360),
        (Roi(101, 57, 333, 211), 84, 52),
        (Roi(640, 0, 640, 720), 160, 180),
    ],
)
@pytest.mark.parametrize(("lens", "focal"), [("pinhole", 640.0), ("fisheye", 814.873)])
def test_a_known_point_is_projected_correctly(lens, focal, roi, width, height):
    known = delivered_intrinsics(replace(FRONT, lens=lens), roi, width, height)
    assert known.model == {"pinhole": "plumb_bob", "fisheye": "equidistant"}[lens]
    for point in POINTS:
        u, v = pixel_of(point, lens, focal)
        u, v = (u - roi.x) * width / roi.width - 0.5, (v - 120 - roi.y) * height / roi.height - 0.5
        assert projected(known, point) == pytest.approx((u, v), abs=0.01)


def test_values_of_the_whole_picture():
    model, *values = delivered_intrinsics(FRONT, FRONT.full_roi, 1280, 720)
    assert model == "plumb_bob"
    assert values == pytest.approx([640, 640, 639.5, 359.5])


def test_a_pinhole_of_180_degrees_has_none():
    assert delivered_intrinsics(replace(FRONT, fov_deg=180.0), FRONT.full_roi, 1280, 720) is None
    assert delivered_intrinsics(replace(FRONT, fov_deg=190.0, lens="fisheye"), FRONT.full_roi, 1280, 720)


def test_focal_lengths():
    assert focal_px("pinhole", 90, 640) == pytest.approx(320)
    assert focal_px("fisheye", 180, 314) == pytest.approx(100, abs=0.1)
