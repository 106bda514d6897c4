"""Clips of a synthetic drive show the same place of it at the same time, whenever each was started."""

from __future__ import annotations

import time
from contextlib import contextmanager
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest

from rig import until
from runner.configuration.config import configuration
from runner.graph import compile_graph, launch

pytestmark = [pytest.mark.gst]
SECONDS, FPS, SIZE = 2.0, Fraction(20), (64, 48)
FRAMES = int(SECONDS * FPS)
STEP = 5  # of brightness, between two frames


@pytest.fixture(scope="module")
def plan(tmp_path_factory):
    """A camera whose clip shows the number of each frame as its brightness."""
    from runner.apply import write_clip

    clip = tmp_path_factory.mktemp("drive") / "clip.mp4"
    (width, height), grey = SIZE, bytes([128])
    pictures = (bytes([20 + STEP * k]) * (width * height) + grey * (width * height // 2) for k in range(FRAMES))
    write_clip(clip, pictures, width, height, FPS)
    setup = configuration(["vehicle=delivery_robot"]).setup()
    front = replace(setup.vehicle.cameras["front"], width=width, height=height, native=None, crop=None, fps=FPS)
    return compile_graph(front, setup.media, clip=str(clip))


class Playing:
    """Frames of a clip as they leave its source: by how much each is ahead of the drive, s, negative if behind."""

    def __init__(self, plan):
        from gi.repository import Gst

        from runner.gst.source import loop_clip

        self.ahead, self.pause_s = [], 0.0
        self._pipeline = Gst.parse_launch(f"{launch(plan.source)} ! fakesink name=out signal-handoffs=true sync=false")
        self._pipeline.get_by_name("out").connect("handoff", self._on_frame)
        loop_clip(self._pipeline, plan, SECONDS)
        self._pipeline.set_state(Gst.State.PLAYING)

    def _on_frame(self, _sink, frame, _pad):
        number = round((np.frombuffer(frame.extract_dup(0, SIZE[0] * SIZE[1]), np.uint8).mean() - 20) / STEP)
        due_s = (self._pipeline.get_base_time() + frame.pts) / 1e9  # by the monotonic clock
        apart = (number / float(FPS) - due_s) % SECONDS
        self.ahead.append(apart - SECONDS if apart > SECONDS / 2 else apart)
        time.sleep(self.pause_s)

    @property
    def is_in_step(self):
        """Whether the last second was."""
        last = self.ahead[-int(FPS) :]
        return len(last) == int(FPS) and max(map(abs, last)) < 1 / FPS

    def stop(self):
        from gi.repository import Gst

        self._pipeline.set_state(Gst.State.NULL)


@contextmanager
def playing(plan):
    clip = Playing(plan)
    try:
        yield clip
    finally:
        clip.stop()


def test_cameras_that_start_at_different_times_show_the_same_place(plan):
    with playing(plan) as first:
        until(lambda: first.is_in_step, seconds=20)
        time.sleep(0.7)
        with playing(plan) as second:
            until(lambda: first.is_in_step and second.is_in_step, seconds=20)
            until(lambda: len(second.ahead) > 3 * FRAMES and first.is_in_step and second.is_in_step, seconds=20)


def test_a_clip_that_lagged_is_where_the_others_are_from_the_next_round_on(plan):
    from gi.repository import GLib

    def handle_timers():
        while GLib.MainContext.default().iteration(False):
            pass

    with playing(plan) as clip:
        until(lambda: clip.is_in_step, seconds=20)
        clip.pause_s = 3 / float(FPS)  # a machine that is too slow
        until(lambda: handle_timers() or clip.ahead[-1] < -0.3, seconds=20)
        clip.pause_s = 0.0
        until(lambda: clip.is_in_step, seconds=20)
