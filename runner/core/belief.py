"""One belief about the capacity of the uplink, and the total that follows from it. Pure.

What is believed of x = ln(capacity in kbit/s) is normal: mean m, variance v. Reports of the operator's side are
measurements of it (a Kalman filter). A prediction is evidence, too, as far as predictions proved right; see
`runner.core.learned`. It is never a limit.

The total is the believed capacity less a margin, which is learned so that the standing queue is longer than GOAL_S for
the share TAIL of the time (adaptive conformal inference; Gibbs and Candès 2021), and less what drains a queue.
"""

from __future__ import annotations

from math import exp, inf, log, log1p
from statistics import median
from typing import NamedTuple

from runner.core import history
from runner.core.events import Evidence
from runner.core.evidence import JITTER_S, REPORT_S
from runner.core.history import History, recorded, value_at
from runner.core.learned import HORIZON_S, MEMORY_S, WRONG, Learned
from runner.core.policer import Losses, Policer, police

LEAST_JITTER_S = JITTER_S / 2  # of an arrival, once learned
LONGEST_S = 0.3  # a report that comes later counts as if it came after this time
DRIFT = 0.02  # variance that a second adds to x while innovations are white
HIGHEST_STEP = 0.4  # ln: a burst is never taken for more than 1.5 times the capacity
RARE = 0.25  # a service is never expected to take less than this share of the time it took
GOAL_S, TAIL = 0.02, 0.04  # a standing queue, and the share of the time for which it may be longer
ADAPT = 0.5  # 1/s: how fast the margin answers
THIN, THICK = 0.05, 0.2  # least and greatest margin, ln; a larger change is one of the link
OPTIMISM = (
    0.1  # ln: by so much more is sent after HORIZON_S in which no frame waited; after twice the time, twice as much
)
CREDIT, MOST_CREDIT_KBIT = 0.3, 80.0  # weight of one comparison of trains with the rate of the busy link, and its limit
FORGET = 10.0  # times slower is a credit forgotten than learned: one that is too low lets the total overshoot
AT_ONCE = 0.75  # share of a train: if so much of it passed at once, a longer one might have, too
YIELDED = 1 / 3  # of the best capacity: competing traffic gets no more than the rest
BEST_S = 60.0  # memory of the best capacity
LOSSY, LOSS_S = 0.1, 0.5  # share of losses, in this time, that random loss does not reach
MANY = 5  # reports with trains of a busy link, in LOSS_S: with more, their median tells the link's own rate
STUCK_S = 2.0  # a queue that is constant for this long while the link is not busy is a longer path
LASTING_S = 1.0  # of a total that is worth new sizes: each begins with a key frame, several times as large as others
HALVE_S = 0.2  # in which the total is halved while nothing arrives
ABSENT_S = 0.3  # without a report for longer, perhaps nothing arrives
LOWEST = 50.0  # kbit/s: with less nothing is measured
STEADY = 0.015  # a change of the total by less than this share is not worth commands to all encoders
NO_TRAINS = (0.0, 0.0, 0)


class Arrived(NamedTuple):
    """Of one report: standing queue and longest wait, s; received and lost, kbit."""

    queue: float
    longest: float
    kbit: float
    lost: float


class Belief(NamedTuple):
    """State after the events until t.

    since       when the operator connected
    m, v        mean and variance of x
    most        kbit/s: nothing asks for more
    total       kbit/s on the wire that may be sent
    totals      those of the last LASTING_S, one for each decision
    learned     of predictions
    innovation  what remained of the last surprise
    before      that of the previous report
    noise       variance of the error of an arrival time, s^2
    margin      ln
    best        the best recent x
    queue       standing queue, s
    longer      s by which a path has become longer, which looks like a queue
    loss        share of what was sent in the last LOSS_S
    forward     sum of all changes of m by predictions
    reported, observed, waited  times of the last report, of the last with frames, and of the last with a frame that
                found the link busy
    busy        the rate of the link when it was last busy, kbit/s
    credit      kbit that an idle link passes at once
    trains      (kbit, s, number) of the trains of an idle link since `waited`
    within      the rates of the trains of a busy link in the last LOSS_S, one for each report, kbit/s
    """

    t: float
    since: float
    m: float
    v: float
    most: float
    total: float
    learned: Learned
    innovation: float = 0.0
    before: float = 0.0
    noise: float = JITTER_S**2
    margin: float = THIN
    best: float = -inf
    queue: float = 0.0
    longer: float = 0.0
    loss: float = 0.0
    forward: float = 0.0
    reported: float = 0.0
    observed: float = 0.0
    waited: float = 0.0
    busy: float = 0.0
    credit: float = 0.0
    trains: tuple[float, float, int] = NO_TRAINS
    policer: Policer = Policer()
    within: History[float] = ()
    totals: History[float] = ()
    levels: History[float] = ()
    forwards: History[float] = ((-inf, 0.0),)
    arrived: History[Arrived] = ()

    @property
    def lasting(self) -> float:
        """The usual total of the last LASTING_S, kbit/s: a short fall is not worth smaller pictures."""
        return median(total for _, total in self.totals) if self.totals else self.total

    @property
    def kbps(self) -> float:
        """The believed capacity."""
        return exp(self.m)


