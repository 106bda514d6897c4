"""Who drives: at most one operator holds control, and this is how it passes from one to another. Pure.

    free    nobody holds control. An operator that asks gets it, and without asking one that alone could
    held    the holder is in control. It may offer control to another, which accepts once it sees the pictures
    lost    the holder has gone without releasing control: nobody is in control, the vehicle's fail-safe has to act. The
            holder gets control back by returning, one to whom it had offered control by accepting

Control of a vehicle that moves passes only by an offer that is accepted, or to a supervisor that takes it. A vehicle
moves unless its speed was reported below SLOW_MPS for SLOW_S, last less than KNOWN_S ago.

Whoever is connected may ask the vehicle to stop. That stands until the holder or a supervisor lifts it, whoever comes,
goes or drives meanwhile.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Set
from dataclasses import dataclass, field, replace
from enum import StrEnum
from math import inf
from typing import Annotated

from runner.core.events import (
    NAMES,
    ClockAdvanced,
    ControlAccepted,
    ControlDenied,
    ControlOffered,
    ControlReleased,
    ControlRequested,
    ControlRestored,
    ControlTaken,
    Departure,
    Event,
    OperatorConnected,
    OperatorDisconnected,
    PositionReported,
    Refused,
    StopLifted,
    StopRequested,
)
from runner.core.limits import NonNegative
from runner.core.roles import DRIVERS, Role, denial

SLOW_MPS, SLOW_S, KNOWN_S = 0.3, 2.0, 1.0
OFFER_S = 60.0  # an offer nobody accepts ends: meanwhile every camera is sent twice


class Control(StrEnum):
    """Whether an operator is in control."""

    FREE = "free"
    HELD = "held"
    LOST = "lost"


@dataclass(frozen=True, slots=True)
class Driving:
    """Who drives the vehicle, by its own account."""

    state: Annotated[Control, "lost: the holder has gone, so nobody is in control until it returns"] = Control.FREE
    holder: Annotated[str | None, "id of the operator that is in control, or was until it was lost; None: free"] = None
    since: Annotated[NonNegative, "t from which this holder has been in this state, s"] = 0.0
    offered: Annotated[str | None, "id of the operator to whom the holder offers control; None: no offer"] = None
    offer_ends: Annotated[float | None, "t at which the offer ends unless it is accepted; None: no offer"] = None
    requested: Annotated[tuple[str, ...], "ids of the operators that ask for control, in this order"] = ()
    present: Annotated[Mapping[str, Role], "roles of the operators that are connected, by id"] = field(
        default_factory=dict
    )
    released: Annotated[str | None, "who has released control last, and does not get it again without asking"] = None
    stop: Annotated[str | None, "id of the operator that has asked the vehicle to stop; None: nobody has"] = None
    stop_since: Annotated[float | None, "t from which that stands, s; None: nobody has asked"] = None
    standing: Annotated[bool, "whether the vehicle is known to stand, so that control may be released"] = False
    why: Annotated[str, "the last change, in words"] = "nobody has driven yet"

    @property
    def in_control(self) -> str:
        """The operator that is in control, "" for none."""
        return self.holder if self.state is Control.HELD and self.holder else ""

    @property
    def drivers(self) -> tuple[str, ...]:
        """The operators that need pictures most: the holder, also while it is lost, and whom control is offered to."""
        return tuple(name for name in (self.holder, self.offered) if name)


@dataclass(frozen=True, slots=True)
class Motion:
    """What is known of the speed: the newest report, m/s and s, and since when all were slow without a long gap."""

    speed_mps: float = 0.0
    at: float = -inf
    slow_since: float | None = None

    def after(self, event: PositionReported) -> Motion:
        """With another report; one without a speed tells nothing."""
        if event.speed_mps is None:
            return self
        goes_on = self.slow_since is not None and event.t - self.at < SLOW_S
        since = self.slow_since if goes_on else event.t
        return Motion(event.speed_mps, event.t, since if event.speed_mps < SLOW_MPS else None)

    def is_known(self, t: float) -> bool:
        return t - self.at < KNOWN_S

    def stands(self, t: float, since: float = -inf) -> bool:
        """Whether the vehicle is known to stand, and has for SLOW_S since some time."""
        return self.slow_since is not None and self.is_known(t) and t - max(self.slow_since, since) >= SLOW_S

    def words(self, t: float) -> str:
        """Why control cannot be released now."""
        if not self.is_known(t):
            return "its speed is not known, which counts as moving"
        if self.slow_since is None:
            return f"it moves at {3.6 * self.speed_mps:.0f} km/h"
        return f"it has stood for less than {SLOW_S:g} s"


def advance(driving: Driving, motion: Motion, event: Event, sent: Set[str]) -> Driving:
    """Who drives after an event; motion is as known then.

    sent    the cameras that are being sent: an operator that takes over has to see them, unless the vehicle stands
    raises  Refused
    """
    after = _changed(driving, motion, event, sent)
    if after is driving and not isinstance(event, ClockAdvanced | PositionReported):
        return driving
    return _settled(after, motion, event.t)


def _changed(driving: Driving, motion: Motion, event: Event, sent: Set[str]) -> Driving:  # noqa: PLR0911
    """By the event itself."""
    match event:
        case OperatorConnected(operator=str(name)):
            return _arrived(driving, name, event.role or Role.WATCHER, event.t)
        case OperatorDisconnected(operator=str(name)):
            return _left(driving, motion, name, event.departure or Departure.SILENT, event.t)
        case ControlRestored(operator=name, stop=stop):
            now = driving if stop is None else replace(driving, stop=stop, stop_since=event.t)
            return _lost(now, name, event.t, f"the vehicle has restarted while {name} was in control") if name else now
        case ControlRequested(operator=name):
            _may(driving, name, event)
            return _asked(driving, name, event.t)
        case ControlOffered(operator=name, to=to):
            _may(driving, name, event)
            return _offered(driving, name, to, event.t)
        case ControlAccepted(operator=name, live=live):
            _may(driving, name, event)
            unseen = frozenset() if motion.stands(event.t) else sent - frozenset(live)
            return _accepted(driving, name, unseen, event.t)
        case ControlDenied(operator=name, to=to):
            _may(driving, name, event)
            return _denied(driving, name, to)
        case ControlReleased(operator=name):
            _may(driving, name, event)
            return _released(driving, motion, name, event.t)
        case ControlTaken(operator=name):
            _may(driving, name, event)
            former = f" from {driving.holder}" if driving.holder else ""
            return _held(driving, name, event.t, f"{name} has taken control{former}, as a supervisor")
        case StopRequested(operator=name):
            _may(driving, name, event)
            return _stopped(driving, name, event.t)
        case StopLifted(operator=name):
            _may(driving, name, event)
            return _lifted(driving, name)
        case _:
            return driving


def _settled(driving: Driving, motion: Motion, t: float) -> Driving:
    """What follows from time, speed and who is present, whatever the event was."""
    standing = motion.stands(t)
    now = driving if driving.standing is standing else replace(driving, standing=standing)
    able = [name for name, role in now.present.items() if role in DRIVERS]
    if now.offered is not None and now.offered not in able:
        now = _without_offer(now, f"{now.offered} has gone: the offer of control has ended")
    if now.offer_ends is not None and t >= now.offer_ends:
        now = _without_offer(now, f"{now.offered} has not accepted control within {OFFER_S:g} s")
    asking = tuple(name for name in now.requested if name in able)
    if asking != now.requested:
        now = replace(now, requested=asking)
    if now.state is Control.LOST and motion.stands(t, now.since):
        now = _free(now, t, f"the vehicle stands, and {now.holder} has not returned")
    if now.state is Control.FREE and asking:
        return _held(now, asking[0], t, f"{asking[0]} has asked for control, which became free")
    if now.state is Control.FREE and len(able) == 1 and able[0] != now.released:
        return _held(now, able[0], t, f"control was free, and nobody but {able[0]} is here to drive")
    return now


def _may(driving: Driving, name: str, event: Event) -> None:
    """raises Refused"""
    kind = NAMES[type(event)]
    if name not in driving.present:
        raise Refused(f"{name} is not connected: an operator's side announces itself by operator_connected")
    if why := denial(driving.present[name], kind):
        raise Refused(why)


def _arrived(driving: Driving, name: str, role: Role, t: float) -> Driving:
    now = replace(driving, present={**driving.present, name: role})
    if driving.state is Control.LOST and driving.holder == name and role in DRIVERS:
        return replace(now, state=Control.HELD, since=t, why=f"{name} is back")
    if driving.in_control == name and role not in DRIVERS:
        return _lost(now, name, t, f"{name}, now a {role}, may no longer drive")
    return now


def _left(driving: Driving, motion: Motion, name: str, departure: Departure, t: float) -> Driving:
    present = {other: role for other, role in driving.present.items() if other != name}
    signed_off = departure is Departure.SIGNED_OFF
    released = None if signed_off and driving.released == name else driving.released
    now = replace(driving, present=present, released=released)
    if driving.in_control != name:
        return now
    if signed_off and motion.stands(t):
        return _free(now, t, f"{name} has signed off, and the vehicle stands")
    still = f": {motion.words(t)}" if signed_off else ""
    return _lost(now, name, t, f"{name}: {departure}{still}")


def _asked(driving: Driving, name: str, t: float) -> Driving:
    if driving.state is Control.FREE:
        return _held(driving, name, t, f"{name} has asked for control, which was free")
    if name in (driving.in_control, *driving.requested):
        return driving
    return replace(driving, requested=(*driving.requested, name), why=f"{name} asks for control")


def _offered(driving: Driving, name: str, to: str, t: float) -> Driving:
    if driving.in_control != name:
        raise Refused(f"only the operator in control may offer it: {_who(driving)}")
    if not to:
        return driving if driving.offered is None else _without_offer(driving, f"{name} has withdrawn its offer")
    if to == name:
        raise Refused(f"{name} is in control already")
    if to not in driving.present:
        raise Refused(f"{to} is not connected")
    if driving.present[to] not in DRIVERS:
        raise Refused(f"{to} is a {driving.present[to]}, control needs a {' or '.join(DRIVERS)}")
    return replace(driving, offered=to, offer_ends=t + OFFER_S, why=f"{name} offers control to {to}")


def _accepted(driving: Driving, name: str, unseen: Collection[str], t: float) -> Driving:
    if driving.offered != name:
        raise Refused(f"control is not offered to {name}: {_who(driving)}")
    if unseen:
        raise Refused(f"not yet live for 1 s at the station of {name}: {', '.join(sorted(unseen))}")
    return _held(driving, name, t, f"{name} has accepted control from {driving.holder}")


def _denied(driving: Driving, name: str, to: str) -> Driving:
    if driving.in_control != name:
        raise Refused(f"only the operator in control may decline a request: {_who(driving)}")
    if to not in driving.requested:
        raise Refused(f"{to} does not ask for control")
    asking = tuple(other for other in driving.requested if other != to)
    now = _without_offer(driving, "") if driving.offered == to else driving
    return replace(now, requested=asking, why=f"{name} has declined the request of {to}")


def _released(driving: Driving, motion: Motion, name: str, t: float) -> Driving:
    """By its holder, or of a lost holder by a supervisor, who may also vouch that a vehicle stands."""
    is_supervisor = driving.present[name] is Role.SUPERVISOR
    if driving.in_control == name or (driving.state is Control.LOST and is_supervisor):
        if not motion.stands(t) and (motion.is_known(t) or not is_supervisor):
            raise Refused(f"the vehicle must stand before its control is released: {motion.words(t)}; or offer control")
        return replace(_free(driving, t, f"{name} has released control"), released=name)
    if name != driving.offered and name not in driving.requested:
        raise Refused(f"{name} has nothing to release: {_who(driving)}")
    asking = tuple(other for other in driving.requested if other != name)
    if name == driving.offered:
        return replace(_without_offer(driving, f"{name} has declined control"), requested=asking)
    return replace(driving, requested=asking, why=f"{name} no longer asks for control")


def _stopped(driving: Driving, name: str, t: float) -> Driving:
    if driving.stop is not None:
        return driving
    return replace(driving, stop=name, stop_since=t, why=f"{name} asks the vehicle to stop")


def _lifted(driving: Driving, name: str) -> Driving:
    if driving.in_control != name and driving.present[name] is not Role.SUPERVISOR:
        raise Refused(f"only the operator in control or a supervisor may lift it: {_who(driving)}")
    if driving.stop is None:
        raise Refused("nobody has asked the vehicle to stop")
    return replace(driving, stop=None, stop_since=None, why=f"{name} has lifted the stop that {driving.stop} asked for")


def _held(driving: Driving, name: str, t: float, why: str) -> Driving:
    if driving.in_control == name:
        return driving
    asking = tuple(other for other in driving.requested if other != name)
    released = None if driving.released == name else driving.released
    now = replace(driving, state=Control.HELD, holder=name, since=t, requested=asking, released=released, why=why)
    return _without_offer(now, why)


def _lost(driving: Driving, name: str, t: float, why: str) -> Driving:
    """An offer outlasts its maker: it has been agreed to, and the other one may see the pictures already."""
    return replace(driving, state=Control.LOST, holder=name, since=t, why=why)


def _free(driving: Driving, t: float, why: str) -> Driving:
    return _without_offer(replace(driving, state=Control.FREE, holder=None, since=t), why)


def _without_offer(driving: Driving, why: str) -> Driving:
    return replace(driving, offered=None, offer_ends=None, why=why)


def _who(driving: Driving) -> str:
    """Who is in control, in words."""
    if driving.state is Control.FREE:
        return "nobody is in control"
    return f"{driving.holder} is in control" if driving.state is Control.HELD else f"{driving.holder} is lost"
