"""Decoded pictures for programs: numpy arrays with the camera's name and the time of capture.

    with live_frames(["vehicle=delivery_robot"], cameras=["front"]) as frames:
        for frame in frames:                          # waits for the next one
            detect(frame.image, frame.captured)       # uint8, height x width x 3, RGB

Runs alone, or in addition to an operator as a viewer like any other (`media.max_viewers`). A program that is slower
than the cameras gets the newest picture of each and misses others; nothing is queued.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from runner.configuration.config import configuration
from runner.core.model import Roi
from runner.errors import UserError, suggest
from runner.operator.awaited import Awaited, watched
from runner.plans import compile_plans
from runner.security.exposure import viewer_keyring

# A camera that delivers at most FEW frames may be off: it is expected, and rebuilt, only for RETRY_S of each PERIOD_S.
FEW, RETRY_S, PERIOD_S = 5, 5.0, 30.0


class Frame(NamedTuple):
    """One decoded picture.

    captured  s since 1970 by the vehicle's clock; None if the transport does not carry it
    image     uint8, height x width x 3, RGB; its size is that of the sent stream
    region    what it shows of the camera's full image, px; None: all of it, or the stream does not say, see
              docs/operator.md
    """

    camera: str
    captured: float | None
    image: NDArray[np.uint8]
    region: Roi | None = None


class Frames(Awaited[Frame]):
    """The newest picture of each camera, each returned once, in order of arrival."""

    def __init__(self) -> None:
        self._newest: dict[str, Frame] = {}
        super().__init__(self._newest, lambda: self._newest.pop(next(iter(self._newest))))

    def put(
        self, camera: str, captured: float | None, width: int, height: int, data: bytes, region: Roi | None = None
    ) -> None:
        """Add a picture from the decoder, whose rows may be padded."""
        rows = np.frombuffer(data, np.uint8).reshape(height, -1)[:, : width * 3]
        frame = Frame(camera, captured, rows.reshape(height, width, 3), region)
        with self._changed:
            self._newest[camera] = frame
            self._changed.notify()


@contextmanager
def live_frames(
    overrides: Sequence[str] = (),
    conf: Path | str | None = None,
    *,
    cameras: Sequence[str] | None = None,
    report: Callable[[str, str], None] = lambda camera, what: None,
) -> Iterator[Frames]:
    """Receive and decode cameras of a streaming vehicle; pipelines that fail or fall silent are rebuilt.

    A camera that stays silent may be off; its pipeline is rebuilt less often.

    overrides  Hydra overrides, as on the command line, also conf=DIR
    conf       directory of files of your own, which shadow the packaged ones
    cameras    names; None: all
    report     called with camera and what happened to it
    raises     ConfigError; UserError for an unknown camera or missing keys
    """
    from runner import apply

    setup = configuration(overrides, conf, runnable=False, check=apply.check_operator).setup()
    vehicle = setup.vehicle
    for name in cameras or ():
        if name not in vehicle.cameras:
            raise UserError("cameras", "", name, f"unknown camera{suggest(name, vehicle.cameras)}")
    plans = [plan for plan in compile_plans(setup) if cameras is None or plan.camera.name in cameras]
    frames, keyring = Frames(), viewer_keyring(setup)
    side = apply.OperatorSide(plans, report, on_picture=frames.put, keyring=keyring, vehicle=vehicle.name)
    expected = {plan.camera.name: True for plan in plans}
    delivered, since = dict.fromkeys(expected, 0), dict.fromkeys(expected, time.monotonic())

    def look() -> None:
        now = time.monotonic()
        for name, received in side.sample(expected).items():
            if received.frames - delivered[name] > FEW:
                delivered[name], since[name] = received.frames, now
            expected[name] = (now - since[name]) % PERIOD_S < RETRY_S

    with watched(side, frames, look):
        yield frames
