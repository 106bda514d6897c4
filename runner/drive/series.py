"""From the lines of a drive to quantities over time: one time axis for all sides, arrays for figures. Pure.

The axis is s since the vehicle's log began, or the operator's if the vehicle kept none; sides are aligned by the
epoch time in their first lines and the difference of their clocks, if it was measured. Bitrates are kbit/s. `nan`
stands for a value unknown at a time.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from itertools import accumulate, pairwise
from typing import Any, NamedTuple, TypeVar

import numpy as np
from msgspec import UNSET
from numpy.typing import NDArray

from runner.core.events import BitratePredicted, Event, LinkMeasured, PositionReported
from runner.core.model import Mode
from runner.drive.log import FILES
from runner.drive.read import Drive, Side
from runner.errors import UserError
from runner.pqos.bandwidth_map import EARTH_M
from runner.records.decisions import CameraDecision, DecisionMade
from runner.records.lines import ClockSet, LinkSample, Note, Record
from runner.records.operator import CameraSample, Sample
from runner.records.reception import ReceptionReported
from runner.records.vehicle import CameraTelemetry, Position, Telemetry, VehicleState
from runner.system.clocks import STEP_S

FloatSeries = NDArray[np.float64]
Flags = NDArray[np.bool_]
T = TypeVar("T")

RATE_WINDOW_S = 1.0  # rates of sent video are measured over at least this long, as the operator's are
# How often the vehicle's loop, the operator's sampling and its reports write a line; one that is later was held up.
LOOP_S, SAMPLE_S, REPORT_S = 0.1, 0.25, 0.04
HELD_UP_S = 0.1
LATE_S = 0.05  # that the vehicle was late to send a frame
DOWN_DEG = 25.0  # a camera pitched down by this much is a top view, as on the operator's page
BELIEVED = ("kbps", "deviation", "margin", "bias", "error", "gain", "policer_kbps")  # of `Believed`, over time
PANEL_CAMERAS = 4  # number of curves distinguishable in one panel; more are split if the mounting gives no groups


class TimeSeries(NamedTuple):
    """A quantity over time: t s, increasing; y its values."""

    t: FloatSeries
    y: FloatSeries


@dataclass(frozen=True, slots=True)
class DecidedSeries:
    """The decisions for one camera, each entry in force until the next.

    roi_share  pixels of the region of interest over those of the full image
    scaling    nan while the camera is off
    """

    t: FloatSeries
    sending: Flags
    kbps: FloatSeries
    scaling: FloatSeries
    width: FloatSeries
    height: FloatSeries
    roi_share: FloatSeries
    reason: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class ReceivedSeries:
    """What the operator received from one camera. Counters continue where those in the log restarted from 0.

    t                        s, of each sample
    kbps                     over the second before
    width, height            px of the picture, 0 before the first
    latency_ms               capture to decode of the last sampled frame, nan if unknown
    bound_ms                 by how much latencies may be wrong, nan if unknown
    frames, bytes            counters at each sample
    lost, rebuilt            packets, counters at each sample
    damaged                  counter of frames whose picture shows a loss
    arrival_t, arrival_ms    arrival of each access unit, s, and its latency from capture to arrival, likewise
    """

    t: FloatSeries
    kbps: FloatSeries
    width: FloatSeries
    height: FloatSeries
    latency_ms: FloatSeries
    bound_ms: FloatSeries
    frames: FloatSeries
    bytes: FloatSeries
    lost: FloatSeries
    rebuilt: FloatSeries
    damaged: FloatSeries
    arrival_t: FloatSeries
    arrival_ms: FloatSeries


@dataclass(frozen=True, slots=True)
class Sent:
    """Output of the vehicle's encoder: continuous counters, and the rate over the last second."""

    t: FloatSeries
    frames: FloatSeries
    bytes: FloatSeries
    kbps: FloatSeries


@dataclass(frozen=True, slots=True)
class CameraSeries:
    """One camera. received, sent: None where that side has no log. fps: of the configuration, Hz; nan if unknown."""

    name: str
    decided: DecidedSeries
    received: ReceivedSeries | None
    sent: Sent | None
    fps: float = float("nan")

    @property
    def actual(self) -> TimeSeries:
        """The bitrate as received, or as sent if no operator logged."""
        source = self.received or self.sent
        return TimeSeries(source.t, source.kbps) if source else EMPTY

    @property
    def allocated(self) -> TimeSeries:
        """The bitrate as decided, a step function; nan while the camera should not send."""
        return TimeSeries(self.decided.t, np.where(self.decided.sending, self.decided.kbps, np.nan))


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
    """The limited link of an experiment: rate in force, kbit/s; queueing delay, ms; packets dropped so far."""

    t: FloatSeries
    kbps: FloatSeries
    queue_ms: FloatSeries
    dropped: FloatSeries


