"""Reception reports: what has arrived since the last one, for the vehicle, which estimates the uplink from them."""

from __future__ import annotations

from msgspec import UNSET, UnsetType

from runner.core.view import View
from runner.operator.latency import Latency
from runner.operator.packet_count import PacketCount
from runner.records.reception import Arrivals, ReceptionReport, UnitReceived


class ReceptionReports:
    """Makes the reports of one run of the operator's side; in one thread.

    run     identifies them
    uplink  what they are about; "": the vehicle has one
    """

    def __init__(self, run: int, latency: Latency, uplink: str = "") -> None:
        self._run, self._latency, self._uplink = run, latency, uplink
        self._packets = PacketCount()
        self._delay_s: float | None = None  # of the first access unit: reported delays are relative to it

    def make(
        self, arrivals: Arrivals, now: float, as_of: float | None, view: View | UnsetType = UNSET
    ) -> ReceptionReport | None:
        """The next report.

        as_of  the vehicle's time; None: it cannot be reached, so that there is no report of these arrivals
        view   what this process shows of the cameras, if it is due
        """
        self._latency.add_newest(arrivals.newest, now)
        frames = [(name, frame) for name, some in arrivals.frames.items() for frame in some]
        frames.sort(key=lambda each: each[1].arrived)
        if frames and self._delay_s is None:
            self._delay_s = frames[0][1].arrived - frames[0][1].captured
        base = self._delay_s or 0.0
        self._packets.add(arrivals.arrived)
        received = []
        for name, frame in frames:  # in order of arrival, as `carried` needs them
            train = self._packets.between(frame.first or frame.arrived, frame.arrived)
            received.append(UnitReceived.of(name, frame, now, base, train, self._packets.carried(frame.arrived)))
        if as_of is None:
            return None
        latency_ms, sent = self._latency.worst_ms(now), self._latency.ask_clock(now)
        return ReceptionReport(
            round(now, 4),
            as_of,
            tuple(received),
            arrivals.packets,
            arrivals.lost,
            latency_ms=UNSET if latency_ms is None else round(latency_ms, 1),
            damaged=tuple(arrivals.damaged) or UNSET,
            sent=UNSET if sent is None else sent,
            run=self._run,
            uplink=self._uplink or UNSET,
            view=view,
            offset_s=round(base, 4) if received else UNSET,
        )
