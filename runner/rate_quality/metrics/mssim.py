"""Mean structural similarity of luma (Z. Wang et al., "Image quality assessment: from error visibility to structural
similarity", IEEE Trans. Image Processing 13(4), 2004).

    SSIM(x, y) = (2 mx my + C1)(2 sxy + C2) / ((mx^2 + my^2 + C1)(sx^2 + sy^2 + C2)),    C1 = (.01 L)^2, C2 = (.03 L)^2

with mean m, variance s^2 and covariance sxy under an 11x11 Gaussian window of sigma 1.5, L = 255, averaged over all
windows that lie wholly inside the picture. Full resolution: no prior decimation. Computed with d = x - y as

    SSIM(x, y) = (1 - md^2 / (mx^2 + my^2 + C1)) (1 - sd^2 / (sx^2 + sy^2 + C2)),

which is the same, and exact enough in float32: for two flat pictures sxy is a small difference of large numbers.
"""

from __future__ import annotations

from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from runner.rate_quality.compiled import compiled
from runner.rate_quality.metrics.interface import FrameMeter, Luma, Mask, Metric, PictureSize, no_pixels

SIDE, SIGMA = 11, 1.5  # of the window, px
MARGIN = SIDE // 2
C1, C2 = np.float32((0.01 * 255) ** 2), np.float32((0.03 * 255) ** 2)
ONE = np.float32(1)
GREY = np.float32(128)  # subtracted first: keeps squares small, so that float32 is exact enough

PixelRow = NDArray[np.float32]
PixelRows = np.ndarray[Any, np.dtype[np.float32]]


def metric() -> Metric:
    return Metric(
        name="mssim",
        label="MSSIM",
        identity="mssim of luma, Wang 2004, 11x11 Gaussian of sigma 1.5, K .01 .03, windows inside the picture",
        bounds=(-1.0, 1.0),
        tolerance=5e-4,
        good=0.98,
        build=meter,
        smallest_px=SIDE,
    )


def meter(size: PictureSize, fps: Fraction, stride: int, mask: Mask | None) -> FrameMeter:
    """Meter of one lane. Raises UserError for a mask without the centre of a window."""
    width, height = size
    if mask is None:
        counts = np.ones((height - 2 * MARGIN, width - 2 * MARGIN), np.uint8)
    else:
        counts = np.ascontiguousarray(mask[MARGIN:-MARGIN, MARGIN:-MARGIN], np.uint8)
    windows = int(np.count_nonzero(counts))
    if not windows:
        raise no_pixels(f"no pixel that is {MARGIN} px or more from the border")
    weights = gaussian()

    def score(reference: Luma, picture: Luma) -> float:
        # A crop of a larger picture is not contiguous, which the compiled code requires.
        return total(np.ascontiguousarray(reference), np.ascontiguousarray(picture), weights, counts) / windows

    return FrameMeter(size, score)


def gaussian() -> PixelRow:
    """One side of the window, of sum 1."""
    x = np.arange(SIDE) - MARGIN
    bell = np.exp(-(x**2) / (2 * SIGMA**2))
    weights: PixelRow = (bell / bell.sum()).astype(np.float32)
    return weights


@compiled
def total(x: Luma, y: Luma, weights: PixelRow, counts: NDArray[np.uint8]) -> float:
    """Sum of SSIM over the windows that count.

    weights  one side of the window
    counts   [window], 1 for those that count, otherwise 0

    One pass over the rows: a ring holds the last 11 of each moment, smoothed along the row.
    """
    rows, width = x.shape[0], x.shape[1] - 2 * MARGIN
    lines = np.empty((4, x.shape[1]), np.float32)
    ring = np.empty((4, SIDE, width), np.float32)
    means = np.empty((4, width), np.float32)
    turned = np.empty(SIDE, np.float32)
    result = 0.0
    for row in range(rows):
        multiply(x[row], y[row], lines)
        for moment in range(4):
            smooth_row(lines[moment], weights, ring[moment, row % SIDE])
        first = row - SIDE + 1
        if first < 0:
            continue
        for tap in range(SIDE):
            turned[(first + tap) % SIDE] = weights[tap]
        for moment in range(4):
            smooth_column(ring[moment], turned, means[moment])
        result += compare(means, counts[first])
    return result


@compiled
def multiply(x: Luma, y: Luma, lines: PixelRows) -> None:
    """The terms to average, for one row: x, d, x^2 + y^2 and d^2, with x and y less grey, d = x - y."""
    for j in range(len(x)):
        a, b = np.float32(x[j]) - GREY, np.float32(y[j]) - GREY
        d = a - b
        lines[0, j], lines[1, j] = a, d
        lines[2, j], lines[3, j] = a * a + b * b, d * d


# Unrolled below: loops over the taps would not be vectorised.


@compiled
def smooth_row(line: PixelRow, w: PixelRow, smooth: PixelRow) -> None:
    """Weighted mean of every 11 neighbours in a row."""
    for j in range(len(smooth)):
        smooth[j] = (
            w[0] * (line[j] + line[j + 10])
            + w[1] * (line[j + 1] + line[j + 9])
            + w[2] * (line[j + 2] + line[j + 8])
            + w[3] * (line[j + 3] + line[j + 7])
            + w[4] * (line[j + 4] + line[j + 6])
            + w[5] * line[j + 5]
        )


@compiled
def smooth_column(ring: PixelRows, w: PixelRow, smooth: PixelRow) -> None:
    """Weighted mean of the 11 lines of a ring; the weights are rotated like the ring."""
    w0, w1, w2, w3, w4, w5, w6, w7, w8, w9, w10 = w[0], w[1], w[2], w[3], w[4], w[5], w[6], w[7], w[8], w[9], w[10]
    for j in range(len(smooth)):
        smooth[j] = (
            w0 * ring[0, j]
            + w1 * ring[1, j]
            + w2 * ring[2, j]
            + w3 * ring[3, j]
            + w4 * ring[4, j]
            + w5 * ring[5, j]
            + w6 * ring[6, j]
            + w7 * ring[7, j]
            + w8 * ring[8, j]
            + w9 * ring[9, j]
            + w10 * ring[10, j]
        )


@compiled
def compare(means: PixelRows, counts: NDArray[np.uint8]) -> float:
    """Sum of SSIM over one row of windows, from the means of x, d, x^2 + y^2 and d^2, with x and y less grey."""
    result = np.float32(0)
    for j in range(len(counts)):
        mx, md = means[0, j], means[1, j]
        my = mx - md
        variances, difference = means[2, j] - (mx * mx + my * my), means[3, j] - md * md
        mx, my = mx + GREY, my + GREY
        luminance = ONE - md * md / (mx * mx + my * my + C1)
        structure = ONE - difference / (variances + C2)
        result += luminance * structure * np.float32(counts[j])
    return float(result)
