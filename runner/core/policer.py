"""Policers: links that drop what exceeds a rate, without a queue that would show it. Pure.

Losses without a queue have two causes. A policer's depend on what is sent, and end when less is sent; the path's do
not. So they are told apart by an experiment: less is sent until enough packets would have been lost.
"""

from __future__ import annotations

from math import inf
from typing import NamedTuple

PACKET_KBIT = 10.0  # of a full packet, about
FEW, ENOUGH = 10 * PACKET_KBIT, 15 * PACKET_KBIT  # losses that raise the question, and those that answer it
POLICED = 0.03  # share of losses beyond the usual ones that raises it
SETTLE_S = 0.3  # until a lower rate shows in the reports
PROVEN, REFUTED = (
    0.25,
    0.6,
)  # of the losses expected if they do not depend on the rate: Poisson, 15: -3 and -1.5 deviations
TEST_S = 3.0  # after which a test without an answer ends: so few losses do little harm
FIRST_S, TRIAL_S, PASSED_S = 5.0, 30.0, 3.0  # until more is tried: after the proof, a failed trial, one without losses
TRIED = 0.05  # by this share; twice as much where nothing was lost before, then twice that, until ...
WRONG = 0.8  # ... a rate that may be exceeded by so much is none
SLOWEST = 200.0  # kbit/s: with less there are too few packets to tell
RANDOM = 0.1  # share that losses which do not depend on the rate stay below
USUAL_S = 60.0  # memory of losses that do not depend on the rate


class Policer(NamedTuple):
    """The rate above which the link drops packets.

    kbps       inf: there is no such rate
    proven     whether losses ended when less was sent; until then it is tested
    since      begin of the test, or of the last trial with more, s
    share      of packets lost when the test began
    kbit, lost received and lost during the test, kbit
    usual      share of losses that does not depend on the rate
    step       share by which the next trial sends more
    wait       s from `since` until then
    """

    kbps: float = inf
    proven: bool = False
    since: float = -inf
    share: float = 0.0
    kbit: float = 0.0
    lost: float = 0.0
    usual: float = 0.0
    step: float = TRIED
    wait: float = FIRST_S


class Losses(NamedTuple):
    """Of a report, and of the last seconds.

    kbit, lost         received and lost according to this report, kbit
    recent_kbit, recent_lost   the same of the last seconds, but not before the last test or trial
    kbps               received rate: the greater of those of the last half second and the last two
    queued             whether a queue existed within them
    dt                 s since the previous report
    """

    kbit: float
    lost: float
    recent_kbit: float
    recent_lost: float
    kbps: float
    queued: bool
    dt: float


def police(p: Policer, t: float, seen: Losses) -> Policer:
    """What is known of a policer after a report at t."""
    if p.kbps < inf and not p.proven:
        return _test(p, t, seen)
    sent = seen.recent_kbit + seen.recent_lost
    is_much = seen.recent_lost > FEW and seen.recent_lost > (POLICED + 2 * p.usual) * sent
    if is_much and not seen.queued and seen.kbps > SLOWEST:
        share, is_first = seen.recent_lost / sent, p.kbps == inf  # the first rate may be too low
        step, wait = (2 * TRIED, FIRST_S) if is_first else (TRIED, TRIAL_S)
        return Policer(min(p.kbps, seen.kbps), since=t, share=share, usual=p.usual, step=step, wait=wait)
    if p.kbps < inf and t - p.since > p.wait:
        if p.step >= WRONG:
            return Policer(usual=p.usual)
        return p._replace(kbps=p.kbps * (1 + p.step), since=t, step=2 * p.step, wait=PASSED_S)
    return p._replace(usual=p.usual * (1 - min(1.0, seen.dt / USUAL_S)))


def _test(p: Policer, t: float, seen: Losses) -> Policer:
    if t - p.since < SETTLE_S:
        return p
    p = p._replace(kbit=p.kbit + seen.kbit, lost=p.lost + seen.lost)
    sent = p.kbit + p.lost
    if p.share * sent < ENOUGH:
        if t - p.since < TEST_S:
            return p
        # A rate that was proven before is kept.
        return p._replace(proven=True, since=t) if p.wait == TRIAL_S else Policer(usual=max(p.usual, p.share))
    found = p.lost / (p.share * sent)
    if found < PROVEN:
        return p._replace(proven=True, since=t)
    if found > REFUTED and p.lost < RANDOM * sent:
        # Where a rate was proven before, that it is still too much is as likely: no loss is usual yet.
        return Policer(usual=p.usual if p.wait == TRIAL_S else max(p.usual, p.lost / sent))
    kbps = min(p.kbps, seen.kbps or p.kbps)  # still too much
    return p._replace(kbps=kbps, since=t, share=p.lost / sent, kbit=0.0, lost=0.0)
