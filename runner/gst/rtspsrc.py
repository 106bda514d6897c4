"""Keeps rtspsrc, GStreamer's RTSP client, from races that hang or end the process (GStreamer 1.22)."""

from __future__ import annotations

import re
import threading
from collections.abc import Callable
from weakref import WeakMethod

from gi.repository import GObject, Gst

STREAM_ENDED = "the stream ended"
# The client closes in a thread of its own, which frees its streams: up to `tcp-timeout` later if the server does not
# answer. After this time it is stopped nevertheless, and uses what is being freed: an overloaded machine may need far
# longer to free it, and whoever waits no longer has abandoned it (`runner.gst.aside`).
TEARDOWN_S = 20.0
FAILING_S = 20.0  # likewise after an error, while it fails to open a stream
NO_PLACE = 453  # Not Enough Bandwidth (RFC 2326, section 11.3.7)
BYE = "on-bye-ssrc"  # signals of an RTP session (RFC 3550, section 6.6)
SILENT = ("on-bye-timeout", "on-timeout")


def is_rtsp_client(element: Gst.Element) -> bool:
    return bool(GObject.signal_lookup("select-stream", element))


def status_of(error: Gst.Message) -> int | None:
    """The status of the answer by which an RTSP client's request has failed; None: it failed in another way.

    The client states it only in what it says for developers: "Error (453): Not Enough Bandwidth" (1.22 to 1.28).
    """
    found = re.search(r"Error \((\d{3})\):", error.parse_error()[1] or "") if is_rtsp_client(error.src) else None
    return int(found[1]) if found else None


def limit_teardown(pipeline: Gst.Bin) -> None:
    """Make RTSP clients in a pipeline close before they are stopped, for TEARDOWN_S at most."""
    for client in filter(is_rtsp_client, pipeline.children):
        client.set_property("teardown-timeout", round(TEARDOWN_S * Gst.SECOND))


class Opening:
    """Whether an RTSP client is failing to open its stream: it reports an error, then frees what it has set up.

    Both show in its messages, which must be handled in its thread.
    """

    def __init__(self) -> None:
        self._ended, self._is_failing = threading.Event(), False
        self._ended.set()

    def follow(self, bus: Gst.Bus) -> None:
        """Handle the messages of a bus."""
        bus.enable_sync_message_emission()
        for kind in ("progress", "error"):
            bus.connect(f"sync-message::{kind}", lambda _bus, message: self.handle(message))

    def handle(self, message: Gst.Message) -> None:
        if message.type == Gst.MessageType.ERROR:
            self._is_failing = not self._ended.is_set()
        elif message.type == Gst.MessageType.PROGRESS:
            kind, code, _text = message.parse_progress()
            if code == "open":
                is_opening = kind in (Gst.ProgressType.START, Gst.ProgressType.CONTINUE)
                (self._ended.clear if is_opening else self._ended.set)()

    def wait(self) -> None:
        """To be called before it is stopped: wait until it has failed, for FAILING_S at most."""
        if self._is_failing:
            self._ended.wait(FAILING_S)


def handle_stream_end(client: Gst.Element, on_gone: Callable[[Gst.Element, bool], None]) -> None:
    """Replace the handlers by which an RTSP client ends a stream.

    They end its elements, in a thread in which one of them streams. If the connection fails at the same time, another
    thread ends the same elements, and both wait for each other.

    on_gone  method of the owner, which it does not keep alive; called in a streaming thread with the client, and
             whether the source of the stream has ended it (BYE) or is only silent
    """
    client.connect("pad-added", _on_stream, WeakMethod(on_gone))


def _on_stream(client: Gst.Element, pad: Gst.Pad, on_gone: WeakMethod[Callable[[Gst.Element, bool], None]]) -> None:
    numbers = re.match(r"recv_rtp_src_(\d+)_(\d+)_", pad.get_name())
    if not numbers:  # a stream without RTP
        return
    session = client.get_by_name("manager").emit("get-internal-session", int(numbers[1]))
    for name in (BYE, *SILENT):
        _disconnect_second(session, name)
        session.connect(name, _on_source_gone, on_gone, client, int(numbers[2]), name == BYE)


def _on_source_gone(
    _session: GObject.Object,
    source: GObject.Object,
    on_gone: WeakMethod[Callable[[Gst.Element, bool], None]],
    client: Gst.Element,
    ssrc: int,
    is_bye: bool,
) -> None:
    method = on_gone()
    if method and source.props.ssrc == ssrc:  # not the receiver's own, nor one of retransmitted packets
        method(client, is_bye)


def _disconnect_second(session: GObject.Object, signal: str) -> None:
    """Disconnect the second handler of a signal of an RTP session, which is the client's; the first is rtpsession's."""
    kind = GObject.signal_lookup(signal, session)
    own = _handler(session, kind, GObject.SignalMatchType.ID)
    GObject.signal_handler_block(session, own)
    if other := _handler(session, kind, GObject.SignalMatchType.ID | GObject.SignalMatchType.UNBLOCKED):
        GObject.signal_handler_disconnect(session, other)
    GObject.signal_handler_unblock(session, own)


def _handler(session: GObject.Object, kind: int, match: GObject.SignalMatchType) -> int:
    return int(GObject.signal_handler_find(session, match, kind, 0, None, None, None))
