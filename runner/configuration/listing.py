"""The composed configuration as YAML, each value with its file or override as a comment. Pure."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from typing import Any

import yaml

from runner import schema
from runner.configuration.origin import Composed
from runner.configuration.yaml_file import resolve_exponents

WIDEST = 100  # characters of a line before its comment, if its value can be split over several lines
TEXT = "tag:yaml.org,2002:str"
UNSTATED = "in none of the files and overrides"


def listing(composed: Composed) -> str:
    """YAML that loads as the composed document.

    A list or mapping whose values have a single origin is written in one line if short enough or a list of numbers.
    """
    return "\n".join(_entries(composed, composed.document, (), ""))


def _entries(composed: Composed, value: Any, path: schema.Path, indent: str) -> Iterator[str]:
    """The lines of a list or a mapping that is not empty."""
    listed = isinstance(value, list)
    for key, inner in enumerate(value) if listed else value.items():
        lead = f"{indent}-" if listed else f"{indent}{_flow(key)}:"
        yield from _entry(composed, inner, (*path, key), lead, f"{indent}  ")


def _entry(composed: Composed, value: Any, path: schema.Path, lead: str, indent: str) -> Iterator[str]:
    origins = dict.fromkeys(_origins(composed, value, path))
    line = f"{lead} {_flow(value)}"
    short = len(line) <= WIDEST or (isinstance(value, list) and not any(map(_is_filled, value)))
    if not _is_filled(value) or (len(origins) == 1 and short):
        yield f"{line}  # {'; '.join(origins)}"
    elif lead.endswith("-"):
        first, *others = _entries(composed, value, path, indent)
        yield f"{lead} {first.removeprefix(indent)}"
        yield from others
    else:
        yield lead
        yield from _entries(composed, value, path, indent)


def _is_filled(value: Any) -> bool:
    return isinstance(value, list | dict) and bool(value)


def _origins(composed: Composed, value: Any, path: schema.Path) -> Iterator[str]:
    """Origins of the values below a path, in order."""
    if _is_filled(value):
        for key, inner in enumerate(value) if isinstance(value, list) else value.items():
            yield from _origins(composed, inner, (*path, key))
        return
    part = composed.stated_by(path)
    yield " ".join(part.name.split()) if part else UNSTATED


def _flow(value: Any) -> str:
    """A value in one line of YAML, as OmegaConf reads it."""
    text = yaml.dump(
        value, Dumper=dumper(), default_flow_style=True, width=float("inf"), allow_unicode=True, sort_keys=False
    )
    return text.removesuffix("\n...\n").rstrip("\n")


@cache
def dumper() -> Any:
    """A dumper that quotes what OmegaConf, or YAML 1.1, would otherwise read as something else than text."""

    class OneLine(yaml.SafeDumper):
        def ignore_aliases(self, data: Any) -> bool:
            return True

    def text(dumper: Any, data: str) -> Any:
        lines = len(data.splitlines()) > 1 or data.endswith("\n")
        return dumper.represent_scalar(TEXT, data, '"' if lines else "'" if data in ("y", "Y", "n", "N") else None)

    OneLine.add_representer(str, text)
    resolve_exponents(OneLine)
    return OneLine
