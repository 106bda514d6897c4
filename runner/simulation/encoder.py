"""A camera's encoder: how many bytes each frame has. Pure."""

from __future__ import annotations

import math
import random
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

from runner.core.commands import Command
from runner.core.model import Camera


@dataclass(frozen=True)
class EncoderModel:
    """How sizes of frames depart from bitrate / frame rate.

    The rate control buffer of a graph holds one and a half frames, so what one frame takes more the next ones have to
    give back. Measured with the packaged settings of x264 (`bench/frame_sizes.py`, four recordings at 15 Hz, 100 to
    1500 kbit/s): means over a drive 91 to 100 % of the bitrate, over a second within 0.1 to 5 % of that; deviation of a
    frame 7 to 20 %, correlation with the frame before -0.4 to 0.4; a key frame 0.8 to 1.3 of the mean and 0.6 to 0.9 in
    the frame after it. Less bitrate is obeyed by the next frame, of three times as much 0.3, 0.7, 0.9 and 1.

    filled     share of the bitrate that encoders use on average
    error      standard deviation (ln) of the rate that an encoder misses for a while
    error_s    correlation time of that
    noise      sizes of successive frames vary by at most this share
    key_frame  what a key frame has more, as a share of the mean
    returned   share of what the frames before had more that the next one has less
    rise       share of a higher bitrate that each further frame makes up for
    """

    filled: float = 0.975
    error: float = 0.03
    error_s: float = 1.0
    noise: float = 0.15
    key_frame: float = 0.25
    returned: float = 0.6
    rise: float = 0.6


class Encoder:
    """The encoder of one camera. Its start, a change of size and a request make the next frame a key frame."""

    def __init__(self, camera: Camera, model: EncoderModel, rng: random.Random) -> None:
        self._model, self._uniform, self._gauss = model, rng.uniform, rng.gauss
        self._set = 0.0  # bytes of a frame at the bitrate that is set; 0: nothing is sent
        self._mean = 0.0  # that it follows
        self._send_at(camera.fps)
        self.restarts = camera.graph.key_frame is not None  # whether it makes a key frame on request
        self.frames = self.bytes = 0
        self.key = True  # whether the next frame is a key frame
        self._error = rng.gauss(0, model.error) if model.error else 0.0
        self._more = 0.0  # that the last frames took more, in frames
        self._values: dict[str, Any] = {}

    def _send_at(self, fps: Fraction) -> None:
        self.interval_s = float(1 / fps)
        self._keep = math.exp(-self.interval_s / self._model.error_s)
        self._drawn = self._model.error * math.sqrt(1 - self._keep**2)

    @property
    def sends(self) -> bool:
        return self._set > 0

    @property
    def uplinks(self) -> tuple[str, ...]:
        """That carry the camera; empty: all of them, or there is one."""
        return tuple(self._values.get("uplinks", ()))

    def turn(self, command: Command) -> None:
        """Turn a knob, before the next frame."""
        before = self._values.get(command.knob)
        self._values[command.knob] = command.value
        if command.knob == "size" and before != command.value:
            self.key = True
        if command.knob == "fps" and isinstance(command.value, Fraction):
            before_s = self.interval_s
            self._send_at(command.value)
            self._mean *= self.interval_s / before_s
        sending, kbps = self._values.get("sending", False), self._values.get("bitrate", 0)
        self._set = self._model.filled * kbps * 125 * self.interval_s if sending else 0.0
        if not self._mean or self._set < self._mean:
            self._mean = self._set

    def frame(self) -> int:
        """Bytes of the next frame; 0: none is sent."""
        if not self._set:
            return 0
        model, noise = self._model, self._model.noise
        own = self._uniform(1 - noise, 1 + noise)
        if self.key:
            self.key = False
            own += model.key_frame
        share = own - model.returned * self._more
        self._more += share - 1
        size = self._mean * share
        if self._drawn:
            self._error = self._keep * self._error + self._gauss(0, self._drawn)
            size *= math.exp(self._error)
        self._mean += model.rise * (self._set - self._mean)
        whole = max(1, int(size))
        self.frames, self.bytes = self.frames + 1, self.bytes + whole
        return whole
