"""The vocabulary: JSON and back, and messages about lines that are no events."""

from __future__ import annotations

import json
from fractions import Fraction
from typing import Any

import pytest

from runner.core.events import EVENTS, BitratePredicted, CameraConfigured, Evidence, RoiSet, WeightsSet, parse, to_json
from runner.core.model import Roi
from runner.drive.read import read_line
from runner.schema import event_names, event_problem

LINK = {"event": "link_measured", "kbps": 780, "queue_ms": 12.5, "loss": 0.01, "state": "filling", "rtt_ms": 48}
LINK["evidence"] = Evidence(silent_s=0.2)._asdict()
EXAMPLES: list[dict[str, Any]] = [
    {"t": 0.0, "event": "mode_selected", "mode": "automatic"},
    {"t": 0.1, "event": "bitrate_predicted", "kbps": 3000},
    {"t": 0.1, "event": "bitrate_predicted", "kbps": 3000.5, "lower_kbps": 100, "valid_s": 2},
    {"t": 0.1, "event": "bitrate_predicted", "kbps": 3000, "bias": 0.2, "error": 0.1},
    {"t": 0.2, "event": "position_reported", "lat": 48.26, "lon": 11.66, "speed_mps": 8.3, "heading_deg": 90},
    {"t": 0.2, "event": "position_reported", "lat": -90, "lon": -180},
    {"t": 0.2, "event": "steering_reported", "rad": -0.35},
    {"t": 0.2, "event": "steering_reported", "rad": -0.35, "gear": "R"},
    {"t": 0.3, "event": "total_set", "kbps": 4000},
    {"t": 0.4, "event": "camera_switched", "camera": "rear_center", "on": False},
    {"t": 0.5, "event": "roi_set", "camera": "front_left", "x": 0, "y": 0, "width": 960, "height": 520},
    {"t": 0.6, "event": "camera_configured", "camera": "front_left", "kbps": 800, "scaling": 0.25},
    {"t": 0.6, "event": "camera_configured", "camera": "front_left", "scaling": 0.25},
    {"t": 0.7, "event": "weights_set", "weights": {"front_left": 2.5}},
    {"t": 0.7, "event": "moment_marked", "back_s": 10},
    {"t": 0.8, **LINK},
    {"t": 0.8, "event": "copies_counted", "copies": {"front_left": 2}},
    {"t": 0.8, "event": "stream_measured", "camera": "front_left", "kbps": 3140},
    {"t": 0.8, "event": "source_reported", "camera": "front_left", "works": False, "reason": "no such device"},
    {"t": 0.8, "event": "control_passed", "operator": "me"},
    {"t": 0.8, "event": "control_requested", "operator": "me"},
    {"t": 0.8, "event": "control_offered", "operator": "me", "to": "you"},
    {"t": 0.8, "event": "control_offered", "operator": "me", "to": ""},
    {"t": 0.8, "event": "control_accepted", "operator": "you", "live": ["front_left", "rear_center"]},
    {"t": 0.8, "event": "control_denied", "operator": "me", "to": "you"},
    {"t": 0.8, "event": "control_released", "operator": "you"},
    {"t": 0.8, "event": "control_taken", "operator": "you"},
    {"t": 0.8, "event": "stop_requested", "operator": "you"},
    {"t": 0.8, "event": "stop_lifted", "operator": "me"},
    {"t": 0.8, "event": "control_restored", "operator": "you"},
    {"t": 0.8, "event": "control_restored", "operator": "", "stop": "you"},
    {"t": 0.8, "event": "attention_changed", "attention": "hidden"},
    {"t": 0.8, "event": "attention_changed"},
    {
        "t": 0.8,
        "event": "view_reported",
        "view": {
            "front_left": {"x": 8, "y": 0, "width": 640, "height": 360, "screen_width": 320, "screen_height": 180}
        },
    },
    {"t": 0.9, "event": "operator_connected"},
    {"t": 0.9, "event": "operator_connected", "attention": "watching"},
    {"t": 0.9, "event": "operator_connected", "operator": "me", "role": "controller"},
    {"t": 0.9, "event": "operator_disconnected"},
    {"t": 0.9, "event": "operator_disconnected", "operator": "me", "departure": "signed off"},
    {"t": 0.9, "event": "clock_advanced"},
]
KNOWN = ", ".join([*event_names()[:13], "..."])


@pytest.mark.parametrize("document", EXAMPLES)
def test_events_survive_a_round_trip_through_json(document: dict[str, Any]) -> None:
    assert event_problem(document) is None
    assert to_json(parse(document)) == document
    assert parse(json.loads(json.dumps(to_json(parse(document))))) == parse(document)


def test_there_is_an_example_of_every_event() -> None:
    assert {document["event"] for document in EXAMPLES} == set(EVENTS) == set(event_names())


