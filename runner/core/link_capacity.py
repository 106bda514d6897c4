"""What the link is known to carry, in relation to the limit, which is a prediction or the operator's total. Pure.

A link that proved at its last overuse to carry a share of a prediction is expected to carry that share of the next one.
An operator's total does not scale it.
"""

from __future__ import annotations

from fractions import Fraction

from runner.core.events import LinkMeasured
from runner.core.link_memory import SEEN_S, LinkCap, Lowering, Overuse, PredictedOutage, rtt_s, tenths
from runner.core.model import Kbps, exact
from runner.core.trust import FALL_S, LATE_S, relieve

DRAIN_MS = 400  # a queue should drain within about this time ...
DEEPEST, SHALLOWEST = Fraction(3, 5), Fraction(19, 20)  # ... by a cut to a share of what the link carries
RESERVE = Fraction(23, 25)  # share of what the link carried up to which recovery is fast
FELL = Fraction(9, 10)  # share of the known capacity below which the link has fallen, or of a prediction: too high
# A prediction that falls by this factor announces an outage, and one that rises by it ends it. If it is short, what
# arrives meanwhile says nothing about the link after it; nor does less than that share in the first BEGIN_S after it.
OUTAGE, OUTAGE_S = 10, 10.0
BEGIN_S = 2.0  # after the first measurement or an outage: until then the capacity is too uncertain


def fall_with_limit(cap: LinkCap, link: LinkMeasured | None, t: float, limit: Kbps) -> LinkCap:
    """The cap when a prediction falls: a link that carries a constant share of it has fallen, too.

    The cap falls to what is then known to be carried, or further where a queue has to drain. Careful increases end.
    If it has grown far beyond that, the known capacity is outdated, and the cap keeps its share of the prediction. It
    does not fall if the link has fallen before, and the prediction follows. See `_fall_unproven` for a cap that has not
    proved right or wrong.
    """
    last, before = cap.overuse, cap.limit.kbps
    if not cap.predicted or cap.kbps is None or limit >= before or (last and _was_late(cap, last, t, limit)):
        return cap
    sent = cap.in_force(before)
    if _is_unproven(cap, t):
        return cap._replace(kbps=tenths(min(sent, _fall_unproven(cap, link, t, limit))))
    if last is None:
        return cap
    known, same_share = min(limit, last.known(limit)), sent * limit / before
    drained = _drain_share_after(link, before, limit) * known
    return cap._replace(kbps=tenths(same_share if known < FELL * same_share else min(sent, drained)))


def _fall_unproven(cap: LinkCap, link: LinkMeasured | None, t: float, limit: Kbps) -> Kbps:
    """What may be sent when the prediction falls while the cap grows beyond what is known.

    A fall that is slight, or leaves more than arrives, lowers the cap in proportion at the start, and not later. After
    any other, less is sent than the link is known to carry or, before it proves narrow, than a proportional part of
    what arrives.
    """
    sent, in_force = cap.in_force(cap.limit.kbps), cap.limit.kbps
    same_share = sent * limit / in_force
    otherwise = same_share if is_start(cap, t) else sent
    if link is None:
        return otherwise
    before = cap.limit.before_fall if just_fell(cap, link, t) else in_force
    last = cap.overuse or Overuse(t, link.kbps or Fraction(0), before)  # as if what arrives were the capacity
    if limit >= FELL * before or last.carried < FELL * limit:
        return otherwise
    if limit >= FELL * in_force:
        return same_share  # the last step of a fall for which the cap has been lowered
    return max(DEEPEST * same_share, _drain_share_after(link, before, limit) * min(limit, last.known(limit)))


def _drain_share_after(link: LinkMeasured | None, before: Kbps, limit: Kbps) -> Fraction:
    """The share of its capacity with which the queue drains after the link has fallen in proportion to the limit."""
    queue_ms = exact((link and link.queue_ms) or 0)
    return min(RESERVE, drain_share(queue_ms * before / limit)) if limit else RESERVE


def drain_share(queue_ms: Fraction) -> Fraction:
    """The share of its capacity with which a queue drains in time."""
    return max(DEEPEST, min(SHALLOWEST, 1 - queue_ms / DRAIN_MS))


def adapt_overuse(cap: LinkCap, t: float, limit: Kbps) -> LinkCap:
    """Correct the last overuse if the limit has followed the link since: it was late, and less wrong than it seemed.

    After an outage the link is expected to carry the same share of the limit as before it.
    """
    known, last = cap.limit, cap.overuse
    cap = cap._replace(limit=known.followed_by(limit, t))
    if cap.predicted and known.kbps >= OUTAGE * limit:
        is_late = last is not None and last.fell and t - last.t <= LATE_S  # that overuse already was the outage's
        before = cap.outage.overuse if cap.outage else None if is_late else last
        return cap._replace(outage=PredictedOutage(t, limit, before))
    if cap.outage and (t - cap.outage.t > OUTAGE_S or not cap.predicted):
        cap = cap._replace(outage=None)
    elif cap.outage and limit >= OUTAGE * cap.outage.limit:
        return _end_outage(cap, t, limit, cap.outage.overuse)
    if last is None or limit >= last.limit or last.carried >= last.limit or not _was_late(cap, last, t, limit):
        return cap
    followed = max(limit, last.carried)
    trust = relieve(cap.trust, last.t, followed / last.limit)
    return cap._replace(overuse=last._replace(limit=followed), trust=trust)


