"""The total that the measured link allows. Pure.

Overuse cuts it at once below what the link carries, low enough to drain the queue. It recovers in factors up to the
limit, which is the prediction or the operator's total, and never beyond: the prediction saves the probing. Where the
link proved narrower than the limit, recovery is fast up to what it carried, in proportion to the limit of that time,
and careful from there on.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from fractions import Fraction

from runner.core.events import LinkMeasured
from runner.core.model import Kbps, exact
from runner.core.uplink import LinkState

DRAIN_MS = 400  # a queue is to be drained within about this time ...
DEEPEST, SHALLOWEST = Fraction(3, 5), Fraction(19, 20)  # ... by a cut to a share of what the link carries
TOO_LOSSY = 0.1  # share of packets; random loss on the radio link stays below
RESERVE = Fraction(23, 25)  # share of what the link carried up to which recovery is fast
FAST = Fraction(3, 2)  # increase in each step
CAREFUL, DOUBLING = Fraction(1, 50), 5  # first increase beyond that, and the number of steps that double it
SETTLE_S = 0.15  # beyond the round trip, until the effect of a cut shows
REPORT_S = 0.04  # between two reports
STEP_S = 0.1  # of recovery, on top of the round trip
LEAST = Fraction(50)  # kbit/s; from nothing no factor would recover
SILENCE_S = 0.3  # without a report, or with reports of nothing, for this long: half


@dataclass(frozen=True, slots=True)
class LinkCap:
    """Memory between measurements.

    kbps      cap in force; None: nothing speaks against the limit
    carried   kbit/s that the link carried when it was last overused, and the limit at that time
    queue_ms  wait at the last cut
    steps     careful increases since then
    before    kbit/s that arrived when the link was last clear
    stalled   t at which nothing arrived any more; None: something arrives
    halved    how often the cap was halved since then
    changed   t of the last change
    measured  t of the last measurement
    """

    kbps: Kbps | None = None
    carried: tuple[Kbps, Kbps] | None = None
    queue_ms: float = 0.0
    steps: int = 0
    before: Kbps | None = None
    stalled: float | None = None
    halved: int = 0
    changed: float = -float("inf")
    measured: float = -float("inf")


UNCAPPED = LinkCap()


def advanced(cap: LinkCap, link: LinkMeasured | None, t: float, limit: Kbps) -> LinkCap:
    """The cap at time t under a limit, with the newest measurement."""
    if link is None:
        return cap
    if link.t <= cap.measured:
        return _silent(cap, link, t, limit)
    cap = replace(cap, measured=link.t)
    if link.state is LinkState.STALLED:
        return _stalled(cap, t, limit)
    if (link.state is LinkState.FILLING or (link.loss or 0) > TOO_LOSSY) and link.kbps:
        return _cut(cap, link, t, limit)
    if link.state is LinkState.CLEAR:
        return _recovered(_resumed(cap, limit), link, t, limit)
    return cap


def _cut(cap: LinkCap, link: LinkMeasured, t: float, limit: Kbps) -> LinkCap:
    assert link.kbps is not None
    drain = 1 - exact(link.queue_ms or 0) / DRAIN_MS
    target = link.kbps * max(DEEPEST, min(SHALLOWEST, drain))
    settled = t - cap.changed >= SETTLE_S + (link.rtt_ms or 0) / 1000
    if target >= _in_force(cap, limit) or not (settled or (link.queue_ms or 0) > cap.queue_ms):
        return cap
    return replace(
        cap, kbps=_short(target), carried=(link.kbps, limit), queue_ms=link.queue_ms or 0.0, steps=0, changed=t
    )


def _recovered(cap: LinkCap, link: LinkMeasured, t: float, limit: Kbps) -> LinkCap:
    cap = replace(cap, before=link.kbps or cap.before, queue_ms=0.0)
    if cap.kbps is None or cap.kbps >= limit or t - cap.changed < STEP_S + (link.rtt_ms or 0) / 1000:
        return cap  # a cap that is not in force is not tested, and so does not grow
    steps, factor = cap.steps, FAST
    if cap.carried:
        carried, limit_then = cap.carried
        factor = min(FAST, RESERVE * carried * limit / limit_then / cap.kbps)
        if factor < 1 + CAREFUL:
            factor, steps = min(FAST, 1 + CAREFUL * 2 ** (steps // DOUBLING)), steps + 1
    kbps = _short(cap.kbps * factor)
    return replace(cap, kbps=None if kbps >= limit else kbps, steps=steps, changed=t)


def _stalled(cap: LinkCap, t: float, limit: Kbps) -> LinkCap:
    """One cut at first, since most stalls are short; then half again and again."""
    if cap.stalled is None:
        arrived = min(_in_force(cap, limit), cap.before or limit)
        return replace(cap, kbps=_short(arrived * DEEPEST), stalled=t, halved=0, changed=t)
    return _halved(cap, t, limit)


def _halved(cap: LinkCap, t: float, limit: Kbps) -> LinkCap:
    if t - cap.changed < SILENCE_S:
        return cap
    return replace(cap, kbps=_short(_in_force(cap, limit) / 2), halved=cap.halved + 1, changed=t)


def _silent(cap: LinkCap, link: LinkMeasured, t: float, limit: Kbps) -> LinkCap:
    """Without a report the link may be gone: half, once for each such time."""
    longest = max(SILENCE_S, 2 * (link.rtt_ms or 0) / 1000 + 3 * REPORT_S)
    if t - max(link.t, cap.changed) < longest:
        return cap
    return _halved(replace(cap, stalled=link.t if cap.stalled is None else cap.stalled), t, limit)


def _resumed(cap: LinkCap, limit: Kbps) -> LinkCap:
    """The first report after a stall that shows an empty queue restores half of what arrived before."""
    if cap.stalled is None:
        return cap
    kbps = cap.kbps
    if kbps is not None and cap.halved and cap.before:
        kbps = max(kbps, min(cap.before, limit) / 2)
    return replace(cap, kbps=kbps, stalled=None, halved=0)


def _in_force(cap: LinkCap, limit: Kbps) -> Kbps:
    return limit if cap.kbps is None else min(cap.kbps, limit)


def _short(kbps: Kbps) -> Kbps:
    """Rounded down to 0.1 kbit/s: products of many factors would become long numbers."""
    return max(LEAST, Fraction(kbps.numerator * 10 // kbps.denominator, 10))
