"""The total that the measured link allows. Pure.

On overuse it is cut immediately below the link's capacity, low enough to drain the queue. It recovers in steps up to
the limit, which is the prediction or the operator's total, and never beyond: the prediction saves probing. Where the
link proved narrower than the limit, recovery is fast up to that capacity, scaled with the limit, and careful beyond.
When an operator connects, the cap starts at a share of the limit.
"""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from typing import NamedTuple

from runner.core.events import LinkMeasured, PositionReported
from runner.core.model import Kbps, exact
from runner.core.trust import FALL_S, LATE_S, UNDOUBTED, Trust, add_doubt, relieve, thousandths, update_trust
from runner.core.uplink import LinkState

DRAIN_MS = 400  # a queue should drain within about this time ...
DEEPEST, SHALLOWEST = Fraction(3, 5), Fraction(19, 20)  # ... by a cut to a share of what the link carries
LOSSY = 0.03  # share of packets lost above which a growing queue is full
LOSS_S = 1.4  # losses are measured over 1 s, and a full queue drains in 0.4 s: until then they do not reflect a cut
TOO_LOSSY = 0.1  # share of packets lost; random loss on the radio link stays below
LOSING_S = 0.3  # a loss share that has only fallen for longer reflects earlier packets: losses have stopped
RESERVE = Fraction(23, 25)  # share of what the link carried up to which recovery is fast
FAST = Fraction(3, 2)  # increase in each step
CAREFUL, DOUBLING = Fraction(1, 50), 8  # first increase beyond that, and the number of steps that double it
HELD_S = 2.0  # after an overuse that proved a prediction too high, until the first careful increase
TESTED = 3  # a cap grows up to this multiple of what arrives
BEGIN_S, BEGIN = 2.0, Fraction(5, 4)  # until then the capacity is too uncertain: the cap is tied to what arrives
SETTLE_S = 0.15  # beyond the round trip, until the effect of a cut shows
REPORT_S = 0.04  # between two reports
STEP_S = 0.1  # of recovery, on top of the round trip
START_S = 5.0  # until the first pictures of all cameras have arrived and are reported
UNMEASURED_S = 2.0  # a present operator that reports nothing for longer does not measure the link
FRESH_S = 1.0  # an older measurement does not replace a prediction
FELL = Fraction(9, 10)  # share of the known capacity below which the link has fallen, or of a prediction: too high
BELIEVED = Fraction(24, 25)  # share of what the link carried that a doubted limit is lowered to
LONGEST_RTT_S = 1.0  # a longer round trip does not delay the recovery further
LEAST = Fraction(50)  # kbit/s; recovery in factors cannot start from 0
# To competing traffic the cameras yield down to this share of the most that arrived recently ...
YIELDED = Fraction(1, 3)
# ... and, once the queue has been long for this many s, to this part of that share ...
EASED_S, EASED = 2.0, Fraction(4, 5)
# ... unless, while a cap was held and the queue was long for this many s, less than this share of the cap arrived, or
# never more than TRIED of it: then the link itself is narrower. Otherwise the encoders may have used less than the cap.
NARROW = ((0.0, Fraction(1, 2)), (1.0, Fraction(4, 5)))
TRIED_S, TRIED = 2.0, Fraction(19, 20)
# Likewise while only the floors are sent; without losses, encoders that use less are the more likely reason.
NARROW_FLOORS = ((0.0, Fraction(1, 2)), (1.0, Fraction(2, 3)), (3.0, Fraction(4, 5)))
# A shorter queue, ms, may be jitter of the radio link or of a busy machine, unless packets are lost: a real overload
# soon makes it longer.
JITTER_MS = 40
# A longer one is real once it has lasted this long, s: delays on a busy machine are shorter.
LASTED_S = 0.3
SEEN_S = 0.4  # beyond the round trip, until a measured rate no longer includes the time before a change of cap or limit
# Without predictions, this often within this many s means that short competing flows keep restarting: each fills the
# queue and drops packets, like a link whose capacity falls. From then on, the share above falls by a third over
# BURST_S while the queue is long, and only after that the link is considered narrow.
OFTEN, OFTEN_S, BURST_S, CONTESTED = 3, 30.0, 2.0, Fraction(2, 3)
PROVEN = 2  # then the most that arrived is limited to this multiple of the capacity
FADED = Fraction(999, 1000)  # factor by which that most decays each second
# A prediction that falls by this factor announces an outage, and one that rises by it ends it. If it is short, what
# arrives meanwhile says nothing about the link after it; nor does less than that share in the first BEGIN_S after it.
OUTAGE, OUTAGE_S = 10, 10.0
SILENCE_S = 0.3  # without a report, or with empty reports, for this long the cap is halved


