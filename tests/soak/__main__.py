"""Long repetitions of faults that a drive must survive: signals, stalls, openings, kills, frozen cameras, slow readers,
new sizes, new views, garbage, reports and links of any kind, clocks that drift apart, outages with keys, addresses that
change, variants of cameras, bags and players as people own them, and thousands of changes that must leak nothing.

    make soak                           everything, about 100 minutes on two cores
    SOAK=0.1 make soak                  a tenth of it
    SOAK_SEED=7 make soak               repeats the random choices; each run prints its seed
    make soak PARTS="stalls hostile"    some parts only
    KEYS=1 make soak                    encrypted: TLS, passwords and SRTP for video, TLS 1.3 for control

The tests run alone, then the parts in two lanes: one for those with time limits, the other for those that only repeat
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
import links
import openings
import outages
import readers
import reports
import roaming
import signals
import sizes
import stalls
import views

from rig import CHECKOUT

DRAWS = 5  # of other examples for each property test


def _tests(seed: int, scale: float) -> list[str]:
    """Tests that `make test` excludes, other examples for its properties, and mutations of packaged files."""
    properties = ("-m", "pytest", "-m", "hypothesis and not soak", "-n", "auto", "--hypothesis-profile=random")
    draws = range(seed, seed + max(1, round(DRAWS * scale)))
    commands = {
        "pytest": ("-m", "pytest", "-m", "soak and not sources and not players"),
        **{f"properties with seed {draw}": (*properties, f"--hypothesis-seed={draw}") for draw in draws},
        "golden": ("tests/golden", "mutations"),
    }
    ended = {
        name: subprocess.run([sys.executable, *words], check=False, cwd=CHECKOUT).returncode
        for name, words in commands.items()
    }
    return [f"{name} ended with {status}" for name, status in ended.items() if status]


def _variants(mark: str) -> Part:
    """Variants of one kind of source or player, each with a test of its own."""

    def soak(_seed: int, _scale: float) -> list[str]:
        words = (sys.executable, "-m", "pytest", "-m", f"soak and {mark}", "--durations=10")
        status = subprocess.run(words, check=False, cwd=CHECKOUT).returncode
        return [f"pytest of {mark} ended with {status}"] if status else []

    return soak


Part = Callable[[int, float], list[str]]  # seed, scale -> problems
PARTS: dict[str, Part] = {
    "tests": _tests,
    "signals": lambda seed, scale: [str(run) for run in signals.soak(seed, max(8, round(80 * scale)))],
    "stalls": stalls.soak,
    "openings": openings.soak,
    "kills": kills.soak,
    "ip_camera": ip_camera.soak,
    "sources": _variants("sources"),
    "players": _variants("players"),
    "readers": readers.soak,
    "sizes": sizes.soak,
    "views": views.soak,
    "hostile": hostile.soak,
    "reports": reports.soak,
    "links": links.soak,
    "clocks": clocks.soak,
    "roaming": roaming.soak,
    "outages": outages.soak,
    "churn": churn.soak,
}


ALONE = ("tests",)  # they measure how soon a driver sees something
# One after the other: reports and links would leave churn no processor time, and its sides would end as hung.
SECOND_LANE = ("reports", "links", "clocks", "churn")
BACKGROUND = str(CHECKOUT / "scripts" / "background")
BEFORE = {name: [BACKGROUND] for name in ("reports", "links", "churn")}  # they use all the processor time that they get


def main(chosen: Sequence[str]) -> int:
    scale = float(os.environ.get("SOAK", "1"))
    seed = int(os.environ.get("SOAK_SEED", random.randrange(10**6)))
    if unknown := set(chosen) - PARTS.keys():
        print(f"unknown part {', '.join(sorted(unknown))}; expected one of {', '.join(PARTS)}", file=sys.stderr)
        return 2
    if len(chosen) == 1:
        return _run(chosen[0], seed, scale)
    print(f"seed {seed}, scale {scale:g}", flush=True)
    # For the parts, whose lines must appear immediately.
    os.environ |= {"SOAK_SEED": str(seed), "PYTHONUNBUFFERED": "1", "TOD_SITE": ""}
    names = chosen or tuple(PARTS)
    lanes = [
        [name for name in names if name not in ALONE and (name in SECOND_LANE) == second] for second in (False, True)
    ]
    failed = _run_each([name for name in names if name in ALONE])
    with ThreadPoolExecutor(len(lanes)) as pool:
        failed += [name for found in pool.map(_run_each, lanes) for name in found]
    print(f"failed: {', '.join(failed)}" if failed else "no problems")
    return 1 if failed else 0


def _run_each(names: Sequence[str]) -> list[str]:
    """Run parts, each in a process of its own. Returns those that failed."""
    return [name for name in names if _run_in_process(name)]


def _run_in_process(name: str) -> int:
    """Run a part and print its lines with its name as they arrive. Returns its exit status."""
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
    except Exception:  # report the traceback: nobody watches
        problems = [traceback.format_exc()]
    print(f"{len(problems)} problems, {time.monotonic() - began:.0f} s", flush=True)
    print("\n".join(problems), end="\n" if problems else "", flush=True)
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
