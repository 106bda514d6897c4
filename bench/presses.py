"""From a key or click to the frame that shows it, on a page that draws eight cameras.

  python bench/presses.py [--presses 20]

The browser's own Event Timing (W3C) states the time from a press to the next frame that is presented, in steps of 8 ms,
and leaves out presses below 16 ms. Beside it stand the page's own frame interval at that time, from animation frames,
and the same press on a bare page that paints one canvas: no page is faster on this machine.
Needs chromium. Run it on an otherwise idle machine.
"""

from __future__ import annotations

import needs_tests  # noqa: F401 (first: makes parts of the tests importable)  # isort: skip

import argparse
import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import cycle, islice

from page import EIGHT, SETTLE_S, station, vehicle
from playwright.sync_api import Browser, Page, sync_playwright
from table import Row, show, spread

from rig import CHROMIUM_FLAGS, until

APART_S = 0.3
SHORT_MS = 8  # of a press that Event Timing leaves out: it took less than 16 ms
WATCH = """() => {
  globalThis.took = [];
  new PerformanceObserver((list) => {
    for (const { name, duration } of list.getEntries()) if (["keydown", "click"].includes(name)) took.push(duration);
  }).observe({ type: "event", durationThreshold: 16 });
  globalThis.frames = [];
  const frame = (at) => (frames.push(at), requestAnimationFrame(frame));
  requestAnimationFrame(frame);
}"""
KEYS = {"choose a camera": "12", "lines on the ground": "g", "drawer": "d", "day and night": "n", "view": "v"}
BUTTON = "#guides"
BARE = """<p id=count></p><canvas id=road width=1200 height=700></canvas><script>
  const context = road.getContext("2d");
  const paint = (at) => {
    context.fillStyle = `hsl(${at / 10} 50% 50%)`;
    context.fillRect(0, 0, road.width, road.height);
    requestAnimationFrame(paint);
  };
  requestAnimationFrame(paint);
  addEventListener("keydown", () => { count.textContent = performance.now(); });
</script>"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--presses", type=int, default=20, help="of each key")
    show(list(rows(parser.parse_args().presses)))


def rows(presses: int) -> Iterator[Row]:
    what, count, video, kbps = EIGHT
    with (
        sync_playwright() as playwright,
        playwright.chromium.launch(executable_path=shutil.which("chromium"), args=CHROMIUM_FLAGS) as browser,
        vehicle(count, video, kbps) as words,
        station(words) as (url, *_),
    ):
        yield _bare(browser, presses)
        page = browser.new_page(viewport={"width": 1920, "height": 1080})
        page.goto(url)
        until(lambda: page.evaluate("window.tod?.control") == "you")
        page.keyboard.press("v")
        time.sleep(SETTLE_S)
        page.evaluate(WATCH)
        for action, keys in KEYS.items():
            yield _measured(page, f"{what}: {action}", [partial(page.keyboard.press, key) for key in keys], presses)
        yield _measured(page, f"{what}: a click", [page.locator(BUTTON).click], presses)
        between = page.evaluate("frames.slice(1).map((at, index) => at - frames[index])")
        yield spread(f"{what}: between two frames of the page", between, "ms")


def _bare(browser: Browser, presses: int) -> Row:
    """While vehicle and station run as they do for the others."""
    with browser.new_page(viewport={"width": 1920, "height": 1080}) as page:
        page.set_content(BARE)
        page.evaluate(WATCH)
        return _measured(page, "a bare page", [partial(page.keyboard.press, "g")], presses)


def _measured(page: Page, what: str, acts: Sequence[Callable[[], None]], presses: int) -> Row:
    page.evaluate("took.length = 0")
    for act in islice(cycle(acts), presses):
        act()
        time.sleep(APART_S)
    took = page.evaluate("took")
    return spread(what, [*took, *[SHORT_MS] * (presses - len(took))], "ms")


if __name__ == "__main__":
    main()
