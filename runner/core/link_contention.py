"""Whether the link itself is narrow, or filled by competing traffic, to which the cameras yield only so far. Pure."""

from __future__ import annotations

from fractions import Fraction

from runner.core.events import LinkMeasured
from runner.core.link_memory import LinkCap, Proofs, is_lossy, is_short, rtt_s, tenths
from runner.core.model import Kbps

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
# Competing TCP flows back off after losses. A long queue that loses packets for longer is full of the floors alone.
FULL_S = 8.0
# Without predictions, this often within this many s means that short competing flows keep restarting: each fills the
# queue and drops packets, like a link whose capacity falls. From then on, the share above falls by a third over
# BURST_S while the queue is long, and only after that the link is considered narrow.
OFTEN, OFTEN_S, BURST_S, CONTESTED = 3, 30.0, 2.0, Fraction(2, 3)


def is_narrow(cap: LinkCap, link: LinkMeasured, t: float, limit: Kbps) -> bool:
    """Whether less arrives than is sent, so that the link itself is narrow, not filled by competing traffic."""
    assert link.kbps is not None
    if is_short(link):
        return False
    held_s, sent = t - max(cap.changed, cap.short), cap.may_send(limit)
    if held_s >= TRIED_S and cap.passed[1] < TRIED * sent:
        return True
    return any(held_s >= least_s and link.kbps < share * sent for least_s, share in NARROW)


def is_below_floors(cap: LinkCap, link: LinkMeasured, t: float, limit: Kbps) -> bool:
    """Whether the link carries less than the floors although no more is sent, so that others are not the reason."""
    if cap.in_force(limit) > cap.floors:
        return False
    assert link.kbps is not None
    drops = is_lossy(link)  # the queue of the link itself may be short
    held_s, sent = t - (cap.changed if drops else max(cap.changed, cap.short)), cap.may_send(limit)
    tiers = NARROW if drops else NARROW_FLOORS
    is_proof = any(held_s >= least_s and link.kbps < share * sent for least_s, share in tiers)
    is_full = t - max(cap.began, cap.changed, cap.unfilled) >= FULL_S
    return cap.below or is_full or (is_proof and (drops or not is_short(link)))


def note_proof(cap: LinkCap, link: LinkMeasured, t: float, limit: Kbps) -> LinkCap:
    """Count a proof that the link is narrow; many show that it is contested instead, and refute the earlier ones.

    One is counted for each long queue. Losses with a short one repeat in every report, and are not counted.
    """
    proofs = cap.proofs
    times = tuple(each for each in proofs.times if t - each <= OFTEN_S)
    most = max(proofs.most, cap.most.kbps) if t - proofs.t <= OFTEN_S else cap.most.kbps
    is_new = not is_short(link) and not (times and times[-1] > cap.short)
    cap = cap._replace(proofs=Proofs((*times, t)[-OFTEN:] if is_new else times, most, t))
    if not is_new or not _is_contested(cap) or cap.kbps is None:
        return cap
    least = tenths(CONTESTED * YIELDED * min(most, limit))
    return cap._replace(most=cap.most._replace(kbps=most), kbps=max(cap.kbps, least))


def _is_contested(cap: LinkCap) -> bool:
    return cap.alone and len(cap.proofs.times) == OFTEN


def yielded(cap: LinkCap, link: LinkMeasured, t: float) -> Fraction:
    """The share of the most that arrived, below which the cameras do not yield; less after EASED_S of a long queue.

    If the link fell to just that share, the cameras' own queue would never drain. Not on a contested link, whose queue
    others keep full: some cameras would fall below their floors. There it falls by a third over BURST_S instead.
    """
    if _is_contested(cap):
        return YIELDED * (CONTESTED + (1 - CONTESTED) * burst(cap, link, t))
    return YIELDED * EASED if t - cap.short >= EASED_S else YIELDED


def burst(cap: LinkCap, link: LinkMeasured, t: float) -> Fraction:
    """How far a long queue may still be a burst of competing traffic: from 1 to 0, in tenths."""
    if not _is_contested(cap):
        return Fraction(0)
    lasted_s = max(0.0, t - cap.short - rtt_s(link))
    return Fraction(10 - min(10, int(10 * lasted_s / BURST_S)), 10)
