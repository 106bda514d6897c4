"""Shared by the live verbs: a progress bar, lines on standard error, and access to GStreamer."""

from __future__ import annotations

import shutil
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import ModuleType
from typing import IO, cast

from runner.core.model import Progress
from runner.errors import MissingBindings, RunError
from runner.redact import printable
from runner.system import signals

NAME = "tod-runner"
SWITCH_S = 0.0005  # the longest that a thread with a frame or a message to pass on waits for one that computes


def streaming() -> ModuleType:
    """The module `runner.apply`. From here on signals are held, see `runner.system.signals.hold`.

    raises  RunError if GStreamer's Python bindings are missing
    """
    signals.hold()
    try:
        from runner import apply
    except MissingBindings as error:
        raise RunError(f"{error}; or run `make setup`") from None
    signals.check()
    return apply


def command_name() -> str:
    """How to start this program again: by name if the path finds it, otherwise as it was started."""
    started = sys.argv[0]
    return NAME if shutil.which(NAME) or Path(started).name != NAME else started


class _Forgiving:
    """A stream that drops what cannot be written."""

    def __init__(self, stream: IO[str]) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        with suppress(OSError):
            self._stream.write(text)
        return len(text)

    def flush(self) -> None:
        with suppress(OSError):
            self._stream.flush()

    def __getattr__(self, name: str) -> object:
        return getattr(self._stream, name)


def forgiving(stream: IO[str]) -> IO[str]:
    """A stream for output of work that must not end because of a closed pipe or terminal, or a full disk."""
    return cast("IO[str]", _Forgiving(stream))


def say(what: str) -> None:
    """Print one line to standard error, with the time of day; it is dropped if it cannot be written."""
    now = time.time()
    clock = time.strftime("%H:%M:%S", time.localtime(now))
    print(f"{clock}.{int(now * 1000) % 1000:03d} {printable(what)}", file=forgiving(sys.stderr), flush=True)


@contextmanager
def progress_bar(*, interrupts: bool = True) -> Iterator[Progress]:
    """Shows the progress of long work while it lasts. Without a terminal, prints a line for each tenth.

    interrupts  whether a signal interrupts work in the main thread when it reports its progress
    """
    check = signals.check if interrupts else lambda: None
    if not sys.stderr.isatty():
        yield _progress_lines(check)
        return
    from rich.console import Console
    from rich.progress import BarColumn, TaskProgressColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as Bars

    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
    with Bars(*columns, console=Console(file=forgiving(sys.stderr)), transient=True) as bars:
        tasks: dict[str, int] = {}

        def progress(what: str, done: float) -> None:
            check()
            if what not in tasks:
                tasks[what] = bars.add_task(what, total=1.0)
            bars.update(tasks[what], completed=done)  # type: ignore[arg-type]

        yield progress


def _progress_lines(check: Callable[[], None]) -> Progress:
    tenths: dict[str, int] = {}

    def progress(what: str, done: float) -> None:
        check()
        if int(done * 10) != tenths.get(what):
            tenths[what] = int(done * 10)
            say(f"{what}: {done:.0%}")

    return progress
