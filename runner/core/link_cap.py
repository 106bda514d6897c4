"""The total that the measured link allows. Pure.

On overuse it is cut immediately below the link's capacity, low enough to drain the queue. It recovers in steps up to
the limit, which is the prediction or the operator's total, and never beyond: the prediction saves probing. Where the
link proved narrower than the limit, recovery is fast up to that capacity, which is scaled with a prediction but not
with an operator's total, and careful beyond.
When an operator connects, the cap starts at a share of the limit.
"""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction

from runner.core import link_capacity as capacity
from runner.core import link_contention as contention
from runner.core.events import LinkMeasured, PositionReported
from runner.core.link_memory import LOSSY, LastLimit, LinkCap, Overuse, Stall, is_lossy, is_short, record, rtt_s, tenths
from runner.core.model import Kbps, exact
from runner.core.trust import Trust, add_doubt, thousandths, update_trust
from runner.core.uplink import LinkState

LOSS_S = 1.4  # losses are measured over 1 s, and a full queue drains in 0.4 s: until then they do not reflect a cut
TOO_LOSSY = 0.1  # share of packets lost; random loss on the radio link stays below
LOSING_S = 0.3  # a loss share that has only fallen for longer reflects earlier packets: losses have stopped
LASTED_S = 0.3  # a long queue is real once it has lasted this long: delays on a busy machine are shorter
PROVEN = 2  # once the link proved narrow, the most that arrived is limited to this multiple of the capacity
FAST = Fraction(3, 2)  # increase in each step up to the known capacity
# While that is uncertain, the cap grows in smaller steps, and up to a multiple of what arrives: less with a queue, and
# not at all with one of this length, ms. A queue shows a while after its cause.
BEGIN_STEP, BEGIN, BEGIN_MS = Fraction(9, 8), Fraction(5, 4), 20
CAREFUL, DOUBLING = Fraction(1, 50), 8  # first increase beyond it, and the number of steps that double it
HELD_S = 2.0  # after an overuse that proved a prediction too high, until the first careful increase
TESTED = 3  # a cap grows up to this multiple of what arrives
SETTLE_S = 0.15  # beyond the round trip, until the effect of a cut shows
STEP_S = 0.1  # of recovery, on top of the round trip
REPORT_S = 0.04  # between two reports
SILENCE_S = 0.3  # without a report, or with empty reports, for this long the cap is halved
START_S = 5.0  # until the first pictures of all cameras have arrived and are reported
UNMEASURED_S = 2.0  # a present operator that reports nothing for longer does not measure the link
FRESH_S = 1.0  # an older measurement does not replace a prediction
BELIEVED = Fraction(24, 25)  # share of what the link carried that a doubted limit is lowered to


def update_cap(
    cap: LinkCap,
    link: LinkMeasured | None,
    t: float,
    limit: Kbps,
    least_trust: Fraction = Fraction(1),
    position: PositionReported | None = None,
) -> LinkCap:
    """The cap at time t under a limit, with the newest measurement. The effective limit is `believed_limit`.

    least_trust  minimum share of the limit that is believed, however often it proved too high; 1: it is not doubted
    position     of the vehicle, if known
    """
    if link is None:
        unmeasured = t - max(cap.measured, cap.changed, cap.idle)
        has_started = cap.measured >= cap.connected and not cap.provisional
        if unmeasured > (UNMEASURED_S if has_started else START_S):
            return _reset(cap, limit)
        return _follow_limit(cap, None, t, limit) if cap.provisional else cap
    cap, full = _follow_limit(cap, link, t, limit), limit
    cap = cap._replace(trust=update_trust(cap.trust, t, least_trust, position))
    limit = believed_limit(cap, limit, least_trust)
    if link.t > cap.measured:
        cap = _handle_measurement(cap, link, t, limit, full, least_trust)
    return _handle_silence(cap, link, t, limit)


def _follow_limit(cap: LinkCap, link: LinkMeasured | None, t: float, limit: Kbps) -> LinkCap:
    return capacity.adapt_overuse(capacity.fall_with_limit(cap, link, t, limit), t, limit)


