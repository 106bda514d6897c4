"""Marks painted into the ground of the synthetic drive, and found in pictures by image processing.

A mark is a corner where two white and two black fields meet. For lines on the ground there is one at each end of those
that the page draws across it, 5, 10 and 15 m from both ends of the vehicle, and some on the wheels' paths at a steering
angle; for the bird's-eye view they are around it.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from fractions import Fraction
from itertools import product
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

from runner.clips import View
from runner.core.mounting import Pose
from runner.settings import Dimensions

SECONDS = 4.0
FPS = Fraction(5)
SIZE = (1280, 720)
CAR = Dimensions(wheelbase_m=2.9, track_m=1.65, width_m=1.92, front_m=3.65, rear_m=0.95)
DISTANCES_M = (5, 10, 15)
WITHIN_PX = 2  # of the full image
AROUND_PX = 40  # maximum search distance of a mark from the end of its line
FINER = 4  # rays each way through a pixel of the bird's-eye view's cameras, as the light that a sensor collects
End = tuple[int, int, int]  # 1 ahead or -1 behind, distance in m, side: 0 left or -1 right


@dataclass(frozen=True)
class Mark:
    """Where a mark is, in the vehicle's axes, how far its fields reach each way, m, and how far it is turned, rad."""

    x: float
    y: float
    along: float = 2.0
    aside: float = 0.5
    turned: float = 0.0


@dataclass(frozen=True)
class Mounted:
    """A camera and the ends of lines that must be visible in it.

    top   where the full image begins in the native one, px
    roi   x, y, width, height in the full image; None: all of it
    """

    pose: Pose
    ends: tuple[End, ...]
    fov_deg: float = 90
    lens: str = "pinhole"
    native: tuple[int, int] = SIZE
    top: int = 0
    factor: float = 1.0
    roi: tuple[int, int, int, int] | None = None

    @property
    def view(self) -> View:
        return View(*self.native, FPS, self.pose, self.fov_deg, self.lens)

    @property
    def optics(self) -> dict[str, Any]:
        """The camera as sent to the page."""
        native = {"width": self.native[0], "height": self.native[1], "left": 0, "top": self.top}
        return {"pose": asdict(self.pose), "fov_deg": self.fov_deg, "lens": self.lens, "native": native}


AHEAD, BEHIND = ([(sign, far, side) for far, side in product(DISTANCES_M, (0, -1))] for sign in (1, -1))
CAMERAS = {
    "scaled": Mounted(Pose(2.0, 0.0, 1.5, 0, 5), tuple(AHEAD), factor=0.5),
    "cropped": Mounted(
        Pose(1.9, 0.5, 1.5, 40, 6, 2), ((1, 5, 0), (1, 10, 0), (1, 15, 0)), 100, native=(1280, 960), top=130
    ),
    "mirrored": Mounted(Pose(-0.9, 0.0, 1.4, 180, 8), tuple(BEHIND), roi=(240, 60, 880, 495)),
    "fisheye": Mounted(Pose(3.7, 0.0, 1.2, 0, 25), tuple(AHEAD), 130, "fisheye"),
}


def _line_end(sign: int, far: int, side: int) -> Mark:
    ahead = CAR.front_m + far if sign > 0 else -CAR.rear_m - far
    return Mark(ahead, CAR.width_m / 2 * (1 + 2 * side))


LINE_ENDS = tuple(_line_end(*end) for end in (*AHEAD, *BEHIND))

STEERED_RAD = 0.1
# Points of the front wheels' paths at that angle, none of which is on a line's end: how many points from the end of the
# path that the page draws, side as above, and how far the centre of the rear axle has travelled by then, m.
STEERED = ((0, 0, 15.75), (0, -1, 15.75), (8, 0, 0.75 + 15 * (40 / 48) ** 2), (8, -1, 0.75 + 15 * (40 / 48) ** 2))


def _wheel(side: int, travelled: float) -> Mark:
    """Where a front wheel is then: all points of a vehicle turn about one on the line of its rear axle."""
    radius = CAR.wheelbase_m / math.tan(STEERED_RAD)
    wheel = complex(CAR.wheelbase_m, CAR.track_m / 2 * (1 + 2 * side))
    centre = complex(0, radius)
    place = centre + (wheel - centre) * cmath.exp(1j * travelled / radius)
    at_camera = CAMERAS["scaled"].pose.x_m
    return Mark(place.real, place.imag, turned=cmath.phase(place - at_camera))  # upright in its picture


