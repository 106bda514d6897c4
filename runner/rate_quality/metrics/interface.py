"""What a metric of picture quality is, and the meter that scores the pictures of a lane."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from runner.errors import UserError

Luma = NDArray[np.uint8]  # height x width
Mask = NDArray[np.bool_]  # height x width, True where it counts
PictureSize = tuple[int, int]  # width, height in px


class QualityMeter(Protocol):
    """Scores the pictures of one lane, given in order of frames, from one thread."""

    def add(self, frame: int, reference: Luma, picture: Luma) -> None:
        """Take one picture and what it should look like, both of the meter's size; nothing is kept of them.

        raises  ValueError where shape or type differ, RunError where a tool fails
        """

    def close(self) -> dict[int, float]:
        """The score of each frame; ends the meter and frees what it holds. Further calls return the same.

        returns  score by frame; after a failed `add` nothing
        raises   RunError where a tool fails, once
        """


@dataclass(frozen=True)
class Metric:
    """A measure of picture quality; can be pickled.

    name         psnr, mssim, vmaf or brisque
    label        for an axis of a chart
    identity     everything that changes a score (definition, model, library version): part of cache keys
    bounds       lowest and highest score there is
    tolerance    a loss below it is not worth a scaling factor
    good         quality that b_full is chosen for by default
    build        makes a meter from size, frame rate, stride and mask; call `meter`
    every_frame  its meters must see every frame; else those that are to be scored
    """

    name: str
    label: str
    identity: str
    bounds: tuple[float, float]
    tolerance: float
    good: float
    build: Callable[[PictureSize, Fraction, int, Mask | None], QualityMeter] = field(repr=False, compare=False)
    smallest_px: int = 1
    higher_is_better: bool = True
    every_frame: bool = False
    takes_mask: bool = True

    def meter(self, size: PictureSize, fps: Fraction, stride: int = 1, mask: Mask | None = None) -> QualityMeter:
        """A meter for one lane.

        size    width and height in px of every picture
        fps     frames per second of the lane
        stride  of a metric that sees every frame: score each stride-th, from the first on; the others score all given
        mask    which pixels count (of windows: their centres); None for all
        raises  UserError for pictures that are too small, a mask that the metric cannot use, a mask without a pixel
        """
        width, height = size
        if min(size) < self.smallest_px:
            rule = f"{self.name} needs at least {self.smallest_px}x{self.smallest_px} px"
            raise UserError("", "size", f"{width}x{height}", rule)
        if mask is not None:
            if not self.takes_mask:
                raise UserError("", "mask", self.name, "this metric takes no mask; psnr and mssim do")
            if mask.shape != (height, width) or mask.dtype != np.bool_:
                raise ValueError(f"mask of {mask.dtype} {mask.shape}, must be bool {(height, width)}")
        return self.build(size, fps, stride, mask)


class FrameMeter:
    """Meter of a metric that scores each picture by itself.

    score  of reference and picture
    """

    def __init__(self, size: PictureSize, score: Callable[[Luma, Luma], float]) -> None:
        self._size, self._score = size, score
        self._scores: dict[int, float] = {}

    def add(self, frame: int, reference: Luma, picture: Luma) -> None:
        check(self._size, reference, picture)
        self._scores[frame] = self._score(reference, picture)

    def close(self) -> dict[int, float]:
        return self._scores


def check(size: PictureSize, *pictures: Luma) -> None:
    """Refuse what compiled code would read beyond its end. Raises ValueError."""
    for picture in pictures:
        if picture.shape != size[::-1] or picture.dtype != np.uint8:
            raise ValueError(f"picture of {picture.dtype} {picture.shape}, must be uint8 {size[::-1]}")


def no_pixels(what: str) -> UserError:
    """A mask that leaves nothing to score."""
    return UserError("", "mask", None, f"{what} counts")
