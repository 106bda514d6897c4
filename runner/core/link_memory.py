"""What the cap on the total remembers between measurements of the link. Pure."""

from __future__ import annotations

from fractions import Fraction
from typing import NamedTuple

from runner.core.events import LinkMeasured
from runner.core.model import Kbps
from runner.core.trust import UNDOUBTED, Trust

LEAST = Fraction(50)  # kbit/s; recovery in factors cannot start from 0
LOSSY = 0.03  # share of packets lost above which a growing queue is full
# A shorter queue, ms, may be jitter of the radio link or of a busy machine, unless packets are lost: a real overload
# soon makes it longer.
JITTER_MS = 40
SEEN_S = 0.4  # beyond the round trip, until a measured rate no longer includes the time before a change of cap or limit
FADED = Fraction(999, 1000)  # factor by which the most that arrived decays each second
LONGEST_RTT_S = 1.0  # a longer round trip does not delay the recovery further


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

    t: float = -float("inf")
    known: Kbps = Fraction(0)


class Proofs(NamedTuple):
    """When the link seemed to be narrow in the last `link_contention.OFTEN_S`, once per long queue.

    most  kbit/s that had arrived before the first proof
    t     of the last proof; here losses with a short queue are proofs, too
    """

    times: tuple[float, ...] = ()
    most: Kbps = Fraction(0)
    t: float = -float("inf")


class Stall(NamedTuple):
    """A period in which nothing arrives: its start (t), and how often the cap was halved in it."""

    t: float
    halved: int


class Losses(NamedTuple):
    """Share of packets lost at the last measurement, and when it last rose (t)."""

    share: float = 0.0
    t: float = -float("inf")


class Most(NamedTuple):
    """The most that arrived recently, kbit/s, and when it last decayed (t)."""

    kbps: Kbps = Fraction(0)
    t: float = -float("inf")


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
    unfilled    t at which it was last not full: short, or without losses
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
    most: Most = Most()
    began: float = float("inf")
    passed: tuple[float, Kbps] = (-float("inf"), Fraction(0))
    connected: float = -float("inf")
    provisional: bool = False
    losses: Losses = Losses()
    limit: LastLimit = LastLimit()
    short: float = -float("inf")
    unfilled: float = -float("inf")
    lowering: Lowering = Lowering()
    proofs: Proofs = Proofs()

    def in_force(self, limit: Kbps) -> Kbps:
        return limit if self.kbps is None else min(self.kbps, limit)

    def may_send(self, limit: Kbps) -> Kbps:
        """What the cameras may send: a cap in force leaves its reserve to others."""
        return limit if self.kbps is None else min(limit, max(LEAST, self.kbps - self.reserve))


UNCAPPED = LinkCap()


def record(cap: LinkCap, link: LinkMeasured, t: float) -> LinkCap:
    """Record the most that arrived recently and since the last change took effect, and the losses."""
    most = cap.most if t - cap.most.t < 1 else Most(tenths(cap.most.kbps * FADED), t)
    kbps = link.kbps or Fraction(0)
    since, passed = cap.passed
    passed = passed if since == cap.changed else Fraction(0)
    if t - cap.changed >= SEEN_S + rtt_s(link):
        passed = max(passed, kbps)
    loss = link.loss or 0.0
    losses = Losses(loss, t if loss > cap.losses.share else cap.losses.t)
    most = most._replace(kbps=max(most.kbps, kbps))
    short = t if is_short(link) else cap.short
    unfilled = cap.unfilled if is_lossy(link) and not is_short(link) else t
    return cap._replace(most=most, passed=(cap.changed, passed), losses=losses, short=short, unfilled=unfilled)


def rtt_s(link: LinkMeasured) -> float:
    return min((link.rtt_ms or 0.0) / 1000, LONGEST_RTT_S)


def is_short(link: LinkMeasured) -> bool:
    return (link.queue_ms or 0) < JITTER_MS


def is_lossy(link: LinkMeasured) -> bool:
    """Whether the full queue drops packets, which hides its true length."""
    return (link.loss or 0) > LOSSY


def tenths(kbps: Kbps) -> Kbps:
    """Round down to 0.1 kbit/s: fractions from many multiplications would grow long."""
    return max(LEAST, Fraction(kbps.numerator * 10 // kbps.denominator, 10))
