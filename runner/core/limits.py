"""Limits of numbers, texts and lists as part of their type, from which schemas are generated."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated


@dataclass(frozen=True, slots=True)
class Limits:
    """Of a number, or of the length of a text, list or mapping; None: no limit.

    least, most  inclusive
    above        exclusive
    among        the only texts
    unique       whether no entry of a list may occur twice
    """

    least: float | None = None
    most: float | None = None
    above: float | None = None
    among: tuple[str, ...] = ()
    unique: bool = False


NonNegative = Annotated[float, Limits(0)]
Count = Annotated[int, Limits(0)]
Share = Annotated[float, Limits(0, 1)]
