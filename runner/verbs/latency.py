"""usage: tod-runner latency camera=NAME [OVERRIDE ...] [duration_s=20] [loop=false]

Measures glass-to-glass latency: a camera of the vehicle films this machine's screen, on which one page shows a
counter, and another page shows the camera's picture and reads the counter in it. Both pages use this machine's clock,
so no clocks are compared. The vehicle must be running. Ends duration_s after the first counter was read, with Ctrl-C,
or if no counter was read for five minutes. Without a vehicle it ends after 20 s.

Prints the measured latency; the latency from capture to drawing that the operator's page states for the same pictures;
the difference, which camera and screen add; and latency.fixed_ms, for the vehicle's file (latency: {fixed_ms: ...}) or
as an override of its side (latency.fixed_ms=...).

With loop=true the vehicle's side runs here, too, and its camera delivers drawn pictures of the counter. Without camera
and screen in between, the difference shows how far the page's latency can be trusted.

  tod-runner latency camera=front_center keys=keys/alice media.host=192.0.2.7 control.host=192.0.2.1 control.port=8883
  tod-runner latency camera=rear vehicle=delivery_robot loop=true fps_max=15
"""

from __future__ import annotations

import sys
import threading
import time
from collections import deque
from collections.abc import Collection, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from runner.configuration.config import configuration, with_choice
from runner.core.model import Camera, Vehicle
from runner.errors import ArgumentError, RunError, suggest
from runner.operator.station import Listener
from runner.records.lines import Note
from runner.security.exposure import KeysOfAll, page_keyring
from runner.settings import Setup
from runner.system.signals import stopping
from runner.verbs import Arguments
from runner.verbs.screen import SWITCH_S, progress_bar, say, streaming

if TYPE_CHECKING:
    from runner.operator.live import LiveOperator
    from runner.page.counter import CounterReading, GlassToGlass
    from runner.vehicle.live import LiveVehicle

DURATION_S = 20.0
START_S = 20.0  # how long the vehicle may take to answer
SHOWN_S = 300.0  # how long the user may take to show the counter to the camera
SAY_S = 2.0  # between two lines of progress
LOOK_S = 0.1
JOIN_S = 1.0
MOST_READINGS = 20_000  # the newest ones count


class _Notes(Listener):
    """Prints the notes of the operator's side."""

    def on_note(self, note: Note) -> None:
        say(note.text)


def run(arguments: Arguments) -> int:
    streaming()
    from runner.mqtt.broker import private_broker
    from runner.operator.live import live_operator
    from runner.page.server import PageServer

    duration = arguments.number("duration_s")
    looped = arguments.choice("loop") == "true"
    site = None if looped else arguments.site
    config = configuration(arguments.overrides, arguments.conf, runnable=False, site=site)
    setup = config.setup()
    camera = _camera(setup.vehicle, arguments.values.get("camera"))
    keys = KeysOfAll.of(setup) if looped else None
    own = [*arguments.overrides, *([f"keys={keys.controller}"] if keys else [])]
    page_keys = page_keyring(configuration(own, arguments.conf, runnable=False, site=site).setup())
    sys.setswitchinterval(SWITCH_S)
    readings: deque[CounterReading] = deque(maxlen=MOST_READINGS)

    def on_counter(reading: CounterReading) -> None:
        if reading.camera == camera.name:
            readings.append(reading)

    with ExitStack() as stack:
        if looped:
            stack.enter_context(private_broker(setup.control, keys.broker if keys else None, say))
            words = [*with_choice(arguments.overrides, "pqos", config), *([f"keys={keys.vehicle}"] if keys else [])]
            stack.enter_context(_looped_vehicle(words, arguments.conf, camera))
        operator = stack.enter_context(live_operator(own, arguments.conf, site=site))
        page = PageServer(operator.setup, operator.station, on_counter, keyring=page_keys)
        page.start()
        stack.callback(page.stop)
        operator.station.listeners += [page, _Notes()]
        if not looped:
            say(f"show {page.url}counter on this machine's screen to camera {camera.name}")
        say(f"open {page.url}#counter={camera.name} on this machine; neither page may cover the other")
        operator.start(page.show)
        stop = stack.enter_context(stopping(action=operator.end))
        decoded_ms = _collect(operator, camera.name, readings, DURATION_S if duration is None else duration)
        # Before both sides end, which takes a while: a second signal would lose the result.
        status = _show(camera.name, list(readings), decoded_ms, looped)
    return status or stop.status


def _camera(vehicle: Vehicle, name: str | None) -> Camera:
    """raises UserError"""
    if name is None:
        raise ArgumentError("camera", None, f"must be given: one of {', '.join(vehicle.cameras)}")
    if name not in vehicle.cameras:
        raise ArgumentError("camera", repr(name), f"unknown camera{suggest(name, vehicle.cameras)}")
    return vehicle.cameras[name]


