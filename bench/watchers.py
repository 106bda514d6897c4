"""What ten people who watch at one page cost: bits that the vehicle sends, and latency of the driver's pictures.

  python bench/watchers.py [--pairs 10] [--seconds 10] [--watchers 10] [WORD ...]

One drive over a link of its own, with keys; in turn, blocks with the watchers and without. The watchers receive
everything, over TLS, and decode nothing; the driver's latency is from capture until a picture has reached the driver's
page. Words are overrides of the drive. Needs root, as `link=netns` does, and an otherwise idle machine.
"""

from __future__ import annotations

import needs_tests  # noqa: F401 (first: makes parts of the tests importable)  # isort: skip

import argparse
import math
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from statistics import median
from typing import NamedTuple

from table import Row, show
from visitors import Page, Watching, driver, issue, page, uplink_bytes, vehicle, watching

from rig import small_robot, until
from runner.core.roles import Role
from runner.operator.meter import percentile
from runner.security.page_people import PagePerson, change_people

CAMERAS = ("front", "rear", "mast")
WORDS = (*small_robot(*CAMERAS), "source=test", "fps_max=15", "modes=open_loop", "pqos=constant", "pqos.kbps=3000")
SETTLE_S = 2.0
MOST_PERCENT, MOST_MS = 2.0, 5.0  # that watchers may add


class Block(NamedTuple):
    """A part of the drive. gap_s: the longest time without a picture that any watcher had of any camera, s."""

    kbps: float
    p95_ms: float
    gap_s: float = 0.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pairs", type=int, default=10)
    parser.add_argument("--seconds", type=float, default=10)
    parser.add_argument("--watchers", type=int, default=10)
    parser.add_argument("words", nargs="*")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as directory:
        names = [f"watcher{number}" for number in range(options.watchers)]
        people = change_people(Path(directory) / "people", dict.fromkeys(names, Role.WATCHER))
        keys = issue(Path(directory) / "keys")
        pairs = list(_pairs(keys, Path(directory) / "people", people, options))
    show(list(_rows(pairs)))


def _pairs(
    keys: Path, file: Path, people: Mapping[str, PagePerson], options: argparse.Namespace
) -> Iterator[tuple[Block, Block]]:
    """Blocks without and with watchers, in changing order."""
    latencies: list[float] = []
    with (
        vehicle(keys, *WORDS, *options.words) as (words, _),
        page(keys, file, words) as at,
        driver(at, lambda captured, arrived: latencies.append(1000 * (arrived - captured))) as watcher,
    ):
        until(lambda: len(watcher.seen()) == len(CAMERAS), seconds=60)
        for number in range(options.pairs):
            blocks = {}
            for watched in (False, True) if number % 2 else (True, False):
                blocks[watched] = _block(at, people if watched else {}, latencies, options.seconds)
                print(f"{'with' if watched else 'without':8} {blocks[watched]}", flush=True)
            yield blocks[False], blocks[True]


def _block(at: Page, people: Mapping[str, PagePerson], latencies: list[float], seconds: float) -> Block:
    if not people:
        return _measured(latencies, seconds)
    with watching(at, people) as watchers:
        until(lambda: _all_watch(watchers, people), seconds=60)
        block = _measured(latencies, seconds)
        lines = watchers.lines[-round(seconds / 0.25) :]
    return block._replace(gap_s=max(seen.gap_s for line in lines for of in line.values() for seen in of.values()))


def _all_watch(watchers: Watching, people: Mapping[str, PagePerson]) -> bool:
    seen = watchers.lines[-1] if watchers.lines else {}
    return seen.keys() == people.keys() and all(len(cameras) == len(CAMERAS) for cameras in seen.values())


def _measured(latencies: list[float], seconds: float) -> Block:
    time.sleep(SETTLE_S)
    before, began = uplink_bytes(), time.monotonic()
    latencies.clear()
    time.sleep(seconds)
    kbps = 8 * (uplink_bytes() - before) / 1000 / (time.monotonic() - began)
    known = [ms for ms in tuple(latencies) if math.isfinite(ms)]
    if not known:
        sys.exit("no picture of known latency reached the driver's page: is the machine idle?")
    return Block(kbps, percentile(known, 0.95))


def _rows(pairs: list[tuple[Block, Block]]) -> Iterator[Row]:
    shares = sorted(watched.kbps / alone.kbps - 1 for alone, watched in pairs)
    added = sorted(watched.p95_ms - alone.p95_ms for alone, watched in pairs)
    for name, unit in (("kbps", "kbit/s"), ("p95_ms", "ms")):
        what = "sent by the vehicle" if name == "kbps" else "driver's pictures, capture to page, p95"
        alone, watched = (median(getattr(pair[side], name) for pair in pairs) for side in (0, 1))
        yield Row(f"{what}: watched", watched, unit, note=f"{alone:.4g} without watchers")
    for what, found, most, unit in (
        ("sent: added by the watchers, median of pairs", [100 * share for share in shares], MOST_PERCENT, "%"),
        ("p95: added by the watchers, median of pairs", added, MOST_MS, "ms"),
    ):
        yield Row(what, median(found), unit, most=most, note=f"{found[0]:.2f} to {found[-1]:.2f}")
    yield Row("longest wait of a watcher for a picture", 1000 * max(watched.gap_s for _, watched in pairs), "ms")


if __name__ == "__main__":
    main()
