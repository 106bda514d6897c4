"""Two ways between two machines: a vehicle with a device for each, and an operator with one address for both.

    vehicle's namespace   way-a, way-b ---- a thread that delays, holds or drops packets ---- op-a, op-b   this one

The operator's devices are in the namespace of the test.
"""

from __future__ import annotations

import heapq
import itertools
import os
import select
import subprocess
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress

from machines import Machine

from rig import WAIT_S
from runner.link.tunnel import create

OPERATOR, OPERATOR_6 = "10.78.0.1", "fd78::1"
ADDRESSES = {"a": "10.78.1.2", "b": "10.78.2.2"}  # of the vehicle
ADDRESSES_6 = {"a": "fd78:1::2", "b": "fd78:2::2"}
FLOOD_S = 0.0004  # between two packets of a flood: 24 Mbit/s
TURN = 64  # packets read before the other devices get their turn


def whole(address: str) -> str:
    """An address with the length of a prefix that is nothing but this address; it is usable at once."""
    return f"{address}/128 nodad" if ":" in address else f"{address}/32"


def operator_at(address: str) -> str:
    """The operator's address of the same family."""
    return OPERATOR_6 if ":" in address else OPERATOR


def ip(words: str) -> None:
    subprocess.run(["ip", *words.split()], check=True, timeout=WAIT_S)


class Way:
    """One way.

    delay_s   of each packet, from the vehicle and towards it
    is_cut    whether packets are dropped, silently
    is_held   whether packets wait; the end of it lets them go as fast as a link carries them
    passed    packets from the vehicle that arrived
    seen      called with each packet from the vehicle; returns whether it passes
    """

    def __init__(self, name: str, vehicle: Machine, address: str) -> None:
        self.name, self.device, self._vehicle, self._near = name, f"way-{name}", vehicle, f"op-{name}"
        self.delay_s, self.is_cut, self.passed = 0.0, False, 0
        self.seen: Callable[[bytes], bool] = lambda packet: True
        self.is_held = False
        self.free_at = 0.0  # when the last packet that was held will be gone
        self.waiting: list[tuple[int, bytes]] = []
        self.near = self.far = -1
        self.create(address)

    def create(self, address: str) -> None:
        """Create both devices."""
        near, self.far = create(self._near), create(self.device)
        metric = 1 + list(ADDRESSES).index(self.name)
        ip(f"link set dev {self.device} netns {self._vehicle.pid}")
        ip(f"link set dev {self._near} up")
        family = "-6" if ":" in address else "-4"
        ip(f"route add {address} dev {self._near} src {operator_at(address)}")
        self._vehicle.run(f"ip addr add {whole(address)} dev {self.device}")
        self._vehicle.run(f"ip link set dev {self.device} up")
        self._vehicle.run(f"ip {family} route add default dev {self.device} metric {metric}")
        self.near = near

    def remove(self) -> None:
        """Remove both devices, as when a modem is pulled out."""
        near, far, self.near, self.far = self.near, self.far, -1, -1
        time.sleep(0.2)  # the thread that forwards waits for them
        os.close(near)
        os.close(far)

    def to_operator(self, packet: bytes) -> None:
        """Let a packet arrive at once there."""
        write(self.near, packet)

    def to_vehicle(self, packet: bytes) -> None:
        """Let a packet arrive at once there."""
        write(self.far, packet)

    def passes(self, packet: bytes, sink: int) -> bool:
        """Whether a packet goes on now."""
        if self.is_cut or (sink == self.near and not self.seen(packet)):
            return False
        if self.is_held:
            self.waiting.append((sink, packet))
            return False
        self.passed += sink == self.near
        return True


class Ways:
    """The ways by name; `vehicle` is the machine of the vehicle."""

    def __init__(self, vehicle: Machine, addresses: Mapping[str, str]) -> None:
        self.vehicle = vehicle
        ip("link set dev lo up")
        self._own = {operator_at(address) for address in addresses.values()}
        for own in self._own:
            ip(f"addr add {whole(own)} dev lo")
        self.named = {name: Way(name, vehicle, address) for name, address in addresses.items()}
        self._ended = False
        self._thread = threading.Thread(target=self._forward, daemon=True)
        self._thread.start()

    def __getitem__(self, name: str) -> Way:
        return self.named[name]

    def _forward(self) -> None:
        due: list[tuple[float, int, int, bytes]] = []
        order = itertools.count()
        while not self._ended:
            present = [way for way in self.named.values() if way.near >= 0]
            ends = {way.far: (way, way.near) for way in present} | {way.near: (way, way.far) for way in present}
            wait = max(0.0, due[0][0] - time.monotonic()) if due else 0.1
            for source in select.select(list(ends), [], [], min(wait, 0.1))[0]:
                way, sink = ends[source]
                for packet in read(source):
                    if way.passes(packet, sink):
                        at = max(way.free_at, time.monotonic()) + way.delay_s
                        heapq.heappush(due, (at, next(order), sink, packet))
            now = time.monotonic()
            for way in self.named.values():
                while way.waiting and not way.is_held:
                    way.free_at = max(way.free_at, now) + FLOOD_S
                    heapq.heappush(due, (way.free_at, next(order), *way.waiting.pop(0)))
            while due and due[0][0] <= now:
                write(*heapq.heappop(due)[2:])

    def end(self) -> None:
        self._ended = True
        self._thread.join()
        for way in self.named.values():
            way.remove()
        for own in self._own:
            ip(f"addr del {whole(own).split()[0]} dev lo")


def read(source: int) -> Iterator[bytes]:
    for _ in range(TURN):
        try:
            yield os.read(source, 65_536)
        except OSError:  # none is waiting, or the device is down
            return


def write(sink: int, packet: bytes) -> None:
    with suppress(OSError):  # the device is down, or gone
        os.write(sink, packet)


@contextmanager
def two_ways(addresses: Mapping[str, str] = ADDRESSES) -> Iterator[Ways]:
    vehicle = Machine("vehicle")
    try:
        ways = Ways(vehicle, addresses)
        try:
            yield ways
        finally:
            ways.end()
    finally:
        vehicle.end()
