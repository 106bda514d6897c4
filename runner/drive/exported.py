"""The messages of an exported drive, in any format: log lines and pictures, in time order."""

from __future__ import annotations

import heapq
from base64 import b64decode
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, Protocol

from runner.core.events import NAMES, Event, PositionReported
from runner.core.events import to_json as event_to_json
from runner.drive.captures import ReadVideo, RecordedVideo, files
from runner.drive.read import Drive, Side
from runner.errors import RunError
from runner.records import Json
from runner.records.lines import KINDS, LinkSample, Note, Record, SoundReceived, line_to_json
from runner.records.operator import Sample
from runner.records.vehicle import Position
from runner.system.clocks import SECOND_NS

if TYPE_CHECKING:
    from runner.apply import Unit

REPORT_EVERY = 500  # messages between two reports of progress
# Topic by kind of line.
TOPICS = {
    "decision": "/decision",
    "telemetry": "/telemetry",
    "state": "/operator/state",
    "sample": "/operator/sample",
    "link": "/link",
}
VIDEO_TOPICS = {"vehicle": "/{camera}/video", "operator": "/{camera}/video_received"}


POSITION_TOPIC, NOTE_TOPIC, SOUND_TOPIC = "/position", "/notes", "/sound_received"


class ExportTarget(Protocol):
    """Receives the messages of an export. Times are ns since 1970, never decreasing."""

    def write_line(self, topic: str, schema: str, definition: str, line: Json, ns: int) -> None:
        """A line of a log, with the schema definition that it satisfies."""

    def write_position(self, position: Position, ns: int) -> None:
        """A position of the vehicle."""

    def note(self, side: str, line: Note, ns: int) -> None:
        """A note of a side."""

    def picture(self, topic: str, camera: str, unit: Unit, ns: int) -> None:
        """An access unit of a camera, captured then."""

    def sound(self, packet: bytes, ns: int) -> None:
        """An Opus packet of the vehicle's sound, captured then."""


class ExportMessage(NamedTuple):
    """A message to write, and its time.

    ns  since 1970
    """

    ns: int
    write: Callable[[], None]


def write_all(
    drive: Drive,
    target: ExportTarget,
    read_video: ReadVideo,
    on_warning: Callable[[str], None],
    on_progress: Callable[[float], None],
    check: Callable[[], None] = lambda: None,
) -> int:
    """Write all of a drive in time order.

    read_video  yields the pictures of a file
    on_warning  called with a line about each omission
    on_progress called every REPORT_EVERY messages with the share done
    check       called after each message
    returns     number of messages
    """
    count = 0
    first, last = _span(drive)
    for message in heapq.merge(*_streams(drive, target, read_video, on_warning), key=lambda m: m.ns):
        message.write()
        check()
        count += 1
        if count % REPORT_EVERY == 0:
            on_progress(min(1.0, (message.ns - first) / max(1, last - first)))
    on_progress(1.0)
    return count


def _streams(
    drive: Drive, target: ExportTarget, read_video: ReadVideo, on_warning: Callable[[str], None]
) -> Iterator[Iterator[ExportMessage]]:
    """Messages by source, each in time order."""
    for name, side in drive.sides.items():
        # Without a log of the vehicle, its positions are in the operator's log.
        yield _lines(name, side, target, positions="vehicle" not in drive.sides)
        yield _sound(side, target)
        for camera, recorded in files(side).items():
            yield _pictures(drive.path, VIDEO_TOPICS[name], camera, recorded, target, read_video, on_warning)


def _lines(name: str, side: Side, target: ExportTarget, positions: bool) -> Iterator[ExportMessage]:
    began = round(side.began_s * SECOND_NS)
    for line in side.lines:
        ns = began + round(line.t * SECOND_NS)
        for write in _writers(name, line, target, positions, ns):
            yield ExportMessage(ns, write)


def _writers(
    name: str, line: Event | Record, target: ExportTarget, positions: bool, ns: int
) -> Iterator[Callable[[], None]]:
    """The messages of one line."""
    if isinstance(line, Event):
        event = NAMES[type(line)]
        topic = _topic(f"/events/{event}", getattr(line, "uplink", ""))
        yield lambda: target.write_line(topic, "event", event, event_to_json(line), ns)
        if isinstance(line, PositionReported):
            yield lambda: target.write_position(Position.of(line), ns)
        return
    kind = KINDS[type(line)]
    if isinstance(line, Note):
        yield lambda: target.note(name, line, ns)
    elif kind in TOPICS:
        topic = _topic(TOPICS[kind], (line.lane or "") if isinstance(line, LinkSample) else "")
        yield lambda: target.write_line(topic, "drive", kind, line_to_json(line), ns)
    if isinstance(line, Sample) and positions and (position := line.position):
        yield lambda: target.write_position(position, ns)


def _topic(topic: str, name: str) -> str:
    """A topic, with the name of the uplink or lane that its lines are about, if there are several."""
    return f"{topic}/{name}" if name else topic


def _pictures(
    directory: Path,
    topic: str,
    camera: str,
    recorded: list[RecordedVideo],
    target: ExportTarget,
    read_video: ReadVideo,
    on_warning: Callable[[str], None],
) -> Iterator[ExportMessage]:
    """The frames of one camera on one side, at their capture times."""
    topic = topic.format(camera=camera)
    last = -1
    for file in recorded:
        if file.is_outside:
            on_warning(f"{file.name}: is outside the drive's directory and was left out")
            continue
        try:
            for unit in read_video(directory / file.name):
                # Files of a camera follow each other in time, but clocks may be set back.
                last = max(file.captured(unit.after_ns), last + 1)
                yield ExportMessage(last, lambda u=unit, ns=last: target.picture(topic, camera, u, ns))  # type: ignore[misc]
        except RunError as error:
            more = "the rest of it" if last >= file.captured(0) else "it"
            on_warning(f"{error}; the export continues without {more}")


def _sound(side: Side, target: ExportTarget) -> Iterator[ExportMessage]:
    """The vehicle's sound, at its capture times; where one is unknown, when it arrived."""
    last = -1
    for line in side.of(SoundReceived):
        for captured, packet in line.packets:
            at = side.began_s + line.t if captured is None else side.corrected(captured, line.t)
            last = max(round(at * SECOND_NS), last + 1)  # clocks may be set back
            yield ExportMessage(last, lambda p=packet, ns=last: target.sound(b64decode(p), ns))  # type: ignore[misc]


def cameras_of(drive: Drive) -> list[str]:
    return names_of(drive, "cameras")


def names_of(drive: Drive, key: str) -> list[str]:
    """What the configuration names under a key, on either side."""
    named = (name for side in drive.sides.values() for name in side.began.config.get(key) or {})
    return list(dict.fromkeys(named))


def _span(drive: Drive) -> tuple[int, int]:
    """Start and end of the drive, ns since 1970."""
    began = [side.began_s for side in drive.sides.values()]
    ended = [side.began_s + side.end for side in drive.sides.values()]
    return round(min(began) * SECOND_NS), round(max(ended) * SECOND_NS)
