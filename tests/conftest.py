"""The environment of every test: neither the configuration nor the cache of the user who runs it."""

from __future__ import annotations

import gc
import os
import tempfile
import uuid
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import helpers
import pytest
from helpers import Command, UserConf, shared_cache
from hypothesis import settings

from runner.__main__ import NEW_OBJECTS
from runner.configuration import config
from runner.configuration.origin import Composed

# GStreamer lists its plugins once, not for each new cache, and again whenever one of them changes.
REGISTRY = Path(tempfile.gettempdir()) / f"gstreamer-registry-of-tests-{os.getuid()}.bin"

# A busy machine may take longer than 0.2 s for an example. A few examples, the same ones in each run; `make soak` draws
# more, and others.
settings.register_profile("same", deadline=None, derandomize=True, max_examples=25)
settings.register_profile("random", deadline=None, derandomize=False, print_blob=True)
settings.load_profile("same")


def pytest_configure() -> None:
    gc.set_threshold(NEW_OBJECTS)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        marks = {mark.name for mark in item.iter_markers()}
        if marks & {"timed", "alone"} and "integration" not in item.path.parts:
            raise pytest.UsageError(f"{item.nodeid}: `make test` runs timed tests of tests/integration only")


def pytest_collection_finish() -> None:
    gc.freeze()  # what has been imported stays: it need not be searched for garbage again and again


@pytest.hookimpl(tryfirst=True)
def pytest_warning_recorded(warning_message: warnings.WarningMessage) -> None:
    """Workers of pytest-xdist pass a warning on by its module, and GLib's claim one that does not exist (gobject)."""
    if warning_message.category.__module__ == "gobject":
        warning_message.category = RuntimeWarning
        warning_message.message = RuntimeWarning(f"GLib: {warning_message.message}")


@pytest.fixture(scope="session", autouse=True)
def nothing_of_this_user(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """For what several tests share, too."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TOD_SITE", "")
        patch.setenv("XDG_STATE_HOME", str(tmp_path_factory.mktemp("state")))
        yield


@pytest.fixture(autouse=True)
def clean_environment(monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory) -> None:
    monkeypatch.delenv("TOD_CONF", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(shared_cache(tmp_path_factory)))
    monkeypatch.setenv("GST_REGISTRY", str(REGISTRY))
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path_factory.getbasetemp() / f"state-{uuid.uuid4().hex}"))


@pytest.fixture
def tod(capfd: pytest.CaptureFixture[str]) -> Command:
    """The command line, run in this process."""
    return Command(capfd)


@pytest.fixture
def unprinted(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make only the page and report.json of a report: the figures for print take most of the time."""
    monkeypatch.setattr("runner.drive.print.write_figures", lambda *_: None)


@pytest.fixture
def composed_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Compose each packaged configuration once for all tests that use this."""

    def compose(overrides: Sequence[str], user: Path | None = None, *more: Any) -> Composed:
        return real(overrides, user, *more) if user or any(more) else helpers.composed_once(tuple(overrides))

    real = config.compose
    monkeypatch.setattr(config, "compose", compose)


@pytest.fixture
def conf(tmp_path: Path) -> UserConf:
    """An empty user configuration directory, at a path that is awkward to quote."""
    return UserConf(tmp_path / "my conf ü")
