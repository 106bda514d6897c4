"""Master keys of SRTP (RFC 3711) from the system's generator, and how RTSP carries them (see `runner.gst.mikey`).

GStreamer draws them from GLib's generator, which is predictable: the server's digest nonces come from it, too.
"""

from __future__ import annotations

import re
from secrets import token_bytes

from gi.repository import Gst, GstRtsp, GstSdp

MASTER_BYTES = 30  # AES-128 key and salt (RFC 3711, section 8.2)
ALGORITHMS = ", ".join(
    f"{kind}-cipher=(string)aes-128-icm, {kind}-auth=(string)hmac-sha1-80" for kind in ("srtp", "srtcp")
)
# Where RTSP and its descriptions have them (RFC 4567, section 3).
KEY_HEADER, KEY_DATA = GstRtsp.RTSPHeaderField.KEYMGMT, re.compile(r'(?<=data=")[^"]*')
KEY_ATTRIBUTE = "key-mgmt"


def set_master_key(encoder: Gst.Element) -> None:
    """Give an srtpenc a new key, before it starts."""
    encoder.set_property("random-key", False)
    encoder.set_property("key", Gst.Buffer.new_wrapped(token_bytes(MASTER_BYTES)))


def provide_rtcp_key(client: Gst.Element) -> None:
    """Make an rtspsrc encrypt what it sends, RTCP, by keys from here, and send them so that every server reads them."""
    client.connect("request-rtcp-key", _rtcp_key)
    client.connect("before-send", _on_send)


def _rtcp_key(_client: Gst.Element, _stream: int) -> Gst.Caps:
    key = token_bytes(MASTER_BYTES).hex()
    return Gst.Caps.from_string(f"application/x-srtcp, srtp-key=(buffer){key}, {ALGORITHMS}")


def _on_send(_client: Gst.Element, request: GstRtsp.RTSPMessage) -> bool:
    """Whether to send a request: always."""
    join_keys(request)
    return True


def join_keys(request: GstRtsp.RTSPMessage) -> None:
    """Write the keys of a request, if it has any, so that every server reads them."""
    from runner.gst.mikey import in_one_piece

    found, keys = request.get_header(KEY_HEADER, 0)
    if found == GstRtsp.RTSPResult.OK and (joined := KEY_DATA.sub(lambda data: in_one_piece(data[0]), keys)) != keys:
        request.remove_header(KEY_HEADER, -1)
        request.add_header(KEY_HEADER, joined)


def write_keys(media: GstSdp.SDPMedia) -> None:
    """Write the keys of a description so that every client reads them."""
    from runner.gst.mikey import in_one_piece

    for number in range(media.attributes_len()):
        attribute = media.get_attribute(number)
        if attribute.key == KEY_ATTRIBUTE:
            kind, _, message = attribute.value.partition(" ")
            if (joined := in_one_piece(message)) != message:
                media.remove_attribute(number)
                media.add_attribute(KEY_ATTRIBUTE, f"{kind} {joined}")
            return
