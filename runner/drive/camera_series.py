"""What was decided for, sent by and received from one camera, over time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import pairwise
from typing import Any

import numpy as np
from msgspec import UNSET

from runner.drive.time_series import EMPTY, Flags, FloatSeries, TimeSeries, counted, rate, settled
from runner.records.decisions import CameraDecision
from runner.records.operator import CameraSample, Sample
from runner.records.vehicle import CameraTelemetry
from runner.system.clocks import STEP_S


@dataclass(frozen=True, slots=True)
class DecidedSeries:
    """The decisions for one camera, each entry in force until the next.

    roi_share  pixels of the region of interest over those of the full image
    scaling    nan while the camera is off
    fps        Hz, nan where it is the camera's own
    """

    t: FloatSeries
    sending: Flags
    kbps: FloatSeries
    scaling: FloatSeries
    width: FloatSeries
    height: FloatSeries
    roi_share: FloatSeries
    reason: tuple[str, ...]
    fps: FloatSeries


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

    def sent_fps(self, t: FloatSeries) -> FloatSeries:
        """Hz at which its pictures were to be sent at these times."""
        stated = np.concatenate([[np.nan], self.decided.fps])[np.searchsorted(self.decided.t, t, "right")]
        return np.where(np.isnan(stated), self.fps, stated)


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


def camera_series(
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
        fps=np.array([np.nan if camera.fps is UNSET else camera.fps for _, camera in decided], dtype=float),
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
        kbps=settled(t, column("kbps"), frames),
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
