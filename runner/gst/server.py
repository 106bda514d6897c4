"""The vehicle's RTSP server: one shared factory (`camera_media`) per camera, whose pipeline is built when watched.

The server library runs each client in its own thread, so that a waiting client does not delay the others. Its
callbacks run in any of these threads, and one lock guards all shared state.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from importlib import import_module
from typing import TYPE_CHECKING, Any

from gi.repository import GLib, GstRtsp, GstRtspServer

from runner.core.budget import SOUND, VOICE
from runner.errors import RunError
from runner.graph import FEEDBACK, Plan, rtsp_url
from runner.gst.admission import FORBIDDEN, OK, UNAVAILABLE, Admission
from runner.gst.camera_media import describe_for, wants_feedback
from runner.gst.clients import Clients, drop_silent
from runner.gst.connections import RtspConnection
from runner.gst.left import LeftCameras
from runner.gst.memory import give_back
from runner.gst.opening import ServedCameras
from runner.gst.other_servers import OtherServers
from runner.gst.pipeline import Openings
from runner.gst.rtsp_requests import camera_name, has_password, has_query, path
from runner.gst.sessions import SessionPool, is_held, on_session_removed
from runner.gst.timers import every
from runner.gst.viewers import over_uplink
from runner.records.vehicle import NOTHING_ENCODED, SoundReading
from runner.settings import Endpoint, Media
from runner.system.ports import check_port_free, ip_address_of
from runner.system.reports import LimitedReports

if TYPE_CHECKING:
    from runner.gst.loudspeaker import Loudspeaker
    from runner.gst.secure import ViewerCheck
    from runner.security.keyring import Keyring
    from runner.sound import SoundPlan
    from runner.voice import VoicePlan

BACKLOG = 128  # connections waiting to be accepted; with the library's 5, further viewers would retry after 1 s
MAX_BODY_BYTES = 65_536  # of a request; the library's limit is 4 GB ...
MAX_REQUEST_BYTES = 1_048_576  # ... and it has none for the number of headers
LAG_S = 1.0  # a TCP viewer that lags by more is disconnected
WATCH_MS = 200
SESSIONS_EVERY_S = 1.0
GIVE_BACK_S = 10.0  # interval at which memory of ended pipelines and of replaced encoders is returned to the system
METHODS = (
    *("options", "describe", "announce", "setup", "play", "record", "pause", "get-parameter", "set-parameter"),
    "teardown",
)
MOVED, NOT_FOUND = GstRtsp.RTSPStatusCode.MOVED_PERMANENTLY, GstRtsp.RTSPStatusCode.NOT_FOUND

# Default reasons for refusing a client that has not authenticated.
NO_CERTIFICATE, NO_PASSWORD, WRONG_PASSWORD = (
    "it has not completed a TLS handshake with a certificate",
    "it has given no password",
    "its password is wrong",
)


class CameraServer:
    """RTSP server with mount points for the sound and for each camera: one plain, one with feedback for our receivers.

    keyring  of this vehicle; None: anyone may watch, and nothing is encrypted
    voice    its loudspeaker; None: it has none
    """

    def __init__(
        self,
        plans: Sequence[Plan | SoundPlan],
        media: Media,
        openings: Openings,
        keyring: Keyring | None,
        voice: VoicePlan | None = None,
    ) -> None:
        check_port_free(media)
        on_report = openings.on_report
        self._keys: ViewerCheck | None = None
        self._keys_fault = ""  # the last one reported
        if keyring:
            from runner.gst.secure import ViewerCheck

            self._keys = ViewerCheck(keyring, lambda what: on_report("keys", what), self._on_refused)
        self._report_refusal = LimitedReports(lambda what: on_report("keys", what))
        self._media, self._on_report = media, on_report
        self._silent_s = None if openings.uplinks else media.session_timeout_s
        self._stopped = threading.Event()
        self._clients = Clients(on_report)
        self._changed = self._clients.changed
        permissions = self._keys and self._keys.permissions
        self._cameras = ServedCameras(plans, media, openings, permissions, self._clients, self._stopped)
        self.pipelines = self._cameras.pipelines
        self.admission = Admission(self._cameras, self._clients, self._keys, media, on_report)
        self._lost = openings.lost
        self.loudspeaker: Loudspeaker | None = None
        if voice:
            kind: Any = import_module("runner.gst.loudspeaker").Loudspeaker
            report = partial(on_report, VOICE)
            self.loudspeaker = kind(voice, self._cameras.addresses, self._clients, self._keys, self._lost, report)
        self._left = LeftCameras(self._clients, self.pipelines)
        self._sessions, self._mounts = SessionPool(), GstRtspServer.RTSPMountPoints()
        self._sessions.connect("session-removed", on_session_removed)
        for name, camera in self._cameras.named.items():
            for mount in (name, f"{name}/{FEEDBACK}"):
                self._mounts.add_factory(f"/{mount}", camera.factory)
        if self.loudspeaker:
            self._mounts.add_factory(f"/{VOICE}", self.loudspeaker.factory)
        own = ip_address_of(media.host)  # of a name with several, IPv4
        self._server = self._make_server(own)
        self._attached = self._server.attach(None)
        if not self._attached:
            raise RunError(f"the RTSP server cannot listen on {media}; choose another media.port")
        others = openings.uplinks.listening if openings.uplinks else dict
        self._others = OtherServers(self._make_server, others, Endpoint(own, media.port), on_report)
        watches = (self._watch_connections, *((self._watch_keys,) if self._keys else ()))
        self._watches = [every(WATCH_MS, watch, lambda what: on_report("viewers", what)) for watch in watches]
        threading.Thread(target=self._expire_sessions, name="rtsp-sessions", daemon=True).start()

    def _make_server(self, address: str) -> GstRtspServer.RTSPServer:
        """One that serves the same as all others, at an address of its own."""
        server = GstRtspServer.RTSPServer()
        server.set_address(address)
        server.set_service(str(self._media.port))
        server.set_backlog(BACKLOG)
        server.set_content_length_limit(MAX_BODY_BYTES)
        server.set_thread_pool(self._cameras.threads)
        if self._keys:
            server.set_auth(self._keys.auth)
        server.set_session_pool(self._sessions)
        server.set_mount_points(self._mounts)
        server.connect("client-connected", self._on_connected)
        return server

    def stop(self) -> None:
        """Accept no more clients, and end every connection in its own thread.

        `client_filter` would close them from this thread. During a request, the library (1.22) then reads forever from
        a stream that no longer exists.
        """
        self._stopped.set()
        for source in (*self._watches, self._attached):
            GLib.source_remove(source)
        self._others.stop()
        self._clients.close()

    # --- clients ------------------------------------------------------------------------------------------------------

    def _on_connected(self, _server: object, client: GstRtspServer.RTSPClient) -> None:
        with suppress(OSError):  # it has already disconnected, or no descriptor is left: SETUP will be refused
            connection = RtspConnection(client, self._silent_s)
            connection.refusal = NO_CERTIFICATE if self._keys else ""
            self._clients.add(client, connection)
        client.connect("closed", self._on_closed)
        client.connect("new-session", self._on_session)
        for method in METHODS:
            client.connect(f"{method}-request", self._on_answered)
        client.connect("pre-describe-request", self._on_describe)
        client.connect("describe-request", self._on_described)
        client.connect("pre-announce-request", self._on_announce)
        client.connect("pre-setup-request", self._on_setup)
        client.connect("setup-request", self._on_set_up)
        client.connect("play-request", self._on_playing)
        client.connect("teardown-request", self._on_teardown)

    def _on_closed(self, client: GstRtspServer.RTSPClient) -> None:
        with self._changed:
            connection = self._clients.remove(client)
            if connection:
                self._left.add(connection.cameras)
        if self.loudspeaker:
            self.loudspeaker.on_closed(client)
        if connection and connection.refusal:
            address = connection.viewer.address
            self._report_refusal(f"refused an RTSP client at {address}: {connection.refusal}", address)

    def _on_refused(self, peer: tuple[str, int], why: str) -> None:
        """A client's certificate is not accepted: its connection ends."""
        with self._changed:
            for connection in self._clients.connections.values():
                if connection.peer == peer:
                    connection.refusal = why

    def _on_session(self, _client: object, session: GstRtspServer.RTSPSession) -> None:
        session.set_timeout(self._media.session_timeout_s)

    def _on_answered(self, client: GstRtspServer.RTSPClient, _context: object) -> None:
        connection = self._clients.of(client)
        if connection:
            if self._keys:
                connection.read_certificate(client)
            connection.note_request()
            if connection.refusal == NO_CERTIFICATE:
                connection.refusal = NO_PASSWORD

    def _on_describe(
        self, client: GstRtspServer.RTSPClient, context: GstRtspServer.RTSPContext
    ) -> GstRtsp.RTSPStatusCode:
        name, _, kind = path(context).partition("/")
        camera, connection = self._cameras.named.get(name) if kind in ("", FEEDBACK) else None, self._clients.of(client)
        if connection and self._keys:
            connection.read_certificate(client)
        withdrawn = self._keys.withdrawn(connection and connection.certificate) if self._keys else None
        if connection:
            connection.note_request()
            connection.refusal = withdrawn or ""
        if withdrawn:
            return FORBIDDEN
        if camera is None:
            return OK  # the library answers 404
        if has_query(context):
            self._redirect(client, context)
            return MOVED
        if connection:
            connection.opening = True
        is_held = self._cameras.hold(client, camera)
        if connection:
            connection.opening = False
        if not is_held:
            return UNAVAILABLE
        if connection:
            connection.described = camera.name
            if self._keys:  # until the library has accepted its password
                connection.refusal = WRONG_PASSWORD if has_password(context) else NO_PASSWORD
        describe_for(path(context))
        return OK

    def _redirect(self, client: GstRtspServer.RTSPClient, context: GstRtspServer.RTSPContext) -> None:
        """Answer with the correct URL: with a query the library would find the camera here, but not in PLAY."""
        uri = context.uri
        _, message = GstRtsp.rtsp_message_new_response(MOVED, GstRtsp.rtsp_status_as_text(MOVED), context.request)
        own = rtsp_url(replace(self._media, host=uri.host, port=uri.port), path(context))
        message.add_header(GstRtsp.RTSPHeaderField.LOCATION, own)
        message.add_header(GstRtsp.RTSPHeaderField.CONNECTION, "close")
        client.send_message(None, message)
        connection = self._clients.of(client)
        if connection:
            connection.close()  # the library would also answer, without a Location

    def _on_described(self, client: GstRtspServer.RTSPClient, _context: object) -> None:
        connection = self._clients.of(client)
        if connection:
            connection.refusal = ""
        self._cameras.release(client)

    def _on_announce(
        self, client: GstRtspServer.RTSPClient, context: GstRtspServer.RTSPContext
    ) -> GstRtsp.RTSPStatusCode:
        return self.loudspeaker.on_announce(client, context) if self.loudspeaker else NOT_FOUND

    def _on_setup(self, client: GstRtspServer.RTSPClient, context: GstRtspServer.RTSPContext) -> GstRtsp.RTSPStatusCode:
        own = self.loudspeaker if camera_name(context) == VOICE else None
        return (own or self.admission).on_setup(client, context)

    def _on_set_up(self, client: GstRtspServer.RTSPClient, context: GstRtspServer.RTSPContext) -> None:
        connection = self._clients.of(client)
        self._cameras.release(client)
        name = camera_name(context)
        if connection is None or name == VOICE:
            return
        connection.cameras[name] = context.trans
        if context.trans.get_transport().lower_transport & GstRtsp.RTSPLowerTrans.TCP:
            connection.carry_video(self._cameras.named[name].plan.settings.dscp)
            if name in connection.refused_udp:
                first, last = self._media.rtp_ports
                is_ipv4_at_ipv6 = "." in connection.viewer.address and ":" in ip_address_of(self._media.host)
                fault = "IPv6 only" if is_ipv4_at_ipv6 else "in use"
                self._on_report(name, f"over TCP, UDP ports {first}-{last} are {fault}")
        connection.refused_udp.discard(name)

    def _on_playing(self, client: GstRtspServer.RTSPClient, context: GstRtspServer.RTSPContext) -> None:
        name = camera_name(context)
        self._left.wake(name)
        # Players without feedback cannot request a key frame, and show nothing before they have seen a whole wave.
        pipeline, joins = self.pipelines.get(name), len(self._clients.watching(name)) > 1
        if joins and pipeline and not wants_feedback(path(context)):
            pipeline.is_joined = True

    def _on_teardown(self, client: GstRtspServer.RTSPClient, context: GstRtspServer.RTSPContext) -> None:
        connection = self._clients.of(client)
        if connection:
            holds = is_held(client, context.sessmedia)  # the session that ended may be another connection's
            with self._changed:
                if not holds:
                    connection.cameras.pop(camera_name(context), None)
                self._left.add((camera_name(context),))

    def copies(self) -> dict[str, int]:
        """By camera, the number of viewers outside the vehicle; cameras without any are omitted. From any thread."""
        return self._clients.copies()

    def give_control(self, drivers: Sequence[str], in_control: str) -> None:
        """See `VehicleSide.give_control`."""
        self.admission.give_control(drivers)
        if self.loudspeaker:
            self.loudspeaker.give_control(in_control)

    def read_sound(self) -> SoundReading:
        """What the elements of the sound say now. From any thread."""
        pipeline = self.pipelines.get(SOUND)
        return SoundReading(
            encoded=pipeline.counters() if pipeline else NOTHING_ENCODED,
            lost=self._lost.reasons().get(SOUND),
            copies=self.copies().get(SOUND, 0),
            refused=self.admission.refused().get(SOUND, {}),
        )

    def _watch_connections(self) -> None:
        """Close readers that lag, and connections without a complete request or with one that does not end."""
        with self._changed:
            connections = self._clients.current()
            interleaved = [connection for _, connection in connections if connection.interleaved]
            lags = {connection: self._clients.lag(connection, self.pipelines) for connection in interleaved}
            endless = {each for _, each in connections if each.unanswered_bytes() > MAX_REQUEST_BYTES}
        now = time.monotonic()
        self._left.look(now)
        self._others.look(now)
        for name, pipeline in tuple(self.pipelines.items()):
            viewers = [each for each in self._clients.watching(name) if over_uplink(each.viewer.address)]
            pipeline.requests.viewers = sum(not each.interleaved for each in viewers)
        if self._keys:
            drop_silent([connection for _, connection in connections], now)
        for client, connection in connections:
            if lags.get(connection, 0) > LAG_S:
                self._clients.disconnect(connection, f"it lags by more than {LAG_S:g} s")
            elif connection in endless:
                self._clients.disconnect(connection, f"it sends a request of more than {MAX_REQUEST_BYTES} bytes")
            elif now - connection.last_request > self._media.session_timeout_s and not client.session_filter(None):
                connection.close()

    def _watch_keys(self) -> None:
        """Load new key files, which may arrive one by one, and close connections of holders that may no longer watch.

        Apart from the other checks, so that no fault of theirs lets a revoked holder go on watching.
        """
        assert self._keys
        self._refresh_keys(self._keys)
        for _, connection in self._clients.current():
            # Before a first request it may be in the handshake, where no certificate has been verified.
            if not connection.unused_s(time.monotonic()) and (why := self._keys.withdrawn(connection.certificate)):
                connection.refusal = "" if connection.cameras else why  # `disconnect` reports a viewer
                self._clients.disconnect(connection, why)

    def _refresh_keys(self, viewers: ViewerCheck) -> None:
        try:
            viewers.refresh()
        except RunError as error:
            if self._keys_fault != str(error):
                self._on_report("keys", str(error))
            self._keys_fault = str(error)

    def _expire_sessions(self) -> None:
        """End sessions whose viewer no longer sends requests or RTCP.

        In a separate thread, since the end of the last session tears the pipeline down.
        """
        pool, given_back = self._sessions, time.monotonic()
        while not self._stopped.wait(SESSIONS_EVERY_S):
            if time.monotonic() - given_back > GIVE_BACK_S:
                give_back()
                given_back = time.monotonic()
            self._keep_paused_sessions()
            pool.cleanup()
            self._cameras.release_old()

    def _keep_paused_sessions(self) -> None:
        """Keep sessions from expiring on a camera that is paused, or whose source is being replaced.

        Nothing is sent then, and players such as ffmpeg send nothing in return. TCP detects viewers that have left.
        """
        with self._changed:
            watching = [(client, list(connection.cameras)) for client, connection in self._clients.current()]
        for client, cameras in watching:
            if cameras and all(map(self._is_silent, cameras)):
                for session in client.session_filter(None):
                    session.touch()

    def _is_silent(self, camera: str) -> bool:
        pipeline = self.pipelines.get(camera)
        return pipeline is not None and (pipeline.paused or bool(pipeline.source_fault))
