"""Copies of the schemas in a user's directory, with their version, by which editors know the keys of its files."""

from __future__ import annotations

from importlib.metadata import version
from pathlib import Path

from runner.resources import directory

FOLDER = ".schemas"  # hidden: `validate` takes no file in it for configuration
VERSION_FILE = "VERSION"  # name of the file with the version


def copies() -> dict[str, str]:
    """By path below a user's directory, the text of each schema, and of the file with their version."""
    schemas = sorted(directory("schemas").glob("*.json"))
    texts = {f"{FOLDER}/{path.name}": path.read_text(encoding="utf-8") for path in schemas}
    return texts | {f"{FOLDER}/{VERSION_FILE}": f"{version('tod-runner')}\n"}


def version_problem(user: Path) -> str | None:
    """Why an editor may know other keys than this version; None if it does not, or if there are no copies."""
    file, own = user / FOLDER / VERSION_FILE, version("tod-runner")
    try:
        found = file.read_text(encoding="utf-8").strip() if file.parent.is_dir() else own
    except (OSError, ValueError):
        found = "unknown"
    if found == own:
        return None
    again = f"rm -r {user / FOLDER} && tod-runner init {user} files=schemas"
    return f"{user / FOLDER}: version {found}, this is tod-runner {own}; your editor may know other keys: {again}"
