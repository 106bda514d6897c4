"""A bandwidth map from drives: what the link was believed to carry, and how far that varied. Pure.

In drives without a belief about the link, the received rate wherever the link was the bottleneck: it shows the
capacity only while more than that is sent; at all other times it shows how much was sent. A sample counts if packets
were lost or frames queued during its second, the measured link limited the total, and neither machine was held up,
which delays frames as a link does: its rate is then the capacity.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from runner.core.events import LEAST_ERROR
from runner.core.learned import WRONG
from runner.drive.believed_series import BelievedSeries
from runner.drive.series import Positions, Series
from runner.drive.time_series import Flags, FloatSeries, TimeSeries, held
from runner.pqos.bandwidth_map import offset

WINDOW_S = 1.0  # over which the rates of the samples are measured
QUEUED_MS = 50.0  # above the lowest latency of the drive: the queue in front of the link was filling
AFTER_S = 0.5  # after a side was held up: what had piled up is delivered
GAP_S = 2.0  # positions further apart say nothing about the time between
SURE = 0.2  # deviation, ln, of a belief that counts: there was evidence in the last second
USED = 0.99  # share of what the cameras can use: rounded, it is all
EVERY_S = 0.25  # between two samples of a belief
AGAIN_S = 10.0  # a square that is entered again after this time has been passed twice


class CapacitySample(NamedTuple):
    """Capacity of the link at a place: degrees, kbit/s of encoded video, s since the drive began."""

    lat: float
    lon: float
    kbps: float
    t: float = 0.0


class Cell(NamedTuple):
    """A square of the ground: mean position of its samples, a percentile of their rates (kbit/s), and their number.

    bias, error  mean of ln(rate / that percentile), and the deviation from it that is to be expected
    """

    lat: float
    lon: float
    kbps: float
    samples: int
    bias: float
    error: float


def capacity_problem(drive: Series, uplink: str = "") -> str | None:
    """Why a drive does not show the capacity of the link; None if it does.

    uplink  one of several; "": the vehicle has one
    """
    if problem := _uplink_problem(drive, uplink):
        return problem
    if _believed(drive, uplink):
        return None if drive.positions else "has no positions"
    if not any(camera.received for camera in drive.cameras.values()):
        return "has no operator's log"
    if not drive.measured_t.size:
        return "has no measurements of the link: needs the vehicle's log, and rules that measure it (modes=safe)"
    return None if drive.positions else "has no positions"


def _uplink_problem(drive: Series, uplink: str) -> str | None:
    if drive.uplinks and uplink not in drive.uplinks:
        return f"has the uplinks {', '.join(drive.uplinks)}: uplink=NAME chooses one"
    if uplink and not drive.uplinks:
        return f"has no uplink {uplink}: the vehicle had one"
    if uplink and not drive.uplinks[uplink].believed:
        return f"has nothing that was believed of uplink {uplink}: needs rules that measure it (modes=safe)"
    return None


def _believed(drive: Series, uplink: str) -> BelievedSeries | None:
    return drive.uplinks[uplink].believed if uplink else drive.believed


def sample_times(drive: Series, uplink: str = "") -> FloatSeries:
    """When the capacity of the link may have been known, s."""
    return np.arange(0.0, drive.end, EVERY_S) if _believed(drive, uplink) else drive.actual.t


def limited_samples(drive: Series, uplink: str = "") -> list[CapacitySample]:
    """The samples of a drive in which the capacity of the link was known; none if they cannot be determined."""
    if capacity_problem(drive, uplink) or drive.positions is None:
        return []
    t = sample_times(drive, uplink)
    if _believed(drive, uplink):
        return _samples(t, carried(drive, t, uplink), _positions_at(drive.positions, t))
    received = [camera.received for camera in drive.cameras.values() if camera.received]
    kbps = drive.actual.y
    limited = np.zeros(t.shape, dtype=bool)
    for camera in received:
        limited |= _lost(t, camera.t, camera.lost) | _queued(t, camera.arrival_t, camera.arrival_ms)
    limited &= _measured_limit(drive, t) & ~_held_up(drive, t)
    return _samples(t, np.where(limited, kbps, np.nan), _positions_at(drive.positions, t - WINDOW_S / 2))


def carried(drive: Series, t: FloatSeries, uplink: str = "") -> FloatSeries:
    """What the link was believed to carry at some times, kbit/s of video; nan where reports did not tell it.

    Where it carries all that the cameras can use, more cannot be known.
    """
    believed = _believed(drive, uplink)
    if believed is None:
        return np.full(t.shape, np.nan)
    kbps, deviation, usable = (
        held(TimeSeries(believed.t, y), t)
        for y in (np.fmin(believed.kbps, believed.policer_kbps), believed.deviation, believed.usable)
    )
    known = (deviation <= SURE) & (kbps < USED * usable) & ~_held_up(drive, t)
    return np.where(known, kbps, np.nan)


def _samples(t: FloatSeries, kbps: FloatSeries, places: tuple[FloatSeries, FloatSeries]) -> list[CapacitySample]:
    known = np.isfinite(kbps) & np.isfinite(places[0])
    rows = zip(*(each[known].tolist() for each in (*places, kbps, t)), strict=True)
    return [CapacitySample(*row) for row in rows]


def cells(samples: Iterable[CapacitySample], percentile: float, cell_m: float) -> list[Cell]:
    """Squares of the ground, in the order of their first samples.

    percentile  of the rates in a cell, 0 to 100: 10 is the rate that nine of ten samples reached
    cell_m      side of a square, m
    """
    found: dict[tuple[int, int], list[CapacitySample]] = {}
    first: CapacitySample | None = None
    for sample in samples:
        first = first or sample
        found.setdefault(_square(sample, first, cell_m), []).append(sample)
    return [_cell(inside, percentile) for inside in found.values()]


def _cell(inside: list[CapacitySample], percentile: float) -> Cell:
    lat, lon, rates, t = np.array(inside).T
    # The lower of two neighbours, since nothing was measured between them.
    kbps = float(np.percentile(rates, percentile, method="lower"))
    off = np.log(np.maximum(rates, 1.0) / max(kbps, 1.0))
    # One pass says little about the next: as if there had been another, with the error of what nobody has checked.
    passes = 1 + int(((np.diff(t) < 0) | (np.diff(t) > AGAIN_S)).sum())
    error = float(np.sqrt((WRONG**2 + passes * off.var()) / (passes + 1)))
    return Cell(lat.mean(), lon.mean(), kbps, len(inside), float(off.mean()), max(LEAST_ERROR, error))


def _square(sample: CapacitySample, origin: CapacitySample, cell_m: float) -> tuple[int, int]:
    """Column and row, on the plane around the first sample."""
    east, north = offset(origin.lat, origin.lon, sample.lat, sample.lon)
    return int(np.floor(east / cell_m)), int(np.floor(north / cell_m))


def _lost(at: FloatSeries, t: FloatSeries, lost: FloatSeries) -> Flags:
    """Whether packets were lost in the second before each time."""
    before = np.interp(at - WINDOW_S, t, lost)
    more: Flags = np.interp(at, t, lost) > before
    return more


def _queued(at: FloatSeries, t: FloatSeries, latency_ms: FloatSeries) -> Flags:
    """Whether half of the frames that arrived in the second before each time had been queued."""
    queued = np.zeros(at.shape, dtype=bool)
    if not np.isfinite(latency_ms).any():
        return queued
    late = latency_ms > np.nanmin(latency_ms) + QUEUED_MS
    ends, begins = np.searchsorted(t, at, "right"), np.searchsorted(t, at - WINDOW_S, "right")
    count = np.append(0, np.cumsum(late))
    frames = ends - begins
    queued[frames > 0] = (2 * (count[ends] - count[begins]) >= frames)[frames > 0]
    return queued


def _measured_limit(drive: Series, at: FloatSeries) -> Flags:
    """Whether the total was below what was asked for, and the link measured in the second before each time."""
    ends, begins = (np.searchsorted(drive.measured_t, t, "right") for t in (at, at - WINDOW_S))
    return np.asarray((held(drive.capped, at) == 1) & (ends > begins))


def _held_up(drive: Series, at: FloatSeries) -> Flags:
    """Whether a side was held up in the second before each time, or so shortly before that frames were still late."""
    found = np.zeros(at.shape, dtype=bool)
    for begin, end in drive.held_up:
        found |= (begin <= at) & (at - WINDOW_S - AFTER_S <= end)
    return found


def _positions_at(positions: Positions, t: FloatSeries) -> tuple[FloatSeries, FloatSeries]:
    """Degrees at each time; nan if no position is near."""
    after = np.searchsorted(positions.t, t).clip(1, max(1, len(positions.t) - 1))
    neighbours = positions.t[[after - 1, np.minimum(after, len(positions.t) - 1)]]
    far = np.abs(neighbours - t).min(axis=0) > GAP_S
    lat, lon = (np.interp(t, positions.t, values) for values in (positions.lat, positions.lon))
    return np.where(far, np.nan, lat), np.where(far, np.nan, lon)
