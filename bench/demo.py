"""Processor time of `tod-runner demo` with its page: by it the demo chooses its cameras and their rate.

  python bench/demo.py                 vehicle=tum_q7 with one, three and eight cameras, five minutes
  python bench/demo.py --cases 3@20    so many of its cameras at so many Hz

Prints for each the cores that both sides take, also by megapixel of the cameras' full images; those that the browser
takes, which draws the Drive view at 1920x1080 without a GPU, also by picture; and the share of pictures that the page
skipped. Run it on an otherwise idle machine.
"""

from __future__ import annotations

import needs_tests  # noqa: F401 (first: makes parts of the tests importable)  # isort: skip

import argparse
import os
import shutil
import subprocess
import time
from collections.abc import Iterator, Sequence

from playwright.sync_api import Browser, sync_playwright
from table import Row, show
from usage import processor_of_tree_s, processor_s

from rig import CHROMIUM_FLAGS, answers, free_port, process, until
from runner.configuration.config import configuration

ALL = ("front_center", "front_left", "front_right", "rear_center", "top_front", "top_left", "top_right", "top_rear")
CASES = ("1@30", "3@15", "3@18", "8@6")  # cameras and Hz
SETTLE_S = 15


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=40)
    parser.add_argument("--cases", nargs="*", default=CASES, metavar="CAMERAS@HZ")
    options = parser.parse_args()
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=CHROMIUM_FLAGS)
        rows = [row for case in options.cases for row in measure(browser, *map(int, case.split("@")), options.seconds)]
        browser.close()
    show(rows)


def measure(browser: Browser, count: int, fps: int, seconds: float) -> Iterator[Row]:
    words = [*(f"~cameras.{name}" for name in ALL[count:]), f"fps_max={fps}"]
    cameras = configuration(words).vehicle().cameras.values()
    mpx = fps * sum(camera.width * camera.height for camera in cameras) / 1e6
    sides, page, skipped = _drive(browser, words, seconds)
    what = f"cameras: {count}, at {fps} Hz"
    yield Row(
        f"{what}: both sides", sides, "cores", note=f"{1000 * sides / mpx:.2f} ms per megapixel of {mpx:.0f} a second"
    )
    yield Row(f"{what}: browser", page, "cores", note=f"{1000 * page / (count * fps):.1f} ms per picture")
    yield Row(f"{what}: skipped", 100 * skipped, "%")


def _drive(browser: Browser, words: Sequence[str], seconds: float) -> tuple[float, float, float]:
    """Cores of both sides and of the browser, and the share of pictures that the page skipped."""
    media, control, port = (free_port() for _ in range(3))
    ports = (f"media.port={media}", f"control.port={control}", f"page.port={port}")
    with (
        process("demo", *words, *ports, "duration_s=3600", stdout=subprocess.DEVNULL) as demo,
        browser.new_context(viewport={"width": 1920, "height": 1080}) as context,
    ):
        until(lambda: answers(port), seconds=300)  # the drive may have to be rendered
        page = context.new_page()
        page.goto(f"http://127.0.0.1:{port}/")
        until(lambda: page.evaluate("window.tod?.control") == "you", seconds=60)
        if page.evaluate("tod.view") != "drive":
            page.keyboard.press("v")
        time.sleep(SETTLE_S)
        before, began = _used(demo.pid), time.monotonic()
        pictures = page.evaluate("tod.measure()")["cameras"].values()
        time.sleep(seconds)
        after, took = _used(demo.pid), time.monotonic() - began
        shown = page.evaluate("tod.measure()")["cameras"].values()
        demo.terminate()
    due, drawn = (sum(b[key] - a[key] for a, b in zip(pictures, shown, strict=True)) for key in ("due", "drawn"))
    sides, browsers = ((b - a) / took for a, b in zip(before, after, strict=True))
    return sides, browsers, 1 - drawn / due


def _used(demo: int) -> tuple[float, float]:
    """Processor time so far of both sides, and of everything else that this process has started: the browser, s."""
    sides = processor_of_tree_s(demo)
    return sides, processor_of_tree_s(os.getpid()) - processor_s(os.getpid()) - sides


if __name__ == "__main__":
    main()
