"""Seconds that `tod-runner validate` takes for a user's directory, alone and with all that is packaged.

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

FLEET = Path(__file__).resolve().parents[1] / "tests/fleet"
MOST_S = {"": 1.5, "all=true": 6.0}  # by argument


def seconds(*words: str) -> float:
    command = [sys.executable, "-m", "runner", "validate", f"conf={FLEET}", *words]
    began = time.monotonic()
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return time.monotonic() - began


def main() -> int:
    runs = int(sys.argv[1]) if len(sys.argv) > 1 else 5
    slow = 0
    for words, most in MOST_S.items():
        taken = sorted(seconds(*words.split()) for _ in range(runs))
        slow += median(taken) > most
        print(f"validate {words or 'of a directory'}: median {median(taken):.2f} s of {runs} runs, {taken[0]:.2f} to "
              f"{taken[-1]:.2f} s; at most {most:g} s")  # fmt: skip
    return 1 if slow else 0


if __name__ == "__main__":
    sys.exit(main())
