"""What V4L2 devices say about themselves, from the structures that their drivers fill in."""

from __future__ import annotations

import errno
import os
import struct
import subprocess
import sys
from fractions import Fraction
from pathlib import Path
from typing import Any

import pytest

from runner.__main__ import main
from runner.core.capture import Capture
from runner.system import v4l2
from runner.system.v4l2 import Device, Span, device_problem, offered_rate, unoffered, users

NTSC = Fraction(30_000, 1001)
CAMERA, METADATA = 0x84200001, 0x84A00000  # capabilities of a UVC camera's nodes: device_caps, streaming, extended
NULL = Path("/dev/null")  # a character device that is no camera


def capability(own: int) -> bytes:
    """As uvcvideo fills it in: the flags of all nodes together, and those of this one."""
    text = (b"uvcvideo", b"HD Pro Webcam C920", b"usb-0000:00:14.0-2")
    return struct.pack("16s32s32s3I12x", *text, 0x06_01_00, 0x84A00001, own)


def entry(number: int) -> bytes:
    """Of a list of formats."""
    code = (b"YUYV", b"MJPG")[number]
    return struct.pack("3I32s4s16x", number, 1, 0, b"a format", code)


SIZES = {b"YUYV": ((640, 480),), b"MJPG": ((1280, 720), (1920, 1080))}
INTERVALS = ((1001, 30_000), (333_667, 5_000_000), (1, 5))  # s: 29.97, 14.985 and 5 Hz


class Kernel:
    """A camera's driver, by what it answers; there is no V4L2 device in most machines that run tests."""

    def __init__(self, own: int = CAMERA, busy: bool = False) -> None:
        self._own, self._busy = own, busy

    def __call__(self, _file: int, request: int, data: bytearray) -> None:
        index = struct.unpack_from("I", data)[0]
        try:
            data[:] = self._answer(request, index, bytes(data))
        except IndexError:
            raise OSError(errno.EINVAL, "Invalid argument") from None

    def _answer(self, request: int, index: int, asked: bytes) -> bytes:
        if request == v4l2.QUERYCAP:
            return capability(self._own)
        if request == v4l2.ENUM_FMT:
            return entry((0, 1)[index])
        if request == v4l2.ENUM_FRAMESIZES:
            return struct.pack("I4sI2I24x", index, asked[4:8], 1, *SIZES[asked[4:8]][index])
        if request == v4l2.ENUM_FRAMEINTERVALS:
            return struct.pack("I4s2II2I24x", index, *struct.unpack_from("4s2I", asked, 4), 1, *INTERVALS[index])
        if self._busy:
            raise OSError(errno.EBUSY, "Device or resource busy")
        return asked


@pytest.fixture
def formats() -> list[v4l2.Format]:
    device = Device(NULL, Kernel())
    try:
        return device.formats()
    finally:
        device.close()


def test_a_device_lists_formats_sizes_and_rates(formats: list[v4l2.Format]) -> None:
    listed = {each.name: [str(size) for size in each.sizes] for each in formats}
    assert listed == {"YUY2": ["640x480"], "mjpeg": ["1280x720", "1920x1080"]}
    rates = [rate.most for rate in formats[0].sizes[0].rates]
    assert rates == [NTSC, Fraction(5_000_000, 333_667), 5]


@pytest.mark.parametrize(
    ("asked", "taken"),
    [("29.97", NTSC), ("30", NTSC), ("15", Fraction(5_000_000, 333_667)), ("5", 5), ("25", None), ("60", None)],
)
def test_the_nearest_rate_is_taken_if_it_is_close(formats: list[v4l2.Format], asked: str, taken: Any) -> None:
    assert offered_rate(formats, Capture("mjpeg", 1280, 720, Fraction(asked))) == taken


def test_a_range_of_sizes_and_rates_holds_its_steps() -> None:
    wide, high = v4l2.parse_size(struct.pack("3I6I8x", 0, 0, 3, 16, 1920, 16, 16, 1080, 2))
    assert [wide.nearest(Fraction(width)) for width in (8, 640, 641, 4000)] == [16, 640, 640, 1920]
    assert high == Span(Fraction(16), Fraction(1080), Fraction(2))
    rate = v4l2.parse_rate(struct.pack("5I6I8x", 0, 0, 640, 480, 2, 1, 60, 1, 1, 1, 60))
    assert rate == Span(Fraction(1), Fraction(60))
    assert rate.nearest(Fraction("29.97")) == Fraction("29.97")


@pytest.mark.parametrize(
    ("capture", "why"),
    [
        (Capture(), None),
        (Capture("mjpeg", 1920, 1080, Fraction("29.97")), None),
        (Capture("raw", 640, 480), None),
        (Capture("h264"), "offers no h264, only YUY2, mjpeg"),
        (Capture("mjpeg", 640, 480), "offers no mjpeg of 640x480, only 1280x720, 1920x1080"),
        (
            Capture("mjpeg", 1280, 720, Fraction(25)),
            "offers mjpeg of 1280x720 at 5, 5000000/333667, 30000/1001 Hz, not at 25",
        ),
        (
            Capture("mjpeg", 1280, 720),
            "offers mjpeg of 1280x720 at 5, 5000000/333667, 30000/1001 Hz, less than the camera's fps, 40",
        ),
    ],
)
def test_what_a_device_does_not_offer_is_named(formats: list[v4l2.Format], capture: Capture, why: str | None) -> None:
    assert unoffered(formats, capture, Fraction(30 if why is None else 40)) == why


def test_nodes_without_pictures_and_devices_in_use_are_named() -> None:
    assert device_problem(NULL, Capture(), Fraction(30), Kernel()) is None
    metadata = device_problem(NULL, Capture(), Fraction(30), Kernel(METADATA))
    assert metadata == "is no camera: HD Pro Webcam C920 delivers metadata here"
    busy = device_problem(NULL, Capture(), Fraction(30), Kernel(busy=True))
    assert busy is not None and busy.startswith("is in use by ")


@pytest.mark.parametrize("device", ["/dev/null", "/dev/zero", "/dev/urandom", "/dev/ptmx"])
def test_a_character_device_is_no_camera(device: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor", "vehicle", "vehicle=delivery_robot", "source=v4l2", f"cameras.front.device={device}"]) == 1
    found = f"MISSING camera front: {device} is no camera: it does not answer as a V4L2 device"
    assert found in capsys.readouterr().out.splitlines()


def test_the_processes_that_have_a_device_open_are_named() -> None:
    terminal, other = os.openpty()
    path = Path(os.ttyname(other))
    code = f"import sys; f = open({str(path)!r}); print(flush=True); sys.stdin.read()"
    with subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as child:
        assert child.stdout and child.stdout.readline()
        assert any(user.endswith(f"({child.pid})") for user in users(path))
        child.communicate()
    os.close(terminal)
    os.close(other)
