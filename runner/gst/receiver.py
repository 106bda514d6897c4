"""The operator's side: each camera received, decoded and measured by a pipeline of its own."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace

from gi.repository import GObject, Gst, GstSdp

from runner.graph import Plan
from runner.gst.pipeline import counted
from runner.gst.supervised import SupervisedPipeline
from runner.gst.video_files import VideoFile, VideoFiles
from runner.units import AccessUnit, read_unit

NTP_EPOCH_S = 2_208_988_800  # 1900-01-01 to 1970-01-01 (RFC 5905)
STALL_S = 2.0  # a camera that should send and is silent for longer is built anew


@dataclass(frozen=True, slots=True)
class Received:
    """What has come of one camera; counters run since the start and go on through rebuilt pipelines.

    frames      access units received
    bytes       their payload
    decoded     frames that reached the sink
    lost        RTP packets that never came
    width, height  px of the decoded picture, 0 before the first
    latency_ms  capture to decode of the last sampled frame; None before the first
    rebuilt     how often the pipeline was built anew
    arrivals    of each access unit since the sample before, where wanted: when it came and when it was captured,
                s since 1970 by this machine's and by the vehicle's clock
    """

    frames: int = 0
    bytes: int = 0
    decoded: int = 0
    lost: int = 0
    width: int = 0
    height: int = 0
    latency_ms: float | None = None
    rebuilt: int = 0
    arrivals: tuple[tuple[float, float | None], ...] = ()


OnUnit = Callable[[str, AccessUnit], None]  # camera, what came
OnPicture = Callable[[str, float | None, int, int, bytes], None]  # camera, captured, width, height, rows of RGB
PICTURES = (
    "videoconvert ! video/x-raw,format=RGB "
    "! appsink name={name} emit-signals=true sync=false async=false max-buffers=1 drop=true"
)


class Receiver:
    """Receives one camera. `sample` is to be called a few times a second; it keeps watch over a silent stream.

    on_unit     told each access unit from the streaming thread
    on_picture  told each decoded picture from the streaming thread
    arrivals    keep when each access unit came
    video       where what comes is kept; the plan has `video` then
    Without these no Python runs per frame.
    """

    def __init__(
        self,
        plan: Plan,
        report: Callable[[str, str], None],
        on_unit: OnUnit | None = None,
        on_picture: OnPicture | None = None,
        arrivals: bool = False,
        video: VideoFiles | None = None,
    ) -> None:
        self._report, self._video = report, video
        self._client_name, self._sink_name = plan.operator[0].name, plan.operator[-1].name
        self._arrivals: deque[tuple[float, float | None]] | None = deque() if arrivals else None
        self._on_unit, self._on_picture = on_unit, on_picture
        self._name = name = plan.camera.name
        launch = plan.receiver_into(PICTURES.format(name=self._sink_name)) if on_picture else plan.receiver
        self._supervised = SupervisedPipeline(launch, self._on_built, lambda what: report(name, what))
        self._before = Received()  # what earlier pipelines have counted
        self._latency_ms: float | None = None
        self._moved = (0, time.monotonic())  # frames at the last change of the counter, and when
        self.should_send = False

    def start(self) -> None:
        self._supervised.start()

    def stop(self) -> None:
        self._supervised.stop()

    def sample(self) -> Received:
        """What has come so far; asks for the latency of the next frame."""
        received = replace(self._count(), arrivals=self._arrived())
        now = time.monotonic()
        if received.frames != self._moved[0] or not self.should_send:
            self._moved = (received.frames, now)
        elif now - self._moved[1] > STALL_S:
            self._moved = (received.frames, now)
            self._supervised.restart(f"no frame for {STALL_S:g} s")
        else:
            return received
        # One frame in many is looked at: no Python runs for the others.
        self._sink.get_static_pad("sink").add_probe(Gst.PadProbeType.BUFFER, self._on_frame)
        return received

    def _on_built(self, pipeline: Gst.Pipeline) -> None:
        self._before = self._count() if self._supervised.rebuilt else Received()
        self._sink = pipeline.get_by_name(self._sink_name)
        self._received = pipeline.get_by_name("received")
        self._begun = False
        self._jitter_buffers: list[Gst.Element] = []
        pipeline.connect("deep-element-added", self._on_element)
        client = pipeline.get_by_name(self._client_name)
        if GObject.signal_lookup("select-stream", client):
            take_feedback(client)
        if self._video:
            VideoFile(self._video, self._name, "operator", _came, self._report).follow(pipeline)
        if self._on_unit:
            self._received.get_static_pad("src").add_probe(Gst.PadProbeType.BUFFER, self._on_access_unit)
        if self._arrivals is not None:
            self._received.get_static_pad("src").add_probe(Gst.PadProbeType.BUFFER, self._on_arrival)
        if self._on_picture:
            self._sink.connect("new-sample", self._on_sample)

    def _on_element(self, _pipeline: Gst.Pipeline, _parent: Gst.Bin, element: Gst.Element) -> None:
        if element.get_factory() and element.get_factory().get_name() == "rtpjitterbuffer":
            # Frames come in bursts: the packet that is guessed to be next is the next frame's, and not missing.
            element.set_property("rtx-next-seqnum", False)
            self._jitter_buffers.append(element)

    def _count(self) -> Received:
        before = self._before
        frames, size = counted(self._received)
        caps = self._sink.get_static_pad("sink").get_current_caps()
        picture = caps.get_structure(0) if caps else None
        return Received(
            frames=before.frames + frames,
            bytes=before.bytes + size,
            decoded=before.decoded + self._sink.get_property("stats").get_value("rendered"),
            lost=before.lost + sum(b.get_property("stats").get_value("num-lost") for b in self._jitter_buffers),
            width=picture.get_int("width")[1] if picture else 0,
            height=picture.get_int("height")[1] if picture else 0,
            latency_ms=self._latency_ms,
            rebuilt=self._supervised.rebuilt,
        )

    def _on_frame(self, _pad: Gst.Pad, info: Gst.PadProbeInfo) -> Gst.PadProbeReturn:
        captured = capture_time(info.get_buffer())
        if captured is not None:
            self._latency_ms = 1000 * (time.time() - captured)
        return Gst.PadProbeReturn.REMOVE

    def _on_arrival(self, _pad: Gst.Pad, info: Gst.PadProbeInfo) -> Gst.PadProbeReturn:
        self._arrivals.append((time.time(), capture_time(info.get_buffer())))  # type: ignore[union-attr]
        return Gst.PadProbeReturn.OK

    def _arrived(self) -> tuple[tuple[float, float | None], ...]:
        """What has arrived since the last call; more may come meanwhile."""
        arrivals = self._arrivals or ()
        return tuple(self._arrivals.popleft() for _ in range(len(arrivals)))  # type: ignore[union-attr]

    def _on_access_unit(self, _pad: Gst.Pad, info: Gst.PadProbeInfo) -> Gst.PadProbeReturn:
        arrived, buffer = time.time(), info.get_buffer()
        data = buffer.extract_dup(0, buffer.get_size())
        # The depayloader marks the first unit of all, and each that packets are missing of.
        damaged, self._begun = self._begun and buffer.has_flags(Gst.BufferFlags.DISCONT), True
        unit = read_unit(data, capture_time(buffer), arrived, damaged=damaged)
        if unit:
            self._on_unit(self._name, unit)  # type: ignore[misc]
        return Gst.PadProbeReturn.OK

    def _on_sample(self, sink: Gst.Element) -> Gst.FlowReturn:
        sample = sink.emit("pull-sample")
        picture, buffer = sample.get_caps().get_structure(0), sample.get_buffer()
        width, height = picture.get_int("width")[1], picture.get_int("height")[1]
        data = buffer.extract_dup(0, buffer.get_size())  # a copy: the decoder uses its memory again
        self._on_picture(self._name, capture_time(buffer), width, height, data)  # type: ignore[misc]
        return Gst.FlowReturn.OK


def _came(_pad: Gst.Pad, buffer: Gst.Buffer) -> float:
    """When a frame was captured, s since 1970; when it came, where the line does not carry that."""
    captured = capture_time(buffer)
    return time.time() if captured is None else captured


def take_feedback(client: Gst.Element) -> None:
    """Let an RTSP client take the stream in the profile in which lost packets are asked for again (RFC 4585, 4588).

    A server that offers both states the stream twice; by itself the client takes the first, which has no feedback.
    """
    chosen = [0]

    def on_sdp(_client: Gst.Element, sdp: GstSdp.SDPMessage) -> None:
        profiles = [sdp.get_media(number).get_proto() for number in range(sdp.medias_len())]
        chosen[0] = next((number for number, profile in enumerate(profiles) if profile.endswith("AVPF")), 0)

    client.connect("on-sdp", on_sdp)
    client.connect("select-stream", lambda _client, number, _caps: number == chosen[0])


def capture_time(buffer: Gst.Buffer) -> float | None:
    """When a frame was captured, s since 1970 by the vehicle's clock; None where the line does not carry it."""
    meta = buffer.get_reference_timestamp_meta(None)
    return meta.timestamp / Gst.SECOND - NTP_EPOCH_S if meta else None
