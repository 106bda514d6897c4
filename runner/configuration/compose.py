"""Composes the YAML tree with Hydra, and records the file or override that each value comes from."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, cast

from runner import schema
from runner.configuration.files import GROUPS, ROOT, bases_of, chosen_by, conf_directories, defaults, find_file, options
from runner.configuration.interpolation import expands_within, spliced, value_at
from runner.configuration.origin import PICKED, Composed, Part, nested
from runner.configuration.overrides import Override, choice_problems, parse_overrides, rule_problems
from runner.configuration.yaml_file import label, load_file, read
from runner.core.model import Mode
from runner.errors import COMMAND_LINE, ConfigError, Problem, suggest

if TYPE_CHECKING:
    from omegaconf import DictConfig

    from runner.configuration.site import Site

# keys of a mount that stay when its kind of camera is replaced
KEPT_KEYS = (
    *("place", "pose", "weight", "floor_kbps", "shed", "redundant", "graph", "source"),
    *("device", "address", "clip", "bag", "topic", "capture", "credentials"),
)
RESTATED = (
    "is stated in {first}, too, and both would be merged, with the rules of that file in their old places; "
    "write out all modes in one file, without the other in defaults; a single number: modes.MODE.RULE.NUMBER=VALUE"
)
WHOLE = ("vehicle", "experiment")  # groups whose files apply to the whole document
MAX_RESOLVED = 50_000  # values of a configuration with its interpolations expanded
PACKAGE_HEADER = "# @package _global_"  # a vehicle's file applies to the whole document


def compose(
    overrides: Sequence[str],
    user: Path | None = None,
    site: Path | None = None,
    instead: Mapping[str, str] = MappingProxyType({}),
) -> Composed:
    """Compose conf/config.yaml with the user's overrides.

    user     directory whose files shadow the packaged ones one by one
    site     file of this machine, between these files and the overrides
    instead  by group, the choice in place of that of the packaged conf/config.yaml
    raises   ConfigError
    """
    from omegaconf import open_dict

    parsed = parse_overrides(overrides)
    directories = conf_directories(user)
    problems = [p for override in parsed for p in (*choice_problems(override, directories), *rule_problems(override))]
    of_site, more = _site(site, directories)
    if problems := [*problems, *more]:
        raise ConfigError(problems)
    _check_headers({o.key: str(o.value) for o in parsed if o.key == "experiment"}, directories)
    by_site = _chosen_by(of_site, parsed)
    config, choices = _compose([*by_site, *parsed], directories, instead, of_site.content if of_site else None)
    _check_headers(choices, directories)
    parts = [_part(override) for override in reversed(parsed) if override.deletes or not override.choice]
    files = list(_file_parts(directories, choices))
    if problems := list(_restated(files)):
        raise ConfigError(problems)
    parts += [Part(label(of_site.path), (), of_site.content, of_site.path)] if of_site else []
    parts += reversed(files)
    with open_dict(config):
        del config["hydra"]
    composed = _resolved(config, parts, choices)
    if of_site and (problems := list(of_site.problems(composed.document))):
        raise ConfigError(problems)
    return composed


def _site(path: Path | None, directories: Sequence[Path]) -> tuple[Site | None, list[Problem]]:
    """The site file, if there is one, or its problems."""
    if path is None:
        return None, []
    from runner.configuration.site import read_site

    try:
        site = read_site(path)
    except ConfigError as error:
        return None, list(error.problems)
    words = parse_overrides([f"{group}={name}" for group, name in site.choices.items()])
    problems = (problem for word in words for problem in choice_problems(word, directories))
    return site, [replace(problem, file=label(path)) for problem in problems]


def _chosen_by(site: Site | None, overrides: Sequence[Override]) -> list[Override]:
    """The choices of a site file that no override replaces."""
    stated = {override.key for override in overrides}
    choices = site.choices.items() if site else ()
    return parse_overrides([f"{group}={name}" for group, name in choices if group not in stated])


def _check_headers(choices: Mapping[str, str], directories: Sequence[Path]) -> None:
    """Check that files for the whole document declare it; Hydra would silently put them elsewhere."""
    for file in (find_file(directories, group, choices[group]) for group in WHOLE if group in choices):
        if file.exists() and read(file).package != "_global_":
            rule = f"must begin with the line {PACKAGE_HEADER}"
            raise ConfigError([Problem(label(file), "", None, rule)])


def recompose(base: dict[str, Any], name: str, overrides: Sequence[str], user: Path | None = None) -> Composed:
    """Apply the user's overrides to a configuration composed before; a group's file replaces that part.

    base    the document, as stored with a drive; name: its location, for messages
    raises  ConfigError
    """
    if not overrides:
        return Composed(base, [Part(name, (), base)])
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    parsed = parse_overrides(overrides)
    directories = conf_directories(user)
    problems = [p for override in parsed for p in (*choice_problems(override, directories), *rule_problems(override))]
    if problems:
        raise ConfigError(problems)
    config = OmegaConf.create(base)
    for override in sorted(parsed, key=lambda o: not o.choice):
        try:
            if override.deletes or override.is_none:
                above, _, key = override.key.rpartition(".")
                (OmegaConf.select(config, above) if above else config).pop(key, None)
            for key, value in _replaced(override, config, user):
                OmegaConf.update(config, key, value, merge=not override.choice)
        except (OmegaConfBaseException, ValueError, TypeError, AttributeError, KeyError) as error:
            rule = str(error).partition("\n")[0]
            raise ConfigError([Problem(COMMAND_LINE, override.key, None, rule)]) from None
    parts = [_part(override) for override in reversed(parsed) if override.deletes or not override.choice]
    document = cast("dict[str, Any]", OmegaConf.to_container(config))
    return Composed(document, [*parts, Part(name, (), base)])


def _mounted(kind: dict[str, Any], config: DictConfig, package: str) -> dict[str, Any]:
    """Replace the kind of a mounted camera: keys that belong to the mount stay."""
    from omegaconf import OmegaConf

    before = OmegaConf.select(config, package) or {}
    return {**{key: before[key] for key in KEPT_KEYS if key in before}, **kind}


def _replaced(override: Override, config: DictConfig, user: Path | None) -> Iterator[tuple[str, Any]]:
    """Keys that an override of a composed document sets, and their values."""
    if override.deletes or override.is_none:
        return
    if not override.choice:
        yield override.key, override.value
        return
    group, _, package = override.key.lstrip("/").partition("@")
    if group == "experiment":
        raise ValueError("an experiment is a whole configuration: override individual keys instead")
    if group == "vehicle":
        document = compose([f"{group}={override.value}"], user).document
        yield from ((key, document[key]) for key in ("name", "cameras"))
    else:
        document = compose([f"+{group}@{PICKED}={override.value}"], user).document
        yield package or group, _mounted(document[PICKED], config, package) if group == "cameras" else document[PICKED]


def _part(override: Override) -> Part:
    return Part(COMMAND_LINE, (), nested(override.key, override.value), word=override.text)


# --- Hydra ------------------------------------------------------------------------------------------------------------


def _compose(
    overrides: Sequence[Override],
    directories: Sequence[Path],
    instead: Mapping[str, str],
    site: Mapping[str, Any] | None,
) -> tuple[DictConfig, dict[str, str]]:
    """Hydra's composition, and by group the chosen file."""
    from hydra import compose as hydra_compose
    from hydra import initialize_config_dir
    from hydra.core.global_hydra import GlobalHydra
    from hydra.errors import HydraException
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    from runner.configuration.hydra_files import search, without_launchers

    # OmegaConf's resolver for environment variables is not supported: only files define values.
    OmegaConf.clear_resolver("oc.env")
    search(directories, instead, site)
    root = find_file(directories, "", ROOT)
    chosen = {key for key, _ in chosen_by(root)}
    words = [o.hydra(chosen) for o in overrides]
    GlobalHydra.instance().clear()
    try:
        with initialize_config_dir(str(directories[-1]), version_base="1.3"), without_launchers():
            config = hydra_compose(ROOT, words, return_hydra_config=True)
    except (HydraException, OmegaConfBaseException) as error:
        raise ConfigError(_list_problems(error, directories) or [_hydra_problem(error, directories)]) from None
    except (TypeError, ValueError) as error:
        if "deletion value must be a string" in str(error):
            word = " ".join(o.text for o in overrides if o.deletes and repr(o.text) in str(error))
            rule = f"what follows = must be the name of a file; to remove the choice itself: {word.partition('=')[0]}"
            raise ConfigError([Problem(COMMAND_LINE, "", word, rule)]) from None
        if not re.search(r"is not an int|invalid literal for int|list indices must be integers", str(error)):
            raise
        rule = "list entries are addressed by index, from 0, and cannot be removed; override the whole list"
        raise ConfigError([Problem(COMMAND_LINE, "", " ".join(o.text for o in overrides), rule)]) from None
    except RecursionError:
        rule = "files include each other in a cycle"
        raise ConfigError([Problem(COMMAND_LINE, "", " ".join(o.text for o in overrides), rule)]) from None
    choices = {str(key): str(value) for key, value in config.hydra.runtime.choices.items()}
    return config, choices


