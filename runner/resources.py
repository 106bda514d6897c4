"""Where the files that come with the package are."""

from __future__ import annotations

from pathlib import Path


def directory(name: str) -> Path:
    """The packaged conf/ or schemas/: inside the installed package, beside it in a checkout."""
    package = Path(__file__).resolve().parent
    inside = package / name
    return inside if inside.is_dir() else package.parent / name
