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
TRIAL_S, PASSED_S = 30.0, 2.0  # from the proof, or a failed trial, until more is tried; after a trial without losses
TRIED = 0.05  # and how much more; twice as much where nothing was lost before, up to MOST_TRIED
MOST_TRIED = 0.8
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
    """

    kbps: float = inf
    proven: bool = False
    since: float = -inf
    share: float = 0.0
    kbit: float = 0.0
    lost: float = 0.0
    usual: float = 0.0
    step: float = TRIED


class Losses(NamedTuple):
    """Of a report, and of the last seconds.

    kbit, lost         received and lost according to this report, kbit
    recent_kbit, recent_lost   the same of the last seconds, but not before the last test or trial
    kbps               received rate of the last seconds
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
    if seen.recent_lost > FEW and seen.recent_lost > (POLICED + 2 * p.usual) * sent and not seen.queued and seen.kbps:
        step = TRIED if p.kbps < inf else 2 * TRIED  # the first rate may be too low
        share = seen.recent_lost / sent
        return Policer(min(p.kbps, seen.kbps), since=t, share=share, usual=p.usual, step=step)
    if p.kbps < inf and t - p.since > (TRIAL_S if p.step == TRIED else PASSED_S):
        return p._replace(kbps=p.kbps * (1 + p.step), since=t, step=min(MOST_TRIED, 2 * p.step))
    return p._replace(usual=p.usual * (1 - min(1.0, seen.dt / USUAL_S)))


def _test(p: Policer, t: float, seen: Losses) -> Policer:
    if t - p.since < SETTLE_S:
        return p
    p = p._replace(kbit=p.kbit + seen.kbit, lost=p.lost + seen.lost)
    sent = p.kbit + p.lost
    if p.share * sent < ENOUGH:
        return p
    found = p.lost / (p.share * sent)
    if found < PROVEN:
        return p._replace(proven=True, since=t)
    if found > REFUTED and p.lost < RANDOM * sent:
        return Policer(usual=max(p.usual, p.lost / sent))
    kbps = min(p.kbps, seen.kbps or p.kbps)  # still too much
    return Policer(kbps, since=t, share=p.lost / sent, usual=p.usual, step=p.step)
