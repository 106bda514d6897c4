"""What the operator's side measures a few times a second."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from runner.core.model import Count, NonNegative, Share
from runner.records import Amount, Number, Time
from runner.records.vehicle import EncoderCounts, Position


@dataclass(frozen=True, slots=True)
class LatencyStages:
    """Parts of the latency from capture to decoding, ms, each of a recently sampled picture; None: unknown.

    capture  to the encoder's input on the vehicle, with conversion, cropping and scaling
    encode   through the encoder
    link     from there to the operator's side: the remainder. The only part that depends on the clocks, accurate to
             within `clock_bound_ms`
    buffer   in the jitter buffer
    decode   from the complete access unit to its picture
    """

    capture: float | None = None
    encode: float | None = None
    link: float | None = None
    buffer: float | None = None
    decode: float | None = None


@dataclass(frozen=True, slots=True)
class CameraSample(EncoderCounts):
    """Reception of one camera. Rates cover the last second, counters run since the start.

    fps         frames received, Hz
    kbps        encoded video received, kbit/s
    allocated_kbps, demand_kbps, scaling  as the vehicle has decided; None while the camera is off or nothing is known
    width, height  of the decoded picture, px; 0 before the first
    lost        RTP packets that never arrived
    frames, bytes  access units received, and their size, not those that the encoder has put out
    damaged     frames whose picture shows packet loss, until it is healed
    buffer_ms   how long a picture waits for retransmitted packets, ms; None: no retransmission
    foreign     packets from senders other than the vehicle, dropped
    rebuilt     how often the receiver's pipeline was rebuilt
    latency_ms  capture to decode of the last sampled frame, ms; None: unknown
    stages_ms   the parts of it
    arrivals    in a log, of each access unit since the previous sample: time, s, and ms since its capture if known

    Latencies are accurate to within the sample's `clock_bound_ms`.
    """

    fps: NonNegative
    kbps: NonNegative
    allocated_kbps: Amount
    demand_kbps: Amount
    scaling: Number | None
    width: Count
    height: Count
    latency_ms: float | None
    lost: Count
    rebuilt: Count
    damaged: Count
    stages_ms: LatencyStages
    arrivals: tuple[tuple[float, float | None], ...]
    foreign: Count = 0
    buffer_ms: Count | None = None


@dataclass(frozen=True, slots=True)
class Sample:
    """What the operator's side measures a few times a second.

    predicted_kbps  as in `Telemetry`
    allocated_kbps  sum over the cameras, kbit/s
    actual_kbps     received in the last second, sum over the cameras, kbit/s
    refused         as in `Telemetry`
    cameras         what was received, by camera
    dropped         invalid messages on the control link
    speed_factor    as in `SpeedAdvice`; None: not advised
    clock_ahead_ms  how far the vehicle's clock is ahead, ms; None: unknown, as are all latencies
    clock_bound_ms  maximum error of that and of each latency, ms; None: unknown. Older logs lack it: there
                    `clock_ahead_ms` was derived from negative latencies, and latencies are differences of both clocks
    """

    t: Time
    predicted_kbps: Amount | None
    allocated_kbps: Amount
    actual_kbps: NonNegative
    position: Position | None
    refused: Count
    cameras: Mapping[str, CameraSample]
    dropped: Count = 0
    clock_ahead_ms: float | None = None
    clock_bound_ms: NonNegative | None = None
    speed_factor: Share | None = None
