"""Converts the camera list of the paper's own implementation in ROS to files for `conf/`."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from runner import schema
from runner.configuration.overrides import choosable
from runner.configuration.yaml_file import load_file
from runner.core.model import ModelError, RateQualityModel, exact, plain
from runner.errors import ConfigError, Problem

ENTRY = re.compile(r"camera(\d+)")
NAME = re.compile(r"[A-Za-z0-9_-]+")  # of a vehicle
PARAMETERS = "ros__parameters"  # key above the parameters of a ROS 2 node
NOT_CONVERTED = ("host", "ip_offset", "stream_on_connect", "is_jpeg")
# By key of a model, the key of the list that it comes from.
FROM = {"scaling": "scalings", "b_min_kbps": "transition_bitrates", "b_full_kbps": "transition_bitrates"}


class CameraSize(NamedTuple):
    """Size of a camera's pictures in px, and their rate in Hz."""

    width: int
    height: int
    fps: Fraction


@dataclass(frozen=True, slots=True)
class ListedCamera:
    """A camera of the list.

    entry        its key in the list
    name         as a camera of the vehicle
    shown        its name on the operator's side
    model        the transition bitrates as ranges: the last one is b_full, the others are the bounds above 0
    topic        of its pictures in ROS
    """

    entry: str
    name: str
    shown: str
    fisheye: bool
    model: RateQualityModel
    topic: str


def read_camera_list(path: Path) -> tuple[list[ListedCamera], list[str]]:
    """The cameras of the list in order, and a note on each kind of key without a counterpart.

    raises  ConfigError with all problems
    """
    document = load_file(path)
    if isinstance(document, dict) and len(document) == 1:  # ROS 2: /**: {ros__parameters: {...}}
        (inner,) = document.values()
        document = inner[PARAMETERS] if isinstance(inner, dict) and list(inner) == [PARAMETERS] else document
    file = str(path)
    problems = [Problem(file, schema.dotted(f.path), f.found, f.rule) for f in schema.findings(document, "camera_list")]
    if problems:
        raise ConfigError(problems)
    entries = {key: value for key, value in document.items() if ENTRY.fullmatch(key)}
    used = {key: value for key, value in entries.items() if value["vehicle_name"]}
    if not used:
        raise ConfigError([Problem(file, "", None, "lists no camera: camera0, camera1, ... with a vehicle_name")])
    cameras: list[ListedCamera] = []
    for key in sorted(used, key=lambda key: int(key.removeprefix("camera"))):
        try:
            cameras.append(_camera(key, used[key], document))
        except ModelError as error:
            where = f"{key}.{FROM[error.key]}"
            found = used[key][FROM[error.key]]
            problems.append(Problem(file, where, schema.shown(found), _rule(error, used[key])))
    problems += _misnamed(file, cameras)
    if problems:
        raise ConfigError(problems)
    return cameras, [*_notes(used, len(entries) - len(used))]


def camera_document(camera: ListedCamera, size: CameraSize) -> dict[str, Any]:
    """A camera's file for conf/cameras/, as data."""
    model = camera.model
    return {
        "width_px": size.width,
        "height_px": size.height,
        "fps": plain(size.fps),
        **({"lens": "fisheye"} if camera.fisheye else {}),
        "rate_quality": {
            "scaling": [plain(factor) for factor in model.scaling],
            "b_min_kbps": [plain(bound) for bound in model.b_min],
            "b_full_kbps": plain(model.b_full),
        },
    }


def camera_text(camera: ListedCamera, document: Mapping[str, Any], origin: str) -> str:
    """The same as YAML."""
    shown = f", {camera.shown} at the operator" if camera.shown else ""
    return "\n".join(
        [
            "# yaml-language-server: $schema=../../schemas/camera.schema.json",
            f"# {camera.name}{shown}: {camera.entry} of {origin}, by `tod-runner convert`.",
            *(f"{key}: {value}" for key, value in document.items() if key != "rate_quality"),
            "rate_quality:",
            *(f"  {key}: {value}" for key, value in document["rate_quality"].items()),
            "",
        ]
    )


