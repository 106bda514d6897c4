"""Answers accepted requests once what they command is read back as applied. Pure: time is passed in."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from runner.core.commands import Command, KnobValues
from runner.core.events import Event
from runner.core.step import Run
from runner.mqtt.messages import APPLY_S
from runner.records.vehicle import CameraReading, Outcome
from runner.vehicle.inbox import Answer

_Kind = tuple[type, str | None]  # of a request: its event, and the camera that it names
_Knobs = Sequence[tuple[str, str]]  # camera, knob


class _Pending(NamedTuple):
    answer: Answer
    knobs: _Knobs
    until: float
    kind: _Kind


@dataclass
class Replies:
    """Requests that are not answered yet."""

    _pending: list[_Pending] = field(default_factory=list)
    _timed_out: dict[_Kind, _Knobs] = field(default_factory=dict)  # of the last request of a kind

    @property
    def is_awaited(self) -> bool:
        """Whether any request waits for its answer."""
        return bool(self._pending)

    def expect(self, answer: Answer, event: Event, commands: Iterable[Command]) -> None:
        """Answer a request later.

        commands  that it has caused
        """
        kind = (type(event), getattr(event, "camera", None))
        commanded = [(command.camera, command.knob) for command in commands]
        # A request that is repeated commands nothing, but what it asks for may still not be applied.
        waited = [knob for pending in self._pending if pending.kind == kind for knob in pending.knobs]
        knobs = list(dict.fromkeys([*commanded, *waited, *self._timed_out.get(kind, ())]))
        self._pending.append(_Pending(answer, knobs, event.t + APPLY_S, kind))

    def settle(self, run: Run, cameras: Mapping[str, CameraReading], now: float) -> None:
        """Answer the requests of which all knob values are applied, or that have timed out."""
        applied = {name: camera.applied for name, camera in cameras.items()}
        self._pending = [pending for pending in self._pending if not self._answered(pending, run, applied, now)]

    def _answered(self, pending: _Pending, run: Run, applied: Mapping[str, KnobValues], now: float) -> bool:
        settings = run.decision.settings  # what is not sent keeps the other values
        relevant = [(name, knob) for name, knob in pending.knobs if knob == "sending" or settings[name].sending]
        watched = [(name, knob) for name, knob in relevant if applied[name]]
        waiting = [(name, knob) for name, knob in watched if applied[name].get(knob) != run.commanded[name][knob]]
        if waiting and now < pending.until:
            return False
        self._timed_out.pop(pending.kind, None)
        if waiting:
            self._timed_out[pending.kind] = waiting
            missing = ", ".join(f"{name} {knob}" for name, knob in waiting)
            pending.answer(Outcome(now, "timed out", f"not applied within {APPLY_S:g} s: {missing}"))
            return True
        unwatched = dict.fromkeys(name for name, _ in pending.knobs if not applied[name])
        reason = f"no viewer for {', '.join(unwatched)}: applied when one connects" if unwatched else ""
        pending.answer(Outcome(now, "applied", reason))
        return True