def _wanted(value: str, replaces: str) -> str:
    """What a list or mapping of the command line should be, by Hydra's words on what it replaces."""
    if value.startswith("["):
        return "must be a mapping"
    if "object_type=list" in replaces:
        return "must be a list"
    return "has a list in place of a mapping, or the reverse"


def _hydra_problem(error: Exception, directories: Sequence[Path]) -> Problem:
    """Hydra's message as one problem; a file missing from a defaults list gets a suggestion."""
    text = str(error)
    missing = re.search(r"In '([\w/.-]+)': Could not (?:find|load) '([\w/.-]+)'", text)
    if missing:
        where, wanted = missing.groups()
        group, name = _place(wanted)
        known = options(group, directories)
        hint = suggest(name, known) if known else f"; expected one of the groups {', '.join(f'/{g}' for g in GROUPS)}"
        overriding = _overriding(group, name, directories)
        file = overriding or label(find_file(directories, *_place(where)))
        return Problem(file, "defaults", repr(wanted), f"no such file{hint}")
    lines = [line.strip() for line in text.partition("Config search path:")[0].splitlines() if line.strip()]
    rule = "; ".join(lines)
    twice = re.search(r"Multiple values for ([\w/@.-]+?)\. ", text)
    if twice:
        rule = f"is chosen twice; to replace a choice write override /{twice[1]}: FILE"
        return Problem(_chooser(twice[1], directories), "defaults", repr(f"/{twice[1]}"), rule)
    inside = re.search(r"In '([\w/.-]+)': (?:\w+ raised while composing config:; )?(.*)", rule)
    if inside:
        rule = re.sub("Cannot merge.*", "a key is a list here and a mapping in a file that this builds on", inside[2])
        return Problem(label(find_file(directories, *_place(inside[1]))), "", None, rule)
    interpolation = re.search(r"Error resolving interpolation '(.+?)'", text)
    if interpolation:
        rule = "a defaults list may refer only to a choice above it, such as ${vehicle}"
        for path, entries in defaults(directories):
            if any(interpolation[1] in value for _, value in entries):
                return Problem(label(path), "defaults", interpolation[1], rule)
    merged = re.search(r"Error merging override \+*([\w.@/-]+)=([\[{].*)", text)
    if merged:
        return Problem(COMMAND_LINE, merged[1], merged[2], _wanted(merged[2], replaces=str(error.__cause__)))
    return Problem(COMMAND_LINE, "", None, rule)


