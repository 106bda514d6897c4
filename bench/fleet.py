"""Three vehicles at one station, compared with three stations: processor time; and how long it takes to switch.

  python bench/fleet.py                     ten pairs of 20 s, then twenty switches; needs chromium
  python bench/fleet.py --pairs 4 --seconds 10 --switches 0

Three vehicles with three small cameras each at 10 Hz. In each pair all nine pictures are received, decoded and sent to
pages that draw nothing, first by one station and then by three, or the other way around. A switch lasts from the press
until all pictures of the other vehicle are live in the browser, which draws without a GPU. Run it on an otherwise idle
machine.
"""

from __future__ import annotations

import needs_tests  # noqa: F401 (first: makes parts of the tests importable)  # isort: skip

import argparse
import asyncio
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from statistics import median

from aiohttp import ClientSession, WSMsgType
from fleet_rig import NAMES, Programs, await_page, card, leave, live, pids_of
from playwright.sync_api import sync_playwright
from table import Row, show, spread
from usage import processor_s

from rig import BROWSER, CHROMIUM_FLAGS, free_port, until

CAMERAS, FPS = 3, 10
SETTLE_S = 4.0
MOST = 1.15  # times the processor time of three stations
SWITCH_S = 1.0
DUE = 0.95  # share of the pictures that must arrive for a pair to count


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pairs", type=int, default=10)
    parser.add_argument("--seconds", type=float, default=20)
    parser.add_argument("--switches", type=int, default=20)
    options = parser.parse_args()
    show(rows(options.pairs, options.seconds, options.switches))


def rows(pairs: int = 10, seconds: float = 20, switches: int = 20) -> list[Row]:
    with tempfile.TemporaryDirectory() as directory, Programs(Path(directory)) as programs:
        for name in NAMES:
            programs.vehicle(name)
        found = list(processor_rows(programs, pairs, seconds)) if pairs else []
        return [*found, switch_row(programs, switches)] if switches else found


def processor_rows(programs: Programs, pairs: int, seconds: float) -> Iterator[Row]:
    ratios, one, three, received = [], [], [], []
    for number in range(pairs):
        measured = {}
        for kind in ("one", "three") if number % 2 else ("three", "one"):
            measured[kind], share = cores(programs, kind, seconds)
            received.append(share)
            print(f"pair {number}: {kind}: {measured[kind]:.3f} cores, {share:.2f} of the pictures", flush=True)
        ratios.append(measured["one"] / measured["three"])
        one.append(measured["one"])
        three.append(measured["three"])
    note = f"{min(ratios):.3f} to {max(ratios):.3f} in {pairs} pairs"
    yield Row("one station for three vehicles, cores", median(one), "cores")
    yield Row("three stations, cores", median(three), "cores")
    yield Row("one station, times the processor time of three", median(ratios), "", most=MOST, note=note)
    yield Row("pictures received, of those due, at least", min(received), "", least=DUE)


def cores(programs: Programs, kind: str, seconds: float) -> tuple[float, float]:
    """Cores that the stations use, and the share of the pictures that their pages get."""
    if kind == "one":
        programs.station(programs.file())
        names, urls = ["station"], [f"{programs.url}vehicle/{name}/live" for name in NAMES]
        until(lambda: len(pids_of(programs)) == len(NAMES), 60)
    else:
        names, urls = [f"station of {name}" for name in NAMES], []
        for name, own in zip(NAMES, names, strict=True):
            port = free_port()
            programs.start(own, "operator", *programs.of(name), f"page.port={port}")
            urls.append(f"http://127.0.0.1:{port}/live")
    try:
        with pages(urls) as counts:
            until(lambda: all(count > CAMERAS * FPS for count in counts), 60)
            time.sleep(SETTLE_S)
            pids = [*(pids_of(programs).values() if kind == "one" else ()), *(programs.processes[n].pid for n in names)]
            before, seen, began = sum(map(processor_s, pids)), sum(counts), time.monotonic()
            time.sleep(seconds)
            used, elapsed = sum(map(processor_s, pids)) - before, time.monotonic() - began
            due = elapsed * len(NAMES) * CAMERAS * FPS
            return used / elapsed, (sum(counts) - seen) / due
    finally:
        programs.end(*names)


@contextmanager
def pages(urls: Sequence[str]) -> Iterator[list[int]]:
    """Pages that decode nothing: the number of pictures that each has got."""
    counts = [0 for _ in urls]
    loop, ended = asyncio.new_event_loop(), asyncio.Event()

    async def view(number: int, url: str) -> None:
        async with ClientSession() as session:
            while not ended.is_set():
                try:
                    async with session.ws_connect(f"{url}?viewer=bench{number}", max_msg_size=0) as ws:
                        async for message in ws:
                            counts[number] += message.type is WSMsgType.BINARY
                except OSError:
                    await asyncio.sleep(0.1)  # its station is starting

    async def run() -> None:
        tasks = [asyncio.create_task(view(number, url)) for number, url in enumerate(urls)]
        await ended.wait()
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    thread = threading.Thread(target=loop.run_until_complete, args=(run(),))
    thread.start()
    try:
        yield counts
    finally:
        loop.call_soon_threadsafe(ended.set)
        thread.join()


def switch_row(programs: Programs, switches: int) -> Row:
    programs.station(programs.file())
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=BROWSER, args=CHROMIUM_FLAGS)
        page = browser.new_page(viewport={"width": 1366, "height": 768})
        await_page(programs)
        page.goto(programs.url)
        until(lambda: page.locator(".state[data-level=fine]").count() == len(NAMES), 60, 0.1)
        card(page, NAMES[0]).locator("a.open").click()
        until(lambda: live(page) == CAMERAS, 60, 0.02)
        times = []
        for number in range(1, switches + 1):
            time.sleep(4.0)  # the pictures of the vehicle before have ended
            began = time.monotonic()
            leave(page, NAMES[number % len(NAMES)])
            until(lambda: live(page) == CAMERAS, 60, 0.02)
            times.append(time.monotonic() - began)
        browser.close()
    programs.end("station")
    return spread("switch to another vehicle until its pictures are live", times, "s")._replace(most=SWITCH_S)


if __name__ == "__main__":
    main()
