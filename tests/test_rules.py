"""The rules of the modes: the paper's numbers, safe reactions, calmer pictures; rule lists from YAML."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from fractions import Fraction
from importlib.metadata import EntryPoint
from typing import Any

import pytest
from helpers import CONF, Drive, carries, vehicle
from hypothesis import example, given
from hypothesis import strategies as st

from runner.configuration.rule_lists import OWN_RULES, call_rule, check_order
from runner.core import events as core_events
from runner.core import rules
from runner.core.decision import Decision
from runner.core.events import Attention, BitratePredicted, parse
from runner.core.model import Mode, ModelError, Roi, Vehicle, least_float
from runner.core.rules import decide, registry
from runner.core.state import State
from runner.core.step import Run, start, step

TUM = vehicle("modes=paper")
START = State.initial(TUM, Mode.AUTOMATIC)
STEPS = [1320, 1650, 2200, 2970, 3300, 4400, 5225, 14850]  # computed from Table I


def decided(total: Fraction | int | str, state: State = START) -> Decision:
    prediction = BitratePredicted(t=0, kbps=Fraction(total))
    return decide(TUM, replace(state, prediction=prediction), {})[0]


def factors(total: Fraction | int | str) -> dict[str, float]:
    return {name: float(setting.scaling or 0) for name, setting in decided(total).settings.items()}


# --- the paper --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "total, camera, kbps, scaling",
    [
        (3000, "front_center", 454, 0.5),
        (3000, "front_left", 545, 0.25),
        (3000, "front_right", 545, 0.25),
        (3000, "rear_center", 363, 0.125),
        (3000, "top_front", 272, 0.375),
        (3000, "top_rear", 272, 0.375),
        (8000, "front_left", 1454, 0.5),
        (33000, "rear_center", 4000, 0.5),
        (40000, "front_left", 6000, 0.5),  # never above the demand
    ],
)
def test_table_1(total: int, camera: str, kbps: int, scaling: float) -> None:
    setting = decided(total).settings[camera]
    assert (setting.kbps, setting.scaling) == (kbps, scaling)


def test_the_sweep_steps_up_exactly_where_table_1_requires() -> None:
    sweep = [factors(total) for total in range(16_001)]
    assert [total for total in range(1, 16_001) if sweep[total] != sweep[total - 1]] == STEPS


@pytest.mark.parametrize("total", STEPS)
def test_each_step_is_exact(total: int) -> None:
    before, at = factors(Fraction(total) - Fraction(1, 1000)), factors(total)
    assert before == factors(total - 1)
    assert at != before
    assert all(at[name] >= before[name] for name in at)


def test_at_3000_only_front_center_keeps_one_half() -> None:
    assert [name for name, factor in factors(3000).items() if factor == 0.5] == ["front_center"]


@pytest.mark.parametrize("total", [0, 1, 2.5, 32.999])
def test_a_tiny_total_pauses_cameras(total: float) -> None:
    for name, setting in decided(str(total)).settings.items():
        assert setting.on
        assert setting.scaling == TUM.cameras[name].rate_quality.scaling[0]
        assert setting.sending == (setting.kbps >= 1)
        assert setting.reason.endswith("below 1 kbit/s: not sending") != setting.sending


def test_a_tiny_roi_is_not_sent_either_and_takes_the_smallest_factor() -> None:
    tiny = replace(START, rois={**START.rois, "front_left": Roi(0, 0, 16, 16)})
    left = decided(40_000, tiny).settings["front_left"]
    assert (left.on, left.sending, left.kbps, left.scaling) == (True, False, 0, Fraction(1, 8))
    assert left.reason == "0 of 0.8 kbit/s, range [0, 300) -> 0.125, below 1 kbit/s: not sending"


def test_reasons_state_the_numbers() -> None:
    left = decided(3000).settings["front_left"]
    assert left.reason == "545 of 6000 kbit/s, range [300, 950) -> 0.25"
    cut = replace(START, rois={**START.rois, "front_left": Roi(0, 0, 960, 520)})
    left = decided(3000, cut).settings["front_left"]
    assert left.reason == "157 of 1500 kbit/s, as 631 for the full image, range [300, 950) -> 0.25"


@st.composite
def states(draw: st.DrawFn) -> State:
    """The paper's vehicle with any ROIs, cameras on or off, and weights."""
    on, rois, weights = {}, {}, {}
    for name, camera in TUM.cameras.items():
        width, height = draw(st.integers(16, camera.width)), draw(st.integers(16, camera.height))
        x, y = draw(st.integers(0, camera.width - width)), draw(st.integers(0, camera.height - height))
        on[name], rois[name] = draw(st.booleans()), Roi(x, y, width, height)
        weights[name] = draw(st.fractions(0, 5, max_denominator=10))
    return replace(START, on=on, rois=rois, weights=weights)


