"""Location of the files that come with the package."""

from __future__ import annotations

from pathlib import Path

import runner


def directory(name: str) -> Path:
    """The packaged conf/ or schemas/: inside the installed package; in a checkout linked to the top-level one."""
    return (Path(runner.__file__).parent / name).resolve()
