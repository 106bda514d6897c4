"""The vehicle's sound over a limited link: its age, gaps and level at a page, what it costs, whether it takes frames.

  sudo .venv/bin/python bench/sound.py                          12 minutes
  sudo .venv/bin/python bench/sound.py --only loss --seconds 60
  sudo .venv/bin/python bench/sound.py --only pairs --pairs 6

A round trip of 60 ms: 15 ms with 0 to 30 ms of jitter to the operator, 30 ms back. A tone is played by the page of a
browser, which states its age when it is heard, and its level, losses concealed. Then drives with and without sound in
turn, of a camera whose pictures fill the link. Needs chromium, and root, as `link=netns` does. Run it on an otherwise
idle machine.
"""

from __future__ import annotations

import needs_tests  # noqa: F401 (first: makes parts of the tests importable)  # isort: skip

import argparse
import math
import random
import shutil
import time
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from statistics import median
from subprocess import DEVNULL, Popen
from typing import Any, NamedTuple

from playwright.sync_api import Browser, Page, sync_playwright
from table import Row, show, spread
from usage import processor_of_tree_s

from rig import CHROMIUM_FLAGS, answers, free_port, process, small_robot, until
from runner.link import limited_link
from runner.link.limit import Limit, OneWay
from runner.mqtt.broker import private_broker
from runner.operator.meter import percentile
from runner.records.lines import LinkSample
from runner.settings import Endpoint

LOSSES = (0.0, 0.02, 0.05)
DELAY_MS, JITTER_MS, BACK_MS = 15, 30, 30
AMPLE_KBPS, FULL_KBPS = 20_000, 3000
TONE_DB = -15.05  # RMS of the source
SETTLE_S, LOOK_S = 8.0, 0.1
MOST_AGE_MS, MOST_AHEAD_MS, LEAST_DB, LEAST_SHARE = 200, 80, -1.0, 1 / 1.02
COMMON = ("source=test", "modes=open_loop", "pqos=constant", f"pqos.kbps={FULL_KBPS}")
SEVERAL = (*small_robot("front", "rear", "mast"), "fps_max=15", *COMMON)
# Snow takes all bits that its encoder may have.
ONE = (*small_robot("front"), "fps_max=30", *COMMON, "source.elements.0.properties.pattern=snow")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", choices=("loss", "pairs"))
    parser.add_argument("--seconds", type=float, default=60, help="of a drive; of one of a pair: half of it")
    parser.add_argument("--pairs", type=int, default=6)
    parser.add_argument("--loss", type=float, nargs="*", default=LOSSES, help="shares of packets that are lost")
    parser.add_argument("words", nargs="*", help="overrides of the drives with losses")
    options = parser.parse_args()
    rows: list[Row] = []
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=CHROMIUM_FLAGS)
        if options.only != "pairs":
            rows += [row for loss in options.loss for row in heard(browser, loss, options.seconds, options.words)]
        if options.only != "loss":
            rows += paired(browser, options.pairs, options.seconds / 2)
        browser.close()
    show(rows)


def heard(browser: Browser, loss: float, seconds: float, words: Sequence[str]) -> Iterator[Row]:
    """What is heard over a link that loses packets."""
    what = f"{100 * loss:g} % loss"
    with drive(browser, [*SEVERAL, "sound=test", *words], AMPLE_KBPS, loss) as sides:
        drive_ = measured(sides, seconds)
    looks = drive_.looks
    ages, ahead, levels = (
        [each[key] for each in looks if each[key] is not None] for key in ("age_ms", "ahead_ms", "level_db")
    )
    first, last = looks[0]["counts"], looks[-1]["counts"]
    a_minute = {key: 60 * (last[key] - first[key]) / drive_.seconds for key in last}
    power = sum(10 ** (level / 10) for level in levels) / len(levels)
    yield spread(f"{what}: age when heard", ages, "ms")
    yield Row(f"{what}: the same, p95", percentile(ages, 0.95), "ms", most=MOST_AGE_MS)
    note = f"median {median(ahead):.0f}, p5 {percentile(ahead, 0.05):.0f}; minus: sound is later"
    yield Row(f"{what}: ahead of the front picture, p95", percentile(ahead, 0.95), "ms", most=MOST_AHEAD_MS, note=note)
    note = "silence, after 60 ms without a packet"
    yield Row(f"{what}: gaps a minute", a_minute["dry"], "", note=note)
    note = f"{a_minute['played']:.0f} played, {a_minute['skipped']:.0f} skipped"
    yield Row(f"{what}: packets concealed a minute", a_minute["concealed"], "", note=note)
    note = f"lowest tenth of a second {min(levels) - TONE_DB:.1f}"
    yield Row(f"{what}: level of the tone", 10 * math.log10(power) - TONE_DB, "dB", least=LEAST_DB, note=note)
    yield Row(f"{what}: processor, vehicle", drive_.vehicle, "cores", note=f"operator {drive_.operator:.2f}")


