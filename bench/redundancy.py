"""Two uplinks against "everything twice" and "one uplink, the better one": what the operator saw, in paired drives.

  python bench/redundancy.py OUT A.csv B.csv C.csv                   each pair of the three, 30 minutes
  python bench/redundancy.py OUT A.csv B.csv --runs 1 --seconds 30

For each pair of recorded uplinks, each policy is driven over the same stretch of both; the next run takes the next
stretch. The better uplink of a pair is the one with the higher median rate. The delivered pictures are measured by
`tod-runner quality`, freezes included. Prints a table: medians over the runs, and their range. OUT keeps the drives,
OUT/redundancy.json all figures and OUT/redundancy.png a chart of them; existing drives are not repeated. Needs root, as
`link=netns` does. Run it on an otherwise idle machine.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations
from pathlib import Path
from statistics import fmean, median

import numpy as np
from matplotlib.figure import Figure
from two_uplinks import REDUNDANT, UPLINKS, lanes, rates
from uplinks import DROPPED, SETTLED_S, Figures, cameras, dropped_share, measured_drive, row, shown

from runner.drive.quality_file import DeliveredQuality, read_quality
from runner.drive.read import Drive, read_drive
from runner.drive.series import series
from runner.drive.statistics import statistics
from runner.records.lines import LinkSample
from runner.system.files import write_whole

COMMON = ("vehicle=delivery_robot", "modes=safe", "mode=automatic", "source=synthetic", "link=netns", "fps_max=10")
REST = ("rear", "mast")
ONCE = f"cameras.{REDUNDANT}.redundant=true"
POLICIES = {  # overrides; which uplinks
    "front camera on both": ((UPLINKS, ONCE), "ab"),
    "everything twice": ((UPLINKS, ONCE, *(f"cameras.{name}.redundant=true" for name in REST)), "ab"),
    "one uplink, the better one": ((), "better"),
}
FIGURES = {
    "frozen_front": "front: frozen s",
    "p99_front": "p99 ms",
    "mssim_front": "MSSIM",
    "frozen_all": "all: frozen s",
    "p99_all": "p99 ms",
    "mssim": "MSSIM mean",
    "worst": "worst",
    "mbit": "sent, Mbit",
    "dropped": "frames dropped by the cameras %",
}
PANELS = {
    "frozen_front": "front camera frozen, s (less is better)",
    "frozen_all": "all cameras frozen, s (less is better)",
    "p99_front": "front camera: capture to arrival, p99, ms",
    "mssim": "MSSIM of delivered pictures, mean of the cameras",
}
COLOURS = ("#0072B2", "#E69F00", "#009E73")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("output", type=Path)
    parser.add_argument("uplinks", type=Path, nargs="+")
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--seconds", type=int, default=40)
    parser.add_argument("--set", nargs="*", default=[], help="further overrides")
    options = parser.parse_args()
    found: dict[str, dict[str, list[Figures]]] = {}
    for pair in combinations(options.uplinks, 2):
        name = " + ".join(path.stem.partition("-")[0] for path in pair)
        found[name] = {policy: [] for policy in POLICIES}
        for number in range(options.runs):
            for policy, done in found[name].items():
                path = options.output / name.replace(" ", "") / f"{policy.replace(' ', '_')}.{number}"
                measured_drive(path, _words(options, pair, policy, number))
                done.append(figures(path))
                print(name, path.name, {key: round(value, 3) for key, value in done[-1].items()}, flush=True)
            write_whole(options.output / "redundancy.json", json.dumps(found, indent=1).encode())
    picture(found).savefig(options.output / "redundancy.png", dpi=100)
    print("\n".join(table(found)))


def _words(options: argparse.Namespace, pair: Sequence[Path], policy: str, number: int) -> list[str]:
    words, which = POLICIES[policy]
    stretches = [_stretch(options, path, number) for path in pair]
    if which == "better":
        stretches = [stretches[int(median(rates(pair[1])) > median(rates(pair[0])))]]
    over = lanes(*(f"file: {path.resolve()}" for path in stretches), control=True)
    return [*COMMON, *words, over, f"duration_s={options.seconds}", *options.set]


def _stretch(options: argparse.Namespace, path: Path, number: int) -> Path:
    """The part of a recorded uplink that a run drives over, which starts again at its end."""
    every = rates(path)
    seconds = range(number * options.seconds, (number + 1) * options.seconds)
    lines = [f"{t}.0,{every[second % len(every)]}" for t, second in enumerate(seconds)]
    written: Path = options.output / "stretches" / f"{path.stem}.{number}.csv"
    written.parent.mkdir(parents=True, exist_ok=True)
    write_whole(written, "\n".join(["t_s,uplink_kbps", *lines, ""]).encode())
    return written


def figures(path: Path) -> Figures:
    """What one drive showed."""
    logged = read_drive(path)
    over_time = series(logged, path.name)
    each, delivered = statistics(over_time).cameras, read_quality(path)
    front, *rest = (each[name] for name in (REDUNDANT, *REST))
    means = {name: _mean(quality) for name, quality in delivered.items()}
    return {
        "frozen_front": sum(freeze.seconds for freeze in front.freezes or ()),
        "p99_front": _p99(over_time.cameras[name].received.arrival_ms for name in (REDUNDANT,)),
        "mssim_front": means[REDUNDANT],
        "frozen_all": sum(freeze.seconds for camera in (front, *rest) for freeze in camera.freezes or ()),
        "p99_all": _p99(camera.received.arrival_ms for camera in over_time.cameras.values()),
        "mssim": fmean(means.values()),
        "worst": min(means.values()),
        "mbit": sum(_mbit(logged, lane) for lane in "ab"),
        "dropped": dropped_share(over_time, cameras(logged)),
    }


def _mean(quality: DeliveredQuality) -> float:
    t, scores = np.array(quality.t), np.array(quality.mssim)
    return float(scores[t > SETTLED_S].mean())


def _p99(arrived: Iterator[np.ndarray]) -> float:
    ms = np.concatenate(list(arrived))
    return float(np.percentile(ms[np.isfinite(ms)], 99))


def _mbit(logged: Drive, lane: str) -> float:
    sent = [sample.bytes for sample in logged.sides["link"].of(LinkSample) if sample.lane == lane]
    return 8e-6 * sent[-1] if sent else 0.0


def table(found: Mapping[str, Mapping[str, Sequence[Figures]]]) -> Iterator[str]:
    """Markdown: a row for each pair and policy, median and range over its runs."""
    yield row("uplinks", "sent", *FIGURES.values())
    yield row(*["---"] * (len(FIGURES) + 2))
    for pair, policies in found.items():
        for policy, drives in policies.items():
            void = " (void)" if max(drive["dropped"] for drive in drives) > DROPPED else ""
            yield row(pair, f"{policy}{void}", *(_shown(key, [one[key] for one in drives]) for key in FIGURES))


def _shown(key: str, values: Sequence[float]) -> str:
    return shown(
        {"mssim_front": "mssim", "p99_front": "p99_ms", "p99_all": "p99_ms", "mbit": "used"}.get(key, key), values
    )


def picture(found: Mapping[str, Mapping[str, Sequence[Figures]]]) -> Figure:
    """Each run a dot, by pair of uplinks and policy, and a line at the median of the runs."""
    figure = Figure(figsize=(12, 8), layout="constrained")
    for axes, (key, title) in zip(figure.subplots(2, 2).flat, PANELS.items(), strict=True):
        for place, policies in enumerate(found.values()):
            for number, (policy, drives) in enumerate(policies.items()):
                x, values = place + 0.25 * (number - 1), [drive[key] for drive in drives]
                label = policy if place == 0 else None
                axes.plot([x] * len(values), values, "o", color=COLOURS[number], markersize=5, alpha=0.6)
                axes.plot([x - 0.08, x + 0.08], [median(values)] * 2, color=COLOURS[number], linewidth=3, label=label)
        axes.set(title=title, xticks=range(len(found)), xlim=(-0.5, len(found) - 0.5))
        axes.set_xticklabels(list(found))
        if not key.startswith("mssim"):
            axes.set_ylim(bottom=0)
        axes.grid(axis="y", alpha=0.3)
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=len(POLICIES))
    return figure


if __name__ == "__main__":
    main()