class Overuse(NamedTuple):
    """The last overuse of the link: its time (t), and the capacity and the limit then, kbit/s.

    fell  whether the link carried clearly less than was known: a limit that follows was only late
    """

    t: float
    carried: Kbps
    limit: Kbps
    fell: bool = False

    def known(self, limit: Kbps) -> Kbps:
        """The capacity under another limit, if both have changed alike."""
        return self.carried * limit / self.limit


class PredictedOutage(NamedTuple):
    """An outage that the prediction announces: since when (t), its limit, kbit/s, and the last overuse before it."""

    t: float
    limit: Kbps
    overuse: Overuse | None


class Lowering(NamedTuple):
    """When the capacity proved lower while no cut was due (t), and the capacity known before, kbit/s."""

    t: float
    known: Kbps


class Proofs(NamedTuple):
    """When the link seemed to be narrow in the last OFTEN_S, once per long queue.

    most  kbit/s that had arrived before the first proof
    t     of the last proof; here losses with a short queue are proofs, too
    """

    times: tuple[float, ...]
    most: Kbps
    t: float


class Stall(NamedTuple):
    """A period in which nothing arrives: its start (t), and how often the cap was halved in it."""

    t: float
    halved: int


class Losses(NamedTuple):
    """Share of packets lost at the last measurement, and when it last rose (t)."""

    share: float
    t: float


class Most(NamedTuple):
    """The most that arrived recently, kbit/s, and when it last decayed (t)."""

    kbps: Kbps
    t: float


class LastLimit(NamedTuple):
    """The last limit, before doubts, kbit/s; when it last rose and fell, and the limits before that."""

    kbps: Kbps = Fraction(0)
    rose: float = -float("inf")
    before_rise: Kbps = Fraction(0)
    fell: float = -float("inf")
    before_fall: Kbps = Fraction(0)

    def followed_by(self, limit: Kbps, t: float) -> LastLimit:
        """The next limit, at time t. Falls in quick succession count as one."""
        if 0 < self.kbps < limit:
            return self._replace(kbps=limit, rose=t, before_rise=self.kbps)
        if limit < self.kbps:
            highest = max(self.kbps, self.before_fall) if t - self.fell <= SEEN_S else self.kbps
            return self._replace(kbps=limit, fell=t, before_fall=highest)
        return self._replace(kbps=limit)


NOTHING, NONE_LOST = Most(Fraction(0), -float("inf")), Losses(0.0, -float("inf"))
NOT_LOWERED = Lowering(-float("inf"), Fraction(0))
NO_PROOFS = Proofs((), Fraction(0), -float("inf"))


class LinkCap(NamedTuple):
    """Memory between measurements.

    kbps        cap in force; None: no cap below the limit
    overuse     the last one
    outage      that the prediction announces; None: none
    resumed     t of the predicted end of the last one
    queue_ms    wait at the last cut
    steps       careful increases since then
    before      kbit/s that arrived when the link was last clear
    stall       None: something arrives
    changed     t of the last change
    measured    t of the last measurement
    replaced    t at which the measurement last replaced a stale prediction
    idle        t at which there was last nothing to send
    alone       whether nothing else limits the total
    predicted   whether the limit is a prediction, not what an operator has set
    reserve     kbit/s of the cap that are left to other traffic
    floors      kbit/s that the cap needs for the floors of all cameras; cuts end there unless the link is narrower
    below       whether it proved to be, since the cap was last above them
    trust       how far the limit is trusted
    most        the most that arrived
    began       t of the first measurement
    passed      t of a change, and the most that has arrived since it took effect, kbit/s
    connected   t of the operator's connection for which the cap last started
    provisional whether it started at a share of the limit, and no measurement has contradicted the limit since
    losses      of packets
    limit       the last one
    short       t at which the queue was last shorter than JITTER_MS
    lowering    the last lowering of the known capacity
    proofs      that the link is narrow
    """

    kbps: Kbps | None = None
    overuse: Overuse | None = None
    outage: PredictedOutage | None = None
    resumed: float = -float("inf")
    queue_ms: float = 0.0
    steps: int = 0
    before: Kbps | None = None
    stall: Stall | None = None
    changed: float = -float("inf")
    measured: float = -float("inf")
    replaced: float = -float("inf")
    idle: float = -float("inf")
    alone: bool = False
    predicted: bool = False
    reserve: Kbps = Fraction(0)
    floors: Kbps = Fraction(0)
    below: bool = False
    trust: Trust = UNDOUBTED
    most: Most = NOTHING
    began: float = float("inf")
    passed: tuple[float, Kbps] = (-float("inf"), Fraction(0))
    connected: float = -float("inf")
    provisional: bool = False
    losses: Losses = NONE_LOST
    limit: LastLimit = LastLimit()
    short: float = -float("inf")
    lowering: Lowering = NOT_LOWERED
    proofs: Proofs = NO_PROOFS


