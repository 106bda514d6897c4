"""The uplink's estimate and the cap that follows from it, in a closed loop with a simulated link."""

from __future__ import annotations

import csv
import random
from bisect import bisect_right
from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction
from itertools import pairwise
from operator import attrgetter
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from shared_data import shared
from simulated_link import Link, ShortFlows, busy, drive, jitter, stalls, steps, utilisation
from soak import reports

from runner.core.events import LinkMeasured, PositionReported
from runner.core.link_cap import follow, start_cap, update_cap
from runner.core.link_memory import LEAST, UNCAPPED, LastLimit, LinkCap, Most, Overuse
from runner.core.trust import (
    KNOWN_S,
    METRES_PER_DEGREE,
    REMEMBERED_S,
    DoubtedPlace,
    Trust,
    add_doubt,
    is_near,
    update_trust,
)
from runner.core.uplink import LinkReport, LinkState, ReceivedUnit, UplinkMemory, estimate

pytestmark = pytest.mark.slow  # simulates drives

RIGHT, HIGH = 3600.0, 6000.0  # kbit/s predicted over a link of 4000
HALF = Fraction(1, 2)


def test_a_correct_prediction_is_used_fully() -> None:
    link, limit = Link(steps((0, 4000))), steps((0, RIGHT))
    done = drive(link, limit, 30)
    assert {cap for _, cap, _ in done.caps} == {RIGHT}
    assert utilisation(done, link, limit, 1, 29) == pytest.approx(1, abs=0.02)


def test_a_prediction_that_is_too_high_fills_no_queue() -> None:
    link, limit = Link(steps((0, 4000))), steps((0, HIGH))
    done = drive(link, limit, 60)
    assert done.wait_ms(0.95, since=2) <= 100
    assert utilisation(done, link, limit, 2, 59) >= 0.9


@pytest.mark.parametrize("fps", [15, 30])
def test_a_queue_that_was_full_before_the_first_picture_is_seen_by_its_losses(fps: float) -> None:
    """As if all cameras start with a key frame: its delay is mistaken for the path's."""
    link = Link(steps((0, 2300)), queue_s=0.2)
    done = drive(link, steps((0, 3100)), 20, fps=fps, queued_s=0.2)
    assert done.wait_ms(0.95, since=4) <= 100
    assert done.kbps(4, 20) >= 0.85 * 2300


@pytest.mark.parametrize("fps", [7, 10])
def test_a_link_with_a_short_queue_is_seen_by_its_losses_even_with_few_packets(fps: float) -> None:
    """Less than a hundred packets a second, of which the link drops a third rather than delay them."""
    done = drive(Link(steps((0, 250)), queue_s=0.05, loss=0.005), steps((0, 400)), 20, fps=fps)
    assert done.first(0, lambda cap: cap <= 250) < 5


