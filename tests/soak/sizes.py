"""New sizes of all cameras, twice a second, before the eyes of a browser: no decoder may break."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

TEST = Path(__file__).parents[1] / "integration" / "test_page.py"


def soak(seed: int, scale: float) -> list[str]:
    """The test of the page, for a minute and a half."""
    turns = max(20, round(180 * scale))
    command = [sys.executable, "-m", "pytest", str(TEST), "-k", "new_size"]
    done = subprocess.run(command, env={**os.environ, "TOD_NEW_SIZES": str(turns)}, check=False)
    print(f"{turns} new sizes of each camera")
    return ["see above"] if done.returncode else []
