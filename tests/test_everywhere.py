"""What `make everywhere` does on any machine: steps end with all that they started, and their logs become a table."""

from __future__ import annotations

import importlib.machinery
import importlib.util
import os
import shutil
import subprocess
import uuid
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest

SCRIPT = Path(__file__).resolve().parents[1] / "scripts" / "everywhere"


@pytest.fixture(scope="module", autouse=True)
def _path() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(SCRIPT.parent)
        yield


@pytest.fixture(scope="module")
def roots() -> ModuleType:
    return importlib.import_module("roots")


@pytest.fixture(scope="module")
def everywhere(_path: None) -> ModuleType:
    loader = importlib.machinery.SourceFileLoader("everywhere", str(SCRIPT))
    spec = importlib.util.spec_from_loader("everywhere", loader)
    assert spec
    module = importlib.util.module_from_spec(spec)
    loader.exec_module(module)
    return module


def marked(mark: str) -> list[str]:
    """Command lines of processes with a mark."""
    return subprocess.run(["pgrep", "-af", mark], capture_output=True, text=True, check=False).stdout.splitlines()


@pytest.mark.skipif(os.geteuid() != 0 or not shutil.which("pivot_root"), reason="needs root and pivot_root")
def test_a_step_ends_with_all_that_it_started_and_leaves_nothing_mounted(roots, tmp_path: Path) -> None:
    root, mark = roots.Root(Path("/"), tmp_path), f"mark{uuid.uuid4().hex}"
    mounts = Path("/proc/mounts").read_text()
    sleeping = f"setsid sh -c 'sleep 60; : {mark}' & sleep 60; : {mark}"
    ended = root.run(roots.Step("too long", sleeping, 0.7))
    assert (ended.status, str(ended)) == (None, "**failed**: ended after 1 s")
    fine = root.run(roots.Step("fine", "ip -o link | wc -l; echo done", 20))
    assert (fine.fine, fine.log.read_text()) == (True, "1\ndone\n")  # only the loopback
    assert str(root.run(roots.Step("bad", "exit 3", 20))) == "**failed**: status 3"
    assert marked(mark) == []
    assert Path("/proc/mounts").read_text() == mounts


LOG = """\
...s [100%]
============ 6 skipped, 2673 passed in 512.31s (0:08:32) =============
12 passed in 3.10s
1 failed, 5 passed, 2 errors in 61.00s (0:01:01)
"""


def test_results_of_all_runs_of_pytest_are_added_up(everywhere, tmp_path: Path) -> None:
    log = tmp_path / "tests.log"
    log.write_text(LOG)
    ended = {"tests": everywhere.Ended(2, 600.0, log), "soak": everywhere.Ended(0, 600.0, tmp_path / "soak.log")}
    (tmp_path / "soak.log").write_text("openings | 0 problems, 12 s\n")
    assert everywhere.tests(ended) == "2690 / 3 / 6; tests **failed**: status 2"


def test_a_system_that_is_too_old_must_say_so(everywhere, tmp_path: Path) -> None:
    log = tmp_path / "setup.log"
    said = "scripts/setup: Python 3.9.2 of this system is too old: ..."
    log.write_text(f"scripts/setup .venv\n{said}\nmake: *** [setup] Error 1\n")
    assert everywhere.refusal(everywhere.Ended(2, 1.0, log)) == f"refused: {said}"
    assert "**failed**" in everywhere.refusal(everywhere.Ended(0, 1.0, log))


def test_steps_come_with_those_that_they_need(everywhere) -> None:
    assert everywhere.with_needed(["replay"]) == {"setup", "demo", "replay"}
