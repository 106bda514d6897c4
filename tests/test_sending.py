"""How late the vehicle itself sent what has arrived."""

from __future__ import annotations

import random
from dataclasses import replace
from itertools import accumulate

import pytest
from helpers import vehicle
from hypothesis import given
from hypothesis import strategies as st

from runner.core.events import LinkMeasured, LinkState
from runner.records.reception import ReceptionReport, ReceptionReported, SentFrame, UnitReceived
from runner.vehicle.sending import BUSY_S, KEPT_S, ON_ITS_WAY_S, SendingTimes
from runner.vehicle.uplink import MeasuredUplink

NOW = 1.8e9  # s since 1970
LOOK_S = 0.02


def sent(*processing_s: float, every_s: float = 0.1, begin: float = NOW) -> list[SentFrame]:
    """Frames that left so long after their capture, as seen by looking every LOOK_S, half a look after capture."""
    frames = []
    for number, took in enumerate(processing_s):
        looks = (took + LOOK_S / 2) // LOOK_S
        captured = begin + number * every_s
        unsent = captured - LOOK_S / 2 + looks * LOOK_S
        frames.append(SentFrame(captured, unsent, unsent + LOOK_S))
    return frames


def times(*frames: SentFrame) -> SendingTimes:
    known = SendingTimes()
    known.add({"front": frames})
    return known


@pytest.mark.parametrize(
    ("took", "late"),
    [(0.012, 0.0), (0.03, 0.0), (0.052, 0.02), (0.312, 0.28)],
)
def test_what_exceeds_the_usual_time_is_late(took: float, late: float) -> None:
    """Usual are at most 30 ms, the first look after the fastest frame."""
    known = times(*sent(0.012, took))
    assert known.late_s("front", NOW + 0.1) == pytest.approx(late, abs=1e-6)
    assert known.late_s("front", NOW + 0.1 + 0.0009) == pytest.approx(late, abs=1e-3)  # rounded by RTP and the report


def test_a_frame_that_was_not_seen_left_no_earlier_than_the_one_before_the_next() -> None:
    """A camera at 100 Hz sends more often than the vehicle looks."""
    known = times(*sent(0.012, 0.312))
    assert known.late_s("front", NOW + 0.05) == pytest.approx(0.33, abs=1e-6)


def test_a_machine_too_busy_to_look_sent_the_frame_at_the_end() -> None:
    frame = SentFrame(NOW + 1, NOW + 1.0, NOW + 1.0 + 2 * BUSY_S)
    known = times(*sent(0.012), frame)
    assert known.late_s("front", NOW + 1) == pytest.approx(2 * BUSY_S - 0.03, abs=1e-6)


@pytest.mark.parametrize(
    ("name", "captured"),
    [
        ("rear", NOW),  # no such camera has sent anything
        ("front", NOW + 10),  # not seen yet
        ("front", NOW - 1),  # before the first
        ("front", 812.4),  # of an arbitrary origin: the transport carries no capture time
    ],
)
def test_an_unknown_frame_is_not_late(name: str, captured: float) -> None:
    assert times(*sent(0.3, 0.3, 0.3)).late_s(name, captured) == 0


def test_old_frames_are_forgotten_and_a_usual_time_that_grows_is_learnt() -> None:
    count = int(10 * KEPT_S / 0.1)
    known = times(*sent(0.01, *[0.2] * count))
    assert known.late_s("front", NOW) == 0
    assert known.late_s("front", NOW + 0.1 * count) == 0


def test_a_clock_that_is_set_back_starts_anew() -> None:
    known = times(*sent(0.01, 0.01), *sent(0.2, 0.4, begin=NOW - 3600))
    assert known.late_s("front", NOW) == 0
    assert not known.is_all_received(NOW - 3600 + 1), "a frame from before the step proves nothing about later ones"
    assert known.late_s("front", NOW - 3600 + 0.1) == pytest.approx(0.18, abs=1e-6)
    assert known.is_all_received(NOW - 3600 + 1)


def test_a_frame_lost_by_a_camera_that_is_then_off_is_forgotten() -> None:
    known = times(*sent(0.01, 0.01))
    known.late_s("front", NOW)
    assert not known.is_all_received(NOW + 1)
    assert known.is_all_received(NOW + 1 + KEPT_S)


