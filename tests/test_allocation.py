"""Eq. (1) and (2): demand in proportion to pixels, shares in proportion to demand and weight."""

from __future__ import annotations

from fractions import Fraction
from math import floor

import pytest
from hypothesis import given
from hypothesis import strategies as st

from runner.core.allocation import allocate, demand
from runner.core.model import Roi

FULL = Roi(0, 0, 1920, 1040)
ONES = {name: Fraction(1) for name in "abcdefgh"}

bitrates = st.fractions(0, 10_000, max_denominator=1000)
factors = st.fractions(0, 10, max_denominator=100)
cameras = st.dictionaries(st.sampled_from("abcdefgh"), st.tuples(bitrates | st.just(Fraction(0)), factors))


@pytest.mark.parametrize(
    "roi, expected",
    [
        (FULL, 6000),
        (Roi(0, 0, 960, 1040), 3000),
        (Roi(960, 0, 960, 520), 1500),
        (Roi(5, 7, 16, 16), Fraction(16 * 16 * 6000, 1920 * 1040)),
    ],
)
def test_demand(roi: Roi, expected: Fraction) -> None:
    assert demand(Fraction(6000), roi, FULL) == expected


@pytest.mark.parametrize(
    "demands, total, weights, expected",
    [
        ((300, 100), 200, (1, 1), (150, 50)),
        ((300, 100), 400, (1, 1), (300, 100)),
        ((300, 100), 1000, (1, 1), (300, 100)),  # the surplus stays unused
        ((300, 100), 0, (1, 1), (0, 0)),
        ((0, 100), 50, (1, 1), (0, 50)),  # a camera that is off
        ((0, 0), 500, (1, 1), (0, 0)),  # all of them
        ((100, 100), 100, (3, 1), (75, 25)),
        ((100, 100), 180, (3, 1), (100, 80)),  # capped at demand, the other gets the rest
        ((100, 100), 180, (0, 1), (0, 100)),  # nothing for a weight of 0, even of a surplus
        ((100, 100), 50, (0, 0), (0, 0)),
        ((100, 200, 300), 500, (4, 2, 1), (100, 200, 200)),
        ((100, 100), Fraction("0.5"), (1, 1), (Fraction(1, 4), Fraction(1, 4))),
    ],
)
def test_allocate(
    demands: tuple[int, ...], total: Fraction, weights: tuple[int, ...], expected: tuple[Fraction, ...]
) -> None:
    named = {name: Fraction(own) for name, own in zip("abc", demands, strict=False)}
    allocated = allocate(named, Fraction(total), dict(zip("abc", map(Fraction, weights), strict=False)))
    assert list(allocated.items()) == list(zip("abc", expected, strict=False))


@given(cameras, bitrates)
def test_it_spends_what_it_may_and_gives_nobody_more_than_the_demand(
    given: dict[str, tuple[Fraction, Fraction]], total: Fraction
) -> None:
    demands, weights = {n: d for n, (d, _) in given.items()}, {n: w for n, (_, w) in given.items()}
    allocated = allocate(demands, total, weights)
    assert list(allocated) == list(demands)
    assert sum(allocated.values()) == min(total, sum(d for d, w in given.values() if w > 0))
    assert all(0 <= allocated[name] <= demands[name] for name in demands)
    assert all(allocated[name] == 0 for name in demands if weights[name] == 0)
    assert sum(map(floor, allocated.values())) <= total
    # One lambda for all: a camera below its demand gets lambda * w * d, one at its demand would get more.
    shares = {n: b / (weights[n] * demands[n]) for n, b in allocated.items() if 0 < b < demands[n]}
    assert len(set(shares.values())) <= 1
    for share in shares.values():
        assert all(share * weights[n] >= 1 for n, b in allocated.items() if 0 < b == demands[n])


@given(cameras, bitrates, st.randoms())
def test_the_order_of_cameras_does_not_matter(
    given: dict[str, tuple[Fraction, Fraction]], total: Fraction, random: st.random.Random
) -> None:
    demands, weights = {n: d for n, (d, _) in given.items()}, {n: w for n, (_, w) in given.items()}
    shuffled = dict(random.sample(list(demands.items()), len(demands)))
    assert allocate(shuffled, total, weights) == allocate(demands, total, weights)


@given(cameras, bitrates, bitrates)
def test_more_for_all_is_less_for_nobody(
    given: dict[str, tuple[Fraction, Fraction]], total: Fraction, more: Fraction
) -> None:
    demands, weights = {n: d for n, (d, _) in given.items()}, {n: w for n, (_, w) in given.items()}
    less, greater = allocate(demands, total, weights), allocate(demands, total + more, weights)
    assert all(less[name] <= greater[name] for name in demands)


@given(st.dictionaries(st.sampled_from("abcdefgh"), bitrates), bitrates, factors.filter(bool))
def test_weights_that_are_all_the_same_are_the_paper(
    demands: dict[str, Fraction], total: Fraction, weight: Fraction
) -> None:
    wanted = sum(demands.values())
    paper = {n: d / wanted * min(total, wanted) if wanted else Fraction(0) for n, d in demands.items()}
    assert allocate(demands, total, ONES) == allocate(demands, total, dict.fromkeys(demands, weight)) == paper
