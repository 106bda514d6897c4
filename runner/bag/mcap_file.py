"""MCAP (https://mcap.dev), of any profile, with or without chunks, indexes and summary."""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import BinaryIO

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Channel as ChannelRecord
from mcap.records import Chunk, ChunkIndex, McapRecord, Schema
from mcap.records import Message as MessageRecord
from mcap.stream_reader import breakup_chunk

from runner.bag.storage import MCAP, Channel, Message, Part, merged, normal, total

HEADER_BYTES = 9  # of a record: its kind and its length
MESSAGE_HEADER = struct.Struct("<HIQQ")  # channel, sequence, time of recording, time of publication


class _PlacedChunk:
    """A chunk in the file: where it is, the time of its first message and its channels; None: unknown."""

    def __init__(self, at: int, start: int, channels: Collection[int] | None) -> None:
        self.at, self.start, self.channels = at, start, channels


@dataclass(slots=True)
class _Index:
    """Where the messages are.

    counts  by channel
    loose   messages outside chunks, by channel: time of recording, offset and length of the record
    """

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, ChannelRecord] = field(default_factory=dict)
    counts: Counter[int] = field(default_factory=Counter)
    chunks: list[_PlacedChunk] = field(default_factory=list)
    loose: dict[int, list[tuple[int, int, int]]] = field(default_factory=dict)

    def add(self, record: McapRecord) -> None:
        if isinstance(record, Schema):
            self.schemas[record.id] = record
        elif isinstance(record, ChannelRecord):
            self.channels[record.id] = record
        elif isinstance(record, MessageRecord):
            self.counts[record.channel_id] += 1


class McapFile:
    """An open MCAP file, see `Storage`.

    raises  the library's exceptions, or ValueError, if it is damaged or cut off
    """

    def __init__(self, path: Path) -> None:
        self._file = path.open("rb")
        try:
            self._index = _summarised(self._file) or _scanned(self._file)
        except BaseException:
            self._file.close()
            raise
        index = self._index
        self._channels = {number: _channel(index, number) for number in index.counts}
        self.counts = total((self._channels[number], count) for number, count in index.counts.items())
        starts = [chunk.start for chunk in index.chunks] + [min(placed)[0] for placed in index.loose.values()]
        self.start = min(starts, default=0)

    def close(self) -> None:
        self._file.close()

    def messages(self, topic: str) -> Iterator[Message]:
        wanted = {number for number, channel in self._channels.items() if channel.topic == topic}
        chunks = [c for c in self._index.chunks if c.channels is None or not wanted.isdisjoint(c.channels)]
        parts = [Part(chunk.start, partial(self._of_chunk, chunk, wanted)) for chunk in chunks]
        for number in wanted & self._index.loose.keys():
            parts.append(Part(min(self._index.loose[number])[0], partial(self._loose, number)))
        return merged(parts)

    def _of_chunk(self, placed: _PlacedChunk, wanted: Collection[int]) -> Iterator[Message]:
        records = (r for r in _chunk_records(self._file, placed.at) if isinstance(r, MessageRecord))
        found = sorted((r for r in records if r.channel_id in wanted), key=lambda record: record.log_time)
        return (Message(r.log_time, self._channels[r.channel_id], r.data) for r in found)

    def _loose(self, number: int) -> Iterator[Message]:
        for ns, at, length in sorted(self._index.loose[number]):
            self._file.seek(at + MESSAGE_HEADER.size)
            yield Message(ns, self._channels[number], self._file.read(length - MESSAGE_HEADER.size))


def _summarised(file: BinaryIO) -> _Index | None:
    """The index by the file's summary; None if that lacks something, which writers may leave out."""
    file.seek(-len(MCAP), 2)
    if file.read() != MCAP:
        raise ValueError("it ends without the end of an MCAP file; `mcap recover` saves what it holds")
    file.seek(0)
    summary = SeekingReader(file).get_summary()
    if summary is None or summary.statistics is None:
        return None
    said, chunks = summary.statistics, summary.chunk_indexes
    counts = Counter({number: count for number, count in said.channel_message_counts.items() if count})
    described = {number for number, c in summary.channels.items() if not c.schema_id or c.schema_id in summary.schemas}
    is_whole = chunks and said.chunk_count == len(chunks) and said.message_count == counts.total()
    if not is_whole or counts.keys() - described or _has_loose(file, chunks):
        return None
    placed = [
        _PlacedChunk(c.chunk_start_offset + HEADER_BYTES, c.message_start_time, c.message_index_offsets.keys() or None)
        for c in chunks
    ]
    return _Index(summary.schemas, summary.channels, counts, placed)


def _has_loose(file: BinaryIO, chunks: Iterable[ChunkIndex]) -> bool:
    """Whether messages lie outside the chunks, where the summary does not say; also if what lies there is not clear."""
    ends = {c.chunk_start_offset: c.chunk_start_offset + c.chunk_length + c.message_index_length for c in chunks}
    try:
        return any(kind == Opcode.MESSAGE for kind, *_ in _records(file, ends))
    except ValueError:
        return True


def _scanned(file: BinaryIO) -> _Index:
    """The index by reading through the file, once."""
    index = _Index()
    for kind, at, length in _records(file):
        if kind in (Opcode.SCHEMA, Opcode.CHANNEL):
            file.seek(at)
            index.add((Schema if kind == Opcode.SCHEMA else ChannelRecord).read(ReadDataStream(file)))
        elif kind == Opcode.MESSAGE:
            file.seek(at)
            number, _, ns, _ = MESSAGE_HEADER.unpack(file.read(MESSAGE_HEADER.size))
            index.counts[number] += 1
            index.loose.setdefault(number, []).append((ns, at, length))
        elif kind == Opcode.CHUNK:
            _scan_chunk(index, file, at)
    return index


def _scan_chunk(index: _Index, file: BinaryIO, at: int) -> None:
    records = _chunk_records(file, at)
    for record in records:
        index.add(record)
    messages = [record for record in records if isinstance(record, MessageRecord)]
    if messages:
        start = min(record.log_time for record in messages)
        index.chunks.append(_PlacedChunk(at, start, {record.channel_id for record in messages}))


def _records(file: BinaryIO, skipped: Mapping[int, int] = MappingProxyType({})) -> Iterator[tuple[int, int, int]]:
    """Kind of each record of the data, and offset and length of its content.

    skipped  ends, by beginnings, of parts that are left out
    raises  ValueError if the file ends before its footer
    """
    at = len(MCAP)
    while True:
        while (end := skipped.get(at, at)) > at:
            at = end
        file.seek(at)
        head = file.read(HEADER_BYTES)
        if len(head) < HEADER_BYTES:
            raise ValueError("it ends before its footer")
        kind, length = struct.unpack("<BQ", head)
        at += HEADER_BYTES
        yield kind, at, length
        if kind == Opcode.FOOTER:
            return
        at += length


def _chunk_records(file: BinaryIO, at: int) -> list[McapRecord]:
    file.seek(at)
    chunk = Chunk.read(ReadDataStream(file))
    # Some writers leave an empty one before a message that is larger than a chunk.
    return breakup_chunk(chunk, validate_crc=True) if chunk.uncompressed_size else []


def _channel(index: _Index, number: int) -> Channel:
    channel = index.channels[number]
    schema = index.schemas.get(channel.schema_id)
    if schema is None:
        return Channel(channel.topic, "", channel.message_encoding, ("", ""))
    text = schema.data.decode() if schema.encoding in ("ros1msg", "ros2msg", "ros2idl") else ""
    return Channel(channel.topic, normal(schema.name), channel.message_encoding, (schema.encoding, text))
