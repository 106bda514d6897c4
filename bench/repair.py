"""What shorter refresh waves or forward error correction could gain over the present repair of lost packets.

  python bench/repair.py OUT                     20 minutes
  python bench/repair.py OUT --runs 1 --seconds 15

Forward error correction spends bitrate on redundancy instead of pictures. `fec` is a drive without losses, at the
bitrate that a fifth of redundancy would leave for the pictures: an upper bound for perfect error correction. A row
for each case: medians over paired runs, and their range. OUT keeps the drives; existing ones are not repeated. Run it
on an otherwise idle machine.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from uplinks import FIGURES, FPS, Figures, figures, measured_drive, row, shown

KBPS, REDUNDANCY = 3000, 0.2
LOSSES = (0.01, 0.03)
ROUND_TRIPS_MS = (30, 80)
OWN_WAVE_S = 1.5  # of the graph
WAVES_S = (0.5, OWN_WAVE_S, 3.0)
COLUMNS = ("mssim", "worst", "damaged", "frozen", "lost", "p50_ms", "p99_ms")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("output", type=Path)
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--seconds", type=int, default=20)
    options = parser.parse_args()
    cases = dict(_cases())
    drives: dict[str, list[Figures]] = {name: [] for name in cases}
    for number in range(options.runs):
        for name, done in drives.items():
            path = options.output / f"{name}.{number}"
            measured_drive(path, [*BASE, *cases[name], f"fps_max={FPS}", f"duration_s={options.seconds}"])
            done.append(figures(path))
            print(path.name, {key: round(done[-1][key], 4) for key in COLUMNS}, flush=True)
    print(row("case", *(FIGURES[key] for key in COLUMNS)))
    print(row(*["---"] * (len(COLUMNS) + 1)))
    for name, done in drives.items():
        print(row(name, *(shown(key, [one[key] for one in done]) for key in COLUMNS)))


BASE = ("vehicle=tum_q7", "modes=open_loop", "pqos=constant", f"pqos.kbps={KBPS}", "link=relay", "link.share=3")


def _cases() -> list[tuple[str, tuple[str, ...]]]:
    """Overrides by name."""
    cases: list[tuple[str, tuple[str, ...]]] = []
    for round_trip in ROUND_TRIPS_MS:
        way = f"link.delay_ms={round_trip // 2}"
        back = f"link.reverse={{kbps: 20000, queue_ms: 200, delay_ms: {round_trip // 2}}}"
        cases.append((f"nothing lost, {round_trip} ms", (way, back)))
        cases.append((f"fec, {round_trip} ms", (way, back, f"pqos.kbps={KBPS / (1 + REDUNDANCY):.0f}")))
        for loss in LOSSES:
            for wave in WAVES_S if round_trip == ROUND_TRIPS_MS[0] else (OWN_WAVE_S,):
                words = (way, back, f"link.loss={loss}", f"graph.key_interval_s={wave}")
                cases.append((f"{loss:.0%} lost, {round_trip} ms, waves of {wave:g} s", words))
    return cases


if __name__ == "__main__":
    main()
