"""The operator's log of a drive: the vehicle's messages, and the reception of each camera."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

from runner.drive.log import Log
from runner.operator.station import Listener, Station
from runner.records import CameraSample, Note, Offline, Sample, VehicleState


class DriveLog(Listener):
    """Listens to a station and writes every change into a log."""

    def __init__(self, station: Station, log: Log) -> None:
        self._station, self._log = station, log

    def on_state(self, state: VehicleState | None) -> None:
        now = self._log.now()
        self._log.record(replace(state, t=now) if state else Offline(now))

    def on_sample(self, sample: Sample) -> None:
        cameras = {name: self._with_arrivals(name, camera) for name, camera in sample.cameras.items()}
        self._log.record(replace(sample, t=self._log.now(), cameras=cameras))

    def on_note(self, note: Note) -> None:
        self._log.note(note.text)

    def _with_arrivals(self, name: str, camera: CameraSample) -> CameraSample:
        received: Any = self._station.samples[name]
        return replace(camera, arrivals=_arrivals(received.arrivals, self._log.time))


def _arrivals(arrivals: Iterable[tuple[float, float | None]], began: float) -> tuple[tuple[float, float | None], ...]:
    """Arrival time of each unit, s since the beginning, and its delay since capture, ms."""
    return tuple(
        (round(arrived - began, 4), None if captured is None else round(1000 * (arrived - captured), 2))
        for arrived, captured in arrivals
    )
