"""Admits viewers to the cameras of the RTSP server, or refuses them, when they set a stream up."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from gi.repository import GstRtsp, GstRtspServer

from runner.core.roles import Role
from runner.gst.clients import Clients
from runner.gst.connections import RtspConnection
from runner.gst.opening import ServedCameras
from runner.gst.rtsp_requests import user_agent, wants_udp
from runner.gst.sessions import end, set_up, transports
from runner.gst.viewers import (
    RefusedViewers,
    StreamViewer,
    admit,
    limit_words,
    operator_of,
    over_uplink,
    too_many,
)
from runner.settings import Media

if TYPE_CHECKING:
    from runner.gst.secure import ViewerCheck

OK, FORBIDDEN, REFUSED, UNAVAILABLE, NOT_NOW = (
    GstRtsp.RTSPStatusCode.OK,
    GstRtsp.RTSPStatusCode.FORBIDDEN,
    GstRtsp.RTSPStatusCode.NOT_ENOUGH_BANDWIDTH,
    GstRtsp.RTSPStatusCode.SERVICE_UNAVAILABLE,
    GstRtsp.RTSPStatusCode.METHOD_NOT_VALID_IN_THIS_STATE,
)
ONE_MORE = "it was admitted until control was handed over"


class Admission:
    """Decides in the thread of each client.

    keys       None: anyone may watch
    media      states who may have a copy over the uplink
    on_report  called with a camera and who is refused it, and why

    `drivers` are those that are always admitted: see `runner.gst.viewers`.
    """

    def __init__(
        self,
        cameras: ServedCameras,
        clients: Clients,
        keys: ViewerCheck | None,
        media: Media,
        on_report: Callable[[str, str], None],
    ) -> None:
        self._cameras, self._clients, self._keys = cameras, clients, keys
        self._media, self._changed, self._on_report = media, clients.changed, on_report
        self._refused = RefusedViewers()
        self.drivers: tuple[str, ...] = ()

    def give_control(self, drivers: Sequence[str]) -> None:
        """Admit others from now on, and disconnect those that were admitted as a second one. From any thread."""
        limit = self._media.max_viewers
        with self._changed:
            self.drivers = tuple(drivers)
            watching = {name: self._clients.watching(name) for name in self._cameras.named}
        surplus = set[RtspConnection]()
        for connections in watching.values():
            leaving = too_many([c.viewer for c in connections], limit, self.drivers)
            surplus |= {connection for connection in connections if connection.viewer in leaving}
        for connection in surplus:
            self._clients.disconnect(connection, f"{ONE_MORE}: media.max_viewers={limit}")

    def on_setup(self, client: GstRtspServer.RTSPClient, context: GstRtspServer.RTSPContext) -> GstRtsp.RTSPStatusCode:
        """Admit a viewer, or refuse it for its keys, or because its copy of the stream would overload the uplink."""
        camera, connection = self._cameras.of(context.media), self._clients.of(client)
        if self._keys and connection:
            connection.read_certificate(client)
            if refusal := self._keys.refusal(connection.certificate, context.token):
                connection.refusal = refusal
                return FORBIDDEN
        if not _end_other(client, context):
            return NOT_NOW
        # The library ends a media whose UDP it refuses, but its client then asks for TCP.
        if camera and camera.is_open and wants_udp(context):
            self._cameras.keep(client, context.media)
        with self._changed:
            new_viewer = self._clients.of(client)
            if camera is None or new_viewer is None or not camera.is_open:
                return UNAVAILABLE
            operator = self._keys.viewer(new_viewer.certificate) if self._keys else operator_of(user_agent(context))
            new_viewer.identify(operator)
            current = self._clients.watching(camera.name)
            viewers = [c.viewer for c in current]
            is_admitted = new_viewer in current
            leaving = [] if is_admitted else self._admit(camera.name, viewers, new_viewer.viewer)
            if leaving is None:
                return REFUSED
            new_viewer.cameras.setdefault(camera.name, None)
            if wants_udp(context):
                new_viewer.refused_udp.add(camera.name)  # until it is set up
        for connection in current:
            if connection.viewer in leaving:
                why = f"operator {operator}, who has or is offered control, watches from {new_viewer.viewer.address}"
                self._clients.disconnect(connection, why)
        return OK

    def _admit(
        self, camera: str, viewers: Sequence[StreamViewer], new_viewer: StreamViewer
    ) -> Sequence[StreamViewer] | None:
        """As `admit`; a refusal is reported once."""
        limit, leaving = self._media.max_viewers, None
        if self._must_not_load(new_viewer):
            why = "a watcher gets no copy over the uplink: media.watcher_copies"
        else:
            leaving = admit(viewers, new_viewer, limit, self.drivers)
            why = limit_words(limit, viewers)
        if leaving is not None:
            self._refused.remove(camera, new_viewer)
        elif self._refused.add(camera, new_viewer, why, time.monotonic()):
            self._on_report(camera, f"refused the viewer at {new_viewer}: {why}")
        return leaving

    def _must_not_load(self, viewer: StreamViewer) -> bool:
        """Whether a viewer is one that may only watch, and would load the uplink."""
        is_watcher = self._keys is not None and self._keys.role(viewer.operator) == Role.WATCHER
        return is_watcher and not self._media.watcher_copies and over_uplink(viewer.address)

    def refused(self) -> dict[str, dict[str, str]]:
        """By camera and operator, why this one is refused it. From any thread."""
        with self._changed:
            return self._refused.stated(time.monotonic())


def _end_other(client: GstRtspServer.RTSPClient, context: GstRtspServer.RTSPContext) -> bool:
    """End what a connection has set up of the requested camera elsewhere; False if it is being sent a copy.

    Elsewhere is in another session, or in the same one by the camera's other path.

    The library would not end that copy: it would go on after the viewer has left, and nobody would count it. A camera
    that is not being sent may be set up again: ffmpeg does so in a new session when it pauses UDP to try TCP.
    """
    held = [(session, media) for session, media in set_up(client) if media.get_media() is context.media]
    own = context.session and context.session.get_media(context.uri.abspath)[0]
    sent = context.stream.transport_filter(None)
    if any(transport in sent for _, media in held for transport in transports(media)):
        return False
    for session, media in held:
        if session is not context.session or media is not own:
            end(session, media)
    return True
