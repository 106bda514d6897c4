"""Differences between the configurations of both sides."""

from __future__ import annotations

from runner.configuration.agreement import differences, settings
from runner.configuration.config import configuration


def of(*overrides: str) -> dict[str, object]:
    return dict(settings(configuration(["vehicle=delivery_robot", *overrides]).document))


def test_settings_of_one_side_need_not_agree() -> None:
    own = of("source=v4l2", "cameras.front.device=/dev/video7", "media.host=192.0.2.1", "page.port=1", "pqos=constant")
    assert differences(of("source=test"), own) is None


def test_differences_are_named() -> None:
    assert differences(of("fps_max=10"), of()) == "fps_max: 10 here, null on the vehicle"
    assert differences(of(), of("cameras.rear.weight=2", "graph.mtu_bytes=900")) == (
        "graph.mtu_bytes: 1200 here, 900 on the vehicle; cameras.rear.weight: null here, 2 on the vehicle"
    )
    assert differences(of(), of("graph=openh264_rtsp")).endswith(" more")


def test_a_camera_of_one_side_is_one_difference() -> None:
    assert differences(of(), of("~cameras.mast", "fps_max=10")) == (
        "cameras.mast: only here; fps_max: null here, 10 on the vehicle"
    )
    assert differences(of("~cameras.rear", "~cameras.mast"), of()) == (
        "cameras.mast: only on the vehicle; cameras.rear: only on the vehicle"
    )