UNCAPPED = LinkCap()


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
        return _reset(cap, limit) if unmeasured > (UNMEASURED_S if has_started else START_S) else cap
    cap, full = _adapt_overuse(_fall_with_limit(cap, t, limit), t, limit), limit
    cap = cap._replace(trust=update_trust(cap.trust, t, least_trust, position))
    limit = believed_limit(cap, limit, least_trust)
    if link.t > cap.measured:
        cap = _handle_measurement(cap, link, t, limit, full, least_trust)
    return _handle_silence(cap, link, t, limit)


def _handle_measurement(
    cap: LinkCap, link: LinkMeasured, t: float, limit: Kbps, full: Kbps, least_trust: Fraction
) -> LinkCap:
    """The cap after a new measurement, under a limit as believed and in full."""
    cap = _record(cap._replace(measured=link.t, began=min(t, cap.began)), link, t)
    if link.state is LinkState.STALLED:
        return _handle_stall(cap, link, t, limit)
    lossy = cap.losses.share > TOO_LOSSY and t - cap.losses.t <= LOSING_S
    unanswered = lossy and t - cap.changed >= LOSS_S + _rtt_s(link)
    if (link.state is LinkState.FILLING or unanswered) and link.kbps:
        if cap.stall and cap.before:  # after a stall the link carries less than before
            cap = cap._replace(before=min(cap.before, link.kbps))
        cut = _cut_by_jitter if _may_be_jitter(cap, link) else _cut
        return _doubt_limit(cut(cap, link, t, limit, full), t, least_trust)
    if link.state is LinkState.CLEAR and not lossy:  # a queue that was full from the start looks empty
        return _recover(_resume(cap, t, limit), link, t, limit, full)
    return _raise_known(cap, link, t, full)


def _fall_with_limit(cap: LinkCap, t: float, limit: Kbps) -> LinkCap:
    """The cap when a prediction falls: a link that carries a constant share of it has fallen, too.

    The cap falls to what is then known to be carried: careful increases end, too. If it has grown far beyond that, the
    known capacity is outdated, and the cap keeps its share of the prediction. It does not fall if the link has fallen
    before, and the prediction follows.
    """
    last, before = cap.overuse, cap.limit.kbps
    if not cap.predicted or cap.kbps is None or last is None or limit >= before:
        return cap
    if last.fell and t - last.t <= LATE_S:
        return cap
    in_force = min(before, cap.kbps)
    same_share, known = in_force * limit / before, min(limit, last.known(limit))
    is_outdated = known < FELL * same_share
    return cap._replace(kbps=_short(same_share if is_outdated else min(in_force, RESERVE * known)))


def _adapt_overuse(cap: LinkCap, t: float, limit: Kbps) -> LinkCap:
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
    if last is None or not last.fell or limit >= last.limit or last.carried >= last.limit or t - last.t > LATE_S:
        return cap
    followed = max(limit, last.carried)
    trust = relieve(cap.trust, last.t, followed / last.limit)
    return cap._replace(overuse=last._replace(limit=followed), trust=trust)


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
    kbps = _short(max(carried / 2, cap.kbps or Fraction(0)))
    return cap._replace(kbps=kbps, queue_ms=float("inf"), steps=0, changed=t)  # the queue is the outage's


