"""Compose the YAML tree with Hydra, and remember which file or override each value came from."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import yaml

from runner import schema
from runner.errors import ConfigError, Problem
from runner.model import suggest
from runner.resources import directory

if TYPE_CHECKING:
    from omegaconf import DictConfig

GROUPS = ("vehicle", "cameras", "modes", "graph", "source", "pqos", "recording", "study", "link", "experiment")
COMMAND_LINE = "command line"
PICKED = "picked"  # package in which a group's file is composed alone
OPTIONAL = ("link", "experiment")  # groups of which no file need be chosen
OF_THE_PLACE = ("place", "pose", "weight", "device", "address", "clip", "graph", "source")  # keys of a mount
WHOLE = ("vehicle", "experiment")  # groups whose files speak of the whole document
PACKAGE_HEADER = "# @package _global_"  # a vehicle's file speaks of the whole document


@dataclass(frozen=True, slots=True)
class Part:
    """One file or override that took part, with its content and the place in the whole where it landed."""

    file: str
    package: schema.Path
    content: Any
    path: Path | None = None


@dataclass(frozen=True, slots=True)
class Composed:
    """The whole configuration as plain data, and its parts, the one with the last word first."""

    document: dict[str, Any]
    parts: list[Part] = field(default_factory=list)

    def problem(self, path: schema.Path, found: str | None, rule: str) -> Problem:
        """A problem of the whole, told of the file or override that it came from, by the path in there."""
        part = self._origin(path)
        return Problem(part.file, schema.dotted(path[len(part.package) :]), found, rule)

    def _origin(self, path: schema.Path) -> Part:
        """The part that has the value; for what is missing, the one that says most about its surroundings."""
        inside = [part for part in self.parts if path[: len(part.package)] == part.package]
        for length in range(len(path), 0, -1):
            makers = [part for part in inside if len(part.package) == length]
            above = (part for part in inside if len(part.package) < length)
            holders = [part for part in above if _holds(part.content, path[len(part.package) : length])]
            # For a missing key ask who made its surroundings, the most local file first.
            asked = [*holders, *makers] if length == len(path) else [*makers, *sorted(holders, key=_locality)]
            if asked:
                return asked[0]
        return self.parts[-1]


def _locality(part: Part) -> int:
    return -len(part.package)


def conf_directories(user: Path | None) -> list[Path]:
    """Where configuration files are looked up, the user's directory first."""
    packaged = directory("conf")
    return [user, packaged] if user else [packaged]


def compose(overrides: Sequence[str], user: Path | None = None) -> Composed:
    """Compose conf/config.yaml with the user's overrides.

    user    directory whose files shadow the packaged ones one by one
    raises  ConfigError
    """
    parsed = _parse_overrides(overrides)
    directories = conf_directories(user)
    problems = [p for override in parsed for p in _choice_problems(override, directories)]
    if problems:
        raise ConfigError(problems)
    _check_headers({o.key: str(o.value) for o in parsed if o.key == "experiment"}, directories)
    config, choices = _compose(parsed, directories)
    _check_headers(choices, directories)
    parts = [Part(COMMAND_LINE, (), _nested(o.key, o.value)) for o in reversed(parsed) if not o.choice]
    parts += reversed(list(_file_parts(directories, choices)))
    return _resolved(config, parts)


def _check_headers(choices: Mapping[str, str], directories: Sequence[Path]) -> None:
    """Whether files that speak of the whole document say so; Hydra would put them elsewhere without a word."""
    for file in (find_file(directories, group, choices[group]) for group in WHOLE if group in choices):
        if file.exists() and PACKAGE_HEADER.encode() not in file.read_bytes():
            rule = f"must begin with the line {PACKAGE_HEADER}"
            raise ConfigError([Problem(label(file, directories), "", None, rule)])


