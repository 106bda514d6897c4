"""The difference of two clocks: always within its bound, whatever the delays, and never below 0 in a latency."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator
from itertools import count

import pytest
from hypothesis import given
from hypothesis import strategies as st

from runner.operator.latency import corrected
from runner.system.clocks import KEPT_S, ClockComparison, ClockDifference, Exchange

EVERY_S = 0.2
SLACK_S = 1e-4  # more than the clocks may drift apart during an exchange of 0.1 s
Delays = Callable[[], tuple[float, float]]  # s, there and back


def compared(
    seconds: float, delays: Delays, ahead: Callable[[float], float]
) -> Iterator[tuple[float, ClockDifference, float]]:
    """At each exchange of a simulated link: time, the estimated difference, and the true one, s."""
    clocks = ClockComparison()
    for number in count():
        t = number * EVERY_S
        if t > seconds:
            return
        there, back = delays()
        received, returned = t + there, t + there + back
        clocks.add(returned, Exchange(t, received + ahead(received), received + ahead(received), returned))
        known = clocks.difference(returned)
        assert known
        yield returned, known, ahead(returned)


def mobile(seed: int) -> Delays:
    """30 ms and more in one direction, 20 ms and more in the other."""
    chance = random.Random(seed)
    return lambda: (0.03 + chance.expovariate(100), 0.02 + chance.expovariate(100))


def test_one_exchange_bounds_the_difference_by_half_its_round_trip() -> None:
    clocks = ClockComparison()
    assert clocks.difference(5.0) is None
    clocks.add(5.0, Exchange(sent=100.0, received=103.75, answered=103.8125, returned=100.125))
    assert clocks.difference(5.0) == pytest.approx(ClockDifference(3.71875, 0.03125), abs=SLACK_S)


@pytest.mark.parametrize(("there", "back"), [(0.08, 0.0), (0.0, 0.08), (0.05, 0.03)])
def test_a_delay_in_one_direction_is_within_the_bound(there: float, back: float) -> None:
    for _, known, truth in compared(5, lambda: (there, back), lambda t: 3.7):
        assert abs(known.ahead_s - truth) <= known.bound_s + 1e-9
        assert known.bound_s <= 0.0401


@pytest.mark.slow  # an hour of exchanges
@pytest.mark.parametrize("ppm", [50, -50])
def test_a_skew_of_50_ppm_moves_the_difference_by_less_than_1_ms_from_the_truth(ppm: float) -> None:
    """Over an hour, in which the clocks drift apart by 180 ms; both directions are 20 ms and 2 ms of jitter."""
    chance = random.Random(1)
    delays = lambda: (0.02 + chance.expovariate(500), 0.02 + chance.expovariate(500))  # noqa: E731
    found = list(compared(3600, delays, lambda t: 1.5 + ppm * 1e-6 * t))
    settled = [(known, truth) for t, known, truth in found if t > 10]
    assert all(abs(known.ahead_s - truth) <= known.bound_s for known, truth in settled)
    assert max(abs(known.ahead_s - truth) for known, truth in settled) < 0.001


def test_a_set_clock_is_followed_at_the_next_exchange() -> None:
    found = list(compared(20, mobile(3), lambda t: 0.0 if t < 10 else -3600.0))
    assert all(abs(known.ahead_s - truth) <= known.bound_s for _, known, truth in found)


def test_a_reported_step_smaller_than_the_round_trip_is_followed() -> None:
    clocks = ClockComparison()
    for number in range(100):
        t, ahead = number * EVERY_S, 0.0 if number < 50 else 0.058
        clocks.add(t + 0.06, Exchange(t, t + 0.03 + ahead, t + 0.03 + ahead, t + 0.06, (7.0, 9.0 + ahead)))
        known = clocks.difference(t + 0.06)
        if number != 50:  # then the difference is unknown
            assert known
            assert abs(known.ahead_s - ahead) <= known.bound_s
    assert known
    assert known.ahead_s == pytest.approx(0.058, abs=0.001)


def test_a_slewed_clock_stays_within_the_bound() -> None:
    found = list(compared(60, mobile(4), lambda t: 500e-6 * max(0.0, min(t, 40.0) - 20.0)))
    assert all(abs(known.ahead_s - truth) <= known.bound_s for _, known, truth in found)


def test_without_an_exchange_for_10_s_the_difference_is_unknown() -> None:
    clocks = ClockComparison()
    clocks.add(0.0, Exchange(0.0, 0.01, 0.01, 0.02))
    assert clocks.difference(KEPT_S)
    assert clocks.difference(KEPT_S + 0.1) is None
    clocks.add(20.0, Exchange(20.0, 20.01, 20.01, 20.02))
    assert clocks.difference(20.0) == pytest.approx(ClockDifference(0.0, 0.01), abs=SLACK_S)


@pytest.mark.parametrize(
    ("errors_s", "bound_s"),
    [
        (None, 0.04),  # one of the kernels is not synchronised
        (0.5, 0.04),  # a worse bound than that of the messages
        (0.002, 0.001),  # and the messages bound it from below: none arrives before it was sent
    ],
)
def test_synchronised_kernels_bound_the_difference_too(errors_s: float | None, bound_s: float) -> None:
    clocks = ClockComparison()
    clocks.add(0.0, Exchange(10.0, 10.08, 10.08, 10.08, errors_s=errors_s))  # 80 ms there, none back
    known = clocks.difference(0.0)
    assert known
    assert known.bound_s == pytest.approx(bound_s, abs=SLACK_S)
    assert abs(known.ahead_s) <= known.bound_s + 1e-9


def test_kernels_that_contradict_the_messages_are_not_trusted() -> None:
    clocks = ClockComparison()
    clocks.add(0.0, Exchange(10.0, 13.71, 13.71, 10.02, errors_s=0.001))
    known = clocks.difference(0.0)
    assert known
    assert known.ahead_s == pytest.approx(3.7)


@pytest.mark.parametrize(("answered", "returned"), [(100.03, 99.0), (5000.0, 100.06)])
def test_an_answer_sent_after_its_arrival_is_refused(answered: float, returned: float) -> None:
    """This machine's clock was set back in the meantime, or the other states a wrong time."""
    clocks = ClockComparison()
    with pytest.raises(ValueError, match="answered after the answer arrived"):
        clocks.add(0.0, Exchange(100.0, 100.03, answered, returned))
    assert clocks.difference(0.0) is None


