"""The test cases of RFC 8867 in `experiment=rfc8867`: use of the link, and queuing delay.

  sudo .venv/bin/python bench/rfc8867.py OUT                            all cases, 25 minutes
  sudo .venv/bin/python bench/rfc8867.py OTHER --only 5_6_long_tcp --runs 5 --words modes=paper
  python bench/rfc8867.py THIRD --only 5_1_variable --quality

A row for each case: medians over the runs, and their range. A row is void if a busy machine dropped frames. --quality
also measures the delivered pictures: the drives store videos, and take about twice as long in all. OUT keeps the
drives, existing ones are not repeated, and OUT/rfc8867.png charts the first run of each case. Run it on an otherwise
idle machine, as root for the cases with TCP.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from statistics import median

import numpy as np
from matplotlib.figure import Figure
from uplinks import (
    DROPPED,
    SETTLED_S,
    Figures,
    cameras,
    dropped_share,
    ensure_drive,
    measured_drive,
    mssim,
    queue_ms,
    row,
    shown,
    switches,
    totals,
)

from runner.configuration.config import configuration
from runner.drive.read import Drive, read_drive
from runner.drive.series import series
from runner.drive.statistics import statistics
from runner.records.decisions import DecisionMade
from runner.records.lines import LinkSample

EXPERIMENT = "experiment=rfc8867"
WEIGHTED = "front_center"  # the camera whose weight the case `weights` triples
FIGURES = {
    "used": "link used %",
    "tcp": "of it by TCP %",
    "p50": "queue p50 ms",
    "p95": "p95",
    "p99": "p99",
    "dropped": "packets dropped",
    "lost": "lost",
    "frozen": "frozen %",
    "switches": "sizes/min",
    "below": "below a floor %",
    "down": "settled down s",
    "up": "up s",
    "front": f"{WEIGHTED} of all cameras %",
    "busy": "frames dropped by the cameras %",
    "mssim": "MSSIM mean",
    "worst": "MSSIM worst",
}
SETTLED_SHARE = 0.8  # share of the new rate
TCP_ALONE = "_tcp_alone"  # cases whose cameras send nothing
TCP_WIRE = 1500 / 1448  # bytes on the wire of a full TCP segment with time stamps per byte of its payload


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("output", type=Path)
    parser.add_argument("--runs", type=int, default=1)
    parser.add_argument("--only", nargs="*", help="cases; all if not given")
    parser.add_argument("--words", nargs="*", default=[], help="further overrides")
    parser.add_argument("--quality", action="store_true", help="also measure the delivered pictures")
    options = parser.parse_args()
    cases = configuration([EXPERIMENT]).experiment().runs
    print(row("case", *FIGURES.values()))
    print(row(*["---"] * (len(FIGURES) + 1)), flush=True)
    charted: dict[str, Drive] = {}
    for name in options.only or cases:
        paths = [options.output / f"{name}.{number}" for number in range(options.runs)]
        words = [EXPERIMENT, "~experiment.runs", *cases[name], *options.words]
        quality = options.quality and not name.endswith(TCP_ALONE)
        drives, found = zip(*(_drive(path, words, quality) for path in paths), strict=True)
        void = max(one["busy"] for one in found) > DROPPED
        label = f"{name} (void)" if void else name
        print(row(label, *(shown(key, [one[key] for one in found]) for key in FIGURES)), flush=True)
        charted[name] = drives[0]
    picture(charted).savefig(options.output / "rfc8867.png", dpi=100)


def _drive(path: Path, words: Sequence[str], quality: bool) -> tuple[Drive, Figures]:
    (measured_drive if quality else ensure_drive)(path, words)
    drive = read_drive(path)
    return drive, figures(drive) | (mssim(path, drive) if quality else {"mssim": np.nan, "worst": np.nan})


def figures(drive: Drive) -> Figures:
    """What one drive showed, once settled."""
    over_time = series(drive, "")
    whole = statistics(over_time)
    samples = [sample for sample in drive.sides["link"].of(LinkSample) if sample.t > SETTLED_S]
    t, kbps = np.array([(sample.t, sample.kbps) for sample in samples]).T
    capacity_bytes = float(np.sum(np.diff(t) * kbps[:-1])) * 1000 / 8
    first, last = samples[0], samples[-1]
    return {
        "used": 100 * (last.bytes - first.bytes) / capacity_bytes,
        "tcp": 100 * TCP_WIRE * (last.tcp_bytes - first.tcp_bytes) / capacity_bytes,
        **queue_ms(drive),
        "dropped": last.dropped - first.dropped,
        "lost": float(whole.lost or 0),
        "frozen": 100 * whole.frozen,
        "switches": switches(over_time),
        "below": 100 * _below_floor(drive),
        **settling(drive),
        "front": 100 * _share(drive, WEIGHTED),
        "busy": dropped_share(over_time, cameras(drive)),
    }


def _below_floor(drive: Drive) -> float:
    """Share of the time in which a camera that is on gets less than its `floor_kbps`."""
    floors = {name: int(camera.floor_kbps) for name, camera in cameras(drive).items()}
    decisions = [line for line in drive.sides["vehicle"].of(DecisionMade) if line.t > SETTLED_S]
    below = sum(
        after.t - line.t
        for line, after in pairwise(decisions)
        if any(own.on and own.kbps < floors[name] for name, own in line.cameras.items())
    )
    return below / (decisions[-1].t - decisions[0].t) if below else 0.0  # with the cameras off nothing may be decided


def _share(drive: Drive, camera: str) -> float:
    """Share of all bitrates that was allocated to a camera; nan: nothing was allocated."""
    decisions = [line for line in drive.sides["vehicle"].of(DecisionMade) if line.t > SETTLED_S]
    spans = [(after.t - line.t, line.cameras) for line, after in pairwise(decisions)]
    of_all = sum(span * sum(own.kbps for own in decided.values()) for span, decided in spans)
    return sum(span * decided[camera].kbps for span, decided in spans) / of_all if of_all else np.nan


def picture(drives: Mapping[str, Drive]) -> Figure:
    """By case over time: the link's rate and what passed it, and the wait in front of it."""
    figure = Figure(figsize=(12, 2.4 * len(drives)), layout="constrained")
    for (rates, waits), (name, drive) in zip(
        figure.subplots(len(drives), 2, squeeze=False), drives.items(), strict=True
    ):
        samples = drive.sides["link"].of(LinkSample)
        t, kbps, sent, tcp, queue = np.array(
            [(one.t, one.kbps, one.bytes, TCP_WIRE * one.tcp_bytes, one.queue_ms) for one in samples]
        ).T
        seconds = np.arange(np.ceil(t[0]), np.floor(t[-1]))
        passed, of_tcp = (np.diff(np.interp(seconds, t, each)) * 8 / 1000 for each in (sent, tcp))
        rates.step(t, kbps, where="post", color="#000000", linewidth=1, label="link")
        rates.plot(seconds[1:], passed - of_tcp, color="#0072B2", linewidth=1, label="cameras and control")
        if of_tcp.any():
            rates.plot(seconds[1:], of_tcp, color="#E69F00", linewidth=1, label="TCP")
        waits.plot(t, queue, color="#0072B2", linewidth=0.7)
        rates.set(title=name.replace("_", " "), ylabel="kbit/s", xlabel="s", ylim=(0, None))
        waits.set(title="wait in the queue", ylabel="ms", xlabel="s", ylim=(0, None))
        rates.legend(fontsize=8, ncols=3)
    return figure


def settling(drive: Drive) -> Figures:
    """Time from a step of the link's rate until the total is at most the new rate and at least SETTLED_SHARE of it, s.

    The total counts with its packet headers.

    returns  medians by direction; inf: not before the next step; nan: no such step
    """
    ahead = drive.sides["link"].began.time - drive.sides["vehicle"].began.time
    samples = [(sample.t + ahead, sample.kbps) for sample in drive.sides["link"].of(LinkSample)]
    steps = [(t, now, now < was) for (_, was), (t, now) in pairwise(samples) if now != was]
    decided = totals(drive)
    ends = [*(t for t, _, _ in steps[1:]), np.inf]
    waits: dict[bool, list[float]] = {True: [], False: []}
    for (t, kbps, down), end in zip(steps, ends, strict=False):  # no step, no end
        in_force = [total for since, total in decided if since <= t][-1:]
        after = [(t, total) for total in in_force] + [(since, total) for since, total in decided if t < since < end]
        settled = (since for since, total in after if SETTLED_SHARE * kbps <= total <= kbps)
        waits[down].append(next(settled, np.inf) - t)
    return {name: median(waits[down]) if waits[down] else np.nan for name, down in (("down", True), ("up", False))}


if __name__ == "__main__":
    main()
