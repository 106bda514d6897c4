"""The uplinks of a vehicle, from plain data."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from runner.core.model import Kbps, ModelError, exact
from runner.schema import schema_document
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


def pqos_of_uplinks(document: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """By uplink with predictions of its own, what their source is: all of `pqos`, with what differs.

    Positions are those of the vehicle.
    """
    common, own = document["pqos"], {name: data.get("pqos") for name, data in document.get("uplinks", {}).items()}
    position = {"position": common.get("position")}
    return {name: {**common, **differing, **position} for name, differing in own.items() if differing is not None}


def described(pqos: Mapping[str, Any]) -> str:
    """A source of predictions in a few words: trace uplink.csv."""
    wrong = " made wrong" if pqos.get("wrong") else ""
    match kind := pqos["kind"]:
        case "map" | "trace":
            return f"{kind} {pqos['file']}{wrong}"
        case "constant":
            return f"constant {pqos['kbps']} kbit/s{wrong}"
    return str(kind)


def check_complete(settings: Mapping[str, Any], uplink: str) -> None:
    """raises ModelError if an uplink's source of predictions, see `pqos_of_uplinks`, lacks a key of its kind"""
    kind = settings["kind"]
    missing = [key for key in schema_document("pqos")["$defs"][kind]["required"] if key not in settings]
    if missing:
        rule = f"must be given, for kind {kind}: +pqos@uplinks.{uplink}.pqos={kind} does"
        raise ModelError(missing[0], None, rule, "kind")


def built_uplinks(ways: Ways) -> dict[str, Uplink]:
    return {name: Uplink(*map(data.get, KEYS)) for name, data in ways.items()}


def reserves_kbps(ways: Ways) -> dict[str, Kbps]:
    return {name: exact(data.get("reserve_kbps", 0)) for name, data in ways.items()}
