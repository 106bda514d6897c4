"""The live loop of the vehicle: take an event, step, apply, log, tell. It stays dull."""

from __future__ import annotations

import queue
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, Protocol

from runner.commands import Command, KnobValue
from runner.drive.log import Log, run_lines
from runner.events import (
    ClockAdvanced,
    Event,
    OperatorConnected,
    OperatorDisconnected,
    PositionReported,
    describe,
    parse,
    to_json,
)
from runner.model import Vehicle, plain
from runner.pqos import Pqos
from runner.pqos.track import Track
from runner.schema import event_problem
from runner.step import Run, start, step

TICK_S = 0.1  # time between clock_advanced events
TELEMETRY_TICKS = 2  # also the vehicle's sign of life
APPLY_S = 1.0  # what is not read back from the elements by then, is answered as timed out
OPERATOR_SILENT_S = 3.0  # an operator who said hello and then nothing for so long is gone
Answer = Callable[[Mapping[str, Any]], None]


class Applier(Protocol):
    """What the loop asks of the side that streams."""

    def turn(self, commands: Iterable[Command]) -> None: ...
    def applied(self) -> Mapping[str, Mapping[str, KnobValue]]: ...
    def sent(self) -> Mapping[str, tuple[int, int]]: ...
    def faults(self) -> list[str]: ...


class _Asked(NamedTuple):
    """A request that was accepted and is not answered before its commands are read back as applied."""

    answer: Answer
    knobs: Sequence[tuple[str, str]]  # camera, knob
    until: float


