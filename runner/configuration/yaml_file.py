"""Configuration files: YAML as OmegaConf reads it, checked against limits that protect the parser."""

from __future__ import annotations

import pickle
import re
from collections.abc import Iterable, Iterator
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
EXPONENT = re.compile(r"[-+]?[0-9]+(_[0-9]+)*(\.[0-9_]*)?[eE][-+]?[0-9]+$")
DATE = "tag:yaml.org,2002:timestamp"
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
    if path not in _nodes or _nodes[path][0] is not file:
        _nodes[path] = file, pickle.dumps(_node(path, file.content))
    node: DictConfig = pickle.loads(_nodes[path][1])  # takes a sixth of the time of a deep copy
    return node


_nodes: dict[Path, tuple[YamlFile, bytes]] = {}  # by path, the content read and its node


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
    in_c, in_python = _loaders()
    with suppress(yaml.YAMLError):  # the parser in Python has more detailed messages
        return _loaded(text, in_c)
    return _loaded(text, in_python)


def _loaded(text: str, loader: Any) -> Any:
    _check_size(yaml.parse(text, loader))
    return yaml.load(text, loader)


def _package(text: str) -> str | None:
    """The package in the comments at the top. Hydra itself expects it in the first line."""
    comments = takewhile(lambda line: not line or line.startswith("#"), map(str.strip, text.splitlines()))
    return next((found[1] for line in comments if (found := _PACKAGE.fullmatch(line))), None)


def _yaml_problem(error: yaml.YAMLError, file: str) -> Problem:
    mark = getattr(error, "problem_mark", None)
    what = getattr(error, "problem", None) or str(error)
    return Problem(file, f"line {mark.line + 1}" if mark else "", None, " ".join(str(what).split()))


def _check_size(events: Iterable[Any]) -> None:
    """Check the limits on the values of a file before any is built, so that nothing too large is.

    An alias counts as many values as it refers to.
    """
    values, sizes = 0, dict[str | None, int]()  # so far; by anchor
    above: list[tuple[str | None, int]] = []  # of the lists and mappings around an event: anchor, values before
    for event in events:
        if isinstance(event, yaml.CollectionEndEvent):
            anchor, before = above.pop()
            sizes[anchor] = values - before
        if not isinstance(event, yaml.NodeEvent):
            continue
        if len(above) == DEEPEST:
            raise _error_at(event, f"must be nested at most {DEEPEST} levels deep")
        if isinstance(event, yaml.AliasEvent):
            if any(event.anchor == anchor for anchor, _ in above):
                raise _error_at(event, f"an alias, *{event.anchor}, is part of the value it refers to")
            values += sizes.get(event.anchor, 0)
        elif isinstance(event, yaml.CollectionStartEvent):
            above.append((event.anchor, values))
            values += 1
        else:
            values, sizes[event.anchor] = values + 1, 1
        if values > MAX_VALUES:
            raise _error_at(event, f"must contain at most {MAX_VALUES} values, with aliases expanded")


@cache
def _loaders() -> tuple[Any, Any]:
    """A loader with the parser in C, which takes an eighth of the time, and one with the parser in Python."""
    return _loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)), _loader(yaml.SafeLoader)


def _loader(plain: Any) -> Any:
    """A loader of YAML as OmegaConf reads it: no dates, and no key twice."""

    class Loader(plain):  # type: ignore[misc]
        def construct_mapping(self, node: Any, deep: bool = False) -> Any:
            keys = [key for key, _ in node.value if key.tag == self.DEFAULT_SCALAR_TAG]
            found = set[str]()
            for key in keys:
                if key.value in found:
                    raise _error_at(key, f"found duplicate key {key.value}")
                found.add(key.value)
            return super().construct_mapping(node, deep)

        def construct_yaml_int(self, node: Any) -> int:
            number: int = super().construct_yaml_int(node)
            if abs(number) >= 10**schema.LONGEST_WHOLE:
                raise _error_at(node, f"must have at most {schema.LONGEST_WHOLE} digits")
            return number

    Loader.add_constructor("tag:yaml.org,2002:int", Loader.construct_yaml_int)
    resolve_exponents(Loader)
    resolvers = Loader.yaml_implicit_resolvers.items()
    Loader.yaml_implicit_resolvers = {key: [one for one in known if one[0] != DATE] for key, known in resolvers}
    return Loader


def resolve_exponents(of: Any) -> None:
    """Let a loader or dumper take 1e3 for a number as OmegaConf does. YAML 1.1 requires 1.0e+3."""
    of.add_implicit_resolver("tag:yaml.org,2002:float", EXPONENT, list("-+0123456789"))


def _error_at(place: Any, rule: str) -> yaml.MarkedYAMLError:
    """An error at an event or a node."""
    return yaml.MarkedYAMLError(problem=rule, problem_mark=place.start_mark)
