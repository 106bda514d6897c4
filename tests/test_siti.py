"""SI and TI: definition, exact values, against scipy."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

pytest.importorskip("cv2")

from runner.rate_quality.siti import SiTi, spatial, temporal


def noise(seed: int, height: int = 36, width: int = 50) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (height, width), dtype=np.uint8)


@settings(max_examples=20)
@given(st.integers(0, 2**32 - 1), st.integers(3, 40), st.integers(3, 40))
def test_definition(seed: int, height: int, width: int) -> None:
    ndimage = pytest.importorskip("scipy.ndimage")
    before, luma = noise(seed, height, width), noise(seed + 1, height, width)
    across, down = (ndimage.sobel(luma.astype(float), axis)[1:-1, 1:-1] for axis in (1, 0))
    assert spatial(luma) == pytest.approx(np.hypot(across, down).std(), rel=1e-6, abs=1e-4)
    assert temporal(before, luma) == pytest.approx((luma.astype(float) - before).std(), rel=1e-12, abs=1e-9)


def test_exact_values() -> None:
    ramp = np.tile(np.arange(0, 200, 2, dtype=np.uint8), (20, 1))
    assert spatial(ramp) == 0  # the same slope, 16, everywhere
    edge = np.zeros((6, 6), np.uint8)
    edge[:, 3:] = 10
    assert spatial(edge) == 20  # 0, 40, 40, 0 in each row
    assert temporal(ramp, ramp + 7) == 0  # a change of brightness is no motion
    assert temporal(edge, 0 * edge) == temporal(0 * edge, edge) == 5


def test_clip() -> None:
    frames = [noise(i) for i in range(4)]
    found = SiTi()
    for frame in frames:
        found.add(frame)
    assert found.si == [spatial(frame) for frame in frames]
    assert found.ti == [temporal(*pair) for pair in pairwise(frames)]
    assert (found.si_max, found.ti_max) == (max(found.si), max(found.ti))
    assert (found.si_mean, found.ti_mean) == (pytest.approx(np.mean(found.si)), pytest.approx(np.mean(found.ti)))


def test_too_few_frames() -> None:
    none, one = SiTi(), SiTi()
    assert (none.si_max, none.si_mean, none.ti_max, none.ti_mean) == (0, 0, 0, 0)
    one.add(noise(0))
    assert (one.si_max, one.ti_max, one.ti_mean) == (spatial(noise(0)), 0, 0)
