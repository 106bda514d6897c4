"""Measures the uplink: reception reports in, `link_measured` out. Shared by live runs and replay. Pure."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from itertools import repeat
from operator import attrgetter

from msgspec import UNSET

from runner.core.budget import on_the_wire
from runner.core.events import LinkMeasured
from runner.core.evidence import EvidenceMemory, LinkReport, ReceivedUnit, observe, rounded, summarise
from runner.core.model import Graph, Vehicle, exact
from runner.records.reception import ReceptionReport, ReceptionReported, UnitReceived
from runner.vehicle.operators import PRESENT_S

ROUND_TRIPS = 64  # remembered; the smallest is the round trip
LONGEST_S = 60.0  # upper limit of a reported round trip


class MeasuredUplinks:
    """Measures each uplink of a vehicle."""

    def __init__(self, vehicle: Vehicle) -> None:
        self._each = {name: MeasuredUplink(vehicle, name) for name in vehicle.uplinks or ("",)}

    def of(self, report: ReceptionReport) -> MeasuredUplink | None:
        """The one that a report is about; None: the vehicle has no such uplink."""
        return self._each.get("" if report.uplink is UNSET else report.uplink)

    def take(self, reported: ReceptionReported) -> LinkMeasured | None:
        """See `MeasuredUplink.take`."""
        own = self.of(reported.report)
        return own.take(reported) if own else None


@dataclass
class MeasuredUplink:
    """Measures an uplink by what the operator in control receives. Another operator or process begins anew.

    name  "": the vehicle's only one
    """

    vehicle: Vehicle
    name: str = ""
    _source: tuple[str, object] = ("", None)  # operator, and its run
    _at: float = 0.0
    _t: float = 0.0
    _memory: EvidenceMemory = field(default_factory=EvidenceMemory)
    _round_trips: deque[float] = field(default_factory=lambda: deque(maxlen=ROUND_TRIPS))

    def is_rival(self, reported: ReceptionReported) -> bool:
        """Whether another process of the operator in control, which reports, too, made this report."""
        operator, run = self._source
        is_other = reported.operator == operator and reported.report.run != run
        return reported.in_control and is_other and reported.t - self._t < PRESENT_S

    def take(self, reported: ReceptionReported) -> LinkMeasured | None:
        """The event that results from a report; None: nothing has arrived, or it is not of the process in control."""
        if not reported.in_control or self.is_rival(reported):
            return None
        source = (reported.operator, reported.report.run)
        if source != self._source or reported.report.at < self._at:
            self._source, self._memory = source, EvidenceMemory()
            self._round_trips.clear()
        self._at, self._t = reported.report.at, reported.t
        self._round_trips.append(max(0.0, reported.t - reported.report.as_of))
        self._memory, evidence = observe(self._memory, _on_the_wire(self.vehicle, reported))
        if evidence is None:
            return None
        summary = summarise(self._memory, evidence)
        return LinkMeasured(
            t=reported.t,
            uplink=self.name,
            kbps=exact(round(summary.kbps, 1)),
            queue_ms=round(1000 * summary.queue_s, 1),
            loss=round(summary.loss, 4),
            state=summary.state,
            rtt_ms=round(1000 * min(*self._round_trips, LONGEST_S), 1),
            evidence=rounded(evidence),
        )


def _on_the_wire(vehicle: Vehicle, reported: ReceptionReported) -> LinkReport:
    """The report with packet headers added; units of unknown cameras are omitted."""
    report = reported.report
    late_s = repeat(0.0) if reported.late_s is UNSET else reported.late_s
    units = [
        _unit(vehicle.cameras[unit.camera].graph, report.at, unit, late)
        for unit, late in zip(report.units, late_s, strict=False)
        if unit.camera in vehicle.cameras
    ]
    arrived = tuple(sorted(units, key=attrgetter("arrived")))
    return LinkReport(report.at, arrived, report.packets, report.lost, reported.all_received is True)


def _unit(graph: Graph, at: float, unit: UnitReceived, late: float) -> ReceivedUnit:
    header = graph.settings.header_bytes
    return ReceivedUnit(
        unit.camera,
        unit.captured(at),
        at - unit.ago_s,
        on_the_wire(graph, unit.bytes),
        unit.whole,
        graph.settings.srt_latency_ms / 1000,
        late,
        unit.train_s,
        unit.train_bytes + unit.train_packets * header,
        unit.carried_bytes + unit.carried_packets * header,
    )
