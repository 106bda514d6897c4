"""What a list of several vehicles shows of one."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from msgspec import UNSET

from runner.core.driving import Control, Driving
from runner.core.events import Attention
from runner.core.model import Mode
from runner.operator.station import Station, holds_control
from runner.records.vehicle import VehicleState

UNSEEN = (Attention.SLOW, Attention.HIDDEN, Attention.ABSENT)


@dataclass(frozen=True, slots=True)
class Summary:
    """A vehicle as its station knows it now.

    fault       why there is no control link; None: there is one
    control     whether an operator is in control, or was until it was lost; None: unknown
    holder      id of that operator; None: there is none
    held_s      for how long it has been in this state, s
    offered     id of the operator to whom control is offered; None: none
    requested   ids of those that ask for it
    is_own      whether the holder is this station's operator
    speed_mps   None: unknown
    latency_ms  of the oldest picture of the cameras that are received here, with its error bound; None: unknown
    believed_kbps  what the uplink is believed to carry; None: unknown
    alarms      in words
    cameras     names of those that are on, in the vehicle's order
    received    names of those that are received here
    """

    online: bool
    fault: str | None
    mode: Mode | None
    control: Control | None
    holder: str | None
    held_s: float
    offered: str | None
    requested: tuple[str, ...]
    is_own: bool
    speed_mps: float | None
    latency_ms: float | None
    bound_ms: float | None
    allocated_kbps: float | None
    actual_kbps: float
    believed_kbps: float | None
    alarms: tuple[str, ...]
    cameras: tuple[str, ...]
    received: tuple[str, ...]


def summary(station: Station) -> Summary:
    """From any thread."""
    state, rows = station.state, station.rows()  # another thread may replace the state
    telemetry, clock = station.telemetry if state else None, station.latency.clock
    position = telemetry.position if telemetry else None
    driving = state.driving if state and state.driving is not UNSET else None
    received = [row for row in rows if row.rates.fps]
    latencies = [row.received.latency_ms for row in received]
    known = [ms for ms in latencies if ms is not None]
    return Summary(
        online=state is not None,
        fault=station.link.fault,
        mode=state.mode if state else None,
        control=driving.state if driving else None,
        holder=driving.holder if driving else None,
        held_s=max(0.0, telemetry.t - driving.since) if driving and telemetry else 0.0,
        offered=driving.offered if driving else None,
        requested=driving.requested if driving else (),
        is_own=holds_control(station),
        speed_mps=position.speed_mps if position and position.speed_mps is not UNSET else None,
        latency_ms=max(known) if known and len(known) == len(latencies) else None,
        bound_ms=1000 * clock.bound_s if clock else None,
        allocated_kbps=sum(camera.kbps for camera in state.cameras.values()) if state else None,
        actual_kbps=sum(row.rates.kbps for row in received),
        believed_kbps=float(state.believed.kbps) if state and state.believed is not UNSET else None,
        alarms=tuple(_alarms(state)) if state else (),
        cameras=tuple(name for name, camera in state.cameras.items() if camera.on) if state else (),
        received=tuple(row.name for row in received),
    )


def _alarms(state: VehicleState) -> Iterator[str]:
    """What is wrong on the vehicle, or with its driver."""
    driving = Driving() if state.driving is UNSET else state.driving
    if driving.stop:
        yield f"{driving.stop} asked to stop"
    if state.fault:
        yield state.fault
    for name, camera in state.cameras.items():
        if camera.fault:
            yield f"{name}: {camera.fault}"
        elif driving.in_control and camera.on and not camera.sending:
            yield f"{name}: paused"
    if driving.in_control and state.attention in UNSEEN:
        yield f"the driver's page is {'closed' if state.attention is Attention.ABSENT else state.attention}"
