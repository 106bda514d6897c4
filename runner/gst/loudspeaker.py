"""The vehicle's loudspeaker: a mount of the RTSP server to which the operator in control, and nobody else, may send.

It announces what it sends (RFC 2326, 10.3 and 10.11), with the keys of its SRTP, over the same TLS as viewers. Over UDP
only: what TCP delivers late would be heard long after the key was released.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from typing import TYPE_CHECKING, NamedTuple

from gi.repository import Gst, GstRtsp, GstRtspServer

from runner.core.budget import VOICE
from runner.graph import launch
from runner.gst.arriving import HEADER_BYTES, NUMBERS, read_packet
from runner.gst.clients import Clients
from runner.gst.connections import RtspConnection
from runner.gst.lost import LostCameras
from runner.gst.probes import BufferProbe, PassingBuffer, PassProbe
from runner.gst.rtsp_requests import path, user_agent, wants_udp
from runner.gst.sessions import end
from runner.gst.srtp import join_keys
from runner.gst.viewers import StreamViewer, operator_of
from runner.records.vehicle import VoiceReading
from runner.system.lateness import Lateness
from runner.system.recent import RecentValue
from runner.voice import DEPAY, VoicePlan

if TYPE_CHECKING:
    from runner.gst.secure import ViewerCheck

STATUS = GstRtsp.RTSPStatusCode
OPUS_HZ, STAMPS = 48_000, 2**32  # of RTP timestamps (RFC 7587), and so many there are
LATE_S = 0.3  # a packet that has taken so much longer than others is not played: its key may have been released
SPEAKING_S, SPEAKING_PACKETS = 0.3, 3  # somebody speaks while so many arrive within so long; the first one is silent
QUIETEST_DB = -100.0
CHECK_S, LOOK_MS = 3.0, 20  # how long a loudspeaker may take to start when it is tried; between two looks
SILENCE = "audiotestsrc wave=silence num-buffers=5 ! audio/x-raw,rate=48000,channels=1 ! audioconvert ! audioresample"


class _Factory(GstRtspServer.RTSPMediaFactory):  # type: ignore[misc]  # PyGObject has no types
    """permissions: of those that may log in; None: anyone may, and nothing is encrypted"""

    def __init__(
        self,
        plan: VoicePlan,
        addresses: GstRtspServer.RTSPAddressPool,
        permissions: GstRtspServer.RTSPPermissions | None,
    ) -> None:
        super().__init__()
        self.set_transport_mode(GstRtspServer.RTSPTransportMode.RECORD)
        self.set_launch(plan.server)
        self.set_latency(plan.jitter_buffer_ms)
        self.set_address_pool(addresses)
        self.set_protocols(GstRtsp.RTSPLowerTrans.UDP)
        if permissions:
            self.set_permissions(permissions)
        self.set_profiles(GstRtsp.RTSPProfile.SAVP if permissions else GstRtsp.RTSPProfile.AVP)


class _Speaker(NamedTuple):
    """Who may speak now: an operator, by one connection."""

    operator: str
    client: GstRtspServer.RTSPClient
    connection: RtspConnection


class Loudspeaker:
    """Its callbacks run in the threads of clients; `reading` in any.

    clients    of the server
    keys       None: anyone may connect, and operators are who they say
    lost       knows why it does not open
    on_report  called with what happened to it
    """

    def __init__(
        self,
        plan: VoicePlan,
        addresses: GstRtspServer.RTSPAddressPool,
        clients: Clients,
        keys: ViewerCheck | None,
        lost: LostCameras,
        on_report: Callable[[str], None],
    ) -> None:
        self._clients, self._keys, self._lost, self._on_report = clients, keys, lost, on_report
        self._changed = clients.changed
        self.factory = _Factory(plan, addresses, keys and keys.permissions)
        self.factory.connect("media-configure", self._on_configure)
        self._in_control = ""
        self._speaker: _Speaker | None = None
        self._refused: tuple[StreamViewer, str] | None = None  # the last one, and why
        self._heard: _Heard | None = None  # of the newest pipeline
        self._before = (0, 0)  # packets and losses of earlier ones

    def give_control(self, operator: str) -> None:
        """Let this operator speak, and nobody else; "": nobody. From any thread."""
        with self._changed:
            self._in_control, speaker = operator, self._speaker
        if speaker and speaker.operator != operator:
            self._on_report(f"disconnected {speaker.operator}, who is no longer in control")
            speaker.connection.close()

    def on_announce(
        self, client: GstRtspServer.RTSPClient, context: GstRtspServer.RTSPContext
    ) -> GstRtsp.RTSPStatusCode:
        """Admit who is in control; anybody else is refused."""
        connection = self._clients.of(client)
        if path(context) != VOICE or connection is None:
            return STATUS.NOT_FOUND
        if self._keys:
            connection.read_certificate(client)
            if refusal := self._keys.refusal(connection.certificate, context.token):
                connection.refusal = refusal
                return STATUS.FORBIDDEN
        operator = self._keys.viewer(connection.certificate) if self._keys else operator_of(user_agent(context))
        connection.identify(operator)
        connection.refusal = ""
        with self._changed:
            before = self._speaker
            if not operator or operator != self._in_control:
                self._refuse(connection.viewer, f"{self._in_control or 'nobody'} is in control")
                return STATUS.FORBIDDEN
            if before is None:
                self._speaker, self._refused = _Speaker(operator, client, connection), None
        if before:
            before.connection.close()  # of the same operator, whose address may have changed: it tries again
            return STATUS.SERVICE_UNAVAILABLE
        return STATUS.OK if self._lost.may_open(VOICE) else STATUS.SERVICE_UNAVAILABLE

    def _refuse(self, viewer: StreamViewer, why: str) -> None:
        """Report a refusal, but not each attempt."""
        refused = viewer._replace(since=0.0), why
        if self._refused != refused:
            self._refused = refused
            self._on_report(f"refused {viewer}: {why}")

    def on_setup(self, client: GstRtspServer.RTSPClient, context: GstRtspServer.RTSPContext) -> GstRtsp.RTSPStatusCode:
        """Control may have passed since it was announced."""
        with self._changed:
            speaker = self._speaker
            is_allowed = speaker is not None and speaker.client is client and speaker.operator == self._in_control
        if not is_allowed:
            return STATUS.FORBIDDEN
        join_keys(context.request)
        return STATUS.OK if wants_udp(context) else STATUS.UNSUPPORTED_TRANSPORT

    def on_closed(self, client: GstRtspServer.RTSPClient) -> None:
        """A connection has ended: what it has set up must not play on until its session expires."""
        for session in client.session_filter(None):
            for media in session.filter(None):
                if media.get_media().get_transport_mode() & GstRtspServer.RTSPTransportMode.RECORD:
                    end(session, media)
        with self._changed:
            if self._speaker and self._speaker.client is client:
                self._speaker = None

    def reading(self) -> VoiceReading:
        """What is known of it now."""
        speaker, heard, (packets, lost) = self._speaker, self._heard, self._before
        if heard:
            packets, lost = packets + heard.packets, lost + heard.lost
        return VoiceReading(
            operator=speaker.operator if speaker and heard else None,
            speaking=heard is not None and heard.is_spoken(),
            packets=packets,
            missing=lost,
            level_db=heard.level.get() if heard else None,
            lost=self._lost.reasons().get(VOICE),
        )

    def _on_configure(self, _factory: object, media: GstRtspServer.RTSPMedia) -> None:
        element = media.get_element()
        pipeline, heard = element.get_parent(), _Heard(element)
        bus = pipeline.get_bus()
        bus.enable_sync_message_emission()
        bus.connect("sync-message::element", heard.on_message)
        bus.connect("sync-message::error", self._on_error, heard)
        pipeline.connect("deep-element-added", heard.on_element)
        media.connect("prepared", self._on_prepared, heard)
        media.connect("unprepared", self._on_unprepared, heard)

    def _on_prepared(self, _media: object, heard: _Heard) -> None:
        self._lost.open(VOICE)
        self._heard = heard

    def _on_unprepared(self, _media: object, heard: _Heard) -> None:
        with self._changed:
            if self._heard is heard:
                self._before = self._before[0] + heard.packets, self._before[1] + heard.lost
                self._heard = None

    def _on_error(self, _bus: Gst.Bus, message: Gst.Message, heard: _Heard) -> None:
        if heard.failed:
            return
        heard.failed = True
        self._lost.fail(VOICE, _words(message))
        with self._changed:
            speaker = self._speaker
        if speaker:
            speaker.connection.close()


class _Heard:
    """What arrives in one pipeline: counted, and dropped where it comes too late."""

    def __init__(self, element: Gst.Bin) -> None:
        self.packets = self.lost = 0
        self.level = RecentValue[float]()
        self.failed = False
        self._last: int | None = None  # number of the newest packet
        self._stamp: int | None = None  # of the newest one, counted on where RTP begins anew
        self._recent: deque[float] = deque(maxlen=SPEAKING_PACKETS)  # when the last ones arrived
        self._lateness = Lateness()
        self._probe = BufferProbe(element.get_by_name(DEPAY).get_static_pad("sink"), self._on_packet)
        self._probe.arm()
        self._passing: PassProbe | None = None

    def is_spoken(self) -> bool:
        times = tuple(self._recent)
        return len(times) == SPEAKING_PACKETS and time.monotonic() - times[0] < SPEAKING_S

    def on_element(self, _pipeline: Gst.Bin, _parent: Gst.Bin, element: Gst.Element) -> None:
        """Of those that the server adds."""
        if element.find_property("do-lost"):
            element.set_property("do-lost", True)  # the decoder conceals only what it is told of
        if element.get_factory() and element.get_factory().get_name() == "rtpjitterbuffer":
            self._passing = PassProbe(element.get_static_pad("sink"), self._is_timely)

    def _is_timely(self, _pad: Gst.Pad, buffer: PassingBuffer) -> bool:
        """Whether a packet may be played; before the jitter buffer."""
        packet = read_packet(buffer.extract(0, HEADER_BYTES), buffer.size)
        before = packet.stamp if self._stamp is None else self._stamp
        self._stamp = before + (packet.stamp - before + STAMPS // 2) % STAMPS - STAMPS // 2
        return self._lateness.add(self._stamp / OPUS_HZ, time.monotonic()) < LATE_S

    def _on_packet(self, _pad: Gst.Pad, buffer: PassingBuffer) -> bool:
        number = read_packet(buffer.extract(0, HEADER_BYTES), buffer.size).number
        if self._last is not None:
            self.lost += (number - self._last - 1) % NUMBERS
        self._last = number
        self.packets += 1
        self._recent.append(time.monotonic())
        return False

    def on_message(self, _bus: Gst.Bus, message: Gst.Message) -> None:
        found = message.get_structure()
        if found.get_name() == "level":
            with suppress(TypeError, IndexError):
                (rms,) = found.get_value("rms")
                self.level.set(max(QUIETEST_DB, rms) if math.isfinite(rms) else QUIETEST_DB)


def loudspeaker_problem(plan: VoicePlan) -> str | None:
    """Why the loudspeaker does not open, or plays nothing; None if it does."""
    pipeline = Gst.parse_launch(f"{SILENCE} ! {launch(plan.loudspeaker)}")
    bus, until, kinds = pipeline.get_bus(), time.monotonic() + CHECK_S, Gst.MessageType.ERROR | Gst.MessageType.EOS
    try:
        pipeline.set_state(Gst.State.PLAYING)
        while time.monotonic() < until:
            if message := bus.timed_pop_filtered(LOOK_MS * Gst.MSECOND, kinds):
                return _words(message) if message.type == Gst.MessageType.ERROR else None
        return f"{_named(plan)} plays nothing within {CHECK_S:g} s"
    finally:
        pipeline.set_state(Gst.State.NULL)


def _words(error: Gst.Message) -> str:
    source = error.src
    names = (source.get_property(key) for key in ("device", "location") if source.find_property(key))
    named = " ".join(str(each) for each in (source.get_factory().get_name(), *names) if each)
    return f"{named}: {str(error.parse_error()[0].message).rstrip('.')}"


def _named(plan: VoicePlan) -> str:
    return plan.loudspeaker[-1].factory
