"""Reads the logs of a drive. Stand-in until the reader proper is merged; same interface."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from runner.errors import UserError

FILES = {"vehicle": "drive.jsonl", "operator": "operator.jsonl", "link": "link.jsonl"}


@dataclass(frozen=True, slots=True)
class Side:
    """What one side has logged.

    began  the first line: time, versions, config
    lines  all others, in order
    ended  whether the log was ended cleanly
    """

    began: dict[str, Any]
    lines: list[dict[str, Any]]
    ended: bool


@dataclass(frozen=True, slots=True)
class Drive:
    path: Path
    name: str
    sides: dict[str, Side]
    warnings: list[str] = field(default_factory=list)


def read_drive(path: Path) -> Drive:
    """A drive from its directory.

    raises  UserError where there is none, or a file is not one of a drive
    """
    if not path.is_dir():
        raise UserError(str(path), "", None, "no such directory")
    warnings: list[str] = []
    sides = {side: _side(path / file, warnings) for side, file in FILES.items() if (path / file).is_file()}
    if not {"vehicle", "operator"} & sides.keys():
        raise UserError(str(path), "", None, "holds no drive: neither drive.jsonl nor operator.jsonl is there")
    return Drive(path, path.resolve().name, sides, warnings)


def _side(path: Path, warnings: list[str]) -> Side:
    texts = path.read_text(encoding="utf-8").splitlines()
    documents = []
    for number, text in enumerate(texts, 1):
        try:
            document = json.loads(text)
        except ValueError:
            if number < len(texts) or number == 1:
                raise UserError(f"{path}:{number}", "", None, "is no line of a drive") from None
            warnings.append(f"{path.name}: the last line was cut off")
            continue
        documents.append(document)
    if not documents or not isinstance(documents[0], dict) or documents[0].get("log") != "began":
        raise UserError(f"{path}:1", "", None, "is no log of a drive: its first line must say how it began")
    ended = documents[-1].get("log") == "ended"
    if not ended:
        warnings.append(f"{path.name}: was not ended cleanly")
    return Side(documents[0], documents[1 : -1 if ended else None], ended)
