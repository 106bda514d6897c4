"""Packets of one stream that come by several uplinks: each goes on once, and counts for the uplink that it came by.

Before the RTP session: twins of equal delay would never get through it, others would be taken for losses and jitter.
"""

from __future__ import annotations

from array import array
from collections import deque
from dataclasses import dataclass, field
from math import inf

from runner.gst.arriving import NUMBERS, RTP_HZ, ArrivingFrames, MediaClock, Packet, ShortestTransit, signed
from runner.records.reception import UplinkReceived

# A packet that is later than the newest one by more than the first is of no use: the jitter buffer waits for less. One
# that a way has held for long would make it start anew. Once nothing newer has come for the second, the stream has
# started anew.
LATE_S, RESTART_S = 1.0, 2.0
PAUSE_S = 1.0  # of media time
SILENT_S = 0.1  # once the uplink that carried a stream has delivered nothing for so long, it is taken to be cut
TAKING_OVER_S = 0.2  # what a camera's former uplink has swallowed is awaited for less, which takes at most so long
CURRENT_S = 1.0  # an uplink carries a stream this long after its last packet
LOOK_S = 0.02  # between two looks at how far the uplinks differ
FRAMES = 64  # of which it is remembered that all packets have come
SAME_S = 0.001  # two capture times of one frame, which are rounded differently
MOST_STREAMS = 4  # whose numbers are remembered; a camera has two, that of repeated packets included


@dataclass(slots=True)
class _Uplink:
    """What has come by one uplink.

    hz     of the timestamps
    at     when its last packet of the camera came, s
    stamp  timestamp of the newest one
    """

    frames: ArrivingFrames
    hz: int
    transit: ShortestTransit = field(default_factory=ShortestTransit)
    packets: int = 0
    twins: int = 0
    late: int = 0
    at: float = 0.0
    stamp: int = 0

    def add(self, packet: Packet, now: float, arrived: float | None) -> None:
        """Add a packet of the camera that was not requested again."""
        ahead = signed(packet.stamp - self.stamp)
        if ahead > PAUSE_S * self.hz:
            self.frames.resume()
        if ahead > 0 or not self.at:
            self.stamp = packet.stamp
        self.at = now
        self.frames.add(packet, now, arrived)


class WholeFrames:
    """Which frames have come without a gap, from their first packet, which states the capture time, to their last."""

    def __init__(self) -> None:
        self._captured: float | None = None  # of the frame whose packets have come so far; None: not all have
        self._open: float | None = None  # capture time of the frame that has begun and not ended
        self._next = 0  # number of its next packet
        # Capture times of whole frames, with that of the frame before, if its end has not come: the depayloader then
        # outputs a frame with what it has of that one, and with its time.
        self._found: deque[tuple[float, float]] = deque(maxlen=FRAMES)
        self._joined = 0.0

    def add(self, packet: Packet) -> None:
        """Add a packet that is newer than all earlier ones."""
        if packet.captured is not None:
            self._joined = packet.captured if self._open is None else self._open
            self._captured = self._open = packet.captured
        elif packet.number != self._next:
            self._captured = None
        self._next = (packet.number + 1) % NUMBERS
        if packet.last:
            if self._captured is not None:
                self._found.append((self._captured, self._joined))
            self._open = None

    def captured(self, stated: float) -> float | None:
        """Capture time of the whole frame in a unit that states a time; None: there is none. From any thread."""
        found = (own for own, joined in tuple(self._found) if min(abs(stated - own), abs(stated - joined)) < SAME_S)
        return next(found, None)


