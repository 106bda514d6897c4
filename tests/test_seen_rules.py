"""Rules that send what is seen: regions, sizes and shares by what the operator in control looks at."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction

import pytest
from helpers import Drive, source_for, vehicle

from runner.core.model import Roi
from runner.core.scaling import output_size
from runner.core.step import start

SEEN = ("modes=seen", "vehicle=delivery_robot", "mode=collective")
QUALITY = (
    "{scaling: [0.25, 0.5, 1], b_min_kbps: [0, 300, 900], b_full_kbps: 3000,"
    " quality: [[100, 0.8], [400, 0.88], [2000, 0.94]]}"
)
MEASURED = tuple(f"cameras.{name}.rate_quality={QUALITY}" for name in ("front", "rear", "mast"))
FULL, NOTHING = Roi(0, 0, 1280, 720), {"x": 0, "y": 0, "width": 0, "height": 0, "screen_width": 0, "screen_height": 0}


def view(x, y, width, height, screen_width, screen_height):
    return dict(zip(NOTHING, (x, y, width, height, screen_width, screen_height), strict=True))


@pytest.fixture
def drive():
    drive = Drive(*SEEN, *MEASURED)
    drive.accept("total_set", kbps=2000)
    drive.accept("attention_changed", attention="watching")
    return drive


def test_everything_is_sent_while_no_view_is_stated(drive):
    assert drive["front"].roi == drive.vehicle.cameras["front"].full_roi
    drive.accept("view_reported", t=1, view={"rear": NOTHING})
    drive.accept("clock_advanced", t=3)
    assert drive["front"].roi == drive.vehicle.cameras["front"].full_roi


def look(drive, t, **views):
    drive.accept("view_reported", t=t, view=views)


def test_a_region_is_what_is_seen_with_a_margin_and_what_is_always_sent(drive):
    camera = drive.vehicle.cameras["front"]
    strip = view(camera.width // 2 - 100, 0, 200, camera.height, 100, camera.height // 2)
    look(drive, 0.1, front=strip)
    drive.accept("clock_advanced", t=2)
    sent = drive["front"].roi
    kept = camera.kept_roi
    assert sent.x <= kept.x and sent.x + sent.width >= kept.x + kept.width < camera.width
    assert (sent.y, sent.height) == (0, camera.height)
    assert sent.x % 16 == sent.width % 16 == 0


def test_a_region_widens_at_once_and_narrows_after_a_second(drive):
    camera = drive.vehicle.cameras["front"]
    everything = view(0, 0, camera.width, camera.height, camera.width, camera.height)
    drive.accept("clock_advanced", t=1)
    look(drive, 1.0, front=NOTHING)
    assert drive["front"].roi == camera.full_roi
    drive.accept("clock_advanced", t=1.9)
    assert drive["front"].roi == camera.full_roi
    drive.accept("clock_advanced", t=2.0)
    assert drive["front"].roi.pixels < camera.full_roi.pixels / 3
    look(drive, 2.1, front=everything)
    assert drive["front"].roi == camera.full_roi


def test_a_view_that_alternates_narrows_nothing(drive):
    camera = drive.vehicle.cameras["front"]
    left = view(0, 0, camera.width // 2, camera.height, 100, 100)
    right = view(camera.width // 2, 0, camera.width // 2, camera.height, 100, 100)
    for tenth in range(1, 60):
        look(drive, tenth / 10, front=left if tenth % 2 else right)
        if tenth > 1:
            assert drive["front"].roi == camera.full_roi


@pytest.mark.parametrize(
    ("attention", "speed_mps", "narrows"),
    [("watching", 9, True), (None, 9, False), (None, None, False), (None, 0.5, True), ("hidden", 0.5, False)],
)
def test_while_driving_nothing_is_taken_from_a_driver_who_is_not_known_to_watch(attention, speed_mps, narrows):
    drive = Drive(*SEEN, *MEASURED)
    if attention:
        drive.accept("attention_changed", attention=attention)
    if speed_mps is not None:
        drive.accept("position_reported", lat=48, lon=11, speed_mps=speed_mps)
    look(drive, 0.5, front=NOTHING)
    drive.accept("clock_advanced", t=5)
    assert (drive["front"].roi != drive.vehicle.cameras["front"].full_roi) is narrows


def test_no_region_leaves_the_operators_own():
    drive = Drive(*SEEN, *MEASURED, "mode=single")
    own = {"x": 32, "y": 16, "width": 200, "height": 100}
    drive.accept("roi_set", camera="front", **own)
    drive.accept("mode_selected", mode="collective")
    drive.accept("attention_changed", attention="watching")
    look(drive, 0.1, front=view(100, 50, 64, 64, 64, 64))
    drive.accept("clock_advanced", t=2)
    assert drive["front"].roi != Roi(**own)
    sent = drive["front"].roi
    assert sent.x >= 32 and sent.y >= 16 and sent.x + sent.width <= 232 and sent.y + sent.height <= 116
    look(drive, 2.1, front=view(400, 300, 64, 64, 64, 64))
    assert drive["front"].roi == Roi(**own), "what is seen lies outside"


def test_no_picture_is_larger_than_the_screen_shows_it():
    drive = Drive(*SEEN, *MEASURED, "cameras.front.least_scaling=0.1")
    camera = drive.vehicle.cameras["front"]
    drive.accept("attention_changed", attention="watching")
    look(drive, 0.1, front=view(0, 0, camera.width, camera.height, camera.width // 5, camera.height // 5))
    drive.accept("clock_advanced", t=2)
    assert drive["front"].scaling == Fraction(7, 16), "twice the next one above a fifth, in steps of 1/32"
    assert "the screen shows no more than" in drive["front"].reason
    look(drive, 2.1, front=NOTHING)
    drive.accept("clock_advanced", t=4)
    assert drive["front"].scaling == Fraction(1, 10)


def test_bits_go_to_what_fills_the_screen():
    drive = Drive(*SEEN, *MEASURED, "modes.collective.share_by_quality.kept=0")
    drive.accept("total_set", kbps=2000)
    drive.accept("attention_changed", attention="watching")
    cameras = drive.vehicle.cameras
    before = drive["front"].kbps
    sizes = {name: (own.width, own.height) for name, own in cameras.items()}
    large = view(0, 0, *sizes["front"], *sizes["front"])
    small = {name: view(0, 0, *sizes[name], sizes[name][0] // 8, sizes[name][1] // 8) for name in ("rear", "mast")}
    look(drive, 0.1, front=large, **small)
    drive.accept("clock_advanced", t=2)
    assert drive["front"].kbps > 1.5 * before
    assert all(drive[name].sending and drive[name].kbps >= 30 for name in small)
    assert sum(drive[name].kbps for name in cameras) <= 2000
    assert "shared by quality" in drive["front"].reason


def test_without_measured_quality_demand_shares_the_total():
    drive = Drive(*SEEN)
    assert "no camera has measured quality: shared by demand" in drive["front"].reason
    drive = Drive(*SEEN, *MEASURED[1:])
    assert "front without measured quality: shared by demand" in drive["rear"].reason


def test_floors_and_weights_hold(drive):
    other = Drive(*SEEN, *MEASURED, "cameras.rear.floor_kbps=700", "cameras.mast.weight=0")
    other.accept("total_set", kbps=1000)
    assert other["rear"].kbps >= 700
    assert other["mast"].kbps == 30, "its floor, and nothing beyond it"
    assert drive["mast"].kbps > 30


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ("cameras.front.rate_quality.quality=[[400, 0.8], [100, 0.9]]", "must be increasing and concave"),
        ("cameras.front.always={x: 1200, y: 0, width: 100, height: 100}", "must lie inside the image"),
    ],
)
def test_mistakes_in_the_configuration_are_named(change, problem):
    with pytest.raises(Exception, match=problem):
        Drive(*SEEN, *MEASURED, change)


def bits(drive, t, kbps):
    drive.accept("total_set", t=t, kbps=kbps)
    return drive["front"].scaling


def test_a_factor_stays_near_the_bounds_of_its_range_and_rises_after_a_while():
    drive = Drive(*SEEN, *MEASURED, "modes.collective.share_by_quality.kept=1")
    assert bits(drive, 0, 3000) == 1
    assert drive["front"].kbps == 1500, "half of it; from 900 on"
    assert bits(drive, 1, 1400) == 1, "700 are within 40 % of the bound"
    assert bits(drive, 2, 1200) == Fraction(1, 2)
    assert bits(drive, 3, 2000) == Fraction(1, 2), "1000 are within 40 %, too"
    assert bits(drive, 10, 6000) == Fraction(1, 2)
    assert "kept at 0.5" in drive["front"].reason
    drive.accept("clock_advanced", t=24.9)
    assert drive["front"].scaling == Fraction(1, 2)
    drive.accept("clock_advanced", t=25)
    assert drive["front"].scaling == 1


def test_pictures_that_do_not_say_what_they_show_are_never_cropped_by_a_view():
    drive = Drive(*SEEN, *MEASURED)
    front = drive.vehicle.cameras["front"]
    silent = replace(front, graph=replace(front.graph, places=False))
    drive.vehicle = replace(drive.vehicle, cameras={**drive.vehicle.cameras, "front": silent})
    drive.run = start(drive.vehicle)
    drive.accept("attention_changed", attention="watching")
    look(drive, 0.1, front=view(0, 0, 64, 64, 64, 64), rear=view(0, 0, 64, 64, 64, 64))
    drive.accept("clock_advanced", t=2)
    cropped = {name for name in drive.vehicle.cameras if drive[name].roi != drive.vehicle.cameras[name].full_roi}
    assert cropped == {"rear"}


@pytest.mark.parametrize(
    ("graph", "places"), [("h264_rtsp", True), ("openh264_rtsp", True), ("h264_srt", True), ("pass_through", False)]
)
def test_graphs_of_h264_say_what_their_pictures_show(graph, places):
    cameras = vehicle("vehicle=delivery_robot", f"graph={graph}", f"source={source_for(graph)}").cameras
    assert {camera.graph.places for camera in cameras.values()} == {places}


def drawn(drive, name="front"):
    setting = drive[name]
    return setting.width, setting.height


@pytest.fixture
def small():
    """A drive with a camera of which a small part is always sent."""
    drive = Drive(*SEEN, *MEASURED, "cameras.front.always={x: 608, y: 328, width: 64, height: 64}")
    drive.accept("total_set", kbps=1200)
    drive.accept("attention_changed", attention="watching")
    return drive


def test_a_pan_ten_times_a_second_moves_the_region_behind_the_same_encoded_size(small):
    seen = view(160, 200, 640, 320, 640, 320)
    look(small, 0.1, front=seen)
    small.accept("clock_advanced", t=10)
    before, regions = drawn(small), set()
    for tenth in range(100):
        seen["x"] = 160 + abs((12 * tenth + 340) % 680 - 340)  # 120 px a second, to and fro
        look(small, 10 + tenth / 10, front=seen)
        sent = small["front"].roi
        assert sent.x <= seen["x"] and seen["x"] + 640 <= sent.x + sent.width
        assert drawn(small) == before
        regions.add(sent)
    assert len(regions) > 10
    assert len({(roi.width, roi.height) for roi in regions}) <= 5, "each other length scales the picture anew"


def test_a_region_zooms_behind_its_encoded_size_and_gets_the_best_one_once_it_rests(small):
    look(small, 0.1, front=view(0, 0, 1280, 720, 1280, 720))
    small.accept("clock_advanced", t=10)
    before, t = drawn(small), 10.0
    for step in range(1, 6):
        t += 1.2
        look(small, t - 0.1, front=view(64 * step, 36 * step, 1280 - 128 * step, 720 - 72 * step, 1280, 720))
        small.accept("clock_advanced", t=t + 0.95)
        assert drawn(small) == before, small["front"].reason
    assert small["front"].roi.width < 800
    for tenth in range(1, 80):
        small.accept("clock_advanced", t=t + 1 + tenth / 10)
    setting = small["front"]
    assert (setting.width, setting.height) == output_size(setting.roi, setting.scaling)


def test_a_size_does_not_stay_where_it_suits_the_region_badly(small):
    look(small, 0.1, front=view(0, 0, 1280, 720, 1280, 720))
    small.accept("clock_advanced", t=10)
    look(small, 10.1, front=NOTHING)
    for tenth in range(2, 15):
        small.accept("clock_advanced", t=10 + tenth / 10)
    setting = small["front"]
    assert (setting.roi.width, setting.roi.height) == (64, 80)
    assert setting.width <= 64 and setting.height <= 80, "no picture is larger than its region"


def test_new_sizes_take_turns_the_front_and_the_largest_first():
    drive = Drive("modes=seen", "vehicle=tum_q7", "mode=collective")
    drive.accept("total_set", kbps=4000)
    drive.accept("attention_changed", attention="watching")
    cameras = drive.vehicle.cameras

    def shown(name, share):
        own = cameras[name]
        return view(0, 0, own.width, own.height, own.width // share, own.height // share)

    look(drive, 0.1, **{name: shown(name, 16) for name in cameras})
    for tenth in range(1, 60):
        drive.accept("clock_advanced", t=0.2 + tenth / 10)
    before = {name: drawn(drive, name) for name in cameras}
    look(drive, 10, **{name: shown(name, 1 if name == "top_rear" else 2) for name in cameras})
    turns = [{name for name in cameras if drawn(drive, name) != before[name]}]
    for fortieth in range(1, 20):
        drive.accept("clock_advanced", t=10 + fortieth / 25)
        changed = {name for name in cameras if drawn(drive, name) != before[name]}
        if changed != turns[-1]:
            turns.append(changed)
            last = drive.run.state.t
    assert turns[0] == {"front_center", "top_rear"}
    assert [len(changed) for changed in turns] == [2, 4, 6, 8]
    assert last <= 10.4


def test_with_a_share_for_the_worst_all_cameras_can_be_switched_off():
    drive = Drive(*SEEN, *MEASURED, "modes.collective.share_by_quality.worst=0.5")
    for name in drive.vehicle.cameras:
        run = drive.accept("camera_switched", camera=name, on=False)
        assert run.fault is None and not drive[name].sending
    for name in drive.vehicle.cameras:
        drive.accept("camera_switched", camera=name, on=True)
    run = drive.accept("weights_set", weights=dict.fromkeys(drive.vehicle.cameras, 0))
    assert run.fault is None
    assert {drive[name].kbps for name in drive.vehicle.cameras} == {drive["rear"].kbps}, "of equal cameras, each"
