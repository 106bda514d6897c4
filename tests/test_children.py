"""Child processes that do not end when asked to."""

from __future__ import annotations

import subprocess
from typing import cast

from runner.system.children import end


class _Blocked:
    """Stands in for a process that is blocked in the kernel, so that even SIGKILL does not end it."""

    def __init__(self) -> None:
        self.killed = False

    def wait(self, within_s: float) -> int:
        raise subprocess.TimeoutExpired("blocked", within_s)

    def poll(self) -> None:
        return None

    def kill(self) -> None:
        self.killed = True


def test_a_process_that_cannot_be_killed_is_not_waited_for() -> None:
    process = _Blocked()
    assert not end(cast("subprocess.Popen[bytes]", process), 0.0)
    assert process.killed