@dataclass(frozen=True, slots=True)
class BelievedSeries:
    """What was believed of the uplink, see `runner.core.decision.Believed`, each in force until the next; nan: unknown.

    usable  the most that the cameras can use, kbit/s; nan in mode single
    """

    t: FloatSeries
    kbps: FloatSeries
    deviation: FloatSeries
    margin: FloatSeries
    bias: FloatSeries
    error: FloatSeries
    gain: FloatSeries
    policer_kbps: FloatSeries
    usable: FloatSeries


class Reason(NamedTuple):
    """Why something changed for a camera at a time."""

    t: float
    cause: str
    camera: str
    reason: str


class Panel(NamedTuple):
    """Cameras that are drawn into one panel."""

    title: str
    cameras: tuple[str, ...]


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
    link: LinkSeries | None
    positions: Positions | None
    modes: tuple[tuple[float, str], ...]
    reasons: tuple[Reason, ...]
    notes: tuple[tuple[float, str], ...]
    refused: int
    warnings: tuple[str, ...]
    versions: Mapping[str, Mapping[str, str]]
    ended: Mapping[str, bool]
    config: Mapping[str, Any]


EMPTY = TimeSeries(np.empty(0), np.empty(0))


def series(drive: Drive, label: str = "") -> Series:
    """A drive's quantities over time.

    label   its name among others; "": the drive's own name
    raises  UserError if only the first line or no decision was logged
    """
    return _series(drive, label or drive.name)


def held(line: TimeSeries, at: FloatSeries) -> FloatSeries:
    """Values of a step function at some times; nan before the first value."""
    index = np.searchsorted(line.t, at, "right") - 1
    return np.where(index >= 0, line.y[np.maximum(index, 0)], np.nan) if line.t.size else np.full(at.shape, np.nan)


def spans(t: FloatSeries, begin: float, end: float) -> FloatSeries:
    """How long each value of a step function is in force within [begin, end], s."""
    edges = np.clip(np.append(t, end), begin, end)
    return np.asarray(np.diff(edges))


def mean_held(line: TimeSeries, begin: float, end: float) -> float:
    """Mean of a step function over time; nan if no value is known."""
    weights = spans(line.t, begin, end)
    known = np.isfinite(line.y) & (weights > 0)
    return float(np.average(line.y[known], weights=weights[known])) if known.any() else float("nan")


def sending_spans(decided: DecidedSeries, end: float) -> list[tuple[float, float]]:
    """When a camera should have been sending: [(from s, to s), ...]."""
    found: list[tuple[float, float]] = []
    for (start, until), sending in zip(pairwise([*decided.t, end]), decided.sending, strict=True):
        if not sending or until <= start:
            continue
        if found and found[-1][1] == start:
            found[-1] = (found[-1][0], until)
        else:
            found.append((start, until))
    return found


# --- the whole drive --------------------------------------------------------------------------------------------------


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
    decisions: Sequence[tuple[float, DecisionMade | VehicleState]]
    decisions = vehicle.of(DecisionMade) or operator.of(VehicleState)
    if not decisions:
        raise UserError(str(drive.path), "", None, "contains no decision")
    config = leading.began.config
    samples = [at for at in _by_steady_clock(operator) if 0 <= at[0] <= end]
    telemetry = vehicle.of(Telemetry)
    names = list(config.get("cameras") or decisions[0][1].cameras)
    cameras = {name: _camera(name, config, decisions, samples, telemetry) for name in names}
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
        allocated=_line((t, sum(camera.kbps for camera in line.cameras.values())) for t, line in decisions),
        actual=_total(samples, cameras),
        believed=_believed(decisions),
        measured="received" if samples else "sent" if telemetry else "",
        capped=_capped(operator),
        measured_t=np.array([t for t, _ in vehicle.of(LinkMeasured)], dtype=float),
        held_up=tuple(_held_up(vehicle, samples)),
        link=_link([at for at in link.of(LinkSample) if 0 <= at[0] <= end]),
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


