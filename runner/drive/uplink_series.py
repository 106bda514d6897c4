"""Each of several uplinks over time. Pure.

Bitrates are kbit/s, times s; `nan` is unknown.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from msgspec import UNSET

from runner.core.events import LinkMeasured, LinkState
from runner.drive.believed_series import BelievedSeries, Decisions, believed_series
from runner.drive.time_series import TimeSeries, counted
from runner.records.operator import CameraSample, Sample
from runner.records.vehicle import UplinkMeasured

GAP_S = 1.0  # between two measurements: nothing is known in between
NAN = float("nan")

Measured = Sequence[tuple[float, LinkMeasured | UplinkMeasured]]
Samples = Sequence[tuple[float, Sample]]


class Arrived(NamedTuple):
    """RTP packets of all cameras by one uplink; see `runner.records.reception.UplinkReceived`."""

    packets: int = 0
    lost: int = 0
    twins: int = 0


@dataclass(frozen=True, slots=True)
class UplinkSeries:
    """One of several uplinks.

    allowed   kbit/s of all cameras and copies on it, a step function
    received  kbit/s over it, with packet headers
    queue_ms  standing queue in front of it; nan while it is stalled
    loss      share of the packets of the last second
    stalls    (start, duration), s, while nothing arrived over it
    came, left  how often a camera moved to it, and from it
    arrived   None: no operator logged
    believed  None: no rule believed anything of it
    """

    allowed: TimeSeries
    received: TimeSeries
    queue_ms: TimeSeries
    loss: TimeSeries
    stalls: tuple[tuple[float, float], ...]
    came: int
    left: int
    arrived: Arrived | None
    believed: BelievedSeries | None


def uplink_series(
    decisions: Decisions, measured: Iterable[tuple[float, LinkMeasured]], samples: Samples
) -> Mapping[str, UplinkSeries]:
    """By uplink; none if there is one.

    measured  by the vehicle; without it, what the samples repeat of it
    """
    decided = [(t, line.uplinks, line) for t, line in decisions if line.uplinks is not UNSET]
    found: dict[str, list[tuple[float, LinkMeasured | UplinkMeasured]]] = {
        name: [] for _, uplinks, _ in decided for name in uplinks
    }
    if not found:
        return {}
    for name, t, each in [(each.uplink, t, each) for t, each in measured] or _repeated(samples):
        found.setdefault(name, []).append((t, each))
    moves = list(_moves(decisions))
    return {
        name: UplinkSeries(
            TimeSeries.of((t, uplinks[name].total_kbps if name in uplinks else None) for t, uplinks, _ in decided),
            _line(each, [float(link.kbps) for _, link in each]),
            _line(each, [NAN if _is_stalled(link) else link.queue_ms for _, link in each]),
            _line(each, [link.loss for _, link in each]),
            tuple(_stalls(each)),
            sum(to == name for _, to in moves),
            sum(of == name for of, _ in moves),
            _arrived(name, samples) if samples else None,
            believed_series(decisions, name),
        )
        for name, each in found.items()
    }


def _repeated(samples: Samples) -> list[tuple[str, float, UplinkMeasured]]:
    return [
        (name, t, each) for t, sample in samples if sample.uplinks is not UNSET for name, each in sample.uplinks.items()
    ]


def _line(measured: Measured, values: Sequence[float]) -> TimeSeries:
    """Values over time, with `nan` in gaps."""
    t = np.array([at for at, _ in measured], dtype=float)
    gaps = np.flatnonzero(np.diff(t) > GAP_S) + 1
    return TimeSeries(np.insert(t, gaps, t[gaps - 1]), np.insert(np.array(values, dtype=float), gaps, NAN))


def _is_stalled(link: LinkMeasured | UplinkMeasured) -> bool:
    return link.state is LinkState.STALLED


def _stalls(measured: Measured) -> Iterator[tuple[float, float]]:
    began: float | None = None
    for t, link in measured:
        if _is_stalled(link):
            began = t if began is None else began
        elif began is not None:
            yield began, t - began
            began = None
    if began is not None:
        yield began, measured[-1][0] - began


def _moves(decisions: Decisions) -> Iterator[tuple[str, str]]:
    """The uplinks from which and to which a camera moved, of those with one of their own."""
    for (_, before), (_, line) in pairwise(decisions):
        for name, camera in line.cameras.items():
            was = before.cameras[name].uplinks if name in before.cameras else UNSET
            if was is not UNSET and camera.uplinks is not UNSET and was[0] != camera.uplinks[0]:
                yield was[0], camera.uplinks[0]


def _arrived(uplink: str, samples: Samples) -> Arrived:
    cameras = dict.fromkeys(name for _, sample in samples for name in sample.cameras)
    lines = [[sample.cameras[name] for _, sample in samples if name in sample.cameras] for name in cameras]
    return Arrived(*(sum(_count(uplink, key, each) for each in lines) for key in Arrived._fields))


def _count(uplink: str, key: str, samples: Sequence[CameraSample]) -> int:
    """How far a counter of a camera has come, which begins anew with each pipeline."""
    known = [each.received[uplink] for each in samples if each.received is not UNSET and uplink in each.received]
    values = counted(np.array([getattr(each, key) for each in known], dtype=float))
    return int(values[-1]) if values.size else 0
