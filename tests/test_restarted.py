"""A child process that is started again whenever it ends."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable, Iterator

import pytest

from runner.system import restarted
from runner.system.restarted import RestartedProcess


@pytest.fixture
def lines() -> list[str]:
    return []


@pytest.fixture
def failing(lines: list[str], monkeypatch: pytest.MonkeyPatch) -> Iterator[RestartedProcess]:
    """A verb that fails at once."""
    monkeypatch.setattr(restarted, "BACKOFF_S", (0.1, 0.3))
    process = RestartedProcess("it", "operator", ["socket="], lines.append)
    yield process
    process.request_end()
    assert process.end(10)


def look_until(process: RestartedProcess, done: Callable[[], object]) -> None:
    end = time.monotonic() + 60
    while not done():
        process.look(time.monotonic())
        assert time.monotonic() < end
        time.sleep(0.01)


def test_it_is_started_again_after_longer_and_longer_pauses(failing: RestartedProcess, lines: list[str]) -> None:
    pauses = []
    for pause in (0.1, 0.2, 0.3, 0.3):
        look_until(failing, lambda: failing.fault)
        ended = time.monotonic()
        pauses.append(failing.fault)
        look_until(failing, lambda: failing.fault is None)
        assert time.monotonic() - ended >= pause - 0.02
    reason = "command line: socket: '': must not be empty"
    assert pauses == [
        f"its station ended (status 2): {reason}; starting again in {pause:g} s" for pause in (0.1, 0.2, 0.3, 0.3)
    ]
    assert lines[0] == reason


def test_one_that_is_killed_has_no_reason_of_its_own(lines: list[str]) -> None:
    process = RestartedProcess("it", "ros", ["control.port=9"], lines.append)
    process.look(0.0)
    assert process._process is not None
    os.kill(process._process.process.pid, signal.SIGKILL)
    look_until(process, lambda: process.fault)
    assert process.fault == "its station ended (killed by SIGKILL); starting again in 0.5 s"
