"""The log of one side of a drive, written as lines of JSON during the drive. schemas/drive.schema.json defines them."""

from __future__ import annotations

import errno
import fcntl
import json
import os
import platform
import queue
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from importlib.metadata import version
from itertools import chain, count
from pathlib import Path
from typing import Any

from msgspec import UNSET, UnsetType

from runner.core.events import Event, MomentMarked, describe, to_json
from runner.core.step import Run
from runner.errors import ArgumentError, RunError, UserError, reason
from runner.records import Json
from runner.records.decisions import DecisionMade
from runner.records.lines import (
    Began,
    ClockSet,
    Ended,
    LinesDropped,
    LinkSample,
    LosslessBegan,
    Note,
    Record,
    VideoBegan,
    VideoShifted,
    line_to_json,
)
from runner.records.reception import ReceptionReported
from runner.records.vehicle import Telemetry
from runner.redact import redacted

FORMAT = 2
WITHOUT_LOG = "the drive continues without its log"
FILES = {"vehicle": "drive.jsonl", "operator": "operator.jsonl", "link": "link.jsonl"}  # by side
PROTECTED = "protected"  # file in the directory of a drive that is not to be removed, with the reasons
QUEUED_LINES = 10_000  # more than two minutes of a vehicle with eight cameras
QUEUED_BYTES = 64_000_000  # reports of others are logged, too, each up to 64 kB long
# Records of numbers and the rules' own texts; redacting a decision takes twenty times as long as making it.
WITHOUT_ADDRESSES = (DecisionMade, LinkSample, ReceptionReported, Telemetry)
_MISNAMED = (FileExistsError, NotADirectoryError, BlockingIOError)  # faults of the argument, not of the disk
SYNC_S = 1.0  # a power failure loses about as much, and the queued lines
RETRY_S = 1.0  # time between attempts to write to a full disk
CLOSE_S = 5.0  # a disk that is stuck for longer does not keep the process from ending