@given(st.lists(st.floats(0.001, 0.6), min_size=2, max_size=40), st.integers(0, 10_000))
def test_a_machine_that_looks_in_time_never_claims_too_much(took: list[float], seed: int) -> None:
    """So a queue in front of the link is never underestimated."""
    rng = random.Random(seed)
    captured = [NOW + 0.1 * number for number in range(len(took))]
    left = list(accumulate((at + each for at, each in zip(captured, took, strict=True)), max))  # in order
    looks = list(accumulate((rng.uniform(0.005, BUSY_S) for _ in range(2000)), initial=NOW - BUSY_S))
    frames = [
        SentFrame(at, max(look for look in looks if look <= gone), min(look for look in looks if look >= gone))
        for at, gone in zip(captured, left, strict=True)
    ]
    known = times(*frames)
    fastest = min(gone - at for at, gone in zip(captured, left, strict=True))
    for at, gone in zip(captured, left, strict=True):
        assert known.late_s("front", at) <= gone - at - fastest + 1e-6


def test_what_is_still_on_its_way() -> None:
    known = times(*sent(0.012, 0.012))  # the second left until NOW + 0.13
    at = NOW + 0.13 + ON_ITS_WAY_S
    assert not known.is_all_received(at + 0.01)
    known.late_s("front", NOW)
    assert not known.is_all_received(at + 0.01)
    assert known.is_all_received(at - 0.01)  # it may still be in flight
    known.late_s("front", NOW + 0.1)
    assert known.is_all_received(at + 0.01)
    known.add({"rear": sent(0.012)})
    assert not known.is_all_received(at + 0.01)
    assert not SendingTimes().is_all_received(at)  # nothing is known


ROBOT = vehicle("vehicle=delivery_robot")


def measured(delay_s: float, **known: object) -> LinkMeasured:
    """Of frames that suddenly arrive so much later, up to 0.3 s, all cameras alike."""
    uplink, link = MeasuredUplink(ROBOT), None
    for number in range(60):
        at, delay, arrive = 50 + 0.04 * number, delay_s if number >= 58 else 0.0, number < 50 or number >= 58
        units = tuple(UnitReceived(name, 0.02, delay, 4000) for name in ROBOT.cameras if arrive)
        reported = ReceptionReported(at - 49, "me", True, ReceptionReport(at, at - 49.05, units, 9, 0))
        link = uplink.take(replace(reported, **known) if number >= 58 else reported)  # type: ignore[arg-type]
    assert link
    return link


def test_what_the_vehicle_sent_late_did_not_wait_in_a_queue() -> None:
    late_s = (0.28,) * len(ROBOT.cameras)
    assert (measured(0.3).queue_ms, measured(0.3).state) == (300, LinkState.FILLING)
    assert (measured(0.3, late_s=late_s).queue_ms, measured(0.3, late_s=late_s).state) == (20, LinkState.CLEAR)


@pytest.mark.parametrize(("interval_s", "state"), [(0.04, LinkState.STALLED), (0.25, LinkState.CLEAR)])
def test_an_operator_that_is_held_up_is_no_stalled_link(interval_s: float, state: LinkState) -> None:
    """It has reported for 1.2 s, then receives nothing for 0.25 s, and reports that at once or meanwhile, too."""
    uplink, link = MeasuredUplink(ROBOT), None
    times = [
        *(50 + 0.04 * n for n in range(30)),
        *(51.16 + n * interval_s for n in range(1, round(0.25 / interval_s) + 1)),
    ]
    for at in times:
        units = tuple(UnitReceived(name, 0.02, 0.0, 4000) for name in ROBOT.cameras) if at < 51.17 else ()
        link = uplink.take(ReceptionReported(at - 49, "me", True, ReceptionReport(at, at - 49.05, units, 9, 0)))
    assert link
    assert link.state is state


@pytest.mark.parametrize(("all_received", "state"), [(True, LinkState.CLEAR), (False, LinkState.STALLED)])
def test_a_vehicle_that_sends_nothing_is_no_stalled_link(all_received: bool, state: LinkState) -> None:
    uplink, link = MeasuredUplink(ROBOT), None
    for number in range(40):
        at = 50 + 0.04 * number
        units = tuple(UnitReceived(name, 0.02, 0.0, 4000) for name in ROBOT.cameras) if number < 30 else ()
        report = ReceptionReport(at, at - 49.05, units, 9, 0)
        link = uplink.take(ReceptionReported(at - 49, "me", True, report, all_received=all_received))
    assert link
    assert link.state is state
