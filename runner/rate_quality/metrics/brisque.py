"""BRISQUE of luma (A. Mittal, A. K. Moorthy, A. C. Bovik, "No-reference image quality assessment in the spatial
domain", IEEE Trans. Image Processing 21(12), 2012): 36 features of natural scenes, and a regression from the user.

It compares a picture with statistics of natural scenes, without a reference; scores need not rise with the
bitrate. Equation numbers are those of the paper.
"""

from __future__ import annotations

import math
from fractions import Fraction
from functools import cache, partial
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from runner.errors import UserError
from runner.rate_quality.compiled import compiled
from runner.rate_quality.metrics.interface import FrameMeter, Luma, Mask, Metric, PictureSize
from runner.rate_quality.metrics.svr import Regression, load

Plane = NDArray[np.float32]

SCALES = 2
SIDE, SIGMA = 7, 7 / 6  # of the window, px
FEATURES = 36
SMALLEST_PX = 2 * SIDE
NOISE = 1e-4  # a coefficient below it is rounding noise in a flat window, and has no sign
SHAPES = np.linspace(0.2, 10, 9801)  # candidates for the shape of a distribution
NEIGHBOURS = ((0, 1), (1, 0), (1, 1), (1, -1))  # rows down, columns right (Eq. 7 to 10)


def metric(model: Path | None, ranges: Path | None) -> Metric:
    """BRISQUE with the user's regression, see `svr.py`. Raises UserError for a missing or invalid file."""
    for key, path, what in (
        ("brisque_model", model, "the regression as libsvm's text or OpenCV's brisque_model_live.yml"),
        ("brisque_range", ranges, "the ranges of the features as svm-scale's text or OpenCV's brisque_range_live.yml"),
    ):
        if path is None:
            raise UserError("", key, None, f"brisque needs a file that you provide, {what}")
    assert model is not None and ranges is not None
    regression = load(model, ranges, FEATURES)
    return Metric(
        name="brisque",
        label="BRISQUE (lower is better)",
        identity=f"brisque of luma, Mittal 2012, features 1, regression {regression.identity}, 0 to 100",
        bounds=(0.0, 100.0),
        tolerance=1.0,
        good=25.0,
        build=partial(meter, regression),
        smallest_px=SMALLEST_PX,
        higher_is_better=False,
        takes_mask=False,
    )


def meter(regression: Regression, size: PictureSize, fps: Fraction, stride: int, mask: Mask | None) -> FrameMeter:
    """Meter of one lane. Masks are not supported, as the metric states."""
    return FrameMeter(size, lambda _, picture: score(picture, regression))


def score(picture: Luma, regression: Regression) -> float:
    """0 best to 100 worst; predictions outside are clipped."""
    return min(100.0, max(0.0, regression(features(picture))))


