"""The bandwidth that cameras need on their USB buses, from a copy of sysfs."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import pytest

from runner.core.capture import Capture
from runner.system.usb import Bus, UsbCamera, buses

RAW = Capture("YUY2", 640, 480, Fraction(30))  # 147.456 Mbit/s


@pytest.fixture
def sysfs(tmp_path: Path) -> Path:
    """Two cameras on a USB 2 bus, one on a USB 3 bus, one on no USB at all."""
    places = {
        "video0": "pci0000:00/0000:00:14.0/usb1/1-2/1-2:1.0",
        "video2": "pci0000:00/0000:00:14.0/usb1/1-3/1-3.1/1-3.1:1.0",
        "video4": "pci0000:00/0000:00:14.0/usb2/2-1/2-1:1.0",
        "video6": "platform/csi",
    }
    (tmp_path / "class/video4linux").mkdir(parents=True)
    for name, place in places.items():
        directory = tmp_path / "devices" / place / "video4linux" / name
        directory.mkdir(parents=True)
        (tmp_path / "class/video4linux" / name).symlink_to(directory)
    for number, speed in ((1, 480), (2, 5000)):
        hub = tmp_path / f"bus/usb/devices/usb{number}"
        hub.mkdir(parents=True)
        (hub / "speed").write_text(f"{speed}\n")
    return tmp_path


def camera(name: str, number: int, capture: Capture = RAW) -> UsbCamera:
    return UsbCamera(name, Path(f"/dev/video{number}"), capture, Fraction(15))


def test_cameras_add_up_on_each_bus(sysfs: Path) -> None:
    cameras = [camera("front", 0), camera("rear", 2), camera("left", 4), camera("right", 6)]
    assert list(buses(cameras, sysfs)) == [
        Bus(1, 480, ("front", "rear"), pytest.approx(294.912), ()),
        Bus(2, 5000, ("left",), pytest.approx(147.456), ()),
    ]
    assert [bus.budget_mbps for bus in buses(cameras, sysfs)] == [327, 3600]


@pytest.mark.parametrize(
    ("capture", "mbps"),
    [
        (RAW, 147.456),
        (Capture("mjpeg", 1920, 1080, Fraction(30)), 248.832),
        (Capture("YUY2", 640, 480), 73.728),  # at the rate of the camera's kind
        (Capture("YUY2"), None),
        (Capture(), None),
    ],
)
def test_what_a_camera_needs(capture: Capture, mbps: float | None) -> None:
    assert camera("front", 0, capture).mbps == (None if mbps is None else pytest.approx(mbps))


def test_a_camera_whose_need_is_unknown_is_named(sysfs: Path) -> None:
    (bus,) = buses([camera("front", 0), camera("rear", 2, Capture())], sysfs)
    assert (bus.cameras, bus.unknown, bus.mbps) == (("front", "rear"), ("rear",), pytest.approx(147.456))
