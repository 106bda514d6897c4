"""A slow reader per camera, and one that stops: both are disconnected, and regular viewers lose no frame.

Meanwhile a subscriber to everything that the vehicle publishes reads nothing.
"""

from __future__ import annotations

import random
import time
from contextlib import ExitStack

from system import CAMERAS, Watched, running

import keyed

ALONE_S = 300  # with readers at half the rate


def soak(seed: int, scale: float) -> list[str]:
    rng, problems = random.Random(seed), []
    with running("page.serve=false") as (system, operator):
        silent = system.mqtt_client(keyed.WATCHER)
        silent.subscribe(f"tod/{keyed.VEHICLE}/#")
        silent.loop_write()
        watched = [Watched(system, operator, name) for name in CAMERAS]
        end = time.monotonic() + max(30.0, ALONE_S * scale)
        rounds = 0
        while time.monotonic() < end:
            rounds += 1
            with ExitStack() as stack:
                slow, stopped = [], []
                for name in CAMERAS:
                    for group in (slow, stopped):
                        client = stack.enter_context(system.viewer(name, small=True))
                        if client.open() != [200, 200, 200]:
                            problems.append(f"{name}: a reader was refused")
                        group.append(client)
                for client in slow:
                    kbps = operator.telemetry[-1]["cameras"][client.url.rpartition("/")[2]]["applied"]["bitrate"]
                    client.delay_s = 2 * 1200 * 8 / (1000 * kbps)  # twice the interval at which packets are sent
                    client.read()
                time.sleep(rng.uniform(10, 20))
                for client in stopped:
                    if not client.ended(10):
                        problems.append(f"{client.url}: a reader that stopped was not closed")
                for client in slow:
                    if client.is_reading():
                        client.wait(30)
                    if client.is_reading():
                        problems.append(f"{client.url}: a reader at half the rate was not closed")
        print(f"{rounds} rounds of {2 * len(CAMERAS)} readers", flush=True)
        silent.disconnect()
        for watch in watched:
            problems += watch.problems()
        problems += system.tracebacks()
    return problems
