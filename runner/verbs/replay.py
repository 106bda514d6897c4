"""usage: tod-runner replay [OVERRIDE ...] [input=FILE] [output=FILE]

Events in, decisions out, one line of JSON for each; no video, no GStreamer, far faster than real time. Events come from
standard input or from input=, decisions go to standard output or to output=. schemas/event.schema.json says what an
event is. A line that is no event ends the run with its number; what was put out before stays. An event that cannot be
accepted is answered with "accepted": false and the reason, and the run goes on.

Predictions are those of the input. With a pqos= on the command line they are dropped and that source predicts instead,
from the positions and times of the input; its events are marked "source": "pqos".

  echo '{"t": 0, "event": "bitrate_predicted", "kbps": 3000}' | tod-runner replay modes=paper
  tod-runner replay input=drive/drive.jsonl modes=steady output=steadier.jsonl
  tod-runner replay input=drive/drive.jsonl pqos=map pqos.file=other_map.csv
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, TextIO

from runner.config import load, load_run
from runner.errors import UserError
from runner.events import BitratePredicted, Event, parse, to_json
from runner.model import Vehicle
from runner.schema import event_problem, read_json
from runner.step import Run, start, step
from runner.verbs import Arguments

if TYPE_CHECKING:
    from runner.pqos import Pqos

_encode = json.JSONEncoder(ensure_ascii=False).encode


def run(arguments: Arguments) -> int:
    pqos: Pqos | None = None
    if any(word.lstrip("+").startswith(("pqos=", "pqos.")) for word in arguments.overrides):
        vehicle, pqos, _ = load_run(arguments.overrides, arguments.conf, runnable=False)
    else:
        vehicle = load(arguments.overrides, arguments.conf, runnable=False)
    with _input(arguments) as (name, lines), _output(arguments) as output:
        for line in replay(vehicle, events(lines, name), pqos):
            output.write(line)
    return 0


def replay(vehicle: Vehicle, inputs: Iterable[tuple[dict[str, Any], Event]], pqos: Pqos | None = None) -> Iterator[str]:
    """One line of JSON per event, in order.

    pqos  predicts in place of the events' own predictions
    """
    now = start(vehicle)
    for document, event in inputs:
        if pqos is None:
            now = step(vehicle, now, event)
            yield answer(document, now)
            continue
        if not isinstance(event, BitratePredicted):
            now = step(vehicle, now, event)
            yield answer(document, now)
        prediction = pqos.observe(event)
        if prediction is not None:
            now = step(vehicle, now, prediction)
            yield answer(to_json(prediction) | {"source": "pqos"}, now)


def answer(document: dict[str, Any], now: Run) -> str:
    """The line that answers an event: what was heard, what is in force, what was commanded."""
    line = {"t": document["t"], "event": document["event"]}
    if "source" in document:
        line["source"] = document["source"]
    line["accepted"] = not now.refused
    if now.refused:
        line["reason"] = now.refused
    line |= now.decision.to_json()
    line["commands"] = [command.to_json() for command in now.commands]
    return _encode(line) + "\n"


def events(lines: Iterable[str], name: str) -> Iterator[tuple[dict[str, Any], Event]]:
    """Events of a JSON Lines text, each with the JSON it came from. Lines of a drive log that are no events are passed.

    raises  UserError with the number of the line
    """
    last = 0.0
    for number, line in enumerate(lines, 1):
        document, problem = read_event(line)
        if not problem and _is_log(document):
            continue
        if not problem and document["t"] < last:
            problem = f"t: {document['t']}: must not fall, the event before was at {last}"
        if problem:
            raise UserError(f"{name}: line {number}", "", None, problem)
        last = document["t"]
        yield document, parse(document)


def read_event(line: str) -> tuple[Any, str]:
    """The JSON of a line, and what is wrong with it as an event, or ""."""
    try:
        document = read_json(line.rstrip())
    except RecursionError:
        return None, "not JSON: nested too deeply"
    except json.JSONDecodeError as error:
        return None, f"not JSON: {error.msg} (column {error.pos + 1})"
    except ValueError as error:
        return None, f"not JSON: {error}"
    return document, "" if _is_log(document) else event_problem(document)


def _is_log(document: Any) -> bool:
    """Whether it is a line of a drive log that tells what the vehicle did: a decision, telemetry."""
    return isinstance(document, dict) and "log" in document and "event" not in document


@contextmanager
def _input(arguments: Arguments) -> Iterator[tuple[str, Iterable[str]]]:
    path = arguments.path("input")
    if path is None:
        sys.stdin.reconfigure(encoding="utf-8", errors="replace")  # type: ignore[union-attr]
        yield "standard input", sys.stdin
        return
    try:
        with path.open(encoding="utf-8", errors="replace") as file:
            yield str(path), file
    except (FileNotFoundError, IsADirectoryError, PermissionError) as error:
        raise UserError("command line", "input", repr(str(path)), (error.strerror or "").lower()) from None


@contextmanager
def _output(arguments: Arguments) -> Iterator[TextIO]:
    """Standard output line by line, or a file that is there only when the run has ended."""
    path = arguments.path("output")
    if path is None:
        # Someone may wait for each answer before sending the next event.
        sys.stdout.reconfigure(encoding="utf-8", line_buffering=True)  # type: ignore[union-attr]
        yield sys.stdout
        return
    # What is there and no file, such as /dev/null, is written to as it is.
    special = path.exists() and not path.is_file()
    unfinished = path if special else path.with_name(f".{path.name}.{os.getpid()}")
    try:
        file = unfinished.open("w", encoding="utf-8")
    except OSError as error:
        raise UserError("command line", "output", repr(str(path)), (error.strerror or "").lower()) from None
    try:
        with file:
            yield file
    finally:
        if not special:
            unfinished.replace(path)  # also after a bad line: what was put out before stays