@given(states(), st.fractions(0, 40_000, max_denominator=100), st.fractions(0, 5000, max_denominator=100))
def test_more_bitrate_never_lowers_a_factor(state: State, total: Fraction, more: Fraction) -> None:
    less, greater = decided(total, state).settings, decided(total + more, state).settings
    for name in TUM.cameras:
        assert (less[name].scaling or 0) <= (greater[name].scaling or 0)
        assert less[name].kbps <= greater[name].kbps


@given(states(), st.fractions(0, 40_000, max_denominator=100))
def test_what_is_sent_never_exceeds_the_total(state: State, total: Fraction) -> None:
    decision = decided(total, state)
    assert decision.total == total
    assert sum(setting.kbps for setting in decision.settings.values()) <= total


# --- safe: stale, missing and lost inputs -----------------------------------------------------------------------------


def totals(drive: Drive, *times: float) -> Iterator[float]:
    for t in times:
        drive.accept("clock_advanced", t=t)
        yield float(drive.total)


def test_a_stale_prediction_is_halved_down_to_the_floor() -> None:
    drive = Drive("modes=safe")
    drive.accept("bitrate_predicted", t=1, kbps=8000)
    times = (2, 3, 3.01, 3.99, 4, 5, 6, 7, 100, 1e9)
    assert list(totals(drive, *times)) == [8000, 8000, 4000, 4000, 2000, 1000, 500, 500, 500, 500]
    assert "total 8000 -> 500: no prediction for 99.0 s, limit 2 s" in drive_at(8000, 100)["front_left"].reason
    drive.accept("bitrate_predicted", kbps=6000)
    assert drive.total == 6000


def drive_at(kbps: float, t: float, **keys: Any) -> Drive:
    """A safe drive some time after its only prediction, received at 1 s."""
    drive = Drive("modes=safe")
    drive.accept("bitrate_predicted", t=1, kbps=kbps, **keys)
    drive.accept("clock_advanced", t=t)
    return drive


def test_fading_never_gives_more_than_was_predicted_unless_that_was_nothing() -> None:
    assert [drive_at(300, t).total for t in (1, 4, 50)] == [300, 300, 300]  # below the floor of 500
    assert [drive_at(0, t).total for t in (1, 4, 50)] == [0, 500, 500]  # what is not sent cannot be measured


def test_the_floor_is_not_passed_on_the_way() -> None:
    assert drive_at(700, 3.5).total == 500  # half of it is 350


def test_a_prediction_states_how_long_it_may_be_used() -> None:
    assert [drive_at(8000, t, valid_s=10).total for t in (11, 11.5)] == [8000, 4000]
    assert [drive_at(8000, t, valid_s=0.5).total for t in (1.5, 1.6)] == [8000, 4000]


def test_without_any_prediction_the_start_value_fades_as_well() -> None:
    assert list(totals(Drive("modes=safe"), 2, 2.5, 3.5, 60)) == [3000, 1500, 750, 500]


def test_only_the_lower_bound_is_trusted() -> None:
    assert drive_at(8000, 1, lower_kbps=2500).total == 2500
    assert drive_at(8000, 1, lower_kbps=9000).total == 8000
    assert drive_at(8000, 1, lower_kbps=0).total == 0
    assert "total 8000 -> 2500: lower bound of the prediction" in drive_at(8000, 1, lower_kbps=2500)["top_left"].reason


