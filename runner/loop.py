"""The live loop of the vehicle: take an event, step, apply, log, tell. It stays dull."""

from __future__ import annotations

import json
import queue
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol

from runner.commands import Command, KnobValue
from runner.events import ClockAdvanced, Event, parse, to_json
from runner.model import Vehicle
from runner.pqos import Pqos
from runner.pqos.track import Track
from runner.schema import event_problem
from runner.step import Run, start, step

TICK_S = 0.1  # time between clock_advanced events
TELEMETRY_TICKS = 5
Answer = Callable[[Mapping[str, Any]], None]


class Applier(Protocol):
    """What the loop asks of the side that streams."""

    def turn(self, commands: Iterable[Command]) -> None: ...
    def applied(self) -> Mapping[str, Mapping[str, KnobValue]]: ...
    def sent(self) -> Mapping[str, tuple[int, int]]: ...
    def faults(self) -> list[str]: ...


class Log:
    """The drive log: lines of JSON appended one by one, so that a killed process loses at most the last one.

    directory  None: nothing is kept
    """

    def __init__(self, directory: Path | None) -> None:
        self._file = None
        if directory is not None:
            directory.mkdir(parents=True, exist_ok=True)
            self._file = (directory / "drive.jsonl").open("a", encoding="utf-8", buffering=1)

    def write(self, document: Mapping[str, Any]) -> None:
        if self._file:
            self._file.write(json.dumps(document, ensure_ascii=False) + "\n")


@dataclass
class Loop:
    """Events in, commands out, in one thread. Other threads `post` what they have.

    publish  told the applied state, retained, whenever a decision changed
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
    _inbox: queue.SimpleQueue[tuple[Mapping[str, Any], Answer | None]] = field(default_factory=queue.SimpleQueue)
    _stopped: bool = False
    _ticks: int = 0

    def post(self, document: Mapping[str, Any], answer: Answer | None = None) -> None:
        """An event as JSON without `t`, from any thread; `answer` is told what came of it."""
        self._inbox.put((document, answer))

    def stop(self) -> None:
        self._stopped = True
        self._inbox.put(({}, None))

    def run(self, duration_s: float | None = None) -> None:
        """Work until stopped, or for a time."""
        self._began = time.monotonic()
        self._warned = 0
        self._run = start(self.vehicle)
        self._take(ClockAdvanced(t=0.0))
        next_tick = TICK_S
        while not self._stopped and (duration_s is None or self._now() < duration_s):
            try:
                document, answer = self._inbox.get(timeout=max(0.0, next_tick - self._now()))
            except queue.Empty:
                self._tick()
                next_tick = max(next_tick + TICK_S, self._now() - TICK_S)
                continue
            if document:
                self._take_document(document, answer)

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

    def _take_document(self, document: Mapping[str, Any], answer: Answer | None) -> None:
        stamped = {**document, "t": self._now()}
        problem = event_problem(stamped)
        if problem:
            self.refused += 1
            if answer:
                answer({"t": stamped["t"], "accepted": False, "reason": problem})
            return
        self._take(parse(stamped), answer)

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
        self.log.write(to_json(event))
        if after.refused:
            self.refused += 1
            self.report(f"refused: {after.refused}")
        if answer:
            said = {"t": after.state.t, "accepted": not after.refused}
            answer(said | ({"reason": after.refused} if after.refused else {}))
        if after.commands or after.decision != before.decision:
            self._tell(before, event)

    def _tell(self, before: Run, event: Event) -> None:
        after = self._run
        decision = {"t": after.state.t, **after.decision.to_json()}
        commands = [command.to_json() for command in after.commands]
        self.log.write({**decision, "log": "decision", "commands": commands})
        self.publish("state", {"online": True, **decision})
        cause = _cause(event)
        for name, now in after.decision.settings.items():
            was = before.decision.settings[name]
            if (was.scaling, was.sending) != (now.scaling, now.sending):
                self.report(f"{cause} -> {name}: {now.reason}")

    def _tell_measured(self, t: float) -> None:
        """What was read back from the elements, and what the encoders have put out so far."""
        sent = self.applier.sent()
        cameras = {
            name: {
                "applied": {c.knob: c.to_json()["value"] for c in (Command(name, *item) for item in knobs.items())},
                "frames": sent[name][0],
                "bytes": sent[name][1],
            }
            for name, knobs in self.applier.applied().items()
        }
        telemetry = {"t": t, "cameras": cameras, "refused": self.refused}
        self.log.write({**telemetry, "log": "telemetry"})
        self.publish("telemetry", telemetry)


def _cause(event: Event) -> str:
    """An event in a few words."""
    said = to_json(event)
    words = (f"{key} {value}" for key, value in said.items() if key not in ("t", "event"))
    return " ".join((said["event"], *words))


