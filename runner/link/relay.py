"""usage: python -m runner.link.relay '{"media": [HOST, PORT], "control": [HOST, PORT], "lanes": {"": {"up": {...}}}}'

The process between vehicle and operator. It listens on two ports of its own, named in its first line of output:
`media` for the operator's RTSP, forwarded to the vehicle's server, and `control` for the vehicle's MQTT, forwarded to
the broker. In RTSP's SETUP it replaces both sides' UDP ports with its own, so that RTP and RTCP pass through it.
Traffic from vehicle to operator shares one `Bucket`; UDP packets that find it full are dropped, TCP waits and takes
the next room. Packets count as IP packets: payload plus 28 bytes (UDP), plus 52 bytes for each 1448 (TCP). RTSP
messages and interleaved packets are never split. The other direction has a `Bucket` of its own if `down` is given,
otherwise it is unlimited. Losses and delay follow the queue; only UDP packets are lost.

Lanes are told apart by the address that the vehicle sends from, which the operator sees as well: both sides' packets of
a lane pass a pair of ports at its address. What comes from another address, and all RTSP, uses the first lane.

Each line of input sets the rates, see `take_rates`; the relay ends with its input.
"""

from __future__ import annotations

import asyncio
import gc
import json
import socket
import sys
from collections.abc import AsyncIterator, Callable, Coroutine, Iterable, Mapping, Sequence
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass
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
SocketPair = tuple[socket.socket, socket.socket]
Serve = Callable[["Lanes", SocketAddress, socket.socket, SocketAddress], Coroutine[Any, Any, None]]


@dataclass(frozen=True)
class Lanes:
    """Links by the vehicle's address; "": there is but one."""

    links: Mapping[str, Link]

    @property
    def addresses(self) -> list[str]:
        return [address for address in self.links if address]

    @property
    def first(self) -> Link:
        return next(iter(self.links.values()))

    def of(self, address: str) -> Link:
        return self.links.get(address, self.first)


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
    """UDP sockets between both sides' RTP and RTCP ports: a pair at the relay's address, and at each lane's.

    The vehicle knows the first pair only, the operator those of the lanes, too.

    operator  address of the operator's RTP
    server    host of the vehicle's server; its ports are known from its reply
    """

    def __init__(self, lanes: Lanes, host: str, operator: SocketAddress, server: str) -> None:
        self._lanes, self._operator, self._server = lanes, operator, server
        self.server_port: int | None = None
        self._near, *others = _bind_pairs([host, *lanes.addresses])
        self._at = dict(zip(lanes.addresses, others, strict=True))
        self.port: int = self._near[0].getsockname()[1]
        for address, pair in (("", self._near), *self._at.items()):
            for index, sock in enumerate(pair):
                sock.setblocking(False)
                asyncio.get_running_loop().add_reader(sock, self._read, address, index, sock)

    @property
    def operator_port(self) -> int:
        return self._operator[1]

    def translated(self, reply: bytes) -> bytes:
        """The server's reply with the operator's own ports as the client's, and these as the server's."""
        reply = rtsp.with_ports(reply, "server_port", lambda _: self.port)
        return rtsp.with_ports(reply, "client_port", lambda _: self.operator_port)

    def close(self) -> None:
        for sock in (sock for pair in (self._near, *self._at.values()) for sock in pair):
            asyncio.get_running_loop().remove_reader(sock)
            sock.close()

    def _read(self, address: str, index: int, sock: socket.socket) -> None:
        """Forward what has arrived at a socket, of the lane with that address if it is one's."""
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
                out = self._at.get(source[0], self._near)[index]
                self._lanes.of(source[0]).up.put(len(data) + UDP_HEADERS, _sender(out, data, operator))
            else:
                to_vehicle = _sender(self._near[index], data, (address or self._server, self.server_port + index))
                self._lanes.of(address).down.put(len(data) + UDP_HEADERS, to_vehicle)


class Rtsp:
    """Rewrites the UDP ports in an RTSP connection: both sides see the relay's.

    operator  the operator's host
    far       the connection to the vehicle's server
    server    the server's host
    """

    def __init__(self, lanes: Lanes, operator: str, far: socket.socket, server: str) -> None:
        self._lanes, self._operator = lanes, operator
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
        self._ports.append(Ports(self._lanes, self._host, (self._operator, port), self._server))
        return self._ports[-1].port


def _sender(sock: socket.socket, data: bytes, address: SocketAddress) -> Delivery:
    def send() -> None:
        with suppress(OSError):  # closed meanwhile, or no receiver: a packet lost after the link
            sock.sendto(data, address)

    return send


def _bind_pairs(hosts: Sequence[str]) -> list[SocketPair]:
    """The same two neighbouring ports on each host, the first one even (RFC 3550, section 11)."""
    for _ in range(PAIR_TRIES):
        sockets = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2 * len(hosts))]
        pairs = list(zip(sockets[::2], sockets[1::2], strict=True))
        port = 0
        with suppress(OSError):
            for host, (first, second) in zip(hosts, pairs, strict=True):
                first.bind((host, port))
                port = first.getsockname()[1]
                if port % 2 == 0:
                    second.bind((host, port + 1))
            if port % 2 == 0:
                return pairs
        for sock in sockets:
            sock.close()
    raise OSError(f"no two neighbouring UDP ports are free on {', '.join(hosts)}")


async def serve_media(lanes: Lanes, server: SocketAddress, near: socket.socket, operator: SocketAddress) -> None:
    """Join an operator's connection to the vehicle's RTSP server, whose side is limited."""
    async with connected(server) as far:
        if far:
            passing = Rtsp(lanes, operator[0], far, server[0])
            try:
                await join(lanes.first, far, near, passing.replies, passing.requests)
            finally:
                passing.close()


async def serve_control(lanes: Lanes, broker: SocketAddress, near: socket.socket, vehicle: SocketAddress) -> None:
    """Join the vehicle's connection, which is limited, to the broker."""
    async with connected(broker) as far:
        if far:
            await join(lanes.of(vehicle[0]), near, far, lambda data: [data], lambda data: [data])


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


async def accept(server: socket.socket, lanes: Lanes, serve: Serve, address: SocketAddress) -> None:
    """Serve each connection in its own task, forever."""
    async with asyncio.TaskGroup() as tasks:
        while True:
            near, client = await asyncio.get_running_loop().sock_accept(server)
            tasks.create_task(_served(serve(lanes, address, near, client), near))


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
    lanes = Lanes({address: Link.of(each) for address, each in settings["lanes"].items()})
    listening = {"media": listen(media[0]), "control": listen(control[0])}
    print(json.dumps({name: server.getsockname()[1] for name, server in listening.items()}), flush=True)
    gc.freeze()
    gc.disable()  # no reference cycle here lasts long; a collection would delay packets
    async with asyncio.TaskGroup() as tasks:
        serving = [
            tasks.create_task(accept(listening["media"], lanes, serve_media, media)),
            tasks.create_task(accept(listening["control"], lanes, serve_control, control)),
        ]
        await take_rates([*lanes.links.values()])
        for task in serving:
            task.cancel()


if __name__ == "__main__":
    with asyncio.Runner(loop_factory=exact_loop) as runner:
        runner.run(main())
