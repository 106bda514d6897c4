"""SQLite as rosbag2 writes it, also while, or after, a recorder was killed."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import quote

from runner.bag.storage import Channel, Message, UnreadableError, normal, total

JOURNAL = "-journal"
BESIDE = ("-wal", JOURNAL)  # suffixes of files that a killed recorder leaves; without them messages are missing


class SqliteFile:
    """An open database, see `Storage`.

    raises  sqlite3.DatabaseError if it is damaged or cut off; UnreadableError if it is not
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._unfinished = [left for left in (Path(f"{path}{suffix}") for suffix in BESIDE) if _has_bytes(left)]
        # Without them nothing is written beside it, so that a bag may lie where nothing can be written.
        mode = "mode=ro" if self._unfinished else "immutable=1"
        try:
            self._database = sqlite3.connect(f"file:{quote(str(path))}?{mode}", uri=True, check_same_thread=False)
            self._channels = self._read_channels()
            query = "SELECT topic_id, count(*), min(timestamp) FROM messages GROUP BY topic_id"
            found = self._database.execute(query).fetchall()
        except sqlite3.OperationalError as error:
            raise UnreadableError(self._reason(error)) from None
        self.counts = total((self._channels[number], count) for number, count, _ in found)
        self.start = min((start for *_, start in found), default=0)

    def close(self) -> None:
        self._database.close()

    def messages(self, topic: str) -> Iterator[Message]:
        numbers = [number for number, channel in self._channels.items() if channel.topic == topic]
        marks = ", ".join("?" * len(numbers))
        query = f"SELECT timestamp, topic_id, data FROM messages WHERE topic_id IN ({marks}) ORDER BY timestamp, id"
        for ns, number, data in self._database.execute(query, numbers):
            yield Message(ns, self._channels[number], data)

    def _read_channels(self) -> dict[int, Channel]:
        definitions: dict[str, tuple[str, str]] = {}
        if self._database.execute("SELECT 1 FROM sqlite_master WHERE name = 'message_definitions'").fetchone():
            query = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
            definitions = {kind: (encoding, text) for kind, encoding, text in self._database.execute(query)}
        return {
            number: Channel(topic, normal(kind), encoding, definitions.get(kind, ("", "")))
            for number, topic, kind, encoding in self._database.execute(
                "SELECT id, name, type, serialization_format FROM topics"
            )
        }

    def _reason(self, error: Exception) -> str:
        if not self._unfinished:
            return f"it is no bag of rosbag2: {error}"
        left = ", ".join(path.name for path in self._unfinished)
        if any(path.name.endswith(JOURNAL) for path in self._unfinished):
            remedy = f"`sqlite3 {self._path.name} .tables` takes it back, in a directory that can be written"
            return f"its recorder was killed while it wrote, and {left} holds what must be taken back: {remedy}"
        return f"its recorder was killed, and {left} can be read only in a directory that can be written: {error}"


def _has_bytes(path: Path) -> bool:
    return path.is_file() and path.stat().st_size > 0
