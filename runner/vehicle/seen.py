"""Which cameras' pictures arrive at an operator, by its reception reports. Pure: time is passed in."""

from __future__ import annotations

from collections.abc import Set
from dataclasses import dataclass, field

from runner.records.reception import ReceptionReport
from runner.vehicle.operators import MAX_OPERATORS

SEEN_S = 1.0  # a camera of which nothing has arrived for this long is not seen


@dataclass
class SeenPictures:
    """By operator and camera, when a report last named a frame of it."""

    _seen: dict[str, dict[str, float]] = field(default_factory=dict)

    def add(self, operator: str, t: float, report: ReceptionReport) -> None:
        """A report has arrived, s."""
        if operator not in self._seen and len(self._seen) >= MAX_OPERATORS:
            del self._seen[min(self._seen, key=lambda name: max(self._seen[name].values(), default=0.0))]
        self._seen.setdefault(operator, {}).update({unit.camera: t for unit in report.units})

    def of(self, operator: str, t: float) -> Set[str]:
        """The cameras whose pictures arrive at an operator."""
        return {camera for camera, at in self._seen.get(operator, {}).items() if t - at < SEEN_S}
