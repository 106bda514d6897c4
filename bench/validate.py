"""Seconds that `tod-runner validate` takes for a user's directory, alone and with all packaged files.

python bench/validate.py [runs]

The directory is tests/fleet: 2 vehicles, 6 kinds of camera, 4 modes, 3 graphs, 3 sources, 2 pqos. The whole process
is timed; the median of five runs is compared with a limit per configuration and idle core.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path
from statistics import median

from table import Row, show

FLEET = Path(__file__).resolve().parents[1] / "tests/fleet"
START_S, EACH_S = 1.0, 0.25  # at most, per configuration and core


def measured(*words: str) -> tuple[float, int]:
    """Seconds, and the number of configurations."""
    command = [sys.executable, "-m", "runner", "validate", f"conf={FLEET}", *words]
    began = time.monotonic()
    out = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout
    return time.monotonic() - began, int(out.split()[3])


def rows(runs: int = 5) -> list[Row]:
    found = []
    for words in ("", "all=true"):
        taken, counts = zip(*sorted(measured(*words.split()) for _ in range(runs)), strict=True)
        most = START_S + EACH_S * counts[0] / len(os.sched_getaffinity(0))
        note = f"{taken[0]:.2f} to {taken[-1]:.2f} in {runs} runs, {counts[0]} configurations"
        found.append(Row(f"validate {words or 'of a directory'}", median(taken), "s", most=most, note=note))
    return found


if __name__ == "__main__":
    found = rows(*map(int, sys.argv[1:]))
    show(found)
    sys.exit(not all(row.is_acceptable for row in found))