def recompose(base: dict[str, Any], name: str, overrides: Sequence[str], user: Path | None = None) -> Composed:
    """A configuration that was composed before, with the user's overrides on top; a group's file replaces that part.

    base    the document, as a drive keeps it; name: where it stands, for messages
    raises  ConfigError
    """
    if not overrides:
        return Composed(base, [Part(name, (), base)])
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    parsed = _parse_overrides(overrides)
    problems = [p for override in parsed for p in _choice_problems(override, conf_directories(user))]
    if problems:
        raise ConfigError(problems)
    config = OmegaConf.create(base)
    for override in sorted(parsed, key=lambda o: not o.choice):
        try:
            if override.text.startswith("~") or override.is_none:
                above, _, key = override.key.rpartition(".")
                (OmegaConf.select(config, above) if above else config).pop(key, None)
            for key, value in _replaced(override, config, user):
                OmegaConf.update(config, key, value, merge=not override.choice)
        except (OmegaConfBaseException, ValueError, TypeError, AttributeError, KeyError) as error:
            rule = str(error).partition("\n")[0]
            raise ConfigError([Problem(COMMAND_LINE, override.key, None, rule)]) from None
    parts = [Part(COMMAND_LINE, (), _nested(o.key, o.value)) for o in reversed(parsed) if not o.choice]
    document = cast("dict[str, Any]", OmegaConf.to_container(config))
    return Composed(document, [*parts, Part(name, (), base)])


def _mounted(kind: dict[str, Any], config: DictConfig, package: str) -> dict[str, Any]:
    """Another kind of camera in the place of one that is mounted: what belongs to the place stays."""
    from omegaconf import OmegaConf

    before = OmegaConf.select(config, package) or {}
    return {**{key: before[key] for key in OF_THE_PLACE if key in before}, **kind}


def _replaced(override: Override, config: DictConfig, user: Path | None) -> Iterator[tuple[str, Any]]:
    """Keys that an override of a composed document sets, and to what."""
    if override.text.startswith("~") or override.is_none:
        return
    if not override.choice:
        yield override.key, override.value
        return
    group, _, package = override.key.lstrip("/").partition("@")
    if group == "experiment":
        raise ValueError("an experiment is a configuration of its own: name what of it is to change")
    if group == "vehicle":
        document = compose([f"{group}={override.value}"], user).document
        yield from ((key, document[key]) for key in ("name", "cameras"))
    else:
        document = compose([f"+{group}@{PICKED}={override.value}"], user).document
        yield package or group, _mounted(document[PICKED], config, package) if group == "cameras" else document[PICKED]


# --- overrides --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Override:
    """One override: a choice of a group's file, or a value."""

    text: str
    key: str
    value: Any
    choice: bool

    @property
    def is_none(self) -> bool:
        """Whether it takes away a choice that need not be made."""
        return self.choice and self.key in OPTIONAL and self.value == "null"

    @property
    def hydra(self) -> str:
        """As Hydra is to read it. A value may add a key that no file states; the schema knows which keys there are."""
        if self.is_none:
            return f"~{self.key}"
        return self.text if self.choice or self.text[0] in "+~" else f"++{self.text}"


def _parse_overrides(overrides: Sequence[str]) -> list[Override]:
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException

    parser, parsed, problems = OverridesParser.create(), [], []
    for text in overrides:
        try:
            override = parser.parse_override(text)
            group = override.key_or_group.split("@")[0].lstrip("/")
            if override.is_sweep_override():
                raise HydraException("a,b,c is a sweep; write [a,b,c] for a list")
            if group.partition(".")[0].partition("/")[0] in ("", "hydra"):
                raise HydraException("no such key")
            value = None if override.is_delete() else override.value()
            choice = group in GROUPS and not isinstance(value, dict)
            if choice and value is None and not override.is_delete():
                value = "null"
            parsed.append(Override(text, override.get_key_element().lstrip("+~"), value, choice))
        except HydraException as error:
            rule = str(error).splitlines()[0]
            plain = "sweep" in rule or "no such" in rule
            hint = "" if plain else """; quote a value with special characters: 'key="value"'"""
            problems.append(Problem(COMMAND_LINE, "", text, rule + hint))
    if problems:
        raise ConfigError(problems)
    return parsed


