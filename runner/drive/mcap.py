"""A drive as MCAP (https://mcap.dev) for Foxglove: logs and video on one clock."""

from __future__ import annotations

import heapq
import json
import math
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, NamedTuple

from msgspec import UNSET

from runner.core.events import NAMES, Event, PositionReported
from runner.core.events import to_json as event_to_json
from runner.drive.captures import SECOND_NS, FilmedFile, ReadVideo, files
from runner.drive.read import Drive, Side
from runner.errors import RunError
from runner.records import KINDS, Json, Note, Position, Record, Sample, line_to_json
from runner.schema import referred

if TYPE_CHECKING:
    from runner.apply import Unit

TELL_EVERY = 500  # messages between two reports of progress
# Topic by kind of line. Notes become foxglove.Log, positions also foxglove.LocationFix, videos CompressedVideo.
TOPICS = {
    "decision": "/decision",
    "telemetry": "/telemetry",
    "state": "/operator/state",
    "sample": "/operator/sample",
    "link": "/link",
}
VIDEO_TOPICS = {"vehicle": "/{camera}/video", "operator": "/{camera}/video_received"}


class McapMessage(NamedTuple):
    """A message to write, and its time.

    ns  since 1970
    """

    ns: int
    write: Callable[[], None]


def write_mcap(
    drive: Drive,
    file: BinaryIO,
    read_video: ReadVideo,
    on_warning: Callable[[str], None],
    progress: Callable[[float], None] = lambda done: None,
) -> int:
    """Write all of a drive in time order, in compressed chunks with checksums.

    file        receives the bytes
    read_video  yields the pictures of a file
    on_warning  called with a line about each omission
    progress    called now and then with the share done
    returns     number of messages
    raises      RunError if the file cannot be written
    """
    import foxglove
    from foxglove.mcap import MCAPCompression, MCAPWriteOptions

    context, out = foxglove.Context(), _Out(file)
    options = MCAPWriteOptions(compression=MCAPCompression.Zstd, profile="tod-runner")
    count = 0
    with foxglove.open_mcap(out, context=context, writer_options=options) as writer:
        channels = _Channels(context, _cameras(drive))
        for name, side in drive.sides.items():
            writer.write_metadata(f"{name} began", _texts(line_to_json(side.began)))
        first, last = _span(drive)
        for message in heapq.merge(*_streams(drive, channels, read_video, on_warning), key=lambda m: m.ns):
            message.write()
            out.check()
            count += 1
            if count % TELL_EVERY == 0:
                progress(min(1.0, (message.ns - first) / max(1, last - first)))
    out.check()
    progress(1.0)
    return count


