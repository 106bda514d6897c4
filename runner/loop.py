"""The live loop of the vehicle: take an event, step, apply, log, tell. It stays dull."""

from __future__ import annotations

import json
import queue
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
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
        self._take_run(step(self.vehicle, self._run, ClockAdvanced(t=0.0)), None)
        next_tick = TICK_S
        while not self._stopped and (duration_s is None or self._now() < duration_s):
            try:
                document, answer = self._inbox.get(timeout=max(0.0, next_tick - self._now()))
            except queue.Empty:
                self._tick(next_tick)
                next_tick = max(next_tick + TICK_S, self._now() - TICK_S)
                continue
            if document:
                self._take_document(document, answer)

    def _now(self) -> float:
        return round(time.monotonic() - self._began, 6)

    def _tick(self, scheduled: float) -> None:
        """Time passes: where the drive comes from a track, the position with it."""
        t = max(self._now(), scheduled)
        if self.track is not None:
            position = self.track.at(t)
            self._take(position)
        self._take(ClockAdvanced(t=t))
        for fault in self.applier.faults():
            self.report(fault)

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

    def _take_run(self, after: Run, event: Event | None, answer: Answer | None = None) -> None:
        before, self._run = self._run, after
        self.applier.turn(after.commands)
        if event is not None:
            self.log.write(to_json(event))
        if after.refused:
            self.refused += 1
            self.report(f"refused: {after.refused}")
        if answer:
            said = {"t": after.state.t, "accepted": not after.refused}
            answer(said | ({"reason": after.refused} if after.refused else {}))
        if after.commands or after.decision is not before.decision and after.decision != before.decision:
            self._tell(before, event)

    def _tell(self, before: Run, event: Event | None) -> None:
        after = self._run
        decision = {"t": after.state.t, **after.decision.to_json()}
        commands = [command.to_json() for command in after.commands]
        self.log.write({**decision, "log": "decision", "commands": commands})
        self.publish("state", {"online": True, **decision})
        cause = "start" if event is None else _cause(event)
        for name, now in after.decision.settings.items():
            was = before.decision.settings[name]
            if (was.scaling, was.sending) != (now.scaling, now.sending):
                self.report(f"{cause} -> {name}: {now.reason}")

    def operator_lost(self) -> None:
        """The control link broke: for the vehicle, the operator is gone."""
        self.post({"event": "operator_disconnected"})


def _cause(event: Event) -> str:
    """An event in a few words."""
    said = to_json(event)
    words = (f"{key} {value}" for key, value in said.items() if key not in ("t", "event"))
    return " ".join((said["event"], *words))


