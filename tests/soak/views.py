"""Changes of views at random, in a real drive that sends what is seen, watched by a browser."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

TEST = Path(__file__).parents[1] / "integration" / "test_page_new_views.py"


def soak(seed: int, scale: float) -> list[str]:
    """The test of the page with 1000 changes; each takes about a second and a half, ten at most."""
    changes = max(40, round(1000 * scale))
    environment = {**os.environ, "TOD_NEW_VIEWS": str(changes), "SOAK_SEED": str(seed)}
    command = [sys.executable, "-m", "pytest", "-s", str(TEST)]
    try:
        done = subprocess.run(command, env=environment, check=False, timeout=120 + 10 * changes)
    except subprocess.TimeoutExpired as late:
        return [f"not done after {late.timeout:g} s"]
    return ["see above"] if done.returncode else []
