"""Which cameras' pictures arrive at an operator, by its reception reports. Pure: time is passed in."""

from __future__ import annotations

from collections.abc import Set
from dataclasses import dataclass, field

from runner.core.model import Vehicle
from runner.records.reception import ReceptionReport
from runner.vehicle.operators import MAX_OPERATORS

SEEN_S, FRAMES = 1.0, 2  # a camera of which nothing has arrived for this long, or so many frames, is not seen


@dataclass
class SeenPictures:
    """By operator and camera, when a report last named a frame of it."""

    vehicle: Vehicle
    _seen: dict[str, dict[str, float]] = field(default_factory=dict)

    def add(self, operator: str, t: float, report: ReceptionReport) -> None:
        """A report has arrived, s."""
        if operator not in self._seen and len(self._seen) >= MAX_OPERATORS:
            del self._seen[min(self._seen, key=lambda name: max(self._seen[name].values(), default=0.0))]
        named = {unit.camera: t for unit in report.units if unit.camera in self.vehicle.cameras}
        self._seen.setdefault(operator, {}).update(named)

    def of(self, operator: str, t: float) -> Set[str]:
        """The cameras whose pictures arrive at an operator."""
        cameras = self.vehicle.cameras
        within_s = {name: max(SEEN_S, FRAMES / float(camera.fps)) for name, camera in cameras.items()}
        return {name for name, at in self._seen.get(operator, {}).items() if t - at < within_s[name]}
