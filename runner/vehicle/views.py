"""What the processes of the operator in control show. Pure: time is passed in."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from math import inf

from msgspec import UNSET, UnsetType

from runner.core.events import Event, ViewReported
from runner.core.model import Vehicle
from runner.core.state import State
from runner.core.view import View, together
from runner.records.reception import ReceptionReport
from runner.vehicle.operators import PRESENT_S

VALID_S = 2.0  # what a process has stated holds for so long; it repeats it every 0.5 s
MAX_RUNS = 8  # processes of one operator


@dataclass(frozen=True, slots=True)
class _Stated:
    """What a process stated at a time, and when it last reported."""

    reported: float
    view: View = field(default_factory=dict)
    at: float = -inf


@dataclass
class StatedViews:
    """A process that receives pictures reports their reception. One that states no view shows everything in full."""

    vehicle: Vehicle
    _operator: str = ""
    _runs: dict[int | UnsetType, _Stated] = field(default_factory=dict)

    def take(self, known: State, operator: str, t: float, report: ReceptionReport) -> Iterator[Event]:
        """What a report of an operator changes, t in s; only one of the operator in control does."""
        if operator != known.driving.in_control:
            return iter(())
        if operator != self._operator:
            self._operator, self._runs = operator, {}
        stated = self._runs.get(report.run, _Stated(t))
        if report.view is not UNSET:
            stated = replace(stated, view=self._possible(report.view), at=t)
        self._runs = {report.run: replace(stated, reported=t), **_without(self._runs, report.run)}
        while len(self._runs) > MAX_RUNS:
            self._runs.popitem()
        return self.events(known, t)

    def events(self, known: State, t: float) -> Iterator[Event]:
        """What has expired; to be called a few times a second."""
        view = self._together(t) if known.driving.in_control == self._operator else {}
        if view != known.view:
            yield ViewReported(t=t, view=view)

    def _together(self, t: float) -> View:
        self._runs = {run: stated for run, stated in self._runs.items() if t - stated.reported < PRESENT_S}
        return together(stated.view if t - stated.at < VALID_S else {} for stated in self._runs.values())

    def _possible(self, view: View) -> View:
        """Without what this vehicle's cameras cannot show: another configuration may have been drawn."""
        cameras = self.vehicle.cameras
        return {name: seen for name, seen in view.items() if name in cameras and seen.lies_in(cameras[name])}


def _without(runs: dict[int | UnsetType, _Stated], run: int | UnsetType) -> dict[int | UnsetType, _Stated]:
    return {other: stated for other, stated in runs.items() if other != run}
