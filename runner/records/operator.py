"""What the operator's side measures a few times a second."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

from msgspec import UNSET, UnsetType

from runner.core.limits import Count, NonNegative, Share
from runner.core.model import Roi
from runner.records import Amount, Number, Time
from runner.records.reception import UplinkReceived
from runner.records.vehicle import EncoderCounts, Position, UplinkMeasured


@dataclass(frozen=True, slots=True)
class LatencyStages:
    """Parts of the latency from capture to decoding, ms, each of a recently sampled picture; None: unknown."""

    capture: Annotated[float | None, "to the encoder's input on the vehicle, also conversion, crop and scaling"] = None
    encode: Annotated[float | None, "through the encoder"] = None
    link: Annotated[
        float | None, "from there to the operator's side: the remainder, accurate to within `clock_bound_ms`"
    ] = None
    buffer: Annotated[float | None, "in the jitter buffer"] = None
    decode: Annotated[float | None, "from the complete access unit to its picture"] = None


@dataclass(frozen=True, slots=True)
class CameraSample(EncoderCounts):
    """Reception of one camera. Rates cover the last second, counters run since the start.

    allocated_kbps, demand_kbps, scaling  as the vehicle has decided; None while the camera is off or nothing is known
    width, height  of the decoded picture, px; 0 before the first
    buffer_ms   how long a picture waits for retransmitted packets, ms; None: no retransmission
    arrivals    in a log, of each access unit since the previous sample: time, s, and ms since its capture if known
    regions     in a log, whenever pictures begin to show another part of the image, as H.264 pictures state it: time of
                arrival, s, and that part; at the beginning all of it. Absent: no change

    Latencies are accurate to within the sample's `clock_bound_ms`. Counts of the encoder alone are those of telemetry.
    """

    frames: Annotated[Count, "access units received"]
    bytes: Annotated[Count, "their size"]
    fps: Annotated[NonNegative, "frames received, Hz"]
    kbps: Annotated[NonNegative, "encoded video received, kbit/s"]
    allocated_kbps: Amount
    demand_kbps: Amount
    scaling: Number | None
    width: Count
    height: Count
    latency_ms: Annotated[float | None, "capture to decode of the last sampled frame, ms; None: unknown"]
    lost: Annotated[Count, "RTP packets that never arrived"]
    rebuilt: Annotated[Count, "how often the receiver's pipeline was rebuilt"]
    damaged: Annotated[Count, "frames whose picture shows packet loss, until it is healed"]
    stages_ms: Annotated[LatencyStages, "the parts of it"]
    arrivals: tuple[tuple[float, float | None], ...]
    foreign: Annotated[Count, "packets from senders other than the vehicle, dropped"] = 0
    buffer_ms: Count | None = None
    received: Annotated[
        Mapping[str, UplinkReceived] | UnsetType, "by uplink, since the pipeline was built; absent: there is one"
    ] = UNSET
    refused: Annotated[
        str | UnsetType, "why the vehicle refuses this operator its pictures, in words; absent: it does not"
    ] = UNSET
    regions: tuple[tuple[float, Roi], ...] | UnsetType = UNSET


@dataclass(frozen=True, slots=True)
class SoundSample:
    """Reception of the vehicle's sound; counters run since the start."""

    packets: Annotated[Count, "received"]
    bytes: Annotated[Count, "their payload"]
    lost: Annotated[Count, "packets that never arrived, or too late"]
    level_db: Annotated[float | None, "of the last quarter of a second, dB below full scale; None: nothing arrived"]
    latency_ms: Annotated[float | None, "capture to arrival of the newest packet, ms; None: unknown"]
    rebuilt: Annotated[Count, "how often the receiver's pipeline was rebuilt"] = 0
    foreign: Annotated[Count, "packets from senders other than the vehicle, dropped"] = 0
    fault: Annotated[str | UnsetType, "why its source does not open, in words; absent: it does"] = UNSET
    refused: Annotated[
        str | UnsetType, "why the vehicle refuses this operator the sound, in words; absent: it does not"
    ] = UNSET
    recorded: Annotated[bool, "whether the log of this side holds it"] = False


@dataclass(frozen=True, slots=True)
class Sample:
    """What the operator's side measures a few times a second."""

    t: Time
    predicted_kbps: Annotated[Amount | None, "as in `Telemetry`"]
    allocated_kbps: Annotated[Amount, "sum over the cameras, kbit/s"]
    actual_kbps: Annotated[NonNegative, "received in the last second, sum over the cameras, kbit/s"]
    position: Position | None
    refused: Annotated[Count, "as in `Telemetry`"]
    cameras: Annotated[Mapping[str, CameraSample], "what was received, by camera"]
    dropped: Annotated[Count, "invalid messages on the control link"] = 0
    clock_ahead_ms: Annotated[
        float | None, "how far the vehicle's clock is ahead, ms; None: unknown, as are all latencies"
    ] = None
    clock_bound_ms: Annotated[NonNegative | None, "maximum error of that and of each latency, ms; None: unknown"] = None
    speed_factor: Annotated[Share | None, "as in `SpeedAdvice`; None: not advised"] = None
    uplinks: Annotated[Mapping[str, UplinkMeasured] | UnsetType, "by uplink; absent: there is one"] = UNSET
    sound: Annotated[SoundSample | UnsetType, "absent: this side receives none"] = UNSET
