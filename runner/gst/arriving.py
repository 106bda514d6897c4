"""Arrival times of the packets of each frame, taken before anything waits for missing ones: the effect of the link."""

from __future__ import annotations

import threading
from collections import deque
from dataclasses import dataclass
from math import inf

from runner.records.reception import Arrival, ArrivedPacket

MAX_FRAMES, MAX_PACKETS = 1024, 16_384  # not taken yet; beyond that the oldest are dropped
TAIL_S = 0.01  # a frame whose last packet is missing counts as ended after this long without a packet ...
TAIL_GAPS = 2  # ... and after this many times the longest recent gap within a frame: a slow link spreads packets out
GAP_DECAY = 0.99  # factor by which that gap decays with each packet
INTERVALS = 1.3  # a frame is overdue this many frame intervals after the previous one; less is jitter
NTP_EPOCH_S = 2_208_988_800  # 1900-01-01 to 1970-01-01 (RFC 5905)
RTP_HZ = 90_000  # of video (RFC 6184)
HEADER_BYTES = 32  # of a packet: enough for the header without contributing sources, and the capture time
CAPTURE_ID = 1  # of the header extension with the capture time
EXTENDED, SOURCES, MARKER, NUMBERS = 0x10, 0x0F, 0x80, 0x10000  # RFC 3550, section 5.1; so many sequence numbers
# Jump of the sequence number, ahead or back, that marks a restarted stream if the next packet follows (RFC 3550, A.1):
# more than a stream sends in the time between both packets, but never less than these. A way that has held packets for
# OLDEST_S still delivers them.
DROPOUT, MISORDER = 3000, 100
FASTEST, OLDEST_S = 5000, 15.0  # packets/s: 48 Mbit/s
WINDOW_S = 5.0  # the usual transit time is the shortest one in this window and the window before it
RESTART_S = 10.0  # more than this is not delay: the sender's clock was reset
ONE_BYTE, FIXED_BYTES, WORD_BYTES, NTP_BYTES = b"\xbe\xde", 12, 4, 8  # RFC 8285, section 4.2; RFC 6051


@dataclass(frozen=True, slots=True)
class Packet:
    """The header fields of an RTP packet.

    stamp     RTP timestamp, the same for all packets of a frame
    last      whether it is the last packet of its frame
    bytes     of the payload
    captured  s since 1970 by the sender's clock; None if the packet does not carry it
    """

    number: int
    stamp: int
    last: bool
    bytes: int
    captured: float | None


def read_packet(header: bytes, size: int) -> Packet:
    """Parse the header of a packet of `size` bytes from its first HEADER_BYTES."""
    start, captured = FIXED_BYTES + WORD_BYTES * (header[0] & SOURCES), None
    if header[0] & EXTENDED:
        extension = header[start:]
        captured = _captured(extension)
        start += WORD_BYTES * (1 + int.from_bytes(extension[2:4], "big"))
    return Packet(
        number=int.from_bytes(header[2:4], "big"),
        stamp=int.from_bytes(header[4:8], "big"),
        last=bool(header[1] & MARKER),
        bytes=max(0, size - start),
        captured=captured,
    )


def _captured(extension: bytes) -> float | None:
    """The capture time, which this project's sender writes as the first element of a header extension."""
    start = WORD_BYTES + 1
    if extension[:2] != ONE_BYTE or extension[WORD_BYTES:start] != bytes([CAPTURE_ID << 4 | NTP_BYTES - 1]):
        return None
    ntp = int.from_bytes(extension[start : start + NTP_BYTES], "big")
    return ntp / 2**32 - NTP_EPOCH_S if ntp else None  # a payloader leaves 0, which only a session fills in