class Merge:
    """Decides which packets of a camera go on. The thread in which packets arrive uses it; any other one reads counts.

    is_authentic  whether whoever sends a packet is the vehicle. If that is decided behind it, a forged packet must not
                  replace the true one with its number: twins are only counted, and dropped there
    hz            of the RTP timestamps

    payload_type  of the camera's packets; others are repeated on request. None: not known yet
    whole         frames of which all packets have come
    difference_s  how much longer packets take by the slowest uplink that carries the stream than by the fastest one
    """

    def __init__(self, *, is_authentic: bool, hz: int = RTP_HZ) -> None:
        self._is_authentic, self._hz = is_authentic, hz
        self.payload_type: int | None = None
        self._uplinks: dict[str, _Uplink] = {}
        self._seen: dict[int, array[int]] = {}  # by stream (SSRC), and by number, the timestamp of the last packet
        self._clock = MediaClock(1 / hz)
        self._newest: tuple[int, float] | None = None  # timestamp, and when it came
        self.whole = WholeFrames()
        self._looked = self.difference_s = 0.0
        self._taken_over = -inf  # when an uplink last began to carry the stream after a pause

    def passes(self, header: bytes, packet: Packet, uplink: str | None, now: float, arrived: float | None) -> bool:
        """Count a packet; returns whether it goes on.

        header   its first 12 bytes or more
        uplink   None: unknown
        arrived  when the kernel received it, s; None: unknown
        """
        is_late = self._is_late(packet, now)
        is_twin = self._is_twin(int.from_bytes(header[8:12], "big"), packet)
        if uplink is not None:
            own = self._uplinks.get(uplink) or self._uplinks.setdefault(
                uplink, _Uplink(ArrivingFrames(self._hz), self._hz)
            )
            own.packets += 1
            own.twins, own.late = own.twins + is_twin, own.late + is_late
            if header[1] & 0x7F == self.payload_type:
                self._add(own, packet, now, arrived, is_late=is_late)
        return not (is_late or (is_twin and self._is_authentic))

    def _add(self, own: _Uplink, packet: Packet, now: float, arrived: float | None, *, is_late: bool) -> None:
        is_new, silent_s = now - own.at > CURRENT_S, now - max(each.at for each in self._uplinks.values())
        own.add(packet, now, arrived)
        if not is_late:
            if is_new and silent_s > SILENT_S:
                self._taken_over = now
            self._clock.tick(packet.stamp)
            own.transit.add((arrived or now) - self._clock.seconds, now)
        if is_new or now - self._looked > LOOK_S:
            self.look(now)

    def note_passed(self, packet: Packet, now: float) -> None:
        """A packet has passed, authentic and newer than all earlier ones."""
        self._newest = packet.stamp, now
        self.whole.add(packet)

    def has_taken_over(self, now: float) -> bool:
        """Whether an uplink has just begun to carry the stream after a pause: its former one has failed."""
        return now - self._taken_over < TAKING_OVER_S

    def look(self, now: float) -> None:
        """Find out how far the uplinks differ that carry the stream now."""
        self._looked = now
        transits = [each.transit.seconds for each in tuple(self._uplinks.values()) if now - each.at < CURRENT_S]
        self.difference_s = max(transits) - min(transits) if len(transits) > 1 else 0.0

    @property
    def frames(self) -> dict[str, ArrivingFrames]:
        """By uplink, what it alone has delivered of the camera."""
        return {name: each.frames for name, each in tuple(self._uplinks.items())}

    def counts(self) -> dict[str, UplinkReceived]:
        return {
            name: UplinkReceived(each.packets, each.frames.missing, each.twins, each.late)
            for name, each in tuple(self._uplinks.items())
        }

    def _is_late(self, packet: Packet, now: float) -> bool:
        if self._newest is None:
            return False
        stamp, at = self._newest
        return signed(stamp - packet.stamp) > LATE_S * self._hz and now - at < RESTART_S

    def _is_twin(self, stream: int, packet: Packet) -> bool:
        """Number and timestamp together name a packet, for hours."""
        seen = self._seen.get(stream)
        if seen is None:
            if len(self._seen) == MOST_STREAMS:
                del self._seen[next(iter(self._seen))]
            seen = self._seen[stream] = array("q", [-1]) * NUMBERS
        is_twin, seen[packet.number] = seen[packet.number] == packet.stamp, packet.stamp
        return is_twin