def start_cap(cap: LinkCap, link: LinkMeasured | None, since: float | None, limit: Kbps, share: Fraction) -> LinkCap:
    """The cap after an operator connected at `since`: a share of the limit, unless the link is known to carry less.

    All cameras then start with a key frame. At the full limit, a narrower link would lose packets before the first
    measurement.
    """
    if since is None or since <= cap.connected or share == 1:
        return cap
    cap, kbps = cap._replace(connected=since), _short(limit * share)
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
    if cap.alone:
        return cap
    kbps = _short(asked if cap.kbps is None else min(asked, cap.kbps))
    known = _short(asked if cap.overuse is None else min(asked, cap.overuse.carried))
    return cap._replace(alone=True, kbps=kbps, overuse=Overuse(t, known, limit), steps=0, provisional=False)


def end_probe(cap: LinkCap) -> LinkCap:
    """The cap when the limit applies again; `follow` then relates the known capacity to it."""
    return cap._replace(alone=False) if cap.alone else cap


def follow(cap: LinkCap, limit: Kbps, is_prediction: bool) -> LinkCap:
    """The cap under a limit of this kind. Only a prediction that rises means that the link carries more than it did."""
    if cap.predicted and is_prediction:
        return cap
    last, before = cap.overuse and cap.overuse._replace(limit=limit), cap.limit._replace(kbps=limit)
    return cap._replace(predicted=is_prediction, overuse=last, limit=before)


def mark_idle(cap: LinkCap, t: float) -> LinkCap:
    """The cap at time t when there is nothing to send: silence then, or soon after, is no stall."""
    return cap._replace(idle=t)


def _record(cap: LinkCap, link: LinkMeasured, t: float) -> LinkCap:
    """Record the most that arrived recently and since the last change took effect, and the losses."""
    most = cap.most if t - cap.most.t < 1 else Most(_short(cap.most.kbps * FADED), t)
    kbps = link.kbps or Fraction(0)
    since, passed = cap.passed
    passed = passed if since == cap.changed else Fraction(0)
    if t - cap.changed >= SEEN_S + _rtt_s(link):
        passed = max(passed, kbps)
    loss = link.loss or 0.0
    losses = Losses(loss, t if loss > cap.losses.share else cap.losses.t)
    most = most._replace(kbps=max(most.kbps, kbps))
    short = t if _is_short(link) else cap.short
    return cap._replace(most=most, passed=(cap.changed, passed), losses=losses, short=short)


def _is_narrow(cap: LinkCap, link: LinkMeasured, t: float, limit: Kbps) -> bool:
    """Whether less arrives than is sent, so that the link itself is narrow, not filled by competing traffic."""
    assert link.kbps is not None
    if _is_short(link):
        return False
    held_s, sent = t - max(cap.changed, cap.short), _sent(cap, limit)
    if held_s >= TRIED_S and cap.passed[1] < TRIED * sent:
        return True
    return any(held_s >= least_s and link.kbps < share * sent for least_s, share in NARROW)


def _is_below_floors(cap: LinkCap, link: LinkMeasured, t: float, limit: Kbps) -> bool:
    """Whether the link carries less than the floors although no more is sent, so that others are not the reason."""
    if _in_force(cap, limit) > cap.floors:
        return False
    assert link.kbps is not None
    drops = _is_lossy(link)  # the queue of the link itself may be short
    held_s, sent = t - (cap.changed if drops else max(cap.changed, cap.short)), _sent(cap, limit)
    tiers = NARROW if drops else NARROW_FLOORS
    is_proof = any(held_s >= least_s and link.kbps < share * sent for least_s, share in tiers)
    return cap.below or (is_proof and (drops or not _is_short(link)))


def _note_proof(cap: LinkCap, link: LinkMeasured, t: float, limit: Kbps) -> LinkCap:
    """Count a proof that the link is narrow; many show that it is contested instead, and refute the earlier ones.

    One is counted for each long queue. Losses with a short one repeat in every report, and are not counted.
    """
    proofs = cap.proofs
    times = tuple(each for each in proofs.times if t - each <= OFTEN_S)
    most = max(proofs.most, cap.most.kbps) if t - proofs.t <= OFTEN_S else cap.most.kbps
    is_new = not _is_short(link) and not (times and times[-1] > cap.short)
    cap = cap._replace(proofs=Proofs((*times, t)[-OFTEN:] if is_new else times, most, t))
    if not is_new or not _is_contested(cap) or cap.kbps is None:
        return cap
    least = _short(CONTESTED * YIELDED * min(most, limit))
    return cap._replace(most=cap.most._replace(kbps=most), kbps=max(cap.kbps, least))


