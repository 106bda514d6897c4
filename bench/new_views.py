"""How soon the screen shows a new view, over a limited link, and what changes of views do to its queue.

  python bench/new_views.py                                                  two drives of two and a half minutes
  python bench/new_views.py --set modes.automatic.calm_pictures.at_once=8    likewise, all new sizes together

The eight cameras of the paper's vehicle at a quarter of their pixels, over a link of 3000 kbit/s with delay. Times are
from the page's statement of the new view to the first picture drawn that shows what is seen, as finely as it soon will.
Cameras that need nothing new do not count. Needs chromium. Run it on an otherwise idle machine.
"""

from __future__ import annotations

import needs_tests  # noqa: F401 (first: makes parts of the tests importable)  # isort: skip

import argparse
import json
import math
import random
import shutil
import subprocess
import tempfile
import time
from bisect import bisect_right
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

from playwright.sync_api import Page, sync_playwright
from table import Row, show, spread

from browser import all_live, take_control, viewing
from rig import CHROMIUM_FLAGS, answers, free_port, process, until
from runner.configuration.config import configuration
from runner.core.model import Roi
from runner.core.view import enclosing
from runner.operator.meter import percentile
from runner.plans import render_missing

FPS, RTT_MS = 15, 40
SIZES = {"front_left": (960, 520), "front_center": (960, 520), "front_right": (960, 520), "rear_center": (960, 600)}
TOPS = dict.fromkeys(("top_front", "top_left", "top_right", "top_rear"), (640, 400))
WORDS = (
    "vehicle=tum_q7",
    "source=synthetic",
    f"fps_max={FPS}",
    "modes=seen",
    "pqos=constant",
    "pqos.kbps=3000",
    "link=relay",
    "link.kbps=3000",
    f"link.delay_ms={RTT_MS // 2}",
    f"link.reverse={{kbps: 2000, queue_ms: 200, delay_ms: {RTT_MS // 2}}}",
    *(
        f"cameras.{name}.{side}_px={length}"
        for name, size in (SIZES | TOPS).items()
        for side, length in zip(("width", "height"), size, strict=True)
    ),
)
FRONT = "front_center"
SETTLE_S, SOON_S = 12, 0.95  # a region narrows after one second
PAUSES_S = (1.5, 4.0)  # before another view
SEED = 3


def high(values: Sequence[float], share: float = 0.95) -> float:
    return percentile(values, share) or 0.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=75, help="with changes, at most 75; half of it without")
    parser.add_argument("--drives", type=int, default=2)
    parser.add_argument("--set", nargs="*", default=[], help="overrides")
    options = parser.parse_args()
    show(rows(options.seconds, options.drives, options.set))


def rows(seconds: float = 75, drives: int = 2, more: Sequence[str] = ()) -> list[Row]:
    render_missing(configuration([*WORDS, *more]).vehicle(), lambda *_: None)
    parts = [parts_of_a_drive(seconds, SEED + number, more) for number in range(drives)]
    calm, changing = ([each[part] for each in parts] for part in (0, 1))
    return [*waits(changing), *compared(calm, "without"), *compared(changing, "with")]


def parts_of_a_drive(seconds: float, seed: int, more: Sequence[str]) -> tuple[Phase, Phase]:
    """Without changes of views, and with them."""
    with tempfile.TemporaryDirectory() as directory, driven(Path(directory), more) as page:
        take_control(page)
        viewing(page, "drive")
        time.sleep(SETTLE_S)
        calm = Phase(page)
        time.sleep(seconds / 2)
        calm.end(page)
        changing = Phase(page)
        changing.selected = change_views(page, seconds, random.Random(seed))
        changing.end(page)
        log = [json.loads(line) for line in (Path(directory) / "drive" / "drive.jsonl").read_text().splitlines()]
    for part in (calm, changing):
        part.read(log)
    return calm, changing


