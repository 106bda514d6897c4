"""How soon the encoders follow a link whose rate halves, by transport.

  sudo .venv/bin/python bench/reaction.py OUT                    6 minutes; one transport: --only SRT

Three cameras, predictions of 4 Mbit/s that never change, 20 ms each way. The link carries 4.4 Mbit/s, and every 12 s
half of that for 4 s. A row for each transport: time from each fall until the total, with packet headers, is at most the
new rate, the longest queue after the fall, and packets lost. OUT keeps the drives; existing ones are not repeated. Run
it on an otherwise idle machine.
"""

from __future__ import annotations

import argparse
from itertools import pairwise
from pathlib import Path
from statistics import median
from typing import NamedTuple

import numpy as np
from uplinks import ensure_drive, row, totals

from runner.drive.read import Drive, read_drive
from runner.drive.series import series
from runner.drive.statistics import statistics
from runner.records.lines import LinkSample
from runner.system.files import write_whole

WIDE_KBPS, NARROW_KBPS = 4400, 2200
WIDE_S, NARROW_S = 8, 4
ONE_WAY_MS = 20
LIMIT_MS = 2 * ONE_WAY_MS + 250  # at 40 Hz; one frame interval more at lower rates
TRANSPORTS = {
    "RTSP/UDP": ("graph=h264_rtsp",),
    "RTSP/TCP": ("graph=h264_rtsp", "+graph.receiver.0.properties.protocols=tcp"),
    "SRT": ("graph=h264_srt",),
}
NAMES = ("front", "rear", "mast")
SIZE_PX = (640, 360)  # so that two cores encode and decode 40 pictures a second of each
DRIVE = (
    *("vehicle=delivery_robot", "pqos=constant", "pqos.kbps=4000"),
    *("source=test", "source.elements.0.properties.pattern=snow"),  # for which an encoder uses its whole bitrate
    *(
        f"cameras.{name}.{key}={px}"
        for name in NAMES
        for key, px in zip(("width_px", "height_px"), SIZE_PX, strict=True)
    ),
    *("link=netns", "link.share=1", "link.queue_ms=300", f"link.delay_ms={ONE_WAY_MS}"),
    f"link.reverse={{kbps: 20000, queue_ms: 300, delay_ms: {ONE_WAY_MS}}}",
)


class Reaction(NamedTuple):
    """To one fall: s until the total is at most the new rate (inf: never), and the longest queue until then, ms."""

    seconds: float
    queue_ms: float


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("output", type=Path)
    parser.add_argument("--falls", type=int, default=10)
    parser.add_argument("--fps", type=int, default=40)
    parser.add_argument("--only", nargs="*", choices=TRANSPORTS, default=[*TRANSPORTS])
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    trace = options.output.resolve() / "halves.csv"
    rows = (
        (0, WIDE_KBPS),
        (WIDE_S - NARROW_S, WIDE_KBPS),
        (WIDE_S, NARROW_KBPS),
    )  # the last lasts as long as its neighbour
    write_whole(trace, "\n".join(["t_s,kbps", *(f"{t},{kbps}" for t, kbps in rows)]).encode())
    # Without fps_max, `demo` lowers the rates to what a small machine carries.
    fps = [f"fps_max={options.fps}", *(f"cameras.{name}.fps={options.fps}" for name in NAMES)]
    seconds = options.falls * (WIDE_S + NARROW_S)
    limit = LIMIT_MS + (0 if options.fps >= 40 else 1000 / options.fps)
    print(row("transport", f"median ms (at most {limit:.0f})", "p95", "longest", "longest queue ms, median", "lost"))
    print(row(*["---"] * 6), flush=True)
    for name in options.only:
        path = options.output / name.replace("/", "_").lower()
        ensure_drive(path, [*DRIVE, *TRANSPORTS[name], *fps, f"link.file={trace}", f"duration_s={seconds}"])
        drive = read_drive(path)
        found = reactions(drive)
        ms = [1000 * reaction.seconds for reaction in found]
        lost = statistics(series(drive, "")).lost
        waits = median(reaction.queue_ms for reaction in found)
        longest = f"{max(ms):.0f}"
        print(row(name, f"{median(ms):.0f}", f"{np.percentile(ms, 95):.0f}", longest, f"{waits:.0f}", str(lost)))


def reactions(drive: Drive) -> list[Reaction]:
    """To each fall of the link."""
    samples = list(drive.sides["link"].of(LinkSample))
    decided = totals(drive)
    end = decided[-1][0] - NARROW_S
    falls = [after.t for before, after in pairwise(samples) if after.kbps < before.kbps and after.t < end]
    return [_reaction(fall, decided, samples) for fall in map(_as_planned, falls)]


def _as_planned(t: float) -> float:
    """When the trace falls: the log shows it up to 0.1 s later."""
    period = WIDE_S + NARROW_S
    return period * (t // period) + WIDE_S


def _reaction(fall: float, decided: list[tuple[float, float]], samples: list[LinkSample]) -> Reaction:
    until = fall + NARROW_S
    in_force = [kbps for t, kbps in decided if t <= fall][-1]
    if in_force <= NARROW_KBPS:
        raise SystemExit(f"the total was {in_force} kbit/s before the link fell at {fall:g} s: nothing to react to")
    low = (t for t, kbps in decided if fall < t < until and kbps <= NARROW_KBPS)
    seconds = next(low, np.inf) - fall
    return Reaction(seconds, max(sample.queue_ms for sample in samples if fall <= sample.t < until))


if __name__ == "__main__":
    main()
