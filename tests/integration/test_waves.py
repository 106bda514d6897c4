"""Refresh waves that are asked for one by one: as often as the knob says, and none between."""

from __future__ import annotations

from fractions import Fraction

import inside

from rig import SMALL_ROBOT, streaming, until, watching
from runner.core.commands import Command

HZ = 20
RULE = "modes.collective.waves_by_loss={loss: 0.01, calm_s: 10}"
WORDS = (*SMALL_ROBOT, f"cameras.rear.fps={HZ}", RULE)


class Waves:
    """Of each encoded picture, its running time, s, whether it is a key picture, and whether a wave begins."""

    def __init__(self, side):
        from runner.gst import Gst

        self.pictures = []
        sent = inside.sender(side, "rear").get_by_name("sent")
        sent.get_static_pad("src").add_probe(Gst.PadProbeType.BUFFER, self._on_picture)

    def _on_picture(self, _pad, info):
        from runner.gst import Gst

        buffer = info.get_buffer()
        is_idr, begins = 5 in inside.nal_types(buffer), not buffer.has_flags(Gst.BufferFlags.DELTA_UNIT)
        self.pictures.append((buffer.pts / 1e9, is_idr, begins))
        return Gst.PadProbeReturn.OK

    def over(self, seconds):
        """When waves began within so many seconds of pictures, from now on."""
        first = len(self.pictures)
        until(lambda: len(self.pictures) >= first + seconds * HZ)
        assert not any(key for _, key, _ in self.pictures[first:])
        return [t for t, _, begins in self.pictures[first:] if begins]


def test_waves_come_as_often_as_they_are_asked_for():
    with streaming(*WORDS, cameras=("rear",)) as (side, setup, (plan,), _), watching(plan) as client:
        assert setup.vehicle.cameras["rear"].graph.settings.shortest_wave_s == 1.5

        def turn(**knobs):
            side.turn([Command("rear", knob, value) for knob, value in knobs.items()])

        turn(sending=True, size=(424, 240), bitrate=600, wave_s=Fraction(600))
        until(lambda: client.frames_with_retry() > 20)
        waves = Waves(side)
        assert waves.over(5) == []
        turn(wave_s=Fraction(1))
        began = waves.over(6)
        assert 4 <= len(began) <= 7
        turn(wave_s=Fraction(600))
        waves.over(1)
        assert waves.over(3) == []