def _list_problems(error: Exception, directories: Sequence[Path]) -> list[Problem]:
    """The lists of a modes file that Hydra cannot merge with the mappings of the file that it builds on."""
    found = re.search(r"In 'modes/([\w.-]+)': .*Cannot merge", str(error).replace("\n", " "))
    path = find_file(directories, "modes", found[1]) if found else None
    return [Problem(label(path), schema.dotted(f.path), f.found, f.rule) for f in _findings(path)] if path else []


def _findings(path: Path) -> list[schema.Finding]:
    return schema.findings(load_file(path), path.parent.name)


def _place(name: str) -> tuple[str, str]:
    """Group and file of a name like vehicle/tum_q7."""
    group, _, file = name.rpartition("/")
    return group, file


def _chooser(key: str, directories: Sequence[Path]) -> str:
    """The file whose defaults list mentions a group and package most often, the user's files first."""

    def times(of: tuple[Path, list[tuple[str, str]]]) -> int:
        return sum(chosen.removeprefix("/") == key for chosen, _ in of[1])

    return label(max(defaults(directories), key=times)[0])


def _overriding(group: str, name: str, directories: Sequence[Path]) -> str:
    """The file whose defaults list overrides the choice of a group's file, or ""; Hydra names another one."""
    for path, entries in defaults(directories):
        if any(key.replace(" /", " ") == f"override {group}" and value == name for key, value in entries):
            return label(path)
    return ""


