"""Configuration files: YAML as OmegaConf reads it, checked against limits that protect the parser."""

from __future__ import annotations

import pickle
import re
from collections.abc import Iterator
from contextlib import suppress
from functools import cache, lru_cache
from itertools import takewhile
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import yaml

from runner import schema
from runner.errors import ConfigError, Problem
from runner.resources import directory
from runner.system.files import read_file

if TYPE_CHECKING:
    from omegaconf import DictConfig

MAX_BYTES = 100_000  # about twenty times the longest packaged file
MAX_VALUES = 10_000  # with every alias (*NAME) expanded
DEEPEST = 32  # levels of lists and mappings
_NAME = re.compile(r"[\w /@:.,${}?-]+")  # of a file or a group, in a defaults list
_PACKAGE = re.compile(r"#\s*@package\s+(\S+)")


class YamlFile(NamedTuple):
    """A file's content, and the package that it names: `_global_` of `# @package _global_`."""

    content: Any
    package: str | None


def load_file(path: Path) -> Any:
    """Content of a YAML file: YAML 1.1, duplicate keys refused.

    raises  ConfigError if it is not a file, not YAML or beyond the limits above
    """
    return read(path).content


def read(path: Path) -> YamlFile:
    """Content and package of a YAML file; raises as `load_file`."""
    try:
        status = path.stat()
    except (OSError, ValueError):
        return _read(path, 0, 0)
    return _read(path, status.st_mtime_ns, status.st_size)


def label(path: Path) -> str:
    """A file's name in messages: conf/... for a packaged one, the path as given for a user's own."""
    packaged = directory("conf")
    return f"conf/{path.relative_to(packaged)}" if path.is_relative_to(packaged) else str(path)


def load_node(path: Path) -> DictConfig:
    """Content of a configuration file as Hydra merges it, which the caller may modify.

    raises  ConfigError as `load_file`, and if it is not a configuration
    """
    file = read(path)
    of, pickled = _nodes.get(path, (None, b""))
    if of is file and pickled:
        node: DictConfig = pickle.loads(pickled)  # takes a third of the time of a deep copy
        return node
    node = _node(path, file.content)
    _nodes[path] = file, pickle.dumps(node, pickle.HIGHEST_PROTOCOL) if of is file else b""
    return node


_nodes: dict[Path, tuple[YamlFile, bytes]] = {}  # by path, the content read and, from the second time on, its node


def _node(path: Path, content: Any) -> DictConfig:
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    problems = list(_shape_problems(path, content))
    try:
        node = OmegaConf.create(content) if isinstance(content, dict) else None
    except OmegaConfBaseException as error:
        problems.append(Problem(label(path), str(error.full_key or ""), None, str(error).partition("\n")[0]))
    if problems or node is None:
        raise ConfigError(problems)
    return node


def _shape_problems(path: Path, content: Any) -> Iterator[Problem]:
    """Problems of YAML that Hydra cannot compose."""
    file = label(path)
    if content is None:
        yield Problem(file, "", None, "is empty, must be a mapping")
        return
    if not isinstance(content, dict):
        yield Problem(file, "", schema.shown(content), "must be a mapping")
        return
    entries = content.get("defaults", [])
    if not isinstance(entries, list):
        yield Problem(file, "defaults", schema.shown(entries), "must be a list")
        return
    for index, entry in enumerate(entries):
        where = f"defaults[{index}]"
        if entry == path.stem:
            yield Problem(file, where, repr(entry), "is this file itself")
        elif not _is_choice(entry):
            yield Problem(file, where, schema.shown(entry), "must be a file's name or GROUP: NAME")


def _is_choice(entry: Any) -> bool:
    """Whether Hydra can look up the names in an entry of a defaults list."""
    words = [entry]
    if isinstance(entry, dict):
        ((key, value),) = entry.items() if len(entry) == 1 else ((None, None),)
        words = [key, *(value if isinstance(value, list) else ["null" if value is None else value])]
    return all(isinstance(word, str) and _NAME.fullmatch(word) for word in words)


