"""How events change the state, and the reasons for refusals."""

from __future__ import annotations

from fractions import Fraction
from typing import Any

import pytest
from helpers import Drive

from runner.core.model import Mode, Roi

CAMERAS = "front_left, front_center, front_right, rear_center, top_front, top_left, top_right, top_rear"
LEFT = {"camera": "front_left"}
ROI = {"x": 0, "y": 0, "width": 960, "height": 520}


def test_at_the_start_every_camera_is_on_with_its_full_image() -> None:
    drive = Drive("modes=paper")
    for name, camera in drive.vehicle.cameras.items():
        assert drive[name].on and drive[name].sending
        assert drive[name].roi == Roi(0, 0, camera.width, camera.height)
        assert drive[name].demand == camera.rate_quality.b_full


@pytest.mark.parametrize("mode", list(Mode))
def test_cameras_may_be_switched_in_every_mode(mode: Mode) -> None:
    drive = Drive("modes=paper", f"mode={mode}")
    drive.accept("camera_switched", **LEFT, on=False)
    off = drive["front_left"]
    assert (off.on, off.sending, off.demand, off.kbps) == (False, False, 0, 0)
    assert (off.scaling, off.width, off.height) == (None, 0, 0)
    assert off.reason == "switched off"
    drive.accept("camera_switched", **LEFT, on=True)
    assert drive.sent("front_left") == (545, 0.25)


@pytest.mark.parametrize("modes", ["paper", "safe"])
@pytest.mark.parametrize("mode", list(Mode))
def test_a_camera_that_is_lost_is_off_to_the_rules_until_it_is_found(mode: Mode, modes: str) -> None:
    drive = Drive(f"modes={modes}", f"mode={mode}")
    before = drive.sent("front_left")
    drive.accept("source_reported", **LEFT, works=False, reason="no such device")
    lost = drive["front_left"]
    assert (lost.on, lost.sending, lost.demand, lost.kbps, lost.scaling) == (True, False, 0, 0, None)
    assert lost.reason == "lost: no such device"
    drive.accept("mode_selected", mode="single")  # which keeps the settings of all cameras, also of this one
    drive.accept("mode_selected", mode=str(mode))
    drive.accept("camera_switched", **LEFT, on=False)
    assert drive["front_left"].reason == "switched off"
    drive.accept("camera_switched", **LEFT, on=True)
    assert drive["front_left"].reason == "lost: no such device"
    drive.accept("source_reported", **LEFT, works=True)
    kbps, factor = drive.sent("front_left")
    assert (kbps, factor) == (pytest.approx(before[0], abs=1), before[1])  # S keeps whole kbit/s


def test_the_others_get_the_share_of_a_camera_that_is_lost() -> None:
    drive = Drive("modes=paper")
    drive.accept("bitrate_predicted", kbps=3000)
    everyone = {name: drive[name] for name in drive.vehicle.cameras}
    drive.accept("source_reported", **LEFT, works=False, reason="no such device")
    demand = sum(setting.demand for setting in everyone.values())
    left = demand - everyone["front_left"].demand
    for name, setting in everyone.items():
        share = 0 if name == "front_left" else int(setting.demand * 3000 / left)
        assert drive[name].kbps == share
    assert drive.total == 3000


