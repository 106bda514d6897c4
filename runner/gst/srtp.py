"""Master keys of SRTP (RFC 3711) from the system's generator.

GStreamer draws them from GLib's generator, which is predictable: the server's digest nonces come from it, too.
"""

from __future__ import annotations

from secrets import token_bytes

from gi.repository import Gst

MASTER_BYTES = 30  # AES-128 key and salt (RFC 3711, section 8.2)
ALGORITHMS = ", ".join(
    f"{kind}-cipher=(string)aes-128-icm, {kind}-auth=(string)hmac-sha1-80" for kind in ("srtp", "srtcp")
)


def set_master_key(encoder: Gst.Element) -> None:
    """Give an srtpenc a new key, before it starts."""
    encoder.set_property("random-key", False)
    encoder.set_property("key", Gst.Buffer.new_wrapped(token_bytes(MASTER_BYTES)))


def provide_rtcp_key(client: Gst.Element) -> None:
    """Make an rtspsrc encrypt what it sends, RTCP, by keys from here."""
    client.connect("request-rtcp-key", _rtcp_key)


def _rtcp_key(_client: Gst.Element, _stream: int) -> Gst.Caps:
    key = token_bytes(MASTER_BYTES).hex()
    return Gst.Caps.from_string(f"application/x-srtcp, srtp-key=(buffer){key}, {ALGORITHMS}")
