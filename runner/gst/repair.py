"""How packets arrive at the operator's side. Lost ones are requested early, and awaited as long as round trips take."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Iterator
from itertools import chain
from typing import TYPE_CHECKING

from gi.repository import GObject, Gst, GstRtsp, GstSdp

from runner.core.graph_settings import GraphSettings
from runner.gst.arriving import HEADER_BYTES, RTP_HZ, ArrivingFrames, Lateness, Packet, read_packet
from runner.gst.packet_times import received_at, state_arrivals
from runner.gst.probes import BufferProbe, PassingBuffer
from runner.records.reception import Arrival, ArrivedPacket
from runner.system.recent import RecentValue

if TYPE_CHECKING:
    from runner.gst.merge import Merge
    from runner.gst.received_uplinks import ReceivedUplinks

REORDER_MS = 5  # a packet that is missing for longer was lost, not reordered
MOST_OTHERS_MS, STEP_MS = 100, 10  # how long a request waits for slower uplinks, in steps
AUTOMATIC = -1  # of the buffer's properties
ATTEMPTS = 3  # retransmissions that the buffer waits for
# Retransmission stops above the first share of missing packets and resumes below the second: a link that drops so many
# is congested, and retransmissions would make it worse.
CONGESTED, CLEAR = 0.15, 0.05
DECAY = 0.75  # of both counts, from one update to the next
INITIAL_RTT_MS = 100  # round trip assumed until the first retransmission
LONGEST_MS = 300  # a picture that is later is useless for driving
RETRANSMITTED = Gst.BufferFlags.LAST  # GST_RTP_BUFFER_FLAG_RETRANSMISSION, which has the same value
FRAMES = 64  # whose end is remembered
OVER_TCP = "over TCP, since UDP was refused: are the vehicle's media.rtp_ports in use?"
BY_ROUTE = "over TCP by the vehicle's routes: none of its uplinks carries it or is measured by it"


class RepairBuffer:
    """An rtpjitterbuffer with retransmission of missing packets (RFC 4585, 4588).

    The buffer itself detects a loss when the next packet arrives. After the last packet of a frame, that is up to 66 ms
    later; so a frame whose end, or all of it, is missing is detected here by a timeout.

    The buffer derives the deadline of a missing packet from arrival times. After a packet that is later than the wait,
    or suddenly by more than 1 s, its time base starts anew (rtpjitterbuffer.c, calculate_pts and calculate_skew) and
    returns within seconds. In an outage's queue packets wait for seconds: lost ones would be awaited up to 1 s longer
    than the wait, and hold back the pictures behind them. So no packet may seem to be later than LONGEST_MS.

    reorder_ms    minimum wait
    kernel_times  whether the DTS of packets state when the kernel received them, see `runner.gst.packet_times`
    merge         of the uplinks by which packets come; None: they come one way
    hz            of the RTP timestamps
    """

    def __init__(
        self,
        buffer: Gst.Element,
        reorder_ms: int,
        *,
        kernel_times: bool,
        merge: Merge | None = None,
        hz: int = RTP_HZ,
    ) -> None:
        self._buffer, self._reorder_ms, self._kernel_times = buffer, reorder_ms, kernel_times
        self._merge, self._others_ms = merge, 0  # so long a packet may still come by another uplink
        if merge:
            buffer.set_property("rtx-delay-reorder", 0)  # packets of a faster uplink say nothing of a slower one's
        # Frames arrive in bursts: the next expected packet belongs to the next frame and is not missing.
        buffer.set_property("rtx-next-seqnum", False)
        buffer.set_property("rtx-delay", REORDER_MS)
        self._pad = buffer.get_static_pad("sink")
        self._arriving = BufferProbe(self._pad, self._on_packet)
        self._arriving.arm()
        self.frames = ArrivingFrames(hz)
        self._lateness = Lateness(hz)
        self._tail_requested = False
        self._ends: deque[tuple[int, float]] = deque(maxlen=FRAMES)  # of frames: timestamp, arrival of the last packet
        self._waited = RecentValue[float]()  # how long a frame waited here, ms
        self._passing = BufferProbe(buffer.get_static_pad("src"), self._on_passed)
        self._counted = (0, 0)  # packets received, and missing
        self._recent: tuple[float, ...] = (0.0, 0.0)  # the same, decaying
        self._congested = False  # no retransmission

    @property
    def lost(self) -> int:
        """Packets that were never recovered."""
        lost: int = self._buffer.get_property("stats").get_value("num-lost")
        # The buffer counts those, too, that come by a slower uplink after it has given them up, and before their turn.
        return min(lost, self.frames.missing) if self._merge else lost

    @property
    def unanswered(self) -> int:
        """How many requests for lost packets there were, if none was answered in time."""
        stats = self._buffer.get_property("stats")
        return 0 if stats.get_value("rtx-success-count") else int(stats.get_value("rtx-count"))

    def adapt(self) -> int:
        """Adapt the wait for missing packets to the round trip; returns it, ms. A few times a second."""
        self._update_congestion()
        attempts = ATTEMPTS
        if self._merge:
            now = time.monotonic()
            self._merge.look(now)
            self._await_others(self._merge)
            attempts = 1 if self._merge.has_taken_over(now) else ATTEMPTS
        return self._wait(attempts)

    def _wait(self, attempts: int) -> int:
        """Wait until a packet can have been requested so often; returns for how long, ms."""
        round_trip_ms = self._buffer.get_property("stats").get_value("rtx-rtt") / Gst.MSECOND or INITIAL_RTT_MS
        wait_ms = self._reorder_ms + max(self._others_ms, 0 if self._congested else round(attempts * round_trip_ms))
        wait_ms = max(self._reorder_ms, min(LONGEST_MS, wait_ms))
        if self._buffer.get_property("latency") != wait_ms:
            self._buffer.set_property("latency", wait_ms)
        return wait_ms

    def waited_ms(self) -> float | None:
        """How long the end of a recent frame waited here; samples the next frame. A few times a second."""
        self._passing.arm()
        return self._waited.get()

    def _on_passed(self, _pad: Gst.Pad, buffer: PassingBuffer) -> bool:
        now = time.monotonic()
        packet = read_packet(buffer.extract(0, HEADER_BYTES), buffer.size)
        # A copy: the thread of arriving packets appends to it.
        arrived = next((at for stamp, at in tuple(self._ends) if stamp == packet.stamp), None)
        if not packet.last or arrived is None:
            return False
        self._waited.set(1000 * (now - arrived))
        return True

    def _update_congestion(self) -> None:
        """Stop or resume retransmission."""
        before, now = self._counted, (self.frames.received, self.frames.missing)
        if now != before:
            self._counted = now
            self._recent = tuple(
                DECAY * recent + new - old for recent, new, old in zip(self._recent, now, before, strict=True)
            )
        received, missing = self._recent
        self._congested = missing > (CLEAR if self._congested else CONGESTED) * (received + missing)
        if self._buffer.get_property("do-retransmission") is self._congested:
            self._buffer.set_property("do-retransmission", not self._congested)

    def request_tail(self) -> None:
        """Request the next packet if a frame is overdue; to be called a hundred times a second."""
        others_s = min(MOST_OTHERS_MS, self._others_ms) / 1000
        if self._tail_requested or self._congested or not self.frames.is_late(time.monotonic() - others_s):
            return
        self._tail_requested = True
        request = Gst.Structure.new_empty("GstRTPRetransmissionRequest")
        request.set_value("seqnum", GObject.Value(GObject.TYPE_UINT, self.frames.next_number()))
        self._pad.push_event(Gst.Event.new_custom(Gst.EventType.CUSTOM_UPSTREAM, request))

    def _await_others(self, merge: Merge) -> None:
        """Request nothing that may still come by a slower uplink."""
        others_ms = STEP_MS * math.ceil(1000 * merge.difference_s / STEP_MS)
        if others_ms != self._others_ms:
            self._others_ms = others_ms
            self._buffer.set_property("rtx-delay", REORDER_MS + min(MOST_OTHERS_MS, others_ms))
            self._buffer.set_property("rtx-min-retry-timeout", others_ms or AUTOMATIC)

    def _arrived(self, buffer: PassingBuffer, now: float) -> float | None:
        """When the kernel received a packet, s; None: unknown.

        A DTS that cannot be right, because the kernel's clock is not this process's, is corrected.
        """
        dts = buffer.dts
        if dts is None or not self._kernel_times:
            return None
        base_time = self._buffer.get_base_time()
        arrived = received_at(dts, base_time, now)
        if arrived is None:
            buffer.dts = max(0, round(now * Gst.SECOND) - base_time)
        return arrived

    def _limit_lateness(self, packet: Packet, buffer: PassingBuffer) -> None:
        if (dts := buffer.dts) is None:
            return
        excess_ms = 1000 * self._lateness.of(packet.stamp, dts / Gst.SECOND) - LONGEST_MS
        if excess_ms > 0:
            buffer.dts = max(0, dts - round(excess_ms * Gst.MSECOND))

    def _on_packet(self, _pad: Gst.Pad, buffer: PassingBuffer) -> bool:
        now = time.monotonic()
        packet = read_packet(buffer.extract(0, HEADER_BYTES), buffer.size)
        retransmitted = buffer.has_flags(RETRANSMITTED)
        arrived = self._arrived(buffer, now)
        if not retransmitted or self._tail_requested:  # the buffer takes that one for an original, see below
            self._limit_lateness(packet, buffer)
        if not self.frames.add(packet, now, arrived, retransmitted=retransmitted):
            return False
        if self._merge:
            self._merge.note_passed(packet, now)
            self._await_others(self._merge)
            if self._merge.has_taken_over(now):  # the buffer sees what is missing in a moment
                self._wait(1)
        if self._tail_requested and retransmitted:
            buffer.unset_flags(RETRANSMITTED)  # the buffer drops retransmissions that it has not requested itself
        if packet.last:
            self._ends.append((packet.stamp, now))
        self._tail_requested = False
        return False


class RtpSession:
    """The session of a receiver, with the jitter buffers of its current pipeline.

    Where the vehicle grants feedback over UDP, they repair: otherwise they reorder at most.

    uplinks  by which packets come; None: they come one way
    hz       of the RTP timestamps
    """

    def __init__(
        self,
        graph: GraphSettings,
        on_report: Callable[[str], None],
        uplinks: ReceivedUplinks | None = None,
        hz: int = RTP_HZ,
    ) -> None:
        from runner.gst.understanding import Understanding

        self._graph, self._on_report, self.uplinks, self._hz = graph, on_report, uplinks, hz
        self._counted = (0, 0)  # packets received and missing, as last read
        self._understanding = Understanding(on_report)
        self.begin()

    def begin(self) -> None:
        """Begin anew, with another pipeline."""
        self._buffers: list[RepairBuffer] = []
        self._over_udp = self._feedback = False  # transport and profile
        self._kernel_times = False  # whether packets state when the kernel received them
        self._may_use_udp = False  # until it is known whether it does
        self._may_use_uplinks = self.uplinks is not None  # likewise
        self._understanding.begin()
        if self.uplinks:
            self.uplinks.begin()

    def follow(self, client: Gst.Element) -> None:
        """Note what an RTSP client and the vehicle agree on."""
        self._may_use_udp = bool(client.get_property("protocols") & GstRtsp.RTSPLowerTrans.UDP)
        client.connect("on-sdp", self._on_description)

    def add(self, element: Gst.Element) -> None:
        """Use an element of the pipeline, if it is of the session. From any thread."""
        factory = element.get_factory().get_name() if element.get_factory() else ""
        if factory == "rtpjitterbuffer":
            reorder_ms = self._graph.jitter_buffer_ms
            merge = self.uplinks.merge if self.uplinks else None
            buffer = RepairBuffer(element, reorder_ms, kernel_times=self._kernel_times, merge=merge, hz=self._hz)
            self._buffers.append(buffer)
        if factory == "srtpdec":
            self._understanding.add(element)
        if factory == "udpsrc":
            self._over_udp = True
            try:
                self._kernel_times = state_arrivals(element)
            except OSError as error:
                self._on_report(f"the kernel does not state when packets arrive: {error}")
        if self.uplinks:
            self.uplinks.add(factory, element, kernel_times=self._kernel_times)

    @property
    def lost(self) -> int:
        """Packets of this pipeline that were never recovered."""
        return sum(buffer.lost for buffer in self._buffers)

    def adapt(self) -> int | None:
        """Adapt the wait for missing packets; returns it, ms, or None without repair. A few times a second."""
        if self.uplinks:
            self.uplinks.look()
        repairing = self._repairing()
        received = sum(buffer.frames.received for buffer in self._buffers)
        self._understanding.look(received, sum(buffer.unanswered for buffer in repairing))
        return max((buffer.adapt() for buffer in repairing), default=None)

    def waited_ms(self) -> float | None:
        """How long the end of a recent frame waited; None: unknown. A few times a second."""
        return max((ms for buffer in self._buffers if (ms := buffer.waited_ms()) is not None), default=None)

    def whole(self, captured: float | None) -> float | None:
        """See `runner.gst.merge.WholeFrames.captured`; None if that is not known, as with one uplink."""
        return None if captured is None or self.uplinks is None else self.uplinks.merge.whole.captured(captured)

    def request_tails(self) -> None:
        """Request missing packets at the end of a frame (tail loss); to be called a hundred times a second."""
        for buffer in self._repairing():
            buffer.request_tail()

    def report_transport(self) -> None:
        """Once packets arrive: say it if UDP or uplinks were wanted. Over TCP a late packet holds back what follows."""
        if self._may_use_udp and not self._over_udp:
            self._on_report(OVER_TCP)
        if self._may_use_uplinks and not self._over_udp:
            self._on_report(BY_ROUTE)
        self._may_use_udp = self._may_use_uplinks = False

    def take_arrivals(self) -> list[Arrival]:
        """Frames that arrived since the last call, without waiting for missing packets. From any one thread."""
        now = time.monotonic()
        return [arrival for buffer in self._buffers for arrival in buffer.frames.take(now)]

    def take_packets(self) -> Iterator[ArrivedPacket]:
        """Packets that arrived since the last call. From any one thread."""
        return chain.from_iterable(buffer.frames.take_packets() for buffer in self._buffers)

    def take_counts(self) -> tuple[int, int]:
        """Packets received, and initially missing, since the last call. From any one thread."""
        frames = [buffer.frames for buffer in self._buffers]
        received, missing = sum(each.received for each in frames), sum(each.missing for each in frames)
        before = self._counted if received >= self._counted[0] else (0, 0)  # a new pipeline counts from 0
        self._counted = received, max(missing, before[1])  # it drops if packets were only reordered
        return received - before[0], self._counted[1] - before[1]

    def _repairing(self) -> list[RepairBuffer]:
        return self._buffers if self._graph.retransmission_ms and self._over_udp and self._feedback else []

    def _on_description(self, _client: Gst.Element, sdp: GstSdp.SDPMessage) -> None:
        """Note whether the vehicle grants the profile with feedback, and its version."""
        self._understanding.read(sdp)
        media = range(sdp.medias_len())
        self._feedback = any(sdp.get_media(number).get_proto().endswith("AVPF") for number in media)
        if self.uplinks and media:
            self.uplinks.merge.payload_type = int(sdp.get_media(0).get_format(0))
