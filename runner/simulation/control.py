"""What the control link sends to the operator over the same uplink: sizes and times of its messages. Pure."""

from __future__ import annotations

import json
from collections.abc import Iterator

from runner.core.decision import Decision
from runner.core.step import Run
from runner.records import combined, to_json
from runner.records.decisions import applied_to_json
from runner.records.lines import Record
from runner.records.vehicle import (
    NOTHING_ENCODED,
    CameraReading,
    CameraTelemetry,
    SpeedAdvice,
    Telemetry,
    VehicleState,
)
from runner.settings import Setup
from runner.vehicle import publishing
from runner.vehicle.publishing import REASONS_S, STATE_S

SEGMENT, SEGMENT_HEADER = 1448, 52  # of TCP with time stamps over IPv4, bytes
MESSAGE = 30  # of MQTT's own header with a topic, about


class ControlMessages:
    """The messages as JSON, which hardly change their size during a drive."""

    def __init__(self, setup: Setup, run: Run) -> None:
        applied = {name: applied_to_json(name, run.commanded.get(name, {})) for name in setup.vehicle.cameras}
        sizes = {"frames": 1234, "bytes": 1_234_567, "capture_ms": 1.23, "encode_ms": 4.56}
        cameras = {
            name: combined(CameraTelemetry, NOTHING_ENCODED, applied=own, **sizes) for name, own in applied.items()
        }
        self.telemetry = _bytes(Telemetry(12.345678, 1234.5, None, cameras, 0, 0, 1.0))
        self.state = _bytes(
            vehicle_state(run, run.state.t, "link_measured kbps 1234.5 queue_ms 12.3 loss 0 state clear")
        )
        advised = setup.latency.speed_factor(None) is not None
        self.advice = _bytes(SpeedAdvice(12.345678, 1.0, 123.4, 0.2)) if advised else 0
        self._stated: tuple[float, Decision | None] = (-STATE_S, None)

    def state_due(self, t: float, decision: Decision) -> bool:
        """Whether the state is published now."""
        at, stated = self._stated
        if decision is stated or t - at < STATE_S or (decision == stated and t - at < REASONS_S):
            return False
        self._stated = (t, decision)
        return True


def vehicle_state(run: Run, t: float, cause: str) -> VehicleState:
    """The state as the vehicle publishes it, everything commanded being applied."""
    cameras = {name: CameraReading(run.commanded.get(name, {})) for name in run.decision.settings}
    return publishing.vehicle_state(run, cameras, t, cause)


def segments(size: int) -> Iterator[int]:
    """Bytes of the IP packets of a message of TCP; of 0 bytes: an acknowledgement."""
    yield min(size, SEGMENT) + SEGMENT_HEADER
    for begin in range(SEGMENT, size, SEGMENT):
        yield min(SEGMENT, size - begin) + SEGMENT_HEADER


def _bytes(record: Record | SpeedAdvice) -> int:
    return len(json.dumps(to_json(record))) + MESSAGE
