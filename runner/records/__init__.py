"""Records that both sides publish and log, each a frozen dataclass whose fields are the keys of its JSON. Pure.

Only this package writes and reads that JSON; its schemas, control and drive, are made from the classes: from their
docstrings, and the limits and notes in their types. A key whose field has a default may be missing. Bitrates are
kbit/s, sizes px, times s.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping
from dataclasses import fields
from typing import Annotated, Any, TypeVar

import msgspec

from runner.core.limits import Limits

Number = int | float
Amount = Annotated[Number, Limits(0)]
# s since the start of the run or of the log; at an operator's station, which has no such start, since 1970.
Time = Annotated[float, Limits(0), "s since the start of the run, or of the log that contains this"]
Clock = Annotated[float, Limits(-(10**12), 10**12)]  # s by some clock, or a difference of clocks
CameraName = Annotated[str, "name of the camera"]
Json = dict[str, Any]
T = TypeVar("T")


def to_json(record: Any) -> Json:
    """The JSON object of a record."""
    document: Json = msgspec.to_builtins(record)
    return document


def from_json(kind: type[T], document: Mapping[str, Any]) -> T:
    """The record described by a JSON object that satisfies its schema.

    raises  msgspec.ValidationError, a ValueError
    """
    if kind not in _prepared:
        _prepare(kind)
    return msgspec.convert(document, kind)


def combined(kind: type[T], *records: Any, **values: Any) -> T:
    """A record of some kind from what others have of the same name, of several the last, and from values of its own."""
    names = [each.name for each in fields(kind)]  # type: ignore[arg-type]
    return kind(**{key: getattr(of, key) for of in records for key in names if hasattr(of, key)} | values)


_preparing = threading.Lock()
_prepared = set[type[Any]]()


def _prepare(kind: type[Any]) -> None:
    """Let msgspec build its description of a type: msgspec (0.22) crashes if two threads race to do so on first use."""
    with _preparing:
        msgspec.json.Decoder(kind)
        _prepared.add(kind)
