"""usage: python -m runner.link.relay '{"media": [HOST, PORT], "control": [HOST, PORT], "up": {...}, "down": null}'

The process between vehicle and operator. It listens on two ports of its own, named in its first line of output:
`media` for the operator's RTSP, forwarded to the vehicle's server, and `control` for the vehicle's MQTT, forwarded to
the broker. In RTSP's SETUP it replaces both sides' UDP ports with its own, so that RTP and RTCP pass through it.
Traffic from vehicle to operator shares one `Bucket`; UDP packets that find it full are dropped, TCP waits and takes
the next room. Packets count as IP packets: payload plus 28 bytes (UDP), plus 52 bytes for each 1448 (TCP). RTSP
messages and interleaved packets are never split. The other direction has a `Bucket` of its own if `down` is given,
otherwise it is unlimited. Losses and delay follow the queue; only UDP packets are lost.

Each line of input sets the rates, see `take_rates`; the relay ends with its input.
"""

from __future__ import annotations

import asyncio
import gc
import json
import socket
import sys
from collections.abc import AsyncIterator, Callable, Coroutine, Iterable
from contextlib import asynccontextmanager, suppress
from functools import partial
from typing import Any

from runner.link import rtsp
from runner.link.direction import Delivery, Direction, Link, exact_loop, take_rates

UDP_HEADERS = 28  # bytes of IPv4 and UDP
TCP_HEADERS = 52  # bytes of IPv4 and TCP with time stamps
SEGMENT = 1448  # bytes of TCP payload in one packet of 1500
WINDOW = 32_768  # bytes of TCP buffered here in front of the limit; the rest waits at the sender, as on a real link
DATAGRAMS_PER_TURN = 64  # datagrams read before other sockets get their turn
PAIR_TRIES = 200
WAIT_S = 0.5  # for a server to accept

SocketAddress = tuple[str, int]
Cut = Callable[[bytes], Iterable[bytes]]
Serve = Callable[["Link", SocketAddress, socket.socket, SocketAddress], Coroutine[Any, Any, None]]