@pytest.mark.parametrize("mode", list(Mode))
def test_nothing_is_sent_while_the_operator_is_gone(mode: Mode) -> None:
    drive = Drive("modes=safe", "pqos=live", f"mode={mode}")
    before = {name: drive.sent(name) for name in drive.vehicle.cameras}
    drive.accept("operator_disconnected", t=10)
    for t, sending in ((10.5, True), (11, True), (11.1, False)):
        drive.accept("bitrate_predicted", t=t, kbps=3000)
        assert {setting.sending for setting in drive.run.decision.settings.values()} == {sending}
    assert {(c.knob, c.value) for c in drive.run.commands} == {("sending", False)}
    assert drive["front_left"].reason.endswith("not sending: operator gone for 1.1 s")
    assert drive["front_left"].on and drive["front_left"].kbps == 0
    drive.accept("operator_connected", t=11.2)
    assert {c.value for c in drive.run.commands if c.knob == "sending"} == {True}
    assert drive.total <= 1500, "until the link is measured"
    drive.accept("bitrate_predicted", t=16.3, kbps=3000)
    assert {name: drive.sent(name) for name in drive.vehicle.cameras} == before


@pytest.mark.parametrize("mode", list(Mode))
def test_half_of_the_total_is_sent_until_the_link_of_an_operator_is_measured(mode: Mode) -> None:
    drive = Drive("modes=safe", "pqos=live", f"mode={mode}")
    asked = drive.total
    drive.accept("operator_connected", t=1)
    assert drive.total == int(5 * asked) / 10
    assert "the link has not been measured yet" in drive["front_left"].reason
    for t in (1.1, 1.2, 1.3):
        drive.reports(t, 9000)
    assert drive.total == asked if mode is not Mode.AUTOMATIC else drive.total > asked, "a prediction is no limit"


def test_an_operator_that_measures_nothing_gets_the_full_total_after_five_seconds() -> None:
    drive = connected()
    half, whole = totals(drive, 5.9, 6.1)
    assert (half, whole) == (1500, 3000)


def connected() -> Drive:
    """A safe drive with a prediction of 3000, whose operator has connected at 1 s."""
    drive = Drive("modes=safe")
    drive.accept("bitrate_predicted", t=0, kbps=3000, valid_s=1000)
    drive.accept("operator_connected", t=1)
    return drive


def narrow(drive: Drive) -> Fraction:
    """The total after 0.4 s of reports, from 2 s on, of a link that carries half of what was predicted."""
    return [drive.reports(2 + 0.04 * n, 1500) for n in range(11)][-1]


def test_a_repeated_connection_does_not_restart_the_start() -> None:
    drive = connected()
    for t in (2, 3, 4, 5, 6, 6.1):
        drive.accept("operator_connected", t=t)
    assert drive.total == 3000


def test_a_total_that_the_link_lowers_while_mode_collective_is_entered_returns_with_the_link() -> None:
    drive = connected()
    before = narrow(drive)
    drive.accept("mode_selected", t=2.4, mode="collective")
    assert drive.total == pytest.approx(before, rel=0.02), "no jump"
    for t in (2.5, 2.6, 2.7, 2.8):
        drive.reports(t, 9000)
    assert drive.total == 3000


def test_what_the_link_carries_is_known_until_another_operator_in_control_has_reported() -> None:
    drive = connected()
    before = narrow(drive)
    drive.accept("control_passed", t=2.4, operator="another")
    assert list(totals(drive, 3, 7)) == [pytest.approx(before, rel=0.02)] * 2
    assert list(totals(drive, 7.5)) == [3000], "it measures nothing"


def test_an_operator_that_stops_reporting_is_one_that_measures_nothing() -> None:
    drive = connected()
    narrow(drive)
    assert list(totals(drive, 7.3, 7.5)) == [pytest.approx(40, abs=10), 3000], "it last reported at 2.4 s"


def test_only_a_fall_that_lasts_makes_pictures_smaller() -> None:
    drive = connected()
    for report in range(100):
        drive.reports(2 + 0.04 * report, 9000)
    before, wide = drive.sent("front_center")
    for report in range(100, 106):
        drive.reports(2 + 0.04 * report, 1500)
    short, factor = drive.sent("front_center")
    assert (short < before / 2, factor) == (True, wide)
    for report in range(106, 130):
        drive.reports(2 + 0.04 * report, 1500)
    assert drive["front_center"].scaling < wide


