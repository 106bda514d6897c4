"""What was believed of an uplink over time. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from msgspec import UNSET

from runner.core.decision import Believed
from runner.core.model import Mode
from runner.drive.time_series import FloatSeries
from runner.records.decisions import CameraDecision, DecisionMade
from runner.records.vehicle import VehicleState

Decisions = Sequence[tuple[float, DecisionMade | VehicleState]]


@dataclass(frozen=True, slots=True)
class BelievedSeries:
    """What was believed of the uplink, see `runner.core.decision.Believed`, each in force until the next; nan: unknown.

    usable  the most that the cameras can use, kbit/s; nan in mode single
    """

    t: FloatSeries
    kbps: FloatSeries
    deviation: FloatSeries
    margin: FloatSeries
    bias: FloatSeries
    error: FloatSeries
    gain: FloatSeries
    policer_kbps: FloatSeries
    usable: FloatSeries


def believed_series(decisions: Decisions, uplink: str = "") -> BelievedSeries | None:
    """By the decisions, s and what was decided; None: no rule believed anything.

    uplink  one of several; "": the vehicle has one
    """
    found = [(t, _believed(line, uplink), line) for t, line in decisions]
    if not any(believed for _, believed, _ in found):
        return None

    def row(t: float, believed: Believed | None, line: DecisionMade | VehicleState) -> tuple[float | None, ...]:
        known = (getattr(believed, each.name, None) for each in fields(Believed))
        usable = sum(camera.demand_kbps for camera in line.cameras.values() if not uplink or _is_on(uplink, camera))
        return t, *known, None if line.mode is Mode.SINGLE else usable

    return BelievedSeries(*np.array([row(*each) for each in found], dtype=float).T)


def _believed(line: DecisionMade | VehicleState, uplink: str) -> Believed | None:
    known = line.believed
    if uplink:
        known = line.uplinks[uplink].believed if line.uplinks is not UNSET and uplink in line.uplinks else UNSET
    return None if known is UNSET else known


def _is_on(uplink: str, camera: CameraDecision) -> bool:
    return camera.uplinks is not UNSET and uplink in camera.uplinks
