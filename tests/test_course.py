"""The vehicle of the synthetic drive is steered so that it follows the lane that its pictures show."""

from __future__ import annotations

import math
import shutil
from dataclasses import asdict
from typing import Any

import pytest
from painted import CAR
from test_projection import node

from runner.configuration.config import configuration
from runner.plans import drive_steering

np = pytest.importorskip("numpy")

SECONDS = 12.0
WHEEL_PATHS = """
import { readFileSync } from "node:fs";
import { pathGuides } from "./guides.js";
const { dimensions, angles } = JSON.parse(readFileSync(0, "utf8"));
console.log(JSON.stringify(angles.map((rad) => pathGuides(dimensions, rad).slice(0, 2).map(({ places }) => places))));
"""


def course() -> Any:
    from runner.synthetic.course import plan_course

    return plan_course(SECONDS)


def seen_from(start: tuple[float, float, float], place: complex) -> complex:
    """A place of the world in the axes of a vehicle at a position and heading."""
    x, y, heading = start
    return (place - complex(x, y)) * complex(math.cos(heading), -math.sin(heading))


@pytest.mark.parametrize("seconds", [4.0, 12.0, 30.0])
def test_a_bicycle_steered_that_way_stays_on_the_lane(seconds: float) -> None:
    from runner.synthetic.course import plan_course

    lane, steps = plan_course(seconds), 20_000
    x, y, heading = lane.at(0)
    bends = []
    for step in range(steps // lane.laps):
        at, after = (complex(*lane.at(each / steps)[:2]) for each in (step, step + 1))
        if step + 1 == steps // lane.laps:
            break  # the next lap is elsewhere
        angle = lane.steering((step + 0.5) / steps, CAR.wheelbase_m)
        travelled = abs(after - at)
        turned = travelled * math.tan(angle) / CAR.wheelbase_m
        x, y = x + travelled * math.cos(heading + turned / 2), y + travelled * math.sin(heading + turned / 2)
        heading += turned
        bends.append(angle)
        assert abs(complex(x, y) - after) < 0.02, f"after {step / steps:.1%}"
    assert min(bends) < -0.05 and max(bends) > 0.05, "to both sides"


@pytest.mark.skipif(not shutil.which("node"), reason="needs Node.js")
def test_the_page_draws_the_path_of_the_wheels_along_the_lane_in_a_bend() -> None:
    lane = course()
    shares = np.arange(0.4, 0.6, 0.005)  # in the middle of a lap
    angles = [lane.steering(share, CAR.wheelbase_m) for share in shares]
    tight = [k for k, angle in enumerate(angles) if abs(angle) > 0.7 * max(map(abs, angles))]
    assert len(tight) > 5
    drawn = node(WHEEL_PATHS, {"dimensions": asdict(CAR), "angles": [angles[k] for k in tight]})
    for k, (left, right) in zip(tight, drawn, strict=True):
        start = lane.at(shares[k])
        later = [lane.at(shares[k] + travelled / (12 * SECONDS)) for travelled in np.arange(0, 15, 0.1)]
        ahead = [
            [
                seen_from(start, complex(x, y) + complex(CAR.wheelbase_m, side) * np.exp(1j * heading))
                for x, y, heading in later
            ]
            for side in (CAR.track_m / 2, -CAR.track_m / 2)
        ]
        for drawn_wheel, driven in ((left, ahead[0]), (right, ahead[1])):
            near = [
                complex(place["x"], place["y"]) for place in drawn_wheel if place["x"] < CAR.front_m + 5
            ]  # farther away the bend is another one
            apart = max(min(abs(place - each) for each in driven) for place in near)
            assert apart < 0.25, f"{shares[k]:.0%}: {apart:.2f} m"


def test_a_synthetic_drive_is_steered_by_the_clock_that_its_clips_follow() -> None:
    setup = configuration(["vehicle=tum_q7"]).setup()
    steering, lane = drive_steering(setup), course()
    assert steering is not None and setup.dimensions is not None
    for share in (0.0, 0.3, 0.8):
        for rounds in (0, 7):
            angle = steering((rounds + share) * SECONDS)
            assert angle == pytest.approx(lane.steering(share, setup.dimensions.wheelbase_m), abs=1e-6)
    assert drive_steering(configuration(["vehicle=tum_q7", "source=test"]).setup()) is None