@pytest.mark.parametrize("reports, limit", [("followed", 1500), ("ignored", 3000)])
def test_reports_can_be_ignored(reports: str, limit: float) -> None:
    drive = Drive("modes=safe", f"modes.automatic.follow_link={{reports: {reports}, start: 1}}")
    drive.accept("bitrate_predicted", t=0, kbps=3000, valid_s=1000)
    drive.accept("operator_connected", t=1)
    narrow(drive)
    assert 0.7 * limit <= drive.total <= limit


def test_a_second_loss_does_not_restart_the_clock() -> None:
    drive = Drive("modes=safe")
    drive.accept("operator_disconnected", t=0)
    drive.accept("operator_disconnected", t=4)
    drive.accept("clock_advanced", t=5.1)
    assert not drive["front_left"].sending


def test_settings_survive_the_operators_absence() -> None:
    drive = Drive("modes=safe")
    drive.accept("bitrate_predicted", t=0, kbps=3000, valid_s=100)
    drive.accept("operator_disconnected", t=0)
    drive.accept("clock_advanced", t=6)
    drive.accept("mode_selected", mode="single")
    drive.accept("camera_switched", camera="top_left", on=False)
    drive.accept("operator_connected", t=7)
    drive.accept("clock_advanced", t=12.1)
    drive.accept("camera_switched", camera="top_left", on=True)
    assert drive.sent("front_left") == (545, 0.25)
    assert drive.sent("top_left") == (272, 0.375)


# --- steady -----------------------------------------------------------------------------------------------------------


def test_a_larger_factor_is_held_back_and_a_smaller_one_applied_immediately() -> None:
    drive = Drive("modes=steady")

    def factor(t: float, kbps: int) -> float | None:
        drive.accept("bitrate_predicted", t=t, kbps=kbps)
        return drive.sent("front_center")[1]

    assert [factor(0, 3000), factor(1, 2000), factor(2, 3000)] == [0.5, 0.25, 0.25]
    assert drive["front_center"].reason.endswith("-> 0.5, held at 0.25 until it has been so for 3 s")
    assert drive.sent("front_center")[0] == 454  # only the factor waits
    assert [factor(4.9, 3000), factor(5, 3000)] == [0.25, 0.5]
    assert [factor(6, 2000), factor(7, 3000), factor(8, 2000), factor(10, 3000)] == [0.25] * 4
    assert [factor(12.9, 3000), factor(13, 3000)] == [0.25, 0.5]  # a break restarts the wait


def test_memory_is_empty_under_the_paper_and_frozen_elsewhere() -> None:
    paper, steady = Drive("modes=paper"), Drive("modes=steady")
    for drive in (paper, steady):
        drive.accept("bitrate_predicted", t=0, kbps=2000)
    before = steady.run
    remembered = repr(before.memory)
    steady.accept("bitrate_predicted", t=1, kbps=3000)
    assert paper.run.memory == {}
    assert set(steady.run.memory) == {("hold_upscaling", "hold_upscaling")}
    assert repr(before.memory) == remembered


# --- what rules read --------------------------------------------------------------------------------------------------

