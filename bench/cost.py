"""What the vehicle's side costs compared with a bare GStreamer RTSP server with the same launch lines, in pairs.

  python bench/cost.py                                    three cameras, five pairs of 15 s: six minutes
  python bench/cost.py --pairs 3 vehicle=tum_q7           Table I, eight cameras at 3000 kbit/s in total

Rows: processor time and memory of the vehicle's process, latency from capture to the client's parser, time from the
start until every camera has a picture, and from the request for a new size until the first picture of that size
arrives. Words are overrides of the vehicle.
"""

from __future__ import annotations

import needs_tests  # noqa: F401 (first: makes parts of the tests importable)  # isort: skip

import argparse
import json
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import count
from pathlib import Path
from statistics import median
from typing import IO, Any, NamedTuple

from table import Row, show
from usage import memory_mb, processor_s

from rig import Operator, answers, free_port, until
from runner.apply import check_plan
from runner.configuration.config import configuration
from runner.core.commands import wanted
from runner.core.model import exact
from runner.core.scaling import output_size
from runner.graph import launch
from runner.mqtt.broker import private_broker
from runner.plans import compile_plans
from runner.settings import Endpoint, Setup
from runner.turning import assignments, turn_elements
from runner.verbs.print import decide

WORDS = ("vehicle=delivery_robot", "source=test", "mode=single", "modes=open_loop", "pqos=constant", "pqos.kbps=3000")
SETTLE_S = 3.0
SIZES = (0.75, 0.5)  # scaling factors that alternate, for the time until a new size arrives
RESIZES, RESIZE_S = 20, 0.7
WAIT_S = 30.0
HERE = Path(__file__).parent


class Cost(NamedTuple):
    """Of one run of one server.

    cores     processor time per wall time
    memory    resident, MB
    latency   from capture to the client, ms, median
    start     until each camera has a picture, s
    reaction  until a new size arrives, ms, median
    frames    share of the frames due that were received
    """

    cores: float
    memory: float
    latency: float
    start: float
    reaction: float
    frames: float


class Frame(NamedTuple):
    """As the client received it; see bench/bare.py."""

    stream: int
    t: float
    age_ms: float | None
    width: int


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pairs", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=15)
    parser.add_argument("words", nargs="*")
    options = parser.parse_args()
    show(rows(options.pairs, options.seconds, options.words))


def rows(pairs: int = 5, seconds: float = 15, words: Sequence[str] = ()) -> list[Row]:
    """Medians of the pairs."""
    costs = [(bare_cost([*WORDS, *words], seconds), vehicle_cost([*WORDS, *words], seconds)) for _ in range(pairs)]

    def row(what: str, unit: str, key: str, *, compared: bool = True) -> Row:
        bare, own = (median(getattr(pair[side], key) for pair in costs) for side in (0, 1))
        return Row(what, own, unit, bare if compared else None)

    return [
        row("vehicle: processor", "cores", "cores"),
        row("vehicle: memory", "MB", "memory"),
        # A bare server's packets carry no capture time: its sender reports count from the encoder's output.
        row("capture to client", "ms", "latency", compared=False),
        row("start to all pictures", "s", "start"),
        row("new size to its first picture", "ms", "reaction"),
        row("frames received", "of those due", "frames"),
    ]


# --- the two servers --------------------------------------------------------------------------------------------------


def bare_cost(words: Sequence[str], seconds: float, resizes: int = RESIZES) -> Cost:
    """Of a bare server with the launch lines of a vehicle. words: the vehicle's overrides"""
    port = free_port()
    setup = _setup([*words, f"media.port={port}"])
    decision = decide(setup.vehicle, None)
    lines = {}
    for plan in compile_plans(setup):
        knobs = wanted(decision.settings[plan.camera.name])
        lines[plan.camera.name] = f"( {launch(turn_elements(plan.camera, (*plan.source, *plan.vehicle), knobs))} )"
    began = time.time()
    with child_of([HERE / "bare.py", "serve", str(port)], stdin=subprocess.PIPE) as server:
        assert server.stdin
        write_line(server.stdin, lines)

        def resize(name: str, scaling: float) -> None:
            camera = setup.vehicle.cameras[name]
            size = output_size(camera.full_roi, exact(scaling))
            for element, key, value in assignments(camera, "size", size):
                write_line(server.stdin, [name, element, key, str(value)])  # type: ignore[arg-type]

        return _measured(setup, server.pid, began, seconds, resizes, resize)


