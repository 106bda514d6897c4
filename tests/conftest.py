"""What every test runs in: no configuration and no cache of the person who runs it."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers import Command, UserConf


@pytest.fixture(autouse=True)
def nobodys_environment(monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory) -> None:
    monkeypatch.delenv("TOD_CONF", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.getbasetemp() / "cache"))


@pytest.fixture
def tod(capfd: pytest.CaptureFixture[str]) -> Command:
    """The command line without a process of its own."""
    return Command(capfd)


@pytest.fixture
def conf(tmp_path: Path) -> UserConf:
    """A configuration directory of the user's own, empty, at a place that is awkward to quote."""
    return UserConf(tmp_path / "my conf ü")