@contextmanager
def driven(directory: Path, more: Sequence[str]) -> Iterator[Page]:
    """The page of a demo that has started."""
    ports = {part: free_port() for part in ("page", "media", "control")}
    own = ("duration_s=1200", f"log={directory / 'drive'}", *(f"{part}.port={port}" for part, port in ports.items()))
    with process("demo", *WORDS, *more, *own, stdout=subprocess.DEVNULL) as demo, sync_playwright() as playwright:
        until(lambda: answers(ports["page"]))
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=CHROMIUM_FLAGS)
        page = browser.new_page(viewport={"width": 1280, "height": 720})
        page.goto(f"http://127.0.0.1:{ports['page']}/")
        until(lambda: page.evaluate("window.tod !== undefined"))
        all_live(page)
        yield page
        browser.close()
        demo.terminate()
        demo.wait(timeout=20)


def change_views(page: Page, seconds: float, chance: random.Random) -> Mapping[int, str]:
    """Change what the page shows, at random times; returns by number of the change the camera that it selects."""
    end = time.monotonic() + seconds
    selected: dict[int, str] = {}
    for number in range(10_000):
        if time.monotonic() > end:
            return selected
        match number % 6:
            case 0 | 3:
                page.keyboard.press("v")  # Drive or Configure view
            case 1:
                camera = chance.choice([*SIZES])
                selected[len(page.evaluate("tod.stated()"))] = camera
                page.locator(f'.tile[data-camera="{camera}"] .picture').dblclick()
            case 2:
                page.keyboard.press("Escape")
            case 4 | 5:
                selected[len(page.evaluate("tod.stated()"))] = "rear_center" if number % 6 == 4 else FRONT
                page.keyboard.press("r")  # the rear camera in place of the front one, and back
        time.sleep(chance.uniform(*PAUSES_S))
    return selected


class Drawn(NamedTuple):
    """A picture: when it was captured and drawn, ms, its region (None: all), its size, the image's width, px."""

    captured: float
    at: float
    region: Roi | None
    size: tuple[int, int]
    full_px: int

    @property
    def fineness(self) -> float:
        """Pixels of the picture for each of the image."""
        return self.size[0] / (self.region.width if self.region else self.full_px)


class Phase:
    """Part of a drive: pictures drawn, views stated, marks of pictures that are not live.

    first     how many views were stated before
    selected  by number of a view, the camera that it selects
    changed   when new pictures were needed
    queues    of the link, ms, as they were measured
    """

    def __init__(self, page: Page) -> None:
        self.began = time.time() * 1000
        self.ended = self.began
        self.drawn: dict[str, list[Drawn]] = {}
        self.stated: list[tuple[float, Mapping[str, Any]]] = []
        self.first = len(page.evaluate("tod.stated()"))
        self.selected: Mapping[int, str] = {}
        self._marks_before = max((at for at, *_ in _marks(page)), default=0.0)
        self.marks: list[tuple[float, str]] = []
        self.queues: list[float] = []
        self.changed: list[float] = []

    def end(self, page: Page) -> None:
        self.ended = time.time() * 1000
        for name, shown in page.evaluate("tod.shown()").items():
            full_px = (SIZES | TOPS)[name][0]
            every = [Drawn(captured, at, Roi(**r) if r else None, (w, h), full_px) for captured, at, r, w, h in shown]
            self.drawn[name] = [each for each in every if each.at >= self.began]
        self.stated = page.evaluate("tod.stated()")[self.first :]
        self.marks = [(at, mark) for at, _, mark in _marks(page) if at > self._marks_before and mark != "live"]

    def read(self, log: Sequence[Mapping[str, Any]]) -> None:
        """What the vehicle measured meanwhile."""
        began = log[0]["time"]
        looks = [line for line in log if line.get("event") == "link_measured"]
        self.queues = [look["queue_ms"] for look in looks if self.began <= 1000 * (began + look["t"]) <= self.ended]

    @property
    def minutes(self) -> float:
        """Of all cameras together."""
        return len(self.drawn) * (self.ended - self.began) / 60_000


