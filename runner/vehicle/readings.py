"""What the control loop read of the vehicle's streams last."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Protocol

from runner.core.budget import SOUND, VOICE
from runner.records.vehicle import CameraReading, SoundReading, VoiceReading
from runner.settings import Setup

if TYPE_CHECKING:
    from runner.vehicle.spoken import Spoken


class Reader(Protocol):
    """What is read of the streaming side."""

    def read(self) -> Mapping[str, CameraReading]: ...
    def read_sound(self) -> SoundReading: ...
    def read_voice(self) -> VoiceReading: ...


class Readings:
    """Of all streams; reports when the sound's source or the loudspeaker is lost or found again, and who spoke.

    sound  None: the vehicle sends none
    voice  None: it has no loudspeaker
    """

    def __init__(self, reader: Reader, setup: Setup, on_report: Callable[[str], None]) -> None:
        self._reader, self._on_report = reader, on_report
        self.cameras: Mapping[str, CameraReading] = dict.fromkeys(setup.vehicle.cameras, CameraReading())
        self.sound = SoundReading() if setup.sound else None
        self.voice = VoiceReading() if setup.voice else None
        self._spoken = _spoken() if setup.voice else None

    def read(self) -> None:
        self.cameras = self._reader.read()
        if self.sound is not None:
            before, self.sound = self.sound.lost, self._reader.read_sound()
            self._report_lost(SOUND, before, self.sound.lost)
        if self.voice is not None:
            before, self.voice = self.voice.lost, self._reader.read_voice()
            self._report_lost(VOICE, before, self.voice.lost)
            if self._spoken and (said := self._spoken.look(self.voice, time.monotonic())):
                self._on_report(said)

    def _report_lost(self, name: str, before: str | None, now: str | None) -> None:
        if now != before:
            self._on_report(f"{name}: {'found again' if now is None else f'lost: {now}; trying again'}")

    @property
    def streams(self) -> Mapping[str, CameraReading | SoundReading]:
        return self.cameras if self.sound is None else {**self.cameras, SOUND: self.sound}


def _spoken() -> Spoken:
    from runner.vehicle.spoken import Spoken

    return Spoken()
