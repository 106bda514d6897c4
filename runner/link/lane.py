"""A lane of a link: a network device of the vehicle, with an address and routes of its own."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass

from runner.errors import RunError
from runner.link.iproute import batch, run
from runner.link.limit import LinkCounters, Rates, Shaper

TABLES = 100  # lanes' tables of routes, and priorities of the rules that select them, are the numbers from here on
LAST = 9999  # metric of a route that is used when no other is left


@dataclass(frozen=True)
class Lane:
    """number: among the lanes, from 0 on.

    device     the vehicle's
    here, far  this machine's device, and the vehicle's until it moves to its namespace
    machine    this machine's address
    addresses  the vehicle's, one after the other
    """

    number: int
    device: str
    here: str
    far: str
    machine: str
    addresses: Sequence[str]

    def connect(self, ip: str, namespace: str) -> None:
        """Set up both devices, and this machine's routes to all addresses; the vehicle's device moves."""
        run(ip, "link", "set", "dev", self.far, "netns", namespace, "name", self.device)
        first, *later = self.addresses
        _set_up([ip], self.here, f"{self.machine} peer {first} dev {self.here}")
        _set_up([ip, "-netns", namespace], self.device, self.address(0))
        batch([ip], *(f"route add {address} dev {self.here} src {self.machine}" for address in later))

    def connect_routes(self, inside: Sequence[str]) -> None:
        """Make packets from the lane's address use the lane or none; the first lane is also used by default."""
        last = f"route add unreachable default metric {LAST} table {self._table}"
        batch(inside, last, f"rule add {self.rule(0)}", *self.routes())

    @property
    def _table(self) -> int:
        return TABLES + self.number

    def address(self, moves: int) -> str:
        """An address of the vehicle, with its route, which the kernel removes and restores with the device."""
        return f"{self.addresses[moves]} peer {self.machine} dev {self.device} metric {self.number + 1}"

    def rule(self, moves: int) -> str:
        return f"from {self.addresses[moves]} lookup {self._table} priority {self._table}"

    def routes(self) -> list[str]:
        """Commands for routes that the kernel removes when the device goes down or has no address, and not restores."""
        own = f"route replace default dev {self.device}"
        return [f"{own} table {self._table}", *([f"{own} metric 1"] if self.number == 0 else [])]


def _set_up(ip: Sequence[str], device: str, address: str) -> None:
    with suppress(RunError):  # a kernel without IPv6 lacks this setting, and sends nothing unprompted
        batch(ip, f"link set dev {device} addrgenmode none")
    batch(ip, f"addr add {address}", f"link set dev {device} up")


class LaneShaper:
    """A shaper of a lane, which also takes the vehicle's device down, and gives it other addresses.

    shaper  of the packets
    inside  command prefix of ip in the vehicle's namespace
    """

    def __init__(self, shaper: Shaper, lane: Lane, inside: Sequence[str]) -> None:
        self._shaper, self._lane, self._inside = shaper, lane, inside
        self.check = shaper.check
        self._is_down, self._moves = False, 0

    def limit(self, rates: Rates) -> LinkCounters:
        counters = self._shaper.limit(rates)
        if rates.moves != self._moves:
            self._move(rates.moves)
        if (rates.cut == "down") != self._is_down:
            self._take_down(rates.cut == "down")
        return counters

    def _move(self, moves: int) -> None:
        lane, before = self._lane, self._moves
        batch(
            self._inside,
            f"addr del {lane.address(before)}",
            f"rule del {lane.rule(before)}",
            f"addr add {lane.address(moves)}",
            f"rule add {lane.rule(moves)}",
            *([] if self._is_down else lane.routes()),
        )
        self._moves = moves

    def _take_down(self, is_down: bool) -> None:
        state, routes = ("down", []) if is_down else ("up", self._lane.routes())
        batch(self._inside, f"link set dev {self._lane.device} {state}", *routes)
        self._is_down = is_down