def _is_contested(cap: LinkCap) -> bool:
    return cap.alone and len(cap.proofs.times) == OFTEN


def _yielded(cap: LinkCap, link: LinkMeasured, t: float) -> Fraction:
    """The share of the most that arrived, below which the cameras do not yield; less after EASED_S of a long queue.

    If the link fell to just that share, the cameras' own queue would never drain. Not on a contested link, whose queue
    others keep full: some cameras would fall below their floors. There it falls by a third over BURST_S instead.
    """
    if _is_contested(cap):
        return YIELDED * (CONTESTED + (1 - CONTESTED) * _burst(cap, link, t))
    return YIELDED * EASED if t - cap.short >= EASED_S else YIELDED


def _burst(cap: LinkCap, link: LinkMeasured, t: float) -> Fraction:
    """How far a long queue may still be a burst of competing traffic: from 1 to 0, in tenths."""
    if not _is_contested(cap):
        return Fraction(0)
    lasted_s = max(0.0, t - cap.short - _rtt_s(link))
    return Fraction(10 - min(10, int(10 * lasted_s / BURST_S)), 10)


def _is_short(link: LinkMeasured) -> bool:
    return (link.queue_ms or 0) < JITTER_MS


def _is_lossy(link: LinkMeasured) -> bool:
    """Whether the full queue drops packets, which hides its true length."""
    return (link.loss or 0) > LOSSY


def _drained(link: LinkMeasured, carried: Kbps) -> Kbps:
    """Low enough to drain the queue of a link that carries this much."""
    drain = 1 - exact(link.queue_ms or 0) / DRAIN_MS
    return carried * (DEEPEST if _is_lossy(link) else max(DEEPEST, min(SHALLOWEST, drain)))


def _may_be_jitter(cap: LinkCap, link: LinkMeasured) -> bool:
    """Whether a queue may be jitter: it is short, or has not lasted long enough."""
    if link.state is not LinkState.FILLING or cap.losses.share > LOSSY:
        return False
    return _is_short(link) or (cap.stall is None and link.t - cap.short < LASTED_S)


def _cut_by_jitter(cap: LinkCap, link: LinkMeasured, t: float, limit: Kbps, full: Kbps) -> LinkCap:
    """A cut for a queue that may be jitter; none for a short queue if the link is known to carry more than is sent.

    With jitter, at most as much arrives as is sent. Mistaken for the capacity, it would lower the cap repeatedly.
    """
    sent = _in_force(cap, limit)
    known = cap.overuse.known(full) if cap.overuse else sent
    if cap.overuse and sent <= RESERVE * known and _is_short(link):
        return _raise_known(cap, link, t, full)
    return _cut(cap, link, t, limit, full, known)


def _cut(cap: LinkCap, link: LinkMeasured, t: float, limit: Kbps, full: Kbps, known: Kbps = Fraction(0)) -> LinkCap:
    """A cut to less than arrives, if one is due.

    full   the limit before doubts
    known  what the link is known to carry under it, although less arrives
    """
    assert link.kbps is not None
    carried = link.kbps
    is_proof = _is_lossy(link) or _is_narrow(cap, link, t, limit)
    if is_proof and cap.alone:
        cap = _note_proof(cap, link, t, limit)
    most = min(cap.most.kbps, limit)
    if is_proof and not _burst(cap, link, t):
        most = min(most, PROVEN * carried)
    target = max(_drained(link, carried), _yielded(cap, link, t) * most)
    in_outage = _is_of_outage(cap, link, t, full)
    if cap.provisional or in_outage:  # not all cameras may have started, so a low rate proves little
        target = max(target, DEEPEST * _in_force(cap, limit))
    if not (below := _is_below_floors(cap, link, t, limit)):
        target = max(target, cap.floors)
    settled, seen = t - cap.changed >= SETTLE_S + _rtt_s(link), _limit_seen(cap, link, t, full)
    if target >= _in_force(cap, limit) or not (settled or (link.queue_ms or 0) > cap.queue_ms):
        lowered = cap if in_outage else _lower_known(cap, max(carried, known * seen / full), link, t, seen)
        return _raise_known(lowered, link, t, full)
    carried = max(carried, _short(known * seen / full))
    return cap._replace(
        kbps=_short(target),
        overuse=cap.overuse if in_outage else _overuse(cap.overuse, t, carried, seen),
        queue_ms=link.queue_ms or 0.0,
        steps=0,
        changed=t,
        most=cap.most._replace(kbps=most),
        provisional=False,
        below=below,
    )


