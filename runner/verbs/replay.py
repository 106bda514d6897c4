"""usage: tod-runner replay [-m] [OVERRIDE ...] [input=FILE|DIR] [output=FILE] [log=DIR] [link=again]
                         [positions=BAG [topic=NAME]]

Turns events into decisions, one line of JSON for each; no video, no GStreamer, far faster than real time. Events come
from standard input or from input=, decisions go to standard output or to output=. schemas/event.schema.json defines
events. An invalid line ends the run with an error that states its number; output up to then is kept. An event that
cannot be accepted is answered with "accepted": false and the reason, and the run continues.

A drive (the directory that log= wrote, or its drive.jsonl) is replayed with its own configuration: the decisions are
those of the drive. Overrides change that configuration and so answer "what if"; with log= the result is written as a
new drive, for `report`, and to output= only if that is given. A drive of an older log format is refused.

Predictions are taken from the input. With a pqos= on the command line, or uplinks.NAME.pqos=, they are dropped and that
source predicts instead, from the positions and times of the input; its events are marked "source": "pqos".

Link measurements are taken from the input. With link=again they are made again from the drive's reception reports;
the same version makes the same events.

Positions are taken from the input. With positions=BAG they are replaced by those of a ROS bag that was recorded during
the drive (sensor_msgs/NavSatFix), marked "source": "bag"; topic= is needed if it has several such topics.

With -m, which needs input=, commas and range() define a sweep: each combination of values is a run over the same
events. Each line begins with the key overrides; with log=DIR the drives are DIR/0, DIR/1, ...

  echo '{"t": 0, "event": "bitrate_predicted", "kbps": 3000}' | tod-runner replay modes=paper
  tod-runner replay input=drive output=decisions.jsonl
  tod-runner replay input=drive modes=steady log=steadier    other rules; then: tod-runner report drive steadier
  tod-runner replay input=drive pqos=map pqos.file=other_map.csv
  tod-runner replay input=drive positions=gps.bag pqos=map pqos.file=other_map.csv
  tod-runner replay input=drive link=again     for a change of what is measured
  tod-runner replay input=drive cameras.rear_center.weight=2
  tod-runner replay input=drive vehicle=delivery_robot
  tod-runner replay -m input=drive modes=safe,steady cameras.rear_center.weight=1,2
"""

from __future__ import annotations

import json
import os
import re
import sys
from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from itertools import chain, islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TextIO

from msgspec import UNSET

from runner.configuration.config import Base, configuration
from runner.core.decision import Decision
from runner.core.events import NAMES, BitratePredicted, Event, LinkMeasured, PositionReported, parse, to_json
from runner.core.model import Vehicle
from runner.core.step import Run, start, step
from runner.drive.log import FILES, Log, check_free
from runner.drive.read import OTHER_KINDS, REPORTS, check_began, is_log, read_line, read_lines, text_lines
from runner.errors import ArgumentError, UserError, os_errors_as
from runner.records.decisions import decision_to_json
from runner.records.lines import KINDS, Began, ClockSet, line_from_json
from runner.records.reception import ReceptionReported
from runner.schema import log_problem
from runner.system.files import whole_file
from runner.verbs import Arguments

if TYPE_CHECKING:
    from runner.drive.positions import RecordedPositions
    from runner.pqos import Predictions
    from runner.vehicle.uplink import MeasuredUplinks

InputEvent = tuple[dict[str, Any], Event]  # an event, as JSON and parsed
OTHER_PQOS = re.compile(r"\+*(pqos[=.@]|uplinks\.[^.=]+\.pqos[=.])")  # an override of a source of predictions
CHANGING = ("link", "positions", "topic")  # arguments that change the events
NOTHING_PREDICTED = (
    "the source of predictions on the command line has predicted nothing from this input (a map needs positions in it);"
    " the input's own predictions are ignored"
)