class ArrivingFrames:
    """Groups the packets of one camera into frames, in order of arrival. Of sound, each packet is one.

    hz  of the RTP timestamps

    The thread in which packets arrive adds them; any one other thread takes frames and packets.
    """

    def __init__(self, hz: int = RTP_HZ) -> None:
        self._lock, self._hz = threading.Lock(), hz
        self._frames: deque[Arrival] = deque(maxlen=MAX_FRAMES)
        self._packets: deque[ArrivedPacket] = deque(maxlen=MAX_PACKETS)
        self._clock = MediaClock(1 / hz)
        self._newest: Packet | None = None
        self._handled = 0.0  # when the newest packet was added
        # When the kernel received the first packet of its frame, and the newest one; None: unknown.
        self._first: float | None = None
        self._received: float | None = None
        self._captured, self._bytes = 0.0, 0  # of its frame; bytes not emitted yet
        self._ahead: float | None = None  # how far capture times are ahead of the media clock, s; None: not stated yet
        self._whole = False  # no packet of the frame is missing so far
        self._open = self._emitted = False  # the frame has not ended; its arrival is in `_frames`
        self._gap = 0.0
        self._began, self._interval = 0.0, inf  # of the current frame; s between two frames
        self._missing: dict[int, int] = {}  # sequence numbers, with the timestamp of the packet that followed
        self._restarted: int | None = None  # the sequence number that confirms a restart
        self.received = self.missing = 0  # packets received, and packets missing when a later one arrived

    def add(self, packet: Packet, now: float, arrived: float | None = None, *, retransmitted: bool = False) -> bool:
        """Add a packet; returns whether it is newer than all earlier ones.

        now      s
        arrived  when the kernel received it, s; None: unknown, so that it counts as arriving now
        """
        with self._lock:
            self._packets.append((now if arrived is None else arrived, packet.bytes))
            ahead = 0 if self._newest is None else (packet.number - self._newest.number - 1) % NUMBERS
            media_s = 0.0 if self._newest is None else signed(packet.stamp - self._newest.stamp) / self._hz
            if ahead >= NUMBERS - max(MISORDER, _sent_in(-media_s)) or (retransmitted and ahead >= NUMBERS // 2):
                self._add_older(packet, retransmitted)
                return False
            if ahead < max(DROPOUT, _sent_in(media_s)):
                self._add_newer(packet, now, arrived, retransmitted, whole=not ahead)
                self._note_missing(packet, ahead)
                return True
            expected, self._restarted = self._restarted, (packet.number + 1) % NUMBERS
            if packet.number != expected:
                return False
            self._ahead = None
            self._add_newer(packet, now, arrived, retransmitted, whole=False)
            return True

    def resume(self) -> None:
        """Nothing is missing before the next packet, whatever its number: what was sent meanwhile went elsewhere."""
        with self._lock:
            self._newest = None

    def is_late(self, now: float) -> bool:
        """Whether the rest of the current frame, or all of the next one, is overdue, so that packets are missing."""
        if self._open:
            return now - self._handled > max(TAIL_S, TAIL_GAPS * self._gap)
        return now - self._began > INTERVALS * self._interval

    def next_number(self) -> int:
        """Sequence number of the next packet expected."""
        newest = self._newest
        return (newest.number + 1) % NUMBERS if newest else 0

    def take(self, now: float) -> list[Arrival]:
        """Frames that have ended since the last call, or are overdue."""
        with self._lock:
            if self.is_late(now) and not self._emitted:
                self._whole = False
                self._emit()
            taken = list(self._frames)
            self._frames.clear()
            return taken

    def take_packets(self) -> list[ArrivedPacket]:
        """Packets that have arrived since the last call, repeated and retransmitted ones included."""
        with self._lock:
            taken = list(self._packets)
            self._packets.clear()
            return taken

    def _add_older(self, packet: Packet, retransmitted: bool) -> None:
        """Add a packet that was reordered, retransmitted or duplicated."""
        if retransmitted:
            self._bytes += packet.bytes
        elif self._was_missing(packet):
            self._bytes += packet.bytes
            self.received, self.missing = self.received + 1, self.missing - 1

    def _add_newer(
        self, packet: Packet, now: float, arrived: float | None, retransmitted: bool, *, whole: bool
    ) -> None:
        """Add a packet that is newer than all earlier ones. whole: no packet is missing before it."""
        self.received, self.missing = self.received + (not retransmitted), self.missing + retransmitted
        if self._newest is None or packet.stamp != self._newest.stamp:
            self._begin(packet, now, regular=whole and not retransmitted)
            self._first = arrived
        elif not retransmitted:
            self._gap = max(now - self._handled, GAP_DECAY * self._gap)
        self._whole &= whole and not retransmitted
        self._newest, self._handled, self._bytes = packet, now, self._bytes + packet.bytes
        self._received = arrived
        self._open, self._emitted = not packet.last, False
        if packet.last:
            self._emit()

    def _note_missing(self, packet: Packet, count: int) -> None:
        """`count` packets before this one are missing."""
        self.missing += count
        for each in range(packet.number - min(count, MAX_PACKETS), packet.number):
            self._missing.pop(each % NUMBERS, None)  # noted before the numbers wrapped around
            self._missing[each % NUMBERS] = packet.stamp
        while len(self._missing) > MAX_PACKETS:
            del self._missing[next(iter(self._missing))]

    def _was_missing(self, packet: Packet) -> bool:
        """Whether this packet was noted as missing; it is no longer."""
        followed = self._missing.get(packet.number)
        if followed is None or not 0 <= signed(followed - packet.stamp) <= OLDEST_S * self._hz:
            return False
        del self._missing[packet.number]
        return True

    def _begin(self, packet: Packet, now: float, *, regular: bool) -> None:
        """Begin a frame. regular: no packet is missing since the previous one, and it arrives as first sent."""
        if self._open and not self._emitted:
            self._whole = False
            self._emit()
        before = self._clock.seconds
        self._clock.tick(packet.stamp)
        if regular and self._newest:
            # Frames that all arrive late are queued, not lost: requesting them again would lengthen the queue.
            self._interval = max(self._clock.seconds - before, now - self._began)
        self._began = now
        if packet.captured is not None:
            self._ahead = packet.captured - self._clock.seconds
        elif self._ahead is None and regular and self._newest:
            self._ahead = 0.0  # this sender states none
        self._captured = self._clock.seconds + (self._ahead or 0.0)  # only the first packet states it, and may be lost
        self._whole = True

    def _emit(self) -> None:
        if self._ahead is not None:
            at, first = (self._handled, None) if self._received is None else (self._received, self._first)
            if first is not None:  # processors that take packets from different devices state their times out of order
                first = min(first, at)
            self._frames.append(Arrival(at, self._captured, self._bytes, self._whole, first))
        self._bytes, self._emitted = 0, True


def _sent_in(media_s: float) -> int:
    """How many packets a stream may have sent in this time; none in one that has not passed or is too long."""
    return round(FASTEST * media_s) if 0 < media_s <= OLDEST_S else 0


class ShortestTransit:
    """The shortest transit time of the last 5 to 10 s, s. Silence does not age it."""

    def __init__(self) -> None:
        self._began, self._before, self._shortest = -inf, inf, inf

    def add(self, transit: float, arrived: float) -> None:
        if arrived - self._began > WINDOW_S:
            self._began, self._before, self._shortest = arrived, self._shortest, inf
        self._shortest = min(self._shortest, transit)

    def restart(self, transit: float) -> None:
        self._before = self._shortest = transit

    @property
    def seconds(self) -> float:
        return min(self._before, self._shortest)


class Lateness:
    """How much later than usual the packets of one camera arrive.

    Usual is the shortest transit time of the last 5 to 10 s. The queue of an outage takes less to drain; silence does
    not age it.
    """

    def __init__(self, hz: int = RTP_HZ) -> None:
        self._clock, self._usual = MediaClock(1 / hz), ShortestTransit()

    def of(self, stamp: int, arrived: float) -> float:
        """How late a packet is, s, given its RTP timestamp and its arrival, s; never negative."""
        self._clock.tick(stamp)
        transit = arrived - self._clock.seconds
        self._usual.add(transit, arrived)
        late = transit - self._usual.seconds
        if late > RESTART_S:
            self._usual.restart(transit)
            return 0.0
        return late


class MediaClock:
    """Converts a 32-bit counter that wraps around to seconds; 0 before its first value."""

    def __init__(self, tick_s: float) -> None:
        self._tick_s, self._last, self._ticks = tick_s, 0, 0

    @property
    def seconds(self) -> float:
        return self._ticks * self._tick_s

    def tick(self, counter: int) -> None:
        self._ticks += signed(counter - self._last)
        self._last = counter


def signed(ticks: int) -> int:
    """The difference of two 32-bit counters that wrap around, by the shorter of both directions."""
    ticks &= 0xFFFFFFFF
    return ticks - (ticks >> 31 << 32)
