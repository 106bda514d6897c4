"""What predictions were worth in a drive: level, scatter and delay, and their figure."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from drives import believing, write_drive

from runner.drive.figures import figures
from runner.drive.predictions import EVERY_S, Compared, compared, worth
from runner.drive.read import read_drive
from runner.drive.series import series
from runner.drive.statistics import statistics
from runner.drive.time_series import FloatSeries

T = np.arange(0.0, 60.0, EVERY_S)
LEVELS = np.exp(np.random.default_rng(1).normal(8, 0.5, 40))  # one for each two seconds


def capacity(t: FloatSeries) -> FloatSeries:
    return LEVELS[np.clip(t / 2 + 5, 0, 39).astype(int)]


@pytest.mark.parametrize("late_s", [-2.0, 0.0, 1.0, 3.0])
def test_level_and_delay_are_told_apart(late_s: float) -> None:
    found = worth(Compared(T, 1.2 * capacity(T - late_s), capacity(T)))
    assert found.late_s == pytest.approx(late_s, abs=0.15)
    if not late_s:
        assert (found.bias, found.error) == (pytest.approx(-np.log(1.2)), pytest.approx(0))
        assert found.words == "20% too high ± 0%, in time"


def test_without_changes_no_delay_is_told() -> None:
    found = worth(Compared(T, np.full(T.shape, 3000.0), np.full(T.shape, 6000.0)))
    assert found.late_s is None
    assert found.words == "50% too low ± 0%"


def test_changes_that_have_nothing_to_do_with_the_link_tell_no_delay() -> None:
    other = np.exp(np.random.default_rng(2).normal(8, 0.5, 40))[(T / 1.7).astype(int)]
    assert worth(Compared(T, other, capacity(T))).late_s is None


def test_the_figure_shows_them_over_time_and_by_place(tmp_path: Path) -> None:
    change = believing(lambda t: 3000 + 100 * (t % 10))
    drive = statistics(series(read_drive(write_drive(tmp_path / "drive", seconds=30, change=change))))
    found, _ = figures([drive])
    (figure,) = [each for each in found if each.name == "predictions"]
    assert [bool(chart.track) for (chart,) in figure.rows] == [False, False, False, True]
    right, each = figure.rows[0][0].curves
    assert np.array_equal(right.x, right.y)
    assert each.points
    assert 20 <= each.x.size <= 30
    both = compared(drive.series)
    assert both is not None
    assert drive.predictions == worth(both)
    assert drive.notes[0] == f"predictions: {worth(both).words}"


def test_without_a_belief_it_is_left_out(tmp_path: Path) -> None:
    drive = statistics(series(read_drive(write_drive(tmp_path / "drive", seconds=15))))
    assert drive.predictions is None
    assert any(why.startswith("predictions: left out, ") for why in figures([drive])[1])
