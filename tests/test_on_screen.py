"""Pictures at the pixels of a screen: the kernels that enlarge them, and what is black."""

from __future__ import annotations

import numpy as np
import pytest

from runner.core.model import Roi
from runner.core.view import Seen
from runner.rate_quality.screen import Kernel, on_screen

pytest.importorskip("cv2")
FULL = Roi(0, 0, 64, 36)


def seen(x: int, y: int, width: int, height: int, times: int) -> Seen:
    return Seen(x, y, width, height, width * times, height * times)


@pytest.mark.parametrize("kernel", ["linear", "cubic"])
def test_a_ramp_stays_a_ramp_in_its_place(kernel: Kernel) -> None:
    """Both kernels reproduce straight lines, but at the rim."""
    luma = np.tile(np.arange(32, dtype=np.uint8) * 4, (18, 1))
    shown = on_screen(luma, FULL, seen(0, 0, 64, 36, 3), kernel)
    assert shown.shape == (108, 192)
    expected = 4 * ((np.arange(192) + 0.5) / 6 - 0.5)
    assert np.abs(shown[50, 12:-12] - expected[12:-12]).max() <= 1


def test_the_cubic_kernel_keeps_an_edge_sharper_and_overshoots_by_its_share() -> None:
    luma = np.full((18, 32), 100, np.uint8)
    luma[:, 16:] = 200
    linear, cubic = (
        on_screen(luma, FULL, seen(0, 0, 64, 36, 2), kernel)[30].astype(int) for kernel in ("linear", "cubic")
    )
    assert linear.min() == 100 and cubic.min() == 93  # -9/128 of the step, 1/8 px from a px
    assert np.abs(np.diff(cubic)).max() > np.abs(np.diff(linear)).max()


@pytest.mark.parametrize("kernel", ["linear", "cubic"])
def test_what_was_not_sent_is_black(kernel: Kernel) -> None:
    luma = np.full((18, 32), 200, np.uint8)
    shown = on_screen(luma, Roi(32, 0, 32, 18), seen(0, 0, 64, 36, 2), kernel)
    assert (shown[2:-40, 66:-2] == 200).all()
    assert (shown[:, :62] == 0).all() and (shown[40:] == 0).all()
