"""The operator's note about a decision: one phrase, whatever it changes."""

from __future__ import annotations

import json
import time
from dataclasses import replace
from typing import Any, NamedTuple

import pytest
from msgspec import UNSET

from runner.core.driving import Control, Driving
from runner.core.events import EVENTS, LinkState
from runner.mqtt.messages import read_state
from runner.operator.notes import (
    CAUSES,
    EXPLAINED_S,
    UNEXPLAINED,
    Refusals,
    change_notes,
    decision_note,
    driver_words,
    size_words,
)
from runner.operator.uplinks import uplink_rows
from runner.records.vehicle import UplinkMeasured, VehicleState

FULL = {"x": 0, "y": 0, "width": 1280, "height": 720}
PART = {"x": 8, "y": 4, "width": 640, "height": 360}
WHY = "500 of 4000 kbit/s, range [400, ...) -> 0.5"


def camera(scaling: float | None = 0.5, **more: Any) -> dict[str, Any]:
    on = scaling is not None
    decided = {"on": on, "sending": on, "demand_kbps": 4000, "kbps": 500, "scaling": scaling, "width": 64, "height": 36}
    return decided | {"roi": FULL, "reason": WHY, "weight": 1, "applied": {}} | more


def state(
    cause: str = "start", mode: str = "automatic", total: int = 3000, uplinks: Any = None, **cameras: Any
) -> VehicleState:
    known = {name: camera() for name in ("front", "rear", "mast")}
    decided = {"cause": cause, "mode": mode, "total_kbps": total, "asked_kbps": total, "cameras": known | cameras}
    decided |= {"uplinks": uplinks} if uplinks else {}
    read = read_state(json.dumps({"online": True, "t": 1.0, **decided}).encode())
    assert read
    return read


PREDICTED = "bitrate_predicted kbps 900"
LOW = "500 of 4000 kbit/s, range [0, 800) -> 0.25"
RATE = "500 of 4000 kbit/s"
STALE = "no prediction for 2 s"
LIMIT = "total 900 -> 400: capacity of the link, believed to be 440"


@pytest.mark.parametrize(
    "after, text",
    [
        (state(PREDICTED), None),
        (state(PREDICTED, rear=camera(reason="another")), None),
        (
            state(PREDICTED, rear=camera(0.25, reason=LOW)),
            f"Prediction 900 kbit/s: rear smaller, at quarter size ({RATE})",
        ),
        (
            state("bitrate_predicted uplink a kbps 900", rear=camera(0.25, reason=LOW)),
            f"Prediction 900 kbit/s, uplink a: rear smaller, at quarter size ({RATE})",
        ),
        (
            state(PREDICTED, total=900, rear=camera(0.25), front=camera(0.25), mast=camera(0.125)),
            "Prediction 900 kbit/s: front, rear smaller, at quarter size; mast smaller, at 1/8 size"
            " (3 of 3 cameras, total 900 kbit/s)",
        ),
        (
            state(
                "clock_advanced",
                total=400,
                **{name: camera(0.25, reason=f"{name}; {STALE}") for name in ("front", "rear")},
            ),
            f"Time elapsed: front, rear smaller, at quarter size (2 of 3 cameras, total 400 kbit/s; {STALE})",
        ),
        (
            state(PREDICTED, rear=camera(0.375, kbps=99, demand_kbps=2000.5, reason=f"99 of 2000; {STALE}")),
            f"Prediction 900 kbit/s: rear smaller, at 3/8 size (99 of 2000 kbit/s; {STALE})",
        ),
        (
            state("link_measured kbps 400", rear=camera(0.25, reason=f"500 of 4000 kbit/s; {LIMIT}")),
            f"Link measured: rear smaller, at quarter size ({RATE}; capacity of the link, believed to be 440 kbit/s)",
        ),
        (
            state("source_reported camera rear works False", rear=camera(None, on=True, reason="lost: no /dev/video0")),
            "rear's source: rear lost (no /dev/video0)",
        ),
        (state(PREDICTED, rear=camera(0.125, sending=False)), "Prediction 900 kbit/s: rear paused"),
        (
            state("camera_switched camera rear on False", rear=camera(None, reason="switched off")),
            "rear switched: rear off",
        ),
        (
            state("roi_set camera rear x 8 y 4 width 640 height 360", rear=camera(roi=PART)),
            f"ROI of rear set: rear ROI 640x360 at 8, 4 ({RATE})",
        ),
        (
            state("mode_selected mode single", mode="single"),
            "Mode single: total 3000 kbit/s, cameras keep what mode automatic gave them",
        ),
        (
            state("mode_selected mode single", mode="single", rear=camera(0.25)),
            f"Mode single: rear smaller, at quarter size ({RATE})",
        ),
        (
            state(PREDICTED, mode="single"),
            "Mode single; Prediction 900 kbit/s: total 3000 kbit/s, cameras keep what mode automatic gave them",
        ),
        (state("attention_changed", rear=camera(0.25)), f"Attention changed: rear smaller, at quarter size ({RATE})"),
        (
            state("total_set", rear=camera(0.25)),
            f"total_set: rear smaller, at quarter size ({RATE})",
        ),  # of another version
        (state("tide_turned high 3", rear=camera(0.25)), f"tide_turned high 3: rear smaller, at quarter size ({RATE})"),
    ],
)
def test_a_decision_is_one_phrase(after: VehicleState, text: str | None) -> None:
    assert decision_note(state(), after) == text


@pytest.mark.parametrize(
    "factor, words",
    [(1, "full size"), (0.5, "half size"), (0.25, "quarter size"), (0.375, "3/8 size"), (0.3, "0.3 of full size")],
)
def test_sizes_have_names(factor: float, words: str) -> None:
    assert size_words(factor) == words