# --- files ------------------------------------------------------------------------------------------------------------


def _file_parts(directories: Sequence[Path], choices: dict[str, str]) -> Iterator[Part]:
    """The files behind a composition, in the order in which Hydra merged them."""
    root = find_file(directories, "", ROOT)
    yield Part(label(root), (), load_file(root), root)
    # Mounted files first: a vehicle file overrides values of the mount. An experiment overrides all others.
    for key, name in sorted(choices.items(), key=lambda item: ("@" not in item[0], item[0] == "experiment")):
        group, _, package = key.partition("@")
        if group.startswith("hydra") or group not in GROUPS or name == "None":
            continue
        where = tuple(package.split(".")) if package else () if group in WHOLE else (group,)
        yield from _with_bases(find_file(directories, group, name), group, where, directories)


def _restated(files: Sequence[Part]) -> Iterator[Problem]:
    """Modes whose rules a file states again: Hydra would merge both, and keep the places of the earlier rules.

    files  in the order in which Hydra merged them

    A file of another group may change numbers of rules that the mode has, but not add rules.
    """
    stated: dict[schema.Path, tuple[str, set[str]]] = {}  # by place of a mode, the first file, and names of rules
    for part in files:
        is_modes = part.path is not None and part.path.parent.name == "modes"
        place = part.package if is_modes else (*part.package, "modes")
        stating = part.content if is_modes else value_at(part.content, ("modes",))
        for mode in Mode:
            rules = value_at(stating, (mode,))
            if not isinstance(rules, dict):
                continue
            first, known = stated.setdefault((*place, mode), (part.file, set()))
            if first != part.file and (is_modes or not rules.keys() <= known):
                path = schema.dotted((*place, mode)[len(part.package) :])
                yield Problem(part.file, path, None, RESTATED.format(first=first))
            known.update(rules)


def _with_bases(path: Path, group: str, package: schema.Path, directories: Sequence[Path]) -> Iterator[Part]:
    """A group's file, after those of its own group that it builds on."""
    for base in bases_of(path):
        yield from _with_bases(find_file(directories, group, base), group, package, directories)
    yield Part(label(path), package, load_file(path), path)


def _resolved(config: DictConfig, parts: Sequence[Part], choices: Mapping[str, str]) -> Composed:
    """The composed tree as plain data, interpolations resolved.

    choices  by group, the chosen file
    raises  ConfigError
    """
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    written = OmegaConf.to_container(config)
    if not expands_within(written, MAX_RESOLVED):
        file = next(part.file for part in parts if "${" in str(part.content))
        rule = f"interpolations, ${{...}}, are nested too deeply or expand to more than {MAX_RESOLVED} values"
        raise ConfigError([Problem(file, "", None, rule)])
    try:
        document = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    except OmegaConfBaseException as error:
        origin = Composed({}, list(parts))
        path = tuple(int(p) if p.isdigit() else p for p in re.split(r"[.\[\]]+", str(error.full_key or "")) if p)
        raise ConfigError([origin.problem(path, None, str(error).splitlines()[0])]) from None
    document, moved = spliced(written, document)
    return Composed(cast("dict[str, Any]", document), list(parts), moved, choices).without_graph_parts()
