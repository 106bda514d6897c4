"""Drives by the paper's rules and by those that know the screen, in turn: processor time, and what was seen.

  python bench/seen_drives.py MODELS OUT                 five pairs of 40 s
  python bench/seen_drives.py MODELS OUT --pairs 8 source=test

MODELS: what `tod-runner model vehicle=tum_q7 source=synthetic fps_max=5 output=MODELS` wrote. A browser of 1920x1080
shows the Drive view; its view is stated to the vehicle, and logged, with either rules. With a rendered source the
operator's video is kept in OUT and scored as the screen showed it (`tod-runner quality view=`). Needs chromium. Run it
on an otherwise idle machine.
"""

from __future__ import annotations

import needs_tests  # noqa: F401 (first: makes parts of the tests importable)  # isort: skip

import argparse
import math
import os
import shutil
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from statistics import fmean, median
from subprocess import DEVNULL, run
from typing import NamedTuple

from playwright.sync_api import Browser, sync_playwright
from seen import POLICIES, REFERENCE, own_models
from table import Row, show
from usage import descendants, processor_of_tree_s

from rig import CHROMIUM_FLAGS, answers, free_port, process, until
from runner.configuration.config import configuration
from runner.drive.seen_file import SeenDrive, read_seen
from runner.mqtt.broker import private_broker
from runner.settings import Endpoint

SEEN = "seen"
COMMON = ("vehicle=tum_q7", "pqos=constant", "mode=collective")
TOTAL = "modes.collective.total_from_operator.start_kbps"
SETTLE_S, LOOK_S = 8.0, 1.0
SIDES = ("vehicle", "operator", "browser")
MOST_SHARE = 0.9


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", type=Path)
    parser.add_argument("output", type=Path)
    parser.add_argument("--pairs", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=40)
    parser.add_argument("--total", type=int, default=3000, help="kbit/s")
    parser.add_argument("words", nargs="*", default=["source=synthetic", "fps_max=5"], help="further overrides")
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=CHROMIUM_FLAGS)
        show(list(rows(browser, options)))
        browser.close()


class Measured(NamedTuple):
    """cores: of each side; kbps: of all cameras; drawn: of the slowest camera's pictures, as a share."""

    cores: Mapping[str, float]
    kbps: float
    drawn: float
    log: Path


def rows(browser: Browser, options: argparse.Namespace) -> Iterator[Row]:
    found: dict[str, list[Measured]] = {REFERENCE: [], SEEN: []}
    for number in range(options.pairs):
        for policy in (REFERENCE, SEEN) if number % 2 else (SEEN, REFERENCE):
            found[policy].append(drive(browser, policy, number, options))
    for side in SIDES:
        paper, seen = ([one.cores[side] for one in found[policy]] for policy in (REFERENCE, SEEN))
        ratios = sorted(b / a for a, b in zip(paper, seen, strict=True))
        note = f"{median(paper):.3f} by the paper's rules; ratios {ratios[0]:.3f} to {ratios[-1]:.3f}"
        yield Row(f"{side}: processor", median(seen), "cores", note=note)
        yield Row("  ratio, median of the pairs", median(ratios), "", most=None if side == "operator" else MOST_SHARE)
    for policy, drives in found.items():
        note = f"drawn of the slowest camera's pictures: {min(one.drawn for one in drives):.2f}"
        yield Row(f"received, {policy}", median(one.kbps for one in drives), "kbit/s", note=note)
    if keeps_video(options):
        yield from seen_rows(found)


def keeps_video(options: argparse.Namespace) -> bool:
    return "source=synthetic" in options.words