def _choice_problems(override: Override, directories: Sequence[Path]) -> Iterator[Problem]:
    """A choice of a file that is not there, or a value for a key that belongs to the whole document."""
    if not override.choice or override.value is None or override.is_none:
        return
    group = override.key.split("@")[0].lstrip("/")
    known = options(group, directories)
    if str(override.value) not in known:
        rule = f"no such file in conf/{group}/, {suggest(str(override.value), known)}"
        yield Problem(COMMAND_LINE, override.key, str(override.value), rule)


def _nested(key: str, value: Any) -> Any:
    """{"a": {"b": value}} for a.b."""
    for part in reversed(key.split(".")):
        value = {part: value}
    return value


# --- Hydra ------------------------------------------------------------------------------------------------------------


def _compose(overrides: Sequence[Override], directories: Sequence[Path]) -> tuple[DictConfig, dict[str, str]]:
    """What Hydra composes, and by group the file that was chosen."""
    from hydra import compose as hydra_compose
    from hydra import initialize_config_dir
    from hydra.core.global_hydra import GlobalHydra
    from hydra.errors import HydraException
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    # OmegaConf's own resolver for environment variables is no part of this language: a file says what it says.
    OmegaConf.clear_resolver("oc.env")
    _search(directories)
    GlobalHydra.instance().clear()
    try:
        with initialize_config_dir(str(directories[-1]), version_base="1.3"):
            config = hydra_compose("config", [o.hydra for o in overrides], return_hydra_config=True)
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ConfigError(_unreadable_files(directories) or [Problem("conf", "", None, str(error))]) from None
    except (HydraException, OmegaConfBaseException) as error:
        problem = _hydra_problem(error, directories)
        clear = problem.rule and "Cannot merge" not in str(error)
        raise ConfigError([problem] if clear else _misshapen_files(directories) or [problem]) from None
    except (ValueError, TypeError, AttributeError, RecursionError) as error:
        # What Hydra takes for granted: that a file is a mapping, and its defaults list a list of names.
        rule = str(error).partition("\n")[0]
        raise ConfigError(_misshapen_files(directories) or [Problem("conf", "", None, rule)]) from None
    choices = {str(key): str(value) for key, value in config.hydra.runtime.choices.items()}
    return config, choices


def _resolved(config: DictConfig, parts: list[Part]) -> Composed:
    """The composed tree as plain data, interpolations resolved."""
    from omegaconf import OmegaConf, open_dict
    from omegaconf.errors import OmegaConfBaseException

    with open_dict(config):
        del config["hydra"]
    try:
        document = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    except OmegaConfBaseException as error:
        origin = Composed({}, parts)
        path = tuple(int(p) if p.isdigit() else p for p in re.split(r"[.\[\]]+", str(error.full_key or "")) if p)
        raise ConfigError([origin.problem(path, None, str(error).splitlines()[0])]) from None
    return Composed(cast("dict[str, Any]", document), parts)


def _search(directories: Sequence[Path]) -> None:
    """Let the user's directory shadow the packaged files; Hydra's own --config-dir only appends."""
    from hydra.core.config_search_path import ConfigSearchPath
    from hydra.core.plugins import Plugins
    from hydra.plugins.search_path_plugin import SearchPathPlugin

    class UserDirectory(SearchPathPlugin):
        def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
            for user in reversed(_USER_DIRECTORIES):
                search_path.prepend("tod-runner", f"file://{user}")

    if not _USER_DIRECTORIES and len(directories) == 1:
        return
    _USER_DIRECTORIES[:] = directories[:-1]
    if not _REGISTERED:
        Plugins.instance().register(UserDirectory)
        _REGISTERED.append(UserDirectory)


_USER_DIRECTORIES: list[Path] = []
_REGISTERED: list[type] = []


