"""The RTSP server's TCP connections: measures how far a reader lags, and closes one from any thread."""

from __future__ import annotations

import os
import select
import socket
import struct
import time
from collections import deque
from contextlib import suppress
from fcntl import ioctl

from gi.repository import Gio, GstRtspServer

from runner.gst.viewers import StreamViewer

USER_TIMEOUT_MS = 2000  # the kernel closes a connection whose data stays unacknowledged for this long (RFC 5482)
KEEPALIVE_S, KEEPALIVES = 2, 3  # a peer that answers none of this many probes, this far apart, is gone
_SIOCOUTQ = 0x5411  # unacknowledged bytes (linux/sockios.h)
_BYTES_ACKED, _BYTES_RECEIVED, _MIN_RTT = 120, 128, 148  # offsets in struct tcp_info (linux/tcp.h)
BUFFER_S = 0.35  # of video in the send buffer, in addition to the round-trip time
LEAST_BUFFER_BYTES = 16_384


class RtspConnection:
    """One client of the RTSP server, seen through its TCP connection.

    silent_s     how long the peer may be silent before the kernel probes it; None: it does not. The way of this
                 connection may be cut while the video comes by another one, whose session ends when RTCP is missing

    viewer       its address and its operator
    cameras      those it watches, with the library's transport once it is set up
    opening      whether it waits for the camera of its DESCRIBE to open
    described    camera of its last DESCRIBE: the library keeps it open for the client
    interleaved  whether this connection also carries video
    refused_udp  cameras that its client has tried in vain to set up over UDP
    last_request monotonic time of its last complete request, s; before the first, of its start; see `note_request`
    peer         its IP address and port
    closed       whether it was told to close
    refusal      reason for refusing it, as far as known; "" if it may
    certificate  of its peer, from its first request on, over TLS
    """

    def __init__(self, client: GstRtspServer.RTSPClient, silent_s: int | None) -> None:
        connection = client.get_connection()
        # Our own descriptor: the library closes its own from another thread, and the number is then reused.
        self._socket = socket.socket(fileno=os.dup(connection.get_write_socket().get_fd()))
        if silent_s is not None:
            self._probe_after(silent_s)
        self.peer = self._socket.getpeername()[:2]
        self.refusal, self.closed = "", False
        self.certificate: Gio.TlsCertificate | None = None
        self.viewer = StreamViewer(connection.get_ip(), since=time.monotonic())
        self.cameras: dict[str, GstRtspServer.RTSPStreamTransport | None] = {}
        self.described = ""
        self.refused_udp: set[str] = set()
        self.opening = self.interleaved = False
        self.last_request = self._began = self._writable = time.monotonic()
        self._buffer = self._received = 0
        self._written: deque[tuple[float, int]] = deque()  # when, total bytes written by then

    def __str__(self) -> str:
        return str(self.viewer)

    def _probe_after(self, silent_s: int) -> None:
        for option, value in (("KEEPIDLE", silent_s), ("KEEPINTVL", KEEPALIVE_S), ("KEEPCNT", KEEPALIVES)):
            self._socket.setsockopt(socket.IPPROTO_TCP, getattr(socket, f"TCP_{option}"), value)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)

    def unused_s(self, now: float) -> float:
        """How long it has waited for a first request, s; 0 afterwards. Over TLS it may be in the handshake."""
        return now - self.viewer.since if self.last_request == self._began else 0.0

    def read_certificate(self, client: GstRtspServer.RTSPClient) -> None:
        """To be called over TLS, in its thread: this thread frees the library's connection without a lock."""
        if self.certificate is None and (connection := client.get_connection()):
            self.certificate = connection.get_tls().get_peer_certificate()

    def note_request(self) -> None:
        """A request is complete. From its thread."""
        self.last_request, self._received = time.monotonic(), self._bytes_received()

    def unanswered_bytes(self) -> int:
        """Bytes received since the last complete request: of the next one, and RTCP of interleaved video."""
        return self._bytes_received() - self._received

    def _bytes_received(self) -> int:
        (received,) = struct.unpack_from("Q", self._tcp_info(), _BYTES_RECEIVED)
        return int(received)

    def _tcp_info(self) -> bytes:
        return self._socket.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, 256)

    def identify(self, operator: str | None) -> None:
        self.viewer = self.viewer._replace(operator=operator or "")

    def carry_video(self, dscp: int) -> None:
        """Prepare for interleaved video: the kernel closes the connection when data is no longer acknowledged.

        dscp  DiffServ code point of its packets; -1 leaves it to the system
        """
        self.interleaved, self._writable = True, time.monotonic()
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, USER_TIMEOUT_MS)
        if dscp < 0:
            return
        if self._socket.family == socket.AF_INET6:
            self._socket.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_TCLASS, dscp << 2)
        self._socket.setsockopt(socket.IPPROTO_IP, socket.IP_TOS, dscp << 2)  # of IPv4 over an IPv6 socket, too

    def lag(self, kbps: int, shared: bool) -> float:
        """Age of the oldest byte that the peer has not acknowledged, s; to be called a few times a second.

        kbps    of its video, which sizes the send buffer: by default, the kernel buffers up to 4 MB
        shared  whether others watch the same camera. Then the video continues while the send buffer is full, and data
                queued in front of it is not visible here: the time since it last had room counts as well. A single
                reader exerts back-pressure on the encoder, and its data is no older than the buffer.
        """
        now = time.monotonic()
        info = self._tcp_info()
        (acked,), (rtt_us,) = struct.unpack_from("Q", info, _BYTES_ACKED), struct.unpack_from("I", info, _MIN_RTT)
        self._resize_buffer(round(kbps * 125 * (BUFFER_S + rtt_us / 1e6)))
        (waiting,) = struct.unpack("i", ioctl(self._socket, _SIOCOUTQ, bytes(4)))
        self._written.append((now, acked + waiting))
        while self._written and self._written[0][1] <= acked:
            self._written.popleft()
        if not shared or self._has_room():
            self._writable = now
        return now - min(self._writable, self._written[0][0] if self._written else now)

    def _resize_buffer(self, size: int) -> None:
        size = max(size, LEAST_BUFFER_BYTES)
        if abs(size - self._buffer) > self._buffer / 10:
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, size // 2)  # the kernel doubles it
            self._buffer = size

    def _has_room(self) -> bool:
        room = select.poll()
        room.register(self._socket, select.POLLOUT)
        return bool(room.poll(0))

    def close(self) -> None:
        """Shut the connection down; the server notices in its own thread."""
        self.closed = True
        with suppress(OSError):  # it may have ended already
            self._socket.shutdown(socket.SHUT_RDWR)

    def release(self) -> None:
        """Close our descriptor, once the server has closed the connection."""
        self._socket.close()
