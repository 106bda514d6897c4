"""Measured points, cached by content: the same sequence, settings and metric are never encoded twice."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from fractions import Fraction
from pathlib import Path
from typing import Any

from runner.rate_quality.curves import Point
from runner.system.files import write_whole


def digest(*parts: object) -> str:
    """Digest of values, by their text."""
    return hashlib.sha256(json.dumps(parts, sort_keys=True, default=str).encode()).hexdigest()[:32]


def file_digest(path: Path) -> str:
    """SHA-256 of a file, or of the digests of all files in a directory."""
    if path.is_dir():
        return hashlib.sha256("".join(map(file_digest, sorted(path.iterdir()))).encode()).hexdigest()
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


class Cache:
    """JSON documents by digest, one small file each, written atomically.

    on_warning  called with a line about a file that cannot be used and will be replaced
    """

    def __init__(self, directory: Path, on_warning: Callable[[str], None]) -> None:
        self._directory, self._on_warning = directory, on_warning

    def load(self, key: str) -> dict[str, Any] | None:
        path = self._path(key)
        try:
            document = json.loads(path.read_text(encoding="utf-8"))
        except FileNotFoundError:
            return None
        except (ValueError, OSError) as error:
            self._on_warning(f"{path}: cannot be read ({error}), measured again")
            return None
        if not isinstance(document, dict):
            self._on_warning(f"{path}: is not a cache file, measured again")
            return None
        return document

    def store(self, key: str, document: Mapping[str, Any]) -> None:
        """raises RunError if it cannot be written"""
        write_whole(self._path(key), json.dumps(document).encode())

    def _path(self, key: str) -> Path:
        return self._directory / f"{key}.json"


def point_to_json(point: Point, identities: Mapping[str, str]) -> dict[str, Any]:
    """identities: by metric, everything that determines its scores"""
    return {
        "actual_kbps": point.actual_kbps,
        "encode_ms": point.encode_ms,
        "scores": {identities[name]: scores for name, scores in point.scores.items()},
    }


def point_from_json(
    scaling: Fraction, kbps: int, data: Mapping[str, Any], identities: Mapping[str, str]
) -> Point | None:
    """The point, if it was scored with all of these metrics."""
    try:
        scores = {name: tuple(map(float, data["scores"][identity])) for name, identity in identities.items()}
        return Point(scaling, kbps, float(data["actual_kbps"]), float(data["encode_ms"]), scores)
    except (KeyError, TypeError, ValueError):
        return None