def test_a_camera_comes_back() -> None:
    before = state(rear=camera(None, reason="switched off"), mast=camera(sending=False))
    text = "rear switched: rear, mast on, at half size (2 of 3 cameras, total 3000 kbit/s)"
    assert decision_note(before, state("camera_switched camera rear on True")) == text


def test_phrases_are_of_events() -> None:
    assert CAUSES.keys() <= EVENTS.keys()


def over(*stalled: str, **cameras: str) -> VehicleState:
    """A vehicle with two uplinks, and cameras that go over them."""
    uplinks = {name: {"total_kbps": 1500, "stalled": name in stalled, "reason": ""} for name in "ab"}
    decided = {name: camera(uplinks=list(each)) for name, each in cameras.items()}
    return state(uplinks=uplinks, **decided)


@pytest.mark.parametrize(
    "after, notes",
    [
        (over(front="ab", rear="a", mast="b"), []),
        (over(front="ab", rear="ba", mast="b"), ["rear goes over b"]),  # both carry it for a moment
        (over("a", front="ab", rear="b", mast="b"), ["uplink a: nothing arrives; rear goes over b"]),
        (over("a", front="ba", rear="b", mast="b"), ["uplink a: nothing arrives; rear goes over b"]),
        (over(front="b", rear="a", mast="b"), []),
        (over("b", front="ab", rear="a", mast="ab"), ["uplink b: nothing arrives; mast goes over a"]),
        (over("a", "b", front="ab", rear="a", mast="b"), [f"uplink {name}: nothing arrives" for name in "ab"]),
    ],
)
def test_notes_say_where_cameras_go(after: VehicleState, notes: list[str]) -> None:
    before = over(front="ab", rear="a", mast="b")
    assert list(change_notes(before, after)) == notes
    back = [note for note in change_notes(after, before) if note.startswith("uplink")]
    assert back == [f"uplink {name}: works again" for name in "ab" if after.uplinks[name].stalled]


def test_an_uplink_in_words() -> None:
    now = over("b", front="ab", rear="a", mast="b")
    known = UplinkMeasured(2950.2, 12.4, 0.003, LinkState.FILLING, 30)
    assert [(row.is_stalled, row.words) for row in uplink_rows(now, {"a": known})] == [
        (False, "uplink a: 1500 kbit/s allowed, 2950 received, queue 12 ms, loss 0.3 %, carries front, rear"),
        (True, "uplink b: STALLED, nothing arrives; carries front, mast"),
    ]
    assert uplink_rows(state(), UNSET) == []


@pytest.mark.parametrize(
    "driving, words",
    [
        (Driving(), "nobody is in control"),
        (Driving(Control.HELD, "anna"), "you are in control since {}"),
        (Driving(Control.HELD, "bob", requested=("anna",)), "bob is in control since {}; you ask for control"),
        (
            Driving(Control.HELD, "anna", offered="bob", requested=("bob", "eve")),
            "you are in control since {}; offered to bob; eve asks for control",
        ),
        (Driving(Control.HELD, "bob", stop="eve"), "bob is in control since {}; eve asked to stop: advised speed 0"),
        (Driving(Control.LOST, "bob", offered="anna"), "bob is lost since {}; offered to you"),
    ],
)
def test_who_drives_in_words(driving: Driving, words: str) -> None:
    at = 1_700_000_000.0
    assert driver_words(driving, "anna", at) == words.format(time.strftime("%H:%M:%S", time.localtime(at)))


def test_a_note_says_why_another_operator_drives() -> None:
    before = replace(state(), driving=Driving(Control.HELD, "anna", why="anna has asked for control, which was free"))
    after = replace(before, driving=Driving(Control.HELD, "bob", why="bob has accepted control from anna"))
    assert list(change_notes(before, after)) == ["bob has accepted control from anna"]
    assert list(change_notes(after, replace(after, t=9.0))) == []


# --- refused pictures -------------------------------------------------------------------------------------------------

NO_PLACE = "one viewer per camera: media.max_viewers; anna watches"


class Received(NamedTuple):
    """The part of a reception that counts here."""

    refused: bool = True


class Camera(NamedTuple):
    """The part of a camera's state that counts here."""

    refused: object = UNSET


def test_the_reason_comes_from_the_vehicle_and_is_noted_once():
    refusals = Refusals("bert")
    both, told = (
        {"front": Received(), "rear": Received()},
        {"front": Camera({"bert": NO_PLACE}), "rear": Camera({"bert": NO_PLACE})},
    )
    assert refusals.update(both, {"front": Camera(), "rear": Camera()}, 0) == []  # its state is about to say why
    assert refusals.words == {"front": UNEXPLAINED, "rear": UNEXPLAINED}
    assert refusals.update(both, told, 0.2) == [f"front, rear: refused by the vehicle: {NO_PLACE}"]
    assert refusals.update(both, told, 5) == []
    assert refusals.words == {"front": NO_PLACE, "rear": NO_PLACE}
    assert refusals.update({"front": Received(refused=False), "rear": Received()}, told, 6) == []
    assert refusals.words == {"rear": NO_PLACE}
    assert refusals.update(both, told, 7) == [f"front: refused by the vehicle: {NO_PLACE}"]  # once more


def test_a_vehicle_that_does_not_say_why_is_explained_by_the_status_alone():
    refusals = Refusals("bert")
    front = {"front": Received()}
    assert refusals.update(front, {"front": Camera({"carl": NO_PLACE})}, 0) == []
    assert refusals.update(front, {}, EXPLAINED_S) == [f"front: refused by the vehicle: {UNEXPLAINED}"]
    assert refusals.update(front, {}, 9) == []
