"""From the lines of a drive to quantities over time: one time axis for all sides, arrays for figures. Pure.

The axis is s since the vehicle's log began, or the operator's if the vehicle kept none; sides are aligned by the
epoch time in their first lines and the difference of their clocks, if it was measured. Bitrates are kbit/s. `nan`
stands for a value unknown at a time.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate, pairwise
from typing import Any, NamedTuple, TypeVar

import numpy as np
from msgspec import UNSET

from runner.core.events import BitratePredicted, Event, LinkMeasured, PositionReported
from runner.drive.believed_series import BelievedSeries, Decisions, believed_series
from runner.drive.camera_series import CameraSeries, camera_series
from runner.drive.log import FILES
from runner.drive.panels import Panel, panels
from runner.drive.read import Drive, Side
from runner.drive.time_series import EMPTY, FloatSeries, TimeSeries, settled
from runner.drive.uplink_series import UplinkSeries, uplink_series
from runner.errors import UserError
from runner.pqos.bandwidth_map import EARTH_M
from runner.records.decisions import CameraDecision, DecisionMade
from runner.records.lines import ClockSet, LinkSample, Note, Record
from runner.records.operator import CameraSample, Sample
from runner.records.reception import ReceptionReported
from runner.records.vehicle import Position, Telemetry, VehicleState

T = TypeVar("T")

# How often the vehicle's loop, the operator's sampling and its reports write a line; one that is later was held up.
LOOP_S, SAMPLE_S, REPORT_S = 0.1, 0.25, 0.04
HELD_UP_S = 0.1
LATE_S = 0.05  # that the vehicle was late to send a frame


@dataclass(frozen=True, slots=True)
class Positions:
    """Positions of the vehicle: degrees, and m east and north of the first one."""

    t: FloatSeries
    lat: FloatSeries
    lon: FloatSeries
    east: FloatSeries
    north: FloatSeries


@dataclass(frozen=True, slots=True)
class LinkSeries:
    """A limited link, or a lane of it: rate in force, kbit/s; queueing delay, ms; packets dropped so far."""

    t: FloatSeries
    kbps: FloatSeries
    queue_ms: FloatSeries
    dropped: FloatSeries


class Reason(NamedTuple):
    """Why something changed for a camera at a time."""

    t: float
    cause: str
    camera: str
    reason: str


@dataclass(frozen=True, slots=True)
class Series:
    """A drive over time.

    label      its name among others
    replayed   words of the replay that decided it; None: it was driven
    began      s since 1970 at t = 0
    end        s; the last line of the side that gives the axis
    measured   "received" or "sent": what `actual` is; "" if neither was logged
    predicted, allocated  step functions: each value is in force until the next
    believed   None: no rule believed anything of the uplink
    capped     whether rules lowered the total below what was asked for, a step function; empty if not logged
    measured_t when the vehicle measured the link, s
    held_up    (from s, to s), when a side's process was held up, or the vehicle sent frames late
    links      the limited link by lane; "": it has none; empty: it was not limited
    uplinks    of the vehicle, by name; none if there is one
    modes      (from s, mode)
    notes      (s, text)
    refused    number of requests
    ended      by side, whether its log was closed cleanly
    """

    label: str
    path: str
    replayed: tuple[str, ...] | None
    vehicle: str
    began: float
    end: float
    cameras: Mapping[str, CameraSeries]
    panels: tuple[Panel, ...]
    predicted: TimeSeries
    allocated: TimeSeries
    actual: TimeSeries
    believed: BelievedSeries | None
    measured: str
    capped: TimeSeries
    measured_t: FloatSeries
    held_up: tuple[tuple[float, float], ...]
    links: Mapping[str, LinkSeries]
    uplinks: Mapping[str, UplinkSeries]
    positions: Positions | None
    modes: tuple[tuple[float, str], ...]
    reasons: tuple[Reason, ...]
    notes: tuple[tuple[float, str], ...]
    refused: int
    warnings: tuple[str, ...]
    versions: Mapping[str, Mapping[str, str]]
    ended: Mapping[str, bool]
    config: Mapping[str, Any]


def series(drive: Drive, label: str = "") -> Series:
    """A drive's quantities over time.

    label   its name among others; "": the drive's own name
    raises  UserError if only the first line or no decision was logged
    """
    return _series(drive, label or drive.name)


class _Shifted(NamedTuple):
    """The lines of a side, with the shift of `t` to the drive's axis."""

    lines: Sequence[Event | Record]
    shift: float

    def of(self, kind: type[T]) -> list[tuple[float, T]]:
        return [(line.t + self.shift, line) for line in self.lines if isinstance(line, kind)]


