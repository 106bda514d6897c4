"""Which uplinks carry which camera. Pure.

Eq. (2) of the paper shares a total in proportion to w_i b_dem,i. Of all ways to share that total, this one has the
highest sum_i w_i b_dem,i ln(b_alloc,i / b_dem,i). Cameras are placed so that this sum over all uplinks is highest.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import inf, log
from typing import NamedTuple

from runner.core.allocation import ZERO
from runner.core.decision import NOTHING
from runner.core.model import Kbps

MOVES, MOVES_S = 2, 60.0  # a camera moves at most so often in that time, unless its uplink stalls
SETTLE_S = 2.0  # between two moves, so that the beliefs can follow
OVERLAP_S = 0.4  # both uplinks carry a camera that moves, longer than any jitter buffer waits: nothing is missing
# An uplink that takes over cameras of a stalled one has carried less until now, and may carry less than is believed. At
# first it is to carry so many times as much as before, then again so many times as much after each GROWTH_S, until
# GROWN_S have passed.
GROWTH, GROWTH_S, GROWN_S = 2.0, 0.25, 2.0
GAIN = 0.05  # by how much a move raises the weighted mean of ln(b_alloc / b_dem) at least
LEAST = 1e-3  # share of its demand that a camera without any bitrate counts as having
# An uplink carries copies of redundant cameras from this share of what the best uplink would give them, and then down
# to the second one: with less, the copies would cost these cameras more than they protect.
COPIED, KEPT = 0.3, 0.15


class Wanted(NamedTuple):
    """What a camera asks for.

    kbps       Eq. (1), not 0
    weight     see `allocation.allocate`
    redundant  whether it is to be sent over every uplink
    """

    kbps: float
    weight: float = 1.0
    redundant: bool = False


class Carries(NamedTuple):
    """What is known of an uplink.

    kbps     that its cameras may use together
    stalled  whether nothing arrives over it
    """

    kbps: float
    stalled: bool = False


@dataclass(frozen=True, slots=True)
class Placement:
    """Which uplinks carry which camera, and what limits its next change.

    uplinks  by camera: names, its own uplink first, then those that carry a copy; of a redundant one the living first
    moved    by camera: times of its moves in the last MOVES_S, except those from a stalled uplink, s
    last     time of the last move, s
    left     by camera that moves: the uplink that it leaves, and until when that carries it too, s
    clear    by uplink: since when it has not been stalled, s; inf while it is
    came     by camera that is on another uplink than at first: why, in words
    why      by camera: why these uplinks, in words; none where each is as good
    taken    by uplink: when it took over cameras of a stalled one, s, and what it may have carried until then, kbit/s
    """

    uplinks: Mapping[str, tuple[str, ...]] = field(default_factory=lambda: NOTHING)
    moved: Mapping[str, tuple[float, ...]] = field(default_factory=lambda: NOTHING)
    last: float = -inf
    left: Mapping[str, tuple[str, float]] = field(default_factory=lambda: NOTHING)
    clear: Mapping[str, float] = field(default_factory=lambda: NOTHING)
    came: Mapping[str, str] = field(default_factory=lambda: NOTHING)
    why: Mapping[str, str] = field(default_factory=lambda: NOTHING)
    taken: Mapping[str, tuple[float, float]] = field(default_factory=lambda: NOTHING)

    def most(self, uplink: str, t: float) -> float:
        """What an uplink may carry at time t at most, kbit/s."""
        since, kbps = self.taken.get(uplink, (-inf, inf))
        return inf if t - since > GROWN_S else kbps * GROWTH ** (1 + int((t - since) / GROWTH_S))


def place(
    before: Placement, cameras: Mapping[str, Wanted], uplinks: Mapping[str, Carries], t: float, clear_s: float
) -> Placement:
    """Where each camera goes at time t, s.

    A camera whose uplink stalls moves at once. Others move one at a time, to an uplink that has not been stalled for
    `clear_s`. If all uplinks are stalled, every camera stays. An uplink that would carry nothing gets a copy of the
    camera that asks for least, since it would not be measured otherwise.

    cameras  that are on, by name
    uplinks  by name, at least one
    """
    clear = {name: inf if each.stalled else min(before.clear.get(name, -inf), t) for name, each in uplinks.items()}
    living = [name for name, since in clear.items() if since < inf] or [*uplinks]
    ready = [name for name in living if t - clear[name] >= clear_s] or living
    redundant = {name: each for name, each in cameras.items() if each.redundant}
    single = {name: each for name, each in cameras.items() if not each.redundant}
    carriers = _carriers(redundant, {name: uplinks[name].kbps for name in living}, before)
    problem = _Problem(single, redundant, {name: uplinks[name].kbps for name in living}, carriers)
    own = {name: at[0] for name, at in before.uplinks.items() if name in single and at[0] in living}
    now = _current(before, own, t)
    if homeless := single.keys() - own.keys():
        homes = _homes(problem, own, {name: single[name] for name in homeless}, ready)
        own, now = own | homes, _after_stall(now, homes, cameras, uplinks, t)
    elif t - before.last >= SETTLE_S:
        free = [name for name in single if len(now.moved.get(name, ())) < MOVES]
        if move := problem.best_move(own, free, ready):
            own, now = own | {move[0]: move[1]}, _after_move(now, move[0], own[move[0]], t)
    everywhere = (*carriers, *(name for name in uplinks if name not in living))
    at = {name: (own[name],) if name in own else _as_before(everywhere, before, name, living) for name in cameras}
    at |= {name: (*at[name], uplink) for name, (uplink, _) in now.left.items() if uplink not in at[name]}
    copied = _copied(at, cameras, uplinks)
    at |= {name: (*at[name], *copies) for name, copies in copied.items()}
    why = {**now.came, **_of_redundant(redundant, [name for name in living if name not in carriers])}
    for name, copies in copied.items():
        why[name] = ", ".join(filter(None, (why.get(name), f"a copy keeps {_and(copies)} measured")))
    return replace(now, uplinks=at, clear=clear, why=why)


def _current(before: Placement, own: Mapping[str, str], t: float) -> Placement:
    """Without what is over at time t. own: by camera that need not go elsewhere, its uplink"""
    recent = {name: tuple(at for at in times if t - at < MOVES_S) for name, times in before.moved.items()}
    return replace(
        before,
        moved={name: times for name, times in recent.items() if times},
        left={name: each for name, each in before.left.items() if name in own and t < each[1]},
        came={name: why for name, why in before.came.items() if name in own},
        taken={name: each for name, each in before.taken.items() if t - each[0] <= GROWN_S},
    )


def _homes(
    problem: _Problem, own: Mapping[str, str], homeless: Mapping[str, Wanted], ready: Sequence[str]
) -> dict[str, str]:
    """By camera without an uplink, the best one: the most important camera chooses first."""
    homes: dict[str, str] = {}
    for name in sorted(homeless, key=lambda name: (-_importance(homeless[name]), name)):
        homes[name] = max(ready, key=lambda uplink: problem.value({**own, **homes, name: uplink}))
    return homes


def _after_stall(
    before: Placement, homes: Mapping[str, str], cameras: Mapping[str, Wanted], uplinks: Mapping[str, Carries], t: float
) -> Placement:
    """Cameras have new homes: those that had others come from an uplink that has stalled."""
    fled = {name: uplink for name, uplink in homes.items() if name in before.uplinks}
    came = {name: f"{before.uplinks[name][0]} stalled at {t:.1f} s" for name in fled}
    taken = {}
    for uplink in {*fled.values()} - before.taken.keys():
        had = sum(each.kbps for camera, each in cameras.items() if uplink in before.uplinks.get(camera, ()))
        taken[uplink] = t, min(had, uplinks[uplink].kbps)
    return replace(before, came={**before.came, **came}, taken={**before.taken, **taken}, last=t)


def _after_move(before: Placement, camera: str, uplink: str, t: float) -> Placement:
    """A camera moves away from an uplink."""
    return replace(
        before,
        came={**before.came, camera: f"moved from {uplink} at {t:.1f} s, which gives less"},
        left={**before.left, camera: (uplink, t + OVERLAP_S)},
        moved={**before.moved, camera: (*before.moved.get(camera, ()), t)},
        last=t,
    )


def _of_redundant(cameras: Iterable[str], narrow: Sequence[str]) -> dict[str, str]:
    """By redundant camera why it goes over these uplinks. narrow: living ones that do not carry it"""
    return dict.fromkeys(cameras, f"redundant, but {_and(narrow)} carries too little" if narrow else "redundant")


def in_words(uplinks: Sequence[str], why: str | None) -> str:
    """Over which uplinks a camera goes, and why."""
    over = f"over {_and(uplinks)}"
    return f"{over}: {why}" if why else over


def _and(uplinks: Sequence[str]) -> str:
    return " and ".join(uplinks)


def _carriers(redundant: Mapping[str, Wanted], kbps: Mapping[str, float], before: Placement) -> tuple[str, ...]:
    """Those of the living uplinks that carry the redundant cameras."""
    wanted = sum(each.kbps for each in redundant.values())
    given = {name: min(own, wanted) for name, own in kbps.items()}
    best = max(given.values())
    had = {name for camera in redundant for name in before.uplinks.get(camera, ())}
    return tuple(name for name, own in given.items() if own >= best * (KEPT if name in had else COPIED))


def _as_before(carriers: Sequence[str], before: Placement, camera: str, living: Sequence[str]) -> tuple[str, ...]:
    """The living first, otherwise in the order of before: a redundant camera's knob need not turn at every change."""
    had = (name for name in before.uplinks.get(camera, ()) if name in carriers)
    return tuple(sorted(dict.fromkeys((*had, *carriers)), key=lambda name: name not in living))