def _hydra_problem(error: Exception, directories: Sequence[Path]) -> Problem:
    """Hydra's message as one problem; a file missing from a defaults list gets a suggestion."""
    text = str(error)
    missing = re.search(r"In '([\w/.-]+)': Could not (?:find|load) '([\w/.-]+)'", text)
    if missing:
        where, wanted = missing.groups()
        group, name = _place(wanted)
        known = options(group, directories)
        hint = suggest(name, known) if known else f"groups are {', '.join(f'/{g}' for g in GROUPS)}"
        overriding = _overriding(group, name, directories)
        file = overriding or label(find_file(directories, *_place(where)), directories)
        return Problem(file, "defaults", repr(wanted), f"no such file, {hint}")
    lines = [line.strip() for line in text.partition("Config search path:")[0].splitlines() if line.strip()]
    rule = "; ".join(lines)
    twice = re.search(r"Multiple values for ([\w/@.-]+?)\. ", text)
    if twice:
        rule = f"is chosen twice; to choose again write override /{twice[1]}: FILE"
        return Problem(_chooser(twice[1], directories), "defaults", repr(f"/{twice[1]}"), rule)
    inside = re.search(r"In '([\w/.-]+)': (?:\w+ raised while composing config:; )?(.*)", rule)
    if inside:
        rule = re.sub("Cannot merge.*", "a key is a list here and a mapping in a file that this builds on", inside[2])
        return Problem(label(find_file(directories, *_place(inside[1])), directories), "", None, rule)
    interpolation = re.search(r"Error resolving interpolation '(.+?)'", text)
    if interpolation:
        paths = (path for path in _files(directories) if interpolation[1] in path.read_text(encoding="utf-8"))
        rule = "a defaults list may refer to a choice above it only, such as ${vehicle}"
        for path in paths:
            return Problem(label(path, directories), "defaults", interpolation[1], rule)
    return Problem(COMMAND_LINE, "", None, rule)


def _place(name: str) -> tuple[str, str]:
    """Group and file of a name like vehicle/tum_q7."""
    group, _, file = name.rpartition("/")
    return group, file


def _chooser(key: str, directories: Sequence[Path]) -> str:
    """The file whose defaults list speaks of a group and package most often, the user's files first."""

    def times(path: Path) -> int:
        content = load_file(path)
        entries = content.get("defaults") if isinstance(content, dict) else None
        keys = [next(iter(entry)) for entry in entries or () if isinstance(entry, dict)]
        return sum(str(k).removeprefix("/") == key for k in keys)

    return label(max(_files(directories), key=times), directories)


def _overriding(group: str, name: str, directories: Sequence[Path]) -> str:
    """The file whose defaults list chooses a file of a group in place of another, or ""; Hydra names its reader."""
    for path in _files(directories):
        content = load_file(path)
        entries = content.get("defaults") if isinstance(content, dict) else None
        pairs = [pair for entry in entries or () if isinstance(entry, dict) for pair in entry.items()]
        if any(str(key).replace(" /", " ") == f"override {group}" and value == name for key, value in pairs):
            return label(path, directories)
    return ""


# --- files ------------------------------------------------------------------------------------------------------------


@cache
def load_file(path: Path) -> Any:
    """Content of a YAML file as OmegaConf reads it: YAML 1.1, duplicate keys refused.

    raises  yaml.YAMLError, OSError, UnicodeDecodeError
    """
    from omegaconf._utils import get_yaml_loader

    with path.open(encoding="utf-8") as file:
        return yaml.load(file, Loader=get_yaml_loader())


def options(group: str, directories: Sequence[Path]) -> list[str]:
    """Names of the files that may be chosen for a group."""
    return sorted({path.stem for d in directories for path in (d / group).glob("*.yaml")})


def _files(directories: Sequence[Path]) -> Iterator[Path]:
    """Every YAML file, the user's first."""
    return (path for d in directories for path in sorted(d.rglob("*.yaml")))


def find_file(directories: Sequence[Path], group: str, name: str) -> Path:
    """The first file of that name; where there is none, the place where it would be."""
    candidates = [d / group / f"{name}.yaml" for d in directories]
    return next((path for path in candidates if path.exists()), candidates[0])


