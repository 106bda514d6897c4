"""An operator's process that stalls for 0.5 to 8 s: its video recovers within 1.5 s after it resumes."""

from __future__ import annotations

import random
import signal
import time

from system import System, flowing, newest, running

from rig import until

BACK_S = 1.5


def soak(seed: int, scale: float) -> list[str]:
    rng, problems, slowest = random.Random(seed), [], 0.0
    with running("page.serve=false") as (system, operator):
        for number in range(max(4, round(25 * scale))):
            stall_s = rng.uniform(0.5, 8)
            process = system.processes["operator"]
            process.send_signal(signal.SIGSTOP)
            time.sleep(stall_s)
            paused = not newest(operator)["cameras"]["front"]["sending"]
            before = frames(system)
            process.send_signal(signal.SIGCONT)
            resumed = time.monotonic()
            try:
                until(lambda b=before: flowing(operator) and all_rising(system, b), seconds=10, every_s=0.05)
            except AssertionError:
                problems.append(f"stalled for {stall_s:.1f} s: not back within 10 s")
                continue
            back_s = time.monotonic() - resumed
            slowest = max(slowest, back_s)
            print(
                f"{number:3} stalled {stall_s:.1f} s{', paused' if paused else '':8} back in {back_s:.2f} s", flush=True
            )
            if back_s > BACK_S:
                problems.append(f"stalled for {stall_s:.1f} s: back after {back_s:.2f} s, limit {BACK_S:g} s")
            time.sleep(1)
        problems += system.tracebacks()
    print(f"slowest return {slowest:.2f} s")
    return problems


def frames(system: System) -> dict[str, int]:
    """Frames that the operator's side has received, over all pipelines."""
    return {name: camera["frames"] for name, camera in system.samples().items()}


def all_rising(system: System, before: dict[str, int]) -> bool:
    return all(now > before[name] for name, now in frames(system).items())
