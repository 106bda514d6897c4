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
from runner.bag.storage import MCAP, ROS1, SQLITE, Message, Part, Storage, UnreadableError, merged, total

METADATA = "metadata.yaml"  # makes a directory a ROS 2 bag
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"


class BagFiles:
    """All files of a bag as one, see `Storage`.

    raises  UnreadableError, or any exception of a library if a file is damaged
    """

    def __init__(self, path: Path) -> None:
        with ExitStack() as opened:
            self._files = [_opened(file, opened) for file in files_of(path)]
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


def files_of(path: Path) -> list[Path]:
    """The files of a bag: those that the metadata of a directory lists, in any order, or the one that is named."""
    if path.is_file():
        return [path]
    import yaml

    try:
        loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # a bag of many topics has long metadata
        document = yaml.load((path / METADATA).read_text(encoding="utf-8"), loader)
        names = document["rosbag2_bagfile_information"]["relative_file_paths"]
        files = [path / PurePath(name).name for name in names]  # older ones name the directory, too
    except (yaml.YAMLError, UnicodeDecodeError, LookupError, TypeError) as error:
        raise UnreadableError(f"{METADATA} names no files: {type(error).__name__}: {error}") from None
    if missing := [file.name for file in files if not file.is_file()]:
        raise UnreadableError(f"{METADATA} names {', '.join(missing)}, which must be in the same directory")
    return files


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
