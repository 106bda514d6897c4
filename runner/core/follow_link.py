"""What the rule `follow_link` does: a total that the uplink is believed to carry, or a fading prediction. Pure."""

from __future__ import annotations

from enum import StrEnum
from fractions import Fraction
from math import sqrt
from typing import NamedTuple

from runner.core import belief as beliefs
from runner.core.belief import Belief
from runner.core.budget import beside_sound, video_kbps, wire_kbps
from runner.core.decision import Believed, Draft
from runner.core.events import Evidence, LinkMeasured
from runner.core.learned import WRONG
from runner.core.model import Camera, Kbps, Vehicle, exact, plain
from runner.core.state import State

START_S = 5.0  # until the first pictures of all cameras have arrived and are reported
FLOOR = Kbps(500)


class Reports(StrEnum):
    """What the reports of the operator's side are used for."""

    FOLLOWED = "followed"
    IGNORED = "ignored"


class Ceiling(StrEnum):
    """What the total never exceeds, beside what the cameras can use."""

    NONE = "none"
    PREDICTION = "prediction"


class Prediction(NamedTuple):
    """kbps on the wire, None: there is none, or it is too old; bias and error as for `belief.begin`."""

    kbps: float | None
    bias: float = 0.0
    error: float = WRONG


NO_PREDICTION = Prediction(None)


# --- while the link is measured ---------------------------------------------------------------------------------------


def is_measured(state: State, link: LinkMeasured | None, past: Belief | None) -> bool:
    """Whether reports tell what the link carries.

    While an operator is gone, or another one who has taken control has not reported yet, what they told last holds.
    """
    if link is None:
        return past is not None and _is_recent(past, state.t)
    return state.operator_since is not None and state.t - link.t < START_S


def _is_recent(belief: Belief, t: float) -> bool:
    return t - belief.reported < START_S


def predicted(vehicle: Vehicle, state: State, cameras: tuple[Camera, ...], after_s: Fraction) -> Prediction:
    """The newest prediction, unless it is stale: of what cameras can have, as reports are."""
    made, (age, limit) = state.prediction, _age(state, after_s)
    if made is None or age > limit:
        return NO_PREDICTION
    error = WRONG if made.error is None else made.error
    left = beside_sound(vehicle, state.copies, made.kbps)
    return Prediction(float(wire_kbps(cameras, left)), made.bias or 0.0, error)


def updated(
    past: Belief | None,
    state: State,
    link: LinkMeasured | None,
    *,
    start: float,
    most: float,
    prediction: Prediction,
    floors: float,
    ceiling: float,
) -> Belief:
    """What is believed after an event, with the total for it. All in kbit/s on the wire; see `runner.core.belief`."""
    since = state.t if state.operator_since is None else state.operator_since
    if past is None or (past.since != since and not _is_recent(past, since)):
        past = beliefs.begin(since, start, most, *prediction)
    belief = beliefs.predict(past._replace(since=since, most=most), state.t, *prediction)
    if link is None or link.evidence is None:
        return belief._replace(total=min(belief.total, most, ceiling))
    if link.t > belief.reported:
        belief = beliefs.observe(belief, link.t, _of_every_copy(state, link.evidence), link.rtt_ms / 1000)
    return beliefs.decide(belief, state.t, link.evidence.silent_s, floors, ceiling)


def _of_every_copy(state: State, evidence: Evidence) -> Evidence:
    """The operator measures one copy of each camera."""
    if not state.copies:
        return evidence
    # All copies carry the same, so that a number of copies for each kbit is enough.
    names = [name for name, on in state.on.items() if on]
    ratio = sum(state.copies.get(name, 1) for name in names) / max(1, len(names))
    return evidence._replace(
        busy_kbit=ratio * evidence.busy_kbit,
        train_kbit=ratio * evidence.train_kbit,
        idle_kbit=ratio * evidence.idle_kbit,
        kbit=ratio * evidence.kbit,
        lost_kbit=ratio * evidence.lost_kbit,
    )


