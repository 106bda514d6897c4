"""Child processes that do not end when asked to."""

from __future__ import annotations

import subprocess
from typing import Any, cast

import pytest

from runner.system.children import VerbProcess, end
from runner.verbs.demo import _end


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


class _Side:
    """Stands in for a side of a demo."""

    def __init__(self, name: str) -> None:
        self.name, self.process, self.asked = name, _Blocked(), False
        self.poll = self.process.poll

    def request_end(self) -> None:
        self.asked = True


def test_a_process_that_cannot_be_killed_is_not_waited_for() -> None:
    process = _Blocked()
    assert not end(cast("subprocess.Popen[bytes]", process), 0.0)
    assert process.killed


def test_a_demo_reports_a_side_that_cannot_be_killed_and_ends_the_other(capsys: pytest.CaptureFixture[str]) -> None:
    sides: Any = [_Side("the vehicle's side"), _Side("the operator's side")]
    _end(cast("list[VerbProcess]", sides))
    assert all(side.asked and side.process.killed for side in sides)
    lines = capsys.readouterr().err.splitlines()
    assert [line.partition("s side ")[2] for line in lines] == [
        "did not end within 2.2 s and was killed but still runs, blocked in the kernel"
    ] * 2
