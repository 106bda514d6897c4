"""Recordings that are not part of the checkout; a test that needs one is skipped only if it is missing."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
SHARED = Path(os.environ.get("TOD_SHARED_DATA", ROOT.parent / "shared" / "data"))


def shared(name: str) -> Path:
    """A file below the shared data; skips the running test if it is missing."""
    path = SHARED / name
    if not path.is_file():
        pytest.skip(f"{path} is not here; TOD_SHARED_DATA names the directory of the recordings")
    return path
