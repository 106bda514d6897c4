"""Eq. (1) and (2): demand in proportion to pixels, shares in proportion to demand and weight."""

from __future__ import annotations

from fractions import Fraction
from math import floor

import pytest
from hypothesis import given
from hypothesis import strategies as st

from runner.core.allocation import allocate, allocate_above_floors, demand, shed
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
def test_the_total_is_spent_and_no_camera_gets_more_than_its_demand(
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
def test_a_larger_total_reduces_no_share(
    given: dict[str, tuple[Fraction, Fraction]], total: Fraction, more: Fraction
) -> None:
    demands, weights = {n: d for n, (d, _) in given.items()}, {n: w for n, (_, w) in given.items()}
    less, greater = allocate(demands, total, weights), allocate(demands, total + more, weights)
    assert all(less[name] <= greater[name] for name in demands)


@given(st.dictionaries(st.sampled_from("abcdefgh"), bitrates), bitrates, factors.filter(bool))
def test_equal_weights_give_the_papers_allocation(
    demands: dict[str, Fraction], total: Fraction, weight: Fraction
) -> None:
    wanted = sum(demands.values())
    paper = {n: d / wanted * min(total, wanted) if wanted else Fraction(0) for n, d in demands.items()}
    assert allocate(demands, total, ONES) == allocate(demands, total, dict.fromkeys(demands, weight)) == paper


# --- floors -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "demands, total, floors, expected",
    [
        ((300, 100), 200, (0, 0), (150, 50)),  # none: Eq. (2)
        ((300, 100), 200, (0, 80), (120, 80)),
        ((300, 100), 200, (0, 40), (150, 50)),  # a floor below the share changes nothing
        ((300, 100, 100), 200, (0, 60, 41), (99, 60, 41)),  # the first floor takes from the others' shares
        ((300, 100), 90, (100, 80), (50, 40)),  # less than both: in proportion to them
        ((300, 100), 90, (0, 95), (0, 90)),
        ((300, 50), 200, (0, 80), (150, 50)),  # a floor above the demand counts as the demand
        ((0, 100), 50, (500, 0), (0, 50)),  # the floor of a camera that is off takes nothing
        ((300, 100), 400, (400, 400), (300, 100)),
    ],
)
def test_floors(demands: tuple[int, ...], total: int, floors: tuple[int, ...], expected: tuple[int, ...]) -> None:
    named = {name: Fraction(own) for name, own in zip("abc", demands, strict=False)}
    lowest = {name: Fraction(own) for name, own in zip("abc", floors, strict=False)}
    allocated = allocate_above_floors(named, Fraction(total), ONES, lowest)
    assert list(allocated.items()) == list(zip("abc", expected, strict=False))


@given(cameras, bitrates, st.dictionaries(st.sampled_from("abcdefgh"), bitrates))
def test_floors_come_first_and_the_total_holds(
    of: dict[str, tuple[Fraction, Fraction]], total: Fraction, some: dict[str, Fraction]
) -> None:
    demands, weights = {name: own for name, (own, _) in of.items()}, {name: weight for name, (_, weight) in of.items()}
    floors = {name: some.get(name, Fraction(0)) for name in demands}
    allocated = allocate_above_floors(demands, total, weights, floors)
    assert sum(allocated.values()) <= total
    assert all(0 <= allocated[name] <= own for name, own in demands.items())
    lowest = {name: min(floors[name], own) for name, own in demands.items()}
    if sum(lowest.values()) <= total:
        assert all(allocated[name] >= low for name, low in lowest.items())
    if not any(lowest.values()):
        assert allocated == allocate(demands, total, weights)


@pytest.mark.parametrize(
    "total, before, expected",
    [
        (300, (), ()),
        (299, (), ("a",)),
        (300, ("a",), ("a",)),  # it returns with a margin
        (330, ("a",), ()),
        (199, (), ("a", "b")),
        (99, (), ("a", "b")),  # c is never given up
        (219, ("a", "b"), ("a", "b")),
        (220, ("a", "b"), ("a",)),
    ],
)
def test_cameras_given_up(total: int, before: tuple[str, ...], expected: tuple[str, ...]) -> None:
    demands, floors = dict.fromkeys("abc", Fraction(1000)), dict.fromkeys("abc", Fraction(100))
    assert shed(demands, Fraction(total), floors, ("a", "b"), before) == expected


def test_a_camera_that_is_off_is_not_given_up() -> None:
    demands = {"a": Fraction(0), "b": Fraction(100), "c": Fraction(100)}
    assert shed(demands, Fraction(10), dict.fromkeys("abc", Fraction(50)), ("a", "b")) == ("b",)
