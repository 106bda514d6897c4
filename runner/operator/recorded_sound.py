"""The packets of the vehicle's sound on their way into the log of a drive."""

from __future__ import annotations

from base64 import b64encode
from collections import deque
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from runner.apply import SoundPacket

MOST = 500  # kept between two samples, of which 12 come; more would mean that nothing is logged any more


class RecordedSound:
    """Packets added in one thread are taken in another."""

    def __init__(self) -> None:
        self._packets: deque[SoundPacket] = deque(maxlen=MOST)

    def add(self, packet: SoundPacket) -> None:
        self._packets.append(packet)

    def take(self) -> tuple[tuple[float | None, str], ...]:
        """Those since the last call, as in `SoundReceived`."""
        taken = [self._packets.popleft() for _ in range(len(self._packets))]
        return tuple((packet.captured, b64encode(packet.data).decode()) for packet in taken)
