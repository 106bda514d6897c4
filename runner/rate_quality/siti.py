"""Spatial and temporal perceptual information of luma (ITU-T P.910, SI and TI): how hard a scene is to encode."""

from __future__ import annotations

from dataclasses import dataclass, field
from statistics import fmean

import cv2

from runner.rate_quality.metrics.interface import Luma


@dataclass
class SiTi:
    """SI of each frame of a clip, and TI of each but the first; only the last frame is kept.

    P.910 uses the maximum over time; the mean says more about a scene with a cut or a flash. Without values, each is 0.
    """

    si: list[float] = field(default_factory=list)
    ti: list[float] = field(default_factory=list)
    _before: Luma | None = None

    def add(self, frame: Luma) -> None:
        """The next frame of the clip."""
        self.si.append(spatial(frame))
        if self._before is not None:
            self.ti.append(temporal(self._before, frame))
        self._before = frame

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
