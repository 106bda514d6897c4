"""Bitrate predictions (pQoS): sources of `BitratePredicted` in front of the pure core.

The paper reads its predictions from a pre-recorded bandwidth map by GPS position (section V). No clock, no threads,
no log here: time comes from the events, and a file is read only while a source is built. Rates are kbit/s.
NumPy is loaded with the first file: a vehicle that receives predictions and positions live does not need it.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from random import Random
from typing import TYPE_CHECKING, Any, Protocol

from runner.core.events import BitratePredicted, Event
from runner.core.model import Kbps, ModelError, exact
from runner.pqos.settings import find_file, find_path, number, within

if TYPE_CHECKING:
    from runner.pqos.table import Column
    from runner.pqos.track import Track


class Pqos(Protocol):
    """A source of predictions, fed with every event of the run."""

    @property
    def warnings(self) -> tuple[str, ...]:
        """Suspicious findings about map or positions, for the caller to log; more may appear while running."""

    def observe(self, event: Event) -> BitratePredicted | None:
        """The prediction that follows from this event, stamped with the event's own t; None: nothing new."""


class TimedPqos:
    """Predicts by time alone: when the value changes, and again every `period_s` so that it does not go stale."""

    warnings: tuple[str, ...] = ()

    def __init__(self, kbps_at: Callable[[float], Kbps], period_s: float) -> None:
        self._kbps_at, self._period_s = kbps_at, period_s
        self._last: BitratePredicted | None = None

    def observe(self, event: Event) -> BitratePredicted | None:
        kbps, last = self._kbps_at(event.t), self._last
        # A nanosecond of tolerance: five steps of 0.1 s are half a second.
        if last and last.kbps == kbps and event.t - last.t < self._period_s - 1e-9:
            return None
        self._last = BitratePredicted(t=event.t, kbps=kbps)
        return self._last


class LivePqos:
    """Predicts nothing: predictions arrive as events through the control link."""

    warnings: tuple[str, ...] = ()

    def observe(self, event: Event) -> BitratePredicted | None:
        return None


class WrongPqos:
    """Distorts the predictions of a source, for experiments.

    share   factor applied to the rate
    late_s  delay of every prediction, s
    noise   deviation of the logarithm of another factor, drawn for each second; the same in every drive
    silent  predict nothing
    """

    def __init__(self, source: Pqos, share: Kbps, late_s: float, noise: float, silent: bool) -> None:
        self._source, self._share, self._late_s, self._noise, self._silent = source, share, late_s, noise, silent
        self._waiting: deque[BitratePredicted] = deque()

    @property
    def warnings(self) -> tuple[str, ...]:
        return self._source.warnings

    def observe(self, event: Event) -> BitratePredicted | None:
        """The newest prediction whose delay has passed."""
        prediction = self._source.observe(event)
        if prediction and not self._silent:
            self._waiting.append(prediction)
        due = None
        while self._waiting and self._waiting[0].t + self._late_s <= event.t + 1e-9:
            due = self._waiting.popleft()
        if due is None:
            return None
        share = self._share * self._factor(int(due.t))
        lower = None if due.lower_kbps is None else due.lower_kbps * share
        return replace(due, t=event.t, kbps=due.kbps * share, lower_kbps=lower)

    def _factor(self, second: int) -> Kbps:
        return exact(round(Random(second).lognormvariate(0, self._noise), 4)) if self._noise else Kbps(1)


class Predictions:
    """All sources of a vehicle, by uplink; "" is for all together."""

    def __init__(self, sources: Mapping[str, Pqos]) -> None:
        self._sources = sources

    @property
    def warnings(self) -> Iterator[str]:
        """Of all sources, see `Pqos`."""
        for uplink, source in self._sources.items():
            yield from (f"uplink {uplink}: {warning}" if uplink else warning for warning in source.warnings)

    def observe(self, event: Event) -> Iterator[BitratePredicted]:
        """The predictions that follow from an event."""
        for uplink, source in self._sources.items():
            prediction = source.observe(event)
            if prediction is not None:
                yield replace(prediction, uplink=uplink) if uplink else prediction