def vehicle_text(
    name: str, kinds: Mapping[str, str], cameras: list[ListedCamera], bag: Path | None, origin: str
) -> str:
    """A vehicle's file for conf/vehicle/, as YAML.

    kinds  by camera, its file in conf/cameras/
    bag    with pictures of all cameras; None: none is named
    """
    played = f", bag: {_quoted(str(bag.resolve()))}" if bag else ""
    return "\n".join(
        [
            "# @package _global_",
            "# yaml-language-server: $schema=../../schemas/vehicle.schema.json",
            f"# The cameras of {origin}, by `tod-runner convert`.",
            "defaults:",
            *(f"  - /cameras@cameras.{camera.name}: {kinds[camera.name]}" for camera in cameras),
            "  - _self_",
            "",
            f"name: {_quoted(name)}",
            "",
            "cameras:             # topics are used where source=bag",
            *(f"  {_quoted(camera.name)}: {{topic: {_quoted(camera.topic)}{played}}}" for camera in cameras),
            "",
        ]
    )


def _camera(key: str, entry: Mapping[str, Any], document: Mapping[str, Any]) -> ListedCamera:
    """raises ModelError"""
    rates = [exact(rate) for rate in entry["transition_bitrates"]]
    model = RateQualityModel(
        scaling=tuple(exact(str(factor).replace("p", ".")) for factor in entry["scalings"]),
        b_min=(Fraction(0), *rates[:-1]),
        b_full=rates[-1],
    )
    name = entry["vehicle_name"]
    parts = (document.get("camera_topics_namespace", ""), name, document.get("camera_image_name", ""))
    return ListedCamera(
        entry=key,
        name=re.sub(r"[^A-Za-z0-9_-]+", "_", name.strip("/")),
        shown=" ".join(entry.get("operator_name", "").split()),
        fisheye=entry.get("is_fisheye", False),
        model=model,
        topic="/" + "/".join(part.strip("/") for part in parts if part.strip("/")),
    )


def _rule(error: ModelError, entry: Mapping[str, Any]) -> str:
    """The rule in terms of the list."""
    factors, rates = len(entry["scalings"]), len(entry["transition_bitrates"])
    if factors != rates:
        return f"must have {factors} entries, one per scaling factor"
    return error.rule if error.key == "scaling" else "must be above 0 and strictly increasing"


def _misnamed(file: str, cameras: list[ListedCamera]) -> Iterator[Problem]:
    """Names that are invalid for a camera of a vehicle, or duplicate."""
    taken: dict[str, str] = {}
    for camera in cameras:
        if not choosable(camera.name):
            rule = "must have a letter, and not be true, false or null"
            yield Problem(file, f"{camera.entry}.vehicle_name", repr(camera.name), rule)
        if camera.name in taken:
            rule = f"is already the name of {taken[camera.name]}"
            yield Problem(file, f"{camera.entry}.vehicle_name", repr(camera.name), rule)
        taken.setdefault(camera.name, camera.entry)


def _notes(used: Mapping[str, Mapping[str, Any]], unused: int) -> Iterator[str]:
    if unused:
        yield f"{unused} entr{'y' if unused == 1 else 'ies'} without vehicle_name left out"
    without = [key for key in NOT_CONVERTED if any(key in entry for entry in used.values())]
    if without:
        yield f"without counterpart, left out: {', '.join(without)}"


def _quoted(text: str) -> str:
    """A text in YAML: quoted if it would otherwise be parsed as another type, such as `on` or `1`."""
    plain_text = re.fullmatch(r"[\w/.-]+", text) and yaml.safe_load(text) == text
    return text if plain_text else "'" + text.replace("'", "''") + "'"
