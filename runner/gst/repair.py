"""Repair of lost packets at the operator: requested soon, and waited for as long as a round trip takes."""

from __future__ import annotations

import time
from collections import deque

from gi.repository import GObject, Gst

from runner.system.recent import RecentValue

REORDER_MS = 5  # a packet that is missing for longer was lost, not overtaken
TAIL_S = 0.01  # likewise for the last packets of a frame, of which no later packet tells
GAPS = 2  # and this many times the longest recent gap between packets of a frame: a slow link spreads them
FORGET = 0.99  # what is left of that gap at each packet
ATTEMPTS = 3  # of retransmission that the buffer waits for
FULL, CLEAR = 0.15, 0.05  # share of packets missing from which on nothing is sent again, and until when: a link that
# drops so many is full, and what is sent again would fill it further
MEMORY = 0.75  # of that share, from one look to the next
UNKNOWN_MS = 100  # taken for the round trip until the first packet was sent again
LONGEST_MS = 300  # a picture that is later is of no use for driving
RETRANSMITTED = Gst.BufferFlags.LAST  # GST_RTP_BUFFER_FLAG_RETRANSMISSION, which has the same value
FRAMES = 64  # whose end is remembered
MARKER, HALF = 0x80, 0x8000  # of the RTP header (RFC 3550, section 5.1); half of all sequence numbers


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
        self._pad.add_probe(Gst.PadProbeType.BUFFER, self._on_packet)
        self._newest = -1  # sequence number
        self._stamp = b""  # of its frame
        self._at = 0.0
        self._open = self._asked = False  # the frame has not ended; its next packet was requested
        self._gap = 0.0
        self._tails = 0  # packets that came because they were requested here
        self._ends: deque[tuple[bytes, float]] = deque(maxlen=FRAMES)  # of frames whose last packet came: stamp, when
        self._waited = RecentValue[float]()  # how long a frame waited here, ms
        self._timing = False
        self._counted = (0, 0)  # packets that came, and that were missing
        self._missing = 0.0  # share of packets, lately
        self._full = False  # nothing is requested

    @property
    def packets(self) -> tuple[int, int, int]:
        """Packets passed on, missing at first, and missing for good."""
        stats = self._buffer.get_property("stats")
        lost = stats.get_value("num-lost")
        return stats.get_value("num-pushed"), lost + stats.get_value("rtx-success-count") + self._tails, lost

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
        if not self._timing:
            self._timing = True
            self._buffer.get_static_pad("src").add_probe(Gst.PadProbeType.BUFFER, self._on_passed)
        return self._waited.get()

    def _on_passed(self, _pad: Gst.Pad, info: Gst.PadProbeInfo) -> Gst.PadProbeReturn:
        header, now = info.get_buffer().extract_dup(1, 7), time.monotonic()
        if not header[0] & MARKER:
            return Gst.PadProbeReturn.OK
        # A copy: the thread of arriving packets adds to it.
        came = next((at for stamp, at in tuple(self._ends) if stamp == header[3:]), None)
        if came is None:
            return Gst.PadProbeReturn.OK
        self._waited.set(1000 * (now - came))
        self._timing = False
        return Gst.PadProbeReturn.REMOVE

    def _look(self) -> None:
        """Whether the link is full."""
        before, (passed, missing, _) = self._counted, self.packets
        self._counted = (passed, missing)
        if more := sum(self._counted) - sum(before):
            self._missing = MEMORY * self._missing + (1 - MEMORY) * (missing - before[1]) / more
        self._full = self._missing > (CLEAR if self._full else FULL)
        if self._buffer.get_property("do-retransmission") is self._full:
            self._buffer.set_property("do-retransmission", not self._full)

    def request_tail(self) -> None:
        """Request the next packet of a frame that should have ended by now; to be called a hundred times a second."""
        late = time.monotonic() - self._at > max(TAIL_S, GAPS * self._gap)
        if late and self._open and not (self._asked or self._full):
            self._asked = True
            request = Gst.Structure.new_empty("GstRTPRetransmissionRequest")
            request.set_value("seqnum", GObject.Value(GObject.TYPE_UINT, (self._newest + 1) % (2 * HALF)))
            self._pad.push_event(Gst.Event.new_custom(Gst.EventType.CUSTOM_UPSTREAM, request))

    def _on_packet(self, _pad: Gst.Pad, info: Gst.PadProbeInfo) -> Gst.PadProbeReturn:
        packet, now = info.get_buffer(), time.monotonic()
        header = packet.extract_dup(1, 7)
        number, stamp = int.from_bytes(header[1:3], "big"), header[3:]
        if self._newest >= 0 and (number - self._newest - 1) % (2 * HALF) >= HALF:
            return Gst.PadProbeReturn.OK  # an older one: overtaken, or sent again
        if self._asked and packet.has_flags(RETRANSMITTED):
            packet.unset_flags(RETRANSMITTED)  # the buffer drops those that it has not requested itself
            self._tails += 1
        elif stamp == self._stamp:
            self._gap = max(now - self._at, FORGET * self._gap)
        if header[0] & MARKER:
            self._ends.append((stamp, now))
        self._newest, self._stamp, self._at = number, stamp, now
        self._open, self._asked = not header[0] & MARKER, False
        return Gst.PadProbeReturn.OK