def test_an_answer_sent_before_its_request_is_refused() -> None:
    with pytest.raises(ValueError, match=r"^answered 0\.5 s before it was received$"):
        ClockComparison().add(0.0, Exchange(0.0, 1.0, 0.5, 2.0))


@given(
    ahead=st.floats(-1e6, 1e6),
    delays=st.lists(st.tuples(st.floats(0, 2), st.floats(0, 2)), min_size=1, max_size=60),
    ppm=st.floats(-400, 400),
)
def test_the_truth_is_within_the_bound_whatever_the_delays(
    ahead: float, delays: list[tuple[float, float]], ppm: float
) -> None:
    each = iter(delays)
    found = compared(EVERY_S * (len(delays) - 1), lambda: next(each), lambda t: ahead + ppm * 1e-6 * t)
    for _, known, truth in found:
        assert abs(known.ahead_s - truth) <= known.bound_s + 1e-6


def test_a_latency_is_known_if_both_clocks_are() -> None:
    clock = ClockDifference(ahead_s=3.7, bound_s=0.001)
    assert corrected(-3652.0, clock) == pytest.approx(48)
    assert corrected(-3652.0, None) is None
    assert corrected(None, clock) is None
    assert corrected(-3701.0, clock) == 0  # within the bound of 0, and never below
