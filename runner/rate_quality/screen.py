"""Pictures as a screen shows them, at its own pixels: what a driver sees of what was sent."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import numpy as np

from runner.core.model import Roi
from runner.core.view import Seen
from runner.rate_quality.metrics.interface import Luma

if TYPE_CHECKING:
    from numpy.typing import NDArray

Kernel = Literal["linear", "cubic"]
REDUCED = 1.0  # px of a picture for each px of the screen, above which the average of several is shown


def on_screen(luma: Luma, region: Roi, seen: Seen, kernel: Kernel = "linear") -> Luma:
    """What a view shows of a picture; black where nothing was sent.

    luma    the picture, which may have any size
    region  of the full image that it shows
    seen    of the full image, and px of the screen
    kernel  of pictures that are enlarged. The page's is linear, as Chromium's canvas draws the frames of a video
            whatever it is told, and with a GPU Catmull and Rom's cubic one (`enlarger.js`)
    """
    import cv2

    height, width = luma.shape
    across, down = width / region.width, height / region.height  # px of the picture for each of the full image
    step_x, step_y = seen.width * across / seen.screen_width, seen.height * down / seen.screen_height
    if max(step_x, step_y) > REDUCED:
        luma, step_x, step_y, across, down = _reduced(luma, region, step_x, step_y)
    # From px of the screen to those of the picture, both counted at their centres.
    left, top = (seen.x - region.x) * across, (seen.y - region.y) * down
    matrix = np.array([[step_x, 0, left + step_x / 2 - 0.5], [0, step_y, top + step_y / 2 - 0.5]])
    size, flags = (seen.screen_width, seen.screen_height), cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    whole = seen.x >= region.x and seen.y >= region.y
    whole = (
        whole and seen.x + seen.width <= region.x + region.width and seen.y + seen.height <= region.y + region.height
    )
    if kernel == "cubic" and max(step_x, step_y) < 1:
        return _cubic(luma, matrix, size)
    border = cv2.BORDER_REPLICATE if whole else cv2.BORDER_CONSTANT
    shown: Luma = cv2.warpAffine(luma, matrix, size, flags=flags, borderMode=border)  # type: ignore[assignment]
    return shown


def _cubic(luma: Luma, matrix: NDArray[np.float64], size: tuple[int, int]) -> Luma:
    """The px of a screen at places of the picture, which repeats its rim, but black beyond it.

    matrix  from px of the screen to those of the picture
    """
    across, down = (
        _weights(matrix[axis, axis] * np.arange(length) + matrix[axis, 2], luma.shape[1 - axis])
        for axis, length in enumerate(size)
    )
    shown: Luma = np.rint(down @ luma @ across.T).clip(0, 255).astype(np.uint8)
    return shown


def _weights(places: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """Of `count` px at each place, by Keys's kernel with a = -1/2 (IEEE Transactions on ASSP 29.6, 1981)."""
    weights = np.zeros((len(places), count))
    for px in (np.floor(places).astype(int) + tap for tap in range(-1, 3)):
        off = np.abs(places - px)
        near, far = (1.5 * off - 2.5) * off**2 + 1, ((2.5 - 0.5 * off) * off - 4) * off + 2
        np.add.at(weights, (np.arange(len(places)), px.clip(0, count - 1)), np.where(off <= 1, near, far))
    weights[(places < -0.5) | (places > count - 0.5)] = 0
    return weights


def _reduced(luma: Luma, region: Roi, step_x: float, step_y: float) -> tuple[Luma, float, float, float, float]:
    """The picture with one px for each of the screen; and what belongs to it."""
    import cv2

    height, width = luma.shape
    size = (max(1, round(width / max(1.0, step_x))), max(1, round(height / max(1.0, step_y))))
    reduced: Luma = cv2.resize(luma, size, interpolation=cv2.INTER_AREA)  # type: ignore[assignment]
    across, down = size[0] / region.width, size[1] / region.height
    return reduced, step_x * size[0] / width, step_y * size[1] / height, across, down
