"""Pictures as a screen shows them, at its own pixels: what a driver sees of what was sent."""

from __future__ import annotations

import numpy as np

from runner.core.model import Roi
from runner.core.view import Seen
from runner.rate_quality.metrics.interface import Luma

REDUCED = 1.0  # px of a picture for each px of the screen, above which the average of several is shown


def on_screen(luma: Luma, region: Roi, seen: Seen) -> Luma:
    """What a view shows of a picture; black where nothing was sent.

    luma    the picture, which may have any size
    region  of the full image that it shows
    seen    of the full image, and px of the screen

    Enlarged pictures are drawn linearly, as Chromium's canvas draws the frames of a video whatever it is told.
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
    border = cv2.BORDER_REPLICATE if whole else cv2.BORDER_CONSTANT
    shown: Luma = cv2.warpAffine(luma, matrix, size, flags=flags, borderMode=border)  # type: ignore[assignment]
    return shown


def _reduced(luma: Luma, region: Roi, step_x: float, step_y: float) -> tuple[Luma, float, float, float, float]:
    """The picture with one px for each of the screen; and what belongs to it."""
    import cv2

    height, width = luma.shape
    size = (max(1, round(width / max(1.0, step_x))), max(1, round(height / max(1.0, step_y))))
    reduced: Luma = cv2.resize(luma, size, interpolation=cv2.INTER_AREA)  # type: ignore[assignment]
    across, down = size[0] / region.width, size[1] / region.height
    return reduced, step_x * size[0] / width, step_y * size[1] / height, across, down