REFUSED: list[tuple[str, str, dict[str, Any], str]] = [
    ("automatic", "roi_set", LEFT | ROI, "roi_set is accepted in mode single only, the mode is automatic"),
    (
        "collective",
        "roi_set",
        {"camera": "x", **ROI},
        "roi_set is accepted in mode single only, the mode is collective",
    ),
    ("collective", "roi_set", LEFT | ROI, "roi_set is accepted in mode single only, the mode is collective"),
    (
        "automatic",
        "camera_configured",
        LEFT | {"kbps": 800},
        "camera_configured is accepted in mode single only, the mode is automatic",
    ),
    ("automatic", "total_set", {"kbps": 1}, "total_set is accepted in mode collective only, the mode is automatic"),
    ("single", "total_set", {"kbps": 1}, "total_set is accepted in mode collective only, the mode is single"),
    (
        "automatic",
        "camera_switched",
        {"camera": "front_lfet", "on": False},
        "unknown camera 'front_lfet', did you mean front_left?",
    ),
    ("single", "roi_set", {"camera": "x", **ROI}, f"unknown camera 'x'; expected one of {CAMERAS}"),
    ("single", "camera_configured", {"camera": "x", "kbps": 1}, f"unknown camera 'x'; expected one of {CAMERAS}"),
    (
        "automatic",
        "weights_set",
        {"weights": {"top_left": 2, "x": 1}},
        f"unknown camera 'x'; expected one of {CAMERAS}",
    ),
    (
        "single",
        "roi_set",
        LEFT | ROI | {"x": 961},
        "ROI 960x520 at 961,0 leaves the 1920x1040 image of front_left",
    ),
    (
        "single",
        "roi_set",
        LEFT | ROI | {"y": 521},
        "ROI 960x520 at 0,521 leaves the 1920x1040 image of front_left",
    ),
    ("single", "roi_set", LEFT | ROI | {"width": 15}, "ROI 15x520 at 0,0 is smaller than 16x16"),
    ("single", "roi_set", LEFT | ROI | {"height": 0}, "ROI 960x0 at 0,0 is smaller than 16x16"),
    (
        "single",
        "camera_configured",
        LEFT | {"kbps": 6000.5},
        "6000.5 kbit/s for front_left is outside 1 to 6000, its b_full",
    ),
    ("single", "camera_configured", LEFT | {"kbps": 0}, "0 kbit/s for front_left is outside 1 to 6000, its b_full"),
    (
        "single",
        "camera_configured",
        LEFT | {"kbps": 0.99},
        "0.99 kbit/s for front_left is outside 1 to 6000, its b_full",
    ),
    ("single", "camera_configured", LEFT | {"scaling": 0}, "scaling 0 for front_left is outside ]0, 1]"),
    ("single", "camera_configured", LEFT | {"scaling": 1.001}, "scaling 1.001 for front_left is outside ]0, 1]"),
    (
        "single",
        "camera_configured",
        LEFT | {"kbps": 800, "scaling": 2},
        "scaling 2 for front_left is outside ]0, 1]",
    ),
]


@pytest.mark.parametrize("mode, event, keys, reason", REFUSED)
def test_refused(mode: str, event: str, keys: dict[str, Any], reason: str) -> None:
    drive = Drive("modes=paper", f"mode={mode}")
    before = drive.feed("clock_advanced", t=1)
    after = drive.feed(event, t=2, **keys)
    assert after.refused == reason
    assert after.commands == ()
    assert after.decision == before.decision
    assert after.state.t == 2  # a refused event advances the time, too
    drive.accept("clock_advanced", t=2)
    assert drive.run.state == after.state


@pytest.mark.parametrize(
    "keys, expected",
    [
        ({"kbps": 800}, (800, 0.25)),
        ({"scaling": 0.9}, (545, 0.9)),  # any factor, not only those of the model
        ({"kbps": 1, "scaling": 1}, (1, 1.0)),
        ({"kbps": 6000}, (6000, 0.25)),
        ({"kbps": 99.9}, (99, 0.25)),
    ],
)
def test_mode_single_accepts_either_setting_or_both(keys: dict[str, float], expected: tuple[int, float]) -> None:
    drive = Drive("modes=paper", "mode=single")
    drive.accept("camera_configured", **LEFT, **keys)
    assert drive.sent("front_left") == expected
    assert drive.sent("front_right") == (545, 0.25)


def test_an_roi_on_the_edge_is_accepted() -> None:
    drive = Drive("modes=paper", "mode=single")
    drive.accept("roi_set", **LEFT, x=1904, y=1024, width=16, height=16)
    assert drive["front_left"].roi == Roi(1904, 1024, 16, 16)


def test_rois_stay_in_automatic_and_collective() -> None:
    drive = Drive("modes=paper", "mode=single")
    drive.accept("roi_set", **LEFT, **ROI)
    for mode in ("automatic", "collective", "single"):
        drive.accept("mode_selected", mode=mode)
        assert drive["front_left"].roi == Roi(0, 0, 960, 520)
        assert drive["front_left"].demand == 1500


def test_the_full_image_can_be_had_back_in_every_mode() -> None:
    for mode in ("automatic", "collective", "single"):
        drive = Drive("modes=paper", "mode=single")
        drive.accept("roi_set", **LEFT, **ROI)
        drive.accept("mode_selected", mode=mode)
        drive.accept("roi_set", **LEFT, x=0, y=0, width=1920, height=1040)
        assert drive["front_left"].roi == Roi(0, 0, 1920, 1040)
        assert drive["front_left"].demand == 6000


def test_changes_while_off_apply_when_switched_on_again() -> None:
    drive = Drive("modes=paper", "mode=single")
    drive.accept("camera_switched", **LEFT, on=False)
    drive.accept("roi_set", **LEFT, **ROI)
    drive.accept("camera_configured", **LEFT, kbps=700)
    drive.accept("camera_switched", **LEFT, on=True)
    assert drive.sent("front_left") == (700, 0.25)
    assert drive["front_left"].demand == Fraction(1500)
