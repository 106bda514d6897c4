"""A metric of the picture as a screen shows it that has fewer px than the camera's full image."""

from __future__ import annotations

from dataclasses import dataclass, replace
from fractions import Fraction
from functools import partial

from runner.core.model import plain
from runner.rate_quality.metrics.interface import Luma, Mask, Metric, PictureSize, QualityMeter


def name_at(metric: str, factor: Fraction) -> str:
    """Its name: mssim@0.5."""
    return f"{metric}@{plain(factor)}"


def fits(size: PictureSize, factor: Fraction, metric: Metric) -> bool:
    """Whether the metric can score pictures that are shown at this factor of their size."""
    return min(_shown(size, factor)) >= metric.smallest_px


def reduced(metric: Metric, factor: Fraction) -> Metric:
    """The metric of pictures that are shown at a factor of their size, each px the mean of those that it covers."""
    identity = f"{metric.identity}; shown at {plain(factor)} of its size"
    build = partial(_build, metric, factor)
    return replace(metric, name=name_at(metric.name, factor), identity=identity, build=build, smallest_px=1)


def _build(
    metric: Metric, factor: Fraction, size: PictureSize, fps: Fraction, stride: int, mask: Mask | None
) -> QualityMeter:
    small = _shown(size, factor)
    return _Reduced(metric.meter(small, fps, stride, None if mask is None else _small_mask(mask, small)), small)


@dataclass
class _Reduced:
    meter: QualityMeter
    size: PictureSize

    def add(self, frame: int, reference: Luma, picture: Luma) -> None:
        import cv2

        small: list[Luma] = [cv2.resize(one, self.size, interpolation=cv2.INTER_AREA) for one in (reference, picture)]  # type: ignore[misc]
        self.meter.add(frame, *small)

    def close(self) -> dict[int, float]:
        return self.meter.close()


def _shown(size: PictureSize, factor: Fraction) -> PictureSize:
    return round(size[0] * factor), round(size[1] * factor)


def _small_mask(mask: Mask, size: PictureSize) -> Mask:
    import cv2
    import numpy as np

    return np.asarray(cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST), bool)
