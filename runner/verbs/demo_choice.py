"""Which cameras of a vehicle `demo` shows, and how often: what this machine can draw. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate, groupby
from math import ceil, remainder
from typing import NamedTuple

from runner.core.model import Camera

# Processor time of both sides and of a browser that draws without a GPU, in its Drive view: bench/demo.py.
SIDES_S_PER_MPX = 0.010  # to decode, scale, encode and receive a megapixel of a camera's full image
DRAWN_S = 0.013  # to decode and draw a picture
USABLE = 0.75  # of all cores: pictures do not come evenly
SMOOTH_HZ = 15  # fewer pictures a second look like slides
TOP_VIEW_DEG = 25  # a camera tipped down by this much shows the ground, not the way ahead


class Choice(NamedTuple):
    """cameras: by name, in the order of their importance; fps_max: Hz, None: the cameras' own rates"""

    cameras: tuple[str, ...]
    fps_max: int | None

    @property
    def rate(self) -> str:
        return f" at {self.fps_max} Hz" if self.fps_max else ""

    @property
    def is_smooth(self) -> bool:
        return self.fps_max is None or self.fps_max >= SMOOTH_HZ


def showable(cameras: Sequence[Camera], cores: int) -> Choice:
    """The most cameras that these cores show smoothly, at the highest rate; at least the most important ones."""
    groups = groupby(sorted(cameras, key=_importance), _importance)
    choices = [highest_rate(some, cores) for some in accumulate(tuple(group) for _, group in groups)]
    return next((choice for choice in reversed(choices) if choice.is_smooth), choices[0])


def highest_rate(cameras: Sequence[Camera], cores: int) -> Choice:
    """The highest rate in whole Hz at which these cores show all of these cameras; at least 1."""
    own = ceil(max(camera.fps for camera in cameras))
    fitting = (hz for hz in range(own, 0, -1) if _load(cameras, hz) <= USABLE * cores)
    hz = next(fitting, 1)
    return Choice(tuple(camera.name for camera in cameras), None if hz == own else hz)


def _load(cameras: Sequence[Camera], fps_max: int) -> float:
    """Cores that cameras take at a rate."""
    return sum(
        min(float(camera.fps), fps_max) * (DRAWN_S + SIDES_S_PER_MPX * camera.width * camera.height / 1e6)
        for camera in cameras
    )


def _importance(camera: Camera) -> tuple[int, float]:
    """Ascending: from straight ahead to behind, then all top views, then cameras whose pose is unknown.

    Equal ones are shown together: both sides, all cameras of the bird's-eye view.
    """
    if camera.pose is None:
        return 2, 0.0
    if camera.pose.pitch_deg >= TOP_VIEW_DEG:
        return 1, 0.0
    return 0, abs(remainder(camera.pose.yaw_deg, 360))
