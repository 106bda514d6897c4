"""The operator's side: the vehicle's sound, received, measured, and handed on as packets or decoded."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

from gi.repository import Gst

from runner.gst.arriving import NUMBERS, read_packet
from runner.gst.probes import BufferProbe, PassingBuffer
from runner.gst.receiver import capture_time
from runner.gst.stream_receiver import StreamReceiver
from runner.sound import SoundPlan
from runner.system.recent import RecentValue

if TYPE_CHECKING:
    from runner.gst.received_uplinks import Addresses
    from runner.gst.secure import StreamLogin

OPUS_HZ = 48_000  # of its RTP timestamps, whatever is encoded (RFC 7587)
ANEW = 1000  # packets by which numbers jump where a pipeline is built anew: nobody conceals these
QUIETEST_DB = -100.0
DECODED = (
    "audioconvert ! audio/x-raw,format=S16LE,channels=1,rate=48000 "
    "! appsink name={name} emit-signals=true sync=false async=false max-buffers=10 drop=true"
)


class SoundPacket(NamedTuple):
    """An Opus packet that has left the jitter buffer.

    number    counts packets, those included that were lost
    captured  when its first sample was, s since 1970 by the vehicle's clock; None: unknown
    arrived   s since 1970 by this machine's clock
    """

    number: int
    captured: float | None
    arrived: float
    data: bytes


@dataclass(frozen=True, slots=True)
class SoundReception:
    """What was received; counters run from the start and continue across rebuilt pipelines.

    packets     and their payload, bytes
    lost        RTP packets that never arrived, or too late
    level_db    of the last quarter of a second, decoded, dB below full scale (RMS); None: nothing was
    latency_ms  arrival of the newest packet by this machine's clock minus its capture by the vehicle's; None: unknown
    foreign, rebuilt, refused  as in `runner.gst.receiver.Reception`
    """

    packets: int = 0
    bytes: int = 0
    lost: int = 0
    level_db: float | None = None
    latency_ms: float | None = None
    foreign: int = 0
    rebuilt: int = 0
    refused: bool = False


OnSound = Callable[[SoundPacket], None]
OnSamples = Callable[[float | None, bytes], None]  # captured, S16LE at 48 kHz of one channel


class SoundReceiver(StreamReceiver):
    """Receives the sound. `sample` is to be called a few times a second; it also detects a silent stream.

    on_sound    called with each packet, from the streaming thread
    on_samples  called with what is decoded, losses concealed, from the streaming thread
    others      as of `runner.gst.receiver.Receiver`
    """

    def __init__(
        self,
        plan: SoundPlan,
        on_report: Callable[[str, str], None],
        on_sound: OnSound | None = None,
        on_samples: OnSamples | None = None,
        operator: str = "",
        login: StreamLogin | None = None,
        uplinks: Addresses | None = None,
    ) -> None:
        self._sink_name = plan.operator[-1].name
        launch = plan.receiver_into(DECODED.format(name=self._sink_name)) if on_samples else plan.receiver
        super().__init__(plan, launch, on_report, operator, login, uplinks, OPUS_HZ)
        self._on_sound, self._on_samples = on_sound, on_samples
        self._before = self.stopped_at = SoundReception()  # counters of earlier pipelines, and when it was stopped
        self._level, self._latency = RecentValue[float](), RecentValue[float]()
        self._number = self._last = 0  # of the newest packet, and as RTP states it
        self._decoded: float | None = None  # when the next decoded sample was captured

    def stop(self) -> None:
        """Stop receiving; it may be started again, and its counters continue."""
        self._supervised.stop()
        if self._built:
            self._before = self._count()
            self.stopped_at = replace(self._before, level_db=None, latency_ms=None)
            self._built = False
        self._close_filter()

    def sample(self, should_send: bool | None, anew: bool = False) -> SoundReception:
        """Reception so far; arguments as those of `Receiver.sample`."""
        self._expect(should_send, anew=anew)
        self.rtp.adapt()
        if self._begun:
            self.rtp.report_transport()
        received = self._count()
        self._is_alive(received.packets, received.foreign)
        return received

    def _on_built(self, pipeline: Gst.Pipeline) -> Gst.Pad:
        self._before = self._count() if self._built else self._before
        self._decoded = None
        self._follow(pipeline)
        pipeline.get_bus().connect("message::element", self._on_level)
        if self._on_samples:
            pipeline.get_by_name(self._sink_name).connect("new-sample", self._on_sample)
        arriving = pipeline.get_by_name("depay").get_static_pad("sink")
        self._arriving = BufferProbe(arriving, self._on_packet)
        self._arriving.arm()
        decoding: Gst.Pad = pipeline.get_by_name("depay").get_static_pad("src")
        return decoding

    def _on_element(self, pipeline: Gst.Pipeline, parent: Gst.Bin, element: Gst.Element) -> None:
        super()._on_element(pipeline, parent, element)
        if element.find_property("do-lost"):
            element.set_property("do-lost", True)  # the decoder conceals only what it is told of

    def _count(self) -> SoundReception:
        before = self._before
        return SoundReception(
            packets=self._frames,
            bytes=self._bytes,
            lost=before.lost + self.rtp.lost,
            level_db=self._level.get(),
            latency_ms=self._latency.get(),
            foreign=before.foreign + (self._filter.dropped() if self._filter else 0),
            rebuilt=self._supervised.rebuilt,
            refused=self._refused > 0,
        )

    def _on_packet(self, _pad: Gst.Pad, buffer: PassingBuffer) -> bool:
        arrived, whole = time.time(), buffer.extract(0, buffer.size)
        packet = read_packet(whole, len(whole))
        self._number += ANEW if not self._begun else (packet.number - self._last) % NUMBERS
        self._last, self._begun = packet.number, True
        if packet.captured is not None:
            self._latency.set(1000 * (arrived - packet.captured))
        self._refused = 0
        self._bytes += packet.bytes
        self._frames += 1
        if self._on_sound:
            data = whole[len(whole) - packet.bytes :]
            self._on_sound(SoundPacket(self._number, packet.captured, arrived, data))
        return False

    def _on_level(self, _bus: Gst.Bus, message: Gst.Message) -> None:
        found = message.get_structure()
        if found.get_name() == "level":
            with suppress(TypeError, IndexError):
                (rms,) = found.get_value("rms")
                self._level.set(max(QUIETEST_DB, rms) if math.isfinite(rms) else QUIETEST_DB)

    def _on_sample(self, sink: Gst.Element) -> Gst.FlowReturn:
        buffer = sink.emit("pull-sample").get_buffer()
        data = buffer.extract_dup(0, buffer.get_size())
        stated = capture_time(buffer)  # none where a loss was concealed
        captured = self._decoded if stated is None else stated
        self._decoded = None if captured is None else captured + len(data) / 2 / OPUS_HZ
        self._on_samples(captured, data)  # type: ignore[misc]
        return Gst.FlowReturn.OK
