"""The events by which the core learns what the vehicle notices: who is present, which cameras are lost, copies. Pure.

Each is a comparison with the core's state, not with what was noticed before, since an event may have failed.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Iterator, Mapping
from fractions import Fraction
from math import ceil

from runner.core.commands import KnobValues
from runner.core.events import (
    CopiesCounted,
    Departure,
    Event,
    OperatorConnected,
    OperatorDisconnected,
    SourceReported,
    StreamMeasured,
)
from runner.core.model import Kbps
from runner.core.roles import Role
from runner.core.state import State
from runner.core.step import Run
from runner.records.vehicle import CameraReading, SoundReading

STREAM_S = 4.0  # over which a stream is measured: many cameras send a key picture every two seconds
LEAST_S = 2.0  # of these, before anything is said
CHANGE = Fraction(11, 10)  # of its bitrate, that is told
OVER = Fraction(5, 4)  # of what a camera was asked for: less may be its rate control's
FOLLOW_S = 10.0  # within which it does as asked: a command may wait and take seconds, and what it sends is a mean


def presence_events(
    known: State,
    present: Collection[str],
    watching: Collection[str],
    role_of: Callable[[str], Role | None],
    t: float,
    departure: Departure,
) -> Iterator[Event]:
    """Which operators have come, in which role, and which have gone.

    present    names of those that are; "" is the vehicle's own program, which drives nothing
    watching   names of those who only watch, whatever their keys allow
    role_of    None: its keys were withdrawn
    departure  how those that are no longer present have left
    """
    allowed = {name: role for name in sorted(present) if name and (role := role_of(name))}
    roles = {name: Role.WATCHER if name in watching else role for name, role in allowed.items()}
    for name in known.driving.present.keys() - roles.keys():
        yield OperatorDisconnected(t=t, operator=name, departure=Departure.WITHDRAWN if name in present else departure)
    for name, role in roles.items():
        if known.driving.present.get(name) is not role:
            yield OperatorConnected(t=t, operator=name, role=role)
    own = "" in present
    if not roles and not known.driving.present and own != (known.operator_since is not None):
        yield OperatorConnected(t=t) if own else OperatorDisconnected(t=t)


def source_events(known: State, cameras: Mapping[str, CameraReading], t: float) -> Iterator[Event]:
    """Which cameras cannot be opened, or can be again."""
    for name, why in ((name, camera.lost) for name, camera in cameras.items()):
        if why != known.lost.get(name):
            yield SourceReported(t=t, camera=name, works=why is None, reason=why)


class Streams:
    """Measures what cameras send that encode by themselves, from the counters of their pipelines.

    fixed     names of those that send what they send
    settable  of those that are asked for a bitrate
    """

    def __init__(self, fixed: Collection[str], settable: Collection[str] = ()) -> None:
        self._seen: dict[str, deque[tuple[float, int]]] = {name: deque() for name in (*fixed, *settable)}
        self._asked: dict[str, deque[tuple[float, int]]] = {name: deque() for name in settable}

    def events(self, run: Run, cameras: Mapping[str, CameraReading], t: float) -> Iterator[Event]:
        """Those that send more or less than is known by `CHANGE`; several times a second."""
        self._note_asked(run.commanded, t)
        for name, seen in self._seen.items():
            counted = cameras[name].encoded.bytes
            if cameras[name].applied.get("sending") is not True or (seen and counted < seen[-1][1]):
                seen.clear()  # it is off, or begins anew
            seen.append((t, counted))
            while len(seen) > 2 and t - seen[1][0] >= STREAM_S:
                seen.popleft()
            span_s = t - seen[0][0]
            if span_s < LEAST_S or counted == seen[0][1]:
                continue
            kbps = Kbps(ceil(8 * (counted - seen[0][1]) / span_s / 1000))
            last = run.state.streams.get(name)
            if name in self._asked:
                kbps, last = self._over_asked(name, kbps), last or Kbps(0)
            if last is None or (kbps != last and not (kbps and last and 1 / CHANGE < kbps / last < CHANGE)):
                yield StreamMeasured(t=t, camera=name, kbps=kbps)

    def _note_asked(self, commanded: Mapping[str, KnobValues], t: float) -> None:
        for name, asked in self._asked.items():
            kbps = commanded.get(name, {}).get("bitrate")
            if isinstance(kbps, int) and (not asked or asked[-1][1] != kbps):
                asked.append((t, kbps))
            while len(asked) > 1 and t - asked[1][0] >= FOLLOW_S:
                asked.popleft()

    def _over_asked(self, name: str, kbps: Kbps) -> Kbps:
        """What a camera sends, if that is more than it was asked for at any time in which it could follow; else 0."""
        return kbps if kbps > OVER * max((most for _, most in self._asked[name]), default=kbps) else Kbps(0)


def copies_events(known: State, streams: Mapping[str, CameraReading | SoundReading], t: float) -> Iterator[Event]:
    """How many copies of each camera's stream, and of the sound, leave the vehicle.

    One for the operator to whom control is offered counts from the offer on: the uplink has room before it begins.
    """
    least = len(known.driving.drivers)
    numbers = {name: max(each.copies, least) if each.copies else 0 for name, each in streams.items()}
    copies = {name: number for name, number in numbers.items() if number > 1}
    if copies != known.copies:
        yield CopiesCounted(t=t, copies=copies)
