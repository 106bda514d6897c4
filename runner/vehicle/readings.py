"""What the control loop read of the vehicle's streams last."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Protocol

from runner.core.budget import SOUND
from runner.records.vehicle import CameraReading, SoundReading


class Reader(Protocol):
    """What is read of the streaming side."""

    def read(self) -> Mapping[str, CameraReading]: ...
    def read_sound(self) -> SoundReading: ...


class Readings:
    """Of all streams; reports when the sound's source is lost, and when it is found again.

    sound  None: the vehicle sends none
    """

    def __init__(
        self, reader: Reader, cameras: Iterable[str], on_report: Callable[[str], None], *, has_sound: bool
    ) -> None:
        self._reader, self._on_report = reader, on_report
        self.cameras: Mapping[str, CameraReading] = dict.fromkeys(cameras, CameraReading())
        self.sound = SoundReading() if has_sound else None

    def read(self) -> None:
        self.cameras = self._reader.read()
        if self.sound is None:
            return
        before, self.sound = self.sound.lost, self._reader.read_sound()
        if self.sound.lost != before:
            found = "found again" if self.sound.lost is None else f"lost: {self.sound.lost}; trying again"
            self._on_report(f"{SOUND}: {found}")

    @property
    def streams(self) -> Mapping[str, CameraReading | SoundReading]:
        return self.cameras if self.sound is None else {**self.cameras, SOUND: self.sound}
