"""The site file: what belongs to this machine, and so to every run on it: addresses, interfaces, keys, devices."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from runner import schema
from runner.configuration.interpolation import value_at
from runner.configuration.origin import nested
from runner.configuration.yaml_file import label, load_file
from runner.errors import ConfigError, Problem, suggest

CHOICES = ("vehicle", "source")  # groups of which it may choose a file
PATHS = (  # of files; a relative one is looked up next to the site file
    ("keys",),
    *(("control", key) for key in ("ca", "credentials", "certificate", "key")),
    ("cameras", "*", "credentials"),
)
ELSEWHERE = "does not belong to a machine: state it in the vehicle's file, or as an override"


@dataclass(frozen=True)
class Site:
    """A site file that has been checked.

    choices  by group, the file that it chooses
    content  everything else, with absolute paths
    """

    path: Path
    choices: Mapping[str, str]
    content: Mapping[str, Any]

    def problems(self, document: Mapping[str, Any]) -> Iterator[Problem]:
        """Cameras that the composed configuration has from here alone."""
        cameras, own = document.get("cameras"), self.content.get("cameras") or {}
        if not isinstance(cameras, Mapping):
            return
        known = [name for name in cameras if cameras[name] != own.get(name)]
        for name in own:
            if name not in known:
                rule = f"the vehicle {document.get('name')} has no such camera{suggest(name, known)}"
                yield Problem(label(self.path), f"cameras.{name}", None, rule)


def read_site(path: Path) -> Site:
    """raises ConfigError with all of its problems"""
    content = load_file(path)
    content = {} if content is None else content  # of comments only
    if problems := list(_problems(path, content)):
        raise ConfigError(problems)
    settings = {key: value for key, value in content.items() if key not in CHOICES}
    for place in PATHS:
        _make_absolute(settings, place, path.absolute().parent)
    return Site(path, {group: content[group] for group in CHOICES if group in content}, settings)


def _problems(path: Path, content: Any) -> Iterator[Problem]:
    for finding in schema.findings(content, "site"):
        is_unknown = finding.rule.startswith("unknown key")
        elsewhere = is_unknown and _is_key(finding.path, value_at(content, finding.path))
        yield Problem(label(path), schema.dotted(finding.path), finding.found, ELSEWHERE if elsewhere else finding.rule)


def _is_key(path: schema.Path, value: Any) -> bool:
    """Whether a configuration has this key, though a site file has not."""
    if path[0] in schema.schema_document("composed")["properties"] and len(path) == 1:
        return True
    found = schema.findings(nested(schema.dotted(path), value), "composed")
    return not any(each.path == path[: len(each.path)] and each.rule.startswith("unknown key") for each in found)


def _make_absolute(settings: dict[str, Any], place: tuple[str, ...], base: Path) -> None:
    """Replace relative file names in place."""
    key, *below = place
    for each in settings if key == "*" else [key] if key in settings else ():
        if below and isinstance(settings[each], dict):
            settings[each] = dict(settings[each])
            _make_absolute(settings[each], tuple(below), base)
        elif not below and isinstance(settings[each], str):
            settings[each] = str(base / os.path.expanduser(settings[each]))
