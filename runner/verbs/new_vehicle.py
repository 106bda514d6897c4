"""The files of a new vehicle, for `init NAME cameras=front,left,rear source=v4l2`. Pure but for the templates."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from runner.errors import ArgumentError, suggest

STATIC = Path(__file__).parent / "static"
NAME = re.compile(r"[A-Za-z][A-Za-z0-9_-]*")
TEMPLATES = {  # by path in the directory, the file in static/; NAME and MODULE are replaced in both
    "README.md": "new_README.md",
    "cameras/NAME_camera.yaml": "camera.yaml",
    "graph/NAME.yaml": "new_graph.yaml",
    "modes/NAME.yaml": "modes.yaml",
    "pqos/NAME.yaml": "new_pqos.yaml",
    "maps/NAME.csv": "new_map.csv",
    "rules/MODULE.py": "new_rules.py",
    "rules/pyproject.toml": "new_pyproject.toml",
    ".github/workflows/validate.yaml": "workflow.yaml",
    ".pre-commit-config.yaml": "pre-commit.yaml",
}
INPUTS: Mapping[str, Callable[[int, str], str]] = {  # by source, what a camera states of it, by number and name
    "v4l2": lambda number, _: f"device: /dev/video{2 * number}",  # a USB camera takes two device files
    "rtsp": lambda number, _: f"address: rtsp://10.0.0.{11 + number}/stream",
    "ros": lambda _, camera: f"topic: /{camera}/image_raw",
    "appsrc": lambda *_: "",
    "synthetic": lambda *_: "",
    "test": lambda *_: "",
}
HINTS = {
    "v4l2": "`tod-runner doctor cameras` shows yours",
    "rtsp": "with `credentials: FILE`, one line user:password, if it asks for a login",
    "ros": "of type sensor_msgs/Image or sensor_msgs/CompressedImage",
}
YAWS_DEG = {"front": 0, "left": 90, "rear": 180, "back": 180, "right": -90}  # as in ROS REP 103
COLUMNS = 3  # of tiles on the page
MOST_CAMERAS = 16


def vehicle_files(name: str, cameras: Sequence[str], source: str) -> dict[str, str]:
    """By path below the vehicle's directory, the text of each file.

    raises  ArgumentError
    """
    _check(name, cameras, source)
    words = {"NAME": name, "MODULE": f"{name.replace('-', '_').lower()}_rules", "my_modes": name}

    def filled(text: str) -> str:
        return re.sub("|".join(words), lambda found: words[found[0]], text)

    texts = {filled(path): filled((STATIC / file).read_text(encoding="utf-8")) for path, file in TEMPLATES.items()}
    return {f"vehicle/{name}.yaml": _vehicle(name, cameras, source), **texts}


def _check(name: str, cameras: Sequence[str], source: str) -> None:
    if not NAME.fullmatch(name):
        raise ArgumentError("NAME", name, "must begin with a letter, and have letters, digits, _ and - only")
    if source not in INPUTS:
        raise ArgumentError("source", source, f"must be one of {', '.join(INPUTS)}{suggest(source, INPUTS)}")
    for camera in cameras:
        if not NAME.fullmatch(camera):
            raise ArgumentError(
                "cameras", camera or None, "must be names of letters, digits, _ and -, as in front,rear"
            )
        if cameras.count(camera) > 1:
            raise ArgumentError("cameras", camera, "is named twice")
    if len(cameras) > MOST_CAMERAS:
        raise ArgumentError("cameras", str(len(cameras)), f"must be at most {MOST_CAMERAS}")


def _vehicle(name: str, cameras: Sequence[str], source: str) -> str:
    mounts = "\n".join(f"  - /cameras@cameras.{camera}: {name}_camera" for camera in cameras)
    own = "\n".join(line for number, camera in enumerate(cameras) for line in _mount(number, camera, source))
    return f"""\
# @package _global_
# yaml-language-server: $schema=../.schemas/vehicle.schema.json
# {name}: which cameras sit where, and what it is driven with.
defaults:
{mounts}
  - override /source: {source}
  - override /graph: {name}
  - override /modes: {name}
  - _self_

name: {name}                 # part of its MQTT topics, and the name in its keys

cameras:
{own}
"""


def _mount(number: int, camera: str, source: str) -> Sequence[str]:
    given, hint = INPUTS[source](number, camera), HINTS.get(source, "")
    row, column = divmod(number, COLUMNS)
    lines = [f"  {camera}:", *([f"    {given}    # {hint}"] if given else [])]
    lines.append(f"    place: {{row: {row}, column: {column}}}    # tile on the operator's page")
    yaw = next((yaw for word, yaw in YAWS_DEG.items() if word in re.split("[_-]", camera)), None)
    if yaw is not None:
        pose = f"{{x_m: 0.0, y_m: 0.0, z_m: 1.0, yaw_deg: {yaw}}}"
        lines.append(f"    pose: {pose}    # measure it, from the ground below the rear axle")
    return lines
