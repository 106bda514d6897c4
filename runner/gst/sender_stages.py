"""How long a picture takes on the vehicle: from its capture into the encoder, and through it."""

from __future__ import annotations

import time
from collections.abc import Iterable
from typing import Any, NamedTuple

from gi.repository import Gst

from runner.gst.clocks import captured_at
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
        self._into: Any = encoder.get_static_pad("sink") if encoder else None
        self._out: Any = encoder.get_static_pad("src") if encoder else None
        self._armed = False
        self._left = 0
        self._entered = (0.0, 0.0)  # capture time, s since 1970; ms from it to the encoder
        self._measured = RecentValue[SenderStages]()

    def take(self) -> SenderStages | None:
        """The last figures, if they are recent; requests those of the next picture.

        To be called a few times a second, from one thread.
        """
        if self._into and not self._armed:
            self._armed = True
            self._into.add_probe(Gst.PadProbeType.BUFFER, self._on_raw)
        return self._measured.get()

    def _on_raw(self, pad: Gst.Pad, info: Gst.PadProbeInfo) -> Gst.PadProbeReturn:
        if info.get_buffer().pts == Gst.CLOCK_TIME_NONE:
            return Gst.PadProbeReturn.OK
        captured, self._left = captured_at(pad, info.get_buffer()), PATIENCE
        self._entered = (captured, 1000 * (time.time() - captured))
        self._out.add_probe(Gst.PadProbeType.BUFFER, self._on_coded)
        return Gst.PadProbeReturn.REMOVE

    def _on_coded(self, pad: Gst.Pad, info: Gst.PadProbeInfo) -> Gst.PadProbeReturn:
        now = time.time()
        captured, capture_ms = self._entered
        ahead_s = captured_at(pad, info.get_buffer()) - captured
        self._left -= 1
        if ahead_s < -SAME_S and self._left:
            return Gst.PadProbeReturn.OK  # one that the encoder took earlier
        if abs(ahead_s) < SAME_S:  # else the encoder has dropped the picture
            self._measured.set(SenderStages(capture_ms, 1000 * (now - captured) - capture_ms))
        self._armed = False
        return Gst.PadProbeReturn.REMOVE


def _is_encoder(element: Gst.Element) -> bool:
    return "Encoder" in (element.get_factory().get_metadata("klass") or "")
