"""False cuts of the total while only the reports of the operator's side are lost.

  sudo .venv/bin/python bench/false_cuts.py OUT                     10 minutes; less: --seconds 60

A link that carries more than is sent, and loses 1 % of the packets on the way back, by which the reports travel. Prints
how often the measured link lowered the total, and why. OUT keeps the drive; an existing one is not repeated. Run it on
an otherwise idle machine: one that stalls delays reports, too.
"""

from __future__ import annotations

import argparse
import re
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path

from uplinks import SETTLED_S, ensure_drive

from runner.drive.read import read_drive
from runner.records import DecisionMade, LinkSample

KBPS, LOSS, ONE_WAY_MS = 3000, 0.01, 25
DRIVE = (
    *("vehicle=delivery_robot", "source=test", "fps_max=15", "pqos=constant", f"pqos.kbps={KBPS}"),
    *("link=netns", "link.share=2", f"link.delay_ms={ONE_WAY_MS}"),
    f"link.reverse={{kbps: 20000, queue_ms: 300, delay_ms: {ONE_WAY_MS}, loss: {LOSS}}}",
)
LOWERED = re.compile(r"total \S+ -> \S+: ([^;]+)")  # in the reason of each camera


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("output", type=Path)
    parser.add_argument("--seconds", type=int, default=600)
    options = parser.parse_args()
    path = options.output / "reports"
    ensure_drive(path, [*DRIVE, f"duration_s={options.seconds}"])
    drive = read_drive(path)
    decisions = [line for line in drive.sides["vehicle"].of(DecisionMade) if line.t > SETTLED_S]
    dropped = [line.dropped for line in drive.sides["link"].of(LinkSample)][-1]
    found = Counter(_cuts(decisions))
    print(f"{found.total()} cuts in {options.seconds} s, {dropped} packets dropped on the way to the operator")
    for why, count in found.most_common():
        print(f"  {count}: {why}")


def _cuts(decisions: Iterable[DecisionMade]) -> Iterator[str]:
    """Why the total was lowered, once for each time that it falls while or before it is lowered."""
    before = float("inf")
    for line in decisions:
        lowered = LOWERED.search(next(iter(line.cameras.values())).reason)
        if lowered and line.total_kbps < before:
            yield lowered[1]
        before = line.total_kbps


if __name__ == "__main__":
    main()