def label(path: Path, directories: Sequence[Path]) -> str:
    """A file as messages name it: conf/... for a packaged one, the path as the user gave it for his own."""
    packaged = directories[-1]
    return f"conf/{path.relative_to(packaged)}" if path.is_relative_to(packaged) else str(path)


def yaml_problem(error: Exception, path: str) -> Problem:
    """A file that is no YAML."""
    mark = getattr(error, "problem_mark", None)
    what = getattr(error, "problem", None) or str(error)
    line = f"line {mark.line + 1}" if mark else ""
    return Problem(path, line, None, " ".join(str(what).split()))


def _unreadable_files(directories: Sequence[Path]) -> list[Problem]:
    problems = []
    for path in _files(directories):
        try:
            load_file(path)
        except (yaml.YAMLError, UnicodeDecodeError) as error:
            problems.append(yaml_problem(error, label(path, directories)))
    return problems


def _misshapen_files(directories: Sequence[Path]) -> list[Problem]:
    """Files that are YAML and yet no configuration."""
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    problems = []
    for path in _files(directories):
        content, file = load_file(path), label(path, directories)
        if content is None:
            continue
        if not isinstance(content, dict):
            problems.append(Problem(file, "", schema.shown(content), "must be a mapping"))
            continue
        if _is_circular(content, []):
            problems.append(Problem(file, "", None, "an alias, *NAME, stands inside what it refers to"))
            continue
        entries = content.get("defaults", [])
        if not isinstance(entries, list):
            problems.append(Problem(file, "defaults", schema.shown(entries), "must be a list"))
            continue
        for index, entry in enumerate(entries):
            where = f"defaults[{index}]"
            if entry == path.stem:
                problems.append(Problem(file, where, repr(entry), "is this file itself"))
            elif not isinstance(entry, str) and not (isinstance(entry, dict) and len(entry) == 1):
                problems.append(Problem(file, where, schema.shown(entry), "must be a file's name or GROUP: NAME"))
        try:
            OmegaConf.create(content)
        except OmegaConfBaseException as error:
            problems.append(Problem(file, str(error.full_key or ""), None, str(error).partition("\n")[0]))
    return problems


def _is_circular(value: Any, above: list[int]) -> bool:
    if not isinstance(value, dict | list):
        return False
    inner = value.values() if isinstance(value, dict) else value
    return id(value) in above or any(_is_circular(part, [*above, id(value)]) for part in inner)


def _file_parts(directories: Sequence[Path], choices: dict[str, str]) -> Iterator[Part]:
    """The files behind a composition, in the order in which Hydra merged them."""
    root = find_file(directories, "", "config")
    yield Part(label(root, directories), (), load_file(root), root)
    # Mounted files first: a vehicle file says last what belongs to the place. An experiment has the last word.
    for key, name in sorted(choices.items(), key=lambda item: ("@" not in item[0], item[0] == "experiment")):
        group, _, package = key.partition("@")
        if group.startswith("hydra") or group not in GROUPS or name == "None":
            continue
        where = tuple(package.split(".")) if package else () if group in WHOLE else (group,)
        yield from _with_bases(find_file(directories, group, name), group, where, directories)


def _with_bases(path: Path, group: str, package: schema.Path, directories: Sequence[Path]) -> Iterator[Part]:
    """A group's file after those of its own group that its defaults list builds on."""
    content = load_file(path)
    for entry in (content or {}).get("defaults", []):
        if isinstance(entry, str) and entry != "_self_":
            yield from _with_bases(find_file(directories, group, entry), group, package, directories)
    yield Part(label(path, directories), package, content, path)


def _holds(content: Any, path: schema.Path) -> bool:
    for part in path:
        # An override names the first entry of a list as a.0, a file has a list there.
        key = str(part) if isinstance(content, dict) else part
        try:
            content = content[key]
        except (KeyError, IndexError, TypeError):
            return False
    return True