class Log:
    """One side's file in the directory of a drive. May be used from any thread; a slow disk blocks none of them.

    directory  None: nothing is written
    config     the composed configuration; passwords in addresses are removed
    versions   of the software used, by name
    on_report  called, from the log's thread, when the file cannot be written, and when it can again
    raises     UserError if the directory already contains a drive, is none, or is in use; under a service manager,
               which would start it again for ever, this is only reported

    A file that cannot be made, for example on a full or read-only disk, is tried again: no drive needs its log. Lines
    wait in a bounded queue for a thread that writes each, normally with one system call, so that a killed process loses
    at most the queued lines. Lines are dropped while the queue is full, and a line of kind "dropped" counts them. Lines
    written before `begin` are kept until then.
    """

    def __init__(
        self,
        directory: Path | None,
        side: str,
        config: Mapping[str, Any],
        versions: Mapping[str, str],
        on_report: Callable[[str], None],
    ) -> None:
        self._file = None if directory is None else _File(directory / FILES[side])
        if self._file:
            self._file.open_first()
        self._side, self._config, self._versions, self._on_report = side, config, versions, on_report
        self._lock = threading.Lock()
        self._began: float | None = None
        self._past: float | None = None  # for a past drive, time of its last line
        self.time = 0.0  # of the start, s since 1970
        self._ahead_s = 0.0  # of the wall clock, before a clock that is never set
        self._before_begin: list[Json] = []
        self._writer: _Writer | None = None

    def begin(self, at: float | None = None, replayed: tuple[str, ...] | UnsetType = UNSET) -> None:
        """Set time 0 of the drive.

        at        s since 1970, for a past drive whose lines carry their own times; None: now
        replayed  see `Began`
        """
        from runner.system.kernel_clock import wall_ahead_s

        self.time = time.time() if at is None else at
        versions = {"tod-runner": version("tod-runner"), "Python": platform.python_version(), **self._versions}
        first = Began(0.0, self._side, FORMAT, self.time, versions, redacted(self._config), redacted(replayed))
        with self._lock:
            self._began, self._past = time.monotonic(), None if at is None else 0.0
            self._ahead_s = wall_ahead_s(time.CLOCK_BOOTTIME) if at is None else 0.0
            if self._file and at is None:
                self._writer = _Writer(self._file, self._dropped, self._on_report)
            for line in (line_to_json(first), *self._before_begin):
                self._put(line)

    def now(self) -> float:
        """Time since the start, s."""
        if self._past is not None or self._began is None:
            return self._past or 0.0
        return round(time.monotonic() - self._began, 6)

    def event(self, event: Event) -> None:
        """Write an event.

        raises  RunError if a past drive cannot be written
        """
        self._write(to_json(event))

    def record(self, record: Record) -> None:
        """Write a record; raises as `event`."""
        line = line_to_json(record)
        self._write(line if isinstance(record, WITHOUT_ADDRESSES) else redacted(line))

    def on_step(self, before: Run, event: Event, after: Run) -> None:
        """Write an event, and the decision if it changed; raises as `event`."""
        self.event(event)
        if isinstance(event, MomentMarked):
            self.protect_soon(event.t, event.back_s)
        if after.commands or after.decision != before.decision:
            self.record(DecisionMade.of(after.state.t, describe(event), after.decision, after.commands))

    def protect_soon(self, t: float, back_s: float) -> None:
        """Protect this drive since a moment was marked, in a thread of its own: a slow disk blocks nobody."""

        def protect() -> None:
            said = f"{t:.1f} s: the last {back_s:g} s were marked"
            why = self.protect(said)
            self._on_report(
                f"{said}, but the drive is not protected: {why}" if why else f"{said}, the drive is protected"
            )

        if self._file and self._past is None:
            threading.Thread(target=protect, name="protect", daemon=True).start()

    def protect(self, why: str) -> str | None:
        """Keep this drive from being removed; `why` is a line in its directory.

        returns  why it cannot be protected; None: it is, with what its files hold on the disk
        """
        with self._lock:
            file = self._file if self._began is not None else None
        if file is None:
            return "this side logs no drive"
        try:
            descriptor = os.open(
                file.path.with_name(PROTECTED), os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC, 0o666
            )
            try:
                os.write(descriptor, f"{why}\n".encode())
                os.fsync(descriptor)
            finally:
                os.close(descriptor)
        except OSError as error:
            return reason(error)
        return file.sync()

    def note(self, text: str) -> None:
        """Write a note for the user, with the current time."""
        self.record(Note(self.now(), text))

    def _write(self, line: Json) -> None:
        with self._lock:
            if self._began is None:
                self._before_begin.append(line)
                return
            if self._past is None:
                self._look_at_clock()
            else:
                self._past = line["t"]
            self._put(line)

    def _look_at_clock(self) -> None:
        """Write by how much the wall clock has been set since the line before."""
        from runner.system.clocks import STEP_S
        from runner.system.kernel_clock import wall_ahead_s

        def moved_s() -> float:
            return wall_ahead_s(time.CLOCK_BOOTTIME) - self._ahead_s

        by_s = moved_s()
        if abs(by_s) > STEP_S and abs(by_s := moved_s()) > STEP_S:  # the first reading may be off
            self._ahead_s += by_s
            self._put(line_to_json(ClockSet(self.now(), round(by_s, 6))))

    def video(self, camera: str, file: str, captured: float) -> None:
        """A video file has started; `captured`: capture time of its first frame, s since 1970."""
        self.record(VideoBegan(self.now(), camera, file, captured))

    def lossless(self, camera: str, file: str, captured: float) -> None:
        """A file with whole pictures has started; `captured`: capture time of the first one, s since 1970."""
        self.record(LosslessBegan(self.now(), camera, file, captured))

    def video_shift(self, camera: str, file: str, after_s: float, captured: float) -> None:
        """From a frame on, times in a video file are off by another amount; see `VideoShifted`."""
        self.record(VideoShifted(self.now(), camera, file, round(after_s, 6), captured))

    def close(self) -> None:
        """Close the log cleanly; a drive that never began leaves no file."""
        ended = line_to_json(Ended(self.now()))
        with self._lock:
            if self._past is not None:
                self._put(ended)
            writer, self._writer = self._writer, None
            file, self._file = self._file, None
        if writer:
            writer.close(_encoded(ended))
        elif file and (why := file.close(keep=self._began is not None)):
            raise RunError(f"{file.path}: lines may be missing: {why}")

    def discard(self) -> None:
        """Discard the log of a past drive that was not completed."""
        with self._lock:
            if self._file:
                self._file.close(keep=False)
            self._file = None

    def _put(self, line: Mapping[str, Any]) -> None:
        if self._writer:
            self._writer.put(_encoded(line))
        elif self._file and (why := self._file.append(_encoded(line))):
            raise RunError(f"{self._file.path}: cannot be written: {why}")

    def _dropped(self, lines: int) -> bytes:
        return _encoded(line_to_json(LinesDropped(self.now(), lines)))


