"""False cuts of the total while only the reports of the operator's side are lost.

  sudo .venv/bin/python bench/false_cuts.py OUT                     10 minutes; less: --seconds 60

A link that carries more than is sent, and loses 1 % of the packets on the way back, by which the reports travel. Prints
how often the total fell by more than 15 % within 0.2 s, and why. OUT keeps the drive; an existing one is not repeated.
Run it on an otherwise idle machine: one that stalls delays reports, too.
"""

from __future__ import annotations

import argparse
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

from uplinks import SETTLED_S, ensure_drive

from runner.drive.read import read_drive
from runner.records.decisions import DecisionMade
from runner.records.lines import LinkSample
from runner.simulation.figures import cuts

KBPS, LOSS, ONE_WAY_MS = 3000, 0.01, 25
DRIVE = (
    *("vehicle=delivery_robot", "source=test", "fps_max=15", "pqos=constant", f"pqos.kbps={KBPS}"),
    *("link=netns", "link.share=2", f"link.delay_ms={ONE_WAY_MS}"),
    f"link.reverse={{kbps: 20000, queue_ms: 300, delay_ms: {ONE_WAY_MS}, loss: {LOSS}}}",
)
WHY = re.compile(r"total \S+ -> \S+: ([^;,]+)")  # in the reason of each camera


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


def _cuts(decisions: Sequence[DecisionMade]) -> Iterator[str]:
    """Why the total fell, for each cut."""
    at = {line.t: line for line in decisions}
    for t in cuts([(line.t, float(line.total_kbps)) for line in decisions]):
        why = WHY.search(next(iter(at[t].cameras.values())).reason)
        yield why[1] if why else "no reason"


if __name__ == "__main__":
    main()