def _series(drive: Drive, label: str) -> Series:
    leading = drive.sides.get("vehicle") or drive.sides["operator"]
    began, end = leading.began_s, leading.end
    if end <= 0:
        raise UserError(str(drive.path), "", None, "is empty: only the first line was logged")
    sides = {name: _Shifted(side.lines, side.began_s - began) for name, side in drive.sides.items()}
    vehicle, operator, link = (sides.get(name, _Shifted((), 0.0)) for name in ("vehicle", "operator", "link"))
    decisions: Decisions = vehicle.of(DecisionMade) or operator.of(VehicleState)
    if not decisions:
        raise UserError(str(drive.path), "", None, "contains no decision")
    config = leading.began.config
    samples = [at for at in _by_steady_clock(operator) if 0 <= at[0] <= end]
    telemetry = vehicle.of(Telemetry)
    names = list(config.get("cameras") or decisions[0][1].cameras)
    cameras = {name: camera_series(name, config, decisions, samples, telemetry) for name in names}
    return Series(
        label=label,
        path=str(drive.path),
        replayed=drive.replayed,
        vehicle=str(config.get("name", "")),
        began=began,
        end=end,
        cameras=cameras,
        panels=panels(config.get("cameras") or {name: {} for name in names}),
        predicted=_predicted(vehicle, telemetry, samples),
        allocated=TimeSeries.of((t, sum(camera.kbps for camera in line.cameras.values())) for t, line in decisions),
        actual=_total(samples, cameras),
        believed=believed_series(decisions),
        measured="received" if samples else "sent" if telemetry else "",
        capped=_capped(operator),
        measured_t=np.array([t for t, _ in vehicle.of(LinkMeasured)], dtype=float),
        held_up=tuple(_held_up(vehicle, samples)),
        links=_links([at for at in link.of(LinkSample) if 0 <= at[0] <= end]),
        uplinks=uplink_series(decisions, vehicle.of(LinkMeasured), samples),
        positions=_positions(_Shifted(leading.lines, 0.0), samples),
        modes=tuple(_modes(decisions)),
        reasons=tuple(_reasons(decisions)),
        notes=tuple(sorted((t, note.text) for side in sides.values() for t, note in side.of(Note))),
        refused=max((line.refused for _, line in (telemetry or samples)), default=0),
        warnings=(*drive.warnings, *_warnings(drive.sides, samples)),
        versions={name: side.began.versions for name, side in drive.sides.items()},
        ended={name: side.ended for name, side in drive.sides.items()},
        config=config,
    )


def _by_steady_clock(operator: _Shifted) -> Iterator[tuple[float, Sample]]:
    """The samples with their arrivals, logged by the operator's wall clock, by one that was not set."""
    set_s = [0.0, *accumulate(line.by_s for _, line in operator.of(ClockSet))]
    for t, line in operator.of(Sample):
        yield t, line if len(set_s) == 1 else replace(line, cameras=dict(_unset(line, set_s)))


def _unset(line: Sample, set_s: Sequence[float]) -> Iterator[tuple[str, CameraSample]]:
    """The cameras of a sample, with arrivals before it by the clock as it was at the start."""
    for name, camera in line.cameras.items():
        near = ((min((at - by_s for by_s in set_s), key=lambda t: abs(t - line.t)), ms) for at, ms in camera.arrivals)
        yield name, replace(camera, arrivals=tuple(near))


def _warnings(sides: Mapping[str, Side], samples: Sequence[Any]) -> Iterator[str]:
    """Problems with the clocks of the two sides."""
    if {"vehicle", "operator"} <= sides.keys() and not samples:
        spans = " and ".join(f"{FILES[side]} is of {sides[side].span}" for side in ("vehicle", "operator"))
        yield f"the logs do not overlap: {spans}: different drives, or clocks far apart; the operator's is left out"


