"""How long a picture takes on the vehicle: from its capture into the encoder, and through it."""

from __future__ import annotations

import time
from collections.abc import Iterable
from typing import NamedTuple

from gi.repository import Gst

from runner.gst.clocks import captured_at
from runner.gst.one_shot import OneShot, PassingBuffer
from runner.system.recent import RecentValue

SAME_S = 1e-4  # capture times of the same picture on both sides of the encoder differ by less
PATIENCE = 100  # pictures that leave the encoder before the one that was awaited is given up


class SenderStages(NamedTuple):
    """Of one picture, ms. capture: to the encoder's input, with conversion, cropping and scaling."""

    capture_ms: float
    encode_ms: float


class EncoderWatch:
    """Measures one picture in many as it enters and leaves the encoder: no Python runs for the others.

    elements  of the pipeline from gate to payloader; without an encoder among them nothing is measured
    """

    def __init__(self, elements: Iterable[Gst.Element]) -> None:
        encoder = next((element for element in elements if _is_encoder(element)), None)
        self._into = OneShot(encoder.get_static_pad("sink"), self._on_raw) if encoder else None
        self._out = OneShot(encoder.get_static_pad("src"), self._on_coded) if encoder else None
        self._left = 0
        self._entered = (0.0, 0.0)  # capture time, s since 1970; ms from it to the encoder
        self._measured = RecentValue[SenderStages]()

    def take(self) -> SenderStages | None:
        """The last figures, if they are recent; requests those of the next picture.

        To be called a few times a second, from one thread.
        """
        if self._into and self._out and not self._out.armed:
            self._into.arm()
        return self._measured.get()

    def _on_raw(self, pad: Gst.Pad, picture: PassingBuffer) -> bool:
        if picture.pts is None:
            return False
        captured, self._left = captured_at(pad, picture.pts), PATIENCE
        self._entered = (captured, 1000 * (time.time() - captured))
        assert self._out
        self._out.arm()
        return True

    def _on_coded(self, pad: Gst.Pad, picture: PassingBuffer) -> bool:
        now = time.time()
        captured, capture_ms = self._entered
        ahead_s = captured_at(pad, picture.pts or 0) - captured
        self._left -= 1
        if ahead_s < -SAME_S and self._left:
            return False  # one that the encoder took earlier
        if abs(ahead_s) < SAME_S:  # else the encoder has dropped the picture
            self._measured.set(SenderStages(capture_ms, 1000 * (now - captured) - capture_ms))
        return True


def _is_encoder(element: Gst.Element) -> bool:
    return "Encoder" in (element.get_factory().get_metadata("klass") or "")
