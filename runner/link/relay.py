"""usage: python -m runner.link.relay '{"media": [HOST, PORT], "control": [HOST, PORT], "kbps": N, "queue_ms": N, ...}'

The process between vehicle and operator. It listens on two ports of its own, which its first line of output names:
`media` for the operator's RTSP, passed on to the vehicle's server, and `control` for the vehicle's MQTT, passed on to
the broker. In RTSP's SETUP it puts UDP ports of its own in place of both sides', so that RTP and RTCP come by.
What goes from vehicle to operator shares one `Bucket`; UDP that finds no room is dropped, TCP waits before it. Packets
count as IP packets: payload and 28 bytes (UDP), 52 bytes for each 1448 (TCP). RTSP messages and interleaved packets
pass as wholes. The other way is free.

Each line of input is a rate in kbit/s, answered with the counters; at its end the relay ends. A delay comes after the
wait. Waits are those of select(), which are exact to 0.1 ms where epoll's are to 1 ms.
"""

from __future__ import annotations

import gc
import json
import os
import select
import socket
import sys
import time
from collections import deque
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import asdict
from functools import partial
from typing import Any

from runner.link import rtsp
from runner.link.bucket import Bucket

UDP_HEADERS = 28  # bytes of IPv4 and UDP
TCP_HEADERS = 52  # bytes of IPv4 and TCP with time stamps
SEGMENT = 1448  # bytes of TCP payload in one packet of 1500
WINDOW = 32_768  # bytes that TCP may hold here before the limit; the rest waits at the sender, as on a real link
DATAGRAMS_PER_TURN = 64  # datagrams that are read before others get their turn
PAIR_TRIES = 200
WAIT_S = 0.5  # for a server that has to accept

SocketAddress = tuple[str, int]
Handler = Callable[[], None]
Delivery = Callable[[], object]


class EventLoop:
    """Everything that can happen, one after the other: sockets, departures, rates.

    readers  called when their socket has something
    gated    as readers, but only while the queue has room
    writers  called when their socket takes something
    """

    def __init__(self, kbps: float, queue_ms: float, delay_ms: float) -> None:
        self.bucket: Bucket[Delivery] = Bucket(kbps, queue_ms, time.monotonic())
        self.readers: dict[Any, Handler] = {}
        self.gated: dict[Any, Handler] = {}
        self.writers: dict[Any, Handler] = {}
        self.runs = True
        self._delay_s = delay_ms / 1000
        self._delayed: deque[tuple[float, Delivery]] = deque()

    def run(self) -> None:
        while self.runs:
            gated = self.gated if self.bucket.has_room(SEGMENT + TCP_HEADERS) else {}
            readable, writable, _ = select.select([*self.readers, *gated], [*self.writers], [], self._wait_s())
            self.deliver()
            for handlers, sockets in ((self.writers, writable), (self.readers, readable), (self.gated, readable)):
                for sock in sockets:
                    if handler := handlers.get(sock):  # it may be closed by now
                        handler()
            self.deliver()

    def deliver(self) -> None:
        """Pass on what has waited, and been delayed, long enough."""
        now = time.monotonic()
        for left, delivery in self.bucket.take(now):
            self._delayed.append((left + self._delay_s, delivery))
        while self._delayed and self._delayed[0][0] <= now:
            self._delayed.popleft()[1]()

    def forget(self, sock: Any) -> None:
        for handlers in (self.readers, self.gated, self.writers):
            handlers.pop(sock, None)

    def _wait_s(self) -> float | None:
        times = [self.bucket.due(), self._delayed[0][0] if self._delayed else None]
        known = [when for when in times if when is not None]
        return max(0.0, min(known) - time.monotonic()) if known else None


