"""When the packets of each frame arrived, before anything waits for missing ones: what the link did to the frame."""

from __future__ import annotations

import threading
from collections import deque
from dataclasses import dataclass

from runner.records import Arrival

KEPT = 1024  # frames that have not been read yet; the oldest are dropped
TAIL_S = 0.01  # without a packet for this long, a frame has ended though its last packet is missing ...
GAPS = 2  # ... and for this many times the longest recent gap between packets of a frame: a slow link spreads them
FORGET = 0.99  # what is left of that gap at each packet
NTP_EPOCH_S = 2_208_988_800  # 1900-01-01 to 1970-01-01 (RFC 5905)
RTP_HZ = 90_000  # of video (RFC 6184)
HEADER_BYTES = 32  # of a packet, in which a header without contributing sources and the capture time end
CAPTURE_ID = 1  # of the header extension with the capture time
EXTENDED, SOURCES, MARKER, HALF = 0x10, 0x0F, 0x80, 0x8000  # RFC 3550, section 5.1; half of all sequence numbers
# Packets by which a stream jumps that begins anew, ahead or back, if the next one follows (RFC 3550, A.1).
DROPOUT, MISORDER = 3000, 100
ONE_BYTE, FIXED_BYTES, WORD_BYTES, NTP_BYTES = b"\xbe\xde", 12, 4, 8  # RFC 8285, section 4.2; RFC 6051


@dataclass(frozen=True, slots=True)
class Packet:
    """What the header of an RTP packet says.

    stamp     RTP timestamp, the same for all packets of a frame
    last      whether it is the last packet of its frame
    bytes     of the payload
    captured  s since 1970, by the sender's clock; None if the packet does not carry it
    """

    number: int
    stamp: int
    last: bool
    bytes: int
    captured: float | None


def read_packet(header: bytes, size: int) -> Packet:
    """The header of a packet of that many bytes, from its first HEADER_BYTES."""
    begin, captured = FIXED_BYTES + WORD_BYTES * (header[0] & SOURCES), None
    if header[0] & EXTENDED:
        extension = header[begin:]
        captured = _captured(extension)
        begin += WORD_BYTES * (1 + int.from_bytes(extension[2:4], "big"))
    return Packet(
        number=int.from_bytes(header[2:4], "big"),
        stamp=int.from_bytes(header[4:8], "big"),
        last=bool(header[1] & MARKER),
        bytes=max(0, size - begin),
        captured=captured,
    )


def _captured(extension: bytes) -> float | None:
    """The capture time, of which this project's sender makes the first element of a header extension."""
    begin = WORD_BYTES + 1
    if extension[:2] != ONE_BYTE or extension[WORD_BYTES:begin] != bytes([CAPTURE_ID << 4 | NTP_BYTES - 1]):
        return None
    ntp = int.from_bytes(extension[begin : begin + NTP_BYTES], "big")
    return ntp / 2**32 - NTP_EPOCH_S


class ArrivingFrames:
    """Packets of one camera in the order of their arrival, gathered into frames.

    The thread in which packets arrive adds them; any one other thread takes the frames.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._frames: deque[Arrival] = deque(maxlen=KEPT)
        self._clock = MediaClock(1 / RTP_HZ)
        self._newest: Packet | None = None
        self._at = 0.0  # when it came
        self._captured, self._bytes = 0.0, 0  # of its frame; bytes that have not been given
        self._whole = False  # no packet of the frame is missing so far
        self._open = self._given = False  # the frame has not ended; what came of it is among the frames
        self._gap = 0.0
        self._gone: deque[int] = deque(maxlen=MISORDER)  # numbers that are missing
        self._restarted: int | None = None  # the number after one that jumped
        self.received = self.missing = 0  # packets that came, and that did not before a later one came

    def add(self, packet: Packet, now: float, *, again: bool = False) -> bool:
        """Take a packet; returns whether it is newer than all before.

        now    s, when it came
        again  it was missing, and sent again
        """
        with self._lock:
            ahead = 0 if self._newest is None else (packet.number - self._newest.number - 1) % (2 * HALF)
            if ahead >= (HALF if again else 2 * HALF - MISORDER):
                self._add_older(packet, again)
                return False
            if ahead < DROPOUT:
                self._add_newer(packet, now, again, whole=not ahead)
                self._miss(packet.number, ahead)
                return True
            expected, self._restarted = self._restarted, (packet.number + 1) % (2 * HALF)
            if packet.number != expected:
                return False
            self._add_newer(packet, now, again, whole=False)
            return True

    def is_late(self, now: float) -> bool:
        """Whether the frame should have ended by now: its last packets are missing."""
        return self._open and now - self._at > max(TAIL_S, GAPS * self._gap)

    def next_number(self) -> int:
        """Sequence number of the packet that should come next."""
        newest = self._newest
        return (newest.number + 1) % (2 * HALF) if newest else 0

    def take(self, now: float) -> list[Arrival]:
        """Frames that have ended since the last call, or should have."""
        with self._lock:
            if self.is_late(now) and not self._given:
                self._whole = False
                self._give()
            taken = list(self._frames)
            self._frames.clear()
            return taken

    def _add_older(self, packet: Packet, again: bool) -> None:
        """Take a packet that was overtaken, is sent again, or comes twice."""
        if again:
            self._bytes += packet.bytes
        elif packet.number in self._gone:
            self._gone.remove(packet.number)
            self._bytes += packet.bytes
            self.received, self.missing = self.received + 1, self.missing - 1

    def _add_newer(self, packet: Packet, now: float, again: bool, *, whole: bool) -> None:
        """Take a packet that is newer than all before. whole: it follows the one before."""
        self.received, self.missing = self.received + (not again), self.missing + again
        if self._newest is None or packet.stamp != self._newest.stamp:
            self._begin(packet)
        elif not again:
            self._gap = max(now - self._at, FORGET * self._gap)
        self._whole &= whole and not again
        self._newest, self._at, self._bytes = packet, now, self._bytes + packet.bytes
        self._open, self._given = not packet.last, False
        if packet.last:
            self._give()

    def _miss(self, number: int, count: int) -> None:
        """So many packets before one are missing."""
        self.missing += count
        self._gone.extend(gone % (2 * HALF) for gone in range(number - min(count, MISORDER), number))

    def _begin(self, packet: Packet) -> None:
        if self._open and not self._given:
            self._whole = False
            self._give()
        self._clock.tick(packet.stamp)
        self._captured = self._clock.seconds if packet.captured is None else packet.captured
        self._whole = True

    def _give(self) -> None:
        self._frames.append(Arrival(self._at, self._captured, self._bytes, self._whole))
        self._bytes, self._given = 0, True


class MediaClock:
    """Time of a counter of 32 bits that wraps around; 0 before its first value."""

    def __init__(self, tick_s: float) -> None:
        self._tick_s, self._last, self._ticks = tick_s, 0, 0

    @property
    def seconds(self) -> float:
        return self._ticks * self._tick_s

    def tick(self, counter: int) -> None:
        ahead = (counter - self._last) & 0xFFFFFFFF
        self._ticks += ahead - (ahead >> 31 << 32)  # of two directions the shorter
        self._last = counter