FRONT_LEFT = {"camera": st.just("front_left")}
KBPS = {"kbps": st.sampled_from([0, 0.5, 300, 1320, 2970, 5225.5, 12_000])}
SEEN = [
    dict(zip(("x", "y", "width", "height", "screen_width", "screen_height"), numbers, strict=True))
    for numbers in ((0, 0, 640, 360, 900, 506), (100, 50, 200, 300, 160, 100), (639, 359, 1, 1, 1, 1), (0,) * 6)
]
EVENTS: dict[str, dict[str, st.SearchStrategy[Any]]] = {
    "mode_selected": {"mode": st.sampled_from(list(map(str, Mode)))},
    "bitrate_predicted": {**KBPS, "lower_kbps": st.sampled_from([0, 900, 4000]), "valid_s": st.sampled_from([0.5, 4])},
    "position_reported": {"lat": st.sampled_from([48.1, 48.2]), "lon": st.just(11.6)},
    "steering_reported": {"rad": st.just(0.2)},
    "total_set": KBPS,
    "camera_switched": {**FRONT_LEFT, "on": st.booleans()},
    "roi_set": {
        **FRONT_LEFT,
        **dict.fromkeys(("x", "y"), st.sampled_from([0, 200])),
        **dict.fromkeys(("width", "height"), st.sampled_from([16, 240])),
    },
    "camera_configured": {**FRONT_LEFT, **KBPS, "scaling": st.sampled_from([0.125, 0.5])},
    "moment_marked": {"back_s": st.sampled_from([0, 60])},
    "weights_set": {"weights": st.dictionaries(st.sampled_from(list(TUM.cameras)), st.sampled_from([0, 0.5, 3]))},
    "link_measured": {
        **KBPS,
        "queue_ms": st.sampled_from([0, 30, 300]),
        "rtt_ms": st.sampled_from([10, 900]),
        "loss": st.sampled_from([0, 0.2]),
        "state": st.sampled_from(["clear", "filling", "draining", "stalled"]),
        "evidence": st.sampled_from([{}, carries(1000), carries(9000), {"silent_s": 0.5}, {"kbit": 40, "wait_s": 0.3}]),
    },
    "copies_counted": {"copies": st.dictionaries(st.sampled_from(list(TUM.cameras)), st.sampled_from([1, 2, 3]))},
    "stream_measured": {**FRONT_LEFT, **KBPS},
    "source_reported": {**FRONT_LEFT, "works": st.booleans(), "reason": st.just("no such device")},
    "control_passed": {"operator": st.sampled_from(["a", "b", ""])},
    **{f"control_{kind}": {"operator": st.just("a")} for kind in ("requested", "released", "taken", "restored")},
    **{f"stop_{kind}": {"operator": st.just("a")} for kind in ("requested", "lifted")},
    "control_offered": {"operator": st.just("a"), "to": st.sampled_from(["b", ""])},
    "control_denied": {"operator": st.just("a"), "to": st.just("b")},
    "control_accepted": {"operator": st.just("b"), "live": st.just([])},
    "attention_changed": {"attention": st.sampled_from(list(map(str, Attention)))},
    "view_reported": {"view": st.dictionaries(st.sampled_from(list(TUM.cameras)), st.sampled_from(SEEN))},
    "operator_connected": {},
    "operator_disconnected": {},
    "clock_advanced": {},
}
assert set(EVENTS) == set(core_events.EVENTS)
EVENT = st.sampled_from(list(EVENTS)).flatmap(
    lambda name: st.fixed_dictionaries({"event": st.just(name), **EVENTS[name]})
)
PASSING = st.tuples(EVENT, st.sampled_from([0, 0.1, 0.6, 1.5, 4]))  # and the s that pass before the event

FLOORS = tuple(
    f"cameras.{name}.{key}={value}"
    for number, name in enumerate(TUM.cameras, 1)
    for key, value in (("floor_kbps", 300), ("shed", number))
)

NO_QUEUE = {"kbps": 0, "queue_ms": 0, "loss": 0, "rtt_ms": 30, "state": "clear"}
# The first measurement that the rule sees is 0.6 s old, and an event follows that it does not read.
OLD_MEASUREMENT = [
    ({"event": "operator_disconnected"}, 0),
    ({"event": "mode_selected", "mode": "single"}, 0),
    ({"event": "link_measured", **NO_QUEUE, "evidence": carries(1000)}, 0),
    ({"event": "operator_connected"}, 0.6),
    ({"event": "steering_reported", "rad": 0.2}, 0),
]

# The total starts at a share, and an event follows that the rule does not read.
NEW_OPERATOR = [
    ({"event": "mode_selected", "mode": "single"}, 0),
    ({"event": "operator_connected"}, 0.1),
    ({"event": "steering_reported", "rad": 0.2}, 0),
]


def reading_everything(vehicle: Vehicle) -> Vehicle:
    """The vehicle with rules that do not state what they read."""

    def call(of: Any) -> rules.RuleCall:
        return replace(of, rule=replace(of.rule, reads=registry.EVERYTHING))

    return replace(vehicle, modes={mode: tuple(map(call, calls)) for mode, calls in vehicle.modes.items()})


