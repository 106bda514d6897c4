"""What one side of a drive says, written as lines of JSON while it drives. schemas/drive.schema.json has the lines."""

from __future__ import annotations

import json
import os
import platform
import threading
import time
from collections.abc import Callable, Iterable, Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

from runner.errors import UserError
from runner.events import Event, describe, to_json
from runner.step import Run

FORMAT = 1
WITHOUT_LOG = "the drive goes on without its log"
FILES = {"vehicle": "drive.jsonl", "operator": "operator.jsonl", "link": "link.jsonl"}  # by side


class Log:
    """One side's file in the directory of a drive. May be used from any thread.

    directory  None: nothing is kept
    config     the composed configuration
    versions   of what the drive is made with, by name
    report     told once, if the file cannot be written any further: the drive goes on without its log
    raises     UserError where the directory holds a drive already, or cannot be written

    Every line is one write to the system, so that a killed process loses at most the last one.
    What comes before `begin` is kept until then.
    """

    def __init__(
        self,
        directory: Path | None,
        side: str,
        config: Mapping[str, Any],
        versions: Mapping[str, str],
        report: Callable[[str], None],
    ) -> None:
        self._path = None if directory is None else directory / FILES[side]
        self._fd = -1 if directory is None else _create(directory, side)
        self._side, self._config, self._versions, self._report = side, config, versions, report
        self._lock = threading.Lock()
        self._began: float | None = None
        self._past: float | None = None  # of a drive of the past, the time of its last line
        self.time = 0.0  # of the beginning, s since 1970
        self._early: list[Mapping[str, Any]] = []

    def begin(self, at: float | None = None) -> None:
        """Time 0 of the drive.

        at  s since 1970, of a drive of the past whose lines bring their times; None: now
        """
        self.time = time.time() if at is None else at
        first = {
            "t": 0.0,
            "log": "began",
            "side": self._side,
            "format": FORMAT,
            "time": self.time,
            "versions": {"tod-runner": version("tod-runner"), "Python": platform.python_version(), **self._versions},
            "config": self._config,
        }
        with self._lock:
            self._began, self._past = time.monotonic(), None if at is None else 0.0
            failed = [self._append(line) for line in (first, *self._early)]
        self._tell_failed(*failed)

    def now(self) -> float:
        """Time since the beginning, s."""
        if self._past is not None or self._began is None:
            return self._past or 0.0
        return round(time.monotonic() - self._began, 6)

    def write(self, line: Mapping[str, Any]) -> None:
        """One line: an event, or what a key `log` names."""
        with self._lock:
            if self._began is None:
                self._early.append(line)
                return
            if self._past is not None:
                self._past = line["t"]
            failed = self._append(line)
        self._tell_failed(failed)

    def tell(self, kind: str, **keys: Any) -> None:
        """One line of a kind, at this moment."""
        self.write({"t": self.now(), "log": kind, **keys})

    def video(self, camera: str, file: str, captured: float) -> None:
        """A video file has its first frame, captured then (s since 1970)."""
        self.tell("video", camera=camera, file=file, captured=captured)

    def close(self) -> None:
        """The clean end; a drive that never began leaves nothing."""
        with self._lock:
            if self._began is not None:
                self._append({"t": self.now(), "log": "ended"})
            self._end(keep=self._began is not None)

    def discard(self) -> None:
        """Give up a log that did not come to its end."""
        with self._lock:
            self._end(keep=False)

    def _end(self, keep: bool) -> None:
        if self._fd < 0:
            return
        os.close(self._fd)
        self._fd = -1
        if self._path and not keep:
            self._path.unlink(missing_ok=True)

    def _append(self, line: Mapping[str, Any]) -> str:
        """Write a line; returns why there will be no more, or ""."""
        if self._fd < 0:
            return ""
        # Half of a surrogate pair, as a request or a file's name may hold, is written as JSON has it.
        data = (json.dumps(line, ensure_ascii=False) + "\n").encode("utf-8", "backslashreplace")
        try:
            if os.write(self._fd, data) == len(data):
                return ""
            why = "no space left on device"
        except OSError as error:
            why = (error.strerror or str(error)).lower()
        self._end(keep=True)
        return f"{WITHOUT_LOG}: {FILES[self._side]}: {why}"

    def _tell_failed(self, *failed: str) -> None:
        """Outside the lock: who is told may write a line of its own."""
        for why in filter(None, failed):
            self._report(why)


def check_free(directory: Path, side: str) -> None:
    """raises UserError where this side of a drive is there already; a file without a line is none"""
    path = directory / FILES[side]
    try:
        if os.path.lexists(path) and not (path.is_file() and path.stat().st_size == 0):
            raise _refused(directory, f"holds a drive already ({FILES[side]}), choose another directory")
    except OSError as error:
        raise _refused(directory, (error.strerror or str(error)).lower()) from None


def _create(directory: Path, side: str) -> int:
    """A new file of a drive, open for appending."""
    check_free(directory, side)
    try:
        (directory / FILES[side]).unlink(missing_ok=True)
        directory.mkdir(parents=True, exist_ok=True)
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_APPEND | os.O_CLOEXEC
        return os.open(directory / FILES[side], flags, 0o666)
    except OSError as error:
        raise _refused(directory, (error.strerror or str(error)).lower()) from None


def _refused(directory: Path, rule: str) -> UserError:
    return UserError("command line", "log", repr(str(directory)), rule)


def run_lines(event: Event, before: Run, after: Run) -> Iterable[dict[str, Any]]:
    """What a drive log says of one event: the event, and what was decided where that changed."""
    yield to_json(event)
    if after.commands or after.decision != before.decision:
        commands = [command.to_json() for command in after.commands]
        decision = after.decision.to_json()
        yield {"t": after.state.t, "log": "decision", "cause": describe(event), **decision, "commands": commands}
