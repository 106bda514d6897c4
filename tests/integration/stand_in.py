"""Both sides without GStreamer: commands are recorded, and answered as if every camera streamed."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from runner.apply import Reception
from runner.core.commands import Command, KnobValue
from runner.graph import Plan
from runner.records.reception import Arrivals, SentFrame, UplinkReceived, UplinkSent
from runner.records.vehicle import CameraReading, EncoderCounts, SenderStages, SoundReading, VoiceReading

FRAMES = 5  # delivered by a sending camera between two samples
FRAME_BYTES = 1000


def encoded(frames: int) -> EncoderCounts:
    return EncoderCounts(frames, FRAME_BYTES * frames)


class RecordingVehicle:
    """Stands in for `runner.apply.VehicleSide`.

    watched     cameras that have a pipeline: their commands count as applied
    commands    all that were received, in order
    key_frames  cameras whose encoder was to start anew, in order
    lost        by camera whose source cannot be opened, why
    """

    def __init__(self, plans: Sequence[Plan], *_: Any) -> None:
        self._names = [plan.camera.name for plan in plans]
        self._lock = threading.Lock()
        self._wanted: dict[str, dict[str, KnobValue]] = {name: {} for name in self._names}
        self._sent = dict.fromkeys(self._names, 0)
        self.watched: set[str] = set()
        self.commands: list[Command] = []
        self.drivers: tuple[str, ...] = ()
        self.key_frames: list[str] = []
        self.lost: dict[str, str] = {}
        self.on_turned: Callable[[], None] = lambda: None

    @property
    def beat(self) -> float:
        return time.monotonic()

    def watch(self, *names: str) -> None:
        self.watched = set(names)
        self.on_turned()

    def turn(self, commands: Iterable[Command]) -> None:
        with self._lock:
            for command in commands:
                self.commands.append(command)
                self._wanted[command.camera][command.knob] = command.value
        self.on_turned()

    def read(self) -> dict[str, CameraReading]:
        with self._lock:
            applied = {name: dict(knobs) if name in self.watched else {} for name, knobs in self._wanted.items()}
        for name, knobs in applied.items():
            self._sent[name] += FRAMES if knobs.get("sending") else 0
        return {
            name: CameraReading(knobs, encoded(self._sent[name]), lost=self.lost.get(name))
            for name, knobs in applied.items()
        }

    def read_sound(self) -> SoundReading:
        return SoundReading()

    def read_voice(self) -> VoiceReading:
        return VoiceReading()

    def stages(self) -> dict[str, SenderStages]:
        return {}

    def sent_frames(self) -> dict[str, list[SentFrame]]:
        return {}

    def sent(self) -> dict[str, dict[str, UplinkSent]]:
        return {}

    def send_key_frames(self, cameras: Iterable[str], *, begin_anew: bool = False) -> None:
        self.key_frames += cameras

    def give_control(self, drivers: Sequence[str], in_control: str = "") -> None:
        self.drivers = tuple(drivers)

    def push(self, camera: str, frame: Any) -> bool:
        return camera in self.watched

    def push_shared(self, camera: str, picture: Any) -> bool:
        os.close(picture.memory)
        return camera in self.watched

    def stop(self) -> None:
        self.watched = set()


class RecordingOperator:
    """Stands in for `runner.apply.OperatorSide`: cameras that should send deliver frames of a fixed size."""

    sound = None

    def __init__(self, plans: Sequence[Plan], *_: Any, **__: Any) -> None:
        self._received = {plan.camera.name: Reception() for plan in plans}

    def sample(self, sending: Mapping[str, bool], anew: bool = False) -> dict[str, Reception]:
        for name, received in self._received.items():
            frames = received.frames + (FRAMES if sending.get(name) else 0)
            size = (640, 480) if frames else (0, 0)
            self._received[name] = Reception(frames, FRAME_BYTES * frames, frames, 0, 0, *size)
        return dict(self._received)

    def received(self) -> dict[str, dict[str, UplinkReceived]]:
        return {}

    def take_arrivals(self) -> dict[str, Arrivals]:
        return {"": Arrivals({}, {})}

    def stop(self) -> None:
        self._received = {}
