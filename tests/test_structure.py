"""Imports: the contracts of pyproject.toml are kept, and detect an import that breaks them."""

from __future__ import annotations

import os
import re
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


FORBIDDEN = [  # module, line, the contract that it breaks
    ("core/scaling", "from runner.graph import Plan", "Packages lie in layers"),
    ("core/scaling", "import time", "The core is pure"),
    ("core/scaling", "from runner.resources import directory", "The core is pure"),
    ("gst/lanes", "from runner.rate_quality.study import Study", "Packages lie in layers"),
    ("page/server", "from runner.gst.server import CameraServer", "Only runner.apply imports runner.gst"),
    ("verbs/doctor", "import gi", "Only runner.gst imports gi"),
    ("vehicle/loop", "from runner.drive.series import Series", "loads no evaluation tool"),
    ("page/server", "from runner.drive.series import Series", "loads no evaluation tool"),
    ("core/model", "from runner.core.rules import RuleCall", "imports itself"),
]


@pytest.mark.parametrize("inside", ["{}\n", "def hidden() -> None:\n    {}\n", "if TYPE_CHECKING:\n    {}\n"])
def test_forbidden_imports_are_found_anywhere(copy: Path, inside: str) -> None:
    for module, line, _ in FORBIDDEN:
        path = copy / "runner" / f"{module}.py"
        path.write_text(f"{path.read_text()}\n\n{inside.format(line)}")
    done = lint(copy)
    assert done.returncode == 1, done.stdout
    parts = re.split(r"\n\n(.+)\n-{5,}\n", done.stdout.partition("Broken contracts")[2])
    named = dict(zip(parts[1::2], parts[2::2], strict=True))
    for module, line, contract in FORBIDDEN:
        importer, imported = f"runner.{module.replace('/', '.')}", line.split()[1]
        found = [text for name, text in named.items() if contract in name]
        names = [name.rpartition(".")[2] for name in (importer, imported)]
        texts = (f"{importer} -> {imported} (l.", f"- .{names[0]} -> .{names[1]} (")
        assert any(text in part for text in texts for part in found), (module, line, done.stdout)
