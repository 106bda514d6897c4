"""Latency of a picture on the vehicle: from its capture to the encoder, and through the encoder."""

from __future__ import annotations

import time
from collections.abc import Iterable

from gi.repository import Gst

from runner.gst.clocks import captured_at
from runner.gst.probes import BufferProbe, PassingBuffer
from runner.records.vehicle import SenderStages
from runner.system.recent import RecentValue

SAME_S = 1e-4  # capture times of the same picture before and after the encoder differ by less
MAX_PICTURES = 100  # pictures that leave the encoder before the awaited one is given up


class EncoderWatch:
    """Measures sampled pictures as they enter and leave the encoder; no Python runs for the others.

    elements  of the pipeline from gate to payloader; nothing is measured unless one is an encoder
    encoder   None if none is
    """

    def __init__(self, elements: Iterable[Gst.Element]) -> None:
        self.encoder = encoder = next((element for element in elements if _is_encoder(element)), None)
        self._into = BufferProbe(encoder.get_static_pad("sink"), self._on_raw) if encoder else None
        self._out = BufferProbe(encoder.get_static_pad("src"), self._on_coded) if encoder else None
        self._remaining = 0
        self._entered = (0.0, 0.0)  # capture time, s since 1970; ms from it to the encoder
        self._measured = RecentValue[SenderStages]()

    def take(self) -> SenderStages | None:
        """The latest measurement, if recent; starts one of the next picture.

        To be called a few times a second, from one thread.
        """
        if self._into and self._out and not self._out.armed:
            self._into.arm()
        return self._measured.get()

    def _on_raw(self, pad: Gst.Pad, picture: PassingBuffer) -> bool:
        if picture.pts is None:
            return False
        captured, self._remaining = captured_at(pad, picture.pts), MAX_PICTURES
        self._entered = (captured, 1000 * (time.time() - captured))
        assert self._out
        self._out.arm()
        return True

    def _on_coded(self, pad: Gst.Pad, picture: PassingBuffer) -> bool:
        now = time.time()
        captured, capture_ms = self._entered
        ahead_s = captured_at(pad, picture.pts or 0) - captured
        self._remaining -= 1
        if ahead_s < -SAME_S and self._remaining:
            return False  # an earlier picture
        if abs(ahead_s) < SAME_S:  # otherwise the encoder has dropped the picture
            self._measured.set(SenderStages(round(capture_ms, 2), round(1000 * (now - captured) - capture_ms, 2)))
        return True


def _is_encoder(element: Gst.Element) -> bool:
    return "Encoder" in (element.get_factory().get_metadata("klass") or "")