def _handle_measurement(
    cap: LinkCap, link: LinkMeasured, t: float, limit: Kbps, full: Kbps, least_trust: Fraction
) -> LinkCap:
    """The cap after a new measurement, under a limit as believed and in full."""
    cap = record(cap._replace(measured=link.t, began=min(t, cap.began)), link, t)
    if link.state is LinkState.STALLED:
        return _handle_stall(cap, link, t, limit)
    lossy = cap.losses.share > TOO_LOSSY and t - cap.losses.t <= LOSING_S
    unanswered = lossy and t - cap.changed >= LOSS_S + rtt_s(link)
    if (link.state is LinkState.FILLING or unanswered) and link.kbps:
        if cap.stall and cap.before:  # after a stall the link carries less than before
            cap = cap._replace(before=min(cap.before, link.kbps))
        cut = _cut_by_jitter if _may_be_jitter(cap, link) else _cut
        return _doubt_limit(cut(cap, link, t, limit, full), t, least_trust)
    if link.state is LinkState.CLEAR and not lossy:  # a queue that was full from the start looks empty
        return _recover(_resume(cap, t, limit), link, t, limit, full)
    return capacity.raise_known(cap, link, t, full)


def start_cap(cap: LinkCap, link: LinkMeasured | None, since: float | None, limit: Kbps, share: Fraction) -> LinkCap:
    """The cap after an operator connected at `since`: a share of the limit, unless the link is known to carry less.

    All cameras then start with a key frame. At the full limit, a narrower link would lose packets before the first
    measurement.
    """
    if since is None or since <= cap.connected or share == 1:
        return cap
    cap, kbps = cap._replace(connected=since), tenths(limit * share)
    if link is not None or (cap.kbps is not None and cap.kbps <= kbps):
        return cap
    return _reset(cap, limit)._replace(kbps=kbps, provisional=True, idle=max(cap.idle, since), replaced=cap.replaced)


def _reset(cap: LinkCap, limit: Kbps) -> LinkCap:
    """A new cap under a limit, which keeps only the places where limits proved too high, and what it is about."""
    trust = Trust(places=tuple(replace(place, near=False) for place in cap.trust.places))
    known = LastLimit(kbps=limit)
    return LinkCap(trust=trust, connected=cap.connected, measured=cap.measured, predicted=cap.predicted, limit=known)


def believed_limit(cap: LinkCap, limit: Kbps, least_trust: Fraction) -> Kbps:
    """The limit, lowered after limits that proved too high; see `update_cap`."""
    return limit if cap.trust.share == 1 or least_trust == 1 or cap.alone else limit * cap.trust.share


def _doubt_limit(cap: LinkCap, t: float, least: Fraction) -> LinkCap:
    """Doubt the limit after a cut, if it has been too high for some time."""
    last = cap.overuse
    if cap.changed != t or last is None or cap.alone or least == 1:
        return cap
    share = min(Fraction(1), thousandths(BELIEVED * last.carried / last.limit))
    return cap._replace(trust=add_doubt(cap.trust, t, share))


def raise_cap(cap: LinkCap, least: Kbps) -> LinkCap:
    """The cap, but at least the minimum needed to measure the link."""
    return cap._replace(kbps=least) if cap.kbps is not None and cap.kbps < least else cap


def is_fresh(link: LinkMeasured | None, t: float) -> bool:
    """Whether the link has been measured recently."""
    return link is not None and t - link.t <= FRESH_S


def probe(cap: LinkCap, t: float, asked: Kbps, limit: Kbps) -> LinkCap:
    """The cap once only the measurement limits the total: it grows from the last total requested."""
    cap = cap._replace(replaced=t)
    if cap.alone:
        return cap
    kbps = tenths(asked if cap.kbps is None else min(asked, cap.kbps))
    known = tenths(asked if cap.overuse is None else min(asked, cap.overuse.carried))
    return cap._replace(alone=True, kbps=kbps, overuse=Overuse(t, known, limit), steps=0, provisional=False)


def follow(cap: LinkCap, limit: Kbps, is_prediction: bool) -> LinkCap:
    """The cap under a limit of this kind. Only a prediction that rises means that the link carries more than it did."""
    if cap.predicted and is_prediction:
        return cap
    last, before = cap.overuse and cap.overuse._replace(limit=limit), cap.limit._replace(kbps=limit)
    return cap._replace(predicted=is_prediction, overuse=last, limit=before)


