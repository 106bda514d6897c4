"""From source to screen: delay of a frame on its way into the browser, by stage, and whether the page keeps up.

  python bench/page.py                      one camera 960x540 at 30 Hz, then eight 640x360 at 15 Hz, eight drives each;
                                            pictures skipped with 1, 2, 4 and 8 cameras; what overlays add, also
                                            with eight 320x180, and what the bird's-eye view adds to the cameras
                                            beside it
  python bench/page.py --seconds 60 --show  with a window instead of headless
  python bench/page.py --seconds 200 --pairs 30

The clock starts with the frame's capture time and stops when the page has drawn it, on one machine and one clock; the
display's own delay is not included. Needs chromium. Run it on an otherwise idle machine.
"""

from __future__ import annotations

import needs_tests  # noqa: F401 (first: makes parts of the tests importable)  # isort: skip

import argparse
import math
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from statistics import median
from typing import NamedTuple

from playwright.sync_api import Browser, Page, sync_playwright
from table import Row, show, spread
from usage import processor_s

from rig import CHROMIUM_FLAGS, Operator, answers, free_port, process, repeating, until
from runner.configuration.config import configuration
from runner.mqtt.broker import private_broker
from runner.plans import render_missing
from runner.settings import Endpoint

STAGES = ("capture -> operator", "operator -> page", "page -> decoded", "decoded -> drawn")
SETTLE_S = 5
ROUNDS = 8
ONE, EIGHT = (
    ("one camera 960x540 at 30 Hz", 1, (960, 540, 30), 2500),
    ("eight 640x360 at 15 Hz", 8, (640, 360, 15), 6000),
)
# Shown as large as EIGHT's pictures, but both sides need less processor time. With those, what is left decides.
SMALL = ("eight 320x180 at 15 Hz", 8, (320, 180, 15), 3000)
COUNTS = (1, 2, 4, 8)  # of cameras, for skipped pictures
PAIRS = 10  # of blocks with and without overlays or the bird's-eye view
TOP_VIEWS = 4  # cameras of a bird's-eye view, which replaces their own pictures
BLOCK_SETTLE_S = 0.3
STEERING_S, STEERING_RAD = 0.05, 0.3  # between two reports, and amplitude: the path changes in each picture
# The rectangle of a requested region, which the page shows on one camera until its picture has that region.
REGION = "body:not(.bare) [data-camera=camera_0] .roi-drag"
OVERLAYS = f".bare #drive {{ visibility: hidden }} {REGION} {{ display: block !important; inset: 20% }}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=30)
    parser.add_argument("--show", action="store_true", help="a window instead of headless")
    parser.add_argument("--pairs", type=int, default=PAIRS, help="of blocks with and without overlays")
    options = parser.parse_args()
    show(rows(options.seconds, options.pairs, headless=not options.show))


def rows(seconds: float = 30, pairs: int = PAIRS, *, headless: bool = True) -> list[Row]:
    with sync_playwright() as playwright:
        flags = CHROMIUM_FLAGS
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), headless=headless, args=flags)
        found = [
            *measure(browser, *ONE, seconds),
            *measure(browser, *EIGHT, seconds),
            *(skipped(browser, count, seconds / 2) for count in COUNTS),
            *(row for video in (ONE, SMALL, EIGHT) for row in overlays(browser, *video, seconds, pairs)),
            *birdseye(browser, *EIGHT, seconds, pairs),
        ]
        browser.close()
    return found


