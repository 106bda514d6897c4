"""Settings on which both sides' configurations must agree, and their differences. Pure."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from runner.schema import Path, dotted, shown

SECTIONS = ("name", "fps_max", "cameras", "graph")
# Camera keys that concern only one side: the source of its frames, the place of its picture.
OWN = (
    "source",
    "device",
    "address",
    "clip",
    "bag",
    "topic",
    "capture",
    "credentials",
    "place",
    "pose",
    "framing",
    "fov_deg",
    "lens",
    "calibrated",
)
MAX_NAMED = 3  # differences in a message

SettingsByPath = Mapping[str, Any]


def settings(document: Mapping[str, Any]) -> SettingsByPath:
    """Values by path, such as cameras.front.fps, of a composed configuration."""
    return dict(pair for key in SECTIONS for pair in _leaves(document.get(key), (key,)))


def differences(here: SettingsByPath, vehicle: SettingsByPath) -> str | None:
    """The differences between the operator's configuration and the vehicle's, in one line; None if they agree."""
    ours, theirs = _cameras(here), _cameras(vehicle)
    cameras = {"only here": ours - theirs, "only on the vehicle": theirs - ours}
    parts = [f"{camera}: {where}" for where, some in cameras.items() for camera in sorted(some)]
    parts += [
        f"{path}: {shown(here.get(path))} here, {shown(vehicle.get(path))} on the vehicle"
        for path in {**here, **vehicle}
        if here.get(path) != vehicle.get(path) and _camera(path) not in ours ^ theirs
    ]
    more = [f"{len(parts) - MAX_NAMED} more"] if len(parts) > MAX_NAMED else []
    return "; ".join([*parts[:MAX_NAMED], *more]) or None


def _cameras(of: SettingsByPath) -> set[str]:
    """Paths of the cameras, such as cameras.front."""
    return {camera for path in of if (camera := _camera(path))}


def _camera(path: str) -> str | None:
    """The path of the camera that a setting belongs to; None: it belongs to none."""
    section, *rest = path.split(".")
    return f"{section}.{rest[0]}" if section == "cameras" and rest else None


def _leaves(value: Any, path: Path) -> Iterator[tuple[str, Any]]:
    if isinstance(value, Mapping):
        for key, inner in value.items():
            if not (path[0] == "cameras" and len(path) == 2 and key in OWN):
                yield from _leaves(inner, (*path, key))
    elif isinstance(value, list):
        for index, inner in enumerate(value):
            yield from _leaves(inner, (*path, index))
    else:
        yield dotted(path), value
