"""Each of several uplinks as the operator's side knows it, and in words. Pure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from msgspec import UNSET, UnsetType

from runner.core.events import LinkState
from runner.records.decisions import UplinkDecision
from runner.records.vehicle import UplinkMeasured, VehicleState


class UplinkRow(NamedTuple):
    """What an uplink may carry, what arrives over it, and the cameras that it carries.

    measured  None: nothing has arrived yet
    """

    name: str
    decided: UplinkDecision
    measured: UplinkMeasured | None
    cameras: Sequence[str]

    @property
    def is_stalled(self) -> bool:
        return self.decided.stalled or (self.measured is not None and self.measured.state is LinkState.STALLED)

    @property
    def words(self) -> str:
        """uplink a: 3000 kbit/s allowed, 2950 received, queue 12 ms, loss 0.3 %, carries front, rear"""
        carries = f"carries {', '.join(self.cameras) or 'nothing'}"
        if self.is_stalled:
            return f"uplink {self.name}: STALLED, nothing arrives; {carries}"
        known = [f"{self.decided.total_kbps:.0f} kbit/s allowed"]
        if own := self.measured:
            known += [f"{own.kbps:.0f} received", f"queue {own.queue_ms:.0f} ms", f"loss {100 * own.loss:.1f} %"]
        why = f" ({self.decided.reason})" if self.decided.reason else ""
        return f"uplink {self.name}: {', '.join(known)}, {carries}{why}"


def uplink_rows(state: VehicleState, measured: Mapping[str, UplinkMeasured] | UnsetType) -> list[UplinkRow]:
    """One for each of several uplinks.

    measured  by uplink, those over which something has arrived
    """
    if state.uplinks is UNSET:
        return []
    known = {} if measured is UNSET else measured
    carried = {name: () if each.uplinks is UNSET else each.uplinks for name, each in state.cameras.items()}
    return [
        UplinkRow(name, decided, known.get(name), [camera for camera, on in carried.items() if name in on])
        for name, decided in state.uplinks.items()
    ]
