"""A vehicle whose cameras this program feeds, and which fail on command.

    python fed_vehicle.py CONF OVERRIDE...

Each line of input is a camera and its new behaviour: `rear moves`, `rear hangs` (it delivers nothing) or
`rear repeats` (its last picture, as new); `rear loses` (the packets of its next picture, which nothing can repair,
then it goes on as before). The answer is the time of the change, s since 1970. Ends with its input.
"""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Iterator
from itertools import count, cycle
from pathlib import Path

import numpy as np

from runner.configuration.config import configuration
from runner.core.model import Camera, Vehicle
from runner.vehicle.live import LiveVehicle, live_vehicle

DOES = ("moves", "hangs", "repeats", "loses")
STEP_PX = 4  # of the picture from one to the next
NOISES, NOISE = 7, 12  # different ones, and their size: an encoder needs all of its bitrate for it


class Feed:
    """Pushes the pictures of all cameras, one after the other, at the rate of the first."""

    def __init__(self, vehicle: Vehicle, live: LiveVehicle) -> None:
        self._live = live
        self._moving = {name: moving(camera) for name, camera in vehicle.cameras.items()}
        self._shown = {name: next(pictures) for name, pictures in self._moving.items()}
        self._does = dict.fromkeys(vehicle.cameras, "moves")
        self._lock = threading.Lock()  # a camera's behaviour changes between two pictures
        self._pause_s = 1 / float(next(iter(vehicle.cameras.values())).fps) / len(vehicle.cameras)

    def set_behaviour(self, camera: str, does: str) -> float:
        """Returns the time of the change."""
        assert camera in self._does and does in DOES, f"{camera} {does}"
        with self._lock:
            if does == "loses":
                self._lose(camera)
            else:
                self._does[camera] = does
            return time.time()

    def _lose(self, camera: str) -> None:
        """Drop the packets of one picture before the server numbers the copies that it keeps for retransmission."""
        import inside

        from runner.gst import Gst

        packets = inside.sender(self._live.side, camera).get_by_name("pay0").get_static_pad("src")

        def drop(_pad: Gst.Pad, info: Gst.PadProbeInfo) -> Gst.PadProbeReturn:
            packets.remove_probe(info.id)
            return Gst.PadProbeReturn.DROP

        packets.add_probe(Gst.PadProbeType.BUFFER_LIST, drop)

    def run(self) -> None:
        due = time.monotonic()
        for name in cycle(self._shown):
            with self._lock:
                if self._does[name] == "moves":
                    self._shown[name] = next(self._moving[name])
                if self._does[name] != "hangs":
                    self._live.push(name, self._shown[name])
            due = max(due + self._pause_s, time.monotonic() - self._pause_s)  # lost time is not caught up
            time.sleep(max(0.0, due - time.monotonic()))


def moving(camera: Camera) -> Iterator[np.ndarray]:
    """Oblique bands of grey that move, with noise: I420."""
    width, height = camera.source_size
    x, y = np.meshgrid(np.arange(width), np.arange(height))
    bands = np.vstack([60 + (x + y) // 2 % 120, np.full((height // 2, width), 122)]).astype(np.uint8)
    chance = np.random.default_rng(1)
    noises = [chance.integers(NOISE, size=bands.shape, dtype=np.uint8) for _ in range(NOISES)]
    for number in count():
        yield np.roll(bands, STEP_PX * number, axis=1) + noises[number % NOISES]


def main(conf: str, *words: str) -> None:
    vehicle = configuration(words, Path(conf)).vehicle()
    with live_vehicle(words, Path(conf), say=lambda line: print(line, file=sys.stderr)) as live:
        live.start()
        feed = Feed(vehicle, live)
        threading.Thread(target=feed.run, name="feed", daemon=True).start()
        for line in sys.stdin:
            print(feed.set_behaviour(*line.split()), flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
