"""usage: tod-runner convert FILE output=DIR [vehicle=NAME] bag=BAG [overwrite=true]
       tod-runner convert FILE output=DIR [vehicle=NAME] width_px=N height_px=N fps=N [overwrite=true]

Converts the camera list of the paper's own ROS implementation (sensors-camera.yaml) to a vehicle: each camera with its
scaling factors, its transition bitrates as b_min and b_full, and its topic. Writes DIR/vehicle/NAME.yaml, named after
FILE unless vehicle= is given, and DIR/cameras/NAME_CAMERA.yaml for each camera.

The list states neither sizes nor frame rates: they come from the first pictures of each camera's topic in a bag, or are
the same for all cameras. Existing files are kept, and the verb ends with status 2, unless overwrite=true.

  tod-runner convert sensors-camera.yaml output=my_vehicles vehicle=van bag=drive.bag
  tod-runner convert sensors-camera.yaml output=my_vehicles vehicle=van width_px=1280 height_px=800 fps=30
  tod-runner validate conf=my_vehicles
  tod-runner vehicle conf=my_vehicles vehicle=van source=bag
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from pathlib import Path

from runner import schema
from runner.configuration.camera_list import (
    NAME,
    CameraSize,
    ListedCamera,
    camera_document,
    camera_text,
    read_camera_list,
    vehicle_text,
)
from runner.configuration.overrides import choosable
from runner.core.model import ModelError, exact
from runner.errors import COMMAND_LINE, ArgumentError, ConfigError, Problem
from runner.system.files import write_whole
from runner.verbs import Arguments

SIZE_KEYS = ("width_px", "height_px", "fps")


def run(arguments: Arguments) -> int:
    file, output = _paths(arguments)
    cameras, notes = read_camera_list(file)
    name = arguments.values.get("vehicle", file.stem)
    if not (NAME.fullmatch(name) and choosable(name)):
        rule = "must be letters, digits, _ and -, and no number, true, false or null"
        raise ArgumentError("vehicle", repr(name), rule)
    bag = arguments.path("bag")
    sizes = _sizes_of_bag(cameras, bag) if bag else [_size(arguments)] * len(cameras)
    kinds = {camera.name: f"{name}_{camera.name}" for camera in cameras}
    documents = [camera_document(camera, size) for camera, size in zip(cameras, sizes, strict=True)]
    _check(str(file) if bag else COMMAND_LINE, cameras, documents)
    texts = {output / "vehicle" / f"{name}.yaml": vehicle_text(name, kinds, cameras, bag, file.name)}
    for camera, document in zip(cameras, documents, strict=True):
        texts[output / "cameras" / f"{kinds[camera.name]}.yaml"] = camera_text(camera, document, file.name)
    if arguments.choice("overwrite") == "false":
        _check_new(texts)
    for path, text in reversed(texts.items()):  # the vehicle last: it refers to the others
        write_whole(path, text.encode())
    print("\n".join(map(str, texts)))
    print("\n".join(notes), end="\n" if notes else "", file=sys.stderr)
    return 0


def _paths(arguments: Arguments) -> tuple[Path, Path]:
    """The camera list, and the output directory."""
    if len(arguments.words) != 1:
        found = " ".join(arguments.words) or None
        raise ArgumentError("", found, "must name one file: the camera list, sensors-camera.yaml")
    return Path(arguments.words[0]), arguments.given_path("output", "the directory to write the files to")


def _size(arguments: Arguments) -> CameraSize:
    """The size given for all cameras."""
    missing = [f"{key}=" for key in SIZE_KEYS if key not in arguments.values]
    if missing:
        rule = "sizes and frame rates must be given: bag=BAG with pictures of each camera, or width_px= height_px= fps="
        raise ArgumentError("", f"without {' '.join(missing)}" if len(missing) < 3 else None, rule)
    width, height, fps = (exact(str(arguments.number(key))) for key in SIZE_KEYS)
    for key, value in (("width_px", width), ("height_px", height)):
        if value.denominator != 1:
            raise ArgumentError(key, repr(arguments.values[key]), "must be a whole number")
    return CameraSize(int(width), int(height), fps)


def _sizes_of_bag(cameras: Sequence[ListedCamera], path: Path) -> list[CameraSize]:
    from runner.bag import PICTURES, Bag

    sizes, problems = [], []
    try:
        with Bag(path) as bag:
            for camera in cameras:
                try:
                    form = bag.form(bag.find(PICTURES, camera.topic, "pictures"))
                    sizes.append(CameraSize(form.width, form.height, form.fps))
                except ModelError as error:
                    problems.append(Problem(COMMAND_LINE, "bag", str(error.found), error.rule))
    except ModelError as error:
        raise ArgumentError("bag", str(error.found), error.rule) from None
    if problems:
        raise ConfigError(problems)
    return sizes


def _check(where: str, cameras: Sequence[ListedCamera], documents: Sequence[object]) -> None:
    """Check each camera's file against its schema: size or rate may be invalid."""
    entries = [f"{camera.entry}." if where != COMMAND_LINE else "" for camera in cameras]
    problems = [
        Problem(where, f"{entry}{schema.dotted(finding.path)}", finding.found, finding.rule)
        for entry, document in zip(entries, documents, strict=True)
        for finding in schema.findings(document, "camera")
    ]
    if problems:
        raise ConfigError(problems)


def _check_new(paths: Sequence[Path] | dict[Path, str]) -> None:
    """Check that nothing would be overwritten."""
    rule = "already exists; overwrite=true replaces it"
    problems = [Problem(str(path), "", None, rule) for path in paths if os.path.lexists(path)]
    if problems:
        raise ConfigError(problems)
