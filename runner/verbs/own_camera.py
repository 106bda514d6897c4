"""One camera of the user's own: the vehicle that shows it, as overrides, and as the files of a vehicle."""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import closing
from fractions import Fraction
from pathlib import Path
from typing import Any

import yaml

from runner.core.capture import Capture
from runner.core.model import Camera
from runner.errors import ArgumentError
from runner.system.v4l2 import CLOSE, Device, device_problem, preferred

VEHICLE, CAMERA = "one_camera", "camera"  # conf/vehicle/one_camera.yaml
LIST = "`tod-runner doctor cameras` lists what is connected"
EXAMPLES = "/dev/video0, ros:/front/image_raw, rtsp://10.0.0.11/stream or a clip"
SIZE, FPS = (1280, 720), 30  # of a camera that does not say, and of what the bitrates below are for
B_MIN_KBPS, B_FULL_KBPS = (0, 250, 1500), 4000  # as conf/cameras/webcam.yaml, for factors 0.25, 0.5 and 1


def camera_words(camera: str) -> list[str]:
    """The overrides with which a vehicle of one camera shows this one.

    camera  V4L2 device, topic as ros:/NAME, address of an IP camera, or clip
    raises  ArgumentError if there is no such device or file
    """
    source, key, value = _source(camera)
    words = [
        f"vehicle={VEHICLE}",
        f"source={source}",
        f"cameras.{CAMERA}.{key}={json.dumps(value, ensure_ascii=False)}",
    ]
    if source == "v4l2":
        words += [f"++cameras.{CAMERA}.{name}={_flow(each)}" for name, each in _of_device(Path(value)).items()]
    return words


def _source(camera: str) -> tuple[str, str, str]:
    """The source that shows a camera, the key of the mount that names it, and its value."""
    if camera.startswith(("rtsp://", "rtsps://", "rtspt://")):
        return "rtsp", "address", camera
    if camera.startswith("ros:"):
        return "ros", "topic", camera.removeprefix("ros:")
    path = Path(camera)
    if not path.exists():
        what = f"no such device; {LIST}" if camera.startswith("/dev/") else f"no such file; must be as {EXAMPLES}"
        raise ArgumentError("camera", camera, what)
    return ("file", "clip", str(path.resolve())) if path.is_file() else ("v4l2", "device", camera)


def check_device(camera: Camera) -> None:
    """raises  ArgumentError if the camera's device does not deliver what is asked of it now"""
    if camera.device is not None and (why := device_problem(Path(camera.device), camera.capture, camera.fps)):
        raise ArgumentError("camera", camera.device, why)


def _of_device(path: Path) -> dict[str, Any]:
    """Size, rate and capture of a device, by what it offers."""
    try:
        device = Device(path)
    except OSError:
        return {}  # `check_device` says why
    with closing(device):
        capture = preferred(device.formats())
    return {**kind_of(capture), **mount_of(capture)}


def kind_of(capture: Capture) -> dict[str, Any]:
    """What a camera's file states: size, rate, and a rate-quality model to start with, in proportion to its size."""
    width, height = capture.width or SIZE[0], capture.height or SIZE[1]
    share = width * height / (SIZE[0] * SIZE[1])
    b_min = [round(share * kbps) for kbps in B_MIN_KBPS]
    model = {"scaling": [0.25, 0.5, 1.0], "b_min_kbps": b_min, "b_full_kbps": round(share * B_FULL_KBPS)}
    return {"width_px": width, "height_px": height, "fps": stated(capture.fps or Fraction(FPS)), "rate_quality": model}


def mount_of(capture: Capture) -> dict[str, Any]:
    """What a vehicle states of the camera's capture; nothing if its driver does not say what it offers."""
    if capture.format is None:
        return {}
    rate = {"fps": stated(capture.fps)} if capture.fps else {}
    return {"capture": {"format": capture.format, "width": capture.width, "height": capture.height, **rate}}


def stated(rate: Fraction) -> float | int:
    """A rate as people state it: 30 for 30000/1001, which the device's nearest rate then is."""
    whole = round(rate)
    return whole if abs(rate - whole) <= CLOSE * rate else round(float(rate), 3)


def as_yaml(values: Mapping[str, Any]) -> list[str]:
    """Lines of YAML, as people write it: what has no further levels is in braces."""
    return yaml.safe_dump(dict(values), default_flow_style=None, sort_keys=False, allow_unicode=True).splitlines()


def _flow(value: Any) -> str:
    if isinstance(value, Mapping):
        return f"{{{', '.join(f'{key}: {_flow(each)}' for key, each in value.items())}}}"
    return json.dumps(value, ensure_ascii=False) if not isinstance(value, str) else value
