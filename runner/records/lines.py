"""Lines of a drive's log: all their kinds, and those that nothing publishes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

import msgspec
from msgspec import UNSET, UnsetType

from runner.core.limits import Count, Limits, NonNegative
from runner.records import CameraName, Json, Time, from_json, to_json
from runner.records.decisions import DecisionMade
from runner.records.operator import Sample
from runner.records.reception import ReceptionReported
from runner.records.vehicle import Offline, Telemetry, VehicleState

Since1970 = Annotated[float, Limits(0, 2**32 - 1)]
File = Annotated[str, "relative to the directory of the drive"]


@dataclass(frozen=True, slots=True)
class Began:
    """First line of a log: side, versions and configuration.

    replayed  words of the replay that decided it anew, without input and output; absent: it was driven
    """

    t: Time
    side: Annotated[str, Limits(among=("vehicle", "operator", "link")), "who wrote it"]
    format: Annotated[int, Limits(1), "version of the format"]
    time: Annotated[Since1970, "its start, s since 1970"]
    versions: Annotated[Mapping[str, str], "of the software in use, by name"]
    config: Annotated[Mapping[str, Any], "the composed configuration"]
    replayed: tuple[str, ...] | UnsetType = UNSET


@dataclass(frozen=True, slots=True)
class Note:
    """A note for the user."""

    t: Time
    text: Annotated[str, "one sentence"]


@dataclass(frozen=True, slots=True)
class VideoBegan:
    """A video file has started."""

    t: Time
    camera: CameraName
    file: File
    captured: Annotated[Since1970, "capture time of its first frame, s since 1970"]


@dataclass(frozen=True, slots=True)
class LosslessBegan:
    """A file with whole pictures of a camera, without loss, has started (`log.lossless`)."""

    t: Time
    camera: CameraName
    file: File
    captured: Annotated[Since1970, "capture time of its first picture, s since 1970"]


@dataclass(frozen=True, slots=True)
class VideoShifted:
    """From a frame on, the offset of times in a video file changes, by a pause or a receiver that smooths them."""

    t: Time
    camera: CameraName
    file: File
    after_s: Annotated[NonNegative, "s from the file's first frame to this one, by the file"]
    captured: Annotated[Since1970, "capture time of this one, s since 1970"]


@dataclass(frozen=True, slots=True)
class SoundReceived:
    """Packets of the vehicle's sound, as they arrived since the line before (`log.sound=true`).

    packets  of each, when its first sample was captured, s since 1970 by the vehicle's clock, if known; Opus, base64
    """

    t: Time
    packets: tuple[tuple[float | None, str], ...]


@dataclass(frozen=True, slots=True)
class LinkSample:
    """State of the limited link between the sides; counters run since it was made."""

    t: Time
    kbps: Annotated[NonNegative, "rate in force, kbit/s; 0 while a lane is cut"]
    queue_ms: Annotated[NonNegative, "how long a packet that arrives now waits, ms"]
    bytes: Annotated[Count, "forwarded from vehicle to operator"]
    packets: Annotated[Count, "forwarded from vehicle to operator"]
    dropped: Annotated[Count, "packets that its queue dropped"]
    lost: Annotated[Count, "packets lost after the queue, at random or while it was cut"] = 0
    tcp_bytes: Annotated[Count, "that competing TCP flows have delivered, without headers"] = 0
    lane: Annotated[str, "name of the lane; absent: the link has none"] | UnsetType = UNSET


@dataclass(frozen=True, slots=True)
class ClockSet:
    """The wall clock of this side's machine was set; `t` does not follow it."""

    t: Time
    by_s: Annotated[float, Limits(1 - 2**32, 2**32 - 1), "how far forward, s"]


@dataclass(frozen=True, slots=True)
class LinesDropped:
    """Lines were not written because the disk was too slow."""

    t: Time
    lines: Annotated[int, Limits(1), "their number"]


@dataclass(frozen=True, slots=True)
class Ended:
    """Last line of a log that was closed."""

    t: Time


Record = (
    Began
    | DecisionMade
    | Telemetry
    | VehicleState
    | Offline
    | Sample
    | ReceptionReported
    | Note
    | VideoBegan
    | LosslessBegan
    | VideoShifted
    | SoundReceived
    | LinkSample
    | ClockSet
    | LinesDropped
    | Ended
)

KINDS: dict[type[Any], str] = {  # value of a line's key `log`
    Began: "began",
    DecisionMade: "decision",
    Telemetry: "telemetry",
    VehicleState: "state",
    Offline: "state",
    Sample: "sample",
    ReceptionReported: "reception",
    Note: "note",
    VideoBegan: "video",
    LosslessBegan: "lossless",
    VideoShifted: "video_shift",
    SoundReceived: "sound",
    LinkSample: "link",
    ClockSet: "clock_set",
    LinesDropped: "dropped",
    Ended: "ended",
}


def line_to_json(record: Record) -> Json:
    """A record as a log line."""
    document = to_json(record)
    return {"t": document.pop("t"), "log": KINDS[type(record)], **document}


def line_from_json(document: Mapping[str, Any]) -> Record:
    """The record described by a log line that satisfies its schema."""
    kind = _BY_KIND[document["log"]]
    kind = Offline if kind is VehicleState and not document["online"] else kind
    try:
        record: Record = from_json(kind, document)
    except msgspec.ValidationError:  # to a schema, 1920.0 is a whole number, too
        record = msgspec.convert(document, kind, strict=False)
    return record


_BY_KIND: dict[str, type[Any]] = {name: kind for kind, name in KINDS.items() if kind is not Offline}