def is_start(cap: LinkCap, t: float) -> bool:
    """Whether the link has been measured for too short a time to know its capacity, or not at all."""
    return t - cap.began < BEGIN_S


def _is_unproven(cap: LinkCap, t: float) -> bool:
    """Whether the cap grows without proof of what the link carries."""
    return cap.provisional or is_start(cap, t)


def _was_late(cap: LinkCap, last: Overuse, t: float, limit: Kbps) -> bool:
    """Whether a limit that falls only follows the link, which has fallen before.

    At the start any link that is narrower than the limit seems to have fallen. One that falls to clearly less than what
    was carried then is not late.
    """
    if is_start(cap, last.t) and limit < FELL * last.carried:
        return False
    return last.fell and t - last.t <= LATE_S


def _end_outage(cap: LinkCap, t: float, limit: Kbps, before: Overuse | None) -> LinkCap:
    """The cap when the prediction ends an outage: half of what the link carried before it, relative to the limit.

    All of it at once would fill the queue of a link that recovers gradually. While nothing arrives, the cap stays, and
    the first report restores as much.
    """
    known = before.known(limit) if before else limit
    carried, overuse = min(limit * cap.trust.share, known), before and _known_now(before, known, limit)
    cap = cap._replace(outage=None, resumed=t, overuse=overuse, before=carried)
    if cap.stall:
        return cap
    kbps = tenths(max(carried / 2, cap.kbps or Fraction(0)))
    return cap._replace(kbps=kbps, queue_ms=float("inf"), steps=0, changed=t)  # the queue is the outage's


def next_overuse(cap: LinkCap, t: float, carried: Kbps, limit: Kbps) -> Overuse:
    """A new overuse after the last one; cuts within FALL_S belong to the same fall of the link.

    The first one shows a fall only if more has arrived before. Otherwise the limit may always have been too high.
    """
    last = cap.overuse
    has_fallen = carried < FELL * (last.known(limit) if last else min(limit, cap.most.kbps))
    return Overuse(t, carried, limit, has_fallen or (last is not None and last.fell and t - last.t < FALL_S))


def limit_seen(cap: LinkCap, link: LinkMeasured, t: float, limit: Kbps) -> Kbps:
    """The limit under which a rate was measured: after a rise, for some time the one before."""
    return cap.limit.before_rise if _is_recent(cap.limit.rose, link, t) else limit


def is_of_outage(cap: LinkCap, link: LinkMeasured, t: float, limit: Kbps) -> bool:
    """Whether a rate was measured in a predicted outage, or while one lasts for longer than predicted."""
    lasts = t - cap.resumed < BEGIN_S and limit >= OUTAGE * (link.kbps or 0)
    return cap.predicted and (lasts or limit >= OUTAGE * limit_seen(cap, link, t, limit))


def lower_known(cap: LinkCap, carried: Kbps, link: LinkMeasured, t: float, limit: Kbps) -> LinkCap:
    """Lower the known capacity if the link proves to carry less than at its last overuse, and no cut is due."""
    if cap.overuse is None or carried >= (known := cap.overuse.known(limit)):
        return cap
    known = max(known, cap.lowering.known if _is_recent(cap.lowering.t, link, t) else carried)
    return cap._replace(overuse=_known_now(cap.overuse, carried, limit), lowering=Lowering(t, known))


def raise_known(cap: LinkCap, link: LinkMeasured, t: float, limit: Kbps) -> LinkCap:
    """Raise the known capacity soon after an overuse, while its queue lasts, if more arrives than it.

    Likewise soon after a measurement that lowered it, but not above the value before. After a stall units arrive in
    bursts, and a measurement may include a pause between them. Soon after the prediction fell, a rate may have been
    measured under the one before.
    """
    last = cap.overuse
    if just_fell(cap, link, t):
        limit = max(limit, cap.limit.before_fall)
    if last is None or link.kbps is None or link.kbps <= (known := last.known(limit)):
        return cap
    if _is_recent(last.t, link, t):
        return cap._replace(overuse=_known_now(last, link.kbps, limit))
    if _is_recent(cap.lowering.t, link, t):
        return cap._replace(overuse=_known_now(last, max(known, min(link.kbps, cap.lowering.known)), limit))
    return cap


def is_start_over(cap: LinkCap, link: LinkMeasured, t: float, limit: Kbps) -> bool:
    """Whether the prediction has clearly fallen at the start, so that the link's capacity has to be found again."""
    return _is_unproven(cap, t) and just_fell(cap, link, t) and limit < FELL * cap.limit.before_fall


def just_fell(cap: LinkCap, link: LinkMeasured, t: float) -> bool:
    """Whether what arrives may have been sent before the prediction fell."""
    return cap.predicted and _is_recent(cap.limit.fell, link, t)


def _known_now(last: Overuse, carried: Kbps, limit: Kbps) -> Overuse:
    """The overuse with what the link carries under the current limit."""
    return last._replace(carried=tenths(carried), limit=limit)


def _is_recent(since: float, link: LinkMeasured, t: float) -> bool:
    """Whether a measured rate may still include that time."""
    return t - since <= SEEN_S + rtt_s(link)