async def join(link: Link, vehicle: socket.socket, other: socket.socket, up: Cut, down: Cut) -> None:
    """Forward bytes between two connections until one ends.

    up, down  divide the bytes of each direction into units that are never split
    """
    upwards: asyncio.Queue[bytes] = asyncio.Queue()
    downwards: asyncio.Queue[bytes] = asyncio.Queue()
    for sock in (vehicle, other):
        sock.setblocking(False)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    reading = [
        asyncio.create_task(_pass(*each))
        for each in ((link.up, vehicle, upwards, up), (link.down, other, downwards, down))
    ]
    ends = [asyncio.create_task(each) for each in (_write(upwards, other), _write(downwards, vehicle))]
    try:
        await asyncio.wait(ends, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for task in (*reading, *ends):
            task.cancel()
        ended = await asyncio.gather(*reading, *ends, return_exceptions=True)
    for error in ended:
        if isinstance(error, Exception):
            raise error


async def _pass(direction: Direction, source: socket.socket, arrived: asyncio.Queue[bytes], cut: Cut) -> None:
    loop = asyncio.get_running_loop()
    with suppress(OSError, ValueError):
        while True:
            await arrived.join()  # a receiver that does not read is sent no more
            if not (data := await loop.sock_recv(source, SEGMENT)):
                break
            for unit in cut(data):
                size = len(unit) + TCP_HEADERS * -(-len(unit) // SEGMENT)
                await direction.room(min(size, SEGMENT + TCP_HEADERS))  # a longer unit may exceed the queue
                direction.put(size, partial(arrived.put_nowait, unit), keep=True)
    direction.put(0, partial(arrived.put_nowait, b""), keep=True)  # after all earlier data


async def _write(arrived: asyncio.Queue[bytes], sink: socket.socket) -> None:
    """Send units until the empty one, which marks the end."""
    loop = asyncio.get_running_loop()
    with suppress(OSError):
        while unit := await arrived.get():
            await loop.sock_sendall(sink, unit)
            arrived.task_done()


class Ports:
    """Two UDP sockets between both sides' RTP and RTCP ports.

    operator  address of the operator's RTP
    server    host of the vehicle's server; its ports are known from its reply
    """

    def __init__(self, link: Link, host: str, operator: SocketAddress, server: str) -> None:
        self._link, self._operator, self._server = link, operator, server
        self.server_port: int | None = None
        self._sockets = _bind_pair(host)
        self.port: int = self._sockets[0].getsockname()[1]
        for index, sock in enumerate(self._sockets):
            sock.setblocking(False)
            asyncio.get_running_loop().add_reader(sock, self._read, index, sock)

    @property
    def operator_port(self) -> int:
        return self._operator[1]

    def translated(self, reply: bytes) -> bytes:
        """The server's reply with the operator's own ports as the client's, and these as the server's."""
        reply = rtsp.with_ports(reply, "server_port", lambda _: self.port)
        return rtsp.with_ports(reply, "client_port", lambda _: self.operator_port)

    def close(self) -> None:
        for sock in self._sockets:
            asyncio.get_running_loop().remove_reader(sock)
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
                continue  # too early: the server's ports are not known yet
            if source[1] - self.server_port in (0, 1):
                self._link.up.put(len(data) + UDP_HEADERS, _sender(sock, data, operator))
            else:
                to_vehicle = _sender(sock, data, (self._server, self.server_port + index))
                self._link.down.put(len(data) + UDP_HEADERS, to_vehicle)


class Rtsp:
    """Rewrites the UDP ports in an RTSP connection: both sides see the relay's.

    operator  the operator's host
    far       the connection to the vehicle's server
    server    the server's host
    """

    def __init__(self, link: Link, operator: str, far: socket.socket, server: str) -> None:
        self._link, self._operator = link, operator
        self._host, self._server = far.getsockname()[0], server
        self._ports: list[Ports] = []
        self._requests, self._replies = rtsp.Splitter(), rtsp.Splitter()

    def requests(self, data: bytes) -> Iterable[bytes]:
        for unit in self._requests.feed(data):
            yield rtsp.with_ports(unit, "client_port", self._own) if rtsp.ports(unit, "client_port") else unit

    def replies(self, data: bytes) -> Iterable[bytes]:
        for unit in self._replies.feed(data):
            client, server = rtsp.ports(unit, "client_port"), rtsp.ports(unit, "server_port")
            found = [ports for ports in self._ports if ports.port in client]
            if not (found and server):
                yield unit
                continue
            ports = found[0]
            ports.server_port = server[0]
            yield ports.translated(unit)

    def close(self) -> None:
        for ports in self._ports:
            ports.close()

    def _own(self, port: int) -> int:
        """The relay's own ports for a pair of the operator's."""
        for ports in self._ports:
            if ports.operator_port == port:
                return ports.port
        self._ports.append(Ports(self._link, self._host, (self._operator, port), self._server))
        return self._ports[-1].port


def _sender(sock: socket.socket, data: bytes, address: SocketAddress) -> Delivery:
    def send() -> None:
        with suppress(OSError):  # closed meanwhile, or no receiver: a packet lost after the link
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


async def serve_media(link: Link, server: SocketAddress, near: socket.socket, operator: SocketAddress) -> None:
    """Join an operator's connection to the vehicle's RTSP server, whose side is limited."""
    async with connected(server) as far:
        if far:
            passing = Rtsp(link, operator[0], far, server[0])
            try:
                await join(link, far, near, passing.replies, passing.requests)
            finally:
                passing.close()


async def serve_control(link: Link, broker: SocketAddress, near: socket.socket, _vehicle: SocketAddress) -> None:
    """Join the vehicle's connection, which is limited, to the broker."""
    async with connected(broker) as far:
        if far:
            await join(link, near, far, lambda data: [data], lambda data: [data])


@asynccontextmanager
async def connected(address: SocketAddress) -> AsyncIterator[socket.socket | None]:
    """A connection; None if nothing listens there: the client's own connection then ends, and it retries."""
    with socket.socket() as sock:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, WINDOW)
        sock.setblocking(False)
        try:
            await asyncio.wait_for(asyncio.get_running_loop().sock_connect(sock, address), WAIT_S)
        except OSError:
            yield None
        else:
            yield sock


def listen(host: str) -> socket.socket:
    """A socket that listens on a port chosen by the system; ends the relay if that fails."""
    try:
        server = socket.create_server((host, 0))
    except OSError as error:
        sys.exit(f"cannot listen on {host}: {error.strerror}; with link=relay both sides and the broker are here")
    server.setblocking(False)
    return server


async def accept(server: socket.socket, link: Link, serve: Serve, address: SocketAddress) -> None:
    """Serve each connection in its own task, forever."""
    async with asyncio.TaskGroup() as tasks:
        while True:
            near, client = await asyncio.get_running_loop().sock_accept(server)
            tasks.create_task(_served(serve(link, address, near, client), near))


async def _served(serving: Coroutine[Any, Any, None], near: socket.socket) -> None:
    with near:
        await serving


def _ipv4_address(host: str) -> str:
    try:
        return socket.gethostbyname(host)
    except OSError as error:
        sys.exit(f"{host} has no IPv4 address: {str(error.strerror).lower()}; link=relay knows no others")


async def main() -> None:
    settings = json.loads(sys.argv[1])
    media, control = ((_ipv4_address(host), port) for host, port in (settings["media"], settings["control"]))
    link = Link.of(settings)
    listening = {"media": listen(media[0]), "control": listen(control[0])}
    print(json.dumps({name: server.getsockname()[1] for name, server in listening.items()}), flush=True)
    gc.freeze()
    gc.disable()  # no reference cycle here lasts long; a collection would delay packets
    async with asyncio.TaskGroup() as tasks:
        serving = [
            tasks.create_task(accept(listening["media"], link, serve_media, media)),
            tasks.create_task(accept(listening["control"], link, serve_control, control)),
        ]
        await take_rates(link)
        for task in serving:
            task.cancel()


if __name__ == "__main__":
    with asyncio.Runner(loop_factory=exact_loop) as runner:
        runner.run(main())
