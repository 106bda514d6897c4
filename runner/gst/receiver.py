"""The operator's side: each camera received, decoded and measured by its own pipeline."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from gi.repository import Gst

from runner.core.model import Roi
from runner.graph import Plan, video_codec
from runner.gst.arriving import NTP_EPOCH_S
from runner.gst.caps import structure
from runner.gst.probes import BufferProbe, PassingBuffer
from runner.gst.stream_receiver import StreamReceiver
from runner.gst.video_files import VideoFile, VideoFiles
from runner.h264.access_unit import AccessUnit, read_unit, stated_region
from runner.h264.damage import HEAD_BYTES, Damage
from runner.records.reception import Arrival
from runner.system.recent import RecentValue

if TYPE_CHECKING:
    from runner.gst.received_uplinks import Addresses
    from runner.gst.secure import StreamLogin


@dataclass(frozen=True, slots=True)
class Reception:
    """What was received of one camera; counters run from the start and continue across rebuilt pipelines.

    frames      access units received
    bytes       their payload
    decoded     frames that reached the sink
    damaged     frames whose picture shows packet loss, see `runner.h264.damage`
    lost        RTP packets that never arrived
    foreign     RTP and RTCP packets from hosts other than the vehicle, dropped
    width, height  px of the decoded picture, 0 before the first
    latency_ms  decode time of the last sampled frame by this machine's clock minus its capture time by the vehicle's;
                None before the first, and if it is not recent
    latency_at  when it was measured, s by the monotonic clock
    buffer_ms   how long a picture waits for retransmitted packets; None: there are none, or the transport handles them
    waited_ms   how long a sampled frame was in the jitter buffer; None: unknown, as without RTP
    decode_ms   from a sampled access unit to its picture; None: unknown
    rebuilt     how often a pipeline that had received frames was rebuilt
    refused     whether the vehicle refuses this viewer for want of room on its uplink
    arrivals    of each access unit since the previous sample, if requested: arrival and capture time, s since 1970
                by this machine's and by the vehicle's clock
    regions     likewise, whenever pictures begin to show another part of the image, as they state it: arrival of the
                first one, and that part
    """

    frames: int = 0
    bytes: int = 0
    decoded: int = 0
    damaged: int = 0
    lost: int = 0
    foreign: int = 0
    width: int = 0
    height: int = 0
    latency_ms: float | None = None
    latency_at: float | None = None
    buffer_ms: int | None = None
    waited_ms: float | None = None
    decode_ms: float | None = None
    rebuilt: int = 0
    refused: bool = False
    arrivals: tuple[tuple[float, float | None], ...] = ()
    regions: tuple[tuple[float, Roi], ...] = ()


OnUnit = Callable[[str, AccessUnit], None]  # camera, access unit
# Camera, captured, width, height, rows of RGB, and the region of the full image that the picture states; None: none.
OnPicture = Callable[[str, float | None, int, int, bytes, Roi | None], None]
MAX_DECODING = 64  # pictures in a decoder whose regions are kept
PICTURES = (
    "videoconvert ! video/x-raw,format=RGB "
    "! appsink name={name} emit-signals=true sync=false async=false max-buffers=1 drop=true"
)


class Receiver(StreamReceiver):
    """Receives one camera. `sample` is to be called a few times a second; it also detects a silent stream.

    `rtp` is how its packets arrive.

    on_unit     called with each access unit, from the streaming thread
    on_picture  called with each decoded picture, from the streaming thread
    arrivals    record when each access unit arrived
    video       where to store the received stream; the plan must have `video`
    operator    id of the operator on the control link, which the vehicle admits first; "" for another viewer
    login       credentials for the vehicle; None: the vehicle does not authenticate
    uplinks     addresses of the vehicle by uplink, as far as known; None: it has one way
    """

    def __init__(
        self,
        plan: Plan,
        on_report: Callable[[str, str], None],
        on_unit: OnUnit | None = None,
        on_picture: OnPicture | None = None,
        arrivals: bool = False,
        video: VideoFiles | None = None,
        operator: str = "",
        login: StreamLogin | None = None,
        uplinks: Addresses | None = None,
    ) -> None:
        launch = plan.receiver_into(PICTURES.format(name=plan.operator[-1].name)) if on_picture else plan.receiver
        super().__init__(plan, launch, on_report, operator, login, uplinks)
        self._video, self._sink_name = video, plan.operator[-1].name
        self._arrivals: deque[tuple[float, float | None]] | None = deque() if arrivals else None
        self._sampled = 0  # arrivals that have been read
        self._full = self._region = plan.camera.full_roi  # the second: that the newest access unit shows
        self._changes: deque[tuple[float, Roi]] = deque()  # of it, with arrivals
        self.newest: Arrival | None = None  # access unit, complete or not, that has left the jitter buffer
        self._on_unit, self._on_picture = on_unit, on_picture
        self._regions: deque[tuple[int | None, Roi]] = deque(maxlen=MAX_DECODING)  # by PTS
        self._codec = video_codec(plan.camera.graph)
        # Others have long received what the pictures of a camera that encodes by itself, or makes no waves, refer to.
        self._joins = plan.camera.graph.passes is not None or plan.camera.graph.settings.may_have_no_waves
        self._damage, self._damaged = Damage(self._codec, is_damaged=self._joins), 0
        self._before = Reception()  # counters of earlier pipelines
        self.stopped_at = Reception()  # counters when it was stopped
        self._latency, self._decode = RecentValue[float](), RecentValue[float]()  # ms, of a sampled frame
        self._entered: tuple[int | None, float] = (None, 0.0)  # PTS of the newest access unit, and when it arrived

    def stop(self) -> None:
        """Stop receiving; it may be started again, and its counters continue."""
        self._supervised.stop()
        if self._built:
            counted = self._count()
            self.stopped_at = replace(counted, width=0, height=0, latency_ms=None, latency_at=None, decode_ms=None)
            self._before = replace(self._before, foreign=counted.foreign)
        self._close_filter()

    def sample(self, should_send: bool | None, anew: bool = False) -> Reception:
        """Reception so far; requests the latency of the next frame.

        should_send  whether the camera should; None: unknown while the vehicle is offline
        anew         ask the vehicle again now if it has refused this viewer
        """
        self._expect(should_send, anew=anew)
        buffer_ms = self.rtp.adapt()
        if self._begun:
            self.rtp.report_transport()
        received = self._count()
        received = replace(
            received,
            buffer_ms=buffer_ms,
            waited_ms=self.rtp.waited_ms(),
            arrivals=self._arrived(received.frames),
            regions=self._changed(),
        )
        if self._is_alive(received.frames, received.foreign):
            self._next_picture.arm()
        return received

    @property
    def is_damaged(self) -> bool:
        """Whether the newest picture shows unrecovered packet loss."""
        return self._begun and self._damage.is_damaged

    def _on_built(self, pipeline: Gst.Pipeline) -> Gst.Pad:
        self._before = self._count() if self._built else Reception()
        # A stream that others watch continues: what was missed meanwhile shows until a picture is healed.
        self._damage = Damage(self._codec, is_damaged=self._built or self._joins)
        self._sink = pipeline.get_by_name(self._sink_name)
        self._next_picture = BufferProbe(self._sink.get_static_pad("sink"), self._on_frame)
        self._follow(pipeline)
        if self._video:
            VideoFile(self._video, self._name, "operator", _captured, self._on_report).follow(pipeline)
        received = pipeline.get_by_name("received").get_static_pad("src")
        self._arriving = BufferProbe(received, self._on_arrival)
        self._arriving.arm()
        if self._on_picture:
            self._sink.connect("new-sample", self._on_sample)
        return received

    def _count(self) -> Reception:
        before = self._before
        caps = self._sink.get_static_pad("sink").get_current_caps()
        picture = structure(caps) if caps else None
        latency_at, latency_ms = self._latency.reading() or (None, None)
        return Reception(
            frames=self._frames,
            bytes=self._bytes,
            damaged=self._damaged,
            decoded=before.decoded + self._sink.get_property("stats").get_value("rendered"),
            foreign=before.foreign + (self._filter.dropped() if self._filter else 0),
            lost=before.lost + self.rtp.lost,
            width=picture.get_int("width")[1] if picture else 0,
            height=picture.get_int("height")[1] if picture else 0,
            latency_ms=latency_ms,
            latency_at=latency_at,
            decode_ms=self._decode.get(),
            rebuilt=self._supervised.rebuilt,
            refused=self._refused > 0,
        )

    def _on_frame(self, _pad: Gst.Pad, picture: PassingBuffer) -> bool:
        now, reference_ns, (pts, arrived) = time.monotonic(), picture.reference_ns, self._entered
        if reference_ns is not None:
            self._latency.set(1000 * (time.time() - unix_s(reference_ns)))
        if pts is not None and picture.pts == pts:
            self._decode.set(1000 * (now - arrived))
        return True

    def _on_arrival(self, pad: Gst.Pad, buffer: PassingBuffer) -> bool:
        """An access unit has arrived; page and log share its times."""
        arrived, monotonic, size, captured = time.time(), time.monotonic(), buffer.size, _captured(pad, buffer)
        # The depayloader marks the very first unit, and each unit with missing packets.
        incomplete, self._begun = self._begun and buffer.has_flags(Gst.BufferFlags.DISCONT), True
        whole = self.rtp.whole(captured) if incomplete else None
        damaged = self._damage.add(incomplete, lambda: buffer.extract(0, HEAD_BYTES), whole=whole is not None)
        if not damaged and whole is not None:
            captured = whole
        self._entered = (buffer.pts, monotonic)
        if captured is not None:
            self.newest = Arrival(monotonic, captured, size)
        if self._arrivals is not None:
            self._arrivals.append((arrived, captured))
        self._bytes += size
        self._refused = 0
        self._frames += 1  # after its arrival is recorded: no sample counts a frame without one
        self._damaged += damaged
        if self._codec == "h264" and (self._on_picture or self._arrivals is not None):
            self._note_region(arrived, buffer.pts, stated_region(buffer.extract(0, HEAD_BYTES)))
        if self._on_unit:
            unit = read_unit(buffer.extract(0, size), captured, arrived, damaged=incomplete, codec=self._codec)
            if unit:
                self._on_unit(self._name, unit._replace(damaged=damaged))
        return False

    def _note_region(self, arrived: float, pts: int | None, region: Roi | None) -> None:
        if self._on_picture and region:
            self._regions.append((pts, region))
        shown = region or self._full
        if self._arrivals is not None and shown != self._region:
            self._region = shown
            self._changes.append((arrived, shown))

    def _changed(self) -> tuple[tuple[float, Roi], ...]:
        """Changes of the region since the last call."""
        return tuple(self._changes.popleft() for _ in range(len(self._changes)))

    def _arrived(self, frames: int) -> tuple[tuple[float, float | None], ...]:
        """Arrivals since the last call, only of frames already counted: more may arrive meanwhile."""
        if self._arrivals is None:
            return ()
        new = tuple(self._arrivals.popleft() for _ in range(min(len(self._arrivals), frames - self._sampled)))
        self._sampled += len(new)
        return new

    def _on_sample(self, sink: Gst.Element) -> Gst.FlowReturn:
        sample = sink.emit("pull-sample")
        picture, buffer = structure(sample.get_caps()), sample.get_buffer()
        width, height = picture.get_int("width")[1], picture.get_int("height")[1]
        data = buffer.extract_dup(0, buffer.get_size())  # a copy: the decoder reuses its memory
        region = dict(list(self._regions)).get(buffer.pts)
        self._on_picture(self._name, capture_time(buffer), width, height, data, region)  # type: ignore[misc]
        return Gst.FlowReturn.OK


def _captured(_pad: Gst.Pad, unit: PassingBuffer) -> float | None:
    reference_ns = unit.reference_ns
    return None if reference_ns is None else unix_s(reference_ns)


def capture_time(buffer: Gst.Buffer) -> float | None:
    """Capture time of a frame, s since 1970 by the vehicle's clock; None if the transport does not carry it."""
    meta = buffer.get_reference_timestamp_meta(None)
    return unix_s(meta.timestamp) if meta and meta.timestamp else None


def unix_s(reference_ns: int) -> float:
    """A reference timestamp as s since 1970; those of RTP are in NTP time."""
    return float(reference_ns / Gst.SECOND - NTP_EPOCH_S)
