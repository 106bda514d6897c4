"""Which cameras' pictures arrive at an operator, by its reports."""

from __future__ import annotations

from helpers import vehicle

from runner.records.reception import ReceptionReport, UnitReceived
from runner.vehicle.operators import MAX_OPERATORS
from runner.vehicle.seen import SEEN_S, SeenPictures


def report(*cameras: str) -> ReceptionReport:
    units = tuple(UnitReceived(name, 0.0, 0.1, 1000, True) for name in cameras)
    return ReceptionReport(at=1.0, as_of=0.0, units=units, packets=1, lost=0)


def test_a_camera_is_seen_while_reports_name_its_frames() -> None:
    seen = SeenPictures(vehicle("vehicle=delivery_robot", "cameras.mast.fps=1"))
    seen.add("ann", 0.0, report("front", "mast", "unknown"))
    assert seen.of("ann", 0.5) == {"front", "mast"}
    assert seen.of("bob", 0.5) == set()
    seen.add("ann", 0.5, report("rear"))
    assert seen.of("ann", SEEN_S) == {"rear", "mast"}, "a slow camera has more time"
    assert seen.of("ann", 2.0) == set()


def test_a_flood_of_names_is_forgotten() -> None:
    seen = SeenPictures(vehicle("vehicle=delivery_robot"))
    for number in range(3 * MAX_OPERATORS):
        seen.add(f"stranger{number}", number / 1000, report("front"))
    seen.add("ann", 0.2, report("front"))
    assert seen.of("ann", 0.3) == {"front"}
    assert seen.of("stranger0", 0.3) == set()
