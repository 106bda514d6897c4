"""Sessions of the RTSP server's clients: what each has set up, and how it ends."""

from __future__ import annotations

import secrets

from gi.repository import Gst, GstRtspServer


def set_up(client: GstRtspServer.RTSPClient) -> list[tuple[GstRtspServer.RTSPSession, GstRtspServer.RTSPSessionMedia]]:
    """What a connection has set up, with the session of each."""
    return [(session, media) for session in client.session_filter(None) for media in session.filter(None)]


def is_held(client: GstRtspServer.RTSPClient, ended: GstRtspServer.RTSPSessionMedia) -> bool:
    """Whether a connection has set up the same camera as what has just ended, in a session of its own."""
    return any(media is not ended and media.get_media() is ended.get_media() for _, media in set_up(client))


def transports(media: GstRtspServer.RTSPSessionMedia) -> list[GstRtspServer.RTSPStreamTransport]:
    each = (media.get_transport(number) for number in range(media.get_media().n_streams()))
    return [transport for transport in each if transport is not None]


def end(session: GstRtspServer.RTSPSession, media: GstRtspServer.RTSPSessionMedia) -> None:
    """End what a session has set up, as TEARDOWN does."""
    media.set_state(Gst.State.NULL)
    session.release_media(media)


class SessionPool(GstRtspServer.RTSPSessionPool):  # type: ignore[misc]  # PyGObject has no types
    """Sessions with identifiers from the system's generator.

    Whoever knows an identifier can end or pause that session, from any connection. The library's identifiers come from
    GLib's generator, of which the digest nonces reveal the state.
    """

    def do_create_session_id(self) -> str:
        return secrets.token_hex(16)


def on_session_removed(_pool: object, session: GstRtspServer.RTSPSession) -> None:
    """A session ends its media only in its finalizer, and the library (1.22) leaks one when it refuses a SETUP."""
    for media in session.filter(None):
        end(session, media)