def _line(points: Iterable[tuple[float, float | None]]) -> TimeSeries:
    found = [(t, np.nan if y is None else float(y)) for t, y in points]
    t, y = np.array(found, dtype=float).reshape(-1, 2).T
    return TimeSeries(t, y)


def _predicted(vehicle: _Shifted, telemetry: Sequence[Any], samples: Sequence[Any]) -> TimeSeries:
    """Predictions as received, or those in force according to the samples."""
    events = vehicle.of(BitratePredicted)
    if events:
        return _line((t, float(event.kbps)) for t, event in events)
    return _line((t, line.predicted_kbps) for t, line in (telemetry or samples))


def _total(samples: Sequence[Any], cameras: Mapping[str, CameraSeries]) -> TimeSeries:
    """Measured total; unknown before the first second of video, while the window of the rate is still filling."""
    received = [camera.received for camera in cameras.values() if camera.received]
    if received:
        t, y = _line((t, sample.actual_kbps) for t, sample in samples)
        return TimeSeries(t, _settled(t, y, np.asarray(np.sum([each.frames for each in received], axis=0))))
    sent = [camera.sent for camera in cameras.values() if camera.sent]
    return TimeSeries(sent[0].t, np.asarray(np.sum([each.kbps for each in sent], axis=0))) if sent else EMPTY


def _believed(decisions: Sequence[tuple[float, DecisionMade | VehicleState]]) -> BelievedSeries | None:
    if all(line.believed is UNSET for _, line in decisions):
        return None

    def row(t: float, line: DecisionMade | VehicleState) -> tuple[float | None, ...]:
        known = (getattr(line.believed, key, None) for key in BELIEVED)
        usable = sum(camera.demand_kbps for camera in line.cameras.values())
        return t, *known, None if line.mode is Mode.SINGLE else usable

    return BelievedSeries(*np.array([row(t, line) for t, line in decisions], dtype=float).T)


def _capped(operator: _Shifted) -> TimeSeries:
    states = operator.of(VehicleState)
    return _line((t, state.total_kbps < state.asked_kbps) for t, state in states)


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


def _link(lines: Sequence[Any]) -> LinkSeries | None:
    if not lines:
        return None
    rows = np.array([(t, line.kbps, line.queue_ms, line.dropped) for t, line in lines], dtype=float)
    return LinkSeries(*rows.T)


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


# --- cameras ----------------------------------------------------------------------------------------------------------


def _camera(
    name: str,
    config: Mapping[str, Any],
    decisions: Sequence[Any],
    samples: Sequence[Any],
    telemetry: Sequence[Any],
) -> CameraSeries:
    described = (config.get("cameras") or {}).get(name, {})
    full = described.get("width_px", 0) * described.get("height_px", 0)
    decided = [(t, line.cameras[name]) for t, line in decisions if name in line.cameras]
    received = [(t, line, line.cameras[name]) for t, line in samples if name in line.cameras]
    sent = [(t, line.cameras[name]) for t, line in telemetry if name in line.cameras]
    return CameraSeries(
        name,
        _decided(decided, full),
        _received(received) if received else None,
        _sent(sent) if sent else None,
        _fps(described.get("fps"), config.get("fps_max")),
    )


def _fps(own: Any, limit: Any) -> float:
    rates = [float(Fraction(str(rate))) for rate in (own, limit) if rate is not None]
    return float("nan") if own is None else min(rates)


def _decided(decided: Sequence[tuple[float, CameraDecision]], full: int) -> DecidedSeries:
    def column(key: str) -> FloatSeries:
        return np.array([getattr(camera, key) for _, camera in decided], dtype=float)  # None becomes nan

    shares = [camera.roi.pixels / full if full else 1.0 for _, camera in decided]
    return DecidedSeries(
        t=np.array([t for t, _ in decided], dtype=float),
        sending=np.array([camera.sending for _, camera in decided], dtype=bool),
        kbps=column("kbps"),
        scaling=column("scaling"),
        width=column("width"),
        height=column("height"),
        roi_share=np.array(shares, dtype=float),
        reason=tuple(camera.reason for _, camera in decided),
    )


