"""The paper's own camera list as a vehicle: the files are valid, and errors are reported."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest

from runner.configuration.config import configuration
from runner.verbs import CONVERSION

LIST = """\
camera_topics_namespace: /sensor/camera
camera_image_name: image_raw
camera0: {vehicle_name: front_left, operator_name: Front Left, is_fisheye: false, scalings: ["0p125", "0p25", "0p5"],
          transition_bitrates: [300, 950, 6000], host: vehicle, ip_offset: 1, stream_on_connect: true, is_jpeg: false}
camera10: {vehicle_name: top, is_fisheye: true, scalings: ["0p25", "1"], transition_bitrates: [400, 3000.5]}
camera2: {vehicle_name: rear, scalings: ["0p25"], transition_bitrates: [700]}
camera3: {vehicle_name: "", scalings: ["1"], transition_bitrates: [1]}
"""
SIZE = ("width_px=640", "height_px=400", "fps=12.5")


@pytest.fixture
def listed(tmp_path):
    path = tmp_path / "sensors-camera.yaml"
    path.write_text(LIST)
    return path


@pytest.fixture
def convert(tod, listed, tmp_path):
    return lambda *words: tod("convert", str(listed), f"output={tmp_path / 'out'}", *words)


def test_a_list_is_converted_to_a_valid_vehicle(convert, tod, tmp_path):
    out = tmp_path / "out"
    files = [out / "vehicle/van.yaml", *(out / f"cameras/van_{name}.yaml" for name in ("front_left", "rear", "top"))]
    result = convert("vehicle=van", *SIZE)
    assert (result.status, result.out.splitlines()) == (0, list(map(str, files)))
    assert result.err.splitlines() == [
        "1 entry without vehicle_name left out",
        "without counterpart, left out: host, ip_offset, stream_on_connect, is_jpeg",
    ]
    assert tod("validate", *map(str, files)).out == "valid: 4 files, 4 configurations\n"
    assert tod("print", "vehicle=van", f"conf={out}", "source=test").status == 0
    cameras = configuration(["vehicle=van", "source=test"], out).vehicle().cameras
    assert list(cameras) == ["front_left", "rear", "top"]
    front, rear, top = cameras.values()
    assert (front.rate_quality.scaling, front.rate_quality.b_min, front.rate_quality.b_full) == (
        (Fraction(1, 8), Fraction(1, 4), Fraction(1, 2)),
        (0, 300, 950),
        6000,
    )
    assert (rear.rate_quality.b_min, rear.rate_quality.b_full) == ((0,), 700)
    assert (top.rate_quality.b_min, top.rate_quality.b_full) == ((0, 400), Fraction("3000.5"))
    assert {(camera.width, camera.height, camera.fps) for camera in cameras.values()} == {(640, 400, Fraction("12.5"))}
    assert (front.lens, top.lens) == ("pinhole", "fisheye")
    assert rear.mount == {"topic": "/sensor/camera/rear/image_raw"}


def test_the_parameters_of_a_node_of_ros_2(convert, listed):
    inner = "".join(f"    {line}\n" for line in LIST.splitlines())
    listed.write_text(f"/**:\n  ros__parameters:\n{inner}")
    assert convert(*SIZE).status == 0


def test_existing_files_are_kept_unless_overwritten(convert, tmp_path):
    assert convert(*SIZE).status == 0
    before = {path: path.read_bytes() for path in (tmp_path / "out").rglob("*.yaml")}
    assert "sensors-camera.yaml" in {path.name for path in before}
    result = convert("width_px=320", "height_px=200", "fps=5")
    assert sorted(result.problems) == sorted(f"{path}: already exists; overwrite=true replaces it" for path in before)
    assert {path: path.read_bytes() for path in before} == before
    assert convert("width_px=320", "height_px=200", "fps=5", "overwrite=true").status == 0
    assert all(path.read_bytes() != before[path] for path in before if path.parent.name == "cameras")


def test_sizes_and_rates_come_from_a_bag(convert, tod, tmp_path):
    pytest.importorskip("rosbags")
    from bags import camera_bag

    frames = {
        f"/sensor/camera/{name}/image_raw": [np.zeros((height, width, 3), np.uint8)] * 4
        for name, width, height in (("front_left", 64, 48), ("rear", 96, 32), ("top", 32, 32))
    }
    bag = camera_bag(tmp_path / "drive", "ros1", frames, 15)
    assert convert("vehicle=van", f"bag={bag}").status == 0
    cameras = configuration(["vehicle=van", "source=bag"], tmp_path / "out").vehicle().cameras  # which opens the bag
    assert [(c.width, c.height, c.fps) for c in cameras.values()] == [(64, 48, 15), (96, 32, 15), (32, 32, 15)]
    assert cameras["rear"].mount == {"bag": str(bag), "topic": "/sensor/camera/rear/image_raw"}
    some = camera_bag(tmp_path / "some", "mcap", dict(list(frames.items())[:1]), 15)
    assert convert("vehicle=other", f"bag={some}").problems == [
        f"command line: bag: {some}: /sensor/camera/{name}/image_raw: no such topic with pictures, did you mean "
        "/sensor/camera/front_left/image_raw?"
        for name in ("rear", "top")
    ]
    assert not (tmp_path / "out/vehicle/other.yaml").exists()


NEEDED = "sizes and frame rates must be given: bag=BAG with pictures of each camera, or width_px= height_px= fps="


@pytest.mark.parametrize(
    ("words", "problem"),
    [
        ((), NEEDED),
        (("width_px=640", "fps=5"), f"without height_px=: {NEEDED}"),
        (("bag=/none.bag",), "bag: /none.bag: no such file"),
        (("width_px=640.5", *SIZE[1:]), "width_px: '640.5': must be a whole number"),
        ((*SIZE[:2], "fps=x"), "fps: 'x': must be a number of 0 or more"),
        (
            (*SIZE, "vehicle=a b"),
            "vehicle: 'a b': must be letters, digits, _ and -, and no number, true, false or null",
        ),
        (
            (*SIZE, "mode=single"),
            f"mode=single: unknown argument; expected one of {', '.join(CONVERSION)}, conf",
        ),
    ],
)
def test_invalid_conversions(convert, words, problem):
    result = convert(*words)
    assert (result.status, result.out, result.err) == (2, "", f"command line: {problem}\n")


def test_a_size_that_no_camera_can_have(convert):
    assert convert("width_px=0", *SIZE[1:]).problems == ["command line: width_px: 0: must be at least 16"]


def test_all_mistakes_of_a_list_are_reported(convert, listed):
    listed.write_text(
        LIST.replace('scalings: ["0p25"]', 'scaling: ["0p25"]')
        .replace("[400, 3000.5]", "[a]")
        .replace("is_jpeg", "jpg")
    )
    problems = convert(*SIZE).problems
    assert len(problems) == 3
    assert any("camera2.scaling: unknown key, did you mean scalings?" in problem for problem in problems)
    assert any("camera10.transition_bitrates[0]: 'a'" in problem for problem in problems)
    assert any("camera0.jpg: unknown key" in problem for problem in problems)
    listed.write_text(
        LIST.replace("[300, 950, 6000]", "[300, 950]")
        .replace("[400, 3000.5]", "[400, 100]")
        .replace('["0p25"]', '["2"]')
    )
    assert convert(*SIZE).problems == [
        f"{listed}: camera0.transition_bitrates: [300, 950]: must have 3 entries, one per scaling factor",
        f'{listed}: camera2.scalings: ["2"]: must lie in ]0, 1]',
        f"{listed}: camera10.transition_bitrates: [400, 100]: must be above 0 and strictly increasing",
    ]
    listed.write_text(
        LIST.replace("rear", "front/left").replace("name: top", 'name: "7"').replace("front_left", "front left")
    )
    assert convert(*SIZE).problems == [
        f"{listed}: camera2.vehicle_name: 'front_left': is already the name of camera0",
        f"{listed}: camera10.vehicle_name: '7': must have a letter, and not be true, false or null",
    ]


def test_names_that_yaml_would_parse_as_another_type(convert, listed, tod, tmp_path):
    listed.write_text(LIST.replace("rear", '"on"'))
    assert convert("vehicle=off", *SIZE).status == 0
    assert tod("print", "vehicle=off", f"conf={tmp_path / 'out'}", "source=test").status == 0


def test_files_that_are_not_a_camera_list(convert, listed):
    listed.write_text("camera_image_name: x\n")
    assert convert(*SIZE).problems == [f"{listed}: lists no camera: camera0, camera1, ... with a vehicle_name"]
    listed.write_text("[1, 2")
    assert convert(*SIZE).status == 2