def _predicted(vehicle: _Shifted, telemetry: Sequence[Any], samples: Sequence[Any]) -> TimeSeries:
    """Predictions as received, for all uplinks together, or those in force according to the samples."""
    events = vehicle.of(BitratePredicted)
    if events:
        return TimeSeries.of(_for_all(events))
    return TimeSeries.of((t, line.predicted_kbps) for t, line in (telemetry or samples))


def _for_all(events: Sequence[tuple[float, BitratePredicted]]) -> Iterator[tuple[float, float]]:
    """As `State.predicted_kbps`, after each event."""
    known: dict[str, float] = {}
    for t, event in events:
        known[event.uplink] = float(event.kbps)
        yield t, known.get("", sum(known.values()))


def _total(samples: Sequence[Any], cameras: Mapping[str, CameraSeries]) -> TimeSeries:
    """Measured total; unknown before the first second of video, while the window of the rate is still filling."""
    received = [camera.received for camera in cameras.values() if camera.received]
    if received:
        t, y = TimeSeries.of((t, sample.actual_kbps) for t, sample in samples)
        return TimeSeries(t, settled(t, y, np.asarray(np.sum([each.frames for each in received], axis=0))))
    sent = [camera.sent for camera in cameras.values() if camera.sent]
    return TimeSeries(sent[0].t, np.asarray(np.sum([each.kbps for each in sent], axis=0))) if sent else EMPTY


def _capped(operator: _Shifted) -> TimeSeries:
    states = operator.of(VehicleState)
    return TimeSeries.of((t, state.total_kbps < state.asked_kbps) for t, state in states)


def _held_up(vehicle: _Shifted, samples: Sequence[tuple[float, Sample]]) -> Iterator[tuple[float, float]]:
    """Gaps between lines that a side writes regularly, and frames that the vehicle sent late."""
    reported = vehicle.of(ReceptionReported)
    yield from _gaps([t + vehicle.shift for t in sorted({line.t for line in vehicle.lines})], LOOP_S)
    yield from _gaps([t for t, _ in samples], SAMPLE_S)
    for (_, before), (t, line) in pairwise(reported):
        apart_s = line.report.at - before.report.at
        if before.operator == line.operator and apart_s > REPORT_S + HELD_UP_S:
            yield t - apart_s, t
    for t, line in reported:
        if line.late_s is not UNSET and (late_s := max(line.late_s, default=0.0)) > LATE_S:
            yield t - late_s, t


def _gaps(times: Sequence[float], every_s: float) -> Iterator[tuple[float, float]]:
    return ((before, t) for before, t in pairwise(times) if t - before > every_s + HELD_UP_S)


def _links(lines: Sequence[tuple[float, LinkSample]]) -> dict[str, LinkSeries]:
    rows: dict[str, list[tuple[float, ...]]] = {}
    for t, line in lines:
        rows.setdefault(line.lane or "", []).append((t, line.kbps, line.queue_ms, line.dropped))
    return {lane: LinkSeries(*np.array(each, dtype=float).T) for lane, each in rows.items()}


def _positions(leading: _Shifted, samples: Sequence[Any]) -> Positions | None:
    """Positions as the vehicle received them, otherwise as the operator did; None if there are none.

    Metres by equirectangular projection around the first position, accurate within a few km.
    """
    known: list[tuple[float, PositionReported | Position]] = [*leading.of(PositionReported)]
    known = known or [(t, sample.position) for t, sample in samples if sample.position]
    if not known:
        return None
    t, lat, lon = np.array([(t, place.lat, place.lon) for t, place in known], dtype=float).T
    around = np.remainder(lon - lon[0] + 180, 360) - 180  # also if the drive crosses the 180th meridian
    east = np.radians(around) * np.cos(np.radians(lat[0])) * EARTH_M
    return Positions(t, lat, lon, east, np.radians(lat - lat[0]) * EARTH_M)


def _modes(decisions: Sequence[Any]) -> Iterator[tuple[float, str]]:
    last = None
    for t, line in decisions:
        if line.mode != last:
            last = line.mode
            yield t, str(last)


def _reasons(decisions: Sequence[Any]) -> Iterator[Reason]:
    """Each change of factor or sending, as the vehicle reports them during the drive."""
    last: Mapping[str, CameraDecision] = {}
    for t, line in decisions:
        for name, now in line.cameras.items():
            was = last.get(name)
            if was is None or (was.scaling, was.sending) != (now.scaling, now.sending):
                yield Reason(t, line.cause, name, now.reason)
        last = line.cameras
