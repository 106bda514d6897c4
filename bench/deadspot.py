"""One drive over a recorded uplink, twice: trusting predictions that are too high, and measuring the link.

  python bench/deadspot.py UPLINK.csv deadspot.png
  python bench/deadspot.py UPLINK.csv deadspot.png --share 1.3 --seconds 60

Draws the operator's page of both drives at the same moment, with the time of the drive, and below it the status of
each picture over time. Needs chromium; run it on an otherwise idle machine.
"""

from __future__ import annotations

import needs_tests  # noqa: F401 (first: makes parts of the tests importable)  # isort: skip

import argparse
import io
import tempfile
import time
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
from playwright.sync_api import Browser, sync_playwright

from browser import measure, opened
from rig import BROWSER, CHROMIUM_FLAGS, answers, free_port, process, until
from runner.drive.read import read_drive
from runner.drive.series import Series, series

SETTLED_S = 8.0  # both drives have started by then
EVERY_S = 1.0  # between two screenshots
POLICIES = {"open_loop": "the prediction is trusted", "safe": "the link is measured"}
COLOURS = {"live": "#2e8b57", "late": "#ffb000", "damaged": "#c77dff", "frozen": "#e01b24", "lost": "#7a0000"}
STILL = ("frozen", "lost")
OTHER = "#d5dbe1"  # colour of any other status


class Shot(NamedTuple):
    """The page's pictures t seconds after the vehicle's start, as PNG."""

    t: float
    png: bytes


class Watched(NamedTuple):
    """A drive as its page showed it.

    statuses  by camera, each change: time, s, and status
    """

    drive: Series
    shots: list[Shot]
    statuses: dict[str, list[tuple[float, str]]]

    def spans(self, camera: str) -> list[tuple[float, float, str]]:
        """From, until and status, in order."""
        changes = self.statuses[camera]
        ends = [t for t, _ in changes[1:]] + [self.drive.end]
        return [(t, end, status) for (t, status), end in zip(changes, ends, strict=True)]

    def frozen(self, t: float) -> int:
        """How many pictures stood still at a time."""
        return sum(any(a <= t < b and status in STILL for a, b, status in self.spans(c)) for c in self.statuses)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("uplink", type=Path)
    parser.add_argument("picture", type=Path)
    parser.add_argument("--share", type=float, default=1.5, help="predictions as a multiple of what the link carries")
    parser.add_argument("--seconds", type=float, default=40)
    options = parser.parse_args()
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=BROWSER, args=CHROMIUM_FLAGS)
        drives = {modes: watched(browser, modes, options) for modes in POLICIES}
        browser.close()
    draw(drives, options)


def watched(browser: Browser, modes: str, options: argparse.Namespace) -> Watched:
    """Drive once and watch the page."""
    print(f"{modes}: {options.seconds:g} s", flush=True)
    with tempfile.TemporaryDirectory() as directory:
        port, log = free_port(), Path(directory) / "drive"
        trace = ("pqos=trace", f"pqos.file={options.uplink.resolve()}", f"pqos.wrong={{share: {options.share}}}")
        ports = (f"page.port={port}", f"media.port={free_port()}", f"control.port={free_port()}")
        drive = ("vehicle=tum_q7", "mode=automatic", f"modes={modes}", "link=relay", "fps_max=10", f"log={log}")
        shots, changes = [], {}
        with process("demo", *drive, *trace, *ports, f"duration_s={options.seconds + 5:g}") as child:
            until(lambda: answers(port) or child.poll() is not None, seconds=300)
            with opened(browser, f"http://127.0.0.1:{port}/", width=1280, height=760, refused=True) as page:
                until(lambda p=page: all(camera["drawn"] for camera in measure(p).values()))
                began = time.time()
                while time.time() - began < options.seconds:
                    shots.append((time.time(), page.locator("#tiles").screenshot()))
                    changes.update(
                        {(at, name): status for at, name, status in page.evaluate("tod.measure()")["status_log"]}
                    )
                    time.sleep(max(0.0, began + len(shots) * EVERY_S - time.time()))
            child.terminate()
            child.wait(30)
        found = series(read_drive(log))
    statuses: dict[str, list[tuple[float, str]]] = {name: [] for name in found.cameras}
    for (at, name), status in sorted(changes.items()):
        statuses[name].append((at / 1000 - found.began, status))
    return Watched(found, [Shot(at - found.began, png) for at, png in shots], statuses)


