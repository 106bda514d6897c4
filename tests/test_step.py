"""Single steps: mode changes without jumps, totals, weights, and nothing commanded twice."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from typing import Any

import pytest
from helpers import Drive
from hypothesis import given
from hypothesis import strategies as st
from msgspec import UNSET

from runner.core import rules
from runner.core import step as step_module
from runner.core.commands import wanted
from runner.core.events import Attention, parse
from runner.core.model import Mode
from runner.core.step import Run, start, step
from runner.simulation.control import vehicle_state

PAPER = ("modes=paper",)
LINK = {"kbps": 500, "queue_ms": 300, "loss": 0.5, "state": "filling", "rtt_ms": 30}


def predicted(kbps: float, *overrides: str) -> Drive:
    drive = Drive("modes=paper", *overrides)
    drive.accept("bitrate_predicted", kbps=kbps)
    return drive


def sent(drive: Drive) -> dict[str, Any]:
    return {name: drive.sent(name) for name in drive.vehicle.cameras}


# --- entering a mode --------------------------------------------------------------------------------------------------


def test_entering_single_keeps_every_bitrate_and_factor() -> None:
    drive = predicted(8000)
    before = sent(drive)
    drive.accept("mode_selected", mode="single")
    assert sent(drive) == before
    assert drive.run.commands == ()
    assert drive.total == sum(kbps for kbps, _ in before.values()) == 7997


def test_entering_collective_keeps_the_total_in_force() -> None:
    drive = predicted(8000)
    drive.accept("mode_selected", mode="collective")
    assert (drive.total, drive.run.commands) == (8000, ())


def test_entering_collective_uses_the_last_total_set() -> None:
    drive = Drive(*PAPER, "mode=collective")
    drive.accept("total_set", kbps=4000)
    drive.accept("mode_selected", mode="automatic")
    drive.accept("bitrate_predicted", kbps=9000)
    drive.accept("mode_selected", mode="collective")
    assert drive.total == 4000


def test_entering_collective_from_single_keeps_the_sum() -> None:
    drive = Drive(*PAPER, "mode=single")
    drive.accept("camera_configured", camera="front_left", kbps=1000)
    total = drive.total
    drive.accept("mode_selected", mode="collective")
    assert drive.total == total


@pytest.mark.parametrize("mode", ["single", "collective"])
def test_entering_automatic_uses_the_last_prediction(mode: str) -> None:
    drive = Drive(*PAPER, f"mode={mode}")
    drive.accept("bitrate_predicted", kbps=7000)  # accepted and remembered in every mode
    assert drive.total != 7000
    drive.accept("mode_selected", mode="automatic")
    assert drive.total == 7000


@pytest.mark.parametrize("mode, total", [("automatic", 3000), ("collective", 3000), ("single", 2995)])
def test_before_any_event_a_run_has_start_kbps(mode: str, total: int) -> None:
    drive = Drive(*PAPER, f"mode={mode}")
    assert drive.total == total
    assert drive.sent("front_center") == (454, 0.5)


def test_entering_automatic_without_a_prediction_uses_start_kbps() -> None:
    drive = Drive(*PAPER, "mode=collective")
    drive.accept("total_set", kbps=9000)
    drive.accept("mode_selected", mode="automatic")
    assert drive.total == 3000


def test_selecting_the_mode_in_force_changes_nothing() -> None:
    drive = Drive(*PAPER, "mode=collective")
    drive.accept("total_set", kbps=4000)
    drive.accept("mode_selected", mode="collective")
    assert (drive.total, drive.run.commands) == (4000, ())
    drive = Drive(*PAPER, "mode=single")
    drive.accept("camera_configured", camera="front_left", kbps=1000)
    drive.accept("mode_selected", mode="single")
    assert drive.sent("front_left")[0] == 1000


def test_settings_of_single_are_reset_on_each_entering() -> None:
    drive = Drive(*PAPER, "mode=single")
    drive.accept("camera_configured", camera="front_left", kbps=1000, scaling=1)
    drive.accept("mode_selected", mode="automatic")
    drive.accept("mode_selected", mode="single")
    assert drive.sent("front_left") == (545, 0.25)


def test_a_camera_switched_on_again_in_single_gets_its_last_values() -> None:
    drive = Drive(*PAPER, "mode=single")
    drive.accept("camera_configured", camera="front_left", kbps=1000, scaling=0.75)
    drive.accept("camera_switched", camera="front_left", on=False)
    drive.accept("camera_switched", camera="front_left", on=False)
    assert drive.total == 2995 - 545
    drive.accept("camera_switched", camera="front_left", on=True)
    assert drive.sent("front_left") == (1000, 0.75)


def test_a_camera_switched_off_in_automatic_has_its_last_values_in_single() -> None:
    drive = predicted(8000)
    drive.accept("camera_switched", camera="front_left", on=False)
    drive.accept("bitrate_predicted", kbps=2000)
    drive.accept("mode_selected", mode="single")
    drive.accept("camera_switched", camera="front_left", on=True)
    assert drive.sent("front_left") == (1454, 0.5)


# --- totals, demands, weights -----------------------------------------------------------------------------------------


def test_the_total_is_reported_before_the_cap_at_demand() -> None:
    drive = predicted(50_000)
    assert drive.total == 50_000
    assert sum(kbps for kbps, _ in sent(drive).values()) == 33_000


def test_a_camera_switched_off_leaves_its_share_to_the_others() -> None:
    drive = predicted(3000)
    drive.accept("camera_switched", camera="front_left", on=False)
    assert drive.sent("front_left") == (0, None)
    assert drive.sent("front_right")[0] == 666  # 3000 * 6000 / 27000
    for name in drive.vehicle.cameras:
        drive.accept("camera_switched", camera=name, on=False)
    assert set(sent(drive).values()) == {(0, None)}
    assert drive.total == 3000


def test_bitrates_are_whole_and_rounded_down() -> None:
    drive = predicted(2999.999)
    assert drive.total == pytest.approx(2999.999)
    assert drive.sent("front_center") == (454, 0.5)
    assert sum(kbps for kbps, _ in sent(drive).values()) <= 2999


def test_weights_merge_and_act_in_automatic_and_collective_only() -> None:
    drive = Drive(*PAPER, "mode=single")
    before = sent(drive)
    drive.accept("weights_set", weights={"front_left": 2})
    drive.accept("weights_set", weights={"front_right": 0})
    assert (sent(drive), drive.run.commands) == (before, ())
    for mode in ("automatic", "collective"):
        drive.accept("mode_selected", mode=mode)
        assert drive.sent("front_left")[0] == 2 * 3000 * 6000 // 33_000 == 1090
        assert drive.sent("front_right")[0] == 0
        assert not drive["front_right"].sending


def test_the_vehicles_own_weights_hold_until_others_are_set() -> None:
    drive = Drive(*PAPER, "cameras.front_left.weight=2", "mode=collective")
    assert drive.sent("front_left")[0] == 2 * 3000 * 6000 // 39_000
    drive.accept("weights_set", weights={"front_left": 1})
    assert drive.sent("front_left")[0] == 545


# --- modes=paper: nothing but the paper -------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", list(Mode))
@pytest.mark.parametrize(
    "event, keys",
    [
        ("operator_connected", {}),
        ("operator_disconnected", {}),
        ("clock_advanced", {}),
        ("link_measured", LINK | {"evidence": {"busy_kbit": 4, "busy_s": 0.04}}),
        ("link_measured", LINK | {"state": "stalled", "evidence": {"silent_s": 0.3}}),
        ("position_reported", {"lat": 48.2, "lon": 11.6, "speed_mps": 8, "heading_deg": 90}),
        ("steering_reported", {"rad": 0.4}),
        ("attention_changed", {"attention": "hidden"}),
        ("bitrate_predicted", {"kbps": 3000, "lower_kbps": 1, "valid_s": 0}),
    ],
)
def test_under_the_paper_other_inputs_change_nothing(mode: Mode, event: str, keys: dict[str, Any]) -> None:
    drive = predicted(3000, f"mode={mode}")
    before = drive.run
    for t in (0, 10, 1e6):
        drive.accept(event, t=t, **keys)
        assert drive.run.decision == before.decision
        assert drive.run.commands == ()


# --- commands ---------------------------------------------------------------------------------------------------------


def test_the_first_event_commands_everything() -> None:
    drive = predicted(3000)
    assert [(c.camera, c.knob) for c in drive.run.commands] == [
        (camera, knob) for camera in drive.vehicle.cameras for knob in ("sending", "roi", "size", "bitrate")
    ]


@pytest.mark.parametrize(
    "event, keys",
    [
        ("bitrate_predicted", {"kbps": 5225}),
        ("camera_switched", {"camera": "top_left", "on": False}),
        ("weights_set", {"weights": {"top_left": 3}}),
        ("mode_selected", {"mode": "single"}),
    ],
)
def test_the_same_event_twice_gives_no_command(event: str, keys: dict[str, Any]) -> None:
    drive = predicted(3000)
    drive.accept(event, **keys)
    assert drive.accept(event, **keys).commands == ()


def test_only_what_changes_is_commanded() -> None:
    drive = predicted(3000)
    drive.accept("bitrate_predicted", kbps=3010)
    assert {c.knob for c in drive.run.commands} == {"bitrate"}
    drive.accept("camera_switched", camera="top_left", on=False)
    assert [(c.knob, c.value) for c in drive.run.commands if c.camera == "top_left"] == [("sending", False)]


def test_switching_off_first_commands_only_one_knob() -> None:
    drive = Drive(*PAPER)
    drive.accept("camera_switched", camera="top_left", on=False)
    assert [c.knob for c in drive.run.commands if c.camera == "top_left"] == ["sending"]


def test_changes_while_off_are_commanded_on_switching_on() -> None:
    drive = predicted(3000)
    drive.accept("camera_switched", camera="top_left", on=False)
    drive.accept("bitrate_predicted", kbps=8000)
    assert not [c for c in drive.run.commands if c.camera == "top_left"]
    drive.accept("camera_switched", camera="top_left", on=True)
    assert [c.knob for c in drive.run.commands if c.camera == "top_left"] == ["sending", "size", "bitrate"]


def test_nothing_is_decided_where_no_input_of_the_rules_changed(monkeypatch: pytest.MonkeyPatch) -> None:
    drive = predicted(3000)
    monkeypatch.setattr(step_module.rules, "decide", lambda *_: pytest.fail("decided again"))
    drive.accept("clock_advanced", t=5)
    drive.accept("link_measured", **LINK, evidence={})
    drive.accept("position_reported", lat=48, lon=11)
    drive.feed("total_set", kbps=3)


events = st.one_of(
    st.builds(lambda mode: {"event": "mode_selected", "mode": mode}, st.sampled_from(list(Mode))),
    st.builds(lambda kbps: {"event": "bitrate_predicted", "kbps": kbps}, st.integers(0, 20_000)),
    st.builds(lambda kbps: {"event": "total_set", "kbps": kbps}, st.integers(0, 20_000)),
    st.builds(
        lambda name, on: {"event": "camera_switched", "camera": name, "on": on},
        st.sampled_from(["front_left", "top_rear"]),
        st.booleans(),
    ),
    st.builds(
        lambda x, width: {"event": "roi_set", "camera": "front_left", "x": x, "y": 0, "width": width, "height": 99},
        st.integers(0, 1900),
        st.integers(1, 1920),
    ),
    st.builds(
        lambda kbps: {"event": "camera_configured", "camera": "top_rear", "kbps": kbps, "scaling": 0.9},
        st.integers(0, 4000),
    ),
    st.builds(lambda w: {"event": "weights_set", "weights": {"front_left": w}}, st.sampled_from([0, 0.5, 1, 7])),
    st.sampled_from([{"event": e} for e in ("operator_connected", "operator_disconnected", "clock_advanced")]),
)


@given(st.sampled_from(["paper", "safe", "steady"]), st.lists(st.tuples(st.floats(0, 4), events), max_size=25))
def test_whatever_happens_the_commands_lead_to_the_decision(modes: str, story: list[Any]) -> None:
    vehicle = Drive(f"modes={modes}").vehicle
    run: Run = start(vehicle)
    t = 0.0
    for passed, event in story:
        t += passed
        event = parse({"t": t} | event)  # noqa: PLW2901
        run = step(vehicle, run, event)
        for name, setting in run.decision.settings.items():
            assert wanted(setting).items() <= run.commanded[name].items()
            assert setting.sending == (setting.kbps >= 1)
            assert setting.on == (setting.scaling is not None)
            assert setting.width % 2 == setting.height % 2 == 0
        assert sum(s.kbps for s in run.decision.settings.values()) <= run.decision.total
        assert step(vehicle, run, event).commands == ()


# --- rules that fail --------------------------------------------------------------------------------------------------


def failing(misbehave: Any, *modes: Mode) -> Drive:
    """A drive whose modes end with a rule that misbehaves once 2000 kbit/s or less are predicted."""

    def mine(vehicle: Any, state: Any, draft: Any, memory: Any) -> Any:
        low = state.prediction is not None and state.prediction.kbps <= 2000
        return misbehave(draft, memory) if low else (draft, memory)

    rule = rules.Rule("mine", mine, frozenset(), frozenset({"total"}), frozenset({"prediction"}))
    drive = Drive(*PAPER)
    lists = {mode: (*calls, rules.RuleCall(rule)) for mode, calls in drive.vehicle.modes.items() if mode in modes}
    drive.vehicle = replace(drive.vehicle, modes={**drive.vehicle.modes, **lists})
    drive.run = start(drive.vehicle)
    return drive


def raises(draft: Any, memory: Any) -> Any:
    raise ZeroDivisionError("division by zero")


def leaves(draft: Any, memory: Any) -> Any:
    raise SystemExit(3)


NO_BITRATE = "must be kbit/s from 0 as an exact number (int or Fraction)"


@pytest.mark.parametrize(
    "misbehave, fault",
    [
        (raises, "rule mine failed: ZeroDivisionError: division by zero"),
        (leaves, "rule mine failed: SystemExit: 3"),
        (lambda draft, memory: None, "rule mine failed: TypeError: cannot unpack non-iterable NoneType object"),
        (lambda draft, memory: ("draft", memory), "rule mine failed: it must return a Draft and the memory"),
        (lambda d, m: (d.replaced(total=Fraction(-1)), m), f"rule mine failed: total Fraction(-1, 1): {NO_BITRATE}"),
        (lambda d, m: (d.replaced(total=1000.0), m), f"rule mine failed: total 1000.0: {NO_BITRATE}"),
        (lambda d, m: (d.replaced(total=True), m), f"rule mine failed: total True: {NO_BITRATE}"),
        (
            lambda d, m: (d.replaced(bitrate={**d.bitrate, "top_rear": float("nan")}), m),
            f"rule mine failed: bitrate of top_rear nan: {NO_BITRATE}",
        ),
        (
            lambda d, m: (d.replaced(scaling={}), m),
            "rule mine failed: scaling of front_left None: must be a Fraction in ]0, 1]",
        ),
        (
            lambda d, m: (d.replaced(demand=None), m),
            "rule mine failed: demand None: must be a mapping by camera",
        ),
    ],
)
def test_a_rule_that_fails_leaves_the_last_decision_in_force(misbehave: Any, fault: str) -> None:
    drive = failing(misbehave, Mode.AUTOMATIC)
    before = drive.accept("bitrate_predicted", kbps=8000)
    after = drive.accept("bitrate_predicted", kbps=2000)
    assert (after.decision, after.commands, after.fault) == (before.decision, (), fault)
    assert after.state.prediction is not None and after.state.prediction.kbps == 2000
    assert drive.feed("position_reported", lat=1, lon=1).fault == fault  # nothing that the rules read has changed
    again = drive.accept("bitrate_predicted", kbps=3000)
    assert (drive.total, again.fault) == (3000, None)


def test_a_mode_whose_rules_fail_is_not_entered() -> None:
    drive = failing(raises, Mode.COLLECTIVE)
    before = drive.accept("bitrate_predicted", kbps=1500)
    after = drive.feed("mode_selected", mode="collective")
    assert after.refused == "mode collective: rule mine failed: ZeroDivisionError: division by zero"
    assert (after.state.mode, after.decision, after.fault) == (Mode.AUTOMATIC, before.decision, None)


def test_a_run_whose_rules_fail_at_once_does_not_start() -> None:
    drive = failing(lambda d, m: (d, m), Mode.AUTOMATIC)
    first = drive.vehicle.modes[Mode.AUTOMATIC][-1].rule
    wrong = replace(first, function=lambda vehicle, state, draft, memory: (draft.replaced(total=-1), memory))
    lists = {**drive.vehicle.modes, Mode.AUTOMATIC: (*drive.vehicle.modes[Mode.AUTOMATIC][:-1], rules.RuleCall(wrong))}
    with pytest.raises(rules.RuleFailed, match="rule mine failed: total -1: must be kbit/s"):
        start(replace(drive.vehicle, modes=lists))


def test_a_rule_may_give_whole_numbers() -> None:
    """They are halved exactly, and shared exactly among copies."""

    def whole(vehicle: Any, state: Any, draft: Any, memory: Any) -> Any:
        demand = draft.demand and dict.fromkeys(draft.demand, 701)
        return draft.replaced(total=4001, demand=demand), memory

    mine = rules.RuleCall(rules.Rule("mine", whole, frozenset(), frozenset({"total", "demand"}), frozenset()))
    drive = Drive("modes=safe")
    calls = []
    for call in drive.vehicle.modes[Mode.AUTOMATIC]:
        calls += [mine, call] if call.rule.name in ("follow_link", "share_above_floors") else [call]
    drive.vehicle = replace(drive.vehicle, modes={**drive.vehicle.modes, Mode.AUTOMATIC: tuple(calls)})
    drive.run = start(drive.vehicle)
    drive.accept("bitrate_predicted", t=1, kbps=4001)
    assert drive.accept("copies_counted", copies={"front_left": 2}).fault is None
    assert drive.accept("clock_advanced", t=9).fault is None


def test_the_published_state_says_how_many_copies_share_the_total() -> None:
    drive = Drive("modes=paper")
    assert vehicle_state(drive.run, 0.0, "start").copies is UNSET
    drive.accept("copies_counted", copies={"front_left": 3})
    assert vehicle_state(drive.run, 0.0, "start").copies == {"front_left": 3}
    drive.accept("copies_counted", copies={})
    assert vehicle_state(drive.run, 0.0, "start").copies is UNSET


def test_rules_may_read_the_attention_of_the_person_who_drives() -> None:
    """It belongs to one operator, and is unknown once control passes or nobody is in control."""
    drive = predicted(3000)
    drive.accept("operator_connected", attention="watching")
    assert drive.run.state.attention is None  # the vehicle sends a separate event for it
    for event, keys in (
        ("control_passed", {"operator": "bob"}),
        ("operator_disconnected", {}),
        ("attention_changed", {}),
    ):
        drive.accept("attention_changed", attention="hidden")
        assert drive.run.state.attention is Attention.HIDDEN
        drive.accept(event, **keys)
        assert drive.run.state.attention is None