def followed(
    draft: Draft, total: Kbps, lasting: Kbps, belief: Belief, cameras: tuple[Camera, ...], link: LinkMeasured | None
) -> Draft:
    """With this total, sizes for the one that lasts, and the reason."""
    before, believed = draft.total, _believed(belief, cameras)
    assert before is not None
    draft = draft.replaced(believed=believed, sized_for=None if lasting == total else lasting)
    limited = draft.limited(total, _why(belief, believed, link))
    return limited if limited.total == before else limited.replaced(uncapped=max(before, total))


def _believed(belief: Belief, cameras: tuple[Camera, ...]) -> Believed:
    """As it is stated: for video, rounded."""
    learned, policer = belief.learned, belief.policer

    def video(wire: float) -> int:
        return int(video_kbps(cameras, Fraction(int(wire))))

    is_level_known = learned.ln is not None and learned.is_level_known
    return Believed(
        kbps=video(belief.kbps),
        deviation=round(sqrt(belief.v), 2),
        margin=round(belief.margin, 2),
        bias=round(learned.bias, 2) if is_level_known else None,
        error=round(sqrt(learned.error), 2) if is_level_known else None,
        gain=round(learned.gain, 2) if learned.ln is not None and learned.is_gain_known else None,
        policer_kbps=video(policer.kbps) if policer.proven else None,
    )


def _why(belief: Belief, believed: Believed, link: LinkMeasured | None) -> str:
    if belief.total >= belief.most:
        return "all that the cameras can use"
    if link and link.evidence.silent_s:
        return f"nothing has arrived for {link.evidence.silent_s:.1f} s"
    if believed.policer_kbps is not None and believed.policer_kbps < believed.kbps:
        return f"the link drops what exceeds {believed.policer_kbps}"
    if belief.total > belief.kbps:
        return f"a share of the link, of which other traffic leaves {believed.kbps}"
    return f"capacity of the link, believed to be {believed.kbps}"


# --- while it is not --------------------------------------------------------------------------------------------------


def faded(
    vehicle: Vehicle, state: State, draft: Draft, cameras: int, after_s: Fraction, halve_s: Fraction, floor: Kbps
) -> Draft:
    """At most the lower bound of the prediction, less the older it is.

    After a prediction of nothing it is `floor`: with nothing sent, the link could never be measured.

    cameras  number of those that are sent
    """
    assert draft.total is not None
    lower = None if state.prediction is None else state.prediction.lower_kbps
    lower = None if lower is None else beside_sound(vehicle, state.copies, lower)
    if lower is not None and lower < draft.total:
        draft = draft.limited(lower, "lower bound of the prediction")
    age, limit = _age(state, after_s)
    if age <= limit:
        return draft
    assert draft.total is not None
    halvings = min(64, int((age - limit) / halve_s) + 1)  # 64 are below any floor
    least = floor if draft.total < max(1, cameras) else min(floor, draft.total)
    total = max(Fraction(draft.total) / 2**halvings, least)
    return draft.limited(total, f"no prediction for {float(age):.1f} s, limit {plain(limit)} s")


def started(state: State, draft: Draft, start: Fraction) -> Draft:
    """A share of the total for an operator who has just connected.

    All cameras start with a key frame. At the full total, a narrower link would lose packets before the first report.
    """
    before = draft.total
    if state.operator_since is None or state.t - state.operator_since >= START_S or start == 1:
        return draft
    assert before is not None
    # A new size restarts the encoder, so sizes at the start are chosen for the time after it.
    limited = draft.limited(before * start, "the link has not been measured yet")
    return limited.replaced(uncapped=before, sized_for=before)


def _age(state: State, after_s: Fraction) -> tuple[Fraction, Fraction]:
    """Age of the prediction (before the first one, of the run), s, and how old it may be."""
    made = state.prediction
    limit = after_s if made is None or made.valid_s is None else exact(made.valid_s)
    return exact(state.t) - (exact(made.t) if made else 0), limit
