"""What a request to the RTSP server says; a client may send anything."""

from __future__ import annotations

from gi.repository import GstRtsp, GstRtspServer


def camera_name(context: GstRtspServer.RTSPContext) -> str:
    """First component of the path of a request's URL: the camera, if valid; `FEEDBACK` and a stream may follow it."""
    return path(context).partition("/")[0]


def path(context: GstRtspServer.RTSPContext) -> str:
    """The path of a request's URL without leading and trailing slashes; "" if path or host is not text."""
    try:
        return str(context.uri.abspath).strip("/") if isinstance(context.uri.host, str) else ""
    except UnicodeDecodeError:
        return ""


def has_query(context: GstRtspServer.RTSPContext) -> bool:
    try:
        return context.uri.query is not None
    except UnicodeDecodeError:
        return True


def has_password(context: GstRtspServer.RTSPContext) -> bool:
    """Whether a request gives a password, right or wrong."""
    try:
        return bool(context.request.get_header(GstRtsp.RTSPHeaderField.AUTHORIZATION, 0)[0] == GstRtsp.RTSPResult.OK)
    except UnicodeDecodeError:
        return True


def wants_udp(context: GstRtspServer.RTSPContext) -> bool:
    """Whether a SETUP requests packets over UDP, to this client alone."""
    try:
        wanted = context.request.get_header(GstRtsp.RTSPHeaderField.TRANSPORT, 0)[1] or ""
    except UnicodeDecodeError:
        return False
    return "client_port" in wanted


def user_agent(context: GstRtspServer.RTSPContext) -> str | None:
    try:
        agent: str | None = context.request.get_header(GstRtsp.RTSPHeaderField.USER_AGENT, 0)[1]
    except UnicodeDecodeError:
        return None
    return agent
