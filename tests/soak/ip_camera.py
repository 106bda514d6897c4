"""An IP camera that freezes for 1 to 30 s: viewers keep their sessions, and the picture returns."""

from __future__ import annotations

import random
import signal
import time

from system import flowing, player, running

import rig
from rig import free_port, until

RETRY_S = 10.0  # longest time between two attempts to connect to a source
BACK_S = RETRY_S + 3.0


def soak(seed: int, scale: float) -> list[str]:
    rng, problems = random.Random(seed), []
    with rig.ip_camera(free_port()) as (address, camera):
        words = ("page.serve=false", "+source@cameras.rear.source=rtsp", f'cameras.rear.source.address="{address}"')
        with running(*words) as (system, operator):
            with player(system, "rear", "tcp") as plays:
                for number in range(max(2, round(10 * scale))):
                    stopped_s = rng.uniform(1, 30)
                    rebuilt = system.samples()["rear"]["rebuilt"]
                    camera.send_signal(signal.SIGSTOP)
                    time.sleep(stopped_s)
                    before = system.samples()["rear"]["frames"]
                    camera.send_signal(signal.SIGCONT)
                    resumed = time.monotonic()
                    try:
                        until(lambda b=before: system.samples()["rear"]["frames"] > b + 15, seconds=30, every_s=0.1)
                    except AssertionError:
                        problems.append(f"frozen for {stopped_s:.1f} s: no picture within 30 s")
                        continue
                    back_s = time.monotonic() - resumed
                    print(f"{number:3} frozen {stopped_s:.1f} s, back in {back_s:.1f} s", flush=True)
                    if back_s > BACK_S:
                        problems.append(f"frozen for {stopped_s:.1f} s: back after {back_s:.1f} s, limit {BACK_S:g} s")
                    if system.samples()["rear"]["rebuilt"] != rebuilt:
                        problems.append(f"frozen for {stopped_s:.1f} s: the operator's session was rebuilt")
                    if not plays():
                        problems.append(f"frozen for {stopped_s:.1f} s: the player's session ended")
            until(lambda: flowing(operator), seconds=15)
            problems += system.tracebacks()
    return problems
