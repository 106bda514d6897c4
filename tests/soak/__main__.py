"""Long repetitions of what a drive must survive: signals, stalls, openings, kills, frozen cameras, slow readers,
new sizes, garbage, reports of any kind, clocks that drift apart, outages with keys, addresses that change, and
thousands of changes that must leave nothing behind.

    make soak                           everything, about an hour and a half on two cores
    SOAK=0.1 make soak                  a tenth of it
    SOAK_SEED=7 make soak               the same random choices again; the seed is printed
    make soak PARTS="stalls hostile"    some parts only
    KEYS=1 make soak                    encrypted: TLS, passwords and SRTP for video, TLS 1.3 for control

Every part prints its steps and figures; the exit status is 1 if anything failed.
"""

from __future__ import annotations

import os
import random
import sys
import time
import traceback
from collections.abc import Callable

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

Part = Callable[[int, float], list[str]]  # seed, scale -> problems
PARTS: dict[str, Part] = {
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


def main(chosen: list[str]) -> int:
    scale = float(os.environ.get("SOAK", "1"))
    seed = int(os.environ.get("SOAK_SEED", random.randrange(10**6)))
    if unknown := set(chosen) - PARTS.keys():
        print(f"unknown part {', '.join(sorted(unknown))}; expected one of {', '.join(PARTS)}", file=sys.stderr)
        return 2
    print(f"seed {seed}, scale {scale:g}", flush=True)
    failed: list[str] = []
    for name in chosen or PARTS:
        began = time.monotonic()
        print(f"--- {name}", flush=True)
        try:
            problems = PARTS[name](seed, scale)
        except Exception:  # the other parts are run all the same
            problems = [traceback.format_exc()]
        print(f"--- {name}: {len(problems)} problems, {time.monotonic() - began:.0f} s", flush=True)
        failed += [f"{name}: {problem}" for problem in problems]
    print("\n".join(failed) or "no problems")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
