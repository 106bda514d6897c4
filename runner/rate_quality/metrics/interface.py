"""The interface of picture quality metrics, and of meters that score the pictures of a lane."""

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
    """Scores the pictures of one lane, given in frame order, from one thread."""

    def add(self, frame: int, reference: Luma, picture: Luma) -> None:
        """Score one picture against its reference, both of the meter's size; neither is kept.

        raises  ValueError if shape or type differ, RunError if a tool fails
        """

    def close(self) -> dict[int, float]:
        """The score of each frame; ends the meter and frees its resources. Further calls return the same.

        returns  score by frame; empty after a failed `add`
        raises   RunError if a tool fails, once
        """


@dataclass(frozen=True)
class Metric:
    """A measure of picture quality; can be pickled.

    name         psnr, mssim, vmaf or brisque
    label        for an axis of a chart
    identity     everything that changes a score (definition, model, library version): part of cache keys
    bounds       lowest and highest possible score
    tolerance    a loss below it is not worth a scaling factor
    good         quality for which b_full is chosen by default
    build        makes a meter from size, frame rate, stride and mask; call `meter`
    every_frame  whether its meters must see every frame, not only those to be scored
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
        stride  for a metric that sees every frame: score every stride-th, from the first on; others score all
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
    """Refuse pictures that compiled code would read beyond their end. Raises ValueError."""
    for picture in pictures:
        if picture.shape != size[::-1] or picture.dtype != np.uint8:
            raise ValueError(f"picture of {picture.dtype} {picture.shape}, must be uint8 {size[::-1]}")


def no_pixels(what: str) -> UserError:
    """A mask that leaves nothing to score."""
    return UserError("", "mask", None, f"{what} counts")