def trace(path: Path, loop: bool, off_trace: Kbps | None, column: Column | None = None) -> Callable[[float], Kbps]:
    """Rate in force at a time: that of the last row up to it; `off_trace` before the first row and after the end.

    With `off_trace` None, the first and the last rate apply there.

    path    CSV with t_s (never decreasing) and a rate; its last row lasts as long as the one before, then a loop begins
    column  of the file in place of the rate
    """
    from runner.pqos.table import RATE, TIME, read_table

    table = read_table(path, (TIME, column or RATE))
    if len(table) < 2:
        raise ModelError("file", path, "must have at least two rows, otherwise the duration of a rate is unknown")
    times, rates = table[:, 0].tolist(), [exact(rate) for rate in table[:, 1].tolist()]
    begin, end = times[0], 2 * times[-1] - times[-2]

    def kbps_at(t: float) -> Kbps:
        if t < begin or (t >= end and not loop):
            return off_trace if off_trace is not None else rates[0 if t < begin else -1]
        return rates[bisect_right(times, t if t < end else begin + (t - begin) % (end - begin)) - 1]

    return kbps_at


def build_pqos(settings: Mapping[str, Any], bases: Sequence[Path]) -> Pqos:
    """The source of predictions that the `pqos` section of a configuration describes.

    settings  the composed section: kind and the keys of that kind (schemas/pqos.schema.json)
    bases     directories in which a relative file is looked up, first match wins
    raises    ModelError with the key, the value found and the rule
    """
    source, wrong = _source(settings, bases), settings.get("wrong")
    if not wrong:
        return source
    share, late_s, noise = exact(wrong.get("share", 1)), float(wrong.get("late_s", 0)), float(wrong.get("noise", 0))
    return WrongPqos(source, share, late_s, noise, wrong.get("silent", False))


def _source(settings: Mapping[str, Any], bases: Sequence[Path]) -> Pqos:
    match kind := settings.get("kind"):
        case "map":
            from runner.pqos.bandwidth_map import BandwidthMap
            from runner.pqos.on_map import MapPqos
            from runner.pqos.table import read_errors, read_map

            path = find_file(settings, "file", bases)
            lon, lat, kbps = read_map(path).T
            points = BandwidthMap(lat, lon, kbps, number(settings, "radius_m", positive=True), read_errors(path))
            look_ahead_s, off_map = number(settings, "look_ahead_s"), exact(number(settings, "off_map_kbps"))
            valid_s = None if settings.get("valid_s") is None else number(settings, "valid_s", positive=True)
            return MapPqos(points, look_ahead_s, off_map, valid_s)
        case "trace":
            path, off_trace = find_file(settings, "file", bases), exact(number(settings, "off_trace_kbps"))
            kbps_at = trace(path, bool(settings.get("loop")), off_trace)
            return TimedPqos(kbps_at, number(settings, "period_s", positive=True))
        case "constant":
            constant = exact(number(settings, "kbps"))
            return TimedPqos(lambda _: constant, number(settings, "period_s", positive=True))
        case "live":
            return LivePqos()
    raise ModelError("kind", kind, "must be map, trace, constant or live")


def build_track(settings: Mapping[str, Any], bases: Sequence[Path]) -> Track | None:
    """The drive that `position` in the `pqos` section describes; None: positions arrive as events.

    settings  the composed section; bases: directories in which a relative file is looked up
    raises    ModelError with the key, the value found and the rule
    """
    position = settings.get("position") or {"kind": "live"}
    loop = bool(position.get("loop"))
    match kind := position.get("kind"):
        case "route":
            if settings.get("kind") != "map":
                raise ModelError("position.kind", kind, "needs kind: map, whose points it drives through", "kind")
            with within("position"):
                speed = number(position, "speed_mps", positive=True)
            from runner.pqos.table import read_map
            from runner.pqos.track import track_on_map

            return track_on_map(read_map(find_file(settings, "file", bases)), speed, loop)
        case "track":
            with within("position"):
                path = find_path(position, "file", bases)
                from runner.bag import is_bag
                from runner.pqos.track import read_track, track_of_bag

                if is_bag(path):
                    return track_of_bag(path, position.get("topic"), loop)
                return read_track(find_file(position, "file", bases), loop)
        case "live":
            return None
    raise ModelError("position.kind", kind, "must be route, track or live")
