"""The TCP connections of the RTSP server: how far a reader lags, and how one is closed from any thread."""

from __future__ import annotations

import os
import select
import socket
import struct
import time
from collections import deque
from contextlib import suppress
from fcntl import ioctl

from gi.repository import GstRtspServer

from runner.gst.viewers import StreamViewer, operator_of

USER_TIMEOUT_MS = 2000  # the kernel closes a connection whose data is not taken for so long (RFC 5482)
KEEPALIVE_S, KEEPALIVES = 2, 3  # a machine that answers none of so many, so far apart, has gone
_SIOCOUTQ = 0x5411  # bytes that are not acknowledged yet (linux/sockios.h)
_BYTES_ACKED, _MIN_RTT = 120, 148  # offsets in struct tcp_info (linux/tcp.h)
BUFFER_S = 0.35  # of video in the send buffer, beyond what the way takes
LEAST_BUFFER_BYTES = 16_384


class RtspConnection:
    """One client of the RTSP server, as its TCP connection shows it.

    silent_s     how long the other machine may be silent before the kernel asks whether it is still there

    viewer       where it comes from and for whom
    cameras      what it watches, with the library's transport once there is one
    interleaved  whether video runs through this connection, too
    last_request monotonic time of its last complete request, s
    """

    def __init__(self, client: GstRtspServer.RTSPClient, silent_s: int) -> None:
        connection = client.get_connection()
        # A descriptor of our own: the library closes its one from another thread, and the next file gets its number.
        self._socket = socket.socket(fileno=os.dup(connection.get_write_socket().get_fd()))
        for option, value in (("KEEPIDLE", silent_s), ("KEEPINTVL", KEEPALIVE_S), ("KEEPCNT", KEEPALIVES)):
            self._socket.setsockopt(socket.IPPROTO_TCP, getattr(socket, f"TCP_{option}"), value)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        self.viewer = StreamViewer(connection.get_ip(), since=time.monotonic())
        self.cameras: dict[str, GstRtspServer.RTSPStreamTransport | None] = {}
        self.interleaved = False
        self.last_request = self._writable = time.monotonic()
        self._buffer = 0
        self._written: deque[tuple[float, int]] = deque()  # when, bytes ever written by then

    def __str__(self) -> str:
        return f"{self.viewer.address} ({self.viewer.operator})" if self.viewer.operator else self.viewer.address

    def identify(self, agent: str | None) -> None:
        self.viewer = self.viewer._replace(operator=operator_of(agent))

    def carry_video(self) -> None:
        """Video will run through this connection: the kernel closes it when nothing is taken any more."""
        self.interleaved = True
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, USER_TIMEOUT_MS)

    def lag(self, kbps: int, shared: bool) -> float:
        """Age of the oldest byte that the other side has not acknowledged, s; to be called a few times a second.

        kbps    of its video, by which the send buffer is bounded: of its own, the kernel keeps up to 4 MB
        shared  whether others watch the same. Then the video goes on while the send buffer is full, and what waits in
                front of the buffer is not seen here: the time since it last had room counts as well. A reader that is
                alone holds back the encoder, and what it gets is no older than the buffer.
        """
        now = time.monotonic()
        info = self._socket.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, 256)
        (acked,), (rtt_us,) = struct.unpack_from("Q", info, _BYTES_ACKED), struct.unpack_from("I", info, _MIN_RTT)
        self._bound(round(kbps * 125 * (BUFFER_S + rtt_us / 1e6)))
        (waiting,) = struct.unpack("i", ioctl(self._socket, _SIOCOUTQ, bytes(4)))
        self._written.append((now, acked + waiting))
        while self._written and self._written[0][1] <= acked:
            self._written.popleft()
        if not shared or self._has_room():
            self._writable = now
        return now - min(self._writable, self._written[0][0] if self._written else now)

    def _bound(self, size: int) -> None:
        size = max(size, LEAST_BUFFER_BYTES)
        if abs(size - self._buffer) > self._buffer / 10:
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, size // 2)  # which the kernel doubles
            self._buffer = size

    def _has_room(self) -> bool:
        room = select.poll()
        room.register(self._socket, select.POLLOUT)
        return bool(room.poll(0))

    def close(self) -> None:
        """End the connection. The server then finds it closed, in its own thread."""
        with suppress(OSError):  # it may have ended already
            self._socket.shutdown(socket.SHUT_RDWR)

    def forget(self) -> None:
        """The server has closed it."""
        self._socket.close()