def _copied(
    at: Mapping[str, tuple[str, ...]], cameras: Mapping[str, Wanted], uplinks: Iterable[str]
) -> Mapping[str, list[str]]:
    """The smallest camera, with the uplinks that would carry nothing."""
    unused = [name for name in uplinks if not any(name in carriers for carriers in at.values())]
    return {min(at, key=lambda name: (cameras[name].kbps, name)): unused} if at and unused else {}


def shared(
    limits: Mapping[str, Sequence[str]],
    totals: Mapping[str, Kbps],
    wanted: Mapping[str, Kbps],
    share: Callable[[Mapping[str, Kbps], Kbps], Mapping[str, Kbps]],
) -> dict[str, Kbps]:
    """kbit/s by camera, with each uplink shared by the cameras on it.

    A camera on several uplinks gets what the worst of them would give it; the others share the rest.

    limits  by camera, the uplinks that must carry it
    totals  kbit/s by uplink
    wanted  kbit/s by camera; one without uplinks gets nothing
    share   shares a total among cameras, by what they want
    """
    on = {uplink: [name for name in wanted if uplink in limits.get(name, ())] for uplink in totals}
    given = {uplink: share({name: wanted[name] for name in names}, totals[uplink]) for uplink, names in on.items()}
    fixed = {name: min(given[at][name] for at in uplinks) for name, uplinks in limits.items() if len(uplinks) > 1}
    result = dict.fromkeys(wanted, ZERO) | fixed
    for uplink, names in on.items():
        taken = sum((fixed[name] for name in names if name in fixed), ZERO)
        result |= share({name: wanted[name] for name in names if name not in fixed}, max(ZERO, totals[uplink] - taken))
    return result