@pytest.mark.parametrize("received", [20, 60, 300])
def test_losses_are_counted_for_up_to_two_seconds(received: int) -> None:
    """Packets a second, a quarter of which is lost."""
    uplink, last = UplinkMemory(), None
    for number in range(1, 61):
        unit = ReceivedUnit("front", number / 20, number / 20 + 0.03, 1000)
        uplink, last = estimate(uplink, LinkReport(number / 20, (unit,), received // 20, received // 60))
    assert last
    assert last.loss == pytest.approx(0.25 if received > 20 else 0.0, abs=0.01)


@pytest.mark.parametrize("fps", [15, 30])
def test_a_start_at_half_of_a_prediction_that_is_too_high_loses_less(fps: float) -> None:
    link, limit = Link(steps((0, 4000)), queue_s=0.2), steps((0, HIGH))
    whole, half = (drive(link, limit, 10, fps=fps, start=share, key_frame=6) for share in (Fraction(1), HALF))
    assert len(half.lost) < 0.2 * len(whole.lost)


@pytest.mark.parametrize("fps", [5, 15, 30])
def test_a_start_at_half_of_a_right_prediction_is_over_soon(fps: float) -> None:
    done = drive(Link(steps((0, 4000))), steps((0, RIGHT)), 10, fps=fps, start=HALF, key_frame=6)
    assert done.caps[0][1] == RIGHT / 2
    assert done.lowest(1 + 10 / fps, 10) == RIGHT


def test_a_camera_that_starts_slowly_hides_no_queue() -> None:
    """The first pictures are 220 ms late; other cameras then show that the path is shorter."""
    uplink, shown = UplinkMemory(), []
    for number in range(40):
        captured = number / 15
        late = {"front": 0.22 if captured < 0.2 else 0.0, "rear": 0.22 if captured < 1.0 else 0.0}
        queue = 0.0 if captured < 1.1 else 0.1
        rear = [("rear", late["rear"])] if captured < 1.0 or captured >= 1.3 else []
        units = tuple(
            ReceivedUnit(name, captured, captured + 0.02 + extra + queue, 4000)
            for name, extra in (("front", late["front"]), *rear)
        )
        uplink, estimated = estimate(uplink, LinkReport(captured + 0.25, units, 10, 0))
        shown.append(estimated.queue_ms if estimated else 0.0)
    assert min(shown[19:25]) > 90


@pytest.mark.parametrize("origin", [0, 9000])
@pytest.mark.parametrize("fps", [2, 3, 5, 8])
def test_a_slow_camera_that_is_left_alone_is_no_stall(fps: int, origin: float) -> None:
    """Two fast cameras are switched off after 4 s; reports go on, 25 a second.

    origin  of the fast ones' capture times: without such times each camera has one of its own
    """
    frames = [("slow", n / fps, 0.0) for n in range(8 * fps)]
    frames += [(name, n / 30, origin) for name in ("front", "rear") for n in range(4 * 30)]
    units = sorted((ReceivedUnit(name, t + o, t + 0.02, 4000) for name, t, o in frames), key=attrgetter("arrived"))
    uplink, states = UplinkMemory(), []
    for number in range(1, 8 * 25):
        at = number / 25
        uplink, estimated = estimate(uplink, LinkReport(at, tuple(u for u in units if at - 0.04 < u.arrived <= at), 1))
        states += [(at, estimated.state, estimated.kbps)] if estimated else []
    stalled = [at for at, state, _ in states if state is LinkState.STALLED]
    assert all(4 < at < 4.1 + 1 / fps for at in stalled)
    assert all(kbps for at, _, kbps in states if at > 4.5 + 3 / fps)


def test_a_camera_with_a_clock_of_its_own_meets_no_queue_at_the_start() -> None:
    uplink, queues = UplinkMemory(), []
    for n in range(60):
        cameras = ("rear", -8000.0), *([("front", 0.0)] if n % 6 == 0 else [])
        units = tuple(ReceivedUnit(name, n / 30 + origin, n / 30 + 0.02, 4000) for name, origin in reversed(cameras))
        uplink, estimated = estimate(uplink, LinkReport(n / 30 + 0.03, units, 4))
        queues += [estimated.queue_ms] if estimated else []
    assert max(queues) < 0.001


def test_while_nothing_is_sent_nothing_arrives() -> None:
    """The last measured rate is not repeated."""
    uplink, shown = UplinkMemory(), []
    for n in range(150):
        t = n / 15
        units = (ReceivedUnit("front", t, t + 0.02, 4000),) if n < 60 else ()
        uplink, estimated = estimate(uplink, LinkReport(t + 0.03, units, 4 * min(n, 60), all_received=not units))
        shown += [(estimated.kbps, estimated.state)] if estimated else []
    assert set(shown[-85:]) == {(0.0, LinkState.CLEAR)}


@pytest.mark.parametrize(
    "cap",
    [
        LinkCap(
            kbps=Fraction(1000), changed=0, measured=0, began=0, overuse=Overuse(0, Fraction(1600), Fraction(6000))
        ),
        LinkCap(
            kbps=Fraction(1500), changed=0, measured=0, began=0, overuse=Overuse(0, Fraction(1600), Fraction(6000))
        ),
        LinkCap(kbps=Fraction(3000), changed=0, measured=0, began=0, provisional=True),
    ],
)
def test_the_cap_does_not_grow_while_nothing_is_sent(cap: LinkCap) -> None:
    before = cap.kbps
    for t in range(1, 100):
        link = LinkMeasured(t=t / 10, kbps=Fraction(0), queue_ms=0, loss=0, state=LinkState.CLEAR, rtt_ms=30)
        cap = update_cap(cap, link, t / 10, Fraction(6000))
    assert cap.kbps == before


@pytest.mark.parametrize(("silent_s", "queue_ms"), [(60, 200), (3600, 0)])
def test_path_delays_expire_while_nothing_arrives(silent_s: float, queue_ms: float) -> None:
    """Clocks drift apart: after an hour, 200 ms more is no queue."""
    uplink = UplinkMemory()
    for n in range(61):
        t, drift = (n / 15, 0.0) if n < 60 else (4 + silent_s, 0.2)
        units = (ReceivedUnit("front", t, t + 0.02 + drift, 4000),)
        uplink, estimated = estimate(uplink, LinkReport(t + 0.03 + drift, units, 4 * n))
    assert estimated
    assert estimated.queue_ms == pytest.approx(queue_ms)


def test_the_rest_of_a_frame_in_a_later_report_is_no_clock_step() -> None:
    """With rounded times it seems older than its first part."""
    uplink = UplinkMemory()
    for number in range(30):
        captured, queue = number / 15, 0.0 if number < 20 else 0.1
        part = ReceivedUnit("front", captured, captured + 0.02 + queue, 4000, whole=False)
        rest = replace(part, captured=captured - 0.0001, arrived=part.arrived + 0.012, whole=True)
        for at, unit in ((0.01, part), (0.02, rest)):
            uplink, estimated = estimate(uplink, LinkReport(unit.arrived + at, (unit,), 4, 0))
    assert estimated
    assert estimated.queue_ms > 80
    assert uplink.intervals == {"front": pytest.approx(1 / 15, abs=0.001)}


def test_a_link_that_halves_causes_an_immediate_cut() -> None:
    done = drive(Link(steps((0, 4000), (5, 2000))), steps((0, RIGHT)), 10)
    assert done.first(5, lambda cap: cap <= 2000) <= 0.03 + 0.25
    assert done.wait_ms(0.99, since=6) <= 100


@pytest.mark.parametrize("seed", range(3))
def test_a_play_out_delay_that_hides_a_short_queue_delays_the_cut_little(seed: int) -> None:
    """As with SRT: by the time frames are late, the queue is 60 ms long, and they arrive at the new rate."""
    at = 5 + 0.009 * seed
    link = Link(steps((0, 4400), (at, 2200)), one_way_s=0.02, playout_s=0.06)
    done = drive(link, steps((0, 4000)), 10, cameras=3, fps=40, seed=seed, noise=0.1)
    assert done.first(at, lambda cap: cap <= 2200) <= 0.04 + 0.25  # 0.37 if the delay is ignored
    assert done.wait_ms(0.99, since=at + 1) <= 150


@pytest.mark.parametrize("seed", range(3))
def test_jitter_somewhat_beyond_a_play_out_delay_reduces_the_rate_little(seed: int) -> None:
    link = Link(steps((0, 4400)), jitter(0.5, 0.1, 80, seed=seed), one_way_s=0.02, playout_s=0.06)
    assert drive(link, steps((0, 4000)), 30, cameras=3, fps=40, seed=seed, noise=0.1).kbps(2, 30) >= 0.8 * 4000


@pytest.mark.parametrize("seconds", [0.1, 0.15, 0.2, 0.25])
@pytest.mark.parametrize("begin", [5.0, 5.013, 5.021, 5.03])
def test_a_stall_cuts_once_and_is_over_within_a_second(begin: float, seconds: float) -> None:
    end = begin + seconds
    done = drive(Link(steps((0, 4000)), stalls((begin, end))), steps((0, RIGHT)), 8)
    assert done.lowest(begin, 8) >= 0.6 * 0.97 * RIGHT
    assert done.cuts(begin - 0.5, 8) <= 1
    assert done.first(end, lambda cap: cap >= 0.9 * RIGHT) <= 1
    assert done.lowest(end + 1, 8) >= 0.9 * RIGHT


@pytest.mark.parametrize("limit", [RIGHT, HIGH])
def test_after_an_outage_the_link_is_used_again(limit: float) -> None:
    done = drive(Link(steps((0, 4000), (5, 0), (8, 4000))), steps((0, limit)), 14)
    assert done.kbps(9, 10) > 0.3 * RIGHT
    assert done.kbps(11, 14) > 0.85 * RIGHT
    assert done.wait_ms(0.95, since=9) <= 100


def test_random_loss_does_not_cut() -> None:
    done = drive(Link(steps((0, 4000)), loss=0.03), steps((0, RIGHT)), 20)
    assert done.lowest(1, 20) == RIGHT


def test_a_longer_path_is_not_mistaken_for_a_queue() -> None:
    """A handover adds 60 ms permanently."""
    done = drive(Link(steps((0, 4000)), lambda t: 0.06 if t >= 5 else 0.0), steps((0, RIGHT)), 15)
    assert done.lowest(5, 15) >= 0.4 * RIGHT
    assert done.lowest(9, 15) >= 0.9 * RIGHT


@pytest.mark.parametrize("limit", [RIGHT, HIGH])
@pytest.mark.parametrize("fps", [15, 30])
def test_jitter_does_not_reduce_the_rate(limit: float, fps: float) -> None:
    """Twice a second 0.1 s in which everything is late by some 15 ms, as on many radio links and busy machines."""
    link, total = Link(steps((0, 4000)), jitter(0.5, 0.1, 15)), steps((0, limit))
    done = drive(link, total, 40, fps=fps)
    assert utilisation(done, link, total, 5, 39) >= 0.85
    assert done.lowest(5, 39) >= 0.4 * RIGHT


@pytest.mark.parametrize("trace", ["urban_n8_v30", "arterial_n78_v50"])
@pytest.mark.parametrize("limit", [RIGHT, HIGH])
def test_the_jitter_of_a_recorded_5g_link_does_not_reduce_the_rate(limit: float, trace: str) -> None:
    with shared(f"traces/tidy/cicv5g_{trace}_rtt.csv").open() as file:
        rows = [(float(row["t_s"]), float(row["rtt_ms"]) / 1000) for row in csv.DictReader(file)]
    times, least = [t - rows[0][0] for t, _ in rows], min(rtt for _, rtt in rows)
    link = Link(steps((0, 4000)), lambda t: rows[bisect_right(times, t) - 1][1] - least)
    done = drive(link, steps((0, limit)), 60, fps=15)
    assert utilisation(done, link, steps((0, limit)), 5, 59) >= 0.85


@pytest.mark.parametrize("limit", [RIGHT, HIGH])
@pytest.mark.parametrize(("share", "ms", "least"), [(0.5, 60, 0.8), (0.5, 120, 0.3)])
def test_frames_that_a_busy_machine_sends_late_do_not_starve_the_video(
    share: float, ms: float, least: float, limit: float
) -> None:
    """Each is late independently; a queue would delay all following ones. This once left 2 % of the link."""
    link, total = Link(steps((0, 4000))), steps((0, limit))
    done = drive(link, total, 30, cameras=3, fps=15, late=busy(share, 0.5, ms))
    assert utilisation(done, link, total, 5, 29) >= least


def pauses(seconds: float, long_s: float) -> Callable[[int, float], float]:
    """Every second a machine stands still for so long, and then sends all frames of that time."""
    until = stalls(*((float(begin), begin + long_s) for begin in range(2, int(seconds))))
    return lambda _camera, t: until(t)


@pytest.mark.parametrize("long_s", [0.25, 0.45])
def test_pauses_that_a_vehicle_knows_of_cut_nothing(long_s: float) -> None:
    link, limit = Link(steps((0, 50_000))), steps((0, RIGHT))  # wide: afterwards no queue remains
    watched, unwatched = (drive(link, limit, 20, late=pauses(20, long_s), watched=each) for each in (True, False))
    assert watched.cuts(1, 20) == 0
    assert unwatched.cuts(1, 20) > 10


@pytest.mark.parametrize("ms", [60, 120])
def test_a_vehicle_that_knows_its_own_delays_still_sees_the_link_fall(ms: float) -> None:
    link, limit = Link(steps((0, 4000), (10, 2000))), steps((0, RIGHT))
    watched, unwatched = (
        drive(link, limit, 20, cameras=3, fps=15, late=busy(0.5, 0.5, ms), watched=each) for each in (True, False)
    )
    assert watched.lowest(10, 10.5) <= 2000
    assert watched.wait_ms(0.95, 11) <= 100
    assert watched.kbps(11, 19) >= unwatched.kbps(11, 19)


@pytest.mark.parametrize("fps", [5, 10, 15, 40])
def test_any_frame_rate(fps: float) -> None:
    link, limit = Link(steps((0, 4000), (10, 2000), (20, 4000))), steps((0, HIGH))
    done = drive(link, limit, 30, fps=fps)
    assert utilisation(done, link, limit, 2, 29) >= 0.8
    assert done.first(10, lambda cap: cap <= 2000) <= 0.03 + 0.25 + 2 / fps


def test_case_5_1_of_rfc_8867_without_a_prediction() -> None:
    """Rates times two."""
    link, limit = Link(steps((0, 2000), (40, 5000), (60, 1200), (80, 2000))), steps((0, HIGH))
    done = drive(link, limit, 100)
    assert utilisation(done, link, limit, 1, 99) >= 0.8
    assert done.wait_ms(0.95) <= 100


@pytest.mark.parametrize("kbps", [300, 600, 1000, 1200, 1250, 1300])
def test_a_large_drop_of_the_link_is_not_mistaken_for_competing_traffic(kbps: float) -> None:
    done = drive(Link(steps((0, 5000), (20, kbps)), one_way_s=0.05), steps((0, HIGH)), 60, fps=15)
    assert done.wait_ms(0.95, since=20) <= 100
    assert done.kbps(25, 60) >= 0.9 * kbps


@pytest.mark.parametrize(
    ("falls", "limit"),
    [
        (((0, 6000), (15, 3300), (25, 1815), (35, 998)), 6000),
        (((0, 9000), (15, 5400), (22, 3240), (29, 1944), (36, 1166)), HIGH),
        (((0, 6000), (15, 4200), (22, 2940), (29, 2058), (36, 1440)), 6000),
    ],
)
def test_each_fall_of_a_link_that_falls_in_steps_is_followed(
    falls: tuple[tuple[float, float], ...], limit: float
) -> None:
    """Also to a third of the highest recent rate, below which the cameras yield to no other traffic at first."""
    done = drive(Link(steps(*falls), one_way_s=0.03), steps((0, limit)), 50, fps=15)
    for since, until in pairwise((*(t for t, _ in falls[1:]), 50)):
        waits = [wait for t, wait in done.waits if since <= t < until]
        long_s = (until - since) * sum(wait > 0.1 for wait in waits) / len(waits)
        assert long_s <= 3, since
    assert done.kbps(40, 50) >= 0.9 * falls[-1][1]


def test_after_a_stall_the_rate_is_restored_only_up_to_the_new_capacity() -> None:
    """As in another cell: half of the earlier rate would fill the queue again."""
    link = Link(steps((0, 8000), (20, 800)), delay_s=stalls((20, 22.4)), one_way_s=0.02, queue_s=0.5)
    done = drive(link, steps((0, 8000)), 34, fps=15)
    assert max(cap for t, cap, _ in done.caps if t > 23) <= 1200
    assert done.kbps(24, 34) >= 0.9 * 800


def test_a_prediction_that_falls_and_is_still_too_high_fills_no_queue() -> None:
    link = Link(steps((0, 6000), (20, 1190)), one_way_s=0.05)
    done = drive(link, steps((0, 6000), (20, 1400)), 60, fps=15)
    assert done.wait_ms(0.95, since=22) <= 100


@pytest.mark.parametrize(("queue_ms", "since", "narrow"), [(25, 9.9, False), (60, 8.0, True)])
def test_encoders_that_use_less_than_the_cap_do_not_prove_the_link_narrow(
    queue_ms: float, since: float, narrow: bool
) -> None:
    """The cameras would yield all of it to competing traffic, step by step; a long queue of their own is proof."""
    before = LinkCap(kbps=Fraction(650), most=Most(Fraction(2000), 10), changed=8, measured=10, short=since)
    link = LinkMeasured(t=10.04, kbps=Fraction(480), queue_ms=queue_ms, loss=0.0, state=LinkState.FILLING, rtt_ms=100)
    after = update_cap(before, link, 10.04, Fraction(4000))
    assert after.kbps is not None
    assert (after.kbps < 650) == narrow


@pytest.mark.parametrize("fps", [15, 40])
def test_cameras_and_a_tcp_flow_share_the_link(fps: float) -> None:
    """Case 5.6 of RFC 8867, rates times two: a quarter of the fair share at least. TCP itself fills the queue."""
    link, limit = Link(steps((0, 4000)), one_way_s=0.05), steps((0, 4000))
    done = drive(link, limit, 80, fps=fps, tcp_s=(5, 60))
    assert done.kbps(15, 60) >= 500
    assert sum(size for t, size in done.tcp if 15 <= t < 60) * 8 / 1000 / 45 >= 500
    assert done.kbps(70, 80) >= 3000
    assert done.wait_ms(0.95, since=65) <= 100


def test_cameras_without_predictions_hold_their_share_against_short_flows() -> None:
    """Case 5.7 of RFC 8867, rates times two: flows that start look like a link that has become narrow."""
    link, limit = Link(steps((0, 4000)), one_way_s=0.05), steps((0, 4000))
    done = drive(link, limit, 60, fps=15, tcp_s=(5, 60), flows=ShortFlows, filled=0.9, predicted=False)
    assert done.kbps(15, 60) >= 500
    assert done.lowest(15, 60) >= 300
    assert sum(size for t, size in done.tcp if 15 <= t < 60) * 8 / 1000 / 45 >= 1500


def test_competing_flows_take_no_camera_below_its_floor() -> None:
    link, limit = Link(steps((0, 4000)), one_way_s=0.05, queue_s=0.1), steps((0, 4000))
    others: dict[str, Any] = {"fps": 15, "tcp_s": (5, 60), "flows": ShortFlows, "filled": 0.9, "predicted": False}
    lowest = {
        floors: min(drive(link, limit, 60, floors=floors, seed=seed, **others).lowest(10, 60) for seed in range(1, 6))
        for floors in (0, 500)
    }
    assert lowest[0] < 200
    assert lowest[500] == 500


@pytest.mark.parametrize("seed", range(3))
def test_a_first_overuse_does_not_make_a_prediction_late(seed: int) -> None:
    """As over a recorded LTE uplink: soon after a prediction 50 % too high filled the link, both fall."""
    link = Link(steps((0, 7200), (1.8, 8800), (2.8, 6000), (3.8, 8800)))
    limit = steps((0, 9900), (1.8, 12000), (2.8, 8250), (3.8, 12000))
    done = drive(link, limit, 6, cameras=8, fps=10, seed=seed, start=HALF, key_frame=3)
    assert done.first(2.8, lambda cap: cap < 6000) <= 0.1
    assert done.wait_ms(0.99, since=2.8) <= 170


@pytest.mark.parametrize("queue_s", [0.3, 0.03])
@pytest.mark.parametrize("kbps", [60, 150, 220])
def test_a_link_too_narrow_for_the_floors_gets_less(kbps: float, queue_s: float) -> None:
    """A short queue drops packets until less is sent."""
    link = Link(steps((0, 4000), (10, kbps), (30, 4000)), one_way_s=0.05, queue_s=queue_s)
    done = drive(link, steps((0, 4000)), 45, fps=15, floors=300)
    assert done.first(10, lambda cap: cap < kbps) < 3.5
    assert done.wait_ms(0.95, since=14) <= 100
    assert done.kbps(41, 45) >= 1500, "half of a prediction that proved too high is trusted"


@pytest.mark.parametrize("kbps", [100, 250, 600, 850, 1200, 1300])
def test_without_predictions_the_cap_follows_a_link_that_becomes_narrow(kbps: float) -> None:
    """Once is no sign of competing flows."""
    link = Link(steps((0, 4000), (10, kbps)), one_way_s=0.05)
    done = drive(link, steps((0, 4000)), 45, fps=15, filled=0.95, predicted=False)
    assert done.first(10, lambda cap: cap < kbps) < 1
    assert done.wait_ms(0.95, since=15) <= 100
    assert done.kbps(15, 45) >= 0.9 * kbps


def test_losses_with_a_short_queue_are_no_sign_of_competing_flows() -> None:
    """Every report repeats them; three of these would refute a proof that the link has become narrow."""
    cap = LinkCap(kbps=Fraction(2000), alone=True, most=Most(Fraction(2000), 10), changed=8, measured=10, short=10)
    for i in range(1, 6):
        t = 10 + 0.04 * i
        link = LinkMeasured(t=t, kbps=Fraction(1900), queue_ms=25, loss=0.05, state=LinkState.FILLING, rtt_ms=100)
        cap = update_cap(cap, link, t, Fraction(4000))
    assert cap.proofs.times == ()


def laps(t: float) -> PositionReported:
    """500 m northwards at 10 m/s, repeatedly."""
    return PositionReported(t=t, lat=48 + 10 * t % 500 / METRES_PER_DEGREE, lon=11)


def test_a_place_where_predictions_proved_too_high_is_remembered() -> None:
    """From 100 to 220 m the link carries half of the prediction. The second lap is careful if positions are known."""
    link = Link(steps((0, 4000), (10, 2000), (22, 4000), (60, 2000), (72, 4000)))
    unknown, known = (drive(link, steps((0, RIGHT)), 100, position=position) for position in (None, laps))
    assert known.lowest(9, 10) == unknown.lowest(59, 60) == RIGHT
    assert known.lowest(59, 60) < 0.8 * RIGHT
    assert known.lowest(50, 52) == known.lowest(95, 100) == RIGHT, "far from there all is believed"
    assert known.wait_ms(0.99, since=60) < 0.8 * unknown.wait_ms(0.99, since=60)


DOUBTED = Trust(places=(DoubtedPlace(laps(0), 0.0, Fraction(1, 2), near=False),))


def test_a_place_is_forgotten_gradually() -> None:
    shares = {t: update_trust(DOUBTED, t, HALF, replace(laps(0), t=t)).share for t in (1, 300, 480, REMEMBERED_S, 601)}
    assert list(map(float, shares.values())) == [0.5, 0.75, 0.9, 1, 1]
    assert update_trust(DOUBTED, 601, HALF, replace(laps(0), t=601)) == Trust()


def test_trust_falls_when_the_vehicle_reaches_a_place_and_recovers_while_it_stays() -> None:
    trust = update_trust(DOUBTED, 10, HALF, laps(30))
    assert (trust.share, trust.places[0].near) == (1, False)
    trust = update_trust(trust, 51, HALF, laps(51))
    assert trust.share == Fraction(542, 1000)
    for t in range(52, 120):
        trust = update_trust(trust, t, HALF, replace(laps(50), t=t))
    assert trust.share == 1
    assert update_trust(replace(trust, share=Fraction(4, 5)), 120, HALF, replace(laps(50), t=120)).share == Fraction(
        83, 100
    )


def test_trust_falls_at_a_place_even_while_recovering() -> None:
    """After a period without measurements."""
    trust = update_trust(replace(DOUBTED, share=Fraction(4, 5), changed=0.0), 51, HALF, laps(51))
    assert trust.share == Fraction(542, 1000)


@pytest.mark.parametrize("late_s", [0.0, 0.1, 0.3])
def test_a_limit_that_follows_the_link_is_not_doubted_and_recovery_is_fast(late_s: float) -> None:
    """A prediction that steps with the link arrives with the measurement of the step or just after the cut."""
    falls = [(8 * i + 5.0, 8 * i + 7.0) for i in range(6)]
    link = Link(lambda t: 400 if any(a <= t < b for a, b in falls) else 4000)
    done = drive(link, lambda t: 0.9 * link.kbps(t - late_s), 50, fps=15)
    for _, end in falls:
        assert done.first(end, lambda cap: cap >= 0.8 * RIGHT) <= 2.5


@pytest.mark.parametrize("seed", range(1, 5))
@pytest.mark.parametrize("share", [1, 1.5])
@pytest.mark.parametrize(
    ("early_s", "within_s", "wait_ms"), [(-0.7, 1.6, 150), (0, 0.8, 110), (0.5, 2.3, 110), (1, 2.6, 110)]
)
def test_what_arrives_in_an_outage_that_was_predicted_says_nothing_about_the_link_after_it(
    share: float, seed: int, early_s: float, within_s: float, wait_ms: float
) -> None:
    """Its rate varies, and it may last longer than predicted. One cut in it used to leave the link unused for long."""
    link = Link(steps((0, 4300), (8, 60), (8.3, 300), (8.6, 20), (9, 3800)))
    predicted = steps((0, 4300), (8 - early_s, 144), (9 - early_s, 3800))
    done = drive(link, lambda t: share * predicted(t), 16, fps=10, seed=seed)
    assert done.first(9, lambda cap: cap > 3000) < within_s
    assert done.wait_ms(0.95, since=10) <= wait_ms


def test_the_end_of_a_predicted_outage_releases_no_more_than_half_of_the_rate_at_once() -> None:
    """A link may recover gradually. No cap is in force while more passes than is predicted."""
    link = Link(steps((0, 4300), (8, 120), (9, 2400), (10, 3800)))
    done = drive(link, steps((0, 4300), (8, 96), (9, 3800)), 16, fps=10)
    assert max(cap for t, cap, _ in done.caps if 9 <= t < 9.15) == 3800 / 2
    assert done.kbps(9, 10) > 0.7 * 2400
    assert done.kbps(11, 16) > 0.9 * 3800


def test_a_link_that_is_poor_for_long_is_known_by_what_it_carries() -> None:
    known = Overuse(1, Fraction(4000), Fraction(4000))
    cap = LinkCap(kbps=Fraction(4000), overuse=known, predicted=True, measured=99)
    cap = cap._replace(limit=LastLimit(Fraction(4000), rose=1.0))

    def under(cap: LinkCap, t: float, limit: float) -> LinkCap:
        return update_cap(
            cap, LinkMeasured(t=t, kbps=None, queue_ms=0, loss=0, state=LinkState.CLEAR), t, Fraction(limit)
        )

    poor = under(cap, 2, 300)._replace(overuse=Overuse(2.5, Fraction(100), Fraction(300)))
    after = [under(poor, t, 3300).overuse for t in (5, 13)]
    assert [overuse and overuse.known(Fraction(3300)) for overuse in after] == [3300, 1100]


def test_a_stale_position_is_ignored() -> None:
    assert update_trust(DOUBTED, KNOWN_S + 1, HALF, laps(0)).share == 1
    doubts = tuple((float(t), Fraction(1, 2)) for t in (0, 2))
    trust = update_trust(add_doubt(Trust(doubts=doubts), 4.0, HALF), 4.5, HALF, laps(0))
    assert (trust.share, trust.places) == (Fraction(1, 2), ())


def test_a_place_that_is_doubted_again_is_remembered_longest() -> None:
    near = DoubtedPlace(laps(0), 0.0, Fraction(1, 2))
    far = tuple(
        DoubtedPlace(PositionReported(t=0, lat=50 + i, lon=11), 0.0, Fraction(1, 2), near=False) for i in range(3)
    )
    doubts = tuple((float(t), Fraction(3, 5)) for t in (96, 98))
    trust = add_doubt(Trust(doubts=doubts, places=(near, *far)), 100.0, Fraction(3, 5))
    trust = update_trust(trust, 100.5, HALF, laps(100))
    assert trust.places == (*far, DoubtedPlace(laps(0), 100.5, Fraction(3, 5)))


@pytest.mark.parametrize(
    ("lat", "lon", "other", "near"), [(0, 180, -179.9992, True), (0, 10, 10.001, False), (60, 10, 10.001, True)]
)
def test_distance(lat: float, lon: float, other: float, near: bool) -> None:
    """0.001 degrees of longitude are 111 m at the equator and 56 m at 60 degrees north."""
    assert is_near(PositionReported(t=0, lat=lat, lon=lon), PositionReported(t=0, lat=lat, lon=other)) is near


# --- predictions that are always too high -----------------------------------------------------------------------------


def reported(
    cap: LinkCap, limit: float, *reports: tuple[float, str, int, float], least: Fraction = Fraction(1)
) -> list[float]:
    """The cap after each report: (t, state, kbit/s, wait in the queue in ms)."""
    caps = []
    for t, state, kbps, queue_ms in reports:
        link = LinkMeasured(t=t, kbps=Fraction(kbps), queue_ms=queue_ms, loss=0.0, state=LinkState(state), rtt_ms=30)
        cap = update_cap(cap, link, t, Fraction(limit), least)
        caps.append(limit if cap.kbps is None else float(cap.kbps))
    return caps


def capped(carried: float, limit: float, kbps: float, t: float = 10.0, **other: object) -> LinkCap:
    """The cap of a link that proved at t to carry so much of its limit."""
    overuse = Overuse(t, Fraction(carried), Fraction(limit))
    state: dict[str, object] = {"changed": t, "measured": t, "short": t, "began": 0.0, "predicted": True}
    return LinkCap(kbps=Fraction(kbps), overuse=overuse, limit=LastLimit(Fraction(limit), rose=0.0))._replace(
        **{**state, **other}  # type: ignore[arg-type]
    )


def starting(kbps: float, limit: float) -> LinkCap:
    """The cap half a second after the link was first measured, at t = 10, before it has proved narrow."""
    limited = {"kbps": Fraction(kbps), "limit": LastLimit(Fraction(limit)), "predicted": True}
    return LinkCap(provisional=True, began=9.5, changed=10.0, **limited)  # type: ignore[arg-type]


def varying(seed: int, low: float, high: float) -> Callable[[float], float]:
    """A capacity that is another one each second."""
    rng = random.Random(seed)
    levels = [rng.uniform(low, high) for _ in range(60)]
    return lambda t: levels[int(t)]


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_predictions_that_are_always_too_high_cost_little_latency_once_known(seed: int) -> None:
    """The link falls with the prediction, and so does the cap, before a queue shows it."""
    kbps = varying(seed, 2000, 6000)
    right, high = (
        drive(Link(kbps, one_way_s=0.02), lambda t, share=share: share * kbps(t), 40, cameras=4, fps=10)  # type: ignore[misc]
        for share in (0.95, 1.42)
    )
    assert high.wait_ms(0.99, since=5) <= 1.5 * right.wait_ms(0.99, since=5)
    assert high.kbps(5, 40) >= 0.92 * right.kbps(5, 40)


def test_the_known_capacity_falls_with_the_prediction() -> None:
    """A short queue seems to be jitter while less is sent than the link carried before."""
    cap = capped(4000, 5700, 4000, t=5.0)
    caps = reported(
        cap,
        3990,
        (10.20, "filling", 2800, 35),
        (10.24, "filling", 2800, 50),
        (10.28, "filling", 2800, 60),
        (10.50, "clear", 2400, 0),
        (10.66, "clear", 2400, 0),
    )
    assert max(caps) <= 2800


def test_a_rate_that_is_measured_under_another_prediction_keeps_their_ratio() -> None:
    """Link and prediction rise by 1.43: that the link carries more does not mean that the prediction is right."""
    cap = capped(2800, 3990, 2400)
    rise = ((10.24, "draining", 3300, 40), (10.36, "draining", 3900, 30))
    clear = [(10.44 + n * 0.04, "clear", 2400, 0) for n in range(20)]
    assert max(reported(cap, 5700, *rise, *clear)) <= 4000


def test_a_rate_that_was_measured_before_the_prediction_fell_does_not_raise_the_known_capacity() -> None:
    """Link and prediction have fallen by a quarter; what arrived before that still shows in the next reports."""
    cap = capped(4000, 5700, 3680)
    before = ((10.24, "draining", 4000, 40), (10.36, "draining", 3800, 30))
    clear = [(10.5 + n * 0.04, "clear", 2700, 0) for n in range(20)]
    assert max(reported(cap, 4275, *before, *clear)) <= 2760


@pytest.mark.parametrize(("queue_ms", "kbps"), [(21, 4800), (40, 2430)])
def test_soon_after_the_prediction_rose_a_short_queue_proves_little(queue_ms: float, kbps: float) -> None:
    """All cameras change their size with a large frame; the rate still includes the time before. 0.6 of the limit."""
    rising = LastLimit(Fraction(8000), rose=9.95, before_rise=Fraction(2000))
    cap = LinkCap(measured=9.9, short=9.9, began=0.0, predicted=True, limit=rising)
    assert reported(cap, 8000, (10.04, "filling", 2700, queue_ms)) == [kbps]


def test_careful_increases_end_when_the_prediction_falls() -> None:
    known = capped(4000, 5700, 4100)
    assert reported(known, 4275, (10.6, "clear", 3900, 0)) == [2760], "0.92 of what the link is known to carry"
    outdated = capped(4000, 5700, 5200)
    assert reported(outdated, 4275, (10.6, "clear", 5000, 0)) == [3900], "it carries more than was known"


def test_a_prediction_that_falls_soon_after_it_proved_too_high_was_not_late() -> None:
    cap, link = capped(4000, 5700, 3680), {10: 4000, 11: 3000, 12: 4000}
    for second, kbps in link.items():
        for n in range(25):
            t = second + n / 25
            measured = LinkMeasured(t=t, kbps=Fraction(kbps), queue_ms=0, state=LinkState.CLEAR, rtt_ms=30)
            cap = update_cap(cap, measured, t, Fraction(round(kbps * 1.425)))
            assert cap.kbps is not None
            assert cap.kbps <= 1.05 * kbps


@pytest.mark.parametrize(("limit", "kbps"), [(4000, 3680), (3700, 3680), (1995, 1288)])
def test_a_prediction_that_falls_further_than_the_link_has_fallen_announces_another_fall(
    limit: float, kbps: float
) -> None:
    """Soon after the start any link narrower than predicted seems to have fallen."""
    cap = capped(4000, 5700, 3680)._replace(began=9.0, overuse=Overuse(10.0, Fraction(4000), Fraction(5700), fell=True))
    assert reported(cap, limit, (11.0, "filling", 3900, 10)) == [kbps]


def test_a_rate_from_before_a_fall_of_the_prediction_raises_no_cap_soon_after_the_start() -> None:
    """Such a cap grows beyond what is known without proof: it keeps to what is known when the prediction falls."""
    cap = capped(14000, 20000, 17500)._replace(began=9.5, overuse=Overuse(10.0, Fraction(14000), Fraction(20000)))
    reports = [(10.5 + n * 0.04, "clear", 14500, 0) for n in range(10)]
    assert set(reported(cap, 5000, *reports)) == {3220}, "0.92 of 14 of 20"


@pytest.mark.parametrize(("queue_ms", "kbps"), [(0, 3220), (20, 2800), (60, 2100)])
def test_a_prediction_that_falls_at_the_start_leaves_room_to_drain_the_queue(queue_ms: float, kbps: float) -> None:
    """What waits is carried four times as slowly: 20 ms become 80, and a fifth less is sent; at least 0.6 is."""
    overuse = Overuse(10.0, Fraction(14000), Fraction(20000), fell=True)
    cap = capped(14000, 20000, 13000)._replace(began=9.5, overuse=overuse)
    assert reported(cap, 5000, (10.5, "filling", 14000, queue_ms)) == [kbps]


@pytest.mark.parametrize(
    ("limit", "arrives", "kbps"),
    [
        (5000, 12000, 2700),  # 0.9 of a quarter of 12 Mbit/s, since 10 ms become 40
        (19000, 12000, 15200),  # noise
        (14000, 12000, 11200),  # still more than arrives
        (5000, 1250, 4000),  # one of several cameras has started
        (1000, 1250, 480),  # at least 0.6 of a twentieth of 16 Mbit/s
    ],
)
def test_before_the_link_proves_narrow_a_clear_fall_of_the_prediction_lowers_the_cap_below_what_arrives(
    limit: float, arrives: int, kbps: float
) -> None:
    """Otherwise the cap keeps its share of the prediction."""
    assert reported(starting(16000, 20000), limit, (10.5, "clear", arrives, 10)) == [kbps]


def test_two_quick_falls_of_the_prediction_at_the_start_count_as_one() -> None:
    """What arrives was sent under the first prediction, of 20 Mbit/s."""
    cap = starting(16000, 20000)
    for t, limit in ((10.5, 10000), (10.55, 5000)):
        link = LinkMeasured(t=t, kbps=Fraction(12000), queue_ms=0, loss=0.0, state=LinkState.CLEAR, rtt_ms=30)
        cap = update_cap(cap, link, t, Fraction(limit))
    assert cap.kbps == Fraction(2760), "0.92 of a quarter of 12 Mbit/s"


def test_a_prediction_that_falls_before_the_first_measurement_lowers_the_start() -> None:
    limit = Fraction(20000)
    cap = start_cap(UNCAPPED._replace(predicted=True), None, 1.0, limit, HALF)
    for t in (1.0, 1.5):
        cap = update_cap(cap, None, t, limit if t == 1.0 else limit / 4)
    assert reported(cap, 5000, (1.6, "clear", 2400, 0)) == [2500]


def test_after_the_start_a_cap_that_is_not_filled_grows_in_steps() -> None:
    cap = starting(8000, 20000)._replace(changed=11.3)
    assert reported(cap, 20000, *((t, "clear", 3000, 0) for t in (11.45, 11.6, 11.75, 11.9))) == [
        8000,
        12000,
        18000,
        20000,
    ]


def test_a_short_stall_at_the_start_makes_the_cap_grow_no_faster() -> None:
    cap = starting(10000, 20000)
    states = (("stalled", 10.3), ("clear", 10.35), ("clear", 10.5), ("clear", 10.65))
    assert reported(cap, 20000, *((t, state, 10000, 0) for state, t in states))[-1] <= 8000


@pytest.mark.parametrize(("queue_ms", "kbps"), [(0, 11250), (10, 11250), (16, 10500), (20, 10000), (40, 10000)])
def test_at_the_start_the_cap_grows_less_with_a_queue(queue_ms: float, kbps: float) -> None:
    assert reported(starting(10000, 20000), 20000, (10.5, "clear", 10000, queue_ms)) == [kbps]


def test_at_the_start_what_is_sent_does_not_count_as_carried() -> None:
    """The first overuse of a link of 14.5 Mbit/s with a short queue, while the cap is 18.6 Mbit/s."""
    measured = LinkMeasured(t=10.5, kbps=Fraction(14500), queue_ms=38, state=LinkState.FILLING, rtt_ms=30)
    overuse = update_cap(starting(18600, 20000), measured, 10.5, Fraction(20000)).overuse
    assert overuse
    assert overuse.known(Fraction(20000)) == 14500


def test_at_the_start_jitter_of_the_first_cameras_is_not_taken_for_the_capacity() -> None:
    """One of eight has started, and its two first pictures are late."""
    reports = ((10.2, "filling", 1250, 25), (10.24, "filling", 1250, 27))
    assert min(reported(starting(10000, 20000), 20000, *reports)) >= 6000


@pytest.mark.parametrize(("arrives", "kbps"), [(3000, 20000), (13900, 13900)])
def test_after_the_start_a_cap_that_a_queue_kept_is_not_released_at_once(arrives: int, kbps: float) -> None:
    cap = starting(13900, 20000)._replace(changed=11.3)
    assert reported(cap, 20000, (11.6, "clear", arrives, 20))[-1] == pytest.approx(kbps, rel=0.025)


def test_later_a_prediction_that_falls_further_than_the_link_was_only_late() -> None:
    """It may be a lower bound, which stays below the link."""
    cap = capped(3000, 4800, 2760)._replace(overuse=Overuse(10.0, Fraction(3000), Fraction(4800), fell=True))
    assert reported(cap, 2400, (10.5, "filling", 2800, 10)) == [2760]


@pytest.mark.parametrize("share", [1, 1.5])
def test_a_noisy_prediction_blocks_neither_the_start_nor_the_recovery(share: float) -> None:
    """Ten predictions a second, each a little different; in its first second the link carries less."""
    noise = random.Random(1)
    limits = [share * 4000 * noise.uniform(0.98, 1) for _ in range(300)]
    link = Link(steps((0, 4000), (0.5, 1500), (1.2, 4000)))
    done = drive(link, lambda t: limits[int(10 * t)], 20, fps=15, start=HALF)
    assert done.kbps(8, 20) >= 0.85 * 4000
    done = drive(Link(lambda t: 4000.0), lambda t: limits[int(10 * t)], 4, fps=15, start=HALF)
    assert done.first(0.1, lambda cap: cap >= 0.8 * 4000) <= 1.3


def test_an_operators_total_that_falls_lowers_no_cap_below_it() -> None:
    """Only a prediction that falls says something about the link."""
    cap = follow(capped(3000, 6000, 2800), Fraction(3500), is_prediction=False)
    assert reported(cap, 3500, (10.04, "clear", 2800, 0)) == [2800]


def test_an_outage_is_not_mistaken_for_a_longer_path() -> None:
    """The last waits in the queue seem not to drain, although less arrives than before."""
    link = Link(steps((0, 4000), (4, 1500), (4.25, 0), (6, 4000)))
    done = drive(link, steps((0, 6000), (4, 2100), (6, 6000)), 8, cameras=4, fps=10)
    outage = [(t, cap, state) for t, cap, state in done.caps if 4.6 < t < 6]
    assert {state for _, _, state in outage} == {"stalled"}
    assert all(after[1] <= before[1] for before, after in pairwise(outage))


def test_a_cap_recovers_although_most_cameras_send_next_to_nothing() -> None:
    """They keep their shares; one of four sends all of its own."""
    cap, t = LinkCap(kbps=Fraction(500), measured=10.0, changed=10.0, began=0.0), 10.0
    for _ in range(100):
        t += 0.1
        kbps = Fraction(119) if cap.kbps is None else cap.kbps / 4
        cap = update_cap(cap, LinkMeasured(t=t, kbps=kbps, queue_ms=0, state=LinkState.CLEAR), t, Fraction(4000))
    assert cap.kbps is None


def test_an_operator_that_connects_over_a_narrow_link_has_as_long_as_others_until_its_first_picture() -> None:
    cap = start_cap(capped(300, 6000, 300, idle=100.0), None, 100.0, Fraction(6000), HALF)
    assert [update_cap(cap, None, t, Fraction(6000)).kbps for t in (102.5, 104.9, 105.1)] == [300, 300, None]


def test_a_place_that_was_left_without_measurements_is_doubted_again() -> None:
    trust = Trust(Fraction(4, 5), 100.0, places=(DoubtedPlace(laps(0), 100.0, Fraction(4, 5)),))
    cap = update_cap(capped(300, 6000, 300, t=100.0, trust=trust), None, 110.0, Fraction(6000))
    assert (cap.kbps, cap.trust.share) == (None, 1)
    assert update_trust(cap.trust, 151, HALF, laps(150)).share < 0.9


MEASURED = st.tuples(
    st.sampled_from(LinkState),
    st.none() | st.integers(0, 20_000),
    st.sampled_from([0, 3, 20, 90, 500, 4000]),
    st.sampled_from([0, 0.01, 0.2, 1]),
    st.sampled_from([0.001, 0.04, 0.2, 1, 30]),
    st.integers(1, 9000),
)


@given(st.lists(MEASURED, max_size=40))
def test_any_measurements_leave_a_cap_that_recovers(measured: list[tuple]) -> None:  # type: ignore[type-arg]
    cap, t = LinkCap(), 0.0
    for state, kbps, queue_ms, loss, passed, limit in measured:
        t += passed
        link = LinkMeasured(
            t=t, kbps=None if kbps is None else Fraction(kbps), queue_ms=queue_ms, loss=loss, state=state, rtt_ms=30
        )
        cap = update_cap(cap, link, t, Fraction(limit))
        assert cap.kbps is None or cap.kbps >= LEAST
        for _ in range(3):  # periods without a report
            t += passed / 3
            cap = update_cap(cap, link, t, Fraction(limit))
    for _ in range(500):
        t += 0.1
        cap = update_cap(cap, LinkMeasured(t=t, queue_ms=0, state=LinkState.CLEAR), t, Fraction(5000))
    assert cap.kbps is None or cap.kbps >= 5000


@pytest.mark.parametrize("after, known", [(1870, 1870), (2520, 1900), (1300, 1300)])
def test_a_low_rate_during_the_burst_after_a_stall_is_corrected_by_later_arrivals(after: int, known: int) -> None:
    """As measured on a busy machine; the cap then stayed at 1200 kbit/s for seconds."""
    overuse = Overuse(0.0, Fraction(1900), Fraction(4200))
    cap = LinkCap(kbps=Fraction(1760), overuse=overuse, before=Fraction(1400), began=-9.0, changed=0.6, measured=0.6)
    burst = [("stalled", 1400, 0), ("filling", 2100, 84), ("filling", 1235, 65), ("filling", after, 250)]
    for number, (state, kbps, queue_ms) in enumerate(burst):
        t = 0.7 + 0.06 * number
        link = LinkMeasured(t=t, kbps=Fraction(kbps), queue_ms=queue_ms, loss=0, state=LinkState(state), rtt_ms=4)
        cap = update_cap(cap, link, t, Fraction(4200))
    assert cap.overuse
    assert cap.overuse.carried == known


def test_no_sequence_of_reports_breaks_the_cap() -> None:
    """`make soak` runs 200 000."""
    assert [wrong for seed in range(600) if (wrong := reports.sequence(seed))] == []
