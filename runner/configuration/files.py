"""Locations and names of configuration files: the user's directory before the packaged one."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path

from runner.configuration.yaml_file import load_file
from runner.errors import ConfigError, UserError
from runner.resources import directory

ROOT = "config"  # the file that chooses all others
SITE = "tod-runner-site"  # name of the site file to Hydra, like that of no file of a directory
SITE_VARIABLE = "TOD_SITE"  # of the environment: names the site file
LAYOUT = "layout"  # folder in the user's directory where the operator's page saves layouts; not a group
GROUPS = (
    *("vehicle", "cameras", "modes", "graph", "source", "pqos", "recording", "study", "sound", "voice"),
    *("link", "experiment"),
)


def conf_directories(user: Path | None) -> list[Path]:
    """Directories in which configuration files are looked up, the user's first."""
    packaged = directory("conf")
    return [user, packaged] if user else [packaged]


def options(group: str, directories: Sequence[Path]) -> list[str]:
    """Names of the files that may be chosen for a group."""
    return sorted({path.stem for d in directories for path in (d / group).glob("*.yaml")})


def files(directories: Sequence[Path]) -> Iterator[Path]:
    """Every configuration file, the user's first."""
    return (path for d in directories for group in ("", *GROUPS) for path in sorted((d / group).glob("*.yaml")))


def find_file(directories: Sequence[Path], group: str, name: str) -> Path:
    """The first file of that name; if none exists, its path in the first directory."""
    candidates = [d / group / f"{name}.yaml" for d in directories]
    return next((path for path in candidates if path.exists()), candidates[0])


def defaults(directories: Sequence[Path]) -> Iterator[tuple[Path, list[tuple[str, str]]]]:
    """The choices in the defaults list of each readable file, as pairs of key and name; the user's files first."""
    for path in files(directories):
        with suppress(ConfigError):
            yield path, chosen_by(path)


def built_on(path: Path, directories: Sequence[Path]) -> set[Path]:
    """A file and, recursively, those that its defaults list names; one that cannot be read names none."""
    found, pending = set[Path](), [path]
    while pending:
        path = pending.pop()
        if path not in found and path.exists():
            found.add(path)
            with suppress(ConfigError):
                group = path.parent.name
                named = [(key.split()[-1].lstrip("/").partition("@")[0], name) for key, name in chosen_by(path)]
                named += [(group, name) for name in bases_of(path)]
                pending += [find_file(directories, *one) for one in named]
    return found


def states(path: Path, directories: Sequence[Path], key: str) -> bool:
    """Whether a file, or one that it builds on, states a key; one that cannot be read states none."""
    with suppress(ConfigError):
        return any(key in load_file(file) for file in built_on(path, directories))
    return False


def bases_of(path: Path) -> list[str]:
    """Files of its own group that a file builds on; raises ConfigError if it cannot be read."""
    content = load_file(path)
    entries = content.get("defaults") if isinstance(content, dict) else None
    return [entry for entry in entries or () if isinstance(entry, str) and entry != "_self_"]


def chosen_by(path: Path) -> list[tuple[str, str]]:
    """The choices in the defaults list of a file, as pairs of key and name.

    raises  ConfigError if it cannot be read
    """
    content = load_file(path)
    entries = content.get("defaults") if isinstance(content, dict) else None
    chosen = [entry for entry in entries if isinstance(entry, dict)] if isinstance(entries, list) else []
    return [(str(key), str(value)) for entry in chosen for key, value in entry.items()]


def site_file(environment: Mapping[str, str]) -> Path | None:
    """The file that TOD_SITE names, otherwise site.yaml in the user's configuration directory, if there is one.

    raises  UserError if TOD_SITE names no file; empty, it stands for none
    """
    named = environment.get(SITE_VARIABLE)
    if named == "":
        return None
    if named is not None:
        if not Path(named).is_file():
            raise UserError("environment", SITE_VARIABLE, named, "is no file; an empty one stands for none")
        return Path(named)
    base = environment.get("XDG_CONFIG_HOME") or os.path.expanduser("~/.config")
    standard = Path(base, "tod-runner", "site.yaml")
    return standard if os.path.lexists(standard) else None