def _encoded(line: Mapping[str, Any]) -> bytes:
    # Lone surrogates, which a request or a file name may contain, are written as JSON escapes.
    return (json.dumps(line, ensure_ascii=False) + "\n").encode("utf-8", "backslashreplace")


class _File:
    """A new file of complete lines only: a partly written line is removed."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._fd: int | None = None  # None: not made yet
        self._size = 0
        self._new = False  # whether its directory was made for it

    def open_first(self) -> None:
        """Make the file if possible; otherwise `append` tries it again.

        raises  UserError if a user has to name another directory
        """
        try:
            self._open()
        except _MISNAMED as error:
            from runner.system.service import is_managed

            if not is_managed():
                raise _refused(self.path.parent, reason(error)) from None
        except OSError:
            pass

    def _open(self) -> int:
        if self._fd is None:
            new = not self.path.parent.exists()
            self._fd = _create(self.path)
            self._new = new
        return self._fd

    def append(self, data: bytes) -> str | None:
        """Write a line; returns why it was not written, None if it was."""
        rest = data
        try:
            file = self._open()
        except OSError as error:
            return reason(error)
        try:
            while rest:  # a signal may interrupt a write, and a disk may have space for a part
                rest = rest[os.write(file, rest) :]
        except OSError as error:
            with suppress(OSError):
                os.ftruncate(file, self._size)
            return reason(error)
        self._size += len(data)
        return None

    def sync(self) -> str | None:
        """Flush it to the disk; returns why lines may be missing, None if none are."""
        if self._fd is None:
            return None
        try:
            os.fdatasync(self._fd)
        except OSError as error:
            return None if error.errno == errno.EINVAL else reason(error)  # some file systems cannot
        return None

    def close(self, keep: bool) -> str | None:
        """Close or remove it; returns as `sync`."""
        if self._fd is None:
            return None
        why = self.sync() if keep else None
        try:
            os.close(self._fd)
        except OSError as error:
            why = why or reason(error)
        if keep:
            return why
        self.path.unlink(missing_ok=True)
        if self._new:
            with suppress(OSError):  # it holds other files by now
                self.path.parent.rmdir()
        return None


class _Writer:
    """Writes lines in its own thread, so that a slow disk does not block the thread that logs.

    dropped    makes the line that counts the lines dropped while the queue was full
    on_report  called when the file cannot be written, and when it can again
    """

    def __init__(self, file: _File, dropped: Callable[[int], bytes], on_report: Callable[[str], None]) -> None:
        self._file, self._dropped, self._on_report = file, dropped, on_report
        self._queue: queue.Queue[bytes | None] = queue.Queue(QUEUED_LINES)
        self._put_bytes = self._taken_bytes = 0  # so far; each changed by one thread only
        self._lost = 0
        self._reported = False  # that lines may be missing
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="log", daemon=True)
        self._thread.start()

    def put(self, data: bytes) -> None:
        """Queue a line; to be called by one thread at a time."""
        lines = [self._dropped(self._lost), data] if self._lost else [data]
        size = sum(map(len, lines))
        if (
            self._queue.qsize() + len(lines) > self._queue.maxsize
            or self._put_bytes - self._taken_bytes + size > QUEUED_BYTES
        ):
            self._lost += 1
            return
        self._lost = 0
        self._put_bytes += size
        for line in lines:
            self._queue.put_nowait(line)

    def close(self, last: bytes) -> None:
        """Write the queued lines and a last line, within a time limit."""
        until = time.monotonic() + CLOSE_S
        self._closing.set()
        with suppress(queue.Full):
            for data in (self._dropped(self._lost) if self._lost else b"", last, None):
                self._queue.put(data, timeout=max(0.0, until - time.monotonic()))
        self._thread.join(max(0.0, until - time.monotonic()))
        if waiting := sum(bool(data) for data in self._queue.queue):
            self._on_report(f"{self._file.path.name}: {waiting} lines were not written")

    def _run(self) -> None:
        synced = time.monotonic()
        while (data := self._queue.get()) is not None:
            self._taken_bytes += len(data)
            if not self._write(data):
                break
            if time.monotonic() - synced >= SYNC_S:
                self._report(self._file.sync())
                synced = time.monotonic()
        self._report(self._file.close(keep=True))

    def _report(self, why: str | None) -> None:
        """Report once that lines may be missing."""
        if why and not self._reported:
            self._reported = True
            self._on_report(f"lines may be missing: {self._file.path.name}: {why}")

    def _write(self, data: bytes) -> bool:
        """Write a line, with retries; False if the log is closed before it is written."""
        why = self._file.append(data)
        if why is None:
            return True
        self._on_report(f"{WITHOUT_LOG}: {self._file.path}: {why}; retrying")
        while self._file.append(data):
            if self._closing.wait(RETRY_S):
                return False
        self._on_report(f"the log continues: {self._file.path}")
        return True


def check_free(directory: Path, side: str) -> None:
    """raises UserError if this side of a drive already exists, empty files not counting, or cannot be created"""
    above = next((each for each in (directory, *directory.absolute().parents) if os.path.lexists(each)), directory)
    if not above.is_dir() or not os.access(above, os.W_OK | os.X_OK):
        raise _refused(directory, f"cannot be created: {above} is not a directory that you may write to")
    try:
        _check_untaken(directory / FILES[side])
    except OSError as error:
        raise _refused(directory, reason(error)) from None


def _check_untaken(path: Path) -> None:
    """raises OSError if a file exists; an empty one is of a process that ended before its drive began"""
    if os.path.lexists(path) and not (path.is_file() and path.stat().st_size == 0):
        raise FileExistsError(errno.EEXIST, f"already contains a drive ({path.name}), choose another directory")


def new_drive(parent: Path) -> Path:
    """A directory for a drive that begins now, named by the time, which does not exist yet."""
    name = time.strftime("%Y-%m-%dT%H-%M-%SZ", time.gmtime())
    names = chain([name], (f"{name}-{number}" for number in count(2)))  # without a clock, machines start at one time
    return next(parent / each for each in names if not os.path.lexists(parent / each))


def _create(path: Path) -> int:
    """A new file of a drive, open for appending.

    raises  OSError
    """
    if path.parent.exists() and not path.parent.is_dir():
        raise NotADirectoryError(errno.ENOTDIR, os.strerror(errno.ENOTDIR))
    _check_untaken(path)
    try:
        _remove_abandoned(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_APPEND | os.O_CLOEXEC, 0o666)
        return _locked(file)
    except BlockingIOError as error:
        rule = f"another process is about to write {path.name}, choose another directory"
        raise BlockingIOError(error.errno, rule) from None


def _locked(file: int) -> int:
    """The file, locked until it is closed, also by the end of this process; closed if that fails."""
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(file)
        raise
    return file


def _remove_abandoned(path: Path) -> None:
    """Remove the empty file of a process that ended before its drive began.

    raises  BlockingIOError if that process still runs
    """
    try:
        file = os.open(path, os.O_WRONLY | os.O_CLOEXEC)
    except FileNotFoundError:
        return
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        path.unlink()
    finally:
        os.close(file)


def _refused(directory: Path, rule: str) -> UserError:
    return ArgumentError("log", directory, rule)
