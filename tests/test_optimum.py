"""The best static allocation on the screen, by the cameras' own models."""

from dataclasses import replace

import pytest
from helpers import vehicle

from runner.core.hull import Curve
from runner.core.model import Camera
from runner.core.view import NOWHERE, Seen
from runner.drive.optimum import static_optimum

STEEP, FLAT = Curve((500.0, 1000.0), (0.8, 0.9)), Curve((500.0, 1000.0), (0.8, 0.81))


def cameras() -> dict[str, Camera]:
    found = {name: vehicle().cameras[name] for name in ("front_left", "front_right")}
    curves = {"front_left": STEEP, "front_right": FLAT}
    return {name: replace(c, rate_quality=replace(c.rate_quality, quality=curves[name])) for name, c in found.items()}


def full(camera: Camera) -> Seen:
    return Seen(0, 0, camera.width, camera.height, camera.width, camera.height)


def test_the_steepest_curve_gets_what_is_left() -> None:
    view = {name: full(camera) for name, camera in cameras().items()}
    found = static_optimum(cameras(), view, 1500)
    assert found is not None
    assert found.cameras == pytest.approx({"front_left": 0.9, "front_right": 0.8})
    assert found.mssim == pytest.approx(0.85)


def test_a_camera_that_is_not_on_the_screen_gets_nothing() -> None:
    found = static_optimum(cameras(), {"front_left": NOWHERE}, 500)
    assert found is not None
    assert found.cameras == pytest.approx({"front_right": 0.8})


def test_without_measured_quality_there_is_none() -> None:
    plain = {name: replace(c, rate_quality=replace(c.rate_quality, quality=None)) for name, c in cameras().items()}
    view = {name: full(camera) for name, camera in cameras().items()}
    assert static_optimum(plain, view, 1000) is None
    of_vmaf = Curve((500.0,), (80.0,))
    other = {name: replace(c, rate_quality=replace(c.rate_quality, quality=of_vmaf)) for name, c in cameras().items()}
    assert static_optimum(other, view, 1000) is None
