"""What keys cost: the same drive with and without, in pairs.

    python bench/security.py [--pairs 3] [--seconds 20] [WORD ...]

Prints medians of processor time (both sides and broker), time until the first picture, and latency from capture to
decode, and the ratio with / without. Words are overrides of the drive.
"""

from __future__ import annotations

import argparse
import resource
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

from runner.core.roles import Role
from runner.drive.read import read_drive
from runner.records.operator import Sample
from runner.security.authority import Authority

WORDS = ("vehicle=delivery_robot", "source=test", "fps_max=15", "modes=open_loop", "pqos=constant", "page.serve=false")


class Cost(NamedTuple):
    """Of one drive."""

    cpu_s: float
    first_picture_s: float
    latency_ms: float


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pairs", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=20)
    parser.add_argument("words", nargs="*")
    options = parser.parse_args()
    words = [*WORDS, *options.words, f"duration_s={options.seconds:g}"]
    with tempfile.TemporaryDirectory() as directory:
        keys = _keys(Path(directory) / "keys")
        costs: dict[str, list[Cost]] = {"without": [], "with": []}
        kinds = [("without", []), ("with", [f"keys={keys}"])]
        for pair in range(options.pairs):
            for kind, more in reversed(kinds) if pair % 2 else kinds:  # whichever comes first may find a colder cache
                cost = _drive([*words, *more], Path(directory) / f"{kind}{pair}")
                print(f"{kind:8} {cost.cpu_s:6.2f} s CPU   {cost.first_picture_s:5.2f} s   {cost.latency_ms:5.1f} ms")
                costs[kind].append(cost)
    for number, name in enumerate(Cost._fields):
        plain, secure = ([cost[number] for cost in costs[kind]] for kind in ("without", "with"))
        ratios = sorted(own / other for own, other in zip(secure, plain, strict=True))
        medians = f"{statistics.median(plain):7.2f} -> {statistics.median(secure):7.2f}"
        print(f"{name:16} {medians}   x {statistics.median(ratios):.2f} ({ratios[0]:.2f} to {ratios[-1]:.2f})")


def _keys(directory: Path) -> Path:
    authority = Authority(directory)
    with authority.opened():
        authority.issue("broker", Role.BROKER, ["localhost"])
        authority.issue("delivery_robot", Role.VEHICLE, [])
        authority.issue("alice", Role.CONTROLLER, [])
    return directory


def _drive(words: list[str], log: Path) -> Cost:
    before = _children_s()
    command = [sys.executable, "-m", "runner", "demo", *words, f"log={log}"]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    drive = read_drive(log)
    vehicle, operator = drive.sides["vehicle"], drive.sides["operator"]
    samples = list(operator.of(Sample))
    arrived = min(t for sample in samples for camera in sample.cameras.values() for t, _ in camera.arrivals)
    latencies = [camera.latency_ms for sample in samples for camera in sample.cameras.values() if camera.latency_ms]
    return Cost(
        _children_s() - before, operator.began.time + arrived - vehicle.began.time, statistics.median(latencies)
    )


def _children_s() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


if __name__ == "__main__":
    main()