def begin(
    t: float, start: float, most: float, prediction: float | None, bias: float = 0.0, error: float = WRONG
) -> Belief:
    """Before the first report.

    start        kbit/s that are sent until then
    prediction   kbit/s; None: there is none
    bias, error  of predictions, as their source states them: mean and deviation of ln(capacity / prediction)
    """
    ln = None if prediction is None else _ln(prediction, most)
    m, v = (log(max(LOWEST, start)), 1.0) if ln is None else (min(_highest(most), ln + bias), error * error)
    learned = Learned(ln).starting(bias, error).stated(t, ln)
    return Belief(t, t, m, v, most, start, learned, best=m, reported=t, observed=t, waited=t)


def predict(b: Belief, t: float, prediction: float | None, bias: float = 0.0, error: float = WRONG) -> Belief:
    """After a prediction for t, kbit/s; None: there is none, or it is too old. Others as for `begin`."""
    ln, known = None if prediction is None else _ln(prediction, b.most), b.learned.starting(bias, error)
    if ln is not None and known.ln is not None and ln != known.ln:
        m, v = known.followed(b.m, b.v, ln)
        step = min(_highest(b.most), m) - b.m
        forward = b.forward + step
        forwards = recorded(b.forwards, t, forward, 1.0)
        best = b.best + min(0.0, step)  # one that is too high would raise it again and again
        b = b._replace(m=b.m + step, v=min(1.0, v), best=best, forward=forward, forwards=forwards)
    return b._replace(learned=known.stated(t, ln)) if ln != known.ln else b


def observe(b: Belief, t: float, seen: Evidence, rtt_s: float) -> Belief:
    """After a report that reached the vehicle at t."""
    dt = min(LONGEST_S, t - b.t)
    b = b._replace(v=min(1.0, b.v + DRIFT * dt), t=t, reported=t)
    if seen.kbit:
        weighed = _weigh(_measure_queue(b, seen), seen, rtt_s)
        b = weighed._replace(m=min(weighed.m, b.m + HIGHEST_STEP), observed=t)
    elif not seen.silent_s and t - b.observed > ABSENT_S:
        # Too little for any camera to be sent: nothing is measured until more is tried.
        b = b._replace(m=min(_highest(b.most), b.m + OPTIMISM * dt / HORIZON_S))
    b = b._replace(levels=recorded(b.levels, t, b.m, 1.0))
    return b._replace(learned=b.learned.judged(t, dt, b.levels)) if seen.kbit else b


def decide(b: Belief, t: float, silent_s: float, floors: float = 0.0, ceiling: float = inf) -> Belief:
    """With the total for t.

    silent_s  for which nothing has arrived although something is on its way
    floors    kbit/s that the cameras need at least
    """
    silent_s = max(silent_s, t - b.reported - ABSENT_S, 0.0)
    # A queue that was there before the first frame is seen by its losses only.
    drain = YIELDED if b.loss > LOSSY else max(YIELDED, min(1.0, 1 - (b.queue - JITTER_S) / HORIZON_S))
    total = exp(b.m - b.margin) * drain
    link = _link(b)
    total = max(total, YIELDED * exp(link), min(floors, exp(link - THICK)))
    total = min(total, b.policer.kbps * exp(-THIN))
    total = max(LOWEST, total * 2 ** (-silent_s / HALVE_S))
    limit = min(b.most, ceiling)
    is_same = abs(total - b.total) < STEADY * b.total and max(total, b.total) <= limit
    total = b.total if is_same else min(total, limit)
    is_new = not b.totals or t > b.totals[-1][0]
    return b._replace(total=total, totals=recorded(b.totals, t, total, LASTING_S) if is_new else b.totals)


def _ln(kbps: float, most: float) -> float:
    return min(_highest(most), log(max(LOWEST, kbps)))


def _highest(most: float) -> float:
    """x above which all that is asked for may be sent, whatever the margin."""
    return log(most) + THICK


# --- queue, losses and margin -----------------------------------------------------------------------------------------


