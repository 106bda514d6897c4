"""From points to a ladder: crossings, which factors are kept, confidence, plans."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from functools import partial
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from runner.rate_quality import plans
from runner.rate_quality.choice import ChoiceCriteria, choose, pooled
from runner.rate_quality.curves import (
    Point,
    best_ladder,
    bitrate_for_quality,
    build_ladder,
    cross,
    crossings,
    draw_curves,
    interpolated,
    mean_score,
    quality_drops,
)

RATES = [round(x) for x in np.geomspace(50, 4000, 20)]
EIGHTHS = [Fraction(n, 8) for n in range(1, 9)]
SCORE = mean_score("mssim")
CRITERIA = ChoiceCriteria("mssim", 1, tolerance=5e-4, narrowest=1.25, good=0.95, cores=None, fps=Fraction(25))


def quality(factor, kbps, hard=1.0):
    """A made-up encoder: a ceiling that rises with the factor, and coding noise that falls with bits per pixel."""
    ceiling = 1 - 0.04 * (1 - float(factor)) ** 2
    return ceiling - 0.06 * hard * (float(factor) ** 1.5) * (300 / kbps) ** 0.8


def point(factor, kbps, *, actual=None, hard=1.0, frames=40, noise=0.0):
    wobble = noise * np.sin(np.arange(frames) * (1 + 3 * float(factor)))
    scores = tuple(quality(factor, kbps, hard) + wobble)
    mean = kbps if actual is None else actual
    return Point(factor, kbps, mean, mean, 10 * float(factor) ** 2, {"mssim": scores})


def at(curves, kbps, factor):
    return np.interp(np.log(kbps), np.log(curves.kbps), curves.quality[factor])


def grid(factors=EIGHTHS, rates=RATES, **how):
    return [point(factor, kbps, **how) for factor in factors for kbps in rates]


def true_crossing(lower, upper):
    """The bitrate at which the two made-up curves meet."""
    low, high = 1.0, 1e6
    for _ in range(200):
        middle = (low * high) ** 0.5
        low, high = (low, middle) if quality(upper, middle) > quality(lower, middle) else (middle, high)
    return low


@given(st.lists(st.tuples(st.integers(1, 60), st.floats(0, 1)), min_size=1, max_size=8, unique_by=lambda p: p[0]))
def test_curves_are_pchip(points):
    kbps, y = (np.array(column, float) for column in zip(*sorted(points), strict=True))
    at = np.geomspace(kbps[0] / 2, kbps[-1] * 2, 50)
    found = interpolated(kbps, y, at)
    assert found.min() >= y.min() - 1e-9 and found.max() <= y.max() + 1e-9
    if len(y) > 1:
        pchip = pytest.importorskip("scipy.interpolate").PchipInterpolator(np.log(kbps), y)
        assert found == pytest.approx(pchip(np.log(np.clip(at, kbps[0], kbps[-1]))), abs=1e-9)


def test_a_crossing_is_where_the_curves_meet():
    half, whole = Fraction(1, 2), Fraction(1)
    curves = draw_curves(grid([half, whole]), SCORE)
    assert cross(curves, half, whole) == pytest.approx(true_crossing(half, whole), rel=0.01)


def test_curves_that_do_not_cross_have_no_crossing():
    quarter, whole = Fraction(1, 4), Fraction(1)
    low_rates = draw_curves(grid([quarter, whole], RATES[:5]), SCORE)
    assert cross(low_rates, quarter, whole) is None


def test_noisy_curves_get_one_crossing_the_one_that_loses_least():
    half, whole = Fraction(1, 2), Fraction(1)
    points = grid([half, whole])
    true = true_crossing(half, whole)
    # One wild point far below the crossing must not move it there.
    wild = next(n for n, p in enumerate(points) if p.scaling == whole and p.target_kbps < true / 3)
    points[wild] = point(whole, points[wild].target_kbps, hard=0.01)
    assert cross(draw_curves(points, SCORE), half, whole) == pytest.approx(true, rel=0.02)


def test_each_kept_factor_wins_its_range_and_the_loss_is_what_is_stated():
    curves = draw_curves(grid(), SCORE)
    ladder, table = best_ladder(curves, 5e-4, 1.25)
    assert ladder.regret_max <= 5e-4
    assert all(b / a >= 1.25 for a, b in pairwise(ladder.bounds))
    taken = [ladder.scaling[int(np.searchsorted(ladder.bounds, kbps, side="right"))] for kbps in curves.kbps]
    lost = curves.best - [at(curves, kbps, factor) for kbps, factor in zip(curves.kbps, taken, strict=True)]
    assert max(lost) == pytest.approx(ladder.regret_max, abs=1e-6)
    losses = [fewer.regret_max for fewer in table]
    assert losses == sorted(losses, reverse=True)
    assert [len(one.scaling) for one in table] == sorted({len(one.scaling) for one in table})


def test_a_smaller_tolerance_keeps_no_fewer_factors():
    curves = draw_curves(grid(), SCORE)
    sizes = [len(best_ladder(curves, tolerance, 1.0)[0].scaling) for tolerance in (1e-2, 1e-3, 1e-4, 1e-5)]
    assert sizes == sorted(sizes)
    assert sizes[0] < sizes[-1]


def test_points_that_miss_their_target_are_excluded():
    points = grid([Fraction(1, 2), Fraction(1)])
    honest = draw_curves(points, SCORE)
    # At full size the encoder cannot go below 300 kbit/s, and scores well for it.
    cheat = partial(point, Fraction(1), actual=330, hard=0.01)
    cheats = [p if p.scaling < 1 or p.target_kbps > 300 else cheat(p.target_kbps) for p in points]
    curves = draw_curves(cheats, SCORE)
    below = curves.kbps < 280
    assert np.all(np.isneginf(curves.quality[Fraction(1)][below]))
    assert np.allclose(curves.quality[Fraction(1, 2)], honest.quality[Fraction(1, 2)])


def test_a_factor_with_no_use_for_more_bitrate_stays_as_good():
    points = [point(Fraction(1, 8), kbps, actual=min(kbps, 150)) for kbps in (50, 100, 200, 400)]
    points += grid([Fraction(1)])
    curves = draw_curves(points, SCORE)
    assert at(curves, 4000, Fraction(1, 8)) == pytest.approx(quality(Fraction(1, 8), 400))


def test_points_that_all_miss_their_target_are_refused():
    nearest = "no encoding meets its target bitrate; the nearest: factor 1 reaches 200 at 100 kbit/s"
    with pytest.raises(ValueError, match=nearest):
        draw_curves([point(Fraction(1), 50, actual=200), point(Fraction(1), 100, actual=200)], SCORE)


def test_single_points_of_each_factor_are_too_few():
    points = [point(Fraction(1, 2), 100), point(Fraction(1), 400)]
    with pytest.raises(ValueError, match="no factor has two encodings that meet their target bitrates"):
        best_ladder(draw_curves(points, SCORE), 5e-4, 1.25)


def test_the_confidence_interval_contains_the_crossing_and_grows_with_noise():
    widths = []
    for noise in (0.0, 0.002):
        points = grid([Fraction(1, 2), Fraction(1)], noise=noise)
        ladder = build_ladder(draw_curves(points, SCORE), [Fraction(1, 2), Fraction(1)])
        (crossing,) = crossings(points, ladder, "mssim", 1)
        assert crossing.low <= crossing.kbps <= crossing.high
        widths.append(crossing.high - crossing.low)
    assert widths[0] == pytest.approx(0, abs=1)
    assert widths[1] > 5


@pytest.mark.slow
def test_the_same_points_give_the_same_confidence():
    points = grid(noise=0.002)
    ladder, _ = best_ladder(draw_curves(points, SCORE), 5e-4, 1.25)
    assert crossings(points, ladder, "mssim", 1) == crossings(points, ladder, "mssim", 1)


def test_b_full_is_where_the_quality_stays_reached():
    curves = draw_curves(grid(), SCORE)
    ladder, _ = best_ladder(curves, 5e-4, 1.25)
    kbps = bitrate_for_quality(curves, ladder, 0.97)
    assert np.interp(np.log(kbps), np.log(curves.kbps), curves.best) == pytest.approx(0.97, abs=2e-3)
    assert bitrate_for_quality(curves, ladder, 1.1) is None


def test_falling_curves_are_found():
    points = grid([Fraction(1)])
    points[10] = point(Fraction(1), points[10].target_kbps, hard=4)
    assert [(a.target_kbps, b.target_kbps) for a, b in quality_drops(points, SCORE, 1e-3)] == [(RATES[9], RATES[10])]


# --- the choice -------------------------------------------------------------------------------------------------------


def test_the_choice_is_a_valid_rate_quality_model():
    from runner.core.model import RateQualityModel

    choice = choose(grid(), CRITERIA)
    model = RateQualityModel(choice.scaling, tuple(map(Fraction, choice.b_min)), Fraction(choice.b_full))
    assert model.b_full > model.b_min[-1]
    assert set(choice.dropped) | set(choice.scaling) == set(EIGHTHS)
    assert choice.warnings == ()


def test_a_harder_scene_gets_higher_bounds_and_more_bitrate():
    easy, hard = (choose(grid(hard=hard), CRITERIA) for hard in (1.0, 2.0))
    assert hard.b_full > easy.b_full
    for crossing in easy.crossings:
        same = [c for c in hard.crossings if (c.lower, c.upper) == (crossing.lower, crossing.upper)]
        assert all(other.kbps > crossing.kbps for other in same)


def test_a_budget_of_the_processor_drops_large_factors():
    choice = choose(grid(), replace(CRITERIA, cores=0.1))
    assert max(choice.scaling) <= Fraction(5, 8)  # 10 ms * s^2 * 25 Hz <= 0.1
    assert choice.dropped[Fraction(1)] == "needs 0.25 of a core, allowed 0.1"
    with pytest.raises(ValueError, match=r"no factor's encoder needs at most 0\.001 of a core"):
        choose(grid(), replace(CRITERIA, cores=0.001))


def test_a_choice_warns_of_its_limits():
    unreached = choose(grid(), replace(CRITERIA, good=0.9999))
    assert unreached.b_full == 4000
    assert unreached.warnings[-1].startswith("b_full: mssim 0.9999 is not reached, 0.9")
    short = choose(grid(frames=10), CRITERIA)
    assert "only 10 frames were scored; use a longer sequence" in short.warnings
    one = choose(grid([Fraction(1, 2)]), CRITERIA)
    assert "the curves never cross between 50 and 4000 kbit/s: factor 0.5 is the best" in one.warnings


def test_a_choice_tells_of_an_encoder_that_holds_its_bitrate_in_the_mean_only():
    points = [replace(p, second_kbps=1.5 * p.actual_kbps) if p.scaling == 1 else p for p in grid()]
    assert choose(points, CRITERIA).warnings == (
        "factor 1 exceeds 20 of its targets in some second: it reaches 75 at a target of 50 kbit/s",
    )


def test_lower_is_better_reverses_everything():
    points = [replace(p, scores={"brisque": tuple(100 * (1 - s) for s in p.scores["mssim"])}) for p in grid()]
    turned = choose(points, ChoiceCriteria("brisque", -1, 0.05, 1.25, 5.0, None, Fraction(25)))
    straight = choose(grid(), CRITERIA)
    assert (turned.scaling, turned.b_min, turned.b_full) == (straight.scaling, straight.b_min, straight.b_full)


def test_pooled_cameras_have_the_mean_of_their_curves():
    easy, hard = grid(hard=1.0), grid(hard=2.0)
    both = {(p.scaling, p.target_kbps): SCORE(p) for p in pooled([easy, hard])}
    for one, other in zip(easy, hard, strict=True):
        assert both[one.scaling, one.target_kbps] == pytest.approx((SCORE(one) + SCORE(other)) / 2)
    assert len(pooled([easy, hard[:5]])) == 5


# --- plans ------------------------------------------------------------------------------------------------------------


def run_adaptive(**how):
    points = []
    for _ in range(50):
        lanes = plans.adaptive(EIGHTHS, RATES, points, [SCORE], 5e-4, 1.25)
        if not lanes:
            return points
        points += [point(lane.scaling, lane.kbps, **how) for lane in lanes]
    raise AssertionError("the plan does not end")


@pytest.mark.slow
@settings(max_examples=10)
@given(st.floats(0.3, 4.0))
def test_the_adaptive_plan_chooses_as_the_full_one_with_a_third_of_the_encodings(hard):
    points = run_adaptive(hard=hard)
    assert len(points) <= len(EIGHTHS) * len(RATES) // 3
    full = draw_curves(grid(hard=hard), SCORE)
    chosen, _ = best_ladder(draw_curves(points, SCORE), 5e-4, 1.25)
    judged = build_ladder(full, chosen.scaling)  # its factors on the curves of the full plan
    assert judged is not None
    assert judged.regret_max < 1e-3
    for mine, theirs in zip(chosen.bounds, judged.bounds, strict=True):
        assert mine == pytest.approx(theirs, rel=0.05)


def test_the_full_plan_is_every_factor_at_every_bitrate_once():
    lanes = plans.full(EIGHTHS, RATES, [])
    assert len(lanes) == len(set(lanes)) == 160
    assert plans.full(EIGHTHS, RATES, grid()) == []


def test_rates_are_spread_evenly_and_keep_their_ends():
    assert plans.spread(RATES, 4) == [50, 200, 1002, 4000]
    assert plans.spread([100, 900], 4) == [100, 900]
