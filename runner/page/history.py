"""The last minutes of a drive for the charts of a page that is opened late or reloaded. Pure."""

from __future__ import annotations

from collections import deque
from typing import Any

from runner.records.operator import Sample

EVERY_S = 1.0
MAX_SAMPLES = 300  # five minutes
TOTALS = ("predicted_kbps", "allocated_kbps", "actual_kbps")
PER_CAMERA = ("kbps", "allocated_kbps", "scaling")


class History:
    """One sample a second, oldest first."""

    def __init__(self) -> None:
        self._samples: deque[Sample] = deque(maxlen=MAX_SAMPLES)

    def add(self, sample: Sample) -> None:
        if self._samples and sample.t <= self._samples[-1].t - EVERY_S:
            self._samples.clear()  # the clock was set back
        if not self._samples or sample.t - self._samples[-1].t >= EVERY_S:
            self._samples.append(sample)

    def columns(self) -> dict[str, Any]:
        """For each quantity its values over time; None where unknown."""
        samples = list(self._samples)
        positions = [sample.position for sample in samples]
        names = samples[-1].cameras if samples else ()
        return {
            "time": [sample.t for sample in samples],
            **{key: [getattr(sample, key) for sample in samples] for key in TOTALS},
            **{key: [position and getattr(position, key) for position in positions] for key in ("lat", "lon")},
            "cameras": {
                name: {key: [getattr(sample.cameras[name], key) for sample in samples] for key in PER_CAMERA}
                for name in names
            },
        }
