"""How an IP camera is asked for its video: which medium, how long for an answer, and with how many logins."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

from gi.repository import GLib, Gst, GstRtsp, GstSdp

from runner.core.model import Source
from runner.graph import Plan
from runner.gst.caps import structure
from runner.gst.rtspsrc import is_rtsp_client

OPENING = frozenset({"OPTIONS", "DESCRIBE", "SETUP", "PLAY"})
SENDS = 2  # of one request: without a login, and with it. The client itself (1.22) would try a wrong password 8 times
MARGIN_S = 5.0  # by which the client may notice late that no answer came


def follow_cameras(pipeline: Gst.Bin, plan: Plan, on_stream: Callable[[], None] = lambda: None) -> list[CameraClient]:
    """Follow the RTSP clients of a newly built source; `on_stream` is called when one has streamed."""
    elements = (pipeline.get_by_name(element.name) for element in plan.source)
    source, passes = plan.camera.source, plan.camera.graph.passes
    return [CameraClient(each, source, on_stream, passes) for each in elements if each and is_rtsp_client(each)]


class CameraClient:
    """Follows an RTSP client of a source, from its construction until it has streamed.

    Only one video medium is set up. Until its first packet, each answer may take `first_reply_s`: cameras that are
    started on demand need 5 to 30 s. Then the limit of the source's file is in force.

    passes      the format that the video must have, which is passed on; None: any

    has_failed  whether it has given up

    The client keeps this alive, not the other way round: its handlers would otherwise keep both for ever.
    """

    def __init__(
        self, client: Gst.Element, source: Source, on_stream: Callable[[], None], passes: str | None = None
    ) -> None:
        self._on_first, self._medium, self._passes = on_stream, source.medium, passes
        self._usual_us = int(client.get_property("tcp-timeout"))
        self._reply_s = max(source.first_reply_s, self._usual_us / 1e6)
        self._chosen: int | None = None  # index in the description
        self._last: tuple[str, ...] = ()  # the last request, also once PLAYING is requested while it is unanswered
        self._sends = 0  # of it
        self._asked: tuple[str, float] | None = None  # request without an answer, and when it was sent
        self._heard = time.monotonic()  # when it last sent or received anything
        self._is_opening, self._has_streamed, self.has_failed = True, False, False
        client.connect("on-sdp", self._on_sdp)
        client.connect("select-stream", self._on_select)
        client.connect("before-send", self._on_send)
        client.connect("pad-added", self._on_stream)

    @property
    def is_opening(self) -> bool:
        """Whether the camera has not answered PLAY yet, and its answers are not overdue."""
        return self._is_opening and time.monotonic() - self._heard < self._reply_s + MARGIN_S

    @property
    def asked(self) -> tuple[str, float] | None:
        """The request that the camera has not answered yet, and when it was sent (time.monotonic)."""
        return self._asked if self.is_opening else None

    def follow(self, message: Gst.Message) -> None:
        """Handle a message of the client, in its thread."""
        if message.type != Gst.MessageType.PROGRESS:
            return
        kind, code, _text = message.parse_progress()
        self._heard = time.monotonic()
        if kind == Gst.ProgressType.START:
            self._is_opening = True
        elif kind != Gst.ProgressType.CONTINUE:
            self._asked = None
            self.has_failed = kind == Gst.ProgressType.ERROR
            self._is_opening = code == "open" and not self.has_failed

    # --- called by the client, in its threads -------------------------------------------------------------------------

    def _on_stream(self, client: Gst.Element, _pad: Gst.Pad) -> None:
        """The first packet has arrived."""
        self._has_streamed, self._asked, self._is_opening = True, None, False
        client.set_property("tcp-timeout", self._usual_us)
        self._on_first()

    def _on_sdp(self, client: Gst.Element, sdp: GstSdp.SDPMessage) -> None:
        kinds = [sdp.get_media(number).get_media() for number in range(sdp.medias_len())]
        video = [number for number, kind in enumerate(kinds) if kind == "video"]
        self._chosen = video[self._medium] if self._medium < len(video) else None
        if self._chosen is None:
            self._fail(client, _why_none(kinds, len(video), self._medium))
        elif self._passes and (other := _other_format(sdp.get_media(self._chosen), self._passes)):
            self._chosen = None
            self._fail(client, other)

    @staticmethod
    def _fail(client: Gst.Element, why: str) -> None:
        client.post_message(Gst.Message.new_error(client, GLib.Error(why), ""))

    def _on_select(self, _client: Gst.Element, number: int, _caps: Gst.Caps) -> bool:
        return number == self._chosen

    def _on_send(self, client: Gst.Element, request: GstRtsp.RTSPMessage) -> bool:
        """Whether to send a request: the same one not a third time, since the second has the login."""
        _, method, uri, _ = request.parse_request()
        name = GstRtsp.rtsp_method_as_text(method)
        this = (name, uri, request.get_header(GstRtsp.RTSPHeaderField.TRANSPORT, 0)[1] or "")
        self._sends = self._sends + 1 if this == self._last else 1
        self._last = this
        if name not in OPENING or (self._has_streamed and name == "OPTIONS"):  # to keep the session alive
            return True
        if self._sends > SENDS:
            return False  # the client then reports the last answer
        self._heard = time.monotonic()
        if not self._has_streamed:
            client.set_property("tcp-timeout", round(self._reply_s * 1e6))  # not before: connecting has the usual limit
            self._asked = (name, self._heard)
        return True


def _other_format(medium: GstSdp.SDPMedia, wanted: str) -> str | None:
    """What a medium is, if it has another format than the one that is passed on; None if it has that."""
    caps = medium.get_caps_from_media(int(medium.get_format(0)))
    found = (structure(caps).get_string("encoding-name") if caps else None) or "an unnamed format"
    if found.lower() == wanted:
        return None
    return f"the camera sends {found}, and the graph passes on {wanted.upper()}: set the camera to that, or decode it"


def _why_none(kinds: Sequence[str], video: int, medium: int) -> str:
    """Why a description with these media, so many of them video, does not have the wanted one."""
    if not video:
        return f"the camera offers no video, only {', '.join(kinds) or 'an empty description'}"
    return f"source.medium is {medium}, but the camera offers {video} video media, counted from 0"