def draw(drives: dict[str, Watched], options: argparse.Namespace) -> None:
    """Both pages when most pictures stood still in the first drive, and both drives over time."""
    first, second = drives.values()
    pairs = [(a, min(second.shots, key=lambda b: abs(a.t - b.t))) for a in first.shots if a.t > SETTLED_S]
    at = max(pairs, key=lambda pair: (first.frozen(pair[0].t), -abs(pair[0].t - pair[1].t)))
    matplotlib.use("Agg")
    figure, axes = plt.subplots(
        3, 2, figsize=(14, 8.6), height_ratios=(5.2, 1.6, 1.6), layout="constrained", sharex="row", sharey="row"
    )
    for column, (modes, drive) in enumerate(drives.items()):
        picture, state, rate = axes[:, column]
        shot = at[column]
        picture.imshow(plt.imread(io.BytesIO(shot.png)))
        picture.set_axis_off()
        picture.set_title(f"modes={modes}: {POLICIES[modes]}", fontsize=13, fontweight="bold")
        clock = {"facecolor": "black", "pad": 5}
        picture.text(0.03, 0.52, f"t = {shot.t:.1f} s", transform=picture.transAxes, color="white", size=15, bbox=clock)
        draw_statuses(state, drive, shot.t)
        draw_rates(rate, drive.drive, shot.t, options.share)
    axes[2, 0].set_ylabel("Mbit/s")
    axes[2, 0].legend(loc="upper right", fontsize=8, ncols=3)
    handles = [plt.Rectangle((0, 0), 1, 1, color=colour) for colour in COLOURS.values()]
    axes[1, 0].legend(handles, COLOURS, loc="upper left", bbox_to_anchor=(0, 1.22), fontsize=8, ncols=5, frameon=False)
    figure.savefig(options.picture, dpi=80)
    for modes, drive in drives.items():
        frozen = sum(b - a for c in drive.statuses for a, b, status in drive.spans(c) if status in STILL)
        print(f"{modes}: pictures stood still for {frozen:.1f} s in {len(drive.statuses)} x {drive.drive.end:.0f} s")
    print(options.picture)


def draw_statuses(axes: Any, drive: Watched, t: float) -> None:
    """A row per camera."""
    for row, name in enumerate(reversed(drive.statuses)):
        for begin, end, status in drive.spans(name):
            axes.barh(row, end - begin, left=begin, height=0.8, color=COLOURS.get(status.split()[0], OTHER))
    axes.set_yticks(range(len(drive.statuses)), [*reversed(drive.statuses)], fontsize=8)
    axes.axvline(t, color="black", lw=1)


def draw_rates(axes: Any, drive: Series, t: float, share: float) -> None:
    """What was predicted, what the link carried, what arrived."""
    predicted = drive.predicted
    axes.step(predicted.t, predicted.y / 1000, where="post", color="#888", lw=1, label="predicted")
    for link in drive.links.values():
        axes.plot(link.t, link.kbps / 1000, color="black", lw=1, label="the link carries")
    axes.plot(drive.actual.t, drive.actual.y / 1000, color="#0a61a8", lw=1.2, label="video received")
    axes.set_ylim(0, 1.1 * float(np.nanmax(predicted.y)) / 1000)
    axes.set_xlim(0, drive.end)
    axes.set_xlabel("s")
    axes.axvline(t, color="black", lw=1)


if __name__ == "__main__":
    main()
