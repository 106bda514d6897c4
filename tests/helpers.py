"""Shared by the tests: vehicles, drives through the pure core, the command line, configuration files to break."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from runner.__main__ import main
from runner.configuration.compose import compose
from runner.configuration.config import configuration
from runner.configuration.origin import Composed
from runner.core.decision import Setting
from runner.core.events import parse
from runner.core.model import Vehicle
from runner.core.step import Run, start, step
from runner.resources import directory
from runner.settings import Setup

CONF = directory("conf")


@cache
def setup(*overrides: str) -> Setup:
    return configuration(["source=test", *overrides]).setup()


def vehicle(*overrides: str) -> Vehicle:
    return setup(*overrides).vehicle


def source_for(graph: str) -> str:
    """The name of a source that serves a packaged graph."""
    return "v4l2" if graph.startswith("pass_through") else "test"


@cache
def composed_once(overrides: tuple[str, ...]) -> Composed:
    """A packaged configuration for tests that only read it: composing takes most of the time of many."""
    return compose(overrides)


def shared_cache(factory: pytest.TempPathFactory) -> Path:
    """An empty cache at first, shared by all processes of pytest-xdist: a clip is rendered once."""
    base = factory.getbasetemp()
    return (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "cache"


@contextmanager
def out_of_reach(directory: Path) -> Iterator[None]:
    """This process may not search a directory, as if it belonged to another user, also if it is root."""
    mode, user = directory.stat().st_mode, os.geteuid()
    directory.chmod(0)
    if user == 0:
        os.seteuid(65534)  # nobody
    try:
        yield
    finally:
        os.seteuid(user)
        directory.chmod(mode)


def carries(kbps: float) -> dict[str, Any]:
    """Evidence, as logged, of a link that was busy since the report before and carried this much, kbit/s."""
    return {"busy_kbit": 0.04 * kbps, "busy_s": 0.04, "kbit": 0.04 * kbps}


class Drive:
    """A run that accepts events as JSON keys; time does not advance unless `t` is given."""

    def __init__(self, *overrides: str) -> None:
        self.vehicle = vehicle(*overrides)
        self.run = start(self.vehicle)

    def feed(self, event: str, **keys: Any) -> Run:
        self.run = step(self.vehicle, self.run, parse({"t": self.run.state.t, "event": event} | keys))
        return self.run

    def accept(self, event: str, **keys: Any) -> Run:
        run = self.feed(event, **keys)
        assert run.refused is None
        return run

    def reports(self, t: float, kbps: float, **evidence: Any) -> Any:
        """The total after a report of a link that is busy and carries this much; `evidence` replaces what that says."""
        received = {"kbps": kbps, "queue_ms": 0, "loss": 0, "state": "clear", "rtt_ms": 30}
        self.accept("link_measured", t=t, **received, evidence=carries(kbps) | evidence)
        return self.total

    @property
    def total(self) -> Any:
        return self.run.decision.total

    def __getitem__(self, camera: str) -> Setting:
        return self.run.decision.settings[camera]

    def sent(self, camera: str) -> tuple[int, float | None]:
        """The bitrate in whole kbit/s and the factor that a camera is sent with."""
        setting = self[camera]
        return setting.kbps, None if setting.scaling is None else float(setting.scaling)


class Result(NamedTuple):
    status: int
    out: str
    err: str

    @property
    def problems(self) -> list[str]:
        """The reported problems, after checking that everything else is as expected for invalid input."""
        *problems, summary = self.err.splitlines()
        count = len(problems)
        assert self.status == 2, self.err
        assert self.out == ""
        assert summary == f"{count} problem{'s' * (count != 1)}, nothing was started"
        return problems


class Command:
    def __init__(self, capture: pytest.CaptureFixture[str]) -> None:
        self._capture = capture

    def __call__(self, *words: str) -> Result:
        self._capture.readouterr()
        status = main(words)
        return Result(status, *self._capture.readouterr())


def process(*words: str, stdin: str | bytes = b"", **options: Any) -> Result:
    """The command line as a process."""
    data = stdin.encode() if isinstance(stdin, str) else stdin
    words = (sys.executable, "-m", "runner", *words)
    done = subprocess.run(words, input=data, capture_output=True, check=False, **options)
    return Result(done.returncode, done.stdout.decode(), done.stderr.decode())


class UserConf:
    """A user's configuration directory, created by the first write."""

    def __init__(self, path: Path) -> None:
        self.path = path

    @property
    def word(self) -> str:
        return f"conf={self.path}"

    def write(self, name: str, text: str | bytes) -> UserConf:
        path = self.path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(text.encode() if isinstance(text, str) else text)
        return self

    def change(self, name: str, changes: Mapping[str, str]) -> UserConf:
        """A copy of a packaged file, or of one written before, with the first occurrence of each text replaced."""
        own = self.path / name
        text = (own if own.exists() else CONF / name).read_text()
        for old, new in changes.items():
            assert old in text, f"{name} has no {old!r}"
            text = text.replace(old, new, 1)
        return self.write(name, text)
