"""The page's projection agrees with that of the synthetic drive, which is written the other way round: pixel to ray."""

from __future__ import annotations

import json
import math
import shutil
import subprocess
from dataclasses import asdict
from fractions import Fraction
from pathlib import Path
from typing import Any

import pytest

from runner.clips import View
from runner.core.mounting import Pose
from runner.resources import directory

pytestmark = [
    pytest.mark.slow,  # loads numba
    pytest.mark.skipif(not shutil.which("node"), reason="needs Node.js"),
]
np = pytest.importorskip("numpy")

STATIC = directory("schemas").parent / "runner" / "page" / "static"
FRONT, TILTED = Pose(2.0, 0.0, 1.5, 0.0, 5.0), Pose(1.9, 0.5, 1.5, 55.0, 5.0, 3.0)
VIEWS = {
    "pinhole": (View(1920, 1040, Fraction(40), FRONT, 90, "pinhole"), (0, 0)),
    "turned, tilted and rolled": (View(1280, 960, Fraction(30), TILTED, 78, "pinhole"), (0, 0)),
    "behind, cropped": (View(1920, 1200, Fraction(30), Pose(-0.9, 0, 1.4, 180, 8), 100, "pinhole"), (16, 120)),
    "fisheye": (View(1280, 800, Fraction(30), Pose(1.8, 1.0, 1.1, 90, 35), 180, "fisheye"), (0, 0)),
    "wide fisheye, cropped": (View(1280, 800, Fraction(30), Pose(3.7, 0, 0.8, 0, 35, -8), 200, "fisheye"), (40, 20)),
}
PROJECT = """
import { readFileSync } from "node:fs";
import { projection } from "./projection.js";
const cases = JSON.parse(readFileSync(0, "utf8"));
console.log(JSON.stringify(cases.map(({ optics, places }) => places.map(projection(optics)))));
"""


DRAW = """
import { readFileSync } from "node:fs";
import { imageOf, straightGuides } from "./guides.js";
import { projection } from "./projection.js";
const { dimensions, cameras } = JSON.parse(readFileSync(0, "utf8"));
const drawn = (optics) =>
  straightGuides(dimensions).map((guide) => ({ ...guide, pieces: imageOf(guide.places, projection(optics)) }));
console.log(JSON.stringify(cameras.map(drawn)));
"""


def node(script: str, asked: Any) -> Any:
    """What a module that imports those of the page prints for a question on its standard input."""
    command = ["node", "--input-type=module", "-e", script]
    text = json.dumps(asked)
    done = subprocess.run(command, cwd=STATIC, input=text, capture_output=True, text=True, timeout=60, check=True)
    return json.loads(done.stdout)


def points_on_the_ground(view: View) -> tuple[Any, Any]:
    """Middles of pixels of the synthetic drive's picture that show ground within 15 m, px, and that ground, m."""
    from runner.synthetic.picture import directions

    rays = directions(view)
    row, column = np.nonzero(rays[..., 2] < -0.05)
    row, column = row[::211], column[::211]
    rays = rays[row, column]
    places = np.array([view.pose.x_m, view.pose.y_m, view.pose.z_m]) - rays * (view.pose.z_m / rays[:, 2:])
    near = np.hypot(places[:, 0], places[:, 1]) < 15
    return np.stack([2 * column + 0.5, 2 * row + 0.5], axis=1)[near], places[near]


def test_the_page_finds_the_pixel_that_the_synthetic_drive_casts_its_ray_from() -> None:
    cases, expected = [], []
    for view, (left, top) in VIEWS.values():
        pixels, places = points_on_the_ground(view)
        assert len(pixels) > 300
        native = {"width": view.width, "height": view.height, "left": left, "top": top}
        optics = {"pose": asdict(view.pose), "fov_deg": view.fov_deg, "lens": view.lens, "native": native}
        cases.append({"optics": optics, "places": [dict(zip("xyz", place, strict=True)) for place in places]})
        expected.append(pixels - (left, top))
    for name, points, pixels in zip(VIEWS, node(PROJECT, cases), expected, strict=True):
        apart = np.abs(np.array([[point["x"], point["y"]] for point in points]) - pixels)
        assert apart.max() < 1e-3, f"{name}: {apart.max()} px"


@pytest.mark.soak  # builds a street; in pictures that the page draws: tests/integration/test_page_stills.py
def test_lines_end_where_marks_on_the_synthetic_ground_are_found(tmp_path: Path) -> None:
    pytest.importorskip("cv2")
    from painted import CAMERAS, CAR, SIZE, WITHIN_PX, ends_of, found, native_pictures, paint

    paint(tmp_path / "world")
    asked = {"dimensions": asdict(CAR), "cameras": [camera.optics for camera in CAMERAS.values()]}
    apart = {}
    drawn = dict(zip(CAMERAS, node(DRAW, asked), strict=True))
    for name, picture in native_pictures(tmp_path / "world"):
        camera, (width, height) = CAMERAS[name], CAMERAS[name].native
        luma = np.frombuffer(picture, np.uint8)[: width * height].reshape(height, width).astype(float)
        full = luma[camera.top : camera.top + SIZE[1]]
        ends = ends_of(drawn[name], camera.ends)
        for key, end in ends.items():
            mark = found(full, end, [other for other in ends.values() if other is not end])
            apart[name, *key] = round(math.dist(mark, end), 2)
    print(apart)
    assert {key: value for key, value in apart.items() if value > WITHIN_PX} == {}
