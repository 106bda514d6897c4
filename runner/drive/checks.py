"""A publication's claim about a drive, checked against the result."""

from __future__ import annotations

from typing import NamedTuple


class ClaimCheck(NamedTuple):
    """One claim. holds: None if the drive does not show it."""

    claim: str
    outcome: str
    holds: bool | None