@pytest.mark.slow  # simulates many drives
@pytest.mark.parametrize("modes", sorted(path.stem for path in (CONF / "modes").glob("*.yaml")))
@given(events=st.lists(PASSING, min_size=10, max_size=40))
@example(events=OLD_MEASUREMENT)
@example(events=NEW_OPERATOR)
def test_declaring_reads_changes_no_decision(modes: str, events: list[tuple[dict[str, Any], float]]) -> None:
    stated = vehicle(f"modes={modes}", *FLOORS)
    everything = reading_everything(stated)
    run, other, t = start(stated), start(everything), 0.0
    for event, passing in events:
        t += passing
        parsed = parse({"t": t, **event})
        run, other = step(stated, run, parsed), step(everything, other, parsed)
        assert run == other
        assert reasons(run) == reasons(other)


def reasons(run: Run) -> list[str]:
    """Reasons take no part in the comparison of decisions."""
    return [setting.reason for setting in run.decision.settings.values()]


def test_a_rule_without_declared_reads_runs_on_every_change(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registry, "RULES", dict(registry.RULES))

    @rules.rule(needs=["total"], gives=["total"])
    def below_at_night(vehicle: Vehicle, state: State, draft: Any, memory: Any) -> Any:
        return draft.replaced(total=min(draft.total, 111) if state.t > 10 else draft.total), memory

    first, *others = TUM.modes[Mode.AUTOMATIC]
    call = rules.RuleCall(registry.RULES["below_at_night"])
    drive = Drive("modes=paper")
    drive.vehicle = replace(TUM, modes={**TUM.modes, Mode.AUTOMATIC: (first, call, *others)})
    drive.accept("bitrate_predicted", t=1, kbps=5000)
    assert drive.total == 5000
    drive.accept("clock_advanced", t=11)
    assert drive.total == 111


def test_a_rule_that_is_used_twice_has_a_memory_of_its_own_under_each_name() -> None:
    drive = Drive("modes=steady", "modes.automatic.longer={rule: hold_upscaling, for_s: 4}")
    drive.accept("bitrate_predicted", t=0, kbps=1000, valid_s=100)
    drive.accept("bitrate_predicted", t=10, kbps=8000, valid_s=100)
    factors = []
    for t in (12.9, 13, 16.9, 17):  # 3 s of the first, then 4 s of the second
        drive.accept("clock_advanced", t=t)
        factors.append(drive["front_left"].scaling)
    assert factors == [Fraction(1, 8)] * 3 + [Fraction(1, 2)]


# --- rule lists -------------------------------------------------------------------------------------------------------


def listed(*names: str) -> list[rules.RuleCall]:
    return [rules.RuleCall(registry.RULES[name]) for name in names]


@pytest.mark.parametrize(
    "names, problems",
    [
        (("total_from_prediction", "demand_from_roi", "share_by_demand", "scaling_from_rate_quality"), []),
        (("demand_from_roi", "keep_operator_settings"), []),
        (
            ("total_from_prediction", "share_by_demand", "demand_from_roi", "scaling_from_rate_quality"),
            ["automatic.share_by_demand: needs demand, which no earlier rule gives"],
        ),
        (
            ("follow_link", "total_from_prediction", "demand_from_roi"),
            [
                "automatic.follow_link: needs total, which no earlier rule gives",
                "automatic: no rule gives bitrate, scaling",
            ],
        ),
        (
            ("total_from_prediction", "demand_from_roi", "share_by_demand", "follow_link", "scaling_from_rate_quality"),
            ["automatic.follow_link: gives total, must come before share_by_demand, which uses it"],
        ),
        (
            (
                *("total_from_prediction", "demand_from_roi", "share_by_demand", "scaling_from_rate_quality"),
                *("hold_while_capped", "follow_link"),
            ),
            [
                "automatic.follow_link: gives sized_for, must come before scaling_from_rate_quality, which uses it",
                "automatic.follow_link: gives total, must come before share_by_demand, which uses it",
                "automatic.follow_link: gives uncapped, must come before hold_while_capped, which uses it",
            ],
        ),
    ],
)
def test_a_list_in_the_wrong_order_is_refused(names: tuple[str, ...], problems: list[str]) -> None:
    found = check_order(Mode.AUTOMATIC, listed(*names))
    assert [f"{problem.key}: {problem.rule}" for problem in found] == problems


