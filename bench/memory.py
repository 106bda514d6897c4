"""Memory of the vehicle's process: by step of its start, by camera, and by element of a pipeline.

  python bench/memory.py                                  three cameras, three runs: three minutes
  python bench/memory.py vehicle=tum_q7 fps_max=0         Table I

Each row is what a step adds to the resident memory, median of the runs. The vehicle's steps run in sequence in one
process, as at its start. Elements are those of the first camera, in bare pipelines that are cut off after each of
them; memory that one frees for a later one, such as a buffer pool, does not show. Words are overrides of the vehicle.
"""

from __future__ import annotations

import needs_tests  # noqa: F401 (first: makes parts of the tests importable)  # isort: skip

import argparse
import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import Any

from cost import WORDS
from table import Row, show

from rig import free_port
from runner.apply import check_plan
from runner.configuration.config import configuration
from runner.core.commands import wanted
from runner.graph import launch
from runner.mqtt.broker import private_broker
from runner.plans import compile_plans
from runner.settings import Endpoint
from runner.turning import turn_elements
from runner.verbs.print import decide

RUNS = 3
LIMIT_S = 120.0
STEPS = Path(__file__).parent / "memory_steps.py"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=RUNS)
    parser.add_argument("words", nargs="*")
    options = parser.parse_args()
    show(rows(options.runs, options.words))


def rows(runs: int = RUNS, words: Sequence[str] = ()) -> list[Row]:
    words = [*WORDS, *words]
    steps = _vehicle(words, runs)
    whole = Row("memory: vehicle's process, total", sum(row.value for row in steps), "MB")
    return [*steps, whole, *_elements(words, runs)]


def _vehicle(words: Sequence[str], runs: int) -> list[Row]:
    growth = []
    for _ in range(runs):
        broker = Endpoint("127.0.0.1", free_port())
        with private_broker(broker):
            growth.append(_output("vehicle", *words, f"media.port={free_port()}", f"control.port={broker.port}"))
    return [Row(f"memory: {step}", median(each[step] for each in growth), "MB") for step in growth[0]]


def _elements(words: Sequence[str], runs: int) -> list[Row]:
    setup = configuration(words, check=check_plan).setup()
    plan = compile_plans(setup)[0]
    knobs = wanted(decide(setup.vehicle, None).settings[plan.camera.name])
    elements = turn_elements(plan.camera, (*plan.source, *plan.vehicle), knobs)
    rows, before = [], 0.0
    for count, element in enumerate(elements, start=1):
        line = f"{launch(elements[:count])} ! fakesink sync=false"
        now = median(_output("pipeline", line) for _ in range(runs))
        named = element.factory if count > 1 else f"Python, GStreamer, {element.factory}"
        rows.append(Row(f"memory of a pipeline: {named}", now - before, "MB"))
        before = now
    return rows


def _output(*command: str) -> Any:
    done = subprocess.run([sys.executable, STEPS, *command], check=True, stdout=subprocess.PIPE, timeout=LIMIT_S)
    return json.loads(done.stdout.splitlines()[-1])


if __name__ == "__main__":
    main()