WHEELS = tuple(_wheel(side, travelled) for _, side, travelled in STEERED)

# As tum_q7's, with pictures as they are delivered: scaled, cut from a larger native one, a region of it.
TOP_SIZE = (1280, 800)
TOP_CAMERAS = {
    "top_front": Mounted(Pose(3.7, 0.0, 0.8, 0, 35), (), 180, "fisheye", TOP_SIZE, factor=0.5),
    "top_left": Mounted(Pose(1.8, 1.0, 1.1, 90, 35), (), 180, "fisheye", TOP_SIZE, roi=(40, 80, 1200, 720)),
    "top_right": Mounted(Pose(1.8, -1.0, 1.1, -90, 35), (), 180, "fisheye", TOP_SIZE),
    "top_rear": Mounted(Pose(-1.0, 0.0, 0.9, 180, 35), (), 180, "fisheye", (1280, 960), top=120),
}
AWAY_M = ((2, 0.6, 0.6), (4, 0.9, 0.7), (6, 1.4, 0.7), (8, 1.6, 0.7))  # from the vehicle, and half of a mark's sides


def _all_around() -> Iterator[Mark]:
    """In front, behind, to the left and right, and off the corners."""
    for (far, long, wide), lane in zip(AWAY_M, (-2.5, -0.8, 0.9, 2.6), strict=True):
        yield Mark(CAR.front_m + far, lane, long, wide)
        yield Mark(-CAR.rear_m - far, lane, long, wide)
        for side in (1, -1):
            yield Mark(CAR.front_m / 2 + lane, side * (CAR.width_m / 2 + far), wide, long)
    for far in (3.0, 5.6):
        for side in (1, -1):
            yield Mark(CAR.front_m + far, side * (CAR.width_m / 2 + far), 0.8, 0.8)
            yield Mark(-CAR.rear_m - far, side * (CAR.width_m / 2 + far), 0.8, 0.8)


ALL_AROUND = tuple(_all_around())


