"""What the vehicle's side costs on other systems, compared with the first one, in turns on one machine; as root.

  python bench/systems.py "Debian 12=/" "Debian 13=ROOT" "testing=ROOT"     five rounds of 15 s: four minutes a system

A system is a name and a root directory that `scripts/everywhere --steps "setup for tests" --keep` leaves, or / for this
one. A bare GStreamer RTSP server with the same launch lines (bench/cost.py) runs there too: what it takes more is
GStreamer's own. The last lines are a table in Markdown: medians, and their ratios to the first system's.
"""

from __future__ import annotations

import needs_tests  # noqa: F401 (first: makes parts of the tests importable)  # isort: skip

import argparse
import json
import subprocess
import sys
from pathlib import Path
from statistics import median

import cost

CHECKOUT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(CHECKOUT / "scripts"))
from roots import Root, row  # noqa: E402

LIMIT_S = 180.0
FIGURES = {  # column: whose, which of cost.Cost
    "start, s": ("own", "start"),
    "processor, cores": ("own", "cores"),
    "memory, MB": ("own", "memory"),
    "bare server: processor, cores": ("bare", "cores"),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("systems", nargs="*", metavar="NAME=ROOT")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=15)
    parser.add_argument("--here", action="store_true", help="measure this system once, and print JSON")
    options = parser.parse_args()
    if options.here:
        print(json.dumps(measured(options.seconds)))
        return
    systems = {name: Path(root) for name, _, root in (each.partition("=") for each in options.systems)}
    if len(systems) < 2:
        parser.error("needs at least two systems, each NAME=ROOT")
    rounds = []
    for number in range(options.rounds):
        rounds.append({name: on(root, options.seconds) for name, root in systems.items()})
        print(f"round {number + 1} of {options.rounds}: {rounds[-1]}", flush=True)
    print(row("system", *FIGURES), row(*["---"] * (len(FIGURES) + 1)), sep="\n")
    first = next(iter(systems))
    for name in systems:
        print(row(name, *(cell(rounds, name, first, *figure) for figure in FIGURES.values())))


def measured(seconds: float) -> dict[str, dict[str, float]]:
    """The vehicle's side and a bare server, on this system."""
    return {
        "own": cost.vehicle_cost(cost.WORDS, seconds, resizes=1)._asdict(),
        "bare": cost.bare_cost(cost.WORDS, seconds, resizes=1)._asdict(),
    }


def on(root: Path, seconds: float) -> dict[str, dict[str, float]]:
    """The same, on the system of a root directory."""
    command = f".venv/bin/python bench/systems.py --here --seconds {seconds}"
    here = ["unshare", "--net", "sh", "-c", f"ip link set lo up; cd {CHECKOUT}; {command}"]
    words = here if root == Path("/") else Root(root, root).entering(command, net=False)
    done = subprocess.run(words, capture_output=True, text=True, check=False, timeout=LIMIT_S)
    if done.returncode:
        sys.exit(f"{root}: {done.stderr.strip()}")
    return json.loads(done.stdout.splitlines()[-1])  # type: ignore[no-any-return]


def cell(rounds: list[dict[str, dict[str, dict[str, float]]]], name: str, first: str, side: str, key: str) -> str:
    """Median of a figure, and that of its ratios to the first system's, round by round."""
    here = [each[name][side][key] for each in rounds]
    ratio = median(each[name][side][key] / each[first][side][key] for each in rounds)
    return f"{median(here):.3g}" if name == first else f"{median(here):.3g} ({ratio:.2f})"


if __name__ == "__main__":
    main()