def measure(
    browser: Browser, what: str, count: int, video: tuple[int, int, int], kbps: int, seconds: float
) -> Iterator[Row]:
    """Drive a vehicle of equal cameras and measure its page."""
    with vehicle(count, video, kbps) as words:
        rounds = [_round(browser, words, seconds / ROUNDS) for _ in range(ROUNDS)]
    cameras = [frames for one in rounds for frames in one.frames]
    for number, stage in enumerate(STAGES):
        took = [frame[number + 1] - frame[number] for frames in cameras for frame in frames]
        yield spread(f"{what}: {stage}", took, "ms")
    yield spread(f"{what}: source to screen", [frame[-1] - frame[0] for frames in cameras for frame in frames], "ms")
    between = [later[-1] - sooner[-1] for frames in cameras for sooner, later in pairwise(frames)]
    yield spread(f"{what}: between two pictures", between, "ms")
    yield spread(f"{what}: page opened, all drawn", [one.opened_ms for one in rounds], "ms")
    rates = [rate for one in rounds for rate in one.rates]
    yield Row(f"{what}: drawn, slowest camera", min(rates), "Hz", note=f"of {video[2]}; fastest {max(rates):.1f}")
    yield Row(f"{what}: decoder errors", sum(one.errors for one in rounds), "", most=0)
    yield Row(f"{what}: operator's process", sum(one.cores for one in rounds) / ROUNDS, "cores")


def skipped(browser: Browser, count: int, seconds: float) -> Row:
    """Of the pictures that reached the page, the share that was not drawn."""
    with vehicle(count, (640, 360, 30), 1500 * count) as words:
        one = _round(browser, words, seconds)
    note = f"drawn, slowest camera {min(one.rates):.1f} Hz"
    return Row(f"640x360 at 30 Hz, cameras: {count}: skipped", 100 * one.skipped, "%", note=note)


def overlays(
    browser: Browser, what: str, count: int, video: tuple[int, int, int], kbps: int, seconds: float, pairs: int
) -> Iterator[Row]:
    """What lines on the ground, figures and rectangles of requested regions add to source to screen."""

    def show(page: Page, with_them: bool) -> None:
        if are_shown(page) != with_them:
            page.keyboard.press("g")
        page.evaluate("bare => document.body.classList.toggle('bare', bare)", not with_them)

    def are_shown(page: Page) -> bool:
        return (page.text_content("#guides") or "").startswith("Guides on")

    names = [f"camera_{number}" for number in range(count)]
    with vehicle(count, video, kbps) as words:
        blocks = _alternating(browser, words, names, show, are_shown, seconds, pairs)
    yield _added(f"{what}: overlays add", blocks, most=None if what == EIGHT[0] else 1)


def birdseye(
    browser: Browser, what: str, count: int, video: tuple[int, int, int], kbps: int, seconds: float, pairs: int
) -> Iterator[Row]:
    """What the bird's-eye view, in place of its own cameras' pictures, adds to source to screen of the others."""

    def show(page: Page, with_it: bool) -> None:
        if is_shown(page) != with_it:
            for _ in range(1 if with_it else 2):  # the key cycles: in the row, large, off
                page.keyboard.press("e")
            until(lambda: is_shown(page) == with_it)

    def is_shown(page: Page) -> bool:
        return bool(page.locator("#birdseye").is_visible())

    beside = [f"camera_{number}" for number in range(count - TOP_VIEWS)]
    with vehicle(count, video, kbps, TOP_VIEWS) as words:
        blocks = _alternating(browser, words, beside, show, is_shown, seconds, pairs)
    yield _added(f"{what}: bird's-eye view in place of {TOP_VIEWS} pictures adds to the others", blocks)
    for with_it in (True, False):
        skipped = [block.skipped for block in blocks if block.with_them == with_it]
        how = "with" if with_it else "without"
        yield Row(f"{what}: skipped of the others, {how} bird's-eye view", 100 * sum(skipped) / len(skipped), "%")


class Block(NamedTuple):
    """Some seconds of a drive: source to screen of each picture drawn, ms; skipped as a share of all pictures."""

    with_them: bool
    ages: list[float]
    skipped: float


