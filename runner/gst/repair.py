"""Repair of lost packets at the operator: requested soon, and waited for as long as a round trip takes."""

from __future__ import annotations

import time
from collections import deque

from gi.repository import GObject, Gst

from runner.gst.arriving import HEADER_BYTES, ArrivingFrames, read_packet
from runner.gst.one_shot import OneShot, PassingBuffer
from runner.system.recent import RecentValue

REORDER_MS = 5  # a packet that is missing for longer was lost, not overtaken
ATTEMPTS = 3  # of retransmission that the buffer waits for
FULL, CLEAR = 0.15, 0.05  # share of packets missing from which on nothing is sent again, and until when: a link that
# drops so many is full, and what is sent again would fill it further
MEMORY = 0.75  # of both numbers, from one look to the next
UNKNOWN_MS = 100  # taken for the round trip until the first packet was sent again
LONGEST_MS = 300  # a picture that is later is of no use for driving
RETRANSMITTED = Gst.BufferFlags.LAST  # GST_RTP_BUFFER_FLAG_RETRANSMISSION, which has the same value
FRAMES = 64  # whose end is remembered


class RepairBuffer:
    """An rtpjitterbuffer whose missing packets are sent again (RFC 4585, 4588).

    The buffer itself notices a loss when the next packet comes. After the last packet of a frame that is the next
    frame's, up to 66 ms later; so a frame that does not end is noticed here by time.

    reorder_ms  how long it waits at least
    """

    def __init__(self, buffer: Gst.Element, reorder_ms: int) -> None:
        self._buffer, self._reorder_ms = buffer, reorder_ms
        # Frames come in bursts: the packet expected next belongs to the next frame and is not missing.
        buffer.set_property("rtx-next-seqnum", False)
        buffer.set_property("rtx-delay", REORDER_MS)
        self._pad = buffer.get_static_pad("sink")
        self._probe = self._pad.add_probe(Gst.PadProbeType.BUFFER, self._on_packet)
        self.frames = ArrivingFrames()
        self._asked = False  # the next packet was requested
        self._ends: deque[tuple[int, float]] = deque(maxlen=FRAMES)  # of frames whose last packet came: stamp, when
        self._waited = RecentValue[float]()  # how long a frame waited here, ms
        self._passing = OneShot(buffer.get_static_pad("src"), self._on_passed)
        self._counted = (0, 0)  # packets that came, and that were missing
        self._recent: tuple[float, ...] = (0.0, 0.0)  # of these, lately
        self._full = False  # nothing is requested

    @property
    def lost(self) -> int:
        """Packets missing for good."""
        lost: int = self._buffer.get_property("stats").get_value("num-lost")
        return lost

    def adapt(self) -> int:
        """Wait for missing packets as long as their retransmission takes; returns that, ms. A few times a second."""
        round_trip_ms = self._buffer.get_property("stats").get_value("rtx-rtt") / Gst.MSECOND or UNKNOWN_MS
        self._look()
        wait_ms = self._reorder_ms + (0 if self._full else round(ATTEMPTS * round_trip_ms))
        wait_ms = max(self._reorder_ms, min(LONGEST_MS, wait_ms))
        if self._buffer.get_property("latency") != wait_ms:
            self._buffer.set_property("latency", wait_ms)
        return wait_ms

    def waited_ms(self) -> float | None:
        """How long the end of a frame waited here lately; requests that of the next. A few times a second."""
        self._passing.arm()
        return self._waited.get()

    def close(self) -> None:
        """Let go of a buffer whose pipeline has ended: its pads hold this object, which holds them, for ever."""
        self._pad.remove_probe(self._probe)

    def _on_passed(self, _pad: Gst.Pad, buffer: PassingBuffer) -> bool:
        now = time.monotonic()
        packet = read_packet(buffer.extract(0, HEADER_BYTES), buffer.size)
        # A copy: the thread of arriving packets adds to it.
        came = next((at for stamp, at in tuple(self._ends) if stamp == packet.stamp), None)
        if not packet.last or came is None:
            return False
        self._waited.set(1000 * (now - came))
        return True

    def _look(self) -> None:
        """Whether the link is full."""
        before, now = self._counted, (self.frames.received, self.frames.missing)
        if now != before:
            self._counted = now
            self._recent = tuple(
                MEMORY * recent + new - old for recent, new, old in zip(self._recent, now, before, strict=True)
            )
        received, missing = self._recent
        self._full = missing > (CLEAR if self._full else FULL) * (received + missing)
        if self._buffer.get_property("do-retransmission") is self._full:
            self._buffer.set_property("do-retransmission", not self._full)

    def request_tail(self) -> None:
        """Request the next packet of a frame that should have ended by now; to be called a hundred times a second."""
        if self._asked or self._full or not self.frames.is_late(time.monotonic()):
            return
        self._asked = True
        request = Gst.Structure.new_empty("GstRTPRetransmissionRequest")
        request.set_value("seqnum", GObject.Value(GObject.TYPE_UINT, self.frames.next_number()))
        self._pad.push_event(Gst.Event.new_custom(Gst.EventType.CUSTOM_UPSTREAM, request))

    def _on_packet(self, _pad: Gst.Pad, info: Gst.PadProbeInfo) -> Gst.PadProbeReturn:
        buffer, now = info.get_buffer(), time.monotonic()
        packet = read_packet(buffer.extract_dup(0, HEADER_BYTES), buffer.get_size())
        again = buffer.has_flags(RETRANSMITTED)
        if not self.frames.add(packet, now, again=again):
            return Gst.PadProbeReturn.OK
        if self._asked and again:
            buffer.unset_flags(RETRANSMITTED)  # the buffer drops those that it has not requested itself
        if packet.last:
            self._ends.append((packet.stamp, now))
        self._asked = False
        return Gst.PadProbeReturn.OK