def seen_rows(found: Mapping[str, Sequence[Measured]]) -> Iterator[Row]:
    """What was on the screen, by `tod-runner quality view=`: MSSIM of both, and their difference in each pair."""
    seen = {policy: [scored(one.log) for one in drives] for policy, drives in found.items()}
    both = list(zip(seen[REFERENCE], seen[SEEN], strict=True))
    for what in ("screen", *both[0][0].cameras):
        pairs = [(mssim(paper, what), mssim(own, what)) for paper, own in both]
        gains = sorted(own - paper for paper, own in pairs)
        note = (
            f"{median(paper for paper, _ in pairs):.4f} by the paper's rules; gains {gains[0]:.4f} to {gains[-1]:.4f}"
        )
        yield Row(f"on the screen, MSSIM: {what}", median(own for _, own in pairs), "", note=note)
    for policy, drives in seen.items():
        ages = [each for drive in drives for camera in drive.cameras.values() if (each := camera.age)]
        note = f"the largest of a camera; frozen {max(age.frozen for age in ages):.3f} of its time"
        yield Row(f"age on the screen, p95, {policy}", max(age.p95_ms for age in ages), "ms", note=note)


def scored(log: Path) -> SeenDrive:
    run([sys.executable, "-m", "runner", "quality", str(log), f"view={log}"], stdout=DEVNULL, check=True)
    drive = read_seen(log)
    assert drive
    return drive


def mssim(drive: SeenDrive, what: str) -> float:
    """Mean over time, of the screen or of a camera."""
    summary = (drive if what == "screen" else drive.cameras[what]).summary("mssim")
    return summary.mean if summary else math.nan


def drive(browser: Browser, policy: str, number: int, options: argparse.Namespace) -> Measured:
    """One drive, and what each side used in its middle."""
    rules = POLICIES[policy]
    log = options.output / f"{policy.partition(',')[0]}-{number}"
    words = [*COMMON, *options.words, *rules.words, *rules.graph, f"{TOTAL}={options.total}", f"log={log}"]
    words += own_models(options.models, options.output, rules.own or ())
    words += [f"log.video={keeps_video(options)}".lower()]
    with both_sides(words) as (url, pids), browser.new_context(viewport={"width": 1920, "height": 1080}) as context:
        page = context.new_page()
        page.goto(url)
        until(lambda: page.evaluate("window.tod?.control") == "you")
        page.keyboard.press("v")
        cameras = configuration(words).vehicle().cameras

        def counters() -> list[float]:
            drawn = page.evaluate("tod.measure()")["cameras"]
            shares = (drawn[name]["drawn"] / float(camera.fps) for name, camera in cameras.items())
            return [time.monotonic(), *(sum(map(processor_of_tree_s, pids[side])) for side in SIDES), *shares]

        until(lambda: len(page.evaluate("tod.measure()")["cameras"]) == len(cameras), seconds=30)
        time.sleep(SETTLE_S)
        before, rates = counters(), []
        while time.monotonic() < before[0] + options.seconds:
            rates.append(sum(each["kbps"] for each in page.evaluate("tod.sample.cameras").values()))
            time.sleep(LOOK_S)
        took, *used = (b - a for a, b in zip(before, counters(), strict=True))
    cores = dict(zip(SIDES, (each / took for each in used), strict=False))
    return Measured(cores, fmean(rates), min(used[len(SIDES) :]) / took, log)


@contextmanager
def both_sides(words: Sequence[str]) -> Iterator[tuple[str, Mapping[str, Sequence[int]]]]:
    """Yields the page's address and the processes of each side."""
    media, control, page = (free_port() for _ in range(3))
    own = [*words, f"media.port={media}", f"control.port={control}", f"page.port={page}"]
    with (
        private_broker(Endpoint("127.0.0.1", control)),
        process("vehicle", *own, stdout=DEVNULL) as vehicle,
        process("operator", *own, stdout=DEVNULL) as operator,
    ):
        until(lambda: answers(page), seconds=30)
        pids = {"vehicle": [vehicle.pid], "operator": [operator.pid], "browser": chromium()}
        yield f"http://127.0.0.1:{page}/", pids
        for side in (operator, vehicle):  # whole logs
            side.terminate()
            side.wait(30)


def chromium() -> list[int]:
    """The browser's first process, which this program has started through playwright's."""
    own = [pid for pid in descendants(os.getpid()) if "chrom" in Path(f"/proc/{pid}/comm").read_text()]
    return own[:1]


if __name__ == "__main__":
    main()
