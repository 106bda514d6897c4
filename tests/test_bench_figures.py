"""What the benchmarks compute from drives: a wrong figure looks like any other. The drives are made up here."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from fractions import Fraction
from importlib import import_module
from itertools import pairwise
from pathlib import Path
from random import Random
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from runner.drive.camera_series import ReceivedSeries, Sent
from runner.records.lines import LinkSample

pytestmark = pytest.mark.slow  # imports matplotlib
NOTHING = np.array([])
BENCH = Path(__file__).resolve().parents[1] / "bench"
WITHOUT_PYTEST = """
import importlib.util
find_spec = importlib.util.find_spec
importlib.util.find_spec = lambda name, *more: None if name == "pytest" else find_spec(name, *more)
"""


@pytest.fixture(scope="module", autouse=True)
def _path() -> Any:
    path = str(BENCH)
    sys.path.append(path)
    yield
    sys.path.remove(path)


@pytest.fixture
def uplinks() -> ModuleType:
    return import_module("uplinks")


def link(*steps: tuple[float, float], until: float = 20.0, every: float = 0.1) -> Any:
    """A drive over a link of these rates, (s, kbit/s), half of which was used. Both logs began together."""
    samples, passed = [], 0.0
    for t in np.arange(0, until, every):
        kbps = next(rate for since, rate in reversed(steps) if since <= t + 1e-9)
        samples.append(LinkSample(t=float(t), kbps=kbps, queue_ms=10 * t, bytes=round(passed), packets=0, dropped=0))
        passed += kbps / 2 * every * 125
    side = SimpleNamespace(began=SimpleNamespace(time=100.0), of=lambda kind: (s for s in samples if type(s) is kind))
    return SimpleNamespace(sides={"link": side, "vehicle": SimpleNamespace(began=SimpleNamespace(time=100.0))})


def received(*arrivals: float, ms: float = 50.0, damaged: int = 0) -> ReceivedSeries:
    """Pictures that arrived at these times, the first of which are damaged; a sample every 0.25 s."""
    t = np.arange(0, 20, 0.25)
    broken = np.array([sum(at <= now for at in arrivals[:damaged]) for now in t], dtype=float)
    unused = dict.fromkeys(("kbps", "width", "height", "latency_ms", "bound_ms", "frames", "bytes"), NOTHING)
    rest = dict.fromkeys(("lost", "rebuilt"), NOTHING)
    arrival_t = np.array(arrivals)
    return ReceivedSeries(
        t=t, damaged=broken, arrival_t=arrival_t, arrival_ms=np.full(len(arrivals), ms), **unused, **rest
    )


def over_time(**cameras: Any) -> Any:
    return SimpleNamespace(cameras={name: SimpleNamespace(**kept) for name, kept in cameras.items()})


def test_an_outage_ends_when_the_link_is_usable_again(uplinks: ModuleType) -> None:
    t = np.array([0.0, 5, 7, 7.5, 9, 9.5, 12])
    kbps = np.array([2000.0, 0, 100, 800, 20, 900, 900])
    assert list(uplinks.outages(t, kbps)) == [7.5], "half a second without a link is none"


def test_the_first_undamaged_picture_captured_after_an_outage_ends_it(uplinks: ModuleType) -> None:
    t, kbps = np.array([0.0, 5, 7]), np.array([2000.0, 0, 2000])
    queued = received(7.04, 7.06, 7.4, ms=100)  # captured at 6.94, 6.96 and 7.3
    seen = over_time(front={"received": queued}, rear={"received": received(7.1, 7.2, 7.6, damaged=2)})
    assert uplinks.recovery_s(seen, t, kbps) == pytest.approx(0.6), "the slower camera's"
    never = over_time(front={"received": queued}, rear={"received": received(3.0)})
    assert uplinks.recovery_s(never, t, kbps) == np.inf
    assert np.isnan(uplinks.recovery_s(seen, t, np.full(3, 2000.0))), "no outage"


def test_the_share_of_a_link_that_was_used(uplinks: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    camera = SimpleNamespace(rate_quality=SimpleNamespace(b_full=Fraction(4000)))
    monkeypatch.setattr(uplinks, "cameras", lambda drive: {"front": camera})
    assert uplinks.link_use(link((0, 2000)), None) == pytest.approx(0.5, abs=0.01)
    assert uplinks.link_use(link((0, 8000)), None) == pytest.approx(1, abs=0.01), "the cameras can use 4000 at most"


def test_frames_that_a_busy_machine_dropped(uplinks: ModuleType) -> None:
    t = np.arange(0, 20, 1.0)
    whole = Sent(t=t, frames=10 * t, bytes=NOTHING, kbps=NOTHING)
    paused = replace(whole, frames=10 * np.where(t < 8, t, np.where(t < 12, 8, t - 4)))
    mounted = {name: SimpleNamespace(fps=Fraction(10)) for name in ("front", "rear")}
    assert uplinks.dropped_share(over_time(front={"sent": whole}, rear={"sent": paused}), mounted) == pytest.approx(0)
    mounted["rear"].fps = Fraction(20)
    assert 25 < uplinks.dropped_share(over_time(front={"sent": whole}, rear={"sent": paused}), mounted) < 33


def test_percentiles_of_the_queue_begin_once_settled(uplinks: ModuleType) -> None:
    found = uplinks.queue_ms(link((0, 2000)))
    assert (found["p50"], found["p95"]) == (pytest.approx(115, abs=2), pytest.approx(191, abs=2))


def test_time_until_the_total_fits_the_new_rate(monkeypatch: pytest.MonkeyPatch) -> None:
    rfc8867 = import_module("rfc8867")
    decided = [(0.0, 3900.0), (5.3, 3000.0), (5.7, 1900.0), (11.0, 2500.0), (12.5, 3300.0)]
    monkeypatch.setattr(rfc8867, "totals", lambda drive: decided)
    drive = link((0, 4000), (5, 2000), (10, 4000), (15, 1000))
    assert rfc8867.settling(drive) == {"down": np.inf, "up": pytest.approx(2.5)}, "the last fall was never followed"
    monkeypatch.setattr(rfc8867, "totals", lambda drive: [*decided, (15.2, 900.0)])
    assert rfc8867.settling(drive) == {"down": pytest.approx(0.45), "up": pytest.approx(2.5)}


def test_reactions_are_measured_from_the_planned_fall(monkeypatch: pytest.MonkeyPatch) -> None:
    reaction = import_module("reaction")
    monkeypatch.setattr(
        reaction, "totals", lambda drive: [(0.0, 4000.0), (8.2, 2100.0), (14.0, 4000.0), (30.0, 4000.0)]
    )
    drive = link((0, 4400), (8.1, 2200), (12, 4400), (20.1, 2200), (24, 4400), until=26)
    first, second = reaction.reactions(drive)
    assert (first.seconds, second.seconds) == (pytest.approx(0.2), np.inf)
    assert first.queue_ms == pytest.approx(119, abs=1.5)


def test_a_row_shows_median_and_range(uplinks: ModuleType) -> None:
    assert uplinks.shown("p99_ms", [100.0, 130.4, 90.0]) == "100 (90 to 130)"
    assert uplinks.shown("frozen", [0.25]) == "0.2"
    assert uplinks.shown("back_s", [float("nan")] * 2) == "–"


def test_a_row_is_void_if_the_cameras_do_not_use_their_bitrates(uplinks: ModuleType) -> None:
    one = dict.fromkeys(uplinks.FIGURES, 0.5)
    rows = {fill: list(uplinks.table({"lte": {"right": [one]}}, {"lte": fill}))[-1] for fill in (96.0, 94.0)}
    assert "(void)" not in rows[96.0]
    assert "| right (void) |" in rows[94.0]
    busy = list(uplinks.table({"lte": {"right": [one, {**one, "dropped": 1.5}]}}, {"lte": 100.0}))[-1]
    assert "| right (void) |" in busy


@pytest.mark.parametrize("script", ["ros", "sources", "deadspot"])
def test_a_benchmark_without_the_packages_of_tests_says_what_installs_them(tmp_path: Path, script: str) -> None:
    """As after `make setup`."""
    (tmp_path / "sitecustomize.py").write_text(WITHOUT_PYTEST)
    command = [sys.executable, str(BENCH / f"{script}.py"), "CLIP.mp4"]
    env = {**os.environ, "PYTHONPATH": str(tmp_path)}
    done = subprocess.run(command, env=env, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (
        1,
        f"{script}.py: needs packages that only tests install (pytest): "
        "run `make test` first, or install the extra: .venv/bin/pip install -e '.[dev]'\n",
    )


def test_cuts_are_apart_and_come_where_the_other_uplink_carries_enough() -> None:
    two_uplinks = import_module("two_uplinks")
    wide, narrow = [2000.0] * 100, [500.0] * 40 + [2000.0] * 60
    planned = two_uplinks.plan(wide, narrow, (0.2, 20.0), 3, Random(1))
    assert sorted(cut.for_s for cut in planned) == [0.2] * 3 + [20.0] * 3
    for before, cut in pairwise(planned):
        assert cut.at_s - before.at_s - before.for_s >= two_uplinks.PAUSE_S - 0.01
    assert all(cut.at_s % 100 >= 41 and (cut.at_s + cut.for_s + 2) % 100 >= 40 for cut in planned)


@pytest.mark.gst
def test_vp9_counts_what_a_packet_waits_for_on_its_way() -> None:
    vp9 = import_module("vp9")
    packet = SimpleNamespace(get_size=lambda: 1000 - vp9.UDP_BYTES)  # 8 ms of the link
    assert vp9.Way(1000, 0.0, True, 1).carry([packet] * 2, 1.0) == (pytest.approx(1.046), True)
    assert vp9.Way(1000, 1.0, False, 1).carry([packet], 0.0) == (pytest.approx(0.078), False), "awaited for 40 ms"
    assert vp9.Way(1000, 1.0, True, 1).carry([packet], 0.0) == (pytest.approx(0.258), False), "asked for three times"


@pytest.mark.gst
def test_vp9_is_damaged_until_a_whole_key_picture_and_asks_for_one_twice_a_second() -> None:
    vp9 = import_module("vp9")
    healing, later, key = vp9.Healing(vp9.VP9), SimpleNamespace(key=False), SimpleNamespace(key=True)
    seen = [healing.hand_on(*each) for each in ((later, 0.1, True), (later, 0.2, False), (later, 0.3, True))]
    assert seen == [False, True, True]
    assert [healing.is_key_due(at) for at in (0.2, 0.3, 0.6, 0.8)] == [False, True, False, True]
    assert [healing.hand_on(key, 0.9, whole) for whole in (False, True)] == [True, False]
    assert not healing.is_key_due(2.0)