def _measure_queue(b: Belief, seen: Evidence) -> Belief:
    dt = min(LONGEST_S, b.t - b.observed)
    longer = min(b.longer, seen.wait_s)
    queue = seen.wait_s - longer
    arrived = recorded(b.arrived, b.t, Arrived(queue, seen.longest_s - longer, seen.kbit, seen.lost_kbit), STUCK_S)
    recent = [of for at, of in arrived if at > b.t - LOSS_S]
    lost = sum(of.lost for of in recent)
    # Losses of a queue that was full when its path was first measured look like a policer's, until it drains.
    policer = Policer(usual=b.policer.usual) if seen.shorter_s > GOAL_S else b.policer
    if seen.backlog and policer.kbps == inf:  # nor does what a stalled link loses count
        policer = policer._replace(since=b.t)
    b = b._replace(
        policer=policer,
        longer=longer,
        queue=queue,
        arrived=arrived,
        loss=lost / (lost + sum(of.kbit for of in recent)),
    )
    b = b._replace(policer=police(policer, b.t, _losses(b, arrived, dt)))
    return _widen(b._replace(arrived=(), longer=longer + queue, queue=0.0) if _is_stuck(b) else b, dt, seen.backlog)


def _losses(b: Belief, arrived: History[Arrived], dt: float) -> Losses:
    newest = arrived[-1][1]
    recent = [of for at, of in arrived if at > b.policer.since]
    kbit, lost = sum(of.kbit for of in recent), sum(of.lost for of in recent)
    queued = any(of.longest > GOAL_S for _, of in arrived)
    rate = max(_rate(arrived, b.t, LOSS_S), _rate(arrived, b.t, STUCK_S))
    return Losses(newest.kbit, newest.lost, kbit, lost, rate, queued, dt)


def _rate(arrived: History[Arrived], t: float, within_s: float) -> float:
    """Received in the last seconds, kbit/s; 0: too little is known."""
    return history.rate(tuple((at, of.kbit) for at, of in arrived), t, within_s)


def _is_stuck(b: Belief) -> bool:
    """Whether the queue is none: it stays as it is although the link is not busy."""
    queues = [of.queue for _, of in b.arrived]
    is_constant = min(queues) > GOAL_S and max(queues) - min(queues) < 2 * JITTER_S
    if not is_constant or b.t - b.arrived[0][0] < 0.9 * STUCK_S or b.loss > LOSSY / 2:
        return False
    return _rate(b.arrived, b.t, STUCK_S) < exp(b.m - THICK)


def _widen(b: Belief, dt: float, backlog: bool) -> Belief:
    """The margin, so that the queue is longer than its goal for the allowed share of the time."""
    before = value_at(b.levels, b.t - 2 * HORIZON_S)
    fell = before is not None and b.m < before - THICK  # no margin would have helped
    missed = b.queue > GOAL_S and not fell and not backlog
    return b._replace(margin=min(THICK, max(THIN, b.margin + ADAPT * (missed - TAIL) * dt)))


# --- capacity ---------------------------------------------------------------------------------------------------------


def _weigh(b: Belief, seen: Evidence, rtt_s: float) -> Belief:
    """The belief after what the link carried, at any load."""
    served = b.t - rtt_s - seen.age_s
    # Changes of the prediction since these frames were served do not apply to them.
    later = b.forward - (value_at(b.forwards, served) or 0.0) if b.forwards[-1][0] > served else 0.0
    kbps = exp(b.m - later)
    b = b._replace(before=b.innovation)
    if seen.busy_kbit and seen.busy_s:
        b = _weigh_busy(b, seen, kbps)
    if seen.trains and seen.train_kbit:
        expected_s = seen.train_kbit / kbps
        surprise = _surprise(expected_s, seen.train_s)
        b = _weigh_trains(b, surprise, expected_s, seen.train_s, seen.trains, seen.backlog)
    least = seen.idle_kbit - seen.idle * b.credit
    if least > seen.idle_kbit / 2:
        slower = _surprise(seen.idle_kbit / kbps, seen.idle_s)
        surprise = slower if slower < 0 else max(0.0, _surprise(least / kbps, seen.idle_s))
        b = _weigh_trains(b, surprise, seen.idle_kbit / kbps, seen.idle_s, seen.idle, seen.backlog)
    elif not seen.busy_kbit and seen.unqueued and not seen.backlog:
        b = _send_more(b)
    if b.loss > LOSSY and not (seen.busy_kbit or seen.trains or seen.idle):
        # No frame is whole: what arrives is what the link carries.
        b = b._replace(m=min(b.m, log(max(LOWEST, _rate(b.arrived, b.t, LOSS_S)))))
    if seen.idle:
        kbit, took_s, number = b.trains
        b = b._replace(trains=(kbit + seen.idle_kbit, took_s + seen.idle_s, number + seen.idle))
    return _contend(b, seen)


