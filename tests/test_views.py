"""What an operator sees of each camera: the regions of several windows and processes, and how long they hold."""

from __future__ import annotations

from dataclasses import replace

from helpers import vehicle

from runner.core.driving import Control, Driving
from runner.core.events import ViewReported
from runner.core.state import State
from runner.core.view import MAX_PX, NOWHERE, Seen, united
from runner.operator.seen import StatedView
from runner.records.reception import ReceptionReport
from runner.vehicle.views import MAX_RUNS, VALID_S, StatedViews

ROBOT = vehicle("vehicle=delivery_robot")
HALF, QUARTER = Seen(0, 0, 320, 180, 640, 360), Seen(320, 180, 320, 180, 160, 90)


class Vehicle:
    """The state of a vehicle that a driver controls, and what it notices."""

    def __init__(self):
        self.stated = StatedViews(ROBOT)
        self.state = replace(State.initial(ROBOT, ROBOT.mode), driving=Driving(Control.HELD, "ann"))

    def report(self, t, run=1, **more):
        report = ReceptionReport(at=t, as_of=t, units=(), packets=0, lost=0, run=run, **more)
        return self._after(self.stated.take(self.state, self.state.driving.in_control, t, report))

    def wait(self, t):
        return self._after(self.stated.events(self.state, t))

    def _after(self, events):
        for event in events:
            assert isinstance(event, ViewReported)
            self.state = replace(self.state, view=event.view)
        return self.state.view


def test_a_view_is_noticed_once_and_holds_while_it_is_repeated():
    at = Vehicle()
    assert at.report(0, view={"front": HALF}) == {"front": HALF}
    assert list(at.stated.events(at.state, 0.1)) == []
    for tenth in range(1, 40):
        assert at.report(0.1 * tenth, **({"view": {"front": HALF}} if tenth % 5 == 0 else {})) == {"front": HALF}


def test_a_view_expires_although_its_process_goes_on():
    at = Vehicle()
    at.report(0, view={"front": HALF})
    for tenth in range(1, 20):
        assert at.report(0.1 * tenth)
    assert at.report(VALID_S) == {}


def test_a_view_ends_with_its_process_and_with_control():
    at = Vehicle()
    assert at.report(0, view={"front": HALF})
    assert at.wait(0.9)
    assert at.wait(1.1) == {}
    at.report(1.2, view={"front": HALF})
    at.state = replace(at.state, driving=Driving(Control.HELD, "bob"))
    assert at.wait(1.3) == {}
    assert at.report(1.4) == {}, "ann's view is not bob's"


def test_what_two_processes_show_is_united_and_one_without_a_view_shows_everything():
    at = Vehicle()
    at.report(0, view={"front": HALF, "rear": QUARTER, "mast": NOWHERE})
    at.report(0, run=2, view={"front": QUARTER, "rear": NOWHERE, "mast": NOWHERE})
    assert at.state.view == {"front": Seen(0, 0, 640, 360, 1280, 720), "rear": QUARTER, "mast": NOWHERE}
    assert at.report(0.1, run=3) == {}
    at.report(0.9)
    assert at.report(1.2, run=2) == {"front": Seen(0, 0, 640, 360, 1280, 720), "rear": QUARTER, "mast": NOWHERE}


def test_what_a_magnified_part_and_the_whole_show_together_can_be_reported():
    """Otherwise the vehicle would refuse the report, and with it what it says of the link."""
    magnified, whole = Seen(0, 0, 10, 10, 1000, 1000), Seen(0, 0, 1280, 720, 640, 360)
    view = {"front": united(magnified, whole)}
    assert view == {"front": Seen(0, 0, 1280, 720, MAX_PX, MAX_PX)}
    assert view["front"].problem(ROBOT.cameras["front"]) is None


def test_what_the_cameras_cannot_show_counts_as_everything():
    at = Vehicle()
    camera = ROBOT.cameras["front"]
    beyond = Seen(1, 0, camera.width, camera.height, 10, 10)
    assert at.report(0, view={"front": beyond, "unknown": HALF, "rear": HALF}) == {"rear": HALF}


def test_a_flood_of_processes_is_forgotten():
    at = Vehicle()
    for run in range(5 * MAX_RUNS):
        at.report(0.001 * run, run=run, view={"front": HALF})
    assert len(at.stated._runs) == MAX_RUNS


def test_regions_that_two_windows_show():
    assert united(HALF, NOWHERE) == united(NOWHERE, HALF) == HALF
    assert united(HALF, replace(HALF, screen_width=64, screen_height=36)) == HALF
    assert united(NOWHERE, NOWHERE) == NOWHERE


def test_all_who_show_pictures_in_one_process_are_united():
    seen = StatedView()
    seen.state({"front": HALF, "rear": NOWHERE}, by="page")
    assert seen.view == {"front": HALF, "rear": NOWHERE}
    seen.state(None, by="ros")
    assert seen.view == {}
    seen.state({"front": QUARTER}, by="ros")
    assert seen.view == {"front": united(HALF, QUARTER)}
    seen.state({"front": QUARTER}, for_s=0, by="ros")
    assert seen.view == {}
