"""Effect of a limited link on packets, defined once for both kinds of link. Pure. Sizes are bytes of IP packets."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import inf
from typing import Any, Literal, NamedTuple, Protocol

MOST_ADDRESSES = 13  # of the vehicle: one for each lane, and one for each change
PACKET_BYTES = 1500  # the largest IP packet on Ethernet
BURST_S = 0.002  # of data that an idle link passes in a burst; with less, late timers on a busy machine would cost rate

How = Literal["carrier", "down", "address", "silence", "hold"]


class Cut(NamedTuple):
    """A lane that is cut, from at_s on for for_s, s after the start of the drive; nothing passes meanwhile.

    how  carrier: the vehicle's device loses its carrier
         down: that device is down
         silence: packets vanish without any sign
         hold: packets are held, and flood out when it ends
         address: no cut, the device gets another address at once and for good (for_s 0)
    """

    at_s: float
    for_s: float
    how: How


class Rates(NamedTuple):
    """kbit/s in force from vehicle to operator and back, and the delay each way, ms; None: unlimited, unchanged.

    cut    how the lane is cut; None: it is not
    moves  how often the vehicle has got another address
    """

    up: float
    down: float | None
    up_delay_ms: float | None = None
    down_delay_ms: float | None = None
    cut: How | None = None
    moves: int = 0


class Policing(NamedTuple):
    """kbps, depth_ms: see `runner.link.policer.Policer`"""

    kbps: float
    depth_ms: float


@dataclass(frozen=True)
class OneWay:
    """Effect of the link on all traffic in one direction.

    kbps_at   rate in force t seconds after the start of the drive; 0: nothing passes
    queue_ms  packets that would wait longer are dropped
    delay_ms  in addition to the wait
    delay_at  further delay t seconds after the start of the drive, ms; packets stay in order. None: none
    loss      share of packets lost after the queue; with a relay, of UDP packets
    burst     mean number of packets lost in a row
    policer   drops what exceeds a rate, before the queue; with a relay, of UDP packets. None: there is none
    """

    kbps_at: Callable[[float], float]
    queue_ms: float
    delay_ms: float
    loss: float = 0.0
    burst: float = 1.0
    delay_at: Callable[[float], float] | None = None
    policer: Policing | None = None

    def changing_delay_ms(self, t: float) -> float | None:
        """None: it does not change over time."""
        return self.delay_ms + self.delay_at(t) if self.delay_at else None

    def settings(self, kbps: float | None) -> dict[str, Any]:
        """For a forwarding process (`runner.link.direction`), at this rate."""
        own = {"queue_ms": self.queue_ms, "delay_ms": self.delay_ms, "loss": self.loss, "burst": self.burst}
        return {"kbps": kbps, **own, "policer": self.policer}


@dataclass(frozen=True)
class TcpFlows:
    """TCP flows from vehicle to operator that compete with the cameras.

    flows    how many at a time
    size     bytes of a transfer, uniformly distributed between two bounds; None: one endless transfer
    pause_s  mean time between two transfers of a flow, exponentially distributed
    start_s  when the first transfers begin, s after the start of the drive
    """

    flows: int
    size: tuple[int, int] | None = None
    pause_s: float = 10.0
    start_s: float = 0.0


@dataclass(frozen=True)
class Limit(OneWay):
    """Effect of the link from the vehicle to the operator.

    reverse  effect on traffic from the operator to the vehicle; None: none
    tcp      competing traffic from vehicle to operator; None: none
    cuts     when nothing passes; with a relay, by silence or hold
    """

    reverse: OneWay | None = None
    tcp: TcpFlows | None = None
    cuts: tuple[Cut, ...] = ()

    def rates(self, t: float) -> Rates:
        """The rates to set; before the start, those at the start."""
        at, down = max(0.0, t), self.reverse
        back = (float(down.kbps_at(at)), down.changing_delay_ms(at)) if down else (None, None)
        cut = next((cut.how for cut in self.cuts if cut.at_s <= at < cut.at_s + cut.for_s), None)
        return Rates(float(self.kbps_at(at)), back[0], self.changing_delay_ms(at), back[1], cut, self.moves(at))

    def moves(self, t: float = inf) -> int:
        """How often the vehicle has got another address by then."""
        return sum(cut.how == "address" and cut.at_s <= t for cut in self.cuts)

    def directions(self) -> dict[str, Any]:
        """The settings of both directions at the start."""
        rates = self.rates(0)
        return {"up": self.settings(rates.up), "down": self.reverse and self.reverse.settings(rates.down)}


@dataclass(frozen=True, slots=True)
class LinkCounters:
    """Counters of a link since it was set up.

    queue_ms   wait of a packet that arrives now
    bytes      forwarded from vehicle to operator
    packets    of these
    dropped    packets that found the queue full, or exceeded the rate of a policer
    lost       packets lost after the queue, at random or while it was cut
    tcp_bytes  that competing TCP flows have delivered
    """

    queue_ms: float
    bytes: int
    packets: int
    dropped: int
    lost: int = 0
    tcp_bytes: int = 0


class Shaper(Protocol):
    """Sets rates and reads counters."""

    def limit(self, rates: Rates) -> LinkCounters:
        """Set the rates; returns the counters. raises RunError if the link has failed"""

    def check(self) -> None:
        """raises RunError if the link has failed"""


def burst_bytes(kbps: float) -> int:
    """Size of the token bucket: two full packets, or 2 ms of the rate."""
    return max(2 * PACKET_BYTES, round(kbps * 1000 / 8 * BURST_S))


def queue_bytes(kbps: float, queue_ms: float) -> int:
    """Length of the queue at a rate: queue_ms of it, but at least the bucket, or a slow link would pass nothing."""
    return max(burst_bytes(kbps), round(kbps * queue_ms / 8))
