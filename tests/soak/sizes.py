"""New sizes of all cameras, twice a second, watched by a browser: no decoder may fail."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import keyed

FILE = Path(__file__).parents[1] / "integration" / "test_page_sides.py"
TEST = f"{FILE}::test_two_size_changes_a_second_break_no_decoder"


def soak(seed: int, scale: float) -> list[str]:
    """The test of the page with 180 changes; each takes about a second, ten at most."""
    changes = max(20, round(180 * scale))
    command = [sys.executable, "-m", "pytest", TEST]
    environment = {**os.environ, "TOD_NEW_SIZES": str(changes)}
    if keys := keyed.keys():
        environment["TOD_NEW_SIZES_KEYS"] = str(keys)
    try:
        done = subprocess.run(command, env=environment, check=False, timeout=60 + 10 * changes)
    except subprocess.TimeoutExpired as late:
        return [f"not done after {late.timeout:g} s"]
    print(f"{changes} new sizes of each camera")
    return ["see above"] if done.returncode else []