def _added(what: str, blocks: Sequence[Block], most: float | None = None) -> Row:
    """The difference of the medians of each pair of blocks."""
    medians = {which: [median(block.ages) for block in blocks if block.with_them == which] for which in (True, False)}
    added = [a - b for a, b in zip(medians[True], medians[False], strict=True)]
    note = f"{min(added):.2f} to {max(added):.2f} in {len(added)} pairs, to {median(medians[False]):.1f}"
    return Row(what, median(added), "ms", most=most, note=note)


def _alternating(
    browser: Browser,
    words: Sequence[str],
    names: Sequence[str],
    show: Callable[[Page, bool], None],
    are_shown: Callable[[Page], bool],
    seconds: float,
    pairs: int,
) -> list[Block]:
    """Measure cameras in the Drive view with something and without it, alternating in one drive."""
    with (
        station(words) as (url, _, broker),
        browser.new_context(viewport={"width": 1280, "height": 800}) as context,
    ):
        page = context.new_page()
        page.goto(url)
        until(lambda: page.evaluate("window.tod?.control") == "you")
        page.keyboard.press("v")
        page.add_style_tag(content=OVERLAYS)
        blocks = []
        with _steering(broker):
            time.sleep(SETTLE_S)
            turns = ((True, False, False, True) * pairs)[: 2 * pairs]  # a trend of the machine affects both
            for with_them in turns:
                show(page, with_them)
                blocks.append(_block(page, names, with_them, seconds / len(turns)))
                if are_shown(page) != with_them:
                    raise SystemExit(f"what is measured is {'not ' if with_them else ''}shown")
    return blocks


def _block(page: Page, names: Sequence[str], with_them: bool, seconds: float) -> Block:
    time.sleep(BLOCK_SETTLE_S)
    began, before = 1000 * time.time(), page.evaluate("tod.measure()")["cameras"]
    time.sleep(seconds)
    after, stages = page.evaluate("tod.measure()")["cameras"], page.evaluate("tod.stages()")
    ages = [frame[-1] - frame[0] for name in names for frame in _since(stages[name], began)]
    if not ages:
        raise SystemExit("no picture was drawn; is the machine idle?")
    return Block(with_them, ages, _skipped([before[name] for name in names], [after[name] for name in names]))


def _skipped(before: Sequence[Mapping[str, int]], after: Sequence[Mapping[str, int]]) -> float:
    """Of the pictures that reached the page between two measurements of cameras, the share that was not drawn."""
    due, drawn = (sum(b[key] - a[key] for a, b in zip(before, after, strict=True)) for key in ("due", "drawn"))
    return 1 - drawn / due


@contextmanager
def _steering(broker: Endpoint) -> Iterator[None]:
    """The steering wheel turns from side to side, reported to the vehicle."""
    driver = Operator(broker, "bench")

    def turn() -> None:
        driver.send("steering", event="steering_reported", rad=STEERING_RAD * math.sin(time.time()))

    try:
        with repeating(turn, STEERING_S):
            yield
    finally:
        driver.link.close()


class Round(NamedTuple):
    """Measurements of one page: frames by camera as times of each stage, ms; skipped as a share of all pictures."""

    frames: list[list[list[float]]]
    rates: list[float]
    skipped: float
    errors: int
    opened_ms: float
    cores: float


def _round(browser: Browser, words: Sequence[str], seconds: float) -> Round:
    """Start both sides, open a page in its own context and measure it.

    The phase between cameras and screen is constant during a drive, so one drive alone says little.
    """
    with station(words) as (url, operator, _), browser.new_context(viewport={"width": 1280, "height": 800}) as context:
        page = context.new_page()
        time.sleep(SETTLE_S)
        page.goto(url)
        time.sleep(SETTLE_S)
        before, began, used_s = page.evaluate("tod.measure()")["cameras"], time.time(), processor_s(operator)
        time.sleep(seconds)
        after, took = page.evaluate("tod.measure()")["cameras"], time.time() - began
        cores = (processor_s(operator) - used_s) / took
        stages = page.evaluate("tod.stages()").values()
    frames = [_since(camera, began * 1000) for camera in stages]
    drawn = [after[name]["drawn"] - before[name]["drawn"] for name in after]
    skipped = _skipped(list(before.values()), list(after.values()))
    opened = max(float(camera["first_drawn_ms"] or "inf") for camera in after.values())
    errors = sum(camera["errors"] for camera in after.values())
    return Round(frames, [each / took for each in drawn], skipped, errors, opened, cores)