def _drained(link: LinkMeasured, carried: Kbps) -> Kbps:
    """Low enough to drain the queue of a link that carries this much."""
    return carried * (capacity.DEEPEST if is_lossy(link) else capacity.drain_share(exact(link.queue_ms or 0)))


def _may_be_jitter(cap: LinkCap, link: LinkMeasured) -> bool:
    """Whether a queue may be jitter: it is short, or has not lasted long enough."""
    if link.state is not LinkState.FILLING or cap.losses.share > LOSSY:
        return False
    return is_short(link) or (cap.stall is None and link.t - cap.short < LASTED_S)


def _cut_by_jitter(cap: LinkCap, link: LinkMeasured, t: float, limit: Kbps, full: Kbps) -> LinkCap:
    """A cut for a queue that may be jitter; none for a short queue if the link is known to carry more than is sent.

    With jitter, at most as much arrives as is sent. Mistaken for the capacity, it would lower the cap repeatedly. At
    the start the link may not yet have carried what is sent, so what arrives is all that is known, unless it is so
    little that not all cameras have started.
    """
    sent = cap.in_force(limit)
    known = cap.overuse.known(full) if cap.overuse else sent
    if cap.overuse and sent <= capacity.RESERVE * known and is_short(link):
        return capacity.raise_known(cap, link, t, full)
    is_all_known = capacity.is_start(cap, t) and (link.kbps or 0) >= capacity.DEEPEST * sent
    return _cut(cap, link, t, limit, full, Fraction(0) if is_all_known else known)


def _cut(cap: LinkCap, link: LinkMeasured, t: float, limit: Kbps, full: Kbps, known: Kbps = Fraction(0)) -> LinkCap:
    """A cut to less than arrives, if one is due.

    full   the limit before doubts
    known  what the link is known to carry under it, although less arrives
    """
    assert link.kbps is not None
    carried = link.kbps
    is_proof = is_lossy(link) or contention.is_narrow(cap, link, t, limit)
    if is_proof and cap.alone:
        cap = contention.note_proof(cap, link, t, limit)
    most = min(cap.most.kbps, limit)
    if is_proof and not contention.burst(cap, link, t):
        most = min(most, PROVEN * carried)
    target = max(_drained(link, carried), contention.yielded(cap, link, t) * most)
    in_outage = capacity.is_of_outage(cap, link, t, full)
    seen = capacity.limit_seen(cap, link, t, full)
    # If not all cameras may have started, or the rate was measured under a lower prediction, it proves little.
    if cap.provisional or in_outage or (cap.predicted and seen < full and is_short(link)):
        target = max(target, capacity.DEEPEST * cap.in_force(limit))
    if not (below := contention.is_below_floors(cap, link, t, limit)):
        target = max(target, cap.floors)
    settled = t - cap.changed >= SETTLE_S + rtt_s(link)
    if target >= cap.in_force(limit) or not (settled or (link.queue_ms or 0) > cap.queue_ms):
        lowered = cap if in_outage else capacity.lower_known(cap, max(carried, known * seen / full), link, t, seen)
        return capacity.raise_known(lowered, link, t, full)
    carried = max(carried, tenths(known * seen / full))
    return cap._replace(
        kbps=tenths(target),
        overuse=cap.overuse if in_outage else capacity.next_overuse(cap, t, carried, seen),
        queue_ms=link.queue_ms or 0.0,
        steps=0,
        changed=t,
        most=cap.most._replace(kbps=most),
        provisional=False,
        below=below,
    )