def paired(browser: Browser, pairs: int, seconds: float) -> Iterator[Row]:
    """Drives without and with sound, in changing order."""
    found: dict[bool, list[Measured]] = {False: [], True: []}
    for number in range(pairs):
        for has_sound in (False, True) if number % 2 else (True, False):
            words = [*ONE, *(["sound=test"] if has_sound else [])]
            with drive(browser, words, 1.1 * FULL_KBPS) as sides:
                found[has_sound].append(measured(sides, seconds))
    both = list(zip(found[False], found[True], strict=True))
    for what, unit, key, least in (
        ("frames of a camera that fills the link", "Hz", "fps", LEAST_SHARE),
        ("sent by the vehicle", "kbit/s", "kbps", None),
        ("vehicle's side: processor", "cores", "vehicle", None),
        ("operator's side: processor", "cores", "operator", None),
    ):
        without, with_it = ([getattr(each[side], key) for each in both] for side in (0, 1))
        ratios = sorted(b / a for a, b in zip(without, with_it, strict=True))
        note = f"without {median(without):.4g}; {pairs} pairs, ratios {ratios[0]:.3f} to {ratios[-1]:.3f}"
        yield Row(f"with sound: {what}", median(with_it), unit, note=note)
        yield Row("  ratio, median of the pairs", median(ratios), "", least=least)


class Sides(NamedTuple):
    link: Sequence[LinkSample]
    page: Page
    vehicle: Popen[str]
    operator: Popen[str]


class Measured(NamedTuple):
    """looks: what the page stated of the sound; fps: of the camera at the page; vehicle, operator: cores."""

    seconds: float
    looks: Sequence[dict[str, Any]]
    fps: float
    kbps: float
    vehicle: float
    operator: float


def measured(sides: Sides, seconds: float) -> Measured:
    def counters() -> tuple[float, ...]:
        camera, *_ = _cameras(sides.page)
        used = (processor_of_tree_s(side.pid) for side in (sides.vehicle, sides.operator))
        return time.monotonic(), camera["received"], 8 * sides.link[-1].bytes / 1000, *used

    looks, before = [], counters()
    while time.monotonic() < before[0] + seconds:
        looks.append(sides.page.evaluate("tod.hearing()"))
        time.sleep(LOOK_S)
    took, *counted = (b - a for a, b in zip(before, counters(), strict=True))
    return Measured(took, looks, *(each / took for each in counted))


def _cameras(page: Page) -> list[dict[str, Any]]:
    return list(page.evaluate("tod.measure()")["cameras"].values())


@contextmanager
def drive(browser: Browser, words: Sequence[str], kbps: float, loss: float = 0.0) -> Iterator[Sides]:
    """A vehicle behind the link, a station, and a browser that shows its page."""
    media, control = (Endpoint("127.0.0.1", free_port()) for _ in range(2))
    chance, port, samples = random.Random(1), free_port(), deque[LinkSample](maxlen=1)
    back = OneWay(lambda t: AMPLE_KBPS, 200, BACK_MS, loss)
    limit = Limit(lambda t: kbps, 200, DELAY_MS, loss, delay_at=lambda t: chance.uniform(0, JITTER_MS), reverse=back)
    with (
        limited_link("netns", limit, media, control, samples.append) as link,
        private_broker(link.broker),
        process("vehicle", *words, *link.vehicle_overrides, before=link.vehicle_command, stdout=DEVNULL) as vehicle,
        process("operator", *words, *link.operator_overrides, f"page.port={port}", stdout=DEVNULL) as operator,
    ):
        link.start(time.time())
        until(lambda: answers(port), seconds=30)
        with browser.new_context(viewport={"width": 1280, "height": 800}) as context:
            page = context.new_page()
            page.goto(f"http://127.0.0.1:{port}/")
            page.click("#vehicle")  # browsers play nothing before a press
            until(lambda: all(each["received"] for each in _cameras(page)), seconds=30)
            time.sleep(SETTLE_S)
            yield Sides(samples, page, vehicle, operator)
        link.check()


if __name__ == "__main__":
    main()
