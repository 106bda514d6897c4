"""Commands are the difference between the decision and earlier commands."""

from __future__ import annotations

from dataclasses import replace

from helpers import Drive

from runner.core.commands import Command, after, difference, wanted
from runner.core.model import Roi

DRIVE = Drive("modes=paper", "vehicle=delivery_robot")
DECISION = DRIVE.run.decision
FRONT = DECISION.settings["front"]
WANTED = {"sending": True, "roi": FRONT.roi, "size": (FRONT.width, FRONT.height), "bitrate": FRONT.kbps}


def test_a_camera_that_sends_has_four_knobs() -> None:
    assert wanted(FRONT) == WANTED


def test_while_nothing_is_sent_the_other_knobs_stay() -> None:
    assert wanted(replace(FRONT, sending=False, kbps=0)) == {"sending": False}


def test_only_differences_are_commanded() -> None:
    first = difference(DECISION, {})
    assert [(c.camera, c.knob) for c in first] == [
        (camera, knob) for camera in ("front", "rear", "mast") for knob in ("sending", "roi", "size", "bitrate")
    ]
    commanded = after({}, first)
    assert difference(DECISION, commanded) == []
    changed = replace(DECISION, settings={**DECISION.settings, "front": replace(FRONT, kbps=1)})
    assert difference(changed, commanded) == [Command("front", "bitrate", 1)]


def test_earlier_commands_are_left_unchanged() -> None:
    commanded = after({}, difference(DECISION, {}))
    later = after(commanded, [Command("front", "bitrate", 1)])
    assert commanded["front"]["bitrate"] == FRONT.kbps
    assert later["front"] == WANTED | {"bitrate": 1}
    assert after(commanded, []) is commanded


def test_as_json() -> None:
    def value(knob: str, value: object) -> object:
        return Command("front", knob, value).to_json()["value"]  # type: ignore[arg-type]

    assert value("roi", Roi(1, 2, 30, 40)) == {"x": 1, "y": 2, "width": 30, "height": 40}
    assert value("size", (480, 260)) == {"width": 480, "height": 260}
    assert value("sending", False) is False
    assert Command("front", "bitrate", 545).to_json() == {"camera": "front", "knob": "bitrate", "value": 545}
