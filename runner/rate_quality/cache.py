"""Measured points, cached by content: the same sequence, settings and metric are never encoded twice."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from contextlib import suppress
from fractions import Fraction
from pathlib import Path
from typing import Any

from runner.errors import reason
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
    """JSON documents by digest, one small file each, written atomically, with a digest of its own: whatever has
    happened to a file, its content is used only if it is what was stored.

    on_warning  called with a line about a file that cannot be used and is measured again
    """

    def __init__(self, directory: Path, on_warning: Callable[[str], None]) -> None:
        self._directory, self._on_warning = directory, on_warning

    def load(self, key: str) -> dict[str, Any] | None:
        path = self._path(key)
        try:
            stored = json.loads(path.read_text(encoding="utf-8"))
        except FileNotFoundError:
            return None
        except OSError as error:  # may pass, so the file is kept
            self._on_warning(f"{path}: cannot be read ({reason(error)}), measured again")
            return None
        except (ValueError, RecursionError) as error:
            self._give_up(path, f"cannot be read ({error})")
            return None
        match stored:
            case {"digest": found, "document": dict(document)} if found == digest(document):
                return document
        self._give_up(path, "is damaged")
        return None

    def store(self, key: str, document: Mapping[str, Any]) -> None:
        """raises RunError if it cannot be written"""
        content = {"digest": digest(document), "document": document}
        write_whole(self._path(key), json.dumps(content).encode())

    def _give_up(self, path: Path, why: str) -> None:
        """Remove a file that is of no use, so that it is reported once."""
        self._on_warning(f"{path}: {why}, measured again")
        with suppress(OSError):
            path.unlink()

    def _path(self, key: str) -> Path:
        return self._directory / f"{key}.json"


def point_to_json(point: Point, identities: Mapping[str, str]) -> dict[str, Any]:
    """identities: by metric, everything that determines its scores"""
    return {
        "actual_kbps": point.actual_kbps,
        "second_kbps": point.second_kbps,
        "encode_ms": point.encode_ms,
        "scores": {identities[name]: scores for name, scores in point.scores.items()},
    }


def point_from_json(
    scaling: Fraction, kbps: int, data: Mapping[str, Any], identities: Mapping[str, str]
) -> Point | None:
    """The point, if it was scored with all of these metrics."""
    if any(identity not in data["scores"] for identity in identities.values()):
        return None
    scores = {name: tuple(data["scores"][identity]) for name, identity in identities.items()}
    return Point(scaling, kbps, data["actual_kbps"], data["second_kbps"], data["encode_ms"], scores)
