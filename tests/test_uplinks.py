"""Several uplinks: what each carries, which of them carries which camera, and what that gives the cameras."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from fractions import Fraction
from itertools import pairwise
from math import inf
from typing import Any

from helpers import Drive, carries
from hypothesis import given
from hypothesis import strategies as st

from runner.core.placement import MOVES, MOVES_S, Carries, Placement, Wanted, in_words, place, shared
from runner.core.step import start
from runner.records.decisions import DecisionMade
from runner.records.lines import line_from_json, line_to_json
from runner.schema import log_problem
from runner.vehicle.repair import cut_off

CAMERAS = {
    "front": Wanted(6000, 4, redundant=True),
    "left": Wanted(3000),
    "right": Wanted(3000),
    "rear": Wanted(2000),
    "mast": Wanted(500),
}
A, B = Carries(9000), Carries(7000)
DEAD = Carries(0, stalled=True)
CLEAR_S = 5.0


class Rides:
    """Placements one after the other, each 0.1 s after the one before."""

    def __init__(self, cameras: Mapping[str, Wanted] = CAMERAS) -> None:
        self.cameras, self.t, self.now = cameras, 0.0, Placement()

    def over(self, seconds: float = 0.1, **uplinks: Carries) -> Mapping[str, tuple[str, ...]]:
        for _ in range(round(10 * seconds)):
            self.now = place(self.now, self.cameras, uplinks, self.t, CLEAR_S)
            self.t += 0.1
        return self.now.uplinks

    def words(self) -> dict[str, str]:
        return {name: in_words(on, self.now.why.get(name)) for name, on in self.now.uplinks.items()}


def test_a_redundant_camera_is_on_both_and_the_others_where_there_is_room() -> None:
    at = Rides().over(a=A, b=B)
    assert at["front"] == ("a", "b")
    load = {uplink: sum(CAMERAS[n].kbps for n, on in at.items() if on == (uplink,)) for uplink in "ab"}
    assert load == {"a": 5500, "b": 3000}


def test_a_stalled_uplink_loses_its_cameras_at_once_but_not_the_redundant_ones() -> None:
    ride = Rides()
    ride.over(a=A, b=B)
    at = ride.over(a=A, b=DEAD)
    assert at["front"] == ("a", "b")
    assert {at[name] for name in CAMERAS if name != "front"} == {("a",)}


def test_cameras_return_one_at_a_time_once_it_has_been_clear_for_long_enough() -> None:
    ride = Rides()
    ride.over(a=A, b=B)
    ride.over(3, a=A, b=DEAD)
    before, back = ride.over(CLEAR_S - 0.1, a=A, b=B), ride.t
    assert {before[name] for name in CAMERAS if name != "front"} == {("a",)}
    moves = []
    while ride.t < back + 10:
        at = ride.over(a=A, b=B)
        changed = [name for name in CAMERAS if at[name][0] != before[name][0]]
        assert all(at[name] == ("b", "a") for name in changed)  # both carry it for a moment
        moves += [(ride.t, changed)] if changed else []
        before = at
    assert moves and all(len(changed) == 1 for _, changed in moves)
    assert all(len(on) == 1 for name, on in before.items() if name != "front")
    assert all(later - earlier >= 2 for (earlier, _), (later, _) in pairwise(moves))


def test_a_camera_says_why_it_goes_where_it_does() -> None:
    ride = Rides()
    ride.over(a=A, b=B)
    assert ride.words() == {
        "front": "over a and b: redundant",
        **dict.fromkeys(("left", "rear", "mast"), "over a"),
        "right": "over b",
    }
    ride.over(2, a=A, b=DEAD)
    assert ride.words()["right"] == "over a: b stalled at 0.1 s"
    ride.over(7, a=A, b=B)
    assert "over b: moved from a at 7.2 s, which gives less" in ride.words().values()
    ride.over(a=A, b=Carries(600))
    assert ride.words()["front"] == "over a: redundant, but b carries too little"
    alone = Rides({"left": Wanted(3000), "mast": Wanted(500)})
    alone.over(a=A, b=DEAD)
    assert alone.words()["mast"] == "over a and b: a copy keeps b measured"


def test_what_takes_over_cameras_of_a_stalled_uplink_carries_little_more_than_before_at_first() -> None:
    ride = Rides({"front": Wanted(800, redundant=True), "left": Wanted(1500), "right": Wanted(2500)})
    ride.now = Placement({"front": ("a", "b"), "left": ("a",), "right": ("a",)})
    ride.t = 100.0
    assert ride.over(0.1, a=DEAD, b=B)["left"] == ("b",)
    assert [ride.now.most("b", 100 + after) for after in (0, 0.2, 0.25, 0.5, 2.1)] == [1600, 1600, 3200, 6400, inf]
    assert ride.now.most("a", 100) == inf


def test_if_all_uplinks_stall_every_camera_stays() -> None:
    ride = Rides()
    before = ride.over(a=A, b=B)
    assert ride.over(20, a=DEAD, b=DEAD) == before


def test_a_camera_moves_at_most_twice_a_minute_unless_its_uplink_stalls() -> None:
    ride = Rides({name: each._replace(redundant=False) for name, each in CAMERAS.items()})
    moves: dict[str, list[float]] = {name: [] for name in CAMERAS}
    before = ride.over(a=A, b=B)
    for turn in range(40):
        weak, strong = Carries(500), Carries(12_000)
        for _ in range(30):
            at = ride.over(a=weak, b=strong) if turn % 2 else ride.over(a=strong, b=weak)
            for name in CAMERAS:
                if at[name][0] != before[name][0]:
                    moves[name].append(ride.t)
            before = at
    assert any(moves.values())
    for times in moves.values():
        assert all(later - earlier > MOVES_S - 0.1 for earlier, later in zip(times, times[MOVES:], strict=False))


def test_an_uplink_that_would_carry_nothing_gets_a_copy_of_the_smallest_camera() -> None:
    alone = {"left": Wanted(3000), "mast": Wanted(500)}
    ride = Rides(alone)
    ride.over(a=A, b=DEAD)
    assert ride.over(a=A, b=DEAD) == {"left": ("a",), "mast": ("a", "b")}


def test_a_narrow_uplink_carries_no_copy_that_would_cost_the_camera_more() -> None:
    ride = Rides()
    ride.over(a=A, b=B)
    assert ride.over(a=A, b=Carries(600))["front"] == ("a",)
    assert ride.over(a=A, b=Carries(1300))["front"] == ("a",)  # not yet
    assert ride.over(a=A, b=Carries(2000))["front"] == ("a", "b")


@given(
    kbps=st.lists(st.integers(0, 9000), min_size=1, max_size=3),
    stalled=st.lists(st.booleans(), min_size=3, max_size=3),
    wanted=st.lists(st.tuples(st.integers(1, 9000), st.integers(0, 4), st.booleans()), min_size=1, max_size=6),
)
def test_every_camera_is_somewhere_and_no_uplink_is_without(
    kbps: list[int], stalled: list[bool], wanted: list[tuple[int, int, bool]]
) -> None:
    uplinks = {str(n): Carries(each, dead) for n, (each, dead) in enumerate(zip(kbps, stalled, strict=False))}
    cameras = {f"c{n}": Wanted(*each) for n, each in enumerate(wanted)}
    at = place(Placement(), cameras, uplinks, 0.0, CLEAR_S).uplinks
    assert at.keys() == cameras.keys()
    living = {name for name, each in uplinks.items() if not each.stalled} or uplinks.keys()
    assert all(on[0] in living and len(set(on)) == len(on) for on in at.values())
    assert {name for on in at.values() for name in on} == uplinks.keys()


def equally(wanted: Mapping[str, Any], total: Any) -> dict[str, Any]:
    return {name: min(own, Fraction(total, len(wanted))) for name, own in wanted.items()}


def test_a_camera_on_two_uplinks_gets_what_the_worse_gives_it_and_leaves_the_rest() -> None:
    wanted = {"front": Fraction(6000), "left": Fraction(6000), "right": Fraction(6000)}
    limits = {"front": ("a", "b"), "left": ("a",), "right": ("b",)}
    assert shared(limits, {"a": Fraction(8000), "b": Fraction(2000)}, wanted, equally) == {
        "front": 1000,
        "left": 6000,
        "right": 1000,
    }


# --- rules ------------------------------------------------------------------------------------------------------------


class Vehicle(Drive):
    """The delivery robot with two uplinks; the front camera is redundant."""

    def __init__(self, *overrides: str) -> None:
        super().__init__("vehicle=delivery_robot", *overrides)
        cameras = {n: replace(c, redundant=n == "front") for n, c in self.vehicle.cameras.items()}
        self.vehicle = replace(self.vehicle, cameras=cameras, uplinks={"a": Fraction(0), "b": Fraction(0)})
        self.run = start(self.vehicle)
        self.accept("operator_connected")

    def measured(self, t: float, uplink: str, kbps: float, **keys: Any) -> None:
        received = {"kbps": kbps, "queue_ms": 0, "loss": 0, "state": "clear", "rtt_ms": 30} | keys
        self.accept("link_measured", t=t, uplink=uplink, **({"evidence": carries(kbps)} | received))

    def drive(self, seconds: float, **kbps: float | None) -> None:
        """Reports of both uplinks; None: stalled."""
        began = self.run.state.t
        for step in range(1, round(25 * seconds) + 1):
            t = round(began + 0.04 * step, 3)
            for uplink, own in kbps.items():
                if own is None:
                    silent = {"silent_s": round(t - began, 3)}
                    self.measured(t, uplink, 0, state="stalled", evidence=silent)
                else:
                    self.measured(t, uplink, own)

    def load(self, uplink: str) -> int:
        return sum(each.kbps for each in self.run.decision.settings.values() if uplink in each.uplinks)


def test_each_uplink_is_followed_by_itself_and_no_more_is_placed_on_it() -> None:
    ride = Vehicle()
    ride.drive(20, a=3000, b=1500)
    totals = {name: float(share.total) for name, share in ride.run.decision.uplinks.items()}
    assert 1800 < totals["a"] < 3000 and 900 < totals["b"] < 1500
    assert ride["front"].uplinks[:2] == ("a", "b")
    for name, total in totals.items():
        assert 0.7 * total < ride.load(name) <= total
    assert {command.knob for command in ride.run.commands} <= {"bitrate", "size", "uplinks"}


def test_a_stalled_uplink_takes_nothing_from_the_redundant_camera() -> None:
    ride = Vehicle()
    ride.drive(20, a=3000, b=3000)
    before = ride["front"].kbps
    ride.drive(3, a=3000, b=None)
    assert ride["front"].uplinks == ("a", "b")
    assert all(each.uplinks == ("a",) for name, each in ride.run.decision.settings.items() if name != "front")
    assert ride["front"].kbps > 0.6 * before
    assert ride.load("a") <= float(ride.run.decision.uplinks["a"].total)


def test_cameras_that_get_less_than_their_stalled_uplink_gave_them_are_cut_off() -> None:
    ride = Vehicle()
    ride.drive(20, a=3000, b=1000)
    before = ride.run.decision
    moved = [name for name, each in before.settings.items() if each.uplinks == ("a",)]
    assert moved
    ride.measured(ride.run.state.t + 0.1, "a", 0, state="stalled", evidence={"silent_s": 0.1})
    after = ride.run.decision
    assert cut_off(before, after) == moved
    assert sum(after.settings[name].kbps for name in before.settings) <= 1000
    assert cut_off(after, after) == []
    louder = {name: replace(each, kbps=9999) for name, each in after.settings.items()}
    assert cut_off(before, replace(after, settings=louder)) == []


def test_while_both_uplinks_carry_a_camera_that_moves_none_is_to_carry_more_than_it_can() -> None:
    ride = Vehicle()
    ride.drive(20, a=3000, b=3000)
    ride.drive(3, a=3000, b=None)
    moving = 0
    for _ in range(300):
        ride.drive(0.04, a=3000, b=3000)
        moving += any(len(each.uplinks) > 1 for name, each in ride.run.decision.settings.items() if name != "front")
        assert all(ride.load(name) <= share.total for name, share in ride.run.decision.uplinks.items())
    assert moving


def test_with_both_uplinks_stalled_the_redundant_camera_gets_what_the_worse_would_give_it() -> None:
    ride = Vehicle()
    ride.drive(20, a=3000, b=1500)
    ride.drive(0.2, a=None, b=None)
    assert ride["front"].kbps <= ride.run.decision.uplinks["b"].total


def test_an_uplink_that_the_vehicle_does_not_have_is_refused() -> None:
    ride = Vehicle()
    report = {"kbps": 1, "queue_ms": 0, "loss": 0, "state": "clear", "rtt_ms": 1, "evidence": {}}
    assert ride.feed("link_measured", uplink="c", **report).refused == "unknown uplink 'c'; expected one of a, b"
    assert "unknown uplink ''" in (ride.feed("link_measured", **report).refused or "")
    assert "unknown uplink 'c'" in (ride.feed("bitrate_predicted", kbps=1, uplink="c").refused or "")


def test_predictions_of_one_uplink_concern_that_one() -> None:
    ride = Vehicle()
    for t in range(1, 4):
        ride.accept("bitrate_predicted", t=t, kbps=4000, uplink="a")
        ride.accept("bitrate_predicted", t=t, kbps=1000, uplink="b")
    totals = {name: share.total for name, share in ride.run.decision.uplinks.items()}
    assert totals["a"] == 4 * totals["b"] > 0
    assert ride.run.decision.asked == ride.run.state.predicted_kbps == 5000


def test_the_operators_total_limits_both_together() -> None:
    ride = Vehicle("mode=collective")
    ride.accept("total_set", kbps=2000)
    ride.drive(20, a=3000, b=3000)
    assert sum(share.total for share in ride.run.decision.uplinks.values()) == ride.total == 2000


def test_the_operators_total_may_go_over_the_wider_uplink() -> None:
    ride = Vehicle("mode=collective")
    ride.accept("total_set", kbps=4000)
    ride.drive(20, a=6000, b=500)
    shares = {name: float(share.total) for name, share in ride.run.decision.uplinks.items()}
    assert ride.total == sum(shares.values()) == 4000
    assert shares["a"] > 3300  # more than half of it


def test_a_prediction_for_all_is_shared_equally_until_it_is_known_better() -> None:
    ride = Vehicle()
    ride.accept("bitrate_predicted", t=1, kbps=4000)
    assert {share.total for share in ride.run.decision.uplinks.values()} == {1000}  # half of the half, at the start
    for _ in range(20):
        ride.accept("bitrate_predicted", kbps=4000)
        ride.drive(0.5, a=4000, b=500)
    totals = {name: float(share.total) for name, share in ride.run.decision.uplinks.items()}
    assert totals["a"] > 2500 and totals["b"] < 500


def test_as_a_ceiling_a_prediction_for_all_limits_the_sum_and_one_for_an_uplink_that_uplink() -> None:
    ride = Vehicle("++modes.automatic.follow_link.ceiling=prediction")
    for _ in range(20):
        ride.accept("bitrate_predicted", t=ride.run.state.t + 0.01, kbps=3000)
        ride.drive(0.5, a=6000, b=500)
    totals = {name: float(share.total) for name, share in ride.run.decision.uplinks.items()}
    assert sum(totals.values()) == ride.total == 3000
    assert totals["a"] > 2400
    ride.accept("bitrate_predicted", kbps=1000, uplink="a")
    ride.drive(0.1, a=6000, b=500)
    assert 900 < ride.run.decision.uplinks["a"].total <= 1000


def test_in_mode_single_no_uplink_is_given_more_than_it_carries() -> None:
    ride = Vehicle("mode=single")
    ride.drive(20, a=2500, b=2500)
    for camera in ride.vehicle.cameras:
        ride.accept("camera_configured", camera=camera, kbps=1500)
    ride.drive(1, a=2500, b=2500)
    for name, share in ride.run.decision.uplinks.items():
        assert 1500 < ride.load(name) <= share.total


def test_in_mode_single_the_operators_settings_are_spread() -> None:
    ride = Vehicle("mode=single")
    ride.drive(20, a=9000, b=9000)
    for camera in ride.vehicle.cameras:
        ride.accept("camera_configured", camera=camera, kbps=1000)
    ride.drive(1, a=9000, b=9000)
    assert all(ride[camera].kbps == 1000 for camera in ride.vehicle.cameras)
    assert {ride[camera].uplinks for camera in ride.vehicle.cameras if camera != "front"} == {("a",), ("b",)}


def test_a_decision_states_what_each_uplink_carries() -> None:
    ride = Vehicle()
    ride.drive(20, a=3000, b=None)
    line = line_to_json(DecisionMade.of(20.0, "link_measured", ride.run.decision, ()))
    assert (log_problem(line), line_to_json(line_from_json(line))) == (None, line)
    assert line["cameras"]["front"]["uplinks"] == ("a", "b")
    a, b = (line["uplinks"][name] for name in "ab")
    assert (a["stalled"], b["stalled"]) == (False, True)
    assert a["total_kbps"] == float(ride.run.decision.uplinks["a"].total) < a["believed"]["kbps"]