def features(picture: Luma) -> NDArray[np.float64]:
    """The 36 features: at full and at half size the two of a GGD, and four each of an AGGD for four neighbours.

    Half size is OpenCV's bicubic without a low-pass before, as in the authors' C++ release: models are trained on it.
    """
    plane = picture.astype(np.float32)
    height, width = plane.shape
    found: list[float] = []
    for scale in range(SCALES):
        if scale:
            plane = cv2.resize(plane, (width // 2, height // 2), interpolation=cv2.INTER_CUBIC).astype(np.float32)
        mscn = normalise(plane)
        found += fit_ggd(mscn)
        for down, right in NEIGHBOURS:
            found += fit_aggd(statistics(mscn, down, right))
    return np.array(found)


def normalise(plane: Plane) -> Plane:
    """Mean subtracted contrast normalised coefficients of luma from 0 to 255.

        (I - mu) / (sigma + 1),  mu and sigma under a 7x7 Gaussian of sigma 7/6           (Eq. 1 to 3, C = 1)

    The picture's border is replicated outward; the paper leaves this open.
    """
    centred = plane - 128  # keeps squares small, so that float32 is exact enough
    mean = _blur(centred)
    variance = np.maximum(_blur(centred * centred) - mean * mean, 0)
    coefficients: Plane = (centred - mean) / (np.sqrt(variance) + 1)
    coefficients[np.abs(coefficients) < NOISE] = 0
    return coefficients


def _blur(plane: Plane) -> Plane:
    return cv2.GaussianBlur(plane, (SIDE, SIDE), SIGMA, borderType=cv2.BORDER_REPLICATE).astype(np.float32, copy=False)


def fit_ggd(values: Plane) -> tuple[float, float]:
    """Shape and variance of a generalised Gaussian of mean 0, by moment matching (K. Sharifi, A. Leon-Garcia, 1995).

    Gamma(2/a)^2 / (Gamma(1/a) Gamma(3/a)) = E[|x|]^2 / E[x^2]
    """
    variance = float(np.mean(np.square(values), dtype=np.float64))
    mean = float(np.mean(np.abs(values), dtype=np.float64))
    return shape(mean * mean, variance), variance


class ProductSums(NamedTuple):
    """Sums over a set of values: counts in total, below 0 and above; squares and absolute values."""

    total: int
    below: int
    above: int
    squares_below: float
    squares_above: float
    absolute: float


def statistics(mscn: Plane, down: int, right: int) -> ProductSums:
    """Sums over the products of neighbours within the picture (Eq. 7 to 10)."""
    rows, columns = mscn.shape[0] - down, mscn.shape[1] - abs(right)
    return ProductSums(rows * columns, *sum_products(mscn, down, right))


@compiled
def sum_products(mscn: Plane, down: int, right: int) -> tuple[int, int, float, float, float]:
    """Counts below and above 0, sums of squares below and above 0, sum of absolute values."""
    below = above = 0
    squares_below = squares_above = absolute = 0.0
    columns = mscn.shape[1] - abs(right)
    for row in range(mscn.shape[0] - down):
        a, b = mscn[row, max(0, -right) :], mscn[row + down, max(0, right) :]
        for j in range(columns):
            product = a[j] * b[j]
            low, high = min(product, np.float32(0)), max(product, np.float32(0))
            below += low < 0
            above += high > 0
            squares_below += low * low
            squares_above += high * high
            absolute += high - low
    return below, above, squares_below, squares_above, absolute


def fit_aggd(seen: ProductSums) -> tuple[float, float, float, float]:
    """Shape, mean, left and right variance of an asymmetric generalised Gaussian, by moment matching.

        r(a) = E[|x|]^2 / E[x^2] * (g^3 + 1)(g + 1) / (g^2 + 1)^2,    g = left / right deviation
        mean = (right - left) sqrt(Gamma(1/a) / Gamma(3/a)) * Gamma(2/a) / Gamma(1/a)

    (N.-E. Lasmar, Y. Stitou, Y. Berthoumieu, "Multiscale skewed heavy tailed model for texture analysis", ICIP 2009.)
    For values that are all 0, the shape is the highest, everything else 0.
    """
    left, right = (
        math.sqrt(squares / count) if count else 0.0
        for squares, count in ((seen.squares_below, seen.below), (seen.squares_above, seen.above))
    )
    variance = (seen.squares_below + seen.squares_above) / seen.total
    skew = (left**3 + right**3) * (left + right)
    a = shape((seen.absolute / seen.total) ** 2 * skew, variance * (left**2 + right**2) ** 2)
    one, two, three = (math.gamma(n / a) for n in (1, 2, 3))
    return a, (right - left) * math.sqrt(one / three) * two / one, left**2, right**2


def shape(numerator: float, denominator: float) -> float:
    """The a from 0.2 to 10 with r(a) = Gamma(2/a)^2 / (Gamma(1/a) Gamma(3/a)) = numerator / denominator."""
    if denominator <= 0:
        return float(SHAPES[-1])
    return float(np.interp(numerator / denominator, _ratios(), SHAPES))


@cache
def _ratios() -> NDArray[np.float64]:
    """r(a) of all shapes; increasing."""
    return np.array([math.exp(2 * math.lgamma(2 / a) - math.lgamma(1 / a) - math.lgamma(3 / a)) for a in SHAPES])
