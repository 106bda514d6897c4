"""One way from the vehicle to the operator: a link, and what the operator's side knows of the packets over it. Pure."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from runner.link.limit import Cut, TcpFlows
from runner.link.losses import LossModel
from runner.records.reception import Arrival
from runner.simulation.control import segments
from runner.simulation.operator import TAIL_S, Frame, Operator
from runner.simulation.queues import Queue
from runner.simulation.steps import Steps

RTO_S = 0.2  # until TCP repeats a segment (Linux' least)
# Each frame begins with a packet of its own for the access unit delimiter (2 bytes of payload), and only this one has
# the header extension with the capture time. Seen in reports of real drives.
DELIMITER, EXTENSION = 2, 16
NOTICED_S = 1.0  # a longer gap on one of several ways is no loss, see `runner.records.reception.UplinkReceived`
DelayAt = Callable[[float], float]


@dataclass
class Link:
    """From the vehicle to the operator; those that begin with `back` are of the other direction.

    capacity  kbit/s
    queue     in front of it; back None: there is none
    one_way_s, delay_at  delay without any queue, and what is added over time, s
    losses    behind the queue; None: there are none
    tcp       competing flows
    cuts      when nothing passes in either direction; another address of the vehicle is none
    """

    capacity: Steps
    queue: Queue
    one_way_s: float
    back_s: float
    delay_at: DelayAt | None = None
    losses: LossModel | None = None
    back: Queue | None = None
    back_at: DelayAt | None = None
    back_losses: LossModel | None = None
    tcp: TcpFlows | None = None
    cuts: Sequence[Cut] = ()

    def cut_at(self, t: float) -> Cut | None:
        return next((cut for cut in self.cuts if cut.at_s <= t < cut.at_s + cut.for_s), None)

    def loses(self, left: float) -> bool:
        """Whether the next packet, which leaves the queue then, is lost behind it."""
        cut = self.cut_at(left) if self.cuts else None
        return bool((self.losses and self.losses.draw()) or (cut and cut.how != "hold"))

    def back_after_s(self, t: float) -> float:
        """Delay of a packet to the vehicle without any queue."""
        return self.back_s + (self.back_at(t) if self.back_at else 0.0)

    def back_arrival(self, t: float, size: int) -> float:
        """When a message to the vehicle arrives; a segment that is dropped is repeated later."""
        if self.cuts and (cut := self.cut_at(t)):
            t = cut.at_s + cut.for_s + RTO_S
        left: float | None = t
        for part in segments(size) if self.back else ():
            left = self.back.put(t, part) if self.back and left is not None else None
        return (t + RTO_S if left is None else left) + self.back_after_s(t)

    def loses_back(self) -> bool:
        """Whether the next packet to the vehicle is lost."""
        return bool(self.back_losses and self.back_losses.draw())


class Put(NamedTuple):
    """A frame on a link.

    packets, bytes  that get through, and their bytes of video
    carried         their bytes on the link
    first, last     when the first and the last of these arrive, s
    left            when the last of these leaves the queue, s
    begun           packets and bytes of all cameras that get through, up to the first of these
    missing         bytes of each lost packet, by its number in the frame
    tail            how many of these follow the last that gets through
    """

    packets: int
    bytes: int
    carried: int
    first: float
    last: float
    left: float
    begun: tuple[int, int]
    missing: Mapping[int, int]
    tail: int


class Way:
    """A link, with what arrives over it.

    receiver  what the operator's side knows of this way
    sizes     by camera, bytes of a packet's payload at most, and of its headers
    """

    def __init__(self, link: Link, receiver: Operator, sizes: Mapping[str, tuple[int, int]]) -> None:
        self.link, self.receiver, self._sizes = link, receiver, sizes
        self.newest = 0.0  # arrival of the newest packet: packets stay in order
        self._unnoticed: list[tuple[float, int]] = []  # (time, number) of packets lost since one arrived

    def arrival(self, left: float) -> float:
        """When a packet that has left the queue arrives; packets stay in order."""
        link = self.link
        if link.cuts and (cut := link.cut_at(left)):  # it is held
            left = cut.at_s + cut.for_s
        at = left + link.one_way_s
        if link.delay_at:
            at += link.delay_at(left)
        if at < self.newest:
            return self.newest
        self.newest = at
        return at

    def put_frame(self, t: float, name: str, size: int) -> Put:
        """Put a frame's packets on the link one after the other, as `udpsink` does with the list of a payloader."""
        payload, header = self._sizes[name]
        link = self.link
        put, loses = link.queue.put, link.loses if link.losses or link.cuts else None
        before, arrived = self.receiver.arrived
        first_left = last_left = 0.0
        begun = (0, 0)
        packets = received = carried = tail = 0
        missing: dict[int, int] = {}
        part, wire = DELIMITER, DELIMITER + header + EXTENSION
        while True:
            left = put(t, wire)
            if left is None or (loses is not None and loses(left)):
                missing[packets + len(missing)] = part
                tail += 1
            else:
                tail = 0
                packets += 1
                received += part
                carried += wire
                last_left = left
                if packets == 1:
                    first_left, begun = left, (before + 1, arrived + part)
            if size <= 0:
                break
            part = size if size < payload else payload
            size -= part
            wire = part + header
        self.receiver.arrived = (before + packets, arrived + received)
        first, last = (self.arrival(first_left), self.arrival(last_left)) if packets else (0.0, 0.0)
        return Put(packets, received, carried, first, last, last_left, begun, missing, tail)

    def deliver(self, t: float, name: str, captured: float, put: Put) -> None:
        """Let the receiver of one of several ways know a frame, or what is missing of it."""
        if not put.packets:
            self._unnoticed.append((t, len(put.missing)))
            return
        lost = sum(number for at, number in self._unnoticed if put.first - at < NOTICED_S)
        self._unnoticed.clear()
        known = put.last + TAIL_S if put.tail else put.last
        if lost + len(put.missing):
            self.receiver.missing(lost + len(put.missing), known)
        self.receiver.frame(framed(name, captured, put, self.receiver.arrived), known)


def carried(links: Iterable[Link]) -> Steps:
    """What links carry together, kbit/s; nothing while they are cut."""
    return Steps.total([link.capacity.without((c.at_s, c.at_s + c.for_s) for c in link.cuts) for link in links])


def framed(name: str, captured: float, put: Put, ended: tuple[int, int]) -> Frame:
    """The frame that has arrived."""
    arrival = Arrival(put.last, captured, put.bytes, not put.missing, put.first)
    return Frame(name, arrival, put.begun, ended, put.packets)


def merged(puts: Sequence[Put]) -> Put:
    """What has arrived of a frame over several ways: each packet counts once, by whichever way it came."""
    some = [put for put in puts if put.packets]
    if len(puts) == 1 or not some:
        return puts[0]
    whole = [put for put in some if not put.missing]
    best = min(whole, key=lambda put: put.last) if whole else max(some, key=lambda put: put.last)
    lost = set.intersection(*(set(put.missing) for put in puts))
    missing = {number: puts[0].missing[number] for number in sorted(lost)}
    total = puts[0].packets + len(puts[0].missing)
    size = puts[0].bytes + sum(puts[0].missing.values())
    return best._replace(
        packets=total - len(lost),
        bytes=size - sum(missing.values()),
        carried=sum(put.carried for put in puts),
        first=min(put.first for put in some),
        missing=missing,
        tail=next((number for number in range(total) if total - 1 - number not in lost), total),
    )
