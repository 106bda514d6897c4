"""Seconds that `tod-runner validate` takes for a user's directory, alone and with all packaged files.

python bench/validate.py [runs]

The directory is tests/fleet: 2 vehicles, 6 kinds of camera, 4 modes, 3 graphs, 3 sources, 2 pqos. The whole process
is timed; the median of five runs is compared with the limit for two idle cores.
"""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path
from statistics import median

from table import Row, show

FLEET = Path(__file__).resolve().parents[1] / "tests/fleet"
MOST_S = {"": 1.5, "all=true": 6.0}  # by argument


def seconds(*words: str) -> float:
    command = [sys.executable, "-m", "runner", "validate", f"conf={FLEET}", *words]
    began = time.monotonic()
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return time.monotonic() - began


def rows(runs: int = 5) -> list[Row]:
    found = []
    for words, most in MOST_S.items():
        taken = sorted(seconds(*words.split()) for _ in range(runs))
        note = f"{taken[0]:.2f} to {taken[-1]:.2f} in {runs} runs"
        found.append(Row(f"validate {words or 'of a directory'}", median(taken), "s", most=most, note=note))
    return found


if __name__ == "__main__":
    found = rows(*map(int, sys.argv[1:]))
    show(found)
    sys.exit(not all(row.is_acceptable for row in found))
