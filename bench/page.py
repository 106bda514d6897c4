"""From source to screen: delay of a frame on its way into the browser, by stage, and whether eight tiles keep up.

  python bench/page.py                      one camera 960x540 at 30 Hz, then eight 640x360 at 15 Hz, eight drives each
  python bench/page.py --seconds 60 --show  with a window instead of headless

The clock starts with the frame's capture time and stops when the page has drawn it, on one machine and one clock; the
display's own delay is not included. Needs chromium. Run it on an otherwise idle machine.
"""

from __future__ import annotations

import argparse
import math
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

from playwright.sync_api import Browser, sync_playwright
from table import Row, show, spread
from usage import processor_s

sys.path.append(str(Path(__file__).resolve().parents[1] / "tests" / "integration"))
from rig import CHROMIUM_FLAGS, answers, free_port, process, until
from runner.configuration.config import configuration
from runner.core.model import Endpoint
from runner.mqtt.broker import private_broker
from runner.plans import render_missing

STAGES = ("capture -> operator", "operator -> page", "page -> decoded", "decoded -> drawn")
SETTLE_S = 5
ROUNDS = 8


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=30)
    parser.add_argument("--show", action="store_true", help="a window instead of headless")
    words = parser.parse_args()
    show(rows(words.seconds, headless=not words.show))


def rows(seconds: float = 30, *, headless: bool = True) -> list[Row]:
    with sync_playwright() as playwright:
        flags = CHROMIUM_FLAGS
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), headless=headless, args=flags)
        found = [
            *measure(browser, "one camera 960x540 at 30 Hz", 1, (960, 540, 30), 2500, seconds),
            *measure(browser, "eight 640x360 at 15 Hz", 8, (640, 360, 15), 6000, seconds),
        ]
        browser.close()
    return found


def measure(
    browser: Browser, what: str, count: int, form: tuple[int, int, int], kbps: int, seconds: float
) -> Iterator[Row]:
    """Drive a vehicle of some equal cameras and measure its page."""
    with tempfile.TemporaryDirectory() as directory:
        words = _configuration(Path(directory), count, *form, kbps)
        render_missing(configuration(words, Path(directory)).vehicle(), lambda *_: None)
        rounds = [_round(browser, [*words, f"conf={directory}"], seconds / ROUNDS) for _ in range(ROUNDS)]
    cameras = [frames for one in rounds for frames in one.frames]
    for number, stage in enumerate(STAGES):
        took = [frame[number + 1] - frame[number] for frames in cameras for frame in frames]
        yield spread(f"{what}: {stage}", took, "ms")
    yield spread(f"{what}: source to screen", [frame[-1] - frame[0] for frames in cameras for frame in frames], "ms")
    between = [later[-1] - sooner[-1] for frames in cameras for sooner, later in pairwise(frames)]
    yield spread(f"{what}: between two pictures", between, "ms")
    yield spread(f"{what}: page opened, all drawn", [one.opened_ms for one in rounds], "ms")
    rates = [rate for one in rounds for rate in one.rates]
    yield Row(f"{what}: drawn, slowest camera", min(rates), "Hz", note=f"of {form[2]}; fastest {max(rates):.1f}")
    yield Row(f"{what}: decoder errors", sum(one.errors for one in rounds), "", most=0)
    yield Row(f"{what}: operator's process", sum(one.cores for one in rounds) / ROUNDS, "cores")


class Round(NamedTuple):
    """Measurements of one page: frames by camera as times of each stage, ms."""

    frames: list[list[list[float]]]
    rates: list[float]
    errors: int
    opened_ms: float
    cores: float


def _round(browser: Browser, words: Sequence[str], seconds: float) -> Round:
    """Start both sides, open a page in its own context and measure it.

    The phase between cameras and screen is constant during a drive, so one drive alone says little.
    """
    with _station(words) as (url, operator), browser.new_context(viewport={"width": 1280, "height": 800}) as context:
        page = context.new_page()
        time.sleep(SETTLE_S)
        page.goto(url)
        time.sleep(SETTLE_S)
        before, began, used = page.evaluate("tod.measure()")["cameras"], time.time(), processor_s(operator)
        time.sleep(seconds)
        after, took = page.evaluate("tod.measure()")["cameras"], time.time() - began
        cores = (processor_s(operator) - used) / took
        stages = page.evaluate("tod.stages()").values()
    # The first frames of a stream carry no capture time.
    frames = [[f for f in camera if f[-1] > began * 1000 and math.isfinite(f[0])] for camera in stages]
    rates = [(after[name]["drawn"] - before[name]["drawn"]) / took for name in after]
    opened = max(float(camera["first_drawn_ms"] or "inf") for camera in after.values())
    return Round(frames, rates, sum(camera["errors"] for camera in after.values()), opened, cores)


def _configuration(directory: Path, count: int, width: int, height: int, fps: int, kbps: int) -> list[str]:
    """A vehicle of equal cameras in its own conf directory; returns the overrides that choose it."""
    (directory / "cameras").mkdir()
    (directory / "vehicle").mkdir()
    model = f"{{scaling: [1.0], b_min_kbps: [0], b_full_kbps: {kbps}}}"
    camera = f"width_px: {width}\nheight_px: {height}\nfps: {fps}\nrate_quality: {model}\n"
    (directory / "cameras" / "equal.yaml").write_text(camera)
    names = [f"camera_{number}" for number in range(count)]
    mounts = "".join(f"  - /cameras@cameras.{name}: equal\n" for name in names)
    mounted = []
    for n, name in enumerate(names):
        place = f"{{row: {n // 3}, column: {n % 3}}}"
        pose = f"{{x_m: 2, y_m: 0, z_m: 1.5, yaw_deg: {n * 360 // count}}}"
        mounted.append(f"  {name}: {{place: {place}, pose: {pose}}}\n")
    vehicle = f"# @package _global_\ndefaults:\n{mounts}  - _self_\nname: bench\ncameras:\n{''.join(mounted)}"
    (directory / "vehicle" / "bench.yaml").write_text(vehicle)
    return ["vehicle=bench", "source=synthetic", "pqos=constant", f"pqos.kbps={kbps}"]


@contextmanager
def _station(words: Sequence[str]) -> Iterator[tuple[str, int]]:
    """Both sides as processes, as the demo runs them. Yields the page's address and the operator's process."""
    media, control, page = (free_port() for _ in range(3))
    own = [*words, f"media.port={media}", f"control.port={control}", f"page.port={page}"]
    with (
        private_broker(Endpoint("127.0.0.1", control)),
        process("vehicle", *own, stdout=subprocess.DEVNULL),
        process("operator", *own, stdout=subprocess.DEVNULL) as operator,
    ):
        until(lambda: answers(page), seconds=20)
        yield f"http://127.0.0.1:{page}/", operator.pid


if __name__ == "__main__":
    main()
