"""A drive as MCAP (https://mcap.dev) for Foxglove: logs and video on one clock."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING, Any, BinaryIO

from msgspec import UNSET

from runner.drive.captures import ReadVideo
from runner.drive.exported import NOTE_TOPIC, POSITION_TOPIC, SOUND_TOPIC, names_of, write_all
from runner.drive.read import Drive
from runner.errors import RunError, reason
from runner.records import Json
from runner.records.lines import Note, line_to_json
from runner.records.vehicle import Position
from runner.schema import referred
from runner.system.clocks import SECOND_NS

if TYPE_CHECKING:
    from runner.apply import Unit


BY_UPLINK = ("uplinks", "sent", "received")  # properties whose keys are uplinks


def write_mcap(
    drive: Drive,
    file: BinaryIO,
    read_video: ReadVideo,
    on_warning: Callable[[str], None],
    on_progress: Callable[[float], None] = lambda done: None,
) -> int:
    """Write all of a drive in time order, in compressed chunks with checksums.

    file        receives the bytes
    read_video  yields the pictures of a file
    on_warning  called with a line about each omission
    on_progress called every few hundred messages with the share done
    returns     number of messages
    raises      RunError if the file cannot be written
    """
    import foxglove
    from foxglove.mcap import MCAPCompression, MCAPWriteOptions

    context, out = foxglove.Context(), _Out(file)
    options = MCAPWriteOptions(compression=MCAPCompression.Zstd, profile="tod-runner")
    with foxglove.open_mcap(out, context=context, writer_options=options) as writer:
        cameras, uplinks = (names_of(drive, key) for key in ("cameras", "uplinks"))
        channels = _Channels(context, {"cameras": cameras, **dict.fromkeys(BY_UPLINK, uplinks)})
        for name, side in drive.sides.items():
            writer.write_metadata(f"{name} began", _texts(line_to_json(side.first)))
        count = write_all(drive, channels, read_video, on_warning, on_progress, out.check)
    out.check()
    return count


class _Out:
    """The file as the writer sees it: it never fails, and `check` raises the error where it can be handled."""

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
            raise RunError(f"the MCAP file cannot be written: {reason(self._failed)}")


class _Channels:
    """The topics, each created with its first message."""

    def __init__(self, context: Any, names: Mapping[str, Iterable[str]]) -> None:
        self._context, self._names = context, names
        self._made: dict[str, Any] = {}

    def write_line(self, topic: str, schema: str, definition: str, line: Json, ns: int) -> None:
        """Write a line of JSON, with the schema definition that it satisfies."""
        if topic not in self._made:
            self._made[topic] = self._json_channel(topic, schema, definition)
        self._made[topic].log(json.dumps(line, ensure_ascii=False).encode(), log_time=ns)

    def write_position(self, position: Position, ns: int) -> None:
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
        self._typed(POSITION_TOPIC, LocationFixChannel).log(fix, log_time=ns)

    def note(self, side: str, line: Note, ns: int) -> None:
        from foxglove.channels import LogChannel
        from foxglove.messages import Log, LogLevel

        log = Log(timestamp=_timestamp(ns), level=LogLevel.Info, name=side, message=line.text)
        self._typed(NOTE_TOPIC, LogChannel).log(log, log_time=ns)

    def picture(self, topic: str, camera: str, unit: Unit, ns: int) -> None:
        from foxglove.channels import CompressedVideoChannel
        from foxglove.messages import CompressedVideo

        video = CompressedVideo(timestamp=_timestamp(ns), frame_id=camera, data=unit.data, format=unit.codec)
        self._typed(topic, CompressedVideoChannel).log(video, log_time=ns)

    def sound(self, packet: bytes, ns: int) -> None:
        from foxglove.channels import CompressedAudioChannel
        from foxglove.messages import CompressedAudio

        audio = CompressedAudio(timestamp=_timestamp(ns), data=packet, format="opus")
        self._typed(SOUND_TOPIC, CompressedAudioChannel).log(audio, log_time=ns)

    def _typed(self, topic: str, kind: Any) -> Any:
        if topic not in self._made:
            self._made[topic] = kind(topic, context=self._context)
        return self._made[topic]

    def _json_channel(self, topic: str, schema: str, definition: str) -> Any:
        import foxglove

        text = json.dumps(standalone({"$ref": f"#/$defs/{definition}"}, schema, self._names))
        known = foxglove.Schema(name=f"tod_runner.{definition}", encoding="jsonschema", data=text.encode())
        return foxglove.Channel(topic, schema=known, message_encoding="json", context=self._context)


def standalone(schema: Any, home: str, names: Mapping[str, Iterable[str]]) -> Any:
    """A schema without references, and with cameras and uplinks by name, so that Foxglove offers each number for plots.

    home   name of the schema that it is a part of
    names  by the property whose keys they are
    """
    if isinstance(schema, list):
        return [standalone(part, home, names) for part in schema]
    if not isinstance(schema, dict):
        return schema
    if "$ref" in schema:
        return standalone(*referred(schema["$ref"], home), names)
    whole = {key: standalone(part, home, names) for key, part in schema.items()}
    properties = whole.get("properties", {})
    for key in names.keys() & properties.keys():
        if isinstance(each := properties[key].get("additionalProperties"), dict):
            properties[key] |= {"properties": dict.fromkeys(names[key], each), "additionalProperties": False}
    return whole


def _texts(began: Json) -> dict[str, str]:
    """Metadata, whose values must be texts."""
    return {key: value if isinstance(value, str) else json.dumps(value) for key, value in began.items()}


def _timestamp(ns: int) -> Any:
    from foxglove.messages import Timestamp

    return Timestamp(sec=ns // SECOND_NS, nsec=ns % SECOND_NS)
