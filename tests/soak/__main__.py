"""Long repetitions of what a drive must survive: signals, stalls, openings, kills, frozen cameras, slow readers,
new sizes, garbage, reports of any kind, clocks that drift apart, outages with keys, addresses that change, and
thousands of changes that must leave nothing behind.

    make soak                           everything, about an hour on two cores
    SOAK=0.1 make soak                  a tenth of it
    SOAK_SEED=7 make soak               the same random choices again; the seed is printed
    make soak PARTS="stalls hostile"    some parts only
    KEYS=1 make soak                    encrypted: TLS, passwords and SRTP for video, TLS 1.3 for control

Parts run one after the other in two lanes. One lane has the parts with limits in time, the other those that only repeat
or wait. Every part prints its steps and figures; the exit status is 1 if anything failed.
"""

from __future__ import annotations

import os
import random
import subprocess
import sys
import time
import traceback
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import churn
import clocks
import hostile
import ip_camera
import kills
import openings
import outages
import readers
import reports
import roaming
import signals
import sizes
import stalls

from rig import CHECKOUT


def _tests(_seed: int, _scale: float) -> list[str]:
    """Those of pytest that `make test` leaves out."""
    status = subprocess.run([sys.executable, "-m", "pytest", "-m", "soak"], check=False, cwd=CHECKOUT).returncode
    return [f"pytest ended with {status}"] if status else []


Part = Callable[[int, float], list[str]]  # seed, scale -> problems
PARTS: dict[str, Part] = {
    "tests": _tests,
    "signals": lambda seed, scale: [str(run) for run in signals.soak(seed, max(8, round(80 * scale)))],
    "stalls": stalls.soak,
    "openings": openings.soak,
    "kills": kills.soak,
    "ip_camera": ip_camera.soak,
    "readers": readers.soak,
    "sizes": sizes.soak,
    "hostile": hostile.soak,
    "reports": reports.soak,
    "clocks": clocks.soak,
    "roaming": roaming.soak,
    "outages": outages.soak,
    "churn": churn.soak,
}


ASIDE = ("clocks", "churn")  # the second lane
BACKGROUND = str(CHECKOUT / "scripts" / "background")
BEFORE = {"churn": [BACKGROUND]}  # it uses all the time that it is given


def main(chosen: Sequence[str]) -> int:
    scale = float(os.environ.get("SOAK", "1"))
    seed = int(os.environ.get("SOAK_SEED", random.randrange(10**6)))
    if unknown := set(chosen) - PARTS.keys():
        print(f"unknown part {', '.join(sorted(unknown))}; expected one of {', '.join(PARTS)}", file=sys.stderr)
        return 2
    if len(chosen) == 1:
        return _run(chosen[0], seed, scale)
    print(f"seed {seed}, scale {scale:g}", flush=True)
    os.environ |= {"SOAK_SEED": str(seed), "PYTHONUNBUFFERED": "1"}  # of the parts, whose lines are to come at once
    lanes = [[name for name in chosen or PARTS if (name in ASIDE) == aside] for aside in (False, True)]
    with ThreadPoolExecutor(len(lanes)) as pool:
        failed = [name for names in pool.map(_run_each, lanes) for name in names]
    print(f"failed: {', '.join(failed)}" if failed else "no problems")
    return 1 if failed else 0


def _run_each(names: Sequence[str]) -> list[str]:
    """Run parts, each in a process of its own. Returns those that failed."""
    return [name for name in names if _run_apart(name)]


def _run_apart(name: str) -> int:
    """The exit status of a part, whose lines are printed with its name as they come."""
    command = [*BEFORE.get(name, ()), sys.executable, str(Path(__file__).parent), name]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as child:
        assert child.stdout
        for line in child.stdout:
            print(f"{name:9} | {line}", end="", flush=True)
    return child.returncode


def _run(name: str, seed: int, scale: float) -> int:
    print(f"seed {seed}, scale {scale:g}", flush=True)
    began = time.monotonic()
    try:
        problems = PARTS[name](seed, scale)
    except Exception:  # with what led to it: nobody watches
        problems = [traceback.format_exc()]
    print(f"{len(problems)} problems, {time.monotonic() - began:.0f} s", flush=True)
    print("\n".join(problems), end="\n" if problems else "", flush=True)
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
