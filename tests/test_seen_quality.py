"""Scores of pictures half a second apart, as they are on the screen."""

from fractions import Fraction

import numpy as np
import pytest

from runner.core.model import Roi
from runner.core.view import Seen
from runner.drive.seen_quality import _Meters
from runner.drive.videos import Picture
from runner.errors import RunError
from runner.rate_quality.metrics import Luma, find_metric

cv2 = pytest.importorskip("cv2")

FULL, SEEN = Roi(0, 0, 320, 180), Seen(0, 0, 320, 180, 320, 180)
FPS, STEP_PX = Fraction(10), 3


def moving(count: int) -> list[Luma]:
    """A texture that slides."""
    noise = np.random.default_rng(1).uniform(0, 255, (180, 320 + STEP_PX * count)).astype(np.float32)
    texture = cv2.normalize(cv2.GaussianBlur(noise, None, 2), None, 20, 235, cv2.NORM_MINMAX).astype(np.uint8)
    return [np.ascontiguousarray(texture[:, STEP_PX * n : STEP_PX * n + 320]) for n in range(count)]


def test_sampled_pictures_score_as_in_the_whole_video() -> None:
    """VMAF compares neighbours: without the picture before each, the scene would seem to move ten times as fast."""
    try:
        vmaf = find_metric("vmaf")
    except RunError as error:
        pytest.skip(str(error))
    scenes = moving(24)
    shown = [cv2.GaussianBlur(scene, None, 1.5) for scene in scenes]
    whole = vmaf.meter((320, 180), FPS)
    for number, (scene, picture) in enumerate(zip(scenes, shown, strict=True)):
        whole.add(number, scene, picture)
    expected = whole.close()
    captures = [5, 10, 15, 20]
    meters = _Meters(
        [vmaf], "linear", FPS, {(n, SEEN) for n in captures}, {n: [SEEN] for c in captures for n in (c - 1, c)}
    )
    for captured in meters.by_capture:
        meters.add(captured, Picture(scenes[captured], FULL), Picture(shown[captured], FULL))
    meters.close()
    found = meters.scores["vmaf"]
    assert found == pytest.approx({(n, SEEN): expected[n] for n in captures}, abs=0.2)


def test_of_each_size_pictures_are_scored_by_a_meter_of_their_own() -> None:
    small = Seen(80, 45, 160, 90, 80, 45)
    (scene,) = moving(1)
    scored = {(0, SEEN), (0, small), (1, small)}
    meters = _Meters([find_metric("mssim")], "linear", FPS, scored, {0: [SEEN, small], 1: [small]})
    part = Picture(np.ascontiguousarray(scene[45:135, 80:240]), small.roi)
    for captured in (0, 1):
        meters.add(captured, Picture(scene, FULL), part)
    meters.close()
    found = meters.scores["mssim"]
    assert found.keys() == scored
    assert found[0, small] == found[1, small] > 0.99
    assert found[0, SEEN] < 0.6, "what was not sent is black"
