"""Cost of a change while playing, and latency by transport: commands, sizes and bitrate steps over real RTSP.

  python bench/live.py                       everything, about two minutes
  python bench/live.py --clip CLIP.mp4       steps on your own clip; by default on the synthetic drive

Run it on an otherwise idle machine; both sides share it.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any

from table import Row, show, spread

from runner.apply import VehicleSide, check_plan
from runner.configuration.config import configuration
from runner.core.commands import Command
from runner.gst import Gst, knobs
from runner.gst.caps import structure
from runner.gst.receiver import capture_time
from runner.plans import compile_plans, render_missing
from runner.settings import Setup

PORT = 18554
Sample = tuple[float, int, int, int, float | None]  # time, width, height, bytes, capture time


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--clip", type=Path)
    parser.add_argument("--rounds", type=int, default=60)
    words = parser.parse_args()
    source = ["source=file", f'source.clip="{words.clip}"'] if words.clip else ["source=synthetic"]
    show(rows(source, words.rounds))


def rows(source: Sequence[str] = ("source=synthetic",), rounds: int = 60) -> list[Row]:
    steps = (row for fps in (15, 40) for row in bitrate_step(source, fps))
    latencies = (row for fps in (15, 40) for row in latency(source, fps))
    return [*command_latency(source, rounds), *size_change(source, rounds), *steps, *latencies]


def command_latency(source: Sequence[str], rounds: int) -> Iterator[Row]:
    """From a decision for all cameras to the last encoder that applies it; eight cameras as the demo runs them."""
    setup = _setup([*source, "fps_max=15"])
    with _recorded() as applied, _streaming(setup) as side, _operator([*source, "fps_max=15"]):
        _until(lambda: all(camera.encoded.frames > 30 for camera in side.read().values()))
        for what, sizes in (("bitrate", []), ("bitrate and size", [(960, 520), (480, 260)])):
            last, each = [], []
            for n in range(rounds):
                commands = [Command(name, "bitrate", 500 + n % 7 * 40) for name in setup.vehicle.cameras]
                if sizes:
                    commands += [Command(name, "size", sizes[n % 2]) for name in setup.vehicle.cameras]
                applied.clear()
                began = time.perf_counter()
                side.turn(commands)
                _until(lambda: len(applied) >= len(setup.vehicle.cameras), 2)
                waits = sorted(1000 * (at - began) for at in applied)
                last.append(waits[-1])
                each += waits
                time.sleep(0.137)
            yield spread(f"{what}: command to encoder", each, "ms")
            yield spread(f"{what}: command to the last of {len(setup.vehicle.cameras)} encoders", last, "ms")


def size_change(source: Sequence[str], rounds: int) -> Iterator[Row]:
    """One camera at 40 Hz: from a new size to its first decoded frame, and the longest gap between frames."""
    setup = _one_camera(source, 40)
    sizes = [(960, 520), (480, 260), (240, 130)]
    waits: list[float] = []
    with _streaming(setup) as side, _client(setup) as (samples, errors):
        _until(lambda: len(samples) > 40)
        start = len(samples)
        for n in range(rounds):
            size = sizes[n % 3]
            began, seen = time.time(), len(samples)
            side.turn([Command("front_left", "size", size), Command("front_left", "bitrate", 1000)])
            _until(lambda size=size, seen=seen: any(s[1:3] == size for s in samples[seen:]))
            first = next(s for s in samples[seen:] if s[1:3] == size)
            waits.append((first[0] - began) * 40)
            time.sleep(0.31)
        times = [s[0] for s in samples[start:]]
    gaps = [(b - a) * 40 for a, b in pairwise(times)]
    yield spread("first frame of a new size decoded after", waits, "intervals")
    yield Row("longest gap between frames", max(gaps), "intervals", note=f"of {len(gaps)}")
    yield Row("decoder errors", len(errors), "", most=0)


def bitrate_step(source: Sequence[str], fps: int) -> Iterator[Row]:
    """4000 -> 1000 kbit/s, with and without a change of factor: bitrate on the wire, as a multiple of the new one."""
    setup = _one_camera(source, fps)
    for what, size in (("same factor", (960, 520)), ("factor 0.5 -> 0.25", (480, 260))):
        with _streaming(setup) as side, _client(setup) as (samples, _):
            side.turn([Command("front_left", "size", (960, 520)), Command("front_left", "bitrate", 4000)])
            time.sleep(5)
            side.turn([Command("front_left", "size", size), Command("front_left", "bitrate", 1000)])
            began = time.time()
            time.sleep(4.5)
        before = _kbps(samples, began - 2, began)
        early, late = _kbps(samples, began, began + 0.5), _kbps(samples, began + 2, began + 4)
        note = f"seconds 2 to 4 {late / 1000:.2f}; {before:.0f} kbit/s before"
        yield Row(f"4000 -> 1000 at {fps} Hz, {what}: first 0.5 s", early / 1000, "of 1000", note=note)


def latency(source: Sequence[str], fps: int) -> Iterator[Row]:
    """From the capture of a picture to its decoded frame, by the transport of its packets."""
    setup = _one_camera(source, fps)
    for transport in ("udp", "tcp"):
        with _streaming(setup) as side, _client(setup, transport) as (samples, _):
            side.turn([Command("front_left", "size", (960, 520)), Command("front_left", "bitrate", 2000)])
            _until(lambda samples=samples: len(samples) > fps)
            start = len(samples)
            time.sleep(5)
        waits = [1000 * (s[0] - s[4]) for s in samples[start:] if s[4] is not None]
        yield spread(f"capture to decoded picture at {fps} Hz over {transport.upper()}", waits, "ms")


# --- parts ------------------------------------------------------------------------------------------------------------


def _setup(overrides: Sequence[str]) -> Setup:
    setup = configuration([*overrides, f"media.port={PORT}"], check=check_plan).setup()
    render_missing(setup.vehicle, lambda what, done: print(f"\r{what} {done:4.0%}", end="", file=sys.stderr))
    return setup


def _one_camera(source: Sequence[str], fps: int) -> Setup:
    setup = _setup([*source, f"fps_max={fps}"])
    return setup.with_cameras({"front_left": setup.vehicle.cameras["front_left"]})


@contextmanager
def _streaming(setup: Setup) -> Iterator[VehicleSide]:
    side = VehicleSide(compile_plans(setup), setup.media, lambda *_: None)
    try:
        yield side
    finally:
        side.stop()


@contextmanager
def _operator(overrides: Sequence[str]) -> Iterator[None]:
    """Receives and decodes all cameras in its own process, as the operator does."""
    code = (
        "import sys, time; from runner.apply import OperatorSide;"
        "from runner.configuration.config import configuration;"
        "from runner.plans import compile_plans;"
        "side = OperatorSide(compile_plans(configuration(sys.argv[1:]).setup()), lambda *_: None); time.sleep(600)"
    )
    command = [sys.executable, "-c", code, *overrides, f"media.port={PORT}"]
    with subprocess.Popen(command) as child:
        try:
            yield
        finally:
            child.kill()


@contextmanager
def _client(setup: Setup, transport: str = "udp+tcp") -> Iterator[tuple[list[Sample], list[str]]]:
    """Decodes the one camera and records each frame; bytes are those of the access unit before it."""
    (plan,) = compile_plans(setup)
    pipeline = Gst.parse_launch(plan.receiver)
    Gst.util_set_object_arg(pipeline.get_by_name(plan.operator[0].name), "protocols", transport)
    samples: list[Sample] = []
    errors: list[str] = []
    sizes: list[int] = []

    def on_unit(_pad: Any, info: Any) -> Any:
        sizes.append(info.get_buffer().get_size())
        return Gst.PadProbeReturn.OK

    def on_frame(pad: Any, info: Any) -> Any:
        picture = structure(pad.get_current_caps())
        width, height = picture.get_int("width")[1], picture.get_int("height")[1]
        samples.append((time.time(), width, height, sizes[-1], capture_time(info.get_buffer())))
        return Gst.PadProbeReturn.OK

    def on_message(_bus: Any, message: Any) -> Any:
        kinds = Gst.MessageType
        parse = {kinds.ERROR: message.parse_error, kinds.WARNING: message.parse_warning}.get(message.type)
        if parse:
            errors.append(parse()[0].message)
        return Gst.BusSyncReply.PASS

    pipeline.get_by_name("received").get_static_pad("src").add_probe(Gst.PadProbeType.BUFFER, on_unit)
    pipeline.get_by_name("sink").get_static_pad("sink").add_probe(Gst.PadProbeType.BUFFER, on_frame)
    pipeline.get_bus().set_sync_handler(on_message)
    pipeline.set_state(Gst.State.PLAYING)
    try:
        yield samples, errors
    finally:
        pipeline.set_state(Gst.State.NULL)


@contextmanager
def _recorded() -> Iterator[list[float]]:
    """Times at which knobs are set, of the pipelines that are built in the meantime."""
    times: list[float] = []
    original = knobs.KnobPanel._apply_pending

    def timed(self: knobs.KnobPanel) -> None:
        pending = bool(self._pending)
        original(self)
        if pending:
            times.append(time.perf_counter())

    knobs.KnobPanel._apply_pending = timed
    try:
        yield times
    finally:
        knobs.KnobPanel._apply_pending = original


def _until(done: Any, seconds: float = 60) -> None:
    end = time.monotonic() + seconds
    while not done():
        if time.monotonic() > end:
            raise SystemExit("timed out; is the machine idle?")
        time.sleep(0.0005)


def _kbps(samples: Sequence[Sample], start: float, end: float) -> float:
    return sum(s[3] for s in samples if start <= s[0] < end) * 8 / 1000 / (end - start)


if __name__ == "__main__":
    main()
