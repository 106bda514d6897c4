"""Which drives of `drives=DIR` stay: up to a size and an age, without those that run or are protected."""

from __future__ import annotations

import fcntl
import os
import re
import shutil
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from math import inf
from pathlib import Path
from typing import NamedTuple

from runner.drive.log import FILES, PROTECTED
from runner.errors import reason
from runner.settings import LogSettings

DAY_S, GB = 86_400.0, 1e9
EVERY_S = 60.0  # a drive with video of eight cameras grows by a few hundred MB in that time
END_S = 1.0
NAME = re.compile(r"\d{4}-\d\d-\d\dT\d\d-\d\d-\d\dZ(-\d+)?")  # as `new_drive` names them
REMOVED = re.compile(rf"\.{NAME.pattern}\.removed")  # what is left of one whose removal was interrupted


class StoredDrive(NamedTuple):
    """A drive on the disk; `ended`: the last change of its files, s since 1970."""

    path: Path
    ended: float
    size: int


def stored(parent: Path) -> list[StoredDrive]:
    """The drives in a directory, the oldest first. Anything with another name is none."""
    found = []
    with suppress(FileNotFoundError):
        for entry in os.scandir(parent):
            if NAME.fullmatch(entry.name) and entry.is_dir(follow_symlinks=False):
                files = list(_files(Path(entry.path)))
                ended = max((file.st_mtime for file in files), default=entry.stat().st_mtime)
                found.append(StoredDrive(Path(entry.path), ended, sum(file.st_size for file in files)))
    return sorted(found, key=lambda drive: (drive.ended, drive.path))


def make_room(parent: Path, settings: LogSettings, now: float | None = None) -> list[str]:
    """Remove drives that are too many or too old, the oldest first, and what earlier removals have left.

    now      s since 1970; None: this machine's time
    returns  what to tell the user

    A drive disappears under its name at once; a crash leaves the rest of it to the next call.
    """
    _remove_rests(parent)
    drives, said = stored(parent), list[str]()
    oldest = (time.time() if now is None else now) - (inf if settings.keep_days is None else settings.keep_days * DAY_S)
    limit = inf if settings.keep_gb is None else settings.keep_gb * GB
    total = sum(drive.size for drive in drives)
    for drive in drives:
        if (drive.ended >= oldest and total <= limit) or is_protected(drive.path) or is_running(drive.path):
            continue
        why = "log.keep_days" if drive.ended < oldest else "log.keep_gb"
        try:
            if _remove(drive.path):
                total -= drive.size
                said.append(f"drive {drive.path} was removed: {why}")
        except OSError as error:
            said.append(f"drive {drive.path} cannot be removed: {reason(error)}")
    if total > limit:
        said.append(f"drives in {parent} take more than log.keep_gb: those that are left run or are protected")
    return said


def is_running(drive: Path) -> bool:
    """Whether a process is writing a log there."""
    for name in FILES.values():
        with suppress(FileNotFoundError):
            file = os.open(drive / name, os.O_RDONLY | os.O_CLOEXEC)
            try:
                fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
            except BlockingIOError:
                return True
            finally:
                os.close(file)
    return False


def is_protected(drive: Path) -> bool:
    return os.path.lexists(drive / PROTECTED)


@contextmanager
def keeping_room(parent: Path | None, settings: LogSettings, say: Callable[[str], None]) -> Iterator[None]:
    """Make room in the directory of `drives=`, now and again, in a thread of its own.

    parent  None: no drive is logged there
    say     called with one line for each drive that was removed, or could not be
    """
    if parent is None or (settings.keep_gb is None and settings.keep_days is None):
        yield
        return
    ending = threading.Event()

    def run() -> None:
        said = set[str]()
        while True:
            for line in make_room(parent, settings):
                if line not in said:
                    said.add(line)
                    say(line)
            if ending.wait(EVERY_S):
                return

    thread = threading.Thread(target=run, name="drives", daemon=True)
    thread.start()
    try:
        yield
    finally:
        ending.set()
        thread.join(END_S)


def _files(folder: Path) -> Iterator[os.stat_result]:
    for where, _, names in os.walk(folder):
        for name in names:
            with suppress(OSError):  # removed meanwhile
                yield os.lstat(Path(where, name))


def _remove(drive: Path) -> bool:
    """Whether it was removed; one that somebody has protected meanwhile is not."""
    rest = drive.with_name(f".{drive.name}.removed")
    try:
        drive.rename(rest)
    except FileNotFoundError:  # the other side was faster
        return True
    if is_protected(rest):
        rest.rename(drive)
        return False
    shutil.rmtree(rest, ignore_errors=True)
    return True


def _remove_rests(parent: Path) -> None:
    with suppress(FileNotFoundError):
        for entry in os.scandir(parent):
            if REMOVED.fullmatch(entry.name) and entry.is_dir(follow_symlinks=False):
                if is_protected(Path(entry.path)):  # the process was killed between its look and the way back
                    Path(entry.path).rename(parent / entry.name[1 : -len(".removed")])
                else:
                    shutil.rmtree(entry.path, ignore_errors=True)