def _overuse(last: Overuse | None, t: float, carried: Kbps, limit: Kbps) -> Overuse:
    """A new overuse after the last one; cuts within FALL_S belong to the same fall of the link."""
    has_fallen = carried < FELL * (last.known(limit) if last else limit)
    return Overuse(t, carried, limit, has_fallen or (last is not None and last.fell and t - last.t < FALL_S))


def _limit_seen(cap: LinkCap, link: LinkMeasured, t: float, limit: Kbps) -> Kbps:
    """The limit under which a rate was measured: after a rise, for some time the one before."""
    return cap.limit.before_rise if _is_recent(cap.limit.rose, link, t) else limit


def _is_of_outage(cap: LinkCap, link: LinkMeasured, t: float, limit: Kbps) -> bool:
    """Whether a rate was measured in a predicted outage, or while one lasts for longer than predicted."""
    lasts = t - cap.resumed < BEGIN_S and limit >= OUTAGE * (link.kbps or 0)
    return cap.predicted and (lasts or limit >= OUTAGE * _limit_seen(cap, link, t, limit))


def _lower_known(cap: LinkCap, carried: Kbps, link: LinkMeasured, t: float, limit: Kbps) -> LinkCap:
    """Lower the known capacity if the link proves to carry less than at its last overuse, and no cut is due."""
    if cap.overuse is None or carried >= (known := cap.overuse.known(limit)):
        return cap
    known = max(known, cap.lowering.known if _is_recent(cap.lowering.t, link, t) else carried)
    return cap._replace(overuse=_known_now(cap.overuse, carried, limit), lowering=Lowering(t, known))


def _raise_known(cap: LinkCap, link: LinkMeasured, t: float, limit: Kbps) -> LinkCap:
    """Raise the known capacity soon after an overuse, while its queue lasts, if more arrives than it.

    Likewise soon after a measurement that lowered it, but not above the value before. After a stall units arrive in
    bursts, and a measurement may include a pause between them. Soon after the prediction fell, a rate may have been
    measured under the one before.
    """
    last = cap.overuse
    if cap.predicted and _is_recent(cap.limit.fell, link, t):
        limit = max(limit, cap.limit.before_fall)
    if last is None or link.kbps is None or link.kbps <= (known := last.known(limit)):
        return cap
    if _is_recent(last.t, link, t):
        return cap._replace(overuse=_known_now(last, link.kbps, limit))
    if _is_recent(cap.lowering.t, link, t):
        return cap._replace(overuse=_known_now(last, max(known, min(link.kbps, cap.lowering.known)), limit))
    return cap


def _known_now(last: Overuse, carried: Kbps, limit: Kbps) -> Overuse:
    """The overuse with what the link carries under the current limit."""
    return last._replace(carried=_short(carried), limit=limit)


def _is_recent(since: float, link: LinkMeasured, t: float) -> bool:
    """Whether a measured rate may still include that time."""
    return t - since <= SEEN_S + _rtt_s(link)