@contextmanager
def _looped_vehicle(words: Sequence[str], conf: Path | None, camera: Camera) -> Iterator[None]:
    """Run the vehicle's side here; one of its cameras delivers pictures of the counter."""
    from runner.vehicle.live import live_vehicle

    words = [*words, f"+source@cameras.{camera.name}.source=appsrc"]
    with (
        progress_bar() as progress,
        live_vehicle(words, conf, say=say, progress=progress) as vehicle,
    ):
        ended = threading.Event()
        thread = threading.Thread(target=_film, args=(vehicle, camera, ended), name="counter", daemon=True)
        vehicle.start()
        thread.start()
        try:
            yield
        finally:
            ended.set()
            thread.join(JOIN_S)


def _film(vehicle: LiveVehicle, camera: Camera, ended: threading.Event) -> None:
    """Push a picture of the counter in each frame interval."""
    from runner.synthetic.counter import counter_frame

    width, height = camera.source_size
    interval = 1 / float(camera.fps)
    next_at = time.monotonic()
    while not ended.wait(max(0.0, next_at - time.monotonic())):
        vehicle.push(camera.name, counter_frame(time.time_ns() // 1_000_000, width, height))
        next_at = max(next_at + interval, time.monotonic())


def _collect(
    operator: LiveOperator, camera: str, readings: Collection[CounterReading], duration_s: float
) -> list[float]:
    """Wait until the counter was read for long enough, or was not read at all.

    returns  capture to decoding, ms, of each sample since the counter was first read
    raises   RunError if receiving has ended, or no vehicle answered
    """
    decoded_ms: list[float] = []
    first: float | None = None
    began = reported = time.monotonic()
    before, seen = None, False
    while operator.runs(LOOK_S):
        now, sampled = time.monotonic(), operator.station.samples
        if first is None and _count_read(readings):
            first = reported = now
        if first and sampled is not before and (received := sampled.get(camera)) and received.latency_ms is not None:
            decoded_ms.append(received.latency_ms)
        before = sampled
        seen = seen or operator.station.state is not None
        if not seen and now - began > START_S:
            raise RunError(_no_vehicle(operator.setup))
        if now - reported >= SAY_S and readings:
            reported = now
            say(f"counter read in {_count_read(readings)} of {len(readings)} pictures")
        if now - began > SHOWN_S if first is None else now - first > duration_s:
            break
    return decoded_ms


def _no_vehicle(setup: Setup) -> str:
    broker = f"{setup.control.host}:{setup.control.port}"
    rule = "start it with `tod-runner vehicle`, or check name=, control.host= and control.port="
    return f"no vehicle {setup.vehicle.name} has answered for {START_S:.0f} s over the broker at {broker}: {rule}"


def _count_read(readings: Collection[CounterReading]) -> int:
    """Pictures in which the counter was found."""
    return sum(reading.elapsed_ms is not None for reading in tuple(readings))


def _show(name: str, readings: Sequence[CounterReading], decoded_ms: Sequence[float], looped: bool) -> int:
    """Print what was measured; returns the exit status."""
    from runner.page.counter import MIN_READINGS, glass_to_glass

    if not readings:
        say(f"no page drew a picture of {name}")
        return 1
    found = glass_to_glass(readings, decoded_ms)
    if found is None:
        say(
            f"the counter was read in fewer than {MIN_READINGS} of {len(readings)} pictures of {name}: "
            "it must be sharp, upright, whole, and at least 130 px wide in the picture"
        )
        return 1
    print("\n".join(_lines(name, found, looped)), flush=True)
    return 0


def _lines(name: str, found: GlassToGlass, looped: bool) -> Iterator[str]:
    yield f"{name}: counter read in {found.read} of {found.pictures} pictures"
    yield f"  glass to glass      {found.median:4.0f} ms median, {found.p95:.0f} ms p95"
    if found.stated is None or found.bound is None or found.camera_and_screen is None:
        yield "  capture to drawing  unknown: no clocks were compared"
        return
    yield f"  capture to drawing  {found.stated:4.0f} ± {found.bound:.0f} ms, as the page states it"
    between = "the difference; no camera or screen in between" if looped else "the difference"
    yield f"  camera and screen   {found.camera_and_screen:4.0f} ± {found.bound:.0f} ms, {between}"
    if found.fixed is not None and not looped:
        known = f"{found.decoded:.0f} ms from capture to decoding"
        yield f"  latency.fixed_ms={found.fixed:.0f}, given {known}"
