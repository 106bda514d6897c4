"""The operator's log of a drive: the vehicle's messages and the reception of each camera."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from msgspec import UNSET

from runner.drive.log import Log
from runner.operator.station import Listener, Station
from runner.records.lines import Note, SoundReceived
from runner.records.operator import CameraSample, Sample
from runner.records.vehicle import Offline, VehicleState

if TYPE_CHECKING:
    from runner.operator.recorded_sound import RecordedSound


class DriveLog(Listener):
    """Listens to a station and writes every change into a log.

    sound  that is received; None: it is not recorded
    """

    def __init__(self, station: Station, log: Log, sound: RecordedSound | None = None) -> None:
        self._station, self._log, self._sound = station, log, sound

    def on_state(self, state: VehicleState | None) -> None:
        now = self._log.now()
        self._log.record(replace(state, t=now) if state else Offline(now))

    def on_sample(self, sample: Sample) -> None:
        cameras = {name: self._with_arrivals(name, camera) for name, camera in sample.cameras.items()}
        self._log.record(replace(sample, t=self._log.now(), cameras=cameras))
        if self._sound and (packets := self._sound.take()):
            self._log.record(SoundReceived(self._log.now(), packets))

    def on_note(self, note: Note) -> None:
        self._log.note(note.text)

    def on_marked(self, back_s: float) -> None:
        self._log.protect_soon(self._log.now(), back_s)

    def _with_arrivals(self, name: str, camera: CameraSample) -> CameraSample:
        arrivals = tuple(self._arrival(name, *arrival) for arrival in self._station.samples[name].arrivals)
        changes = self._station.samples[name].regions
        regions = tuple((round(arrived - self._log.time, 4), region) for arrived, region in changes)
        return replace(camera, arrivals=arrivals, regions=regions or UNSET)

    def _arrival(self, name: str, arrived: float, captured: float | None) -> tuple[float, float | None]:
        """Arrival time of a unit, s since the beginning, and its latency since capture, ms."""
        ms = self._station.latency.to_arrival_ms(name, arrived, captured)
        return round(arrived - self._log.time, 4), None if ms is None else round(ms, 2)
