"""What a source claims of a drive, held against what came out."""

from __future__ import annotations

from typing import NamedTuple


class ClaimCheck(NamedTuple):
    """One claim. holds: None where the drive does not show it."""

    claim: str
    outcome: str
    holds: bool | None
