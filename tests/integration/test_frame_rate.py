"""The knob `fps`: fewer pictures from one picture to the next, at the bitrate as it was, without a key picture."""

from __future__ import annotations

import time
from fractions import Fraction
from itertools import pairwise

import inside
import pytest

from rig import SMALL_ROBOT, streaming, until, watching
from runner.core.commands import Command

HZ, KBPS = 40, 150
SIZE = (424, 240)
# Pictures that need more than the bitrate, and none of which x264 takes for a cut.
PATTERN = {"pattern": "zone-plate", "kx2": 20, "ky2": 20, "kt": 3}
WORDS = (
    *(*SMALL_ROBOT, "modes=motion", f"cameras.rear.fps={HZ}"),
    *(f"source.elements.0.properties.{key}={value}" for key, value in PATTERN.items()),
)


class Sent:
    """What a playing pipeline encodes and sends: running times of pictures, RTP times, caps, key pictures."""

    def __init__(self, side):
        from runner.gst import Gst

        self.pts, self.rtp, self.caps, self.keys, self.bytes = [], [], 0, 0, []
        pipeline = inside.sender(side, "rear")
        encoder = pipeline.get_by_name("encoder")
        kinds = Gst.PadProbeType.BUFFER | Gst.PadProbeType.BUFFER_LIST | Gst.PadProbeType.EVENT_DOWNSTREAM
        encoder.get_static_pad("sink").add_probe(kinds, self._on_raw)
        encoder.get_static_pad("src").add_probe(Gst.PadProbeType.BUFFER, self._on_encoded)
        pipeline.get_by_name("pay0").get_static_pad("src").add_probe(kinds, self._on_packet)

    def _on_raw(self, _pad, info):
        from runner.gst import Gst

        if info.type & Gst.PadProbeType.EVENT_DOWNSTREAM:
            self.caps += info.get_event().type == Gst.EventType.CAPS
        else:
            self.pts.append(info.get_buffer().pts)
        return Gst.PadProbeReturn.OK

    def _on_encoded(self, _pad, info):
        from runner.gst import Gst

        self.bytes.append(info.get_buffer().get_size())
        self.keys += 5 in inside.nal_types(info.get_buffer())
        return Gst.PadProbeReturn.OK

    def _on_packet(self, _pad, info):
        from runner.gst import Gst

        if info.type & (Gst.PadProbeType.BUFFER | Gst.PadProbeType.BUFFER_LIST):
            buffers = info.get_buffer_list() if info.type & Gst.PadProbeType.BUFFER_LIST else None
            for buffer in [buffers.get(i) for i in range(buffers.length())] if buffers else [info.get_buffer()]:
                stamp = int.from_bytes(buffer.extract_dup(4, 4), "big")
                if stamp not in self.rtp[-1:]:
                    self.rtp.append(stamp)
        return Gst.PadProbeReturn.OK

    def next(self, count):
        """Of the next so many pictures: intervals, ms, of capture and of RTP, kbit/s."""
        until(lambda: len(self.rtp) == len(self.pts) == len(self.bytes))
        first, packets = len(self.pts), len(self.rtp)
        until(lambda: len(self.rtp) >= packets + count and len(self.bytes) >= first + count)
        pts, rtp = self.pts[first : first + count], self.rtp[packets : packets + count]
        seconds = (pts[-1] - pts[0]) / 1e9
        captured = [(b - a) / 1e6 for a, b in pairwise(pts)]
        stamped = [(b - a) % 2**32 / 90 for a, b in pairwise(rtp)]
        return captured, stamped, 8 * sum(self.bytes[first + 1 : first + count]) / 1000 / seconds


def turn(side, **knobs):
    side.turn([Command("rear", knob, value) for knob, value in knobs.items()])


def test_fewer_pictures_at_the_same_bitrate_without_a_key_picture():
    with streaming(*WORDS, cameras=("rear",)) as (side, _, (plan,), reported), watching(plan) as client:
        turn(side, sending=True, size=SIZE, bitrate=KBPS, fps=Fraction(HZ))
        until(lambda: client.frames_with_retry() > 20)
        sent = Sent(side)
        for fps in (20, 8, 5, 40, 10, 40):
            turn(side, fps=Fraction(fps))
            until(lambda fps=fps: side.read()["rear"].applied["fps"] == fps)
            time.sleep(0.3)
            captured, stamped, kbps = sent.next(2 * fps)
            assert captured == pytest.approx([1000 / fps] * len(captured), abs=1)
            assert stamped == pytest.approx(captured, abs=0.1)
            assert (
                0.65 * KBPS < kbps < 1.1 * KBPS
            )  # x264 leaves some of a small buffer unused; without scaling, a fifth
        assert (sent.caps, sent.keys) == (0, 0)
        assert not [line for line in reported if "Hz" in line]