def test_numbers_are_exact() -> None:
    predicted = parse({"t": 0, "event": "bitrate_predicted", "kbps": 0.1})
    assert isinstance(predicted, BitratePredicted) and predicted.kbps == Fraction(1, 10)
    configured = parse({"t": 0, "event": "camera_configured", "camera": "a", "scaling": 0.3})
    assert isinstance(configured, CameraConfigured) and configured.scaling == Fraction(3, 10)
    weighted = parse({"t": 0, "event": "weights_set", "weights": {"a": 1e-3}})
    assert isinstance(weighted, WeightsSet) and weighted.weights == {"a": Fraction(1, 1000)}
    cut = parse({"t": 0, "event": "roi_set", "camera": "a", "x": 1.0, "y": 2, "width": 16, "height": 16})
    assert isinstance(cut, RoiSet) and cut.roi == Roi(1, 2, 16, 16)


def clock(**keys: Any) -> dict[str, Any]:
    return {"t": 0, "event": "clock_advanced"} | keys


def predicted(**keys: Any) -> dict[str, Any]:
    return {"t": 0, "event": "bitrate_predicted"} | keys


def roi(**keys: Any) -> dict[str, Any]:
    return {"t": 0, "event": "roi_set", "camera": "a", "x": 0, "y": 0, "width": 16, "height": 16} | keys


@pytest.mark.parametrize(
    "document, problem",
    [
        ([], "[]: must be a mapping with t and event"),
        (None, "null: must be a mapping with t and event"),
        ("a", "'a': must be a mapping with t and event"),
        ({}, "event: missing: must be given"),
        ({"t": 0}, "event: missing: must be given"),
        ({"event": "clock_advanced"}, "t: missing: must be given"),
        (clock(event=3), f"event: 3: unknown event; expected one of {KNOWN}"),
        (clock(event="t"), f"event: 't': unknown event; expected one of {KNOWN}"),
        (clock(event="clock_advancd"), "event: 'clock_advancd': unknown event, did you mean clock_advanced?"),
        (clock(t=-0.1), "t: -0.1: must be at least 0"),
        (clock(t="0"), "t: '0': must be a number"),
        (clock(t=True), "t: true: must be a number"),
        (clock(t=None), "t: null: must be a number"),
        (clock(x=1), "x: unknown key; expected one of t, event"),
        (clock(id=1), "id: unknown key; expected one of t, event"),
        (clock(log="decision"), "log: unknown key; expected one of t, event"),
        (predicted(), "kbps: missing: must be given"),
        (predicted(kpbs=1), "kpbs: unknown key, did you mean kbps?"),
        (predicted(kbps=-1), "kbps: -1: must be at least 0"),
        (predicted(kbps="3000"), "kbps: '3000': must be a number"),
        (predicted(kbps=True), "kbps: true: must be a number"),
        (predicted(kbps=1, valid_s=-1), "valid_s: -1: must be at least 0"),
        (predicted(kbps=-1, lower_kbps=-2), "kbps: -1: must be at least 0; lower_kbps: -2: must be at least 0"),
        (roi(x=0.5), "x: 0.5: must be a whole number"),
        (roi(y=-1), "y: -1: must be at least 0"),
        (roi(width="16"), "width: '16': must be a whole number"),
        (roi(camera=""), "camera: '': must not be empty"),
        (roi(camera=3), "camera: 3: must be text"),
        (
            clock(event="mode_selected", mode="auto"),
            "mode: 'auto': must be one of single, automatic, collective, did you mean automatic?",
        ),
        (clock(event="camera_switched", camera="a", on=1), "on: 1: must be true or false"),
        (clock(event="weights_set", weights={}), "weights: {}: must not be empty"),
        (clock(event="weights_set", weights={"a": -1}), "weights.a: -1: must be at least 0"),
        (clock(event="weights_set", weights={"a": "1"}), "weights.a: '1': must be a number"),
        (LINK | {"t": 0, "loss": 1.1}, "loss: 1.1: must be at most 1"),
        (clock(event="position_reported", lat=91, lon=0), "lat: 91: must be at most 90"),
        (clock(event="position_reported", lat=0, lon=-181), "lon: -181: must be at least -180"),
        (clock(event="steering_reported", rad=90), "rad: 90: must be at most 1.5"),
    ],
)
def test_an_invalid_event_is_refused(document: Any, problem: str) -> None:
    assert event_problem(document) == problem


@pytest.mark.parametrize(
    "line, problem",
    [
        ("no", "not JSON: Expecting value (column 1)"),
        ("", "not JSON: Expecting value (column 1)"),
        ('{"t": 0} {"t": 1}', "not JSON: Extra data (column 10)"),
        ('{"t": 0, "event"', "not JSON: Expecting ':' delimiter (column 17)"),
        ('{"t": NaN, "event": "clock_advanced"}', "not JSON: NaN is not a number"),
        ('{"t": -Infinity, "event": "clock_advanced"}', "not JSON: -Infinity is not a number"),
        ('{"t": 1e999, "event": "clock_advanced"}', "not JSON: 1e999 is too large"),
        ('{"t": 1' + "0" * 400 + ', "event": "clock_advanced"}', "not JSON: 10000000000000000000... is too large"),
        ("[" * 100_000, "not JSON: nested too deeply"),
    ],
)
def test_invalid_json_is_refused(line: str, problem: str) -> None:
    assert read_line(line)[1] == problem
