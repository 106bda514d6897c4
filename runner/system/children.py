"""Child processes that do not outlive this one, however it ends, and that are never waited for without a timeout."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import IO

from runner.errors import RunError
from runner.system.signals import LIFELINE

ROOT = Path(__file__).resolve().parents[2]
KILLED_S = 1.0  # a killed process ends within this time, unless it is blocked in the kernel


def bound(command: Sequence[str]) -> list[str]:
    """Wrap a command so that the kernel kills it when this process, or the thread that starts it, ends."""
    launcher = str(Path(__file__).with_name("bound.py"))
    return [sys.executable, "-I", "-S", launcher, str(os.getpid()), *command]


def environment() -> dict[str, str]:
    """This process's environment, extended so that `python -m runner` finds this package from any directory."""
    paths = [str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}


def end(process: subprocess.Popen[bytes] | subprocess.Popen[str], within_s: float) -> bool:
    """Wait for a process that has been asked to end, and kill it after a timeout.

    returns  whether it ended without being killed; a killed one that is blocked in the kernel may still run
    """
    try:
        process.wait(within_s)
    except subprocess.TimeoutExpired:
        process.kill()
        with suppress(subprocess.TimeoutExpired):
            process.wait(KILLED_S)
        return False
    return True


def ending(status: int) -> str:
    """How a process ended, in words."""
    if status >= 0:
        return f"status {status}"
    try:
        return f"killed by {signal.Signals(-status).name}"
    except ValueError:
        return f"killed by signal {-status}"


class VerbProcess:
    """A verb as a child process. It shuts down cleanly when asked to, or when this process ends.

    A pipe whose other end is open in this process signals both. Terminal signals reach only this process, which decides
    the order in which processes end.

    name    for messages
    before  prefix of its command line
    stderr  file for its standard error; None: the same as this process's
    env     variables that its environment has besides this process's
    """

    def __init__(
        self,
        name: str,
        verb: str,
        words: Sequence[str],
        before: Sequence[str] = (),
        stderr: IO[str] | None = None,
        env: Mapping[str, str] | None = None,
    ) -> None:
        self.name, self._stderr = name, stderr
        read, self._lifeline = os.pipe()
        try:
            self.process = subprocess.Popen(
                [*before, sys.executable, "-m", "runner", verb, *words],
                stderr=stderr,
                env={**environment(), **(env or {}), LIFELINE: str(read)},
                pass_fds=[read],
                start_new_session=True,
            )
        finally:
            os.close(read)

    def poll(self) -> int | None:
        """Its exit status, None while it runs."""
        return self.process.poll()

    def check(self) -> None:
        """raises RunError if it has ended, with its error output"""
        status = self.poll()
        if status is None:
            return
        text = ""
        if self._stderr:
            self._stderr.seek(0)
            text = self._stderr.read().strip()
        raise RunError(f"{self.name} ended early ({ending(status)})" + (f":\n{text}" if text else ""))

    def request_end(self) -> None:
        """Ask it to end; repeated calls have no effect."""
        if self._lifeline >= 0:
            os.close(self._lifeline)
            self._lifeline = -1

    def kill(self) -> None:
        self.process.kill()
