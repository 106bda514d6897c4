"""Lets a benchmark use parts of the tests. Imported before them: ends with one line if their packages are missing."""

from __future__ import annotations

import sys
from importlib.util import find_spec
from pathlib import Path

TESTS = Path(__file__).resolve().parents[1] / "tests"
sys.path += [str(TESTS), str(TESTS / "integration")]
if missing := [module for module in ("pytest", "playwright") if find_spec(module) is None]:
    more = "run `make test` first, or install the extra: .venv/bin/pip install -e '.[dev]'"
    sys.exit(f"{Path(sys.argv[0]).name}: needs packages that only tests install ({', '.join(missing)}): {more}")
