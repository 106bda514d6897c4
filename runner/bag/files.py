"""The files of a bag, opened by their first bytes."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import ExitStack
from functools import partial
from pathlib import Path, PurePath
from tempfile import TemporaryDirectory

from runner.bag.ros1_file import Ros1File
from runner.bag.sqlite_file import SqliteFile
from runner.bag.storage import MCAP, ROS1, SQLITE, Message, Part, Storage, UnreadableError, merged, normal, total

SUFFIXES = (".bag", ".mcap", ".db3")
ZSTD = ".zstd"  # follows the suffix of a compressed file
METADATA = "metadata.yaml"  # makes a directory a ROS 2 bag
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"


class BagFiles:
    """All files of a bag as one, see `Storage`.

    stated  number of messages by topic and type, by the metadata of a directory
    raises  UnreadableError, or any exception of a library if a file is damaged
    """

    def __init__(self, path: Path) -> None:
        files, self.stated = _listed(path) if path.is_dir() else ([path], {})
        with ExitStack() as opened:
            self._files = [_opened(file, opened) for file in files]
            self._opened = opened.pop_all()
        self.counts = total(counted for file in self._files for counted in file.counts.items())
        self.start = min((file.start for file in self._files if file.counts), default=0)

    def close(self) -> None:
        self._opened.close()

    def messages(self, topic: str) -> Iterator[Message]:
        files = [file for file in self._files if any(channel.topic == topic for channel in file.counts)]
        for message in merged(Part(file.start, partial(file.messages, topic)) for file in files):
            # Each message may be compressed. CDR begins with 0, and the first four bytes of ROS 1 are a counter.
            packed = message.channel.encoding == "cdr" and message.data.startswith(ZSTD_MAGIC)
            yield message._replace(data=_unpacked(message.data)) if packed else message


def is_named_like_a_bag(path: Path) -> bool:
    """Whether a path has the suffix of a bag's file."""
    return _unpacked_name(path.name).endswith(SUFFIXES)


def _listed(directory: Path) -> tuple[list[Path], dict[tuple[str, str], int]]:
    """The files that the metadata of a bag lists, in any order, and its numbers of messages by topic and type.

    raises  UnreadableError also if the directory holds others
    """
    import yaml

    try:
        loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # a bag of many topics has long metadata
        document = yaml.load((directory / METADATA).read_text(encoding="utf-8"), loader)["rosbag2_bagfile_information"]
        names = [PurePath(name).name for name in document["relative_file_paths"]]  # older ones name the directory, too
        topics = document.get("topics_with_message_count", ())
        counted = [(topic["topic_metadata"], int(topic["message_count"])) for topic in topics]
        stated = {(topic["name"], normal(topic["type"])): count for topic, count in counted}
    except (yaml.YAMLError, ValueError, LookupError, TypeError, AttributeError) as error:
        raise UnreadableError(f"{METADATA} names no files: {type(error).__name__}: {error}") from None
    if missing := [name for name in names if not (directory / name).is_file()]:
        raise UnreadableError(f"{METADATA} names {', '.join(missing)}, which must be in the same directory")
    # ROS unpacks a compressed file beside it.
    known = {_unpacked_name(name) for name in names}
    found = sorted(file.name for file in directory.iterdir() if is_named_like_a_bag(file))
    if others := [name for name in found if _unpacked_name(name) not in known]:
        remedy = "`ros2 bag reindex` lists all files; a file may also be named alone"
        raise UnreadableError(f"{METADATA} does not name {', '.join(others)}: {remedy}")
    return [directory / name for name in names], stated


def _unpacked_name(name: str) -> str:
    return name.removesuffix(ZSTD)


def _opened(path: Path, opened: ExitStack) -> Storage:
    """A file, which is closed with the stack."""
    with path.open("rb") as file:
        begin = file.read(max(map(len, (MCAP, SQLITE, ROS1))))
    if begin.startswith(ZSTD_MAGIC):
        return _opened(_unpacked_file(path, Path(opened.enter_context(TemporaryDirectory()))), opened)
    storage: Storage
    if begin.startswith(MCAP):
        from runner.bag.mcap_file import McapFile

        storage = McapFile(path)
    elif begin.startswith(SQLITE):
        storage = SqliteFile(path)
    elif begin.startswith(ROS1):
        storage = Ros1File(path)
    else:
        raise ValueError(f"{path.name} begins like no bag")
    opened.callback(storage.close)
    return storage


def _unpacked_file(path: Path, directory: Path) -> Path:
    import zstandard

    whole = directory / path.stem
    with path.open("rb") as packed, whole.open("wb") as out:
        shutil.copyfileobj(zstandard.ZstdDecompressor().stream_reader(packed, read_across_frames=True), out)
    return whole


def _unpacked(data: bytes) -> bytes:
    import zstandard

    return zstandard.ZstdDecompressor().decompressobj().decompress(data)