def vehicle_cost(words: Sequence[str], seconds: float, resizes: int = RESIZES) -> Cost:
    """Of the vehicle's side. words: its overrides"""
    media, broker = free_port(), Endpoint("127.0.0.1", free_port())
    words = [*words, f"media.port={media}", f"control.port={broker.port}"]
    setup = _setup(words)
    with private_broker(broker):
        began = time.time()
        with child_of(["-m", "runner", "vehicle", *words]) as side:
            operator = Operator(broker, setup.vehicle.name)
            operator.state(lambda state: state["online"])
            numbers = count()

            def resize(name: str, scaling: float) -> None:
                reply = operator.ask(f"{next(numbers)}", event="camera_configured", camera=name, scaling=scaling)
                assert reply["result"] == "applied", reply

            return _measured(setup, side.pid, began, seconds, resizes, resize)


# --- measuring --------------------------------------------------------------------------------------------------------


def _measured(setup: Setup, pid: int, began: float, seconds: float, resizes: int, resize: Any) -> Cost:
    names = list(setup.vehicle.cameras)
    urls = [f"rtsp://127.0.0.1:{setup.media.port}/{name}" for name in names]
    frames: list[Frame] = []
    until(lambda: answers(setup.media.port), WAIT_S, every_s=0.005)
    with child_of([HERE / "bare.py", "watch", *urls], stdout=subprocess.PIPE) as client:
        threading.Thread(target=read_frames, args=(client.stdout, frames), daemon=True).start()
        until(lambda: {frame.stream for frame in list(frames)} == set(range(len(names))), WAIT_S, every_s=0.005)
        first = {frame.stream: frame.t for frame in reversed(list(frames))}
        time.sleep(SETTLE_S)
        used_s, start = processor_s(pid), time.time()
        time.sleep(seconds)
        took_s, cores = time.time() - start, (processor_s(pid) - used_s) / (time.time() - start)
        received = [frame for frame in list(frames) if start <= frame.t < start + took_s]
        memory = memory_mb(pid)
        reaction = _reaction(names, frames, resizes, resize)
    due = sum(float(camera.fps) for camera in setup.vehicle.cameras.values()) * took_s
    ages = [frame.age_ms for frame in received if frame.age_ms is not None]
    return Cost(cores, memory, median(ages), max(first.values()) - began, reaction, len(received) / due)


def _reaction(names: Sequence[str], frames: list[Frame], resizes: int, resize: Any) -> float:
    """Median ms from the request for a new size of the first camera until a picture of another width arrives."""
    waits = []
    for number in range(resizes):
        before = next(frame.width for frame in reversed(list(frames)) if frame.stream == 0)
        began = time.time()
        resize(names[0], SIZES[number % 2])

        def first_new(since: float = began, old: int = before) -> Frame | None:
            new = (frame for frame in list(frames) if frame.t > since and frame.stream == 0 and frame.width != old)
            return next(new, None)

        until(first_new, WAIT_S, every_s=0.002)
        found = first_new()
        assert found
        waits.append(1000 * (found.t - began))
        time.sleep(RESIZE_S)
    return median(waits)


def read_frames(lines: IO[str], frames: list[Frame]) -> None:
    for line in lines:
        frames.append(Frame(*json.loads(line)))


def _setup(words: Sequence[str]) -> Setup:
    return configuration(words, check=check_plan).setup()


@contextmanager
def child_of(command: Sequence[Any], **pipes: int) -> Iterator[subprocess.Popen[str]]:
    pipes = {"stdout": subprocess.DEVNULL, **pipes}
    child = subprocess.Popen([sys.executable, *command], text=True, stderr=subprocess.DEVNULL, **pipes)
    try:
        yield child
    finally:
        child.terminate()
        try:
            child.wait(10)
        except subprocess.TimeoutExpired:
            child.kill()
            child.wait()


def write_line(pipe: IO[str], what: Any) -> None:
    pipe.write(json.dumps(what) + "\n")
    pipe.flush()


if __name__ == "__main__":
    main()