def _marks(page: Page) -> Any:
    return page.evaluate("tod.measure()")["status_log"]


def waits(phases: Sequence[Phase]) -> Iterator[Row]:
    """From a statement to the picture, of the front and selected cameras, and of the last of all."""
    first, last, cameras = list[float](), list[float](), list[float]()
    for phase in phases:
        for number, (at, view) in enumerate(phase.stated, phase.first):
            found = {name: wait for name in view if (wait := _wait(phase.drawn[name], at, view[name])) is not None}
            cameras += found.values()
            first += [found[name] for name in {FRONT, phase.selected.get(number, FRONT)} if name in found]
            if found:
                last.append(max(found.values()))
                phase.changed.append(at)
    for what, values, most in (
        ("front and selected camera", first, RTT_MS + 3 * 1000 / FPS),
        ("each camera", cameras, RTT_MS + 500),
        ("last camera", last, RTT_MS + 500),
    ):
        p95 = high(values)
        yield Row(f"{what}: new view after, p95", p95, "ms", most=most, note=spread("", values, "").note)
        yield Row(f"{what}: new view after, median", high(values, 0.5), "ms")
    yield Row("changes that needed new pictures", len(last), "")


def _wait(drawn: Sequence[Drawn], at: float, seen: Mapping[str, int]) -> float | None:
    """ms until a camera's picture shows what is seen at least as finely as it soon will; None: it already did."""
    begin = bisect_right([each.at for each in drawn], at)
    end = bisect_right([each.at for each in drawn], at + 1000 * SOON_S)
    if not begin or begin == end or not seen["width"]:
        return None
    region = Roi(*(seen[key] for key in ("x", "y", "width", "height")))

    def shows(picture: Drawn) -> bool:
        covered = picture.region is None or enclosing(picture.region, region) == picture.region
        return covered and picture.fineness >= drawn[end - 1].fineness

    if shows(drawn[begin - 1]):
        return None
    return next((each.at - at for each in drawn[begin:end] if shows(each)), 1000 * SOON_S)


def compared(phases: Sequence[Phase], what: str) -> Iterator[Row]:
    """The queue in front of the link, the age of pictures, the time between two, and those marked as not live."""
    drawn = [pictures for phase in phases for pictures in phase.drawn.values()]
    pairs = [pair for pictures in drawn for pair in pairwise(pictures)]
    anew = [other.at - one.at for one, other in pairs if one.size != other.size]
    for of, values in (
        ("queue", [queue for phase in phases for queue in phase.queues]),
        ("age on the screen", [each.at - each.captured for pictures in drawn for each in pictures]),
        ("between two pictures", [other.at - one.at for one, other in pairs]),
        ("before the first of a new size", anew),
    ):
        if values:
            yield Row(f"{of}, {what} changes, p95", high(values), "ms", note=spread("", values, "").note)
    minutes = sum(phase.minutes for phase in phases)
    yield Row(f"new sizes {what} changes", len(anew) / minutes, "a minute, camera")
    marks = Counter(mark for phase in phases for _, mark in phase.marks)
    yield Row(f"marks {what} changes", marks.total() / minutes, "a minute, camera", note=str(dict(marks)))
    soon = [(at, at + 1000 * SOON_S) for phase in phases for at in phase.changed]
    if soon:
        seconds = sum(min(end, after) - at for (at, end), (after, _) in pairwise([*soon, (math.inf, math.inf)])) / 1000
        near = sum(any(at <= mark <= end for at, end in soon) for phase in phases for mark, _ in phase.marks)
        cameras = len(drawn) / len(phases)
        yield Row(f"marks within {SOON_S:g} s of a new view", 60 * near / (seconds * cameras), "a minute, camera")


if __name__ == "__main__":
    main()
