"""Operator inputs as topics and services, without ROS: the event that each requests."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest

from runner.configuration.config import configuration
from runner.core.events import parse
from runner.core.view import Seen, View
from runner.ros.inputs import input_services, input_topics, ros_name
from runner.ros.pictures import DecodedPictures

VEHICLE = configuration(["vehicle=delivery_robot"]).vehicle()
TOPICS, SERVICES = input_topics(VEHICLE), input_services(VEHICLE)
REGION = {"x": 8, "y": 16, "width": 640, "height": 360}
WHOLE = {"x": 0, "y": 0, "width": 1280, "height": 720}


@pytest.mark.parametrize(
    ("name", "values", "event"),
    [
        ("~/total_kbps", {"number": 2500.5}, {"event": "total_set", "kbps": 2500.5}),
        ("~/camera/front/kbps", {"number": 700.0}, {"event": "camera_configured", "camera": "front", "kbps": 700}),
        ("~/camera/rear/scaling", {"number": 0.5}, {"event": "camera_configured", "camera": "rear", "scaling": 0.5}),
        ("~/camera/front/roi", REGION, {"event": "roi_set", "camera": "front", **REGION}),
        ("~/camera/front/roi", dict.fromkeys(REGION, 0), {"event": "roi_set", "camera": "front", **WHOLE}),
        ("~/mode/single", {"value": None}, {"event": "mode_selected", "mode": "single"}),
        ("~/mode/collective", {"value": None}, {"event": "mode_selected", "mode": "collective"}),
        ("~/camera/mast/switch", {"value": False}, {"event": "camera_switched", "camera": "mast", "on": False}),
    ],
)
def test_events_that_inputs_request(name, values, event):
    found = (TOPICS | SERVICES)[name].event(values)
    assert found == event
    assert parse(json.loads(json.dumps({"t": 0, **found}))).t == 0


def test_there_is_one_of_each_for_every_camera():
    assert len(TOPICS) == 1 + 3 * 3
    assert len(SERVICES) == 3 + 3
    assert [ros_name(name) for name in ("front-left", "360")] == ["front_left", "_360"]


def test_a_number_must_be_finite():
    for number in (float("nan"), float("inf")):
        with pytest.raises(ValueError, match=f"{number}: must be a number"):
            TOPICS["~/total_kbps"].event({"number": number})


def test_a_display_that_shows_the_impossible_is_named_once() -> None:
    setup = replace(configuration(["vehicle=delivery_robot"]).setup(), insecure=True)
    reports: list[str] = []
    views: list[View] = []
    shown = DecodedPictures(setup, reports.append, lambda view, _for_s: views.append(view))
    size = {"screen_width": 640, "screen_height": 360}
    wrong = {"topic": "~/camera/front/seen", "x": 1000, "y": 0, "width": 1000, "height": 720, **size}
    for _ in range(1000):
        shown._on_message(wrong, 0)
    rule = "must lie inside the image of 1280x720 px; it counts as seen in full"
    assert reports == [f"front: ~/camera/front/seen: {rule}"]
    assert views[-1] == {}
    shown._on_message({**wrong, "x": 0}, 0)
    assert views[-1] == {"front": Seen(0, 0, 1000, 720, 640, 360)}