@dataclass
class Loop:
    """Events in, commands out, in one thread. Other threads `post` what they have.

    publish  told the state (decided and applied) whenever it changed, and telemetry a few times a second
    report   told, in a line, what happened and what came of it
    """

    vehicle: Vehicle
    applier: Applier
    pqos: Pqos
    track: Track | None
    log: Log
    publish: Callable[[str, Mapping[str, Any]], None]
    report: Callable[[str], None]
    refused: int = 0
    _inbox: queue.SimpleQueue[Callable[[], None]] = field(default_factory=queue.SimpleQueue)  # run in the loop's thread
    _stopped: bool = False
    _ticks: int = 0
    _asked: list[_Asked] = field(default_factory=list)
    _told: dict[str, Any] = field(default_factory=dict)  # the state as last published
    _cause: str = ""  # the event that the decision in force came from
    _position: PositionReported | None = None
    _heard: float | None = None  # t of the last request of an operator who said hello

    def post(self, document: Mapping[str, Any], answer: Answer | None = None) -> None:
        """An event as JSON without `t`, from any thread.

        answer  told what came of it, as {"result": "applied" | "refused" | "timed out", "reason", "t"}
        """
        self._inbox.put(lambda: self._take_document(document, answer))

    def refuse(self, problem: str, answer: Answer) -> None:
        """Count and answer what is no event at all, from any thread."""
        self._inbox.put(lambda: self._refuse(problem, self._now(), answer))

    def wake(self) -> None:
        """Knobs were turned: look what is applied now. From any thread."""
        self._inbox.put(lambda: None)

    def tell_again(self) -> None:
        """Publish the state though nothing changed, since who listens may have lost it. From any thread."""
        self._inbox.put(self._told.clear)

    def stop(self) -> None:
        self._stopped = True
        self.wake()

    def run(self, duration_s: float | None = None) -> None:
        """Work until stopped, or for a time."""
        self._began = time.monotonic()
        self.log.begin()
        self._warned = 0
        self._run = start(self.vehicle)
        self._take(ClockAdvanced(t=0.0))
        next_tick = TICK_S
        while not self._stopped and (duration_s is None or self._now() < duration_s):
            if self._now() >= next_tick:
                self._tick()
                next_tick = max(next_tick + TICK_S, self._now() - TICK_S)
            try:
                self._inbox.get(timeout=max(0.0, next_tick - self._now()))()
            except queue.Empty:
                continue
            if self._inbox.empty():
                self._tell_state()

    def _now(self) -> float:
        return round(time.monotonic() - self._began, 6)

    def _tick(self) -> None:
        """Time passes: where the drive comes from a track, the position with it."""
        t = self._now()
        if self.track is not None:
            self._take(replace(self.track.at(t), t=t))
        self._take(ClockAdvanced(t=t))
        for fault in self.applier.faults():
            self.report(fault)
        self._ticks += 1
        if self._ticks % TELEMETRY_TICKS == 0:
            self._tell_measured(t)
        self._watch_operator(t)
        self._tell_state()

    def _take_document(self, document: Mapping[str, Any], answer: Answer | None) -> None:
        stamped = {**document, "t": self._now()}
        problem = event_problem(stamped)
        if problem:
            self._refuse(problem, stamped["t"], answer)
            return
        event = parse(stamped)
        if isinstance(event, OperatorDisconnected):
            self._heard = None
        elif isinstance(event, OperatorConnected) or (answer and self._heard is not None):
            self._heard = event.t
        self._take(event, answer)

    def _refuse(self, problem: str, t: float, answer: Answer | None) -> None:
        self.refused += 1
        if answer:
            answer(_said(t, "refused", problem))

    def _take(self, event: Event, answer: Answer | None = None) -> None:
        self._take_run(step(self.vehicle, self._run, event), event, answer)
        prediction = self.pqos.observe(event)
        for warning in self.pqos.warnings[self._warned :]:
            self._warned += 1
            self.report(warning)
        if prediction is not None:
            self._take_run(step(self.vehicle, self._run, prediction), prediction)

    def _take_run(self, after: Run, event: Event, answer: Answer | None = None) -> None:
        before, self._run = self._run, after
        self.applier.turn(after.commands)
        for line in run_lines(event, before, after):
            self.log.write(line)
        if isinstance(event, PositionReported):
            self._position = event
        if after.refused:
            self.refused += 1
            self.report(f"refused: {after.refused}")
        if answer and after.refused:
            answer(_said(event.t, "refused", after.refused))
        elif answer:
            knobs = [(command.camera, command.knob) for command in after.commands]
            self._asked.append(_Asked(answer, knobs, event.t + APPLY_S))
        if after.commands or after.decision != before.decision:
            self._tell_decision(before, event)

    def _tell_decision(self, before: Run, event: Event) -> None:
        self._cause = describe(event)
        for name, now in self._run.decision.settings.items():
            was = before.decision.settings[name]
            if (was.scaling, was.sending) != (now.scaling, now.sending):
                self.report(f"{self._cause} -> {name}: {now.reason}")

    def _tell_state(self) -> None:
        """Publish what is decided and what is applied, where either changed; answer requests that are applied now."""
        applied = self.applier.applied()
        state = {"online": True, "cause": self._cause, **self._run.decision.to_json()}
        for name, camera in state["cameras"].items():
            camera["weight"] = plain(self._run.state.weights[name])
            camera["applied"] = _knobs_to_json(name, applied[name])
        if state != self._told:
            self._told = state
            self.publish("state", {"t": self._now(), **state})
        self._asked = [asked for asked in self._asked if not self._answered(asked, applied)]

    def _answered(self, asked: _Asked, applied: Mapping[str, Mapping[str, KnobValue]]) -> bool:
        """Answer a request, if all that it made of knobs is applied, or time is up."""
        now, commanded = self._now(), self._run.commanded
        watched = [(name, knob) for name, knob in asked.knobs if applied[name]]
        waiting = [f"{name} {knob}" for name, knob in watched if applied[name].get(knob) != commanded[name][knob]]
        if waiting and now < asked.until:
            return False
        if waiting:
            asked.answer(_said(now, "timed out", f"not applied within {APPLY_S:g} s: {', '.join(waiting)}"))
            return True
        unwatched = dict.fromkeys(name for name, _ in asked.knobs if not applied[name])
        reason = f"nobody watches {', '.join(unwatched)}: kept until somebody does" if unwatched else ""
        asked.answer(_said(now, "applied", reason))
        return True

    def _watch_operator(self, t: float) -> None:
        """An operator who is connected says something every second; the broker's last will may come late or never."""
        if self._heard is not None and t - self._heard > OPERATOR_SILENT_S:
            self._heard = None
            self.report(f"the operator has said nothing for {OPERATOR_SILENT_S:g} s")
            self._take(OperatorDisconnected(t=t))

    def _tell_measured(self, t: float) -> None:
        """What was read back from the elements, and what the encoders have put out so far."""
        sent = self.applier.sent()
        cameras = {
            name: {"applied": _knobs_to_json(name, knobs), "frames": sent[name][0], "bytes": sent[name][1]}
            for name, knobs in self.applier.applied().items()
        }
        prediction, position = self._run.state.prediction, self._position
        telemetry = {
            "t": t,
            "predicted_kbps": plain(prediction.kbps) if prediction else None,
            "position": {key: value for key, value in to_json(position).items() if key not in ("t", "event")}
            if position
            else None,
            "cameras": cameras,
            "refused": self.refused,
        }
        self.log.write({"t": t, "log": "telemetry", **telemetry})
        self.publish("telemetry", telemetry)


def _said(t: float, result: str, reason: str) -> dict[str, Any]:
    return {"t": t, "result": result, "reason": reason}


def _knobs_to_json(camera: str, knobs: Mapping[str, KnobValue]) -> dict[str, Any]:
    return {knob: Command(camera, knob, value).to_json()["value"] for knob, value in knobs.items()}
