"""A vehicle that streams: cameras, loop and control link together. The verb `vehicle` runs it; so may your program.

with live_vehicle(["source=appsrc"]) as vehicle:
    vehicle.start()                               # the loop runs in a thread of its own
    while driving:
        vehicle.push("front_left", frame)         # I420, bytes or a contiguous array
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from runner.config import composed, load_run
from runner.control import OFFLINE, Link, read_request
from runner.drive.log import Log
from runner.graph import rtsp_url
from runner.loop import Loop
from runner.model import Progress
from runner.sources import compile_plans, render_missing

if TYPE_CHECKING:
    from runner.apply import VehicleSide


class LiveVehicle:
    """The parts of a vehicle that streams.

    side  the cameras
    loop  events in, commands out; `loop.post` takes events from any thread
    """

    def __init__(self, side: VehicleSide, loop: Loop) -> None:
        self.side, self.loop = side, loop
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Run the loop in a thread, until the vehicle is left."""
        self._thread = threading.Thread(target=self.loop.run, name="loop", daemon=True)
        self._thread.start()

    def push(self, camera: str, frame: Any) -> bool:
        """One frame of a camera whose source is `appsrc`, captured now.

        frame    I420 of the camera's (native) size: width * height * 3 / 2 bytes
        returns  False where nobody watches, so that the frame went nowhere
        raises   ValueError for a frame of another length, KeyError for an unknown camera
        """
        return self.side.push(camera, frame)

    def stop(self) -> None:
        self.loop.stop()
        if self._thread:
            self._thread.join()


@contextmanager
def live_vehicle(
    overrides: Sequence[str] = (),
    conf: Path | None = None,
    *,
    log: Path | None = None,
    say: Callable[[str], None] = print,
    progress: Progress = lambda what, done: None,
) -> Iterator[LiveVehicle]:
    """Everything that the vehicle's side needs, stopped and said goodbye for at the end.

    log       directory that the drive is recorded to
    say       told in a line what happens
    progress  told how far the rendering of a synthetic drive is
    raises    ConfigError, RunError
    """
    from runner import apply

    vehicle, pqos, track = load_run(overrides, conf, check=apply.check_plan)
    render_missing(vehicle, progress)
    plans = compile_plans(vehicle)
    apply.check_machine(plans)
    config = composed(overrides, conf).document if log else {}
    drive = Log(log, "vehicle", config, apply.versions(e for p in plans for e in (*p.source, *p.vehicle)), say)

    def note(what: str) -> None:
        say(what)
        drive.tell("note", text=what)

    video = apply.VideoFiles(log, drive.video) if log and vehicle.log_video else None
    side = apply.VehicleSide(plans, vehicle.media, lambda camera, what: note(f"{camera}: {what}"), video)

    def on_request(payload: bytes) -> None:
        document, identity, problem = read_request(payload)

        def answer(said: Any) -> None:
            link.publish("reply", {"id": identity, **said})

        if problem:
            loop.refuse(problem, answer)
        else:
            loop.post(document, answer)

    def on_connected(here: bool) -> None:
        if not here:
            loop.post({"event": "operator_disconnected"})  # for the vehicle, who cannot be heard is gone
        loop.tell_again()  # the broker has told the last will, or forgotten everything

    link = Link(vehicle.name, vehicle.control, ("state", OFFLINE), {"request": on_request}, on_connected)
    loop = Loop(vehicle, side, pqos, track, drive, link.publish, note)
    side.on_turned = loop.wake
    live = LiveVehicle(side, loop)
    try:
        link.connect()
        for plan in plans:
            say(f"{plan.camera.name}: {rtsp_url(vehicle.media, plan.camera.name) if plan.serves else 'dials out'}")
        yield live
    finally:
        live.stop()
        link.close("state", OFFLINE)
        side.stop()
        drive.close()
