"""An operator's side whose GStreamer hangs for a while, as on an overloaded machine."""

from __future__ import annotations

import re
import time
from types import SimpleNamespace
from typing import Any

import pytest
from helpers import vehicle

from runner.core.view import NOWHERE, Seen
from runner.errors import RunError, UserError
from runner.operator import live
from runner.operator.live import LiveOperator
from runner.operator.seen import StatedView

HANGS = "GStreamer hangs: reading the receivers' counters takes more than 10 s"


def operator(hangs: int, notes: list[str], samples: list[Any]) -> LiveOperator:
    """An operator whose first samples fail."""
    left = [RunError(HANGS)] * hangs

    def sample(_sending: Any, *, anew: bool) -> dict[str, Any]:
        assert not anew
        if left:
            raise left.pop()
        return {}

    side: Any = SimpleNamespace(sample=sample, received=dict, sound=None, stop=lambda: None)
    station: Any = SimpleNamespace(
        state=None,
        seen=StatedView(),
        connect=lambda: None,
        close=lambda: None,
        link=SimpleNamespace(is_behind=lambda: True),
        sending=dict,
        addresses={},
        take=lambda taken, _over, _sound: samples.append(taken),
        note=notes.append,
    )
    log: Any = SimpleNamespace(begin=lambda: None, close=lambda: None)
    return LiveOperator(SimpleNamespace(), station, log, lambda *_on_unit: side)  # type: ignore[arg-type]


def before_start(stated: StatedView) -> LiveOperator:
    """An operator of a robot, without streams."""
    setup: Any = SimpleNamespace(vehicle=vehicle("vehicle=delivery_robot"))
    station: Any = SimpleNamespace(seen=stated)
    log: Any = SimpleNamespace()
    return LiveOperator(setup, station, log, lambda *_: SimpleNamespace())  # type: ignore[arg-type,return-value]


@pytest.mark.parametrize(
    ("view", "problem"),
    [
        ({"fron": NOWHERE}, "view: fron: unknown camera, did you mean front?"),
        ({"front": Seen(0, 0, 2000, 100, 10, 10)}, "must lie inside the image of 1280x720 px"),
        ({"front": Seen(-1, 0, 10, 10, 10, 10)}, "x: must be an integer from 0 to 65535"),
        ({"front": Seen(0, 0, 10, 10, 70_000, 10)}, "screen_width: must be an integer from 0 to 65535"),
        ({"front": Seen(0, 0, 10, 10, 10, 10.5)}, "screen_height: must be an integer from 0 to 65535"),
        ({"front": Seen(0, 0, 10, 10, 0, 0)}, "all or none must be 0"),
    ],
)
def test_a_program_that_shows_the_impossible_is_told_so(view: dict[str, Seen], problem: str) -> None:
    stated = StatedView()
    running = before_start(stated)
    running.see({"rear": NOWHERE})
    with pytest.raises(UserError, match=re.escape(problem)):
        running.see({"rear": Seen(0, 0, 10, 10, 10, 10), **view})
    assert stated.view == {"rear": NOWHERE}


@pytest.mark.parametrize(
    ("samples", "spoken", "problem"),
    [
        (b"", 1.0, "samples: 0 bytes: must be whole samples of 2 bytes, at least one, at most 1 s of 48000 Hz"),
        (b"odd", 1.0, "samples: 3 bytes: must be whole samples of 2 bytes"),
        (bytes(2 * 48_001), 1.0, "samples: 96002 bytes: must be whole samples of 2 bytes"),
        (b"ab", float("nan"), "spoken: nan: must be s by a clock"),
    ],
)
def test_a_program_that_speaks_what_is_no_voice_is_told_so(samples: bytes, spoken: float, problem: str) -> None:
    with pytest.raises(UserError, match=re.escape(problem)):
        before_start(StatedView()).speak(samples, spoken)


def test_a_view_survives_a_machine_that_is_overloaded_for_a_while(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live, "SAMPLE_S", 0.01)
    notes: list[str] = []
    samples: list[Any] = []
    running = operator(3, notes, samples)
    running.start()
    try:
        end = time.monotonic() + 30
        while not samples and time.monotonic() < end:
            assert running.runs(0.01)
        assert samples
        assert notes == [f"a sample failed: {HANGS}"]
    finally:
        running.stop()


def test_a_view_that_hangs_for_long_ends_with_the_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live, "SAMPLE_S", 0.01)
    monkeypatch.setattr(live, "GIVE_UP_S", 0.3)
    running = operator(1_000_000, [], [])
    running.start()
    try:
        with pytest.raises(RunError, match=HANGS):
            running.runs(30)
    finally:
        running.stop()