_encode = json.JSONEncoder(ensure_ascii=False, check_circular=False).encode


class _Prepared(NamedTuple):
    """Everything a run needs apart from the events. pqos, positions: they replace those of the events"""

    arguments: Arguments
    config: Mapping[str, Any]
    vehicle: Vehicle
    pqos: Predictions | None
    positions: RecordedPositions | None


def run(arguments: Arguments) -> int:
    if arguments.sweeps:
        return _sweep(arguments)
    with _input(arguments) as (name, text):
        lines, began = _begin(text, name)
        began = began and _corrected(began, arguments)
        one = _prepare(arguments, name, began, _positions(arguments, began))
        _check(arguments)
        with _output(arguments) as output:
            output.writelines(_output_lines(one, lines, name, began))
    return 0


def _sweep(arguments: Arguments) -> int:
    from runner.verbs.sweep import prepare_all

    if arguments.path("input") is None:
        raise ArgumentError("-m", None, "reads the events once for each run: give input=FILE")
    with _input(arguments) as (name, text):
        _, began = _begin(text, name)
    began = began and _corrected(began, arguments)
    positions = _positions(arguments, began)
    runs = prepare_all(arguments, lambda own: _prepare(own, name, began, positions))
    logged = [one._replace(arguments=one.arguments.in_directory(str(n), ["log"])) for n, (_, one) in enumerate(runs)]
    for one in logged:
        _check(one.arguments)
    with _output(arguments) as output:
        for (words, _), own in zip(runs, logged, strict=True):
            with _input(arguments) as (_, text):
                lines, _ = _begin(text, name)
                output.writelines(
                    f'{{"overrides": {_encode(words)}, {line[1:]}' for line in _output_lines(own, lines, name, began)
                )
    return 0


def _prepare(arguments: Arguments, name: str, began: Began | None, positions: RecordedPositions | None) -> _Prepared:
    config = configuration(arguments.overrides, arguments.conf, base=_base(name, began), runnable=False)
    pqos = config.pqos()[0] if any(map(OTHER_PQOS.match, arguments.overrides)) else None
    return _Prepared(arguments, config.document, config.vehicle(), pqos, positions)


def _positions(arguments: Arguments, began: Began | None) -> RecordedPositions | None:
    if arguments.values.keys().isdisjoint(("positions", "topic")):
        return None
    from runner.drive.positions import given_positions

    recorded = given_positions(arguments.values)
    if began is None:
        rule = "needs a drive as input: events alone do not state when they happened"
        raise ArgumentError("positions", recorded.where, rule)
    return recorded


def _check(arguments: Arguments) -> None:
    """Check the command line before the output is opened, which keeps what was written before an error in the input."""
    arguments.choice("link")
    if directory := arguments.path("log"):
        check_free(directory, "vehicle")


def _output_lines(run: _Prepared, lines: Iterable[str], name: str, began: Began | None) -> Iterator[str]:
    """The output lines of a run, which is logged if requested."""
    inputs = events(lines, name, _uplink(run.arguments, run.vehicle))
    if run.positions and began:
        inputs = _with_positions(inputs, run.positions, began)
    with _log(run.arguments, run.config, began) as log:
        yield from replay(run.vehicle, inputs, run.pqos, log)


def _uplink(arguments: Arguments, vehicle: Vehicle) -> MeasuredUplinks | None:
    """What measures the link again; None: the logged measurements are used."""
    if arguments.choice("link") == "logged":
        return None
    from runner.vehicle.uplink import MeasuredUplinks

    return MeasuredUplinks(vehicle)


def _begin(text: Iterable[str], name: str) -> tuple[Iterable[str], Began | None]:
    """All lines, and the first record of their drive; None: they are events only."""
    lines = iter(text)
    first = list(islice(lines, 1))
    line, problem = read_line(first[0]) if first else ({}, "")
    if problem or not is_log(line) or line["log"] != "began":
        return chain(first, lines), None
    if problem := log_problem(line):
        raise UserError(f"{name}: line 1", "", None, problem)
    began = check_began(line, name)
    if began.side != "vehicle":
        raise UserError(f"{name}: line 1", "side", repr(began.side), f"has no events, they are in {FILES['vehicle']}")
    return chain(first, lines), began


