"""A drive in figures: bitrates, latencies, freezes, losses, estimated quality. Pure.

Means over time are taken while the operator received, or while the vehicle sent if no operator logged. `nan` stands
for unknown values; in JSON it is null.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from runner.drive.camera_series import CameraSeries, ReceivedSeries, sending_spans
from runner.drive.latency import NAN, UNKNOWN, Freeze, Latency, concatenated, freezes, latency
from runner.drive.predictions import Worth, compared, worth
from runner.drive.quality_file import DeliveredQuality
from runner.drive.seen_file import SeenDrive
from runner.drive.series import Series
from runner.drive.time_series import RATE_WINDOW_S, Flags, FloatSeries, TimeSeries, held, mean, mean_held, ratio, spans
from runner.drive.uplink_statistics import UplinkStatistics, uplink_statistics
from runner.rate_quality.curves import interpolated
from runner.records.vehicle import SLOW, SLOW_S

SAMPLED_S = 0.25  # as the operator samples bitrates


class RateCurve(NamedTuple):
    """Measured quality of one factor: kbit/s out of the encoder, increasing, and the quality."""

    kbps: FloatSeries
    quality: FloatSeries


@dataclass(frozen=True, slots=True)
class Model:
    """Quality by a rate-quality model: one curve per factor, in units of the metric."""

    metric: str
    curves: Mapping[float, RateCurve]


@dataclass(frozen=True, slots=True)
class Estimate:
    """Estimated quality of one camera over time, of each picture compared with the scene that it shows.

    While a picture is frozen it keeps the quality it had. Its growing difference from the scene is not
    included: that would require the pictures. So `mean` is an upper bound, reached if nothing moves, and means little
    without the share of the time in which pictures were frozen (`CameraStatistics.frozen`).

    line     in units of the metric; nan while nothing was shown, the rate is unknown or the factor was not measured
    moving   mean over the time in which pictures moved
    clamped  share of the values while pictures moved at bitrates outside the measured ones, where the nearest is used
    unknown  factors in force that are not in the model
    """

    metric: str
    line: TimeSeries
    moving: float
    clamped: float
    unknown: tuple[float, ...]

    @property
    def mean(self) -> float:
        return mean(self.line.y)


@dataclass(frozen=True, slots=True)
class CameraStatistics:
    """One camera over a drive.

    sending_s         time during which it should have been sending, s
    kbps, allocated   means, kbit/s; share: the first over the second
    factors           share of the time by factor, 0 for off or paused
    sizes             share of the time by size of the picture, px
    arrival, decode   latency from capture to arrival, and to decode, ms
    freezes           None if arrivals were not logged
    frozen            share of `sending_s` in which the picture was frozen; nan if arrivals were not logged
    lost, rebuilt     packets, pipelines; None if no operator logged
    damaged           share of the frames whose picture shows a loss; nan if unknown
    quality           None without a rate-quality model
    delivered         measured on the pictures; None if it was not measured
    """

    name: str
    frames: int
    hz: float
    sending_s: float
    kbps: float
    allocated: float
    share: float
    factors: Mapping[float, float]
    sizes: Mapping[tuple[int, int], float]
    arrival: Latency
    decode: Latency
    freezes: tuple[Freeze, ...] | None
    frozen: float
    lost: int | None
    rebuilt: int | None
    damaged: float
    quality: Estimate | None
    delivered: DeliveredQuality | None


@dataclass(frozen=True, slots=True)
class DriveStatistics:
    """A drive: its cameras, and all of them together.

    predictions  what they were worth; None: nothing was predicted, or believed of the link, for long enough
    uplinks      by name; none if there is one
    seen         what the driver saw; None if it was not measured
    """

    series: Series
    cameras: Mapping[str, CameraStatistics]
    kbps: float
    allocated: float
    share: float
    predicted_min: float
    predicted_max: float
    arrival: Latency
    decode: Latency
    freezes: int | None
    frozen_s: float | None
    lost: int | None
    rebuilt: int | None
    damaged: float
    frozen: float
    metric: str
    quality: float
    moving: float
    delivered: float
    delivered_worst: float
    predictions: Worth | None
    uplinks: Mapping[str, UplinkStatistics]
    notes: tuple[str, ...]
    seen: SeenDrive | None = None


def statistics(
    drive: Series,
    models: Mapping[str, Model] | None = None,
    delivered: Mapping[str, DeliveredQuality] | None = None,
    seen: SeenDrive | None = None,
) -> DriveStatistics:
    """All figures of a drive.

    models     by camera, if there is one
    delivered  by camera, quality measured on its pictures, if it was
    seen       what the driver saw, if it was measured
    """
    models, delivered = models or {}, delivered or {}
    cameras = {
        name: camera_statistics(c, drive.end, models.get(name), delivered.get(name))
        for name, c in drive.cameras.items()
    }
    delivered_means = [camera.delivered.mean for camera in cameras.values() if camera.delivered]
    means = np.array([value for value in delivered_means if value is not None])
    each = list(cameras.values())
    received = [c.received for c in drive.cameras.values() if c.received]
    clock_bound = received[0].bound_ms if received else UNKNOWN  # of all: they share the vehicle's clock
    estimates = [camera.quality for camera in each if camera.quality]
    metrics = {estimate.metric for estimate in estimates}
    known = drive.predicted.y[np.isfinite(drive.predicted.y)]
    both = compared(drive)
    known_worth = worth(both) if both else None
    frozen = [freeze for camera in each for freeze in camera.freezes or ()]
    watched = any(camera.freezes is not None for camera in each)
    kbps, allocated = (sum_known(getattr(camera, key) for camera in each) for key in ("kbps", "allocated"))
    return DriveStatistics(
        series=drive,
        cameras=cameras,
        kbps=kbps,
        allocated=allocated,
        share=ratio(kbps, allocated),
        predicted_min=float(np.min(known)) if known.size else NAN,
        predicted_max=float(np.max(known)) if known.size else NAN,
        arrival=latency(concatenated(got.arrival_ms for got in received), clock_bound),
        decode=latency(concatenated(got.latency_ms for got in received), clock_bound),
        freezes=len(frozen) if watched else None,
        frozen_s=sum(freeze.seconds for freeze in frozen) if watched else None,
        frozen=ratio(sum(freeze.seconds for freeze in frozen), sum(c.sending_s for c in each if c.freezes is not None)),
        lost=_sum(camera.lost for camera in each),
        rebuilt=_sum(camera.rebuilt for camera in each),
        damaged=ratio(sum(float(got.damaged[-1]) for got in received), sum(float(got.frames[-1]) for got in received)),
        metric=next(iter(metrics)) if len(metrics) == 1 else "",
        quality=mean(np.array([e.mean for e in estimates])) if len(metrics) == 1 else NAN,
        moving=mean(np.array([e.moving for e in estimates])) if len(metrics) == 1 else NAN,
        delivered=mean(means),
        delivered_worst=float(means.min()) if means.size else NAN,
        predictions=known_worth,
        uplinks=uplink_statistics(drive.uplinks, drive.end),
        notes=tuple(_notes(drive, cameras, known_worth)),
        seen=seen,
    )


def camera_statistics(
    camera: CameraSeries, end: float, model: Model | None = None, delivered: DeliveredQuality | None = None
) -> CameraStatistics:
    source, received, decided = camera.received or camera.sent, camera.received, camera.decided
    begin, until = (float(source.t[0]), float(source.t[-1])) if source else (0.0, end)
    sending = [(max(a, begin), min(b, until)) for a, b in sending_spans(decided, end)]
    sending_s = sum(max(0.0, b - a) for a, b in sending)
    frames = float(source.frames[-1] - source.frames[0]) if source else NAN
    kbps = ratio(float(source.bytes[-1] - source.bytes[0]) * 8 / 1000, until - begin) if source else NAN
    allocated = mean_held(TimeSeries(decided.t, np.where(decided.sending, decided.kbps, 0.0)), begin, until)
    frozen_spans = tuple(freezes(received.arrival_t, sending)) if received and _arrivals_logged(received) else None
    return CameraStatistics(
        name=camera.name,
        frames=int(source.frames[-1]) if source else 0,
        hz=ratio(frames, sending_s),
        sending_s=sending_s,
        kbps=kbps,
        allocated=allocated,
        share=ratio(kbps, allocated),
        factors=factor_shares(camera, begin, until),
        sizes=size_shares(camera, begin, until),
        arrival=latency(received.arrival_ms, received.bound_ms) if received else Latency(),
        decode=latency(received.latency_ms, received.bound_ms) if received else Latency(),
        freezes=frozen_spans,
        frozen=NAN if frozen_spans is None else ratio(sum(freeze.seconds for freeze in frozen_spans), sending_s),
        lost=int(received.lost[-1]) if received else None,
        rebuilt=int(received.rebuilt[-1]) if received else None,
        damaged=ratio(float(received.damaged[-1]), float(received.frames[-1])) if received else NAN,
        quality=estimate(camera, model, frozen_spans or (), None if source else end) if model else None,
        delivered=delivered,
    )


def _arrivals_logged(received: ReceivedSeries) -> bool:
    """Whether arrivals were logged; False if there are frames but no arrivals."""
    return bool(received.arrival_t.size) or not received.frames[-1]


def _notes(drive: Series, cameras: Mapping[str, CameraStatistics], predictions: Worth | None) -> Iterable[str]:
    """Missing data, and caveats of the quality estimates."""
    if not drive.measured:
        yield "neither sent nor received video was logged: bitrates and quality are those of what was allocated"
    if predictions:
        yield f"predictions: {predictions.words}"
    if drive.positions is None:
        yield "no positions were logged: not drawn on the map"
    for camera in drive.cameras.values():
        if slow := slow_time(camera, drive.end):
            yield f"{camera.name}: {slow[1]:.0f} of {camera.fps:g} Hz for {slow[0]:.0f} s"
    estimated = {name: camera.quality for name, camera in cameras.items() if camera.quality}
    frozen = ", ".join(f"{name} {_percentage(cameras[name].frozen)}" for name in estimated if cameras[name].frozen > 0)
    if frozen:
        rule = "a frozen picture counts as its last frame, whatever moves in the scene: an upper bound"
        yield f"estimated quality: {rule}; frozen {frozen} of the time"
    unseen = [name for name, camera in cameras.items() if camera.delivered and not camera.delivered.clip]
    if unseen:
        names = ", ".join(unseen)
        yield f"quality delivered: {names} compared with the stream as sent: what the encoder lost is not included"
    clamped = ", ".join(f"{name} {_percentage(q.clamped)}" for name, q in estimated.items() if q.clamped > 0)
    if clamped:
        yield f"estimated quality: bitrates outside the measured range, the nearest one used: {clamped} of the time"
    for name, quality in estimated.items():
        if quality.unknown:
            factors = ", ".join(f"{factor:g}" for factor in quality.unknown)
            yield f"{name}: its rate-quality model was not measured at the factors {factors}, no estimate for them"
    if len({quality.metric for quality in estimated.values()}) > 1:
        yield "the rate-quality models of the cameras use different metrics: no quality of the whole drive"


def _percentage(share: float) -> str:
    return f"{share:.0%}" if share >= 0.01 else "<1%"


def slow_time(camera: CameraSeries, end: float) -> tuple[float, float] | None:
    """For how long the camera was slow, s, and the mean rate meanwhile, Hz; None: it was not.

    As the vehicle sent it, else as it was received.
    """
    source = camera.sent or camera.received
    if source is None or not camera.fps > 0:
        return None
    t, frames = source.t, source.frames
    before = np.maximum(np.searchsorted(t, t - SLOW_S, "right") - 1, 0)
    begin, until = np.array(sending_spans(camera.decided, end)).reshape(-1, 2).T[..., None]
    sending = ((t[before] >= begin) & (t <= until)).any(0)
    hz = (frames - frames[before]) / np.maximum(t - t[before], SLOW_S)
    fps = np.minimum(camera.sent_fps(t[before]), camera.sent_fps(t))
    slow = sending & (t - t[before] >= SLOW_S) & (hz > 0) & (hz < SLOW * fps)
    seconds = float(np.diff(t, prepend=t[:1])[slow].sum())
    return (seconds, float(hz[slow].mean())) if seconds >= SLOW_S else None


# --- shares of time ---------------------------------------------------------------------------------------------------


def factor_shares(camera: CameraSeries, begin: float, end: float) -> dict[float, float]:
    """Share of the time in which each factor was in force, increasing; 0 stands for off or paused."""
    decided = camera.decided
    factors = np.where(decided.sending & np.isfinite(decided.scaling), decided.scaling, 0.0)
    return _shares([float(factor) for factor in factors], spans(decided.t, begin, end))


def size_shares(camera: CameraSeries, begin: float, end: float) -> dict[tuple[int, int], float]:
    """Share of the time by size of the picture received, or of the one decided if no operator logged, px."""
    received, decided = camera.received, camera.decided
    t, width, height = (
        (received.t, received.width, received.height) if received else (decided.t, decided.width, decided.height)
    )
    shares = _shares([(int(w), int(h)) for w, h in zip(width, height, strict=True)], spans(t, begin, end))
    return {size: share for size, share in shares.items() if size[0]}


def _shares(keys: Sequence[Any], weights: FloatSeries) -> dict[Any, float]:
    total = float(weights.sum())
    found: dict[Any, float] = {}
    for key, weight in zip(keys, weights, strict=True):
        if weight > 0:
            found[key] = found.get(key, 0.0) + float(weight) / total
    return dict(sorted(found.items()))


# --- quality ----------------------------------------------------------------------------------------------------------


def rate_curves(document: Mapping[str, Any]) -> Model:
    """The curves of a model file, see schemas/rate_quality.schema.json."""
    metric = document["metric"]
    groups: dict[float, list[tuple[float, float]]] = {}
    for point in document["points"]:
        if metric in point and point["actual_kbps"] > 0:
            groups.setdefault(round(point["scaling"], 6), []).append((point["actual_kbps"], point[metric]))
    return Model(metric, {factor: _rate_curve(group) for factor, group in groups.items()})


def _rate_curve(points: Sequence[tuple[float, float]]) -> RateCurve:
    """Of bitrate and quality; of points at one bitrate, as of an encoder that cannot use more, the mean."""
    kbps, quality = np.array(points).T
    distinct, index = np.unique(kbps, return_inverse=True)
    return RateCurve(distinct, np.bincount(index, quality) / np.bincount(index))


def estimate(
    camera: CameraSeries, model: Model, frozen_spans: Sequence[Freeze] = (), allocated_until: float | None = None
) -> Estimate:
    """Quality of a camera's pictures by its rate-quality model.

    At each sample: the curve of the factor in force, at the actual bitrate as the full image would have it at the same
    bits per pixel (paper, left side of Eq. 4), between measured points as `model` draws it.

    frozen_spans     when the picture was frozen: it keeps the quality it had before, see `Estimate`
    allocated_until  end of a drive of which only decisions are known: allocated bitrates are taken
    """
    t, kbps = camera.actual if allocated_until is None else _sampled(camera.allocated, allocated_until)
    decided = camera.decided
    factors = np.round(held(TimeSeries(decided.t, np.where(decided.sending, decided.scaling, np.nan)), t), 6)
    full = kbps / held(TimeSeries(decided.t, decided.roi_share), t)
    quality, outside, unknown = np.full(t.shape, np.nan), np.zeros(t.shape, dtype=bool), []
    for factor in np.unique(factors[np.isfinite(factors)]):
        at = (factors == factor) & (full > 0)
        if factor not in model.curves:
            unknown.append(float(factor))
            continue
        curve = model.curves[factor]
        quality[at] = interpolated(curve.kbps, curve.quality, full[at])
        outside[at] = (full[at] < curve.kbps[0]) | (full[at] > curve.kbps[-1])
    moving = np.ones(t.shape, dtype=bool)
    for freeze in frozen_spans:
        _hold_quality(quality, moving, t, freeze)
    known = np.isfinite(quality) & moving
    clamped = ratio(int((outside & known).sum()), int(known.sum()))
    return Estimate(model.metric, TimeSeries(t, quality), mean(quality[moving]), clamped, tuple(unknown))


def _sampled(line: TimeSeries, end: float) -> TimeSeries:
    """A step function at regular times."""
    t = np.arange(0.0, end, SAMPLED_S)
    return TimeSeries(t, held(line, t))


def _hold_quality(quality: FloatSeries, moving: Flags, t: FloatSeries, freeze: Freeze) -> None:
    """Let a frozen picture keep the quality it had, if any.

    Rates cover a second: for a second after a freeze they include part of it, or a backlog that had built up.
    """
    end = freeze.t + freeze.seconds
    during = (t > freeze.t) & (t <= end)
    before = np.flatnonzero(np.isfinite(quality) & (t <= freeze.t) & (t > freeze.t - 2 * RATE_WINDOW_S))
    quality[during] = quality[before[-1]] if before.size else NAN
    quality[(t > end) & (t < end + RATE_WINDOW_S)] = NAN
    moving[during] = False


# --- helpers ----------------------------------------------------------------------------------------------------------


def sum_known(values: Iterable[float]) -> float:
    """Sum of the known values; nan if there are none."""
    known = [value for value in values if not math.isnan(value)]
    return sum(known) if known else NAN


def _sum(values: Iterable[int | None]) -> int | None:
    known = [value for value in values if value is not None]
    return sum(known) if known else None
