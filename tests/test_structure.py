"""Imports: the contracts of pyproject.toml are kept, and detect an import that breaks them."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow  # runs the import linter on copies

CHECKOUT = Path(__file__).resolve().parents[1]
LINT = Path(sys.executable).with_name("lint-imports")


def lint(checkout: Path) -> subprocess.CompletedProcess[str]:
    words = [str(LINT), "--no-cache", "--no-logo"]
    environment = {**os.environ, "COLUMNS": "200"}  # a contract's name and its result in one line
    return subprocess.run(words, cwd=checkout, env=environment, capture_output=True, text=True, check=False, timeout=60)


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    shutil.copy(CHECKOUT / "pyproject.toml", tmp_path)
    shutil.copytree(CHECKOUT / "runner", tmp_path / "runner", ignore=shutil.ignore_patterns("static", "__pycache__"))
    return tmp_path


def test_no_import_breaks_a_contract(copy: Path) -> None:
    done = lint(copy)
    assert done.returncode == 0, done.stdout


@pytest.mark.parametrize(
    "module, line, contract",
    [
        ("core/scaling", "from runner.graph import Plan", "Packages lie in layers"),
        ("core/scaling", "import time", "The core is pure"),
        ("core/scaling", "from runner.resources import directory", "The core is pure"),
        ("gst/lanes", "from runner.rate_quality.study import Study", "Packages lie in layers"),
        ("page/server", "from runner.gst.server import CameraServer", "Only runner.apply imports runner.gst"),
        ("verbs/doctor", "import gi", "Only runner.gst imports gi"),
        ("vehicle/loop", "from runner.drive.series import Series", "loads no evaluation tool"),
        ("page/server", "from runner.drive.series import Series", "loads no evaluation tool"),
        ("core/model", "from runner.core.rules import RuleCall", "imports itself"),
    ],
)
@pytest.mark.parametrize("inside", ["{}\n", "def hidden() -> None:\n    {}\n", "if TYPE_CHECKING:\n    {}\n"])
def test_a_forbidden_import_is_found_anywhere(copy: Path, module: str, line: str, contract: str, inside: str) -> None:
    path = copy / "runner" / f"{module}.py"
    path.write_text(f"{path.read_text()}\n\n{inside.format(line)}")
    done = lint(copy)
    assert done.returncode == 1, done.stdout
    broken = [text for text in done.stdout.splitlines() if "BROKEN" in text]
    assert any(contract in text for text in broken), done.stdout
