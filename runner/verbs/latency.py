"""usage: tod-runner latency camera=NAME [OVERRIDE ...] [duration_s=20] [loop=false]

Measures latency from light to light: a camera of the vehicle films this machine's screen, on which one page shows a
counter, and another page shows the camera's picture and reads the counter in it. Both pages use this machine's clock:
no clocks are compared. The vehicle must be running. Ends duration_s after the first counter was read, or with Ctrl-C.

Prints what was measured, what the operator's page states for the same pictures, from capture to drawing, what camera
and screen add, which is the difference, and latency.fixed_ms for the vehicle's YAML.

With loop=true the vehicle's side runs here, too, and its camera delivers drawn pictures of the counter. Without camera
and screen in between, the difference shows how far the page's latency can be trusted.

  tod-runner latency camera=front_center media.host=192.0.2.7 control.host=192.0.2.7
  tod-runner latency camera=rear vehicle=delivery_robot loop=true fps_max=15
"""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING

from runner.configuration.config import configuration
from runner.core.model import Camera, Vehicle, suggest
from runner.errors import UserError
from runner.system.signals import Stop, stopping
from runner.verbs import Arguments
from runner.verbs.screen import SWITCH_S, say, streaming

if TYPE_CHECKING:
    from runner.operator.station import Station
    from runner.page.counter import CounterReading, LightToLight
    from runner.vehicle.live import LiveVehicle

DURATION_S = 20.0
SHOWN_S = 300.0  # how long the user may take to show the counter to the camera
SAY_S = 2.0  # between two lines of progress
JOIN_S = 1.0


def run(arguments: Arguments) -> int:
    streaming()
    from runner.mqtt.broker import private_broker
    from runner.operator.live import live_operator
    from runner.page.server import PageServer

    duration = arguments.number("duration_s")
    looped = arguments.choice("loop", ("false", "true")) == "true"
    vehicle = configuration(arguments.overrides, arguments.conf, runnable=False).vehicle()
    camera = _camera(vehicle, arguments.values.get("camera"))
    sys.setswitchinterval(SWITCH_S)
    readings: list[CounterReading] = []
    with ExitStack() as stack:
        if looped:
            stack.enter_context(private_broker(vehicle.control))
            stack.enter_context(_filmed(arguments, camera))
        operator = stack.enter_context(live_operator(arguments.overrides, arguments.conf))
        page = PageServer(operator.vehicle, operator.station, on_counter=readings.append)
        stack.callback(page.stop)
        page.start()
        operator.station.listeners.append(page)
        if not looped:
            say(f"show {page.url}counter on this screen, full screen, to camera {camera.name}")
        say(f"open {page.url}#counter={camera.name} on this machine, and keep it visible")
        operator.start(page.show)
        stop = stack.enter_context(stopping(action=operator.end))
        decoded_ms = _collect(stop, readings, DURATION_S if duration is None else duration, operator.station, camera)
    return _result(camera.name, readings, decoded_ms) or stop.status


def _camera(vehicle: Vehicle, name: str | None) -> Camera:
    """raises UserError"""
    if name is None:
        raise UserError("command line", "camera", None, f"must be given: one of {', '.join(vehicle.cameras)}")
    if name not in vehicle.cameras:
        raise UserError("command line", "camera", repr(name), f"unknown camera{suggest(name, vehicle.cameras)}")
    return vehicle.cameras[name]


@contextmanager
def _filmed(arguments: Arguments, camera: Camera) -> Iterator[None]:
    """The vehicle's side, one of whose cameras delivers pictures of the counter."""
    from runner.vehicle.live import live_vehicle

    words = [*arguments.overrides, f"+source@cameras.{camera.name}.source=appsrc"]
    with live_vehicle(words, arguments.conf, say=lambda line: None) as vehicle:
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
    following = time.monotonic()
    while not ended.wait(max(0.0, following - time.monotonic())):
        vehicle.push(camera.name, counter_frame(time.time_ns() // 1_000_000, width, height))
        following = max(following + interval, time.monotonic())


def _collect(
    stop: Stop, readings: Sequence[CounterReading], duration_s: float, station: Station, camera: Camera
) -> list[float]:
    """Wait until the counter was read for long enough, or was not read at all.

    returns  capture to decoding, ms, ten times a second
    """
    decoded_ms: list[float] = []
    first: float | None = None
    began = said = time.monotonic()
    while not stop.wait(0.1):
        now = time.monotonic()
        sampled = station.samples.get(camera.name)
        if sampled and sampled.latency_ms is not None:
            decoded_ms.append(sampled.latency_ms)
        if first is None and any(reading.elapsed_ms is not None for reading in readings):
            first = said = now
        if now - said >= SAY_S and readings:
            said = now
            read = sum(reading.elapsed_ms is not None for reading in readings)
            say(f"counter read in {read} of {len(readings)} pictures")
        if now - began > SHOWN_S if first is None else now - first > duration_s:
            break
    return decoded_ms


def _result(name: str, readings: Sequence[CounterReading], decoded_ms: Sequence[float]) -> int:
    """Print what was measured; returns the exit status."""
    from runner.page.counter import FEWEST, light_to_light

    own = [reading for reading in readings if reading.camera == name]
    if not own:
        say(f"no page drew a picture of {name}")
        return 1
    found = light_to_light(own, decoded_ms)
    if found is None:
        say(
            f"the counter was read in fewer than {FEWEST} of {len(own)} pictures of {name}: "
            "it must be sharp, upright, whole, and at least 130 px wide in the picture"
        )
        return 1
    print("\n".join(_lines(name, found)))
    return 0


def _lines(name: str, found: LightToLight) -> Iterator[str]:
    yield f"{name}: counter read in {found.read} of {found.pictures} pictures"
    yield f"  light to light      {found.median:4.0f} ms median, {found.p95:.0f} ms p95"
    if found.stated is None or found.bound is None or found.outside is None:
        yield "  capture to drawing  unknown: no clocks were compared"
        return
    yield f"  capture to drawing  {found.stated:4.0f} ± {found.bound:.0f} ms, as the page states it"
    yield f"  camera and screen   {found.outside:4.0f} ± {found.bound:.0f} ms, the difference"
    if found.fixed is not None:
        known = f"{found.decoded:.0f} ms from capture to decoding"
        yield f"  latency.fixed_ms={max(0, round(found.fixed))}, as the vehicle knows of {known}"