class _Problem:
    """What a placement of cameras on uplinks is worth.

    single, redundant  cameras by name
    kbps               by living uplink
    carriers           uplinks that carry the redundant ones
    """

    def __init__(
        self,
        single: Mapping[str, Wanted],
        redundant: Mapping[str, Wanted],
        kbps: Mapping[str, float],
        carriers: tuple[str, ...],
    ) -> None:
        self._single, self._redundant, self._kbps, self._carriers = single, redundant, kbps, carriers
        self._sum = sum(map(_importance, (*single.values(), *redundant.values())))

    def value(self, own: Mapping[str, str]) -> float:
        """The sum that is to be high, with each camera on its own uplink."""
        on = {uplink: {n: self._single[n] for n, at in own.items() if at == uplink} for uplink in self._kbps}
        of_all = [_shares(self._kbps[uplink], {**on[uplink], **self._redundant}) for uplink in self._carriers]
        copied = {name: min(shares[name] for shares in of_all) for name in self._redundant}
        taken = sum(copied[name] * each.kbps for name, each in self._redundant.items())
        total = _value(self._redundant, copied)
        for uplink, its in on.items():
            left = self._kbps[uplink] - (taken if uplink in self._carriers else 0.0)
            total += _value(its, _shares(left, its))
        return total

    def best_move(self, own: Mapping[str, str], cameras: Iterable[str], to: Iterable[str]) -> tuple[str, str] | None:
        """The move of one of these cameras that gains most; None: none gains enough."""
        least = self.value(own) + GAIN * self._sum
        moves = [(name, uplink) for name in cameras for uplink in to if uplink != own[name]]
        gains = [(self.value({**own, name: uplink}), name, uplink) for name, uplink in moves]
        value, *move = max(gains, default=(-inf, "", ""))
        return (move[0], move[1]) if value > least else None


def _importance(camera: Wanted) -> float:
    return camera.weight * camera.kbps


def _value(cameras: Mapping[str, Wanted], shares: Mapping[str, float]) -> float:
    return sum(_importance(each) * log(max(LEAST, shares[name])) for name, each in cameras.items())


def _shares(kbps: float, cameras: Mapping[str, Wanted]) -> dict[str, float]:
    """Eq. (2), as a share of each camera's demand."""
    shares, left = {}, max(0.0, kbps)
    open_sum = sum(map(_importance, cameras.values()))
    for name, each in sorted(cameras.items(), key=lambda item: -item[1].weight):
        of_weight = left / open_sum if open_sum > 0 else 0.0
        shares[name] = min(1.0, of_weight * each.weight)
        if shares[name] == 1.0:  # as in `allocation.allocate`: the others share what it leaves
            left, open_sum = left - each.kbps, open_sum - _importance(each)
    return shares
