"""Operator inputs as topics and services, without ROS: the event that each requests."""

from __future__ import annotations

import json

import pytest

from runner.configuration.config import configuration
from runner.core.events import parse
from runner.ros.inputs import input_services, input_topics, ros_name

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