def _received(received: Sequence[tuple[float, Sample, CameraSample]]) -> ReceivedSeries:
    def column(key: str) -> FloatSeries:
        return np.array([getattr(camera, key) for *_, camera in received], dtype=float)

    pairs = [(at + t - line.t, ms) for t, line, camera in received for at, ms in camera.arrivals]
    arrivals = np.array(pairs, dtype=float).reshape(-1, 2)
    arrivals = arrivals[np.argsort(arrivals[:, 0], kind="stable")]
    t = np.array([t for t, *_ in received], dtype=float)
    frames = counted(column("frames"))
    moved = np.diff(frames, prepend=0) > 0  # otherwise the latency is that of a frame already counted
    bound_ms = np.array([line.clock_bound_ms for _, line, _ in received], dtype=float)
    return ReceivedSeries(
        t=t,
        kbps=_settled(t, column("kbps"), frames),
        **{key: column(key) for key in ("width", "height")},
        latency_ms=np.where(moved, column("latency_ms"), np.nan),
        bound_ms=bound_ms,
        frames=frames,
        **{key: counted(column(key)) for key in ("bytes", "lost", "rebuilt", "damaged")},
        arrival_t=arrivals[:, 0],
        arrival_ms=_within(arrivals[:, 1], bound_ms),
    )


def _within(ms: FloatSeries, bound_ms: FloatSeries) -> FloatSeries:
    """Latencies that are negative only within their bound; nan where a clock was set between capture and arrival."""
    return np.where(ms < -float(np.nanmax(bound_ms, initial=0.0)) - 1000 * STEP_S, np.nan, np.maximum(ms, 0.0))


def _sent(sent: Sequence[tuple[float, CameraTelemetry]]) -> Sent:
    t = np.array([t for t, _ in sent], dtype=float)
    frames = counted(np.array([camera.frames for _, camera in sent], dtype=float))
    sizes = counted(np.array([camera.bytes for _, camera in sent], dtype=float))
    return Sent(t, frames, sizes, rate(t, sizes))


def _settled(t: FloatSeries, kbps: FloatSeries, frames: FloatSeries) -> FloatSeries:
    """A rate that is nan until its window has filled with video twice: the first includes the backlog."""
    receiving = t[frames > 0]
    return np.where(t >= (receiving[0] if receiving.size else np.inf) + 2 * RATE_WINDOW_S, kbps, np.nan)


def counted(counter: FloatSeries) -> FloatSeries:
    """A running counter that continues where the logged one restarted from 0."""
    if not counter.size:
        return counter
    steps = np.diff(counter)
    return np.asarray(np.cumsum(np.append(counter[0], np.where(steps < 0, counter[1:], steps))))


def rate(t: FloatSeries, sizes: FloatSeries) -> FloatSeries:
    """kbit/s at each time over the second before, from a running counter of bytes; nan in the first second."""
    before = np.searchsorted(t, t - RATE_WINDOW_S + 1e-6, "right") - 1
    known = before >= 0
    first = np.maximum(before, 0)
    seconds = np.where(known, t - t[first], 1.0)
    return np.where(known, (sizes - sizes[first]) * 8 / 1000 / seconds, np.nan)


# --- panels -----------------------------------------------------------------------------------------------------------


def panels(cameras: Mapping[str, Any]) -> tuple[Panel, ...]:
    """Split cameras into panels: those that look along the road, and those pitched down at the surroundings.

    cameras  the configuration's, with `pose` and `place` if they are mounted
    returns  one or two panels, cameras in the configuration's order

    On the paper's vehicle these are the front- and rear-mounted ones and the top views, as in its figures. If pitch
    makes no difference, up to four cameras share one panel; more are split in half, in the order of their tiles.
    """
    down = [name for name, camera in cameras.items() if (camera.get("pose") or {}).get("pitch_deg", 0) >= DOWN_DEG]
    along = [name for name in cameras if name not in down]
    if down and along:
        return _panel(along), _panel(down)
    if len(cameras) <= PANEL_CAMERAS:
        return (_panel(cameras),)
    tiles = sorted(cameras, key=lambda name: _tile(cameras[name]))
    half = (len(tiles) + 1) // 2
    return _panel(tiles[:half]), _panel(tiles[half:])


def _tile(camera: Mapping[str, Any]) -> tuple[int, int]:
    place = camera.get("place") or {}
    return place.get("row", 0), place.get("column", 0)


def _panel(names: Iterable[str]) -> Panel:
    """Named after the prefixes of the cameras' names, or after its only camera."""
    cameras = tuple(names)
    if len(cameras) == 1:
        return Panel(cameras[0], cameras)
    kinds = list(dict.fromkeys(name.partition("_")[0] for name in cameras))
    return Panel(" and ".join([", ".join(kinds[:-1]), kinds[-1]] if kinds[1:] else kinds).capitalize(), cameras)
