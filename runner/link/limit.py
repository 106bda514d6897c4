"""Effect of a limited link on packets, defined once for both kinds of link. Pure. Sizes are bytes of IP packets."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

PACKET_BYTES = 1500  # the largest IP packet on Ethernet
BURST_S = 0.002  # of data that an idle link passes in a burst; with less, late timers on a busy machine would cost rate


class Rates(NamedTuple):
    """kbit/s in force from vehicle to operator and back, and the delay each way, ms; None: unlimited, unchanged."""

    up: float
    down: float | None
    up_delay_ms: float | None = None
    down_delay_ms: float | None = None


@dataclass(frozen=True)
class Reverse:
    """The direction from operator to vehicle, as in `Limit`."""

    kbps_at: Callable[[float], float]
    queue_ms: float
    delay_ms: float
    loss: float = 0.0
    burst: float = 1.0
    delay_at: Callable[[float], float] | None = None


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
class Limit:
    """Effect of the link on all traffic from the vehicle to the operator.

    kbps_at   rate in force t seconds after the start of the drive; 0: nothing passes
    queue_ms  packets that would wait longer are dropped
    delay_ms  one way, in addition to the wait
    delay_at  further delay t seconds after the start of the drive, ms; packets stay in order. None: none
    loss      share of packets lost after the queue; with a relay, of UDP packets
    burst     mean number of packets lost in a row
    reverse   effect on traffic from the operator to the vehicle; None: none
    tcp       competing traffic from vehicle to operator; None: none
    """

    kbps_at: Callable[[float], float]
    queue_ms: float
    delay_ms: float
    loss: float = 0.0
    burst: float = 1.0
    delay_at: Callable[[float], float] | None = None
    reverse: Reverse | None = None
    tcp: TcpFlows | None = None

    def rates(self, t: float) -> Rates:
        """The rates to set; before the start, those at the start."""
        at, back = max(0.0, t), self.reverse
        return Rates(
            float(self.kbps_at(at)), float(back.kbps_at(at)) if back else None, _delay_ms(self, at), _delay_ms(back, at)
        )

    def settings(self) -> dict[str, Any]:
        """Both directions at the start, for a forwarding process (`runner.link.direction`)."""
        rates = self.rates(0)
        back = None if self.reverse is None else _direction(self.reverse, rates.down)
        return {"up": _direction(self, rates.up), "down": back}


def _delay_ms(one: Limit | Reverse | None, t: float) -> float | None:
    """None: it does not change over time."""
    return one.delay_ms + one.delay_at(t) if one and one.delay_at else None


def _direction(one: Limit | Reverse, kbps: float | None) -> dict[str, float | None]:
    return {"kbps": kbps, "queue_ms": one.queue_ms, "delay_ms": one.delay_ms, "loss": one.loss, "burst": one.burst}


@dataclass(frozen=True, slots=True)
class LinkCounters:
    """Counters of a link since it was set up.

    queue_ms  wait of a packet that arrives now
    bytes     forwarded from vehicle to operator
    packets   of these
    dropped   packets that found the queue full
    lost      packets lost after the queue
    tcp       bytes that competing TCP flows have delivered
    """

    queue_ms: float
    bytes: int
    packets: int
    dropped: int
    lost: int = 0
    tcp: int = 0


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
