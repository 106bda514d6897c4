"""A vehicle whose address changes while driving, and a NAT that forgets it: everything recovers within 3 s each time.

By the recipes of docs/deployment.md, over SRT and through WireGuard.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from machines import Mobile, Watch, mobile
from recipes import SRT, WIREGUARD, Site, watched

BACK_S = 3.0
SETTLE_S = 5.0  # until the next change; anything not back by then counts as lost


def soak(_seed: int, scale: float) -> list[str]:
    count = max(2, round(10 * scale))
    problems = []
    for heading in (SRT, WIREGUARD):
        problems += roam(heading, "new address", False, count, Mobile.move)
        problems += roam(heading, "NAT forgot", True, count, Mobile.rebind)
    return problems


def roam(heading: str, what: str, translated: bool, count: int, change: Callable[[Mobile], None]) -> list[str]:
    problems = []
    with tempfile.TemporaryDirectory(prefix="tod-soak-") as directory, mobile(translated) as network:
        site = Site(network.vehicle, network.operator, Path(directory))
        with watched(site, heading) as watch:
            for number in range(count):
                back = recovery_times(watch, lambda: change(network))
                shown = ", ".join(f"{name} {seconds:.2f}" for name, seconds in sorted(back.items()))
                print(f"{heading:9} {what} {number:2}: back after {shown} s", flush=True)
                problems += [
                    f"{heading}: {what}: {name} back after {seconds:.2f} s, limit {BACK_S:g} s"
                    for name, seconds in back.items()
                    if seconds > BACK_S
                ]
        if problems:
            print("\n".join(watch.notes))
    return problems


def recovery_times(watch: Watch, change: Callable[[], None]) -> dict[str, float]:
    """Make a change, and measure when each camera and the control link are back for good, s."""
    changed = time.monotonic()
    change()
    time.sleep(SETTLE_S)
    return watch.back(changed)