def _recover(cap: LinkCap, link: LinkMeasured, t: float, limit: Kbps, full: Kbps) -> LinkCap:
    cap = cap._replace(before=link.kbps or cap.before, queue_ms=0.0)
    if cap.kbps is None or cap.kbps >= limit or t - cap.changed < STEP_S + _rtt_s(link):
        return cap  # a cap that is not in force is untested, and so does not grow
    if cap.provisional and t - cap.began >= BEGIN_S:  # static pictures may never fill it
        return cap._replace(kbps=None, provisional=False, changed=t)
    if cap.provisional and cap.before is None:
        return cap  # it does not grow before a rate has been measured
    steps, factor, last = cap.steps, FAST, cap.overuse
    if cap.provisional or (last and last.t - cap.began < BEGIN_S):
        factor = min(FAST, BEGIN * (link.kbps or 0) / cap.kbps)
    elif last:
        factor = min(FAST, RESERVE * last.known(full) / cap.kbps)
        if last.t - cap.resumed < BEGIN_S:  # the link may have been recovering
            factor = max(factor, min(BEGIN, BEGIN * (link.kbps or 0) / cap.kbps))
    if factor < 1 + CAREFUL:
        if not _may_probe(cap, link, t, limit):
            return cap
        factor, steps = min(FAST, 1 + CAREFUL * 2 ** (steps // DOUBLING)), steps + 1
    kbps = _short(cap.kbps * factor)
    if kbps >= limit:
        return cap._replace(kbps=None, provisional=False, steps=steps, changed=t)
    return cap._replace(kbps=kbps, steps=steps, changed=t)


def _may_probe(cap: LinkCap, link: LinkMeasured, t: float, limit: Kbps) -> bool:
    """Whether the cap may grow beyond what the link is known to carry.

    Not soon after the prediction proved too high, nor if static pictures are far from using the cap.
    """
    last = cap.overuse
    if cap.predicted and last and t - last.t < HELD_S and last.carried < FELL * last.limit:
        return False
    return link.kbps is None or _sent(cap, limit) <= TESTED * link.kbps


def _handle_stall(cap: LinkCap, link: LinkMeasured, t: float, limit: Kbps) -> LinkCap:
    """One cut at first, since most stalls are short; then repeated halving."""
    if cap.stall is None:
        if t - cap.idle < SILENCE_S + _rtt_s(link):
            return cap
        arrived = min(_in_force(cap, limit), cap.before or limit)
        kbps = max(arrived * DEEPEST, min(arrived, Fraction(0) if cap.below else cap.floors))
        return cap._replace(kbps=_short(kbps), stall=Stall(t, 0), changed=t, provisional=False)
    return _halve(cap, cap.stall, t, limit)


def _halve(cap: LinkCap, stall: Stall, t: float, limit: Kbps) -> LinkCap:
    if t - cap.changed < SILENCE_S:
        return cap._replace(stall=stall)
    kbps = _short(_in_force(cap, limit) / 2)
    return cap._replace(kbps=kbps, stall=stall._replace(halved=stall.halved + 1), changed=t, provisional=False)


def _handle_silence(cap: LinkCap, link: LinkMeasured, t: float, limit: Kbps) -> LinkCap:
    """Without a report the link may be down: halve the cap once per silent period.

    Also right after a measurement, which may be old: rules do not see every event.
    """
    longest = max(SILENCE_S, 2 * _rtt_s(link) + 3 * REPORT_S)
    if t - max(link.t, cap.changed, cap.idle) < longest:
        return cap
    return _halve(cap, cap.stall or Stall(link.t, 0), t, limit)


def _resume(cap: LinkCap, t: float, limit: Kbps) -> LinkCap:
    """After a stall, unless it was short, the first report with an empty queue restores half of the rate before it."""
    if cap.stall is None:
        return cap
    kbps, is_short = cap.kbps, not cap.stall.halved and cap.resumed < cap.stall.t
    if kbps is None or is_short or not cap.before:
        return cap._replace(stall=None)
    return cap._replace(kbps=max(kbps, min(cap.before, limit) / 2), stall=None, changed=t)


def _rtt_s(link: LinkMeasured) -> float:
    return min((link.rtt_ms or 0.0) / 1000, LONGEST_RTT_S)


def _in_force(cap: LinkCap, limit: Kbps) -> Kbps:
    return limit if cap.kbps is None else min(cap.kbps, limit)


def _sent(cap: LinkCap, limit: Kbps) -> Kbps:
    """What the cameras may send: a cap in force leaves its reserve to others."""
    return limit if cap.kbps is None else min(limit, max(LEAST, cap.kbps - cap.reserve))


def _short(kbps: Kbps) -> Kbps:
    """Round down to 0.1 kbit/s: fractions from many multiplications would grow long."""
    return max(LEAST, Fraction(kbps.numerator * 10 // kbps.denominator, 10))
