"""usage: tod-runner completion bash|zsh

Prints the completion script of a shell. It completes verbs, their arguments, groups and their files, including those of
your directory (conf=DIR on the same line, or TOD_CONF), configuration keys, camera names, and the values of keys that
allow only a few.

  eval "$(tod-runner completion bash)"      # in ~/.bashrc
  eval "$(tod-runner completion zsh)"       # in ~/.zshrc, after compinit
  tod-runner completion bash > /etc/bash_completion.d/tod-runner
"""

# Runs on every TAB, so it imports nothing slow: neither Hydra nor OmegaConf.

from __future__ import annotations

import os
import shlex
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import yaml

from runner.configuration.files import GROUPS, conf_directories, find_file, options
from runner.configuration.yaml_file import MAX_BYTES
from runner.errors import ArgumentError
from runner.schema import referred, schema_document
from runner.system.files import read_file
from runner.verbs import VERBS, Arguments

SCRIPTS = {
    "bash": """\
_tod_runner() {
    mapfile -t COMPREPLY < <("$1" completion words "$COMP_WORDBREAKS" "${COMP_LINE:0:COMP_POINT}" 2>/dev/null)
    if [[ ${COMPREPLY[0]-} == *[=.] ]]; then compopt -o nospace; fi
}
complete -o bashdefault -o default -F _tod_runner tod-runner""",
    "zsh": """\
_tod_runner() {
    local -a found
    found=(${(f)"$("$words[1]" completion words '' "${(j: :)words[1,CURRENT-1]} $PREFIX" 2>/dev/null)"})
    if (( $#found )); then
        compadd -Q -S '' -- ${(M)found:#*[=.]}
        compadd -Q -- ${found:#*[=.]}
    else
        compset -P '*='
        _files
    fi
}
compdef _tod_runner tod-runner""",
}
WORDS = {"doctor": (*VERBS, "cameras"), "completion": tuple(SCRIPTS)}  # by verb, its positional arguments


def run(arguments: Arguments) -> int:
    if len(arguments.words) != 1 or arguments.words[0] not in SCRIPTS:
        found = " ".join(arguments.words)
        raise ArgumentError("", found or None, f"must be one of {', '.join(SCRIPTS)}")
    print(SCRIPTS[arguments.words[0]])
    return 0


def words(breaks: str, line: str) -> int:
    """Print completions of the last word of a line, one per line. If there are none, the shell completes files.

    breaks  characters other than blanks at which the shell splits words: it replaces only what follows the last one
    """
    before, _, last = line.rpartition(" ")
    start = max((last.rfind(character) for character in breaks), default=-1) + 1
    try:
        found = candidates(shlex.split(before)[1:], last)
    except Exception:  # unbalanced quotes, or an invalid file, which its verb will report
        return 1
    for word in found:
        print(word[start:])
    return 0


def candidates(before: Sequence[str], last: str) -> list[str]:
    """The words that may replace the last, unfinished one; `before`: the words between the program and it."""
    found = _words(before[0], before[1:], last) if before else [*VERBS, "--help", "--version"]
    # A key without known values is not offered: the shell would append a blank instead of completing files.
    return [word for word in dict.fromkeys(found) if word.startswith(last) and (word != last or word[-1] not in "=.")]


def _words(verb: str, before: Sequence[str], last: str) -> Iterator[str]:
    if verb not in VERBS:
        return
    spec = VERBS[verb]
    yield from WORDS.get(verb, ())
    yield from (["-m"] if spec.sweeps and "-m" not in before else [])
    yield from (f"{name}=" for name in spec.arguments)
    if "=" in last:
        yield from (f"{name}={value}" for name, values in spec.choices.items() for value in values)
    if spec.composes:
        yield "conf="
        yield from _overrides(_Selection(before), last, ("study",) if verb in ("model", "doctor") else ())


