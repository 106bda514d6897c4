"""The last minutes of a drive for the charts, so that a page opened late or again starts with them. Pure."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import Any

EVERY_S = 1.0
KEPT = 300  # points: five minutes
TOTALS = ("time", "predicted_kbps", "allocated_kbps", "actual_kbps")
OF_CAMERA = ("kbps", "allocated_kbps", "scaling")


class History:
    """One sample a second, oldest first."""

    def __init__(self) -> None:
        self._samples: deque[Mapping[str, Any]] = deque(maxlen=KEPT)

    def add(self, sample: Mapping[str, Any]) -> None:
        if not self._samples or sample["time"] - self._samples[-1]["time"] >= EVERY_S:
            self._samples.append(sample)

    def columns(self) -> dict[str, Any]:
        """By quantity a list over time; None where it was not known."""
        samples = list(self._samples)
        positions = [sample["position"] or {} for sample in samples]
        names = samples[-1]["cameras"] if samples else ()
        return {
            **{key: [sample[key] for sample in samples] for key in TOTALS},
            **{key: [position.get(key) for position in positions] for key in ("lat", "lon")},
            "cameras": {
                name: {key: [sample["cameras"][name][key] for sample in samples] for key in OF_CAMERA} for name in names
            },
        }
