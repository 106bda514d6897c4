"""What an operator sees of a camera's image. Pure."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from fractions import Fraction
from math import ceil
from typing import Annotated

from runner.core.limits import Limits
from runner.core.model import Camera, Roi

MAX_PX = 65535
Px = Annotated[int, Limits(0, MAX_PX)]


@dataclass(frozen=True, slots=True)
class Seen:
    """Part of a camera's full image, and how large screens show it.

    x, y                         its left and upper edge, px of the full image
    width, height                its size, px of the full image; 0: nothing is shown
    screen_width, screen_height  px of the screen that it covers
    """

    x: Px
    y: Px
    width: Px
    height: Px
    screen_width: Px
    screen_height: Px

    @property
    def is_empty(self) -> bool:
        return not (self.width and self.height)

    @property
    def roi(self) -> Roi:
        return Roi(self.x, self.y, self.width, self.height)

    @property
    def scale(self) -> Fraction:
        """px of the screen for each px of the full image, in the direction that shows more; 0 if nothing is shown."""
        if self.is_empty:
            return Fraction(0)
        return max(Fraction(self.screen_width, self.width), Fraction(self.screen_height, self.height))

    def lies_in(self, camera: Camera) -> bool:
        """Whether the camera's full image has this part."""
        return self.x + self.width <= camera.width and self.y + self.height <= camera.height

    def problem(self, camera: Camera) -> str | None:
        """What a camera's image cannot show of it; None: nothing."""
        for key in KEYS:
            if type(length := getattr(self, key)) is not int or not 0 <= length <= MAX_PX:
                return f"{key}: must be an integer from 0 to {MAX_PX}"
        if not self.lies_in(camera):
            return f"must lie inside the image of {camera.width}x{camera.height} px"
        lengths = (self.width, self.height, self.screen_width, self.screen_height)
        if len({length > 0 for length in lengths}) > 1:
            return "width, height and both sides on the screen: all or none must be 0"
        return None


KEYS = tuple(field.name for field in fields(Seen))
View = Mapping[str, Seen]  # by camera; those not named are seen in full, as large as they are
NOWHERE = Seen(0, 0, 0, 0, 0, 0)


def united(one: Seen, other: Seen) -> Seen:
    """What two windows show together: the smallest region with both, as large as either shows its own."""
    if one.is_empty or other.is_empty:
        return other if one.is_empty else one
    both, scale = enclosing(one.roi, other.roi), max(one.scale, other.scale)
    screen = (min(MAX_PX, ceil(length * scale)) for length in (both.width, both.height))  # one may be magnified
    return Seen(both.x, both.y, both.width, both.height, *screen)


def together(views: Iterable[View]) -> View:
    """What several show; without any: everything in full."""
    shown: dict[str, Seen] | None = None
    for view in views:
        if shown is None:
            shown = dict(view)
        else:
            shown = {name: united(seen, view[name]) for name, seen in shown.items() if name in view}
    return shown or {}


def enclosing(one: Roi, other: Roi) -> Roi:
    """The smallest region with both."""
    x, y = min(one.x, other.x), min(one.y, other.y)
    right, bottom = (
        max(one.x + one.width, other.x + other.width),
        max(one.y + one.height, other.y + other.height),
    )
    return Roi(x, y, right - x, bottom - y)