class _Selection:
    """The configuration directories and the vehicle that a command line selects."""

    def __init__(self, given: Sequence[str]) -> None:
        chosen = dict(word.partition("=")[::2] for word in given)
        conf = chosen.get("conf") or os.environ.get("TOD_CONF")
        self.directories = conf_directories(Path(conf).expanduser() if conf else None)
        self._vehicle = chosen.get("vehicle") or self._default("vehicle")

    def _default(self, group: str) -> str:
        entries = _content(find_file(self.directories, "", "config")).get("defaults", ())
        return str(next(entry[group] for entry in entries if isinstance(entry, dict) and group in entry))

    def cameras(self) -> Iterator[str]:
        return self._cameras(self._vehicle, set())

    def _cameras(self, vehicle: str, seen: set[str]) -> Iterator[str]:
        """Names of the cameras that a vehicle's file mounts, and of those mounted by the files it builds on."""
        if vehicle in seen:
            return
        content = _content(find_file(self.directories, "vehicle", vehicle))
        for entry in content.get("defaults", ()):
            if isinstance(entry, str) and entry != "_self_":
                yield from self._cameras(entry, {*seen, vehicle})
            for key in entry if isinstance(entry, dict) else ():
                package = str(key).partition("@")[2]
                yield from [package.removeprefix("cameras.")] if package.count(".") == 1 else []
        yield from content.get("cameras", ())


def _content(path: Path) -> dict[str, Any]:
    content: dict[str, Any] = yaml.load(read_file(path, MAX_BYTES), getattr(yaml, "CSafeLoader", yaml.SafeLoader))
    return content


def _overrides(selection: _Selection, last: str, implicit: Sequence[str]) -> Iterator[str]:
    """Overrides that may complete a word: a group with a file, a key with a value, or a prefix of a longer key.

    implicit  sections whose keys may be given without the section's name
    """
    plain = last.lstrip("+~")
    sign = last[: len(last) - len(plain)]
    key, equals, _ = plain.partition("=")
    group = key.partition("@")[0].lstrip("/")
    if equals and group in GROUPS:
        yield from (f"{sign}{key}={name}" for name in options(group, selection.directories))
    elif equals:
        yield from (f"{sign}{key}={value}" for value in _values(_schema_of(key.split("."), implicit)))
    else:
        for name in _names(key, selection, implicit):
            yield f"{sign}{name.rstrip('=.' if '.' in key else '=') if sign == '~' else name}"


def _names(key: str, selection: _Selection, implicit: Sequence[str]) -> Iterator[str]:
    """Groups and keys, one level at a time."""
    above, dot, _ = key.rpartition(".")
    if not dot:
        yield from (f"{group}=" for group in GROUPS if group != "cameras")  # vehicles mount these
        for section in implicit:
            yield from (f"{name}=" for name in schema_document(section)["properties"])
    if above == "cameras":
        yield from (f"cameras.{name}." for name in selection.cameras())
        return
    for name, (node, _) in _properties(*_schema_of(above.split(".") if above else [], ())).items():
        deeper = "properties" in node or isinstance(node.get("additionalProperties"), dict)
        yield f"{above}{dot}{name}{'.' if deeper else '='}"


def _schema_of(steps: Sequence[str], implicit: Sequence[str]) -> tuple[dict[str, Any], str]:
    """The schema of a key, and the name of the file that contains it; empty if there is no such key."""
    home = next((section for section in implicit if steps[0] in schema_document(section)["properties"]), "composed")
    node = schema_document(home)
    for step in steps:
        other = node.get("additionalProperties")
        node, home = _properties(node, home).get(step) or _resolved(other if isinstance(other, dict) else {}, home)
    return node, home


def _properties(node: dict[str, Any], home: str) -> dict[str, tuple[dict[str, Any], str]]:
    """The keys of a mapping, including those that exist only for certain values of other keys."""
    found = {}
    for part in node.get("allOf", ()):
        found.update(_properties(*_resolved(part.get("then", part), home)))
    found |= {name: _resolved(inner, home) for name, inner in node.get("properties", {}).items() if name != "defaults"}
    return found


def _resolved(node: dict[str, Any], home: str) -> tuple[dict[str, Any], str]:
    while "$ref" in node:
        node, home = referred(node["$ref"], home)
    return node, home


def _values(found: tuple[dict[str, Any], str]) -> Iterator[str]:
    node, _ = found
    kinds = node.get("type", ())
    yield from (["true", "false"] if "boolean" in ([kinds] if isinstance(kinds, str) else kinds) else [])
    yield from ("null" if value is None else str(value) for value in node.get("enum", ()))
