"""A verb as a child process that is started again whenever it ends."""

from __future__ import annotations

import os
import threading
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress

from runner.system import children
from runner.system.backoff import pause_s
from runner.system.children import VerbProcess, ending

BACKOFF_S = (0.5, 30.0)  # between two starts, at first and at most
STEADY_S = 10.0  # one that has run for so long is started again at once
LAST_S = 0.5  # how long its last lines may take to arrive after it has ended; a child of its own may hold the pipe


class RestartedProcess:
    """The process of a verb. All methods are to be called from one thread, `kill` from any.

    verb, words  its command line
    on_line      called, from another thread, with each line of its error output
    """

    def __init__(self, name: str, verb: str, words: Sequence[str], on_line: Callable[[str], None]) -> None:
        self.name, self._verb, self._words, self._on_line = name, verb, words, on_line
        self._process: VerbProcess | None = None
        self._failures = 0
        self._due = self._started = float("-inf")
        self._last = deque[str](maxlen=2)  # lines of its output: why it failed
        self._reading = threading.Thread()
        self.fault: str | None = None  # how it ended, until it runs again

    def look(self, now: float) -> None:
        """Start it if it is due; to be called several times a second, with time.monotonic."""
        if self._process is None:
            if now >= self._due:
                self._start(now)
            return
        status = self._process.poll()
        if status is None:
            if now - self._started > STEADY_S:
                self._failures = 0
            return
        self._process.request_end()
        self._process = None
        self._reading.join(LAST_S)
        pause = pause_s(self._failures, *BACKOFF_S)
        self._failures, self._due = self._failures + 1, now + pause
        why = f": {'; '.join(self._last)}" if status > 0 and self._last else ""
        self.fault = f"its station ended ({ending(status)}){why}; starting again in {pause:g} s"

    def request_end(self) -> None:
        if self._process:
            self._process.request_end()

    def end(self, within_s: float) -> bool:
        """Wait until it has ended, after `request_end`; returns whether it did so without being killed."""
        process, self._process = self._process, None
        return process is None or children.end(process.process, within_s)

    def kill(self) -> None:
        if process := self._process:
            process.kill()

    def _start(self, now: float) -> None:
        read, write = os.pipe()
        with os.fdopen(write, "w") as stderr:
            self._process = VerbProcess(self.name, self._verb, self._words, stderr=stderr)
        self._started, self.fault = now, None
        self._last.clear()
        self._reading = threading.Thread(target=self._read, args=(read,), name=f"output of {self.name}", daemon=True)
        self._reading.start()

    def _read(self, descriptor: int) -> None:
        with suppress(OSError), os.fdopen(descriptor, errors="replace") as lines:
            for line in map(str.rstrip, lines):
                if line:
                    self._last.append(line)
                    self._on_line(line)
