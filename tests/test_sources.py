"""Sources of frames in the configuration: what is asked of cameras, and mistakes, reported before anything starts."""

from __future__ import annotations

from pathlib import Path

import pytest

from runner.configuration.config import configuration
from runner.errors import ConfigError, RunError
from runner.graph import Plan
from runner.plans import compile_plans, render_missing

LENS = "must lie in ]0, 170] for a pinhole, ]0, 360] for a fisheye"


@pytest.mark.parametrize(
    ("override", "line"),
    [
        ("cameras.front_left.fov_deg=200", f"command line: cameras.front_left.fov_deg: 200: {LENS}"),
        (
            "cameras.rear_center.pose.z_m=-1",
            "command line: cameras.rear_center.pose.z_m: z_m -1, fps 40: must be above 0",
        ),
    ],
)
def test_a_camera_that_the_drive_cannot_show(override: str, line: str) -> None:
    with pytest.raises(ConfigError) as raised:
        configuration(["source=synthetic", override]).vehicle()
    assert str(raised.value) == f"{line}\n1 problem, nothing was started"
    configuration(["source=test", override]).vehicle()  # other sources accept it


def test_a_numba_that_does_not_load_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def render(*_: object) -> None:
        raise ImportError("Numba needs NumPy 2.0 or less")

    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr("runner.synthetic.render", render)
    vehicle = configuration(["vehicle=delivery_robot", "source=synthetic"]).vehicle()
    with pytest.raises(RunError, match="the synthetic drive cannot be rendered: Numba needs NumPy"):
        render_missing(vehicle, lambda *_: None)


DEVICES = [f"cameras.{name}.device=/dev/video{n}" for n, name in enumerate(("front", "rear", "mast"))]


def plans(*overrides: str) -> dict[str, Plan]:
    setup = configuration(["vehicle=delivery_robot", "source=v4l2", *DEVICES, *overrides]).setup()
    return {plan.camera.name: plan for plan in compile_plans(setup)}


def asked(plan: Plan) -> tuple[object, object]:
    """Controls and caps of the plan's camera."""
    source, capture, *_ = plan.source
    return source.properties.get("extra-controls"), capture.properties.get("caps")


def test_a_camera_is_asked_for_nothing_unless_the_configuration_does() -> None:
    assert {asked(plan) for plan in plans().values()} == {(None, None)}


@pytest.mark.parametrize(
    ("capture", "caps"),
    [
        ("format: mjpeg, width: 1280, height: 720, fps: 30", "image/jpeg,width=1280,height=720,framerate=30/1"),
        ("format: h264, fps: 12.5", "video/x-h264,framerate=25/2"),
        ("format: h265", "video/x-h265"),
        ("format: raw, width: 640, height: 480", "video/x-raw,width=640,height=480"),
        ("format: YUY2", "video/x-raw,format=YUY2"),
    ],
)
def test_formats(capture: str, caps: str) -> None:
    assert asked(plans(f"+cameras.front.capture={{{capture}}}")["front"]) == (None, caps)


def test_what_a_mount_states_replaces_what_the_source_states_key_by_key() -> None:
    common = "source.capture={format: mjpeg, width: 1280, height: 720, controls: {gain: 3, auto_exposure: 1}}"
    found = plans(common, "+cameras.rear.capture={width: 640, height: 480, controls: {gain: 0}}")
    assert asked(found["front"]) == ("controls,gain=3,auto_exposure=1", "image/jpeg,width=1280,height=720")
    assert asked(found["rear"]) == ("controls,gain=0,auto_exposure=1", "image/jpeg,width=640,height=480")


@pytest.mark.parametrize(
    ("override", "problem"),
    [
        ("+cameras.front.capture={width: 640}", "cameras.front.capture.format: null: must be given where width is"),
        (
            "+cameras.front.capture={format: mjpeg, controls: {gain: high}}",
            "cameras.front.capture.controls.gain: 'high': must be a whole number",
        ),
    ],
)
def test_what_cannot_be_asked(override: str, problem: str) -> None:
    with pytest.raises(ConfigError) as raised:
        plans(override)
    assert str(raised.value).startswith(f"command line: {problem}")


@pytest.mark.parametrize("address", ["rtsp://", "rtsp:///stream", "rtsp://:554/x", "rtsp://a:99999/x", "rtsp://[::1/x"])
def test_an_address_without_a_host_is_refused(address: str) -> None:
    with pytest.raises(ConfigError) as raised:
        plans("source=rtsp", f'cameras.front.address="{address}"', 'cameras.rear.address="rtsp://cam.local:554/x"')
    rule = f"cameras.front.address: '{address}': must name a host, as rtsp://10.0.0.11/stream does"
    assert f"command line: {rule}" in str(raised.value)
    assert "cameras.rear.address" not in str(raised.value)


@pytest.mark.parametrize(
    "address",
    ["rtsp://me:secret@10.0.0.1/x", "rtsp://me:secret#1@10.0.0.1/x", "rtsp://10.0.0.1/x?user=me&password=secret"],
)
def test_an_address_with_a_password_is_refused_and_not_shown(address: str) -> None:
    with pytest.raises(ConfigError) as raised:
        plans("source=rtsp", f'source.address="{address}"')
    assert "must not contain user or password: write user:password to a file, and name that" in str(raised.value)
    assert "secret" not in str(raised.value)
