"""Peak signal-to-noise ratio of luma."""

from __future__ import annotations

import math
from fractions import Fraction

import cv2
import numpy as np
from numpy.typing import NDArray

from runner.rate_quality.metrics.interface import FrameMeter, Luma, Mask, Metric, PictureSize, no_pixels

HIGHEST_DB = 100.0  # also for equal pictures, whose ratio is infinite


def metric() -> Metric:
    return Metric(
        name="psnr",
        label="PSNR in dB",
        identity=f"psnr of luma, 10 log10(255^2 / MSE), at most {HIGHEST_DB:g} dB",
        bounds=(0.0, HIGHEST_DB),
        tolerance=0.05,
        good=38.0,
        build=meter,
    )


def meter(size: PictureSize, fps: Fraction, stride: int, mask: Mask | None) -> FrameMeter:
    """Meter of one lane. Raises UserError for a mask without a pixel."""
    pixels = size[0] * size[1] if mask is None else int(np.count_nonzero(mask))
    if not pixels:
        raise no_pixels("no pixel")
    counting = None if mask is None else mask.astype(np.uint8)
    return FrameMeter(size, lambda reference, picture: psnr(reference, picture, counting, pixels))


def psnr(reference: Luma, picture: Luma, mask: NDArray[np.uint8] | None, pixels: int) -> float:
    """10 log10(255^2 / MSE) in dB, at most `HIGHEST_DB`.

    mask    nonzero where a pixel counts; None: everywhere
    pixels  how many count
    """
    squares = cv2.norm(reference, picture, cv2.NORM_L2SQR, mask)
    return min(HIGHEST_DB, 10 * math.log10(255**2 * pixels / squares)) if squares else HIGHEST_DB