@pytest.mark.parametrize(
    "name, parameters, message",
    [
        ("share_by_demnd", {}, ": 'share_by_demnd': unknown rule, did you mean share_by_demand?" + OWN_RULES),
        ("share_by_demand", {"x": 1}, "x: 1: unknown parameter; share_by_demand takes none"),
        ("hold_upscaling", {"fo_s": 1}, "fo_s: 1: unknown parameter, did you mean for_s?"),
        ("hold_upscaling", {}, "for_s: missing: required by this rule"),
        ("hold_upscaling", {"for_s": -1}, "for_s: -1: must be a number of 0 or more"),
        ("hold_upscaling", {"for_s": "3"}, "for_s: '3': must be a number of 0 or more"),
        ("hold_upscaling", {"for_s": True}, "for_s: True: must be a number of 0 or more"),
        ("hold_upscaling", {"for_s": float("nan")}, "for_s: nan: must be a number of 0 or more"),
        ("follow_link", {"halve_every_s": 0}, "halve_every_s: 0: must be above 0"),
        ("follow_link", {"reports": "no"}, "reports: 'no': must be one of followed, ignored"),
    ],
)
def test_a_call_is_checked_against_the_rule(name: str, parameters: dict[str, Any], message: str) -> None:
    with pytest.raises(ModelError) as refused:
        call_rule(name, parameters)
    assert str(refused.value) == message


def test_parameters_are_exact() -> None:
    assert call_rule("hold_upscaling", {"for_s": 0.1}).parameters == {"for_s": Fraction(1, 10)}


def test_a_users_rule_is_found_by_its_entry_point(monkeypatch: pytest.MonkeyPatch) -> None:
    def load(_: EntryPoint) -> None:
        @rules.rule(needs=["total"], gives=["total"])
        def keep_below(vehicle: Vehicle, state: State, draft: Any, memory: Any, *, most_kbps: Fraction) -> Any:
            return draft.replaced(total=min(draft.total, most_kbps)), memory

    entry = EntryPoint("keep_below", "my.rules:keep_below", "tod_runner.rules")
    monkeypatch.setattr(EntryPoint, "load", load)
    monkeypatch.setattr("importlib.metadata.entry_points", lambda group, name: [entry] if name == entry.name else [])
    monkeypatch.setattr(registry, "RULES", dict(registry.RULES))
    call = call_rule("keep_below", {"most_kbps": 1000})
    lists = {**TUM.modes, Mode.AUTOMATIC: (TUM.modes[Mode.AUTOMATIC][0], call, *TUM.modes[Mode.AUTOMATIC][1:])}
    assert check_order(Mode.AUTOMATIC, lists[Mode.AUTOMATIC]) == []
    assert decide(replace(TUM, modes=lists), START, {})[0].total == 1000


def test_a_rule_that_reads_an_unknown_field_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    def load(_: EntryPoint) -> None:
        rules.rule(reads=["prediction", "predicton"])(lambda vehicle, state, draft, memory: (draft, memory))

    entry = EntryPoint("deaf", "my.rules:deaf", "tod_runner.rules")
    monkeypatch.setattr(EntryPoint, "load", load)
    monkeypatch.setattr("importlib.metadata.entry_points", lambda group, name: [entry])
    with pytest.raises(ModelError) as refused:
        call_rule("deaf", {})
    assert str(refused.value).startswith(
        ": 'deaf': my.rules:deaf cannot be imported: ValueError: reads: predicton: unknown; expected fields of State: "
    )


@given(st.fractions(0, 10**6, max_denominator=10**6), st.floats(0, 10**6))
@example(Fraction(1, 10), 0.1)
@example(Fraction(3, 10), 0.3)
def test_waiting_times_are_compared_exactly(for_s: Fraction, waited_s: float) -> None:
    """0.3 as a float is a little less than 3/10, and so it has not lasted for that long."""
    assert (waited_s >= least_float(for_s)) == (waited_s >= for_s)
