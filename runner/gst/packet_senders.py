"""From which address a UDP packet came, as a udpsrc states it.

It goes no further: an RTP session takes a second address of one stream for another sender, and drops its packets.
"""

from __future__ import annotations

import ctypes
from collections.abc import Mapping
from ctypes import c_size_t, c_void_p
from ipaddress import ip_address
from typing import Any

from runner.gst.probes import PassingBuffer

_ADDRESS = 16  # offset of the GSocketAddress in a GstNetAddressMeta, behind a GstMeta (gst/net/gstnetaddressmeta.h)
MAX_SENDERS = 64  # that are remembered


def _function(library: str, name: str, result: Any, *arguments: Any) -> Any:
    function = getattr(ctypes.CDLL(library), name)
    function.restype, function.argtypes = result, arguments
    return function


_kind = _function("libgstnet-1.0.so.0", "gst_net_address_meta_api_get_type", c_size_t)
_get_meta = _function("libgstreamer-1.0.so.0", "gst_buffer_get_meta", c_void_p, c_void_p, c_size_t)
_remove_meta = _function("libgstreamer-1.0.so.0", "gst_buffer_remove_meta", ctypes.c_int, c_void_p, c_void_p)
_inet_address = _function("libgio-2.0.so.0", "g_inet_socket_address_get_address", c_void_p, c_void_p)
_text = _function("libgio-2.0.so.0", "g_inet_address_to_string", c_void_p, c_void_p)
_ref = _function("libgobject-2.0.so.0", "g_object_ref", c_void_p, c_void_p)
_unref = _function("libgobject-2.0.so.0", "g_object_unref", None, c_void_p)
_free = _function("libglib-2.0.so.0", "g_free", None, c_void_p)


class PacketSenders:
    """The names of senders by their addresses.

    GLib gives packets from one address the same object: text is made of it once. From one thread, but for `names`.
    """

    def __init__(self) -> None:
        self._net = _kind()
        self._names: Mapping[str, str] = {}
        self._known: dict[int, str | None] = {}  # by the address of the object, which is kept alive
        self._read: Mapping[str, str] = self._names

    def name(self, names: Mapping[str, str]) -> None:
        """Set the names by IP address. From any thread."""
        self._names = {str(ip_address(host)): name for host, name in names.items()}

    def take(self, buffer: PassingBuffer) -> str | None:
        """Take the sender from a packet; None: it has none, or no name."""
        meta = _get_meta(buffer.address, self._net)
        if not meta:
            return None
        address: int = c_void_p.from_address(meta + _ADDRESS).value or 0
        if self._read is not self._names or len(self._known) > MAX_SENDERS:
            self.forget()
        if address not in self._known:
            self._known[_ref(address)] = self._read.get(_ip_address(address))
        name = self._known[address]
        _remove_meta(buffer.address, meta)
        return name

    def forget(self) -> None:
        self._read = self._names
        for address in self._known:
            _unref(address)
        self._known.clear()

    def __del__(self) -> None:
        self.forget()


def _ip_address(socket_address: int) -> str:
    """Text of a GInetSocketAddress; that of IPv4 in IPv6 is IPv4."""
    text = _text(_inet_address(socket_address))
    try:
        found = ip_address(ctypes.string_at(text).decode())
        return str(getattr(found, "ipv4_mapped", None) or found)
    finally:
        _free(text)