def _corrected(began: Began, arguments: Arguments) -> Began:
    """The first record with the start by the clock as it was set last; from standard input, as it was logged."""
    if arguments.path("input") is None:
        return began
    with _input(arguments) as (_, text):
        steps = (read_line(line)[0] for line in text if KINDS[ClockSet] in line)
        # Wrong lines are skipped here as `events` skips them, which reads no line of this kind.
        valid = (step for step in steps if is_log(step) and step["log"] == KINDS[ClockSet] and not log_problem(step))
        return replace(began, time=began.time + sum(step["by_s"] for step in valid))


def _base(name: str, began: Began | None) -> Base | None:
    """The configuration of a drive."""
    return (dict(began.config), f"{name}: line 1: config") if began else None


@contextmanager
def _log(arguments: Arguments, config: Mapping[str, Any], began: Began | None) -> Iterator[Log | None]:
    """The result as a drive, which exists only when it is complete; None if not requested."""
    directory = arguments.path("log")
    if directory is None:
        yield None
        return
    log = Log(directory, "vehicle", config, {}, lambda what: print(what, file=sys.stderr))
    try:
        log.begin(began.time if began else 0.0, _words(arguments, began))
        yield log
    except BaseException:
        log.discard()
        raise
    log.close()


def _words(arguments: Arguments, began: Began | None) -> tuple[str, ...]:
    """What distinguishes this replay from the drive; a replay may be replayed in turn."""
    before = began.replayed if began and began.replayed is not UNSET else ()
    chosen = (f"{name}={arguments.values[name]}" for name in CHANGING if name in arguments.values)
    return (*before, *arguments.overrides, *chosen)


def replay(
    vehicle: Vehicle, inputs: Iterable[InputEvent], pqos: Predictions | None = None, log: Log | None = None
) -> Iterator[str]:
    """One line of JSON per event, in order.

    pqos  its predictions replace those of the events
    log   written as the vehicle would have written it
    """
    now, answers = start(vehicle), _Answers()
    for document, event in inputs if pqos is None else _with_predictions(inputs, pqos):
        before, now = now, step(vehicle, now, event)
        if log:
            log.on_step(before, event, now)
        yield answers.line(document, now)


def _with_positions(inputs: Iterable[InputEvent], recorded: RecordedPositions, began: Began) -> Iterator[InputEvent]:
    """The events with the positions of a bag in place of their own."""
    from runner.drive.read import time_span

    waiting, last, found = deque(recorded.since(began.time)), 0.0, False
    for document, event in inputs:
        last = event.t
        while waiting and waiting[0].t <= last:
            position, found = waiting.popleft(), True
            yield to_json(position) | {"source": "bag"}, position
        if not isinstance(event, PositionReported):
            yield document, event
    if not found:
        raise recorded.no_overlap(f"the input: {time_span(began.time, began.time + last)}")


def _with_predictions(inputs: Iterable[InputEvent], pqos: Predictions) -> Iterator[InputEvent]:
    """The events with the predictions of another source in place of their own."""
    found = False
    for document, event in inputs:
        if not isinstance(event, BitratePredicted):
            yield document, event
        for prediction in pqos.observe(event):
            found = True
            yield to_json(prediction) | {"source": "pqos"}, prediction
    if not found:
        print(NOTHING_PREDICTED, file=sys.stderr)


