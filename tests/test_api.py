"""The public API: a package of rules, installed as a wheel, runs unchanged and is well typed."""

from __future__ import annotations

import importlib
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow  # builds and installs a wheel

CHECKOUT = Path(__file__).resolve().parents[1]
PACKAGE = CHECKOUT / "tests" / "rule_package"
MODES = """
single:
  demand_from_roi: {}
  keep_operator_settings: {}
automatic:
  total_from_prediction: {start_kbps: 3000}
  first_cap: {rule: night_cap, cap_kbps: 4000}
  night_cap: {cap_kbps: 1234}
  demand_from_roi: {}
  share_by_demand: {}
  scaling_from_rate_quality: {}
collective:
  total_from_operator: {start_kbps: 3000}
  demand_from_roi: {}
  share_by_demand: {}
  scaling_from_rate_quality: {}
"""


def run(*command: str, cwd: Path | None = None, **variables: str) -> str:
    environment = {**os.environ, **variables}
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False, timeout=120, cwd=cwd)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def built(source: Path, made: Path) -> Path:
    """Directory that the wheel of a package is installed into, without its dependencies."""
    pip = (sys.executable, "-m", "pip", "--disable-pip-version-check", "-q")
    run(*pip, "wheel", "--no-deps", "--no-build-isolation", "-w", str(made), str(source))
    (wheel,) = made.glob("*.whl")
    run(*pip, "install", "--no-deps", "--no-index", "--no-compile", "--target", str(made / "site"), str(wheel))
    return made / "site"


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The package of rules."""
    made = tmp_path_factory.mktemp("wheel")
    copy = made / "source"
    copy.mkdir()
    for path in PACKAGE.rglob("*"):
        if path.is_file() and path.suffix in (".py", ".toml", ".typed") and "build" not in path.parts:
            target = copy / path.relative_to(PACKAGE)
            target.parent.mkdir(exist_ok=True)
            target.write_bytes(path.read_bytes())
    return built(copy, made)


def test_the_projects_own_wheel_runs_in_an_empty_directory(tmp_path: Path) -> None:
    copy, empty = tmp_path / "source", tmp_path / "empty"
    empty.mkdir()
    copy.mkdir()
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(CHECKOUT / name, copy)
    for name in ("runner", "conf", "schemas"):
        shutil.copytree(CHECKOUT / name, copy / name, symlinks=True, ignore=shutil.ignore_patterns("__pycache__"))
    site = built(copy, tmp_path / "made")
    sources = (path for name in ("runner", "runner/conf", "runner/schemas") for path in (copy / name).rglob("*"))
    files = {path.relative_to(copy) for path in sources if path.is_file() and "__pycache__" not in path.parts}
    assert {path for path in files if not (site / path).is_file()} == set()
    command = (sys.executable, "-m", "runner")
    for words in (("print", "source=test", "total_kbps=3000"), ("validate",), ("--version",)):
        run(*command, *words, cwd=empty, PYTHONPATH=str(site))
    assert list(empty.iterdir()) == []


def test_a_rule_of_an_installed_package_decides(installed: Path, tmp_path: Path) -> None:
    (tmp_path / "modes").mkdir()
    (tmp_path / "modes" / "night.yaml").write_text(MODES)
    words = ("print", f"conf={tmp_path}", "modes=night", "source=test", "total_kbps=5000")
    printed = run(sys.executable, "-m", "runner", *words, PYTHONPATH=f"{installed}{os.pathsep}{CHECKOUT}")
    assert "total 1234 kbit/s" in printed.splitlines()[0]
    assert "total 5000 -> 4000: night; total 4000 -> 1234: night" in printed


def test_the_package_is_well_typed(tmp_path: Path) -> None:
    words = ("--strict", "--cache-dir", str(tmp_path), "-p", "night_rules")
    run(sys.executable, "-m", "mypy", *words, MYPYPATH=f"{PACKAGE}{os.pathsep}{CHECKOUT}")


def test_the_documented_names_exist() -> None:
    rows = re.findall(r"^\| `from (\S+) import ([^`]+)`", (CHECKOUT / "docs" / "api.md").read_text(), re.MULTILINE)
    assert {module for module, _ in rows} == {
        f"runner.{name}" for name in ("rules", "model", "state", "live", "frames")
    }
    for module, names in rows:
        for name in names.split(", "):
            assert hasattr(importlib.import_module(module), name), f"{module}.{name}"