def paint(world: Path, marks: Sequence[Mark] = (*LINE_ENDS, *WHEELS)) -> None:
    """Build the street, with marks around the start of the drive."""
    from runner.synthetic.course import plan_course
    from runner.synthetic.world import GROUND, build_world, level_of, open_atlas, shrink

    build_world(SECONDS, world)
    course = plan_course(SECONDS)
    atlas = open_atlas(course, world, "r+")  # type: ignore[arg-type]
    luma, per_m = level_of(atlas, GROUND, 0)[0], float(atlas.per_m[GROUND])
    at_x, at_y, heading = course.at(0)
    cos, sin = math.cos(heading), math.sin(heading)
    for mark in marks:
        sides = (np.arange(-half, half, 0.004) for half in (mark.along, mark.aside))
        along, aside = np.meshgrid(*sides)  # m
        white = np.where((along < 0) == (aside < 0), 230, 25)
        place = complex(mark.x, mark.y) + (along + 1j * aside) * cmath.exp(1j * mark.turned)
        ahead, left = place.real, place.imag
        x, y = at_x + cos * ahead - sin * left, at_y + sin * ahead + cos * left
        rows, columns = (np.floor(per_m * each).astype(int) for each in (y, x))
        texels = rows % luma.shape[0] * luma.shape[1] + columns % luma.shape[1]
        which, samples = np.unique(texels, return_inverse=True)  # the edges lie within texels, which are 1 cm wide
        means = np.bincount(samples.ravel(), white.ravel()) / np.bincount(samples.ravel())
        luma[which // luma.shape[1], which % luma.shape[1]] = np.rint(means)
    shrink(atlas, GROUND)


def native_pictures(
    world: Path, cameras: Mapping[str, Mounted] = CAMERAS, finer: int = 1
) -> Iterator[tuple[str, bytes]]:
    """The first picture of each camera, I420 of the native size; without objects on the ground, and without blur.

    finer  rays each way through a pixel, which shows their mean
    """
    from runner.synthetic import picture

    def flat(course: Any) -> Any:
        faces = stand_faces(course)
        return replace(faces, height_m=np.zeros_like(faces.height_m), box=np.full_like(faces.box, -1))

    stand_faces = picture.stand_faces
    with patch.object(picture, "stand_faces", flat), patch.object(picture, "SOFT", 0.0):
        for name, camera in cameras.items():
            view = camera.view
            large = replace(view, width=finer * view.width, height=finer * view.height)
            yield name, _smaller(next(picture.pictures(large, SECONDS, world)), view.width, view.height, finer)


def _smaller(i420: bytes, width: int, height: int, times: int) -> bytes:
    """Downscale a picture: each pixel is the mean of `times` pixels each way."""
    planes, samples, begin = [], np.frombuffer(i420, np.uint8), 0
    for wide, high in ((width, height), (width // 2, height // 2), (width // 2, height // 2)):
        end = begin + wide * high * times**2
        blocks = samples[begin:end].reshape(high, times, wide, times)
        planes.append(np.rint(blocks.mean(axis=(1, 3))).astype(np.uint8).tobytes())
        begin = end
    return b"".join(planes)


def ends_of(lines: Sequence[Any], ends: Sequence[End]) -> dict[End, tuple[float, float]]:
    """The positions of those ends in a picture with these guides, see guides.js."""
    points = {}
    for sign, far, side in ends:
        line = [line for line in lines if line["metres"] == far][0 if sign > 0 else -1]
        point = line["pieces"][side][side]
        points[sign, far, side] = (point["x"], point["y"])
    return points


def found(picture: Any, near: tuple[float, float], others: Sequence[tuple[float, float]]) -> tuple[float, float]:
    """The strongest saddle point around a position: the centre of a mark, px. others: other marks"""
    import cv2

    around = round(min([AROUND_PX, *(0.6 * math.dist(near, other) for other in others)]))

    smooth = cv2.GaussianBlur(picture, (0, 0), 1.5)
    along = {order: cv2.Sobel(smooth, cv2.CV_64F, *order, ksize=5) for order in ((2, 0), (0, 2), (1, 1))}
    saddle = np.maximum(0, along[1, 1] ** 2 - along[2, 0] * along[0, 2])
    left, top = (max(0, round(each) - around) for each in near)
    part = saddle[top : top + 2 * around, left : left + 2 * around]
    row, column = np.unravel_index(part.argmax(), part.shape)
    rows, columns = np.mgrid[top + row - 2 : top + row + 3, left + column - 2 : left + column + 3]
    weights = saddle[rows, columns]
    return float((columns * weights).sum() / weights.sum() + 0.5), float((rows * weights).sum() / weights.sum() + 0.5)


def corner(picture: Any, near: tuple[float, float], half: tuple[float, float], around: float) -> tuple[float, float]:
    """The best match of a mark around a position, px.

    half    how far the part of a mark that is compared reaches to the right and up, px
    around  search radius, px

    Fields of equal shade lie opposite each other: the sum of one pair minus that of the other is largest in its middle,
    from where it falls as a straight line to each side.
    """
    import cv2

    wide, high = (max(2, round(each)) for each in half)
    sign = np.sign(np.arange(-high, high) + 0.5)[:, None] * np.sign(np.arange(-wide, wide) + 0.5)[None, :]
    left, top = (max(0, math.floor(each - around) - margin) for each, margin in zip(near, (wide, high), strict=True))
    right, bottom = (math.ceil(each + around) + margin for each, margin in zip(near, (wide, high), strict=True))
    part = picture[top:bottom, left:right].astype(np.float32)
    alike = np.abs(cv2.matchTemplate(part, sign.astype(np.float32), cv2.TM_CCORR))
    row, column = np.unravel_index(alike.argmax(), alike.shape)
    return left + wide + column + _apex(alike[row], column, wide), top + high + row + _apex(alike[:, column], row, high)


def _apex(values: Any, at: int, half: int) -> float:
    """Where the straight lines through the values at both sides of the largest one meet, counted from there."""
    reach = min(half // 2, at, len(values) - 1 - at)
    if reach < 2:
        return 0.0
    steps = np.arange(1, reach + 1)
    (rise, left), (fall, right) = (np.polyfit(sign * steps, values[at + sign * steps], 1) for sign in (-1, 1))
    return float((right - left) / (rise - fall))
