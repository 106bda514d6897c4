"""What has left the vehicle and arrived at the operator's side, and its reports of that to the vehicle."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, NamedTuple

from msgspec import UNSET, UnsetType

from runner.core.limits import Count, Limits, NonNegative
from runner.core.view import Seen
from runner.records import Clock, Time

Size = Annotated[int, Limits(0, 10**8)]  # bytes or packets of a report
Span = Annotated[float, Limits(0, 3600)]
Packets = Annotated[int, Limits(0, 10**9)]


class Arrival(NamedTuple):
    """Arrival of an encoded frame.

    arrived   of its last packet, s by this machine's monotonic clock
    captured  s by the vehicle's clock; from an arbitrary origin if the transport carries only the RTP timestamp
    whole     whether no packet of it was initially missing
    first     as `arrived`, of its first packet, by the kernel; None: the kernel does not state both
    """

    arrived: float
    captured: float
    bytes: int
    whole: bool = True
    first: float | None = None


ArrivedPacket = tuple[float, int]  # s by this machine's monotonic clock, bytes without headers; there are thousands a s


class SentFrame(NamedTuple):
    """A frame that a camera's payloader has output, seen by looking now and then; s since 1970 by the vehicle's clock.

    unsent  when the camera was last seen sending an older one
    sent    when it was first seen sending this one
    """

    captured: float
    unsent: float
    sent: float


@dataclass(frozen=True, slots=True)
class UplinkSent:
    """RTP packets of a camera over an uplink.

    packets  that it was to send, to each viewer
    bytes    that the system has taken
    errors   how often the system has refused to send some of them, or RTCP
    """

    packets: Count = 0
    bytes: Count = 0
    errors: Count = 0

    def plus(self, other: UplinkSent) -> UplinkSent:
        return UplinkSent(self.packets + other.packets, self.bytes + other.bytes, self.errors + other.errors)


@dataclass(frozen=True, slots=True)
class UplinkReceived:
    """RTP packets of a camera that have come by an uplink.

    packets  all of them, also those that were requested again
    lost     missing among them: what this uplink alone would have lost. A gap of more than 1 s is none: by then the
             camera was carried by others alone, or nothing arrived
    twins    came after their copies by other uplinks
    late     came more than 1 s after newer ones, and were dropped
    """

    packets: Count = 0
    lost: Count = 0
    twins: Count = 0
    late: Count = 0


class UplinkArrivals(NamedTuple):
    """Of one camera by one uplink, since the last call; see `Arrivals`."""

    frames: Sequence[Arrival] = ()
    arrived: Sequence[ArrivedPacket] = ()
    packets: int = 0
    lost: int = 0


class Arrivals(NamedTuple):
    """What the operator's side has received since the last call.

    frames         by camera, without waiting for missing packets
    newest         by camera, the newest access unit that has left the jitter buffer
    packets, lost  RTP packets of all cameras received, and initially missing
    damaged        cameras whose newest picture shows unrecovered packet loss
    arrived        packets of all cameras, those of `frames` and maybe later ones, repeated ones included; in no order
    """

    frames: Mapping[str, Sequence[Arrival]]
    newest: Mapping[str, Arrival]
    packets: int = 0
    lost: int = 0
    damaged: Sequence[str] = ()
    arrived: Sequence[ArrivedPacket] = ()

    def of(self, cameras: Mapping[str, UplinkArrivals]) -> Arrivals:
        """What one uplink alone has delivered, by camera; of pictures, which all share, the same."""
        return self._replace(
            frames={name: each.frames for name, each in cameras.items()},
            packets=sum(each.packets for each in cameras.values()),
            lost=sum(each.lost for each in cameras.values()),
            arrived=[packet for each in cameras.values() for packet in each.arrived],
        )


NOTHING_ARRIVED = Arrivals({}, {})


class UnitReceived(NamedTuple):
    """A frame as the operator's side received it; a list in JSON, since there are hundreds a second.

    delay_s  s from its capture, by the vehicle's clock, to that arrival; minus a constant, since clocks differ
    train_packets, train_bytes  what arrived in that time of all cameras, repeated packets included, without the first
             packet; 0: it was one packet, or the transport does not tell
    carried_packets, carried_bytes  what arrived of all cameras after the last packet of the previous unit and until the
             last packet of this one, repeated packets included; 0: the transport does not tell
    """

    camera: str
    ago_s: Annotated[Span, "s from the arrival of its last packet to the report"]
    delay_s: Clock
    bytes: Annotated[Size, "without packet headers"]
    whole: Annotated[bool, "whether no packet of it was initially missing"] = True
    train_s: Annotated[Span, "s from the arrival of its first packet to that of its last"] = 0.0
    train_packets: Size = 0
    train_bytes: Size = 0
    carried_packets: Size = 0
    carried_bytes: Size = 0

    @classmethod
    def of(
        cls, camera: str, frame: Arrival, at: float, base_s: float, train: tuple[int, int], carried: tuple[int, int]
    ) -> UnitReceived:
        """As a report made at a time says it; delays are less by base_s."""
        ago_s, delay_s = round(at - frame.arrived, 4), round(frame.arrived - frame.captured - base_s, 4)
        train_s = 0.0 if frame.first is None else round(frame.arrived - frame.first, 5)
        return cls(camera, ago_s, delay_s, frame.bytes, frame.whole, train_s, *train, *carried)

    def captured(self, at: float) -> float:
        """When it was captured, if the report was made then."""
        return at - self.ago_s - self.delay_s


@dataclass(frozen=True, slots=True)
class ReceptionReport:
    """What the operator's side has received since its previous report; the vehicle estimates the uplink from it.

    packets, lost  RTP packets of all cameras received, and initially missing: some may have been recovered
    latency_ms     upper bound of the age of the oldest displayed picture, capture to decoding, ms; absent: unknown
    damaged        cameras whose newest picture shows unrecovered packet loss; absent: none
    sent           s since 1970 by the operator's clock; present if the vehicle should answer with a `ClockAnswer`
    uplink         whose packets these are, and which the vehicle estimates; absent: it has one, without a name
    run            random number of this run of the operator's side, to which delays and times are relative
    view           what this process shows, by camera; those not named: in full. Absent: as it last stated, if it has
                   done so within 2 s, otherwise all in full
    """

    at: Annotated[Clock, "s, by the operator's monotonic clock"]
    as_of: Annotated[Clock, "s, the operator's estimate of the vehicle's time, see `runner.vehicle.operators`"]
    units: Annotated[tuple[UnitReceived, ...], Limits(most=2000), "in order of arrival"]
    packets: Packets
    lost: Packets
    latency_ms: Annotated[float, Limits(0, 10**12)] | UnsetType = UNSET
    damaged: Annotated[tuple[str, ...], Limits(most=1000, unique=True)] | UnsetType = UNSET
    sent: Clock | UnsetType = UNSET
    run: Annotated[int, Limits(0, 2**32 - 1)] | UnsetType = UNSET
    uplink: str | UnsetType = UNSET
    view: Annotated[Mapping[str, Seen], Limits(most=1000)] | UnsetType = UNSET
    offset_s: Annotated[Clock | UnsetType, "the constant that delays are less by, s; absent: no unit"] = UNSET


@dataclass(frozen=True, slots=True)
class ReceptionReported:
    """A reception report that arrived at the vehicle at t.

    late_s        of each unit: s by which the vehicle at least took longer than usual to send it; absent: none was late
    all_received  nothing was on its way when the report was made; absent: unknown, or not so, or the report has units
    """

    t: Time
    operator: Annotated[str, "id of its sender"]
    in_control: Annotated[bool, "whether that operator was in control; only its reports are used"]
    report: ReceptionReport
    late_s: Annotated[tuple[NonNegative, ...], Limits(most=2000)] | UnsetType = UNSET
    all_received: bool | UnsetType = UNSET
