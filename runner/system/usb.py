"""Estimates, from their formats, the USB bandwidth that V4L2 cameras need on the buses they share."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from fractions import Fraction
from pathlib import Path
from typing import NamedTuple

from runner.core.capture import Capture

# Mbit/s of payload that a bus has for periodic transfers, by its speed in Mbit/s as sysfs states it. USB 2.0 gives them
# at most 80 % of a microframe of 7500 bytes, enough for 5 transactions of 1024 bytes and 38 of overhead;
# USB 3 gives them at most 90 % of what its line code (8b/10b, 128b/132b) leaves.
BUDGET_MBPS = {480: 327, 5000: 3600, 10_000: 8700, 20_000: 17_400}
RAW_BITS = {"YUY2": 16, "YVYU": 16, "UYVY": 16, "NV16": 16, "NV12": 12, "I420": 12, "YV12": 12, "RGB": 24, "BGR": 24}
# Bits per pixel of the other formats. Compressed ones vary with picture and camera: for a busy picture of good quality.
BITS = {**RAW_BITS, "GRAY8": 8, "raw": 16, "mjpeg": 4, "h264": 0.3, "h265": 0.2}
SYSFS = Path("/sys")


class UsbCamera(NamedTuple):
    """A camera and the capture requested from it; `fps` applies if the capture names none."""

    name: str
    device: Path
    capture: Capture
    fps: Fraction

    @property
    def mbps(self) -> float | None:
        """The bandwidth it needs; None: unknown, since the camera chooses the format."""
        capture = self.capture
        if not (capture.format and capture.width and capture.height):
            return None
        return capture.width * capture.height * float(capture.fps or self.fps) * BITS[capture.format] / 1e6


class Bus(NamedTuple):
    """A USB bus and the cameras on it.

    speed_mbps  of its root hub
    unknown     names of cameras whose need is not known
    """

    number: int
    speed_mbps: int
    cameras: tuple[str, ...]
    mbps: float
    unknown: tuple[str, ...]

    @property
    def budget_mbps(self) -> float:
        return BUDGET_MBPS.get(self.speed_mbps, 0.8 * self.speed_mbps)


def buses(cameras: Iterable[UsbCamera], sysfs: Path = SYSFS) -> Iterator[Bus]:
    """The buses of these cameras, in order; cameras that are not on USB are left out."""
    found: dict[int, list[UsbCamera]] = {}
    for camera in cameras:
        number = _bus_of(camera.device, sysfs)
        if number is not None:
            found.setdefault(number, []).append(camera)
    for number, attached in sorted(found.items()):
        needs = {camera.name: camera.mbps for camera in attached}
        yield Bus(
            number,
            int((sysfs / f"bus/usb/devices/usb{number}/speed").read_text()),
            tuple(needs),
            sum(mbps for mbps in needs.values() if mbps is not None),
            tuple(name for name, mbps in needs.items() if mbps is None),
        )


def _bus_of(device: Path, sysfs: Path) -> int | None:
    """Number of the USB bus of a video device; None if it is on none. sysfs: .../usb1/1-2/1-2:1.0/video4linux/video0"""
    place = (sysfs / "class/video4linux" / device.resolve().name).resolve()
    hubs = [hub for part in place.parts if (hub := re.fullmatch(r"usb(\d+)", part))]
    return int(hubs[-1][1]) if hubs else None