class _Answers:
    """The lines that answer events: the event, the decision in force, the commands."""

    def __init__(self) -> None:
        self._decision: Decision | None = None
        self._text = ""  # of that decision; encoded only once an event leaves it unchanged, as most do

    def line(self, document: dict[str, Any], now: Run) -> str:
        acknowledged = _acknowledgement(document, now)
        commands = [command.to_json() for command in now.commands]
        if self._decision is None or not now.decision.equals_with_reasons(self._decision):
            self._decision, self._text = now.decision, ""
            return f"{_encode(acknowledged | decision_to_json(now.decision) | {'commands': commands})}\n"
        self._text = self._text or _encode(decision_to_json(self._decision))[1:-1]
        turned = _encode(commands) if commands else "[]"
        return f'{_encode(acknowledged)[:-1]}, {self._text}, "commands": {turned}}}\n'


def _acknowledgement(document: Mapping[str, Any], now: Run) -> dict[str, Any]:
    """The event, and whether it was accepted."""
    acknowledged = {"t": document["t"], "event": document["event"]}
    if "source" in document:
        acknowledged["source"] = document["source"]
    acknowledged["accepted"] = not now.refused
    if now.refused:
        acknowledged["reason"] = now.refused
    if now.fault:
        acknowledged["fault"] = now.fault
    return acknowledged


def events(lines: Iterable[str], name: str, uplink: MeasuredUplinks | None = None) -> Iterator[InputEvent]:
    """Events of a JSON Lines text, each with the JSON it came from. Other lines of a drive log are skipped.

    uplink  measures the link again from the drive's reception reports, in place of the drive's own measurements
    raises  UserError with the number of the line
    """
    dropped, warnings, is_empty = 0, list[str](), True
    skipped = OTHER_KINDS if uplink else (*OTHER_KINDS, REPORTS)
    for _, document in read_lines(lines, name, warnings, skipped=skipped):
        if is_log(document):
            if document["log"] == "dropped":
                dropped += document["lines"]
                continue
            record = line_from_json(document) if uplink else None
            if uplink and isinstance(record, ReceptionReported) and (measured := uplink.take(record)):
                is_empty = False
                yield to_json(measured), measured
            continue
        if uplink and document["event"] == NAMES[LinkMeasured]:
            continue
        is_empty = False
        yield document, parse(document)
    if is_empty:
        warnings.append(f"{name}: has no events, so there is nothing to replay")
    if dropped:
        warnings.append(f"{name}: dropped lines: {dropped}; decisions may differ from the drive's")
    print("\n".join(warnings), end="\n" if warnings else "", file=sys.stderr)


@contextmanager
def _input(arguments: Arguments) -> Iterator[tuple[str, Iterable[str]]]:
    path = arguments.path("input")
    if path is None:
        sys.stdin.reconfigure(encoding="utf-8", errors="replace")  # type: ignore[union-attr]
        yield "standard input", text_lines(sys.stdin)
        return
    with os_errors_as(lambda why: ArgumentError("input", path, why)):
        path = path / FILES["vehicle"] if path.is_dir() else path
        _check_not_input(path, arguments.path("output"))
        file = path.open(encoding="utf-8", errors="replace")
    with file:
        yield str(path), text_lines(file)


def _check_not_input(path: Path, output: Path | None) -> None:
    """raises UserError if the input would be overwritten"""
    if output and output.is_file() and path.exists() and output.samefile(path):
        raise ArgumentError("output", output, "is the input, choose another file")


@contextmanager
def _output(arguments: Arguments) -> Iterator[TextIO]:
    """Standard output line by line, or a file that appears only when the run has ended.

    With log= the result is a drive, which contains the decisions; they go to another file only if output= names it.
    """
    path = arguments.path("output")
    if path is None and arguments.path("log"):
        path = Path(os.devnull)
    if path is None:
        # The sender of the events may wait for each answer before sending the next one.
        sys.stdout.reconfigure(encoding="utf-8", line_buffering=arguments.path("input") is None)  # type: ignore[union-attr]
        yield sys.stdout
        return
    with whole_file(path, partly=True) as file:
        yield file