class RelayedConnection:
    """A TCP connection through the relay.

    near     accepted from the client
    far      connected to the server
    limited  whose bytes pass the limit: the vehicle's end
    cut      by end, cuts its bytes into what passes as one
    """

    def __init__(
        self,
        loop: EventLoop,
        near: socket.socket,
        far: socket.socket,
        limited: socket.socket,
        cut: dict[socket.socket, Callable[[bytes], Iterable[bytes]]],
    ) -> None:
        self._loop, self._limited, self._cut = loop, limited, cut
        self._other = {near: far, far: near}
        self._unsent = {near: bytearray(), far: bytearray()}
        self.at_end: list[Handler] = []
        for sock in (near, far):
            sock.setblocking(False)
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            handlers = loop.gated if sock is limited else loop.readers
            handlers[sock] = partial(self._read, sock)

    def close(self) -> None:
        for sock in self._other:
            self._loop.forget(sock)
            sock.close()
        for handler in self.at_end:
            handler()
        self.at_end.clear()

    def _read(self, sock: socket.socket) -> None:
        limited, other = sock is self._limited, self._other[sock]
        try:
            data = sock.recv(SEGMENT if limited else WINDOW)
            units = list(self._cut[sock](data)) if data else []
        except BlockingIOError:
            return
        except (OSError, ValueError):
            data, units = b"", []
        if limited:
            self._pass_limited(other, units)
        else:
            for unit in units:
                self._send(other, unit)
        if not data:
            self._end(sock)

    def _pass_limited(self, other: socket.socket, units: list[bytes]) -> None:
        now = time.monotonic()
        for unit in units:
            size = len(unit) + TCP_HEADERS * -(-len(unit) // SEGMENT)
            self._loop.bucket.put(size, partial(self._send, other, unit), now, keep=True)

    def _end(self, sock: socket.socket) -> None:
        """One end has closed: data that it sent before still passes."""
        if sock is not self._limited:
            self.close()
            return
        self._loop.forget(sock)
        self._loop.bucket.put(0, self.close, time.monotonic(), keep=True)

    def _send(self, sock: socket.socket, data: bytes) -> None:
        if sock.fileno() < 0:
            return
        self._unsent[sock] += data
        self._flush(sock)

    def _flush(self, sock: socket.socket) -> None:
        unsent = self._unsent[sock]
        try:
            del unsent[: sock.send(unsent)]
        except BlockingIOError:
            pass
        except OSError:
            self.close()
            return
        if unsent:
            self._loop.writers[sock] = partial(self._flush, sock)
            # Whoever does not read is not sent more.
            self._loop.gated.pop(self._other[sock], None)
        elif self._loop.writers.pop(sock, None) and self._other[sock] is self._limited:
            self._loop.gated[self._limited] = partial(self._read, self._limited)


class Ports:
    """Two UDP sockets that stand between both sides' RTP and RTCP ports.

    operator  address of the operator's RTP
    server    host of the vehicle's server; its ports are known when it has answered
    """

    def __init__(self, loop: EventLoop, host: str, operator: SocketAddress, server: str) -> None:
        self._loop, self._operator, self._server = loop, operator, server
        self.server_port: int | None = None
        self._sockets = _bind_pair(host)
        self.port: int = self._sockets[0].getsockname()[1]
        for index, sock in enumerate(self._sockets):
            sock.setblocking(False)
            loop.readers[sock] = partial(self._read, index, sock)

    @property
    def operator_port(self) -> int:
        return self._operator[1]

    def as_the_operator_knows(self, reply: bytes) -> bytes:
        """The server's reply with the operator's own ports, and these as the server's."""
        reply = rtsp.with_ports(reply, "server_port", lambda _: self.port)
        return rtsp.with_ports(reply, "client_port", lambda _: self.operator_port)

    def close(self) -> None:
        for sock in self._sockets:
            self._loop.forget(sock)
            sock.close()

    def _read(self, index: int, sock: socket.socket) -> None:
        host, first = self._operator
        operator = (host, first + index)
        for _ in range(DATAGRAMS_PER_TURN):
            try:
                data, source = sock.recvfrom(65_536)
            except OSError:
                return
            if self.server_port is None:
                continue  # too early for anybody
            if source[1] - self.server_port in (0, 1):
                deliver = _sender(sock, data, operator)
                self._loop.bucket.put(len(data) + UDP_HEADERS, deliver, time.monotonic())
            else:
                _sender(sock, data, (self._server, self.server_port + index))()


class Rtsp:
    """What the relay changes in an RTSP connection: whose UDP ports both sides hear of.

    operator  its host
    far       the connection to the vehicle's server
    server    host of that
    """

    def __init__(self, loop: EventLoop, operator: str, far: socket.socket, server: str) -> None:
        self._loop, self._operator = loop, operator
        self._host, self._server = far.getsockname()[0], server
        self._ports: list[Ports] = []
        self._requests, self._replies = rtsp.Units(), rtsp.Units()

    def requests(self, data: bytes) -> Iterable[bytes]:
        for unit in self._requests.feed(data):
            yield rtsp.with_ports(unit, "client_port", self._own) if rtsp.ports(unit, "client_port") else unit

    def replies(self, data: bytes) -> Iterable[bytes]:
        for unit in self._replies.feed(data):
            agreed, answering = rtsp.ports(unit, "client_port"), rtsp.ports(unit, "server_port")
            found = [ports for ports in self._ports if ports.port in agreed]
            if not (found and answering):
                yield unit
                continue
            ports = found[0]
            ports.server_port = answering[0]
            yield ports.as_the_operator_knows(unit)

    def close(self) -> None:
        for ports in self._ports:
            ports.close()

    def _own(self, port: int) -> int:
        """Ports of the relay's own for a pair of the operator's."""
        for ports in self._ports:
            if ports.operator_port == port:
                return ports.port
        self._ports.append(Ports(self._loop, self._host, (self._operator, port), self._server))
        return self._ports[-1].port


def _sender(sock: socket.socket, data: bytes, address: SocketAddress) -> Delivery:
    def send() -> None:
        with suppress(OSError):  # closed meanwhile, or nobody is there: a packet lost behind the link
            sock.sendto(data, address)

    return send


def _bind_pair(host: str) -> tuple[socket.socket, socket.socket]:
    """Two neighbouring ports, the first one even (RFC 3550, section 11)."""
    for _ in range(PAIR_TRIES):
        first, second = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
        try:
            first.bind((host, 0))
            port = first.getsockname()[1]
            if port % 2 == 0:
                second.bind((host, port + 1))
                return first, second
        except OSError:
            pass
        first.close()
        second.close()
    raise OSError(f"no two neighbouring UDP ports are free on {host}")


def listen(loop: EventLoop, host: str, accept: Callable[[socket.socket, SocketAddress], None]) -> int:
    """Take connections on a port of the system's choice, which is returned; ends the relay where it cannot."""
    try:
        server = socket.create_server((host, 0))
    except OSError as error:
        sys.exit(f"cannot listen on {host}: {error.strerror}; with link=relay both sides and the broker are here")
    loop.readers[server] = lambda: accept(*server.accept())
    port: int = server.getsockname()[1]
    return port


def serve_media(loop: EventLoop, server: SocketAddress, near: socket.socket, operator: SocketAddress) -> None:
    """An operator has connected: to the vehicle's RTSP server, whose side is limited."""
    far = _connected(server)
    if far:
        passing = Rtsp(loop, operator[0], far, server[0])
        connection = RelayedConnection(loop, near, far, far, {near: passing.requests, far: passing.replies})
        connection.at_end.append(passing.close)
    else:
        near.close()


def serve_control(loop: EventLoop, broker: SocketAddress, near: socket.socket, _vehicle: SocketAddress) -> None:
    """The vehicle has connected, and is limited: to the broker."""
    far = _connected(broker)
    if far:
        RelayedConnection(loop, near, far, near, {near: lambda data: [data], far: lambda data: [data]})
    else:
        near.close()


def _connected(address: SocketAddress) -> socket.socket | None:
    """None where nobody listens: the client then sees its own connection end, and tries again."""
    sock = socket.socket()
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, WINDOW)
    sock.settimeout(WAIT_S)
    try:
        sock.connect(address)
    except OSError:
        sock.close()
        return None
    return sock


def take_rates(loop: EventLoop, taken: bytearray) -> None:
    """Rates from standard input, each answered with the counters."""
    data = os.read(0, 65_536)
    loop.runs = bool(data)
    taken += data
    *lines, rest = taken.split(b"\n")
    taken[:] = rest
    for line in lines:
        now = time.monotonic()
        loop.bucket.set_rate(float(line), now)
        print(json.dumps(asdict(loop.bucket.counters(now))), flush=True)


def main() -> None:
    settings = json.loads(sys.argv[1])
    media, control = ((socket.gethostbyname(host), port) for host, port in (settings["media"], settings["control"]))
    loop = EventLoop(settings["kbps"], settings["queue_ms"], settings["delay_ms"])
    listens = {
        "media": listen(loop, media[0], partial(serve_media, loop, media)),
        "control": listen(loop, control[0], partial(serve_control, loop, control)),
    }
    taken = bytearray()
    loop.readers[0] = lambda: take_rates(loop, taken)
    gc.freeze()
    gc.disable()  # nothing here is a ring for long; a collection would hold up packets
    print(json.dumps(listens), flush=True)
    loop.run()


if __name__ == "__main__":
    main()
