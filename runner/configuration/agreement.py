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
    paths = [path for path in {**here, **vehicle} if here.get(path) != vehicle.get(path)]
    parts = [
        f"{path}: {shown(here.get(path))} here, {shown(vehicle.get(path))} on the vehicle" for path in paths[:MAX_NAMED]
    ]
    more = [f"{len(paths) - MAX_NAMED} more"] if len(paths) > MAX_NAMED else []
    return "; ".join([*parts, *more]) or None


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
