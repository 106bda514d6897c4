"""Resolution scaling selection (paper, section II-B) and the resulting picture size."""

from __future__ import annotations

from bisect import bisect_right
from fractions import Fraction

from runner.core.model import SMALLEST_SIDE_PX, Kbps, RateQualityModel, Roi


def as_full_image(allocated: Kbps, roi: Roi, full: Roi) -> Kbps:
    """The bitrate that the full image would have at the same bits per pixel, kbit/s.

    b_alloc * p_full / p_set                                             (paper, left side of Eq. 4)

    A region of interest smaller than the full image thus gets a larger scaling factor.
    """
    return Fraction(allocated * full.pixels, roi.pixels) if roi is not full and roi != full else allocated


def select_scaling(model: RateQualityModel, bitrate: Kbps) -> tuple[Fraction, str]:
    """Factor s_r of the range that a bitrate falls into:  b_min,r <= bitrate < b_min,r+1   (paper, Eq. 4)

    bitrate  kbit/s of the full image, see `as_full_image`
    returns  s_r in ]0, 1], and range and factor as text; a bound belongs to the upper range, the last
             range has no upper end
    """
    if model.whole_b_min:
        # An integer bound is reached when the integer part reaches it: the same result without comparing fractions.
        r = bisect_right(model.whole_b_min, bitrate.numerator // bitrate.denominator) - 1
    else:
        r = bisect_right(model.b_min, bitrate) - 1
    return model.scaling[r], model.ranges[r]


def output_size(roi: Roi, scaling: Fraction) -> tuple[int, int]:
    """Width and height in px of the encoded picture: the ROI times the factor, pixels stay square.

    Each side is rounded to the nearest even number, ties up, since 4:2:0 encoders refuse odd ones. If a side would fall
    below 16 px, both use the factor that makes the shorter one 16.
    """
    size = _scaled(roi, scaling)
    if min(size) < SMALLEST_SIDE_PX:
        return _scaled(roi, Fraction(SMALLEST_SIDE_PX, min(roi.width, roi.height)))
    return size


def _scaled(roi: Roi, scaling: Fraction) -> tuple[int, int]:
    p, q = scaling.numerator, scaling.denominator
    return 2 * ((roi.width * p + q) // (2 * q)), 2 * ((roi.height * p + q) // (2 * q))