@lru_cache(maxsize=1024)
def _read(path: Path, _modified_ns: int, _bytes: int) -> YamlFile:
    """Cached while time and size stay the same: a run composes the same files repeatedly."""
    try:
        text = read_file(path, MAX_BYTES).decode()
        return YamlFile(_content(text), _package(text))
    except yaml.YAMLError as error:
        raise ConfigError([_yaml_problem(error, label(path))]) from None
    except (ValueError, TypeError, AttributeError, LookupError, OverflowError) as error:
        # Also errors in PyYAML's own constructors: !!int x, 0x, numbers of ten thousand digits.
        raise ConfigError([Problem(label(path), "", None, str(error))]) from None


def _content(text: str) -> Any:
    in_python, in_c = _loaders()
    with suppress(yaml.YAMLError):  # the parser in Python has more detailed messages
        return yaml.load(text, Loader=in_c)
    return yaml.load(text, Loader=in_python)


def _package(text: str) -> str | None:
    """The package in the comments at the top. Hydra itself expects it in the first line."""
    comments = takewhile(lambda line: not line or line.startswith("#"), map(str.strip, text.splitlines()))
    return next((found[1] for line in comments if (found := _PACKAGE.fullmatch(line))), None)


def _yaml_problem(error: yaml.YAMLError, file: str) -> Problem:
    mark = getattr(error, "problem_mark", None)
    what = getattr(error, "problem", None) or str(error)
    return Problem(file, f"line {mark.line + 1}" if mark else "", None, " ".join(str(what).split()))


@cache
def _loaders() -> tuple[Any, Any]:
    """A loader with the parser in Python, and one with the parser in C, which takes an eighth of the time."""
    from omegaconf._utils import get_yaml_loader

    class Limited(get_yaml_loader()):  # type: ignore[misc]
        """Counts nodes while composing, so that nothing too large is built."""

        def __init__(self, stream: Any) -> None:
            super().__init__(stream)
            self._depth = self._values = 0
            self._sizes: dict[int, int] = {}  # values below a node, by its id

        def compose_node(self, parent: Any, index: Any) -> Any:
            event, before = self.peek_event(), self._values
            self._depth += 1
            if self._depth > DEEPEST:
                raise _limit_error(event, f"must be nested at most {DEEPEST} levels deep")
            node = super().compose_node(parent, index)
            self._depth -= 1
            if isinstance(event, yaml.AliasEvent):
                if id(node) not in self._sizes:
                    raise _limit_error(event, f"an alias, *{event.anchor}, is part of the value it refers to")
                self._values += self._sizes[id(node)]
            else:
                self._values += 1
                self._sizes[id(node)] = self._values - before
            if self._values > MAX_VALUES:
                raise _limit_error(event, f"must contain at most {MAX_VALUES} values, with aliases expanded")
            return node

        def construct_yaml_int(self, node: Any) -> int:
            number: int = super().construct_yaml_int(node)
            if abs(number) >= 10**schema.LONGEST_WHOLE:
                raise _limit_error(node, f"must have at most {schema.LONGEST_WHOLE} digits")
            return number

    Limited.add_constructor("tag:yaml.org,2002:int", Limited.construct_yaml_int)

    if not yaml.__with_libyaml__:
        return Limited, Limited
    from yaml.cyaml import CParser  # type: ignore[attr-defined]

    class Quick(Limited):
        def __init__(self, stream: Any) -> None:
            super().__init__(stream)
            parser = CParser(stream)
            self.check_event, self.peek_event, self.get_event = parser.check_event, parser.peek_event, parser.get_event

    return Limited, Quick


def _limit_error(place: Any, rule: str) -> yaml.MarkedYAMLError:
    """An error at an event or a node."""
    return yaml.MarkedYAMLError(problem=rule, problem_mark=place.start_mark)
