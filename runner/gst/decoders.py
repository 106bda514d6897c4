"""Notices a decoder that is given pictures and delivers none, so that the next attempt chooses another one.

`decodebin` takes the decoder of the highest rank. One of a chip may deliver memory that the next element does not
take, or nothing at all. `force-sw-decoders` avoids those that say in their class that they are hardware; not all do.
"""

from __future__ import annotations

import time
from collections.abc import Callable

from gi.repository import GLib, GObject, Gst

from runner.gst.probes import BufferProbe, PassingBuffer
from runner.gst.timers import later

SILENT_S = 2.0
MOST_HELD = 16  # pictures that a decoder may hold back: the longest reordering in H.264 and H.265
CHECK_S = 0.25
TRY, SKIP = 0, 2  # of GstAutoplugSelectResult, which has no typelib


class DecoderWatch:
    """Watches the decoders that `decodebin` chooses in a newly built bin, until it is gone.

    A silent one is an error of the bin, with its name. In normal operation it looks at one picture per check.

    end        pad behind the decoders that their pictures pass if the elements between take them
    left_out   names of the decoders that are not chosen; it adds those that fail
    on_report  called with a sentence about a decoder that another error stopped
    """

    def __init__(self, bin: Gst.Bin, end: Gst.Pad, left_out: set[str], on_report: Callable[[str], None]) -> None:
        self._bin, self._left_out, self._on_report = bin.weak_ref(), left_out, on_report
        self._decoders: list[_Decoder] = []
        self._passed = False  # a picture
        self._end = BufferProbe(end, self._on_passed)
        choosers = list(filter(_chooses, bin.children))
        for chooser in choosers:
            chooser.connect("autoplug-select", self._on_select)
            chooser.connect("unknown-type", self._on_unknown)
            chooser.connect("deep-element-added", self._on_element)
        if choosers:
            self._end.arm()
            later(CHECK_S, self._check)

    @property
    def suspects(self) -> bool:
        """Whether a decoder is being given pictures and delivers none."""
        return any(decoder.given for decoder in self._decoders)

    def follow(self, bus: Gst.Bus) -> None:
        """Handle the errors of a bus."""
        bus.enable_sync_message_emission()
        bus.connect("sync-message::error", lambda _bus, message: self.handle(message.parse_error()[0]))

    def handle(self, error: GLib.Error) -> None:
        """The bin has failed: before its first picture, its decoder may be at fault, which the next element refuses."""
        if self._passed or GLib.quark_to_string(Gst.StreamError.quark()) != error.domain:
            return
        for decoder in self._decoders:
            if decoder.was_fed and decoder.name not in self._left_out:
                self._left_out.add(decoder.name)
                self._on_report(f"decoder {decoder.name}: no picture has passed; the next attempt leaves it out")

    def _check(self) -> None:
        bin = self._bin()
        if bin is None:
            return
        later(CHECK_S, self._check)
        if self._end.armed:  # nothing has passed since the last check
            for decoder in self._decoders:
                decoder.look()
        self._end.arm()
        for decoder in self._decoders:
            if decoder.is_silent and decoder.name not in self._left_out:
                self._left_out.add(decoder.name)
                why = f"decoder {decoder.name}: no picture within {SILENT_S:g} s; the next attempt leaves it out"
                bin.post_message(Gst.Message.new_error(bin, GLib.Error(why), ""))

    # --- from streaming threads ---------------------------------------------------------------------------------------

    def _on_select(self, _chooser: Gst.Element, _pad: Gst.Pad, _caps: Gst.Caps, factory: Gst.ElementFactory) -> int:
        return SKIP if factory.get_name() in self._left_out else TRY

    def _on_unknown(self, _chooser: Gst.Element, _pad: Gst.Pad, _caps: Gst.Caps) -> None:
        """There is no other decoder for this format."""
        self._left_out.clear()

    def _on_element(self, chooser: Gst.Element, bin: Gst.Bin, element: Gst.Element) -> None:
        if bin == chooser and _decodes(element):
            self._decoders.append(_Decoder(element))

    def _on_passed(self, _pad: Gst.Pad, _picture: PassingBuffer) -> bool:
        self._passed = True
        for decoder in self._decoders:
            decoder.note_picture()
        return True


class _Decoder:
    """What one decoder is given.

    given    pictures since the last one that came of it; before the first one from a key picture on
    was_fed  whether it has been given any
    """

    def __init__(self, element: Gst.Element) -> None:
        self.name = element.get_factory().get_name()
        self.given, self.was_fed = 0, False
        self._since = 0.0  # when the first of these was given
        self._looks, self._has_delivered = True, False
        self._in = BufferProbe(element.get_static_pad("sink"), self._on_input)
        self._in.arm()

    @property
    def is_silent(self) -> bool:
        return self.given > MOST_HELD and time.monotonic() - self._since >= SILENT_S

    def look(self) -> None:
        """Count what it is given, until a picture comes of it."""
        self._looks = True
        self._in.arm()

    def note_picture(self) -> None:
        self.given, self._looks, self._has_delivered = 0, False, True

    def _on_input(self, _pad: Gst.Pad, picture: PassingBuffer) -> bool:
        if not self._looks:
            return True
        if not self.given:
            if not self._has_delivered and picture.has_flags(Gst.BufferFlags.DELTA_UNIT):
                return False
            self._since = time.monotonic()
        self.given, self.was_fed = self.given + 1, True
        return False


def _chooses(element: Gst.Element) -> bool:
    return bool(GObject.signal_lookup("autoplug-select", element))


def _decodes(element: Gst.Element) -> bool:
    factory = element.get_factory()
    pictures = Gst.ELEMENT_FACTORY_TYPE_MEDIA_VIDEO | Gst.ELEMENT_FACTORY_TYPE_MEDIA_IMAGE
    return bool(factory and factory.list_is_type(Gst.ELEMENT_FACTORY_TYPE_DECODER | pictures))
