"""A simulated drive as the directory of a drive, for `report` and `replay`."""

from __future__ import annotations

import sys
from collections import deque
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from msgspec import UNSET

from runner.core.events import BitratePredicted, Event, describe
from runner.core.model import Vehicle, plain
from runner.core.step import Run
from runner.drive.log import Log
from runner.records import combined
from runner.records.decisions import applied_to_json
from runner.records.lines import LinkSample
from runner.records.operator import CameraSample, LatencyStages, Sample
from runner.records.reception import Arrival, ReceptionReported
from runner.records.vehicle import CameraTelemetry, EncoderCounts, Telemetry
from runner.simulation.control import vehicle_state
from runner.simulation.drive import Recorder, Simulation
from runner.simulation.encoder import Encoder
from runner.simulation.operator import Frame

TELEMETRY_TICKS = 2
RATE_S = 1.0  # over which the operator's side measures rates
EXACT_MS = 0.1  # bound of its clock's error


class _Received:
    """What has arrived of one camera. frames: that are on their way, or have arrived since the last sample."""

    def __init__(self) -> None:
        self.coming: deque[Arrival] = deque()
        self.recent: deque[tuple[float, int]] = deque()
        self.frames = self.bytes = 0
        self.latency_ms: float | None = None

    def arrivals(self, t: float) -> list[Arrival]:
        """Frames that have arrived since the last call."""
        found = []
        while self.coming and self.coming[0].arrived <= t:
            frame = self.coming.popleft()
            found.append(frame)
            self.frames, self.bytes = self.frames + 1, self.bytes + frame.bytes
            self.recent.append((frame.arrived, frame.bytes))
            self.latency_ms = _latency_ms(frame)
        while self.recent and self.recent[0][0] <= t - RATE_S:
            self.recent.popleft()
        return found


class DriveFiles(Recorder):
    """Writes the logs of vehicle, operator and link.

    directory  must hold no drive
    document   the composed configuration
    began      time 0, s since 1970
    note       what was simulated, for the report
    raises     UserError
    """

    def __init__(self, directory: Path, vehicle: Vehicle, document: Mapping[str, Any], began: float, note: str) -> None:
        self._vehicle = vehicle
        self._logs = {
            side: Log(directory, side, document, {}, lambda what: print(what, file=sys.stderr))
            for side in ("vehicle", "operator", "link")
        }
        for log in self._logs.values():
            log.begin(began)
        self._logs["vehicle"].note(note)
        self._received = {name: _Received() for name in vehicle.cameras}
        self._ticks = 0
        self._predicted: int | float | None = None

    def step(self, before: Run, event: Event, after: Run) -> None:
        self._logs["vehicle"].on_step(before, event, after)
        if isinstance(event, BitratePredicted):
            self._predicted = plain(after.state.predicted_kbps or event.kbps)
        if after.commands or after.decision != before.decision:
            self._logs["operator"].record(vehicle_state(after, event.t, describe(event)))

    def reported(self, reported: ReceptionReported) -> None:
        self._logs["vehicle"].record(reported)

    def frame(self, frame: Frame) -> None:
        self._received[frame.camera].coming.append(frame.arrival)

    def tick(self, t: float, simulation: Simulation) -> None:
        for name, way in simulation.ways.items():
            counters = asdict(way.link.queue.counters(t)) | {"tcp_bytes": simulation.tcp_bytes}
            kbps = 0.0 if way.link.cut_at(t) else way.link.capacity.at(t)
            sample = LinkSample(**counters, t=t, kbps=kbps, lane=name or UNSET)
            self._logs["link"].record(sample)
        self._ticks += 1
        if self._ticks % TELEMETRY_TICKS == 0:
            self._logs["vehicle"].record(self._telemetry(t, simulation))
            self._logs["operator"].record(self._sample(t, simulation))

    def close(self) -> None:
        for log in self._logs.values():
            log.close()

    def discard(self) -> None:
        """Remove the files of a drive that was not completed."""
        for log in self._logs.values():
            log.discard()

    def _telemetry(self, t: float, simulation: Simulation) -> Telemetry:
        commanded = simulation.vehicle.run.commanded
        cameras = {
            name: combined(CameraTelemetry, _counts(encoder), applied=applied_to_json(name, commanded.get(name, {})))
            for name, encoder in simulation.encoders.items()
        }
        return Telemetry(t, self._predicted, None, cameras, 0)

    def _sample(self, t: float, simulation: Simulation) -> Sample:
        decision, damaged = simulation.vehicle.run.decision, simulation.operator.damaged_s(t)
        cameras = {}
        for name, received in self._received.items():
            arrivals = tuple((round(frame.arrived, 4), _latency_ms(frame)) for frame in received.arrivals(t))
            setting, seconds = decision.settings[name], min(t, RATE_S)
            cameras[name] = combined(
                CameraSample,
                _counts(simulation.encoders[name]),
                fps=round(len(received.recent) / seconds, 1),
                kbps=round(sum(size for _, size in received.recent) * 8 / 1000 / seconds, 1),
                allocated_kbps=setting.kbps,
                demand_kbps=plain(setting.demand),
                scaling=None if setting.scaling is None else plain(setting.scaling),
                width=setting.width,
                height=setting.height,
                latency_ms=received.latency_ms,
                lost=simulation.operator.unrepaired.get(name, 0),
                rebuilt=0,
                frames=received.frames,
                bytes=received.bytes,
                damaged=round(damaged.get(name, 0.0) * float(self._vehicle.cameras[name].fps)),
                stages_ms=LatencyStages(),
                arrivals=arrivals,
            )
        allocated = sum(setting.kbps for setting in decision.settings.values())
        actual = round(sum(camera.kbps for camera in cameras.values()), 1)
        return Sample(t, self._predicted, allocated, actual, None, 0, cameras, 0, 0.0, EXACT_MS)


def _counts(encoder: Encoder) -> EncoderCounts:
    return EncoderCounts(encoder.frames, encoder.bytes)


def _latency_ms(frame: Arrival) -> float:
    return round(1000 * (frame.arrived - frame.captured), 2)
