"""Composes configurations that differ in the files they choose, each file only once if possible.

Hydra merges key by key: a file limited to the section of its group composes to the same section whatever else is
chosen. All such files are composed together, each in its own package; a configuration that chooses some of them is
assembled from their sections. Files that reach further, by a package, a choice or an interpolation, are composed each
time.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from functools import cached_property
from pathlib import Path
from typing import Any

from runner.configuration.compose import WHOLE, compose
from runner.configuration.files import GROUPS, chosen_by, conf_directories, find_file
from runner.configuration.interpolation import stays_inside
from runner.configuration.origin import PICKED, Composed, Part
from runner.configuration.yaml_file import read
from runner.errors import ConfigError

MOUNT = "validated"  # name under which a kind of camera is mounted
# Groups whose files fill the key of their name.
SECTIONS = tuple(group for group in GROUPS if group not in (*WHOLE, "cameras"))
OF_A_VEHICLE = ("name", "cameras", "dimensions")  # keys
REFERENCE = re.compile(r"\$\{\s*(\w+)")
Choices = Mapping[str, str]  # file by group


def words_of(choices: Choices) -> tuple[str, ...]:
    """The overrides for some choices."""
    places = {"cameras": f"+cameras@cameras.{MOUNT}"}
    return tuple(f"{places.get(group, group)}={option}" for group, option in choices.items())


def reaches(path: Path) -> set[str]:
    """Groups other than its own whose choice may affect a file: it refers to, chooses from or fills them.

    raises  ConfigError if it cannot be read
    """
    content, package = read(path)
    own = path.parent.name
    named = set(REFERENCE.findall(str(content)))
    named |= {key.split()[1].lstrip("/").partition("@")[0] for key, _ in chosen_by(path) if key.startswith("override ")}
    if package == "_global_":
        named |= set(content).intersection(SECTIONS) if isinstance(content, dict) else set()
    elif package:
        named.add(package.partition(".")[0])
    return named.intersection(GROUPS) - {own, "cameras"}


class Combinations:
    """Overrides combined with user and packaged files.

    choices  groups and files that will be chosen
    """

    def __init__(self, overrides: Sequence[str], user: Path | None, choices: Iterable[tuple[str, str]]) -> None:
        self.overrides, self._user = tuple(overrides), user
        self._root = find_file(conf_directories(user), "", "config")
        named = any(word.lstrip("+~").startswith("name") for word in overrides)  # set by the vehicle's file, too
        groups = (*SECTIONS, "cameras", *(() if named else ("vehicle",)))
        self._picks = [choice for choice in choices if choice[0] in groups]
        self._sections: dict[tuple[str, str], Any] = {}

    def assembled(self, choices: Choices) -> Composed | None:
        """The configuration assembled from composed sections; None if it has to be composed.

        It does not record the origin of values: compose an invalid configuration to find out.
        """
        base = self._base
        own = {group: self._sections.get((group, option)) for group, option in choices.items()}
        if base is None or None in own.values():
            return None
        if "cameras" in own:
            own["cameras"] = {**base["cameras"], MOUNT: own["cameras"]}
        vehicle = own.pop("vehicle", None) or {}
        others = {key for key in OF_A_VEHICLE if vehicle} - vehicle.keys()  # of the vehicle that the overrides name
        document = {key: value for key, value in {**base, **own, **vehicle}.items() if key not in others}
        return Composed(document, [Part("", (), document)])

    @cached_property
    def _base(self) -> dict[str, Any] | None:
        """The configuration of the overrides alone; also composes the sections of all files."""
        try:
            return self._picked(self._picks)
        except ConfigError:  # in one file; the others are composed one by one
            pass
        try:
            base = self._picked([])
        except ConfigError:
            return None
        for pick in self._picks if base else ():
            with suppress(ConfigError):  # reported when it is composed with its own choices
                self._picked([pick])
        return base

    def _picked(self, picks: Sequence[tuple[str, str]]) -> dict[str, Any] | None:
        """Store the sections of some files; returns the rest of the configuration, None if that reaches further."""
        packages = {pick: f"{PICKED}{index}" for index, pick in enumerate(picks)}
        words = [f"+{group}@{package}={option}" for (group, option), package in packages.items()]
        composed = compose([*self.overrides, *words], self._user)
        further = {part.package[:1] for part in composed.parts if not self._is_self_contained(part)}
        document = dict(composed.document)
        sections = {pick: document.pop(package) for pick, package in packages.items()}
        if further - {(package,) for package in packages.values()}:
            return None
        self._sections |= {pick: section for pick, section in sections.items() if (packages[pick],) not in further}
        return document

    def _is_self_contained(self, part: Part) -> bool:
        """Whether a file fills the section of its group only, and does not depend on other choices."""
        if not stays_inside(part.content):
            return False
        if part.path is None:  # an override applies to all configurations
            return True
        group, package = part.path.parent.name, read(part.path).package
        chosen = [key for key, _ in chosen_by(part.path)]
        if part.path == self._root:
            return not (set(part.content) & {*SECTIONS, "cameras"} or package or set(chosen) - set(GROUPS))
        if group == "vehicle":
            mounts = all(" " not in key and key.partition("@")[2].startswith("cameras.") for key in chosen)
            return package == "_global_" and mounts and set(part.content) <= {"defaults", *OF_A_VEHICLE}
        return group != "experiment" and not package and not chosen
