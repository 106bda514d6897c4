"""Spatial and temporal perceptual information of luma (ITU-T P.910, SI and TI): how hard a scene is to encode."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from statistics import fmean

import cv2

from runner.rate_quality.metrics.interface import Luma


@dataclass(frozen=True)
class SiTi:
    """SI of each frame, and TI of each but the first.

    P.910 uses the maximum over time; the mean says more about a scene with a cut or a flash.
    """

    si: Sequence[float]
    ti: Sequence[float]

    @property
    def si_max(self) -> float:
        return max(self.si, default=0.0)

    @property
    def ti_max(self) -> float:
        return max(self.ti, default=0.0)

    @property
    def si_mean(self) -> float:
        return fmean(self.si or [0.0])

    @property
    def ti_mean(self) -> float:
        return fmean(self.ti or [0.0])


def measure(frames: Iterable[Luma]) -> SiTi:
    """SI and TI of a clip, keeping two frames in memory; 0 if it has too few frames."""
    si: list[float] = []
    ti: list[float] = []
    before: Luma | None = None
    for frame in frames:
        si.append(spatial(frame))
        if before is not None:
            ti.append(temporal(before, frame))
        before = frame
    return SiTi(si, ti)


def spatial(luma: Luma) -> float:
    """Standard deviation over space of the Sobel-filtered picture, without its border, which lacks neighbours.

    SI = std_space(sqrt(Gh^2 + Gv^2))                                                   (ITU-T P.910, SI)
    """
    across, down = (cv2.Sobel(luma, cv2.CV_32F, *order)[1:-1, 1:-1] for order in ((1, 0), (0, 1)))
    return _deviation(cv2.magnitude(across, down))


def temporal(before: Luma, luma: Luma) -> float:
    """Standard deviation over space of the difference from the frame before.

    TI = std_space(F_n - F_n-1)                                                         (ITU-T P.910, TI)
    """
    return _deviation(cv2.subtract(luma, before, dtype=cv2.CV_16S))


def _deviation(values: cv2.typing.MatLike) -> float:
    """Population standard deviation, as in P.910: divided by the number of pixels."""
    _, deviation = cv2.meanStdDev(values)
    return float(deviation[0, 0])
