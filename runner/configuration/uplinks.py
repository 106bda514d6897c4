"""The uplinks of a vehicle, from plain data."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from runner.core.model import Kbps, ModelError, exact
from runner.settings import Uplink

Ways = Mapping[str, Mapping[str, Any]]  # by name
KEYS = ("interface", "address")


def uplink_problems(ways: Ways) -> Iterator[ModelError]:
    """Each names its way, and no two the same."""
    names: dict[str, str] = {}
    for name, data in ways.items():
        given = {key: data[key] for key in KEYS if key in data}
        if not given:
            yield ModelError(f"{name}.interface", None, "an uplink needs an interface or an address")
        for key, way in given.items():
            if way in names:
                yield ModelError(f"{name}.{key}", way, "is already that of another uplink", f"{names[way]}.{key}")
            names[way] = name


def built_uplinks(ways: Ways) -> dict[str, Uplink]:
    return {name: Uplink(*map(data.get, KEYS)) for name, data in ways.items()}


def reserves_kbps(ways: Ways) -> dict[str, Kbps]:
    return {name: exact(data.get("reserve_kbps", 0)) for name, data in ways.items()}
