"""Which cameras the demo shows on so many cores, how often, and what it says of it."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from helpers import vehicle

from runner.verbs import Arguments
from runner.verbs.demo import with_shown
from runner.verbs.demo_choice import SMOOTH_HZ, highest_rate, showable

PAPER, ROBOT = (list(vehicle(f"vehicle={name}").cameras.values()) for name in ("tum_q7", "delivery_robot"))
AHEAD = {"front_left", "front_center", "front_right"}
TOP = {"top_front", "top_left", "top_right", "top_rear"}


@pytest.mark.parametrize(
    ("cores", "shown"),
    [
        (1, {"front_center"}),
        (2, AHEAD),
        (4, AHEAD | {"rear_center"}),
        (8, AHEAD | {"rear_center"} | TOP),
    ],
)
def test_more_cores_show_more_cameras_smoothly(cores: int, shown: set[str]) -> None:
    choice = showable(PAPER, cores)
    assert set(choice.cameras) == shown
    assert choice.cameras[0] == "front_center"
    assert choice.fps_max is not None and choice.fps_max >= SMOOTH_HZ


def test_many_cores_show_everything_at_the_cameras_own_rates() -> None:
    choice = showable(PAPER, 16)
    assert (choice.fps_max, len(choice.cameras)) == (None, 8)


def test_the_rate_of_all_cameras_falls_with_the_cores() -> None:
    rates = [highest_rate(PAPER, cores).fps_max or 40 for cores in (1, 2, 4, 8, 16)]
    assert rates == sorted(set(rates)) and rates[0] >= 1
    assert [highest_rate([camera], 2).fps_max for camera in ROBOT] == [None, None, None]


def test_side_cameras_come_as_a_pair_and_top_views_together() -> None:
    for cores in range(1, 17):
        shown = set(showable(PAPER, cores).cameras)
        assert len(shown & {"front_left", "front_right"}) in (0, 2)
        assert len(shown & TOP) in (0, 4)


def shown(monkeypatch: pytest.MonkeyPatch, *words: str, cores: int = 2) -> tuple[list[str], list[str]]:
    """The overrides that are added to a command line, and what is said."""
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(cores)))
    monkeypatch.setattr("sys.argv", ["/x/.venv/bin/tod-runner"])
    monkeypatch.setenv("PATH", "/nowhere")
    arguments = Arguments.parse("demo", words)
    chosen, config, told = with_shown(arguments)
    added = chosen.overrides[: len(chosen.overrides) - len(arguments.overrides)]
    assert config.document.get("fps_max") is not None or not added
    return added, told


def test_what_is_left_out_is_said_with_the_command_for_all(monkeypatch: pytest.MonkeyPatch) -> None:
    hz, slow = showable(PAPER, 2).fps_max, highest_rate(PAPER, 2).fps_max
    added, told = shown(monkeypatch, "graph=openh264_rtsp", "duration_s=9")
    rest = ["rear_center", "top_front", "top_left", "top_right", "top_rear"]
    assert added == [*(f"~cameras.{name}" for name in rest), f"fps_max={hz}"]
    assert told == [
        f"3 of 8 cameras at {hz} Hz: as many as 2 cores show smoothly",
        f"left out: {', '.join(rest)}",
        f"all 8 at {slow} Hz: /x/.venv/bin/tod-runner demo graph=openh264_rtsp duration_s=9 vehicle=tum_q7",
    ]


@pytest.mark.parametrize(
    "words",
    [
        ["vehicle=tum_q7"],
        ["experiment=driving_test"],
        ["~cameras.top_rear"],
        ["cameras.top_rear.weight=2"],
        ["study.pool={behind: [rear_center, top_rear]}"],
    ],
)
def test_named_cameras_are_kept_at_a_rate_that_is_said(monkeypatch: pytest.MonkeyPatch, words: list[str]) -> None:
    (rate,), told = shown(monkeypatch, *words)
    hz = rate.removeprefix("fps_max=")
    count = 7 if words == ["~cameras.top_rear"] else 8
    rule = "as fast as 2 cores show them; fps_max=null: at their own rates"
    assert told == [f"{count} cameras at {hz} Hz: {rule}"]


@pytest.mark.parametrize("words", [["fps_max=15"], ["fps_max=null"], ["experiment=loss"]])
def test_a_named_rate_is_kept(monkeypatch: pytest.MonkeyPatch, words: list[str]) -> None:
    assert shown(monkeypatch, *words, cores=1) == ([], [])


def test_a_directory_of_ones_own_keeps_all_cameras(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    added, _ = shown(monkeypatch, f"conf={tmp_path}")
    assert [word.partition("=")[0] for word in added] == ["fps_max"]


def test_many_cores_leave_nothing_to_say(monkeypatch: pytest.MonkeyPatch) -> None:
    assert shown(monkeypatch, cores=16) == ([], [])