def _since(frames: list[list[float]], began_ms: float) -> list[list[float]]:
    """Frames drawn since; the first ones of a stream carry no capture time."""
    return [frame for frame in frames if frame[-1] > began_ms and math.isfinite(frame[0])]


@contextmanager
def vehicle(count: int, video: tuple[int, int, int], kbps: int, top_views: int = 0) -> Iterator[list[str]]:
    """A vehicle of equal cameras, whose pictures are rendered; the last ones look down. Yields its words."""
    with tempfile.TemporaryDirectory() as directory:
        words = _configuration(Path(directory), count, top_views, *video, kbps)
        render_missing(configuration(words, Path(directory)).vehicle(), lambda *_: None)
        yield [*words, f"conf={directory}"]


def _configuration(
    directory: Path, count: int, top_views: int, width: int, height: int, fps: int, kbps: int
) -> list[str]:
    """A vehicle of equal cameras in its own conf directory; returns the overrides that choose it."""
    (directory / "cameras").mkdir()
    (directory / "vehicle").mkdir()
    model = f"{{scaling: [1.0], b_min_kbps: [0], b_full_kbps: {kbps}}}"
    camera = f"width_px: {width}\nheight_px: {height}\nfps: {fps}\nrate_quality: {model}\n"
    for kind, optics in (("plain", ""), ("top_view", "lens: fisheye\nfov_deg: 180\n")):
        (directory / "cameras" / f"{kind}.yaml").write_text(camera + optics)
    names = [f"camera_{number}" for number in range(count)]
    plain = count - top_views
    kinds = ["plain"] * plain + ["top_view"] * top_views
    mounts = "".join(f"  - /cameras@cameras.{name}: {kind}\n" for name, kind in zip(names, kinds, strict=True))
    mounted = []
    for n, name in enumerate(names):
        place = f"{{row: {n // 3}, column: {n % 3}}}"
        yaw, pitch = (n * 360 // plain, 0) if n < plain else ((n - plain) * 360 // top_views, 35)
        pose = f"{{x_m: 2, y_m: 0, z_m: 1.5, yaw_deg: {yaw}, pitch_deg: {pitch}}}"
        mounted.append(f"  {name}: {{place: {place}, pose: {pose}, calibrated: true}}\n")
    top = f"# @package _global_\ndefaults:\n{mounts}  - _self_\nname: bench\n"
    car = "{wheelbase_m: 2.9, track_m: 1.65, width_m: 1.92, front_m: 3.65, rear_m: 0.95}"
    (directory / "vehicle" / "bench.yaml").write_text(f"{top}dimensions: {car}\ncameras:\n{''.join(mounted)}")
    return ["vehicle=bench", "source=synthetic", "pqos=constant", f"pqos.kbps={kbps}"]


@contextmanager
def station(words: Sequence[str]) -> Iterator[tuple[str, int, Endpoint]]:
    """Both sides as processes, as the demo runs them. Yields the page's address, the operator's process, the broker."""
    media, control, page = (free_port() for _ in range(3))
    own = [*words, f"media.port={media}", f"control.port={control}", f"page.port={page}"]
    with (
        private_broker(broker := Endpoint("127.0.0.1", control)),
        process("vehicle", *own, stdout=subprocess.DEVNULL),
        process("operator", *own, stdout=subprocess.DEVNULL) as operator,
    ):
        until(lambda: answers(page), seconds=20)
        yield f"http://127.0.0.1:{page}/", operator.pid, broker


if __name__ == "__main__":
    main()
