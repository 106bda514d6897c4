"""usage: python -m runner.link.tunnel '{"devices": [HERE, FAR], "host": HOST, "up": {...}, "down": null}'

Creates two TUN devices and forwards IP packets between them, limited, delayed and dropped by `runner.link.direction`.
`up` is the direction from the second device to the first.

The first line of output shows that both exist, and names the port of a TCP server on `host`, which accepts and discards
all data. Each line of input sets the rates, see `take_rates`, and whether the second device has a carrier; the process
ends with its input, and the devices with it.
"""

from __future__ import annotations

import asyncio
import fcntl
import gc
import json
import os
import socket
import struct
import sys
from contextlib import suppress
from functools import partial

from runner.link.direction import Direction, Link, exact_loop, take_rates
from runner.link.limit import Rates

TUN = "/dev/net/tun"
IFF_TUN, IFF_NO_PI, TUNSETIFF, TUNSETCARRIER = 0x0001, 0x1000, 0x400454CA, 0x400454E2  # linux/if_tun.h
IP_FREEBIND = 15  # linux/in.h
PACKETS_PER_TURN = 64  # read before the other device gets its turn


def create(name: str) -> int:
    """Create a TUN device that lives as long as its file descriptor; ends the process if that fails."""
    try:
        device = os.open(TUN, os.O_RDWR | os.O_NONBLOCK)
        fcntl.ioctl(device, TUNSETIFF, struct.pack("16sH22x", name.encode(), IFF_TUN | IFF_NO_PI))  # struct ifreq
    except OSError as error:
        sys.exit(
            f"cannot create a network device by {TUN}: {error.strerror}; load the module tun, or choose link=relay"
        )
    return device


def read(source: int, direction: Direction, sink: int) -> None:
    """Read the waiting packets of a device; ends the process if the device is gone."""
    for _ in range(PACKETS_PER_TURN):
        try:
            packet = os.read(source, 65_536)
        except BlockingIOError:
            return
        except OSError as error:
            sys.exit(f"the network device is gone: {error.strerror}")
        direction.put(len(packet), partial(write, sink, packet))


def write(sink: int, packet: bytes) -> None:
    with suppress(OSError):  # a device that is down: a packet lost after the link
        os.write(sink, packet)


class Carrier:
    """A device's carrier; the process ends if the kernel cannot take it away."""

    def __init__(self, device: int) -> None:
        self._device, self._is_there = device, True

    def set(self, is_there: bool) -> None:
        if is_there == self._is_there:
            return
        try:
            fcntl.ioctl(self._device, TUNSETCARRIER, struct.pack("i", is_there))
        except OSError as error:
            sys.exit(f"cannot change the carrier of a network device: {error.strerror}; that needs Linux 5.0")
        self._is_there = is_there


class Sink(asyncio.Protocol):
    """Discards received data, and counts it for all connections."""

    received = 0

    def data_received(self, data: bytes) -> None:
        Sink.received += len(data)


async def serve(host: str) -> int:
    """Start a server at an address that a device will get later. Returns its port."""
    sock = socket.socket()
    sock.setsockopt(socket.SOL_IP, IP_FREEBIND, 1)
    sock.bind((host, 0))
    await asyncio.get_running_loop().create_server(Sink, sock=sock)
    port: int = sock.getsockname()[1]
    return port


async def main() -> None:
    settings = json.loads(sys.argv[1])
    here, far = map(create, settings["devices"])
    link = Link.of(settings)
    print(json.dumps({"port": await serve(settings["host"])}), flush=True)
    gc.freeze()
    gc.disable()  # no reference cycle here lasts long; a collection would delay packets
    loop = asyncio.get_running_loop()
    for source, direction, sink in ((far, link.up, here), (here, link.down, far)):
        loop.add_reader(source, read, source, direction, sink)
    carrier = Carrier(far)

    def more(rates: Rates) -> dict[str, int]:
        carrier.set(rates.cut != "carrier")
        return {"tcp_bytes": Sink.received}

    await take_rates([link], more)


if __name__ == "__main__":
    with asyncio.Runner(loop_factory=exact_loop) as runner:
        runner.run(main())