def _recover(cap: LinkCap, link: LinkMeasured, t: float, limit: Kbps, full: Kbps) -> LinkCap:
    cap = cap._replace(before=link.kbps or cap.before, queue_ms=0.0)
    if cap.kbps is None or cap.kbps >= limit or link.kbps == 0 or t - cap.changed < STEP_S + rtt_s(link):
        return cap  # a cap that is not in force, or under which nothing is sent, is untested, and so does not grow
    steps, factor, last = cap.steps, FAST, cap.overuse
    if capacity.is_start_over(cap, link, t, full):
        return cap  # it does not grow before a rate has been measured under this limit
    is_starting = last is None and capacity.is_start(cap, t)
    # Static pictures may never fill the cap; later it grows although they do not.
    if is_starting or (cap.provisional and BEGIN * (link.kbps or 0) >= cap.kbps):
        factor = _begin_factor(cap.kbps, link)
    elif last:
        factor = min(FAST, capacity.RESERVE * last.known(full) / cap.kbps)
        if capacity.is_start(cap, last.t) or last.t - cap.resumed < capacity.BEGIN_S:
            factor = max(factor, _begin_factor(cap.kbps, link))  # that overuse may understate the link
    if factor < 1 + CAREFUL:
        if is_starting or not _may_probe(cap, link, t, limit):
            return cap
        factor, steps = min(FAST, 1 + CAREFUL * 2 ** (steps // DOUBLING)), steps + 1
    kbps = tenths(cap.kbps * factor)
    if kbps >= limit:
        return cap._replace(kbps=None, provisional=False, steps=steps, changed=t)
    return cap._replace(kbps=kbps, steps=steps, changed=t)


def _begin_factor(kbps: Kbps, link: LinkMeasured) -> Fraction:
    """The factor by which a cap may grow while the capacity is uncertain; 1 or less: not."""
    growth = 1 + (BEGIN - 1) * max(Fraction(0), 1 - exact(link.queue_ms or 0) / BEGIN_MS)
    return min(BEGIN_STEP, growth * (link.kbps or 0) / kbps)


def _may_probe(cap: LinkCap, link: LinkMeasured, t: float, limit: Kbps) -> bool:
    """Whether the cap may grow beyond what the link is known to carry.

    Not soon after the prediction proved too high, nor if static pictures are far from using the cap.
    """
    last = cap.overuse
    if cap.predicted and last and t - last.t < HELD_S and last.carried < capacity.FELL * last.limit:
        return False
    return link.kbps is None or cap.may_send(limit) <= TESTED * link.kbps


def _handle_stall(cap: LinkCap, link: LinkMeasured, t: float, limit: Kbps) -> LinkCap:
    """One cut at first, since most stalls are short; then repeated halving."""
    if cap.stall is None:
        if t - cap.idle < SILENCE_S + rtt_s(link):
            return cap
        arrived = min(cap.in_force(limit), cap.before or limit)
        kbps = max(arrived * capacity.DEEPEST, min(arrived, Fraction(0) if cap.below else cap.floors))
        return cap._replace(kbps=tenths(kbps), stall=Stall(t, 0), changed=t, provisional=False)
    return _halve(cap, cap.stall, t, limit)


def _halve(cap: LinkCap, stall: Stall, t: float, limit: Kbps) -> LinkCap:
    if t - cap.changed < SILENCE_S:
        return cap._replace(stall=stall)
    kbps = tenths(cap.in_force(limit) / 2)
    return cap._replace(kbps=kbps, stall=stall._replace(halved=stall.halved + 1), changed=t, provisional=False)


def _handle_silence(cap: LinkCap, link: LinkMeasured, t: float, limit: Kbps) -> LinkCap:
    """Without a report the link may be down: halve the cap once per silent period.

    Also right after a measurement, which may be old: rules do not see every event.
    """
    longest = max(SILENCE_S, 2 * rtt_s(link) + 3 * REPORT_S)
    if t - max(link.t, cap.changed, cap.idle) < longest:
        return cap
    return _halve(cap, cap.stall or Stall(link.t, 0), t, limit)


def _resume(cap: LinkCap, t: float, limit: Kbps) -> LinkCap:
    """After a stall, unless it was short, the first report with an empty queue restores half of the rate before it."""
    if cap.stall is None:
        return cap
    kbps, was_short = cap.kbps, not cap.stall.halved and cap.resumed < cap.stall.t
    if kbps is None or was_short or not cap.before:
        return cap._replace(stall=None)
    return cap._replace(kbps=max(kbps, min(cap.before, limit) / 2), stall=None, changed=t)