def _weigh_busy(b: Belief, seen: Evidence, kbps: float) -> Belief:
    credit, (kbit, took_s, number) = b.credit, b.trains
    busy = seen.busy_kbit / seen.busy_s
    if number and b.t - b.waited < STUCK_S:
        # What these trains got at once. A link that changed meanwhile is no reason: the faster rate is the one to meet.
        saved = (kbit - took_s * max(busy, b.busy)) / number
        if saved > AT_ONCE * kbit / number:  # the whole train: longer ones may pass at once, too
            saved = max(credit, 2 * saved)
        saved = max(0.0, min(MOST_CREDIT_KBIT, saved))
        credit += (CREDIT if saved > credit else CREDIT / FORGET) * (saved - credit)
    b = b._replace(waited=b.t, busy=busy, credit=credit, trains=NO_TRAINS)
    surprise = _surprise(seen.busy_kbit / kbps, seen.busy_s)
    # It lies between two arrivals, each with its error.
    after = _update(b, surprise, seen.busy_kbit / kbps, seen.busy_s, 2, seen.backlog)
    is_steady = abs(seen.growth) * REPORT_S < JITTER_S and b.loss < LOSSY
    if surprise < 0 and is_steady:  # A longer path looks as busy, and as narrow as what is sent.
        rate = _rate(b.arrived, b.t, HORIZON_S)
        least = min(b.m, log(rate) + b.margin) if rate else b.m
        return after._replace(m=max(after.m, least))
    return after


def _weigh_trains(b: Belief, surprise: float, expected_s: float, seen_s: float, number: int, backlog: bool) -> Belief:
    b = _update(b, surprise, expected_s, seen_s, number, backlog)
    # Others send between frames, not within one: the link itself is narrower.
    is_narrow = surprise < 0 and _rate_within(b) is None
    return b._replace(best=max(b.m, (b.best + b.m) / 2)) if is_narrow else b


def _send_more(b: Belief) -> Belief:
    """While no frame waits, the link carries more than is sent; the longer, the more."""
    since = b.t - b.waited
    if since < HORIZON_S or not (rate := _rate(b.arrived, b.t, HORIZON_S)):
        return b
    step = min(HIGHEST_STEP, OPTIMISM * since / HORIZON_S)
    more = min(_highest(b.most), log(rate) + b.margin + step) - b.m
    return b._replace(m=b.m + more, v=min(1.0, b.v + more * more)) if more > 0 else b


def _surprise(expected_s: float, seen_s: float) -> float:
    """By how much the link was faster (above 0) or slower than expected, ln."""
    share = seen_s / expected_s
    return min(HIGHEST_STEP, 1 - share) if share < 1 else -log(share)


def _update(b: Belief, surprise: float, expected_s: float, seen_s: float, pieces: int, backlog: bool) -> Belief:
    """The belief after a measurement with the errors of so many arrivals."""
    if not surprise or (backlog and surprise > 0):
        return b
    scale = max(expected_s, RARE * seen_s) ** 2 / pieces
    # What passes at once shows in busy frames and in trains of one report: to be a rise, it must last.
    noise, repeated = b.noise, surprise * (b.before if surprise > 0 else b.innovation)
    if repeated <= 0:  # innovations of one sign are a change, not noise
        new = scale * min(1.0, max(0.0, surprise * surprise - b.v))
        noise += REPORT_S / MEMORY_S * (min(GOAL_S**2, max(LEAST_JITTER_S**2, new)) - noise)  # a queue is no noise
    v = min(1.0, b.v + max(0.0, repeated))
    k = v / (v + noise / scale)
    m = min(_highest(b.most), b.m + k * surprise)
    return b._replace(m=m, v=max(DRIFT * REPORT_S / 2, (1 - k) * v), innovation=(1 - k) * surprise, noise=noise)


def _contend(b: Belief, seen: Evidence) -> Belief:
    """The best capacity is one of the link itself, of which competing traffic takes a part."""
    if seen.train_s:
        b = b._replace(within=recorded(b.within, b.t, seen.train_kbit / seen.train_s, LOSS_S))
    if _rate_within(b) is not None:
        return b._replace(best=max(b.m, b.best))
    # Without trains: the link itself is narrow while less is served than is sent.
    dt = min(LONGEST_S, b.t - b.observed)
    slower = log1p(max(-0.9, seen.growth)) - log1p(-min(0.9, b.loss))
    is_narrow = slower > THICK and (b.queue > GOAL_S or b.loss > LOSSY)
    best = b.best - slower * dt / REPORT_S * is_narrow
    return b._replace(best=max(b.m, best - (best - b.m) * dt / BEST_S))


def _link(b: Belief) -> float:
    """x of the link itself: what its trains tell, or the best capacity."""
    rate = _rate_within(b)
    return b.best if rate is None else max(b.m, min(b.best, log(rate)))


def _rate_within(b: Belief) -> float | None:
    """The rate of recent trains of a busy link, kbit/s; None: there are too few."""
    # Others send between frames; what they send within one slows some trains.
    recent = [rate for at, rate in b.within if at > b.t - LOSS_S]
    return median(recent) if len(recent) > MANY else None
