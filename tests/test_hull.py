"""Quality over bitrate, and the shares of a total that buy most of it."""

from __future__ import annotations

from math import inf

import pytest
from hypothesis import given
from hypothesis import strategies as st

from runner.core.hull import Contender, Curve, best_shares, concave

STEEP, FLAT = Curve((100.0, 300.0), (0.8, 0.9)), Curve((100.0, 300.0), (0.4, 0.5))


def test_the_hull_of_measured_points():
    assert concave([(200, 0.5), (100, 0.2), (400, 0.8), (300, 0.6), (500, 0.79)]) == ((200, 0.5), (400, 0.8))


def test_quality_and_bitrate_on_a_curve():
    assert [STEEP.at(kbps) for kbps in (0, 50, 100, 200, 900)] == pytest.approx([0, 0.4, 0.8, 0.85, 0.9])
    assert [STEEP.needs(quality) for quality in (0, 0.4, 0.85, 0.95)] == pytest.approx([0, 50, 200, 300])
    assert STEEP.stretched(0.5).at(100) == pytest.approx(0.85)


def test_bits_go_where_they_buy_most():
    both = [Contender(STEEP, 1, 0, inf), Contender(FLAT, 1, 0, inf)]
    assert best_shares(both, 100) == ([100, 0], pytest.approx(0.008))
    assert best_shares(both, 150) == ([100, 50], pytest.approx(0.004))
    assert best_shares(both, 900) == ([300, 300], 0)


def test_weights_floors_and_limits():
    assert best_shares([Contender(STEEP, 1, 0, inf), Contender(FLAT, 3, 0, inf)], 100)[0] == [0, 100]
    assert best_shares([Contender(STEEP, 1, 0, 60), Contender(FLAT, 1, 20, inf)], 100)[0] == [60, 40]
    assert best_shares([Contender(STEEP, 1, 60, inf), Contender(FLAT, 1, 180, inf)], 120) == ([30, 90], inf)
    assert best_shares([Contender(STEEP, 1, 0, inf)], 0)[0] == [0]


def test_the_worst_counts_as_much_as_asked():
    both = [Contender(STEEP, 1, 0, inf), Contender(FLAT, 1, 0, inf)]
    shares = best_shares(both, 120, worst=1)[0]
    assert STEEP.at(shares[0]) == pytest.approx(FLAT.at(shares[1]), abs=0.002)
    assert best_shares(both, 120, worst=0.01)[0] == pytest.approx([100, 20], abs=0.5)


curves = st.lists(st.tuples(st.floats(1, 5000), st.floats(0.01, 1)), min_size=1, max_size=6).map(
    lambda points: Curve(*zip(*concave(points), strict=True))
)
contenders = st.lists(
    st.builds(Contender, curves, st.floats(0.1, 9), st.floats(0, 100), st.floats(100, 5000)), min_size=1
)


@given(contenders, st.floats(0, 20_000), st.sampled_from([0, 0.3, 1]))
def test_no_other_shares_are_better(some, total, worst):
    shares, _ = best_shares(some, total, worst)
    assert sum(shares) <= total * (1 + 1e-9) + 1e-6

    def worth(own):
        quality = [each.curve.at(kbps) for each, kbps in zip(some, own, strict=True)]
        mean = sum(e.weight * q for e, q in zip(some, quality, strict=True)) / sum(e.weight for e in some)
        return (1 - worst) * mean + worst * min(quality)

    if sum(each.least for each in some) > total:
        return
    for giver in range(len(some)):
        for taker in range(len(some)):
            moved = min(10, shares[giver] - some[giver].least, some[taker].most - shares[taker])
            other = [kbps + moved * ((number == taker) - (number == giver)) for number, kbps in enumerate(shares)]
            if giver != taker and moved > 0:
                assert worth(other) <= worth(shares) + (1e-9 if not worst else 2e-3)