class _Out:
    """The file as the writer sees it, which never fails: `check` raises the error where it can be handled."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._failed: OSError | None = None

    def write(self, data: bytes | bytearray) -> int:
        try:
            if self._failed is None:
                self._file.write(data)
        except OSError as error:
            self._failed = error
        return len(data)

    def seek(self, offset: int, whence: int = 0) -> int:
        return self._file.seek(offset, whence)

    def flush(self) -> None:
        try:
            if self._failed is None:
                self._file.flush()
        except OSError as error:
            self._failed = error

    def check(self) -> None:
        if self._failed:
            raise RunError(f"the MCAP file cannot be written: {self._failed.strerror or self._failed}")


class _Channels:
    """The topics, each created with its first message."""

    def __init__(self, context: Any, cameras: Iterable[str]) -> None:
        self._context, self._cameras = context, list(cameras)
        self._made: dict[str, Any] = {}

    def tell(self, topic: str, schema: str, definition: str, line: Json, ns: int) -> None:
        """Write a line of JSON, with the schema definition that it satisfies."""
        if topic not in self._made:
            self._made[topic] = self._json_channel(topic, schema, definition)
        self._made[topic].log(json.dumps(line, ensure_ascii=False).encode(), log_time=ns)

    def fix(self, position: Position, ns: int) -> None:
        from foxglove.channels import LocationFixChannel
        from foxglove.messages import LocationFix, Vector3

        velocity, angle = None, None
        speed = None if position.speed_mps is UNSET else position.speed_mps
        if position.heading_deg is not UNSET:
            angle = math.radians(position.heading_deg)
            velocity = Vector3(x=(speed or 0.0) * math.sin(angle), y=(speed or 0.0) * math.cos(angle), z=0.0)
        fix = LocationFix(
            timestamp=_timestamp(ns),
            frame_id="gps",
            latitude=position.lat,
            longitude=position.lon,
            heading=angle,
            velocity=None if speed is None else velocity,
        )
        self._typed("/position", LocationFixChannel).log(fix, log_time=ns)

    def note(self, side: str, text: str, ns: int) -> None:
        from foxglove.channels import LogChannel
        from foxglove.messages import Log, LogLevel

        log = Log(timestamp=_timestamp(ns), level=LogLevel.Info, name=side, message=text)
        self._typed("/notes", LogChannel).log(log, log_time=ns)

    def picture(self, topic: str, camera: str, unit: Unit, ns: int) -> None:
        from foxglove.channels import CompressedVideoChannel
        from foxglove.messages import CompressedVideo

        video = CompressedVideo(timestamp=_timestamp(ns), frame_id=camera, data=unit.data, format=unit.codec)
        self._typed(topic, CompressedVideoChannel).log(video, log_time=ns)

    def _typed(self, topic: str, kind: Any) -> Any:
        if topic not in self._made:
            self._made[topic] = kind(topic, context=self._context)
        return self._made[topic]

    def _json_channel(self, topic: str, schema: str, definition: str) -> Any:
        import foxglove

        text = json.dumps(standalone({"$ref": f"#/$defs/{definition}"}, schema, self._cameras))
        known = foxglove.Schema(name=f"tod_runner.{definition}", encoding="jsonschema", data=text.encode())
        return foxglove.Channel(topic, schema=known, message_encoding="json", context=self._context)


def standalone(schema: Any, home: str, cameras: Iterable[str]) -> Any:
    """A schema without references, and with the cameras by name, so that Foxglove offers each number for plots.

    home  name of the schema that it is a part of
    """
    if isinstance(schema, list):
        return [standalone(part, home, cameras) for part in schema]
    if not isinstance(schema, dict):
        return schema
    if "$ref" in schema:
        return standalone(*referred(schema["$ref"], home), cameras)
    whole = {key: standalone(part, home, cameras) for key, part in schema.items()}
    by_camera = whole.get("properties", {}).get("cameras")
    if by_camera and isinstance(by_camera.get("additionalProperties"), dict):
        each = by_camera["additionalProperties"]
        by_camera |= {"properties": dict.fromkeys(cameras, each), "additionalProperties": False}
    return whole


def _streams(
    drive: Drive, channels: _Channels, read_video: ReadVideo, on_warning: Callable[[str], None]
) -> Iterator[Iterator[McapMessage]]:
    """Messages by source, each in time order."""
    for name, side in drive.sides.items():
        # If the vehicle did not log, the operator's log has its positions.
        yield _lines(name, side, channels, positions="vehicle" not in drive.sides)
        for camera, filmed in files(side).items():
            yield _pictures(drive.path, VIDEO_TOPICS[name], camera, filmed, channels, read_video, on_warning)


def _lines(name: str, side: Side, channels: _Channels, positions: bool) -> Iterator[McapMessage]:
    began = round(side.began_s * SECOND_NS)
    for line in side.lines:
        ns = began + round(line.t * SECOND_NS)
        for write in _writers(name, line, channels, positions, ns):
            yield McapMessage(ns, write)


def _writers(
    name: str, line: Event | Record, channels: _Channels, positions: bool, ns: int
) -> Iterator[Callable[[], None]]:
    """The messages of one line."""
    if isinstance(line, Event):
        event = NAMES[type(line)]
        yield lambda: channels.tell(f"/events/{event}", "event", event, event_to_json(line), ns)
        if isinstance(line, PositionReported):
            yield lambda: channels.fix(Position.of(line), ns)
        return
    kind = KINDS[type(line)]
    if isinstance(line, Note):
        yield lambda: channels.note(name, line.text, ns)
    elif kind in TOPICS:
        yield lambda: channels.tell(TOPICS[kind], "drive", kind, line_to_json(line), ns)
    if isinstance(line, Sample) and positions and (position := line.position):
        yield lambda: channels.fix(position, ns)


def _pictures(
    directory: Path,
    topic: str,
    camera: str,
    filmed: list[FilmedFile],
    channels: _Channels,
    read_video: ReadVideo,
    on_warning: Callable[[str], None],
) -> Iterator[McapMessage]:
    """The frames of one camera on one side, at their capture times."""
    topic = topic.format(camera=camera)
    last = -1
    for file in filmed:
        if file.lies_outside:
            on_warning(f"{file.name}: lies outside the drive and was left out")
            continue
        try:
            for unit in read_video(directory / file.name):
                # A rebuilt pipeline begins after the previous one has ended, but clocks may be set.
                last = max(file.captured(unit.after_ns), last + 1)
                yield McapMessage(last, lambda u=unit, ns=last: channels.picture(topic, camera, u, ns))  # type: ignore[misc]
        except RunError as error:
            more = "the rest of it" if last >= file.captured(0) else "it"
            on_warning(f"{error}; the export continues without {more}")


def _cameras(drive: Drive) -> list[str]:
    named = (camera for side in drive.sides.values() for camera in side.began.config.get("cameras", {}))
    return list(dict.fromkeys(named))


def _span(drive: Drive) -> tuple[int, int]:
    """Start and end of the drive, ns since 1970."""
    began = [side.began_s for side in drive.sides.values()]
    ended = [side.began_s + line.t for side in drive.sides.values() for line in side.lines[-1:]]
    return round(min(began) * SECOND_NS), round(max([*began, *ended]) * SECOND_NS)


def _texts(began: Json) -> dict[str, str]:
    """Metadata holds texts only."""
    return {key: value if isinstance(value, str) else json.dumps(value) for key, value in began.items()}


def _timestamp(ns: int) -> Any:
    from foxglove.messages import Timestamp

    return Timestamp(sec=ns // SECOND_NS, nsec=ns % SECOND_NS)
