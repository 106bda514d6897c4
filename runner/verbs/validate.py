"""usage: tod-runner validate [OVERRIDE ...] [FILE ...] [conf=DIR] [all=true] [target=NAME|FILE]

Checks the files of your directory against their schemas, then the configurations composed from them: each file once
with the choices of the command line, otherwise the defaults; each vehicle also with each of your graphs and sources.
Without a directory the packaged files are checked, and the one configuration that the command line names. With all=true
every vehicle is combined with every graph and source, every other file is composed once, and a file that refers to
another group, or chooses from it, is combined with each file of that group. Packaged experiments, with all their runs,
and links are composed unchanged.

FILE, a word that ends in .yaml or .yml, limits the check to that file and the files that build on it. Its directory is
conf=DIR, otherwise the nearest one above it that has folders of groups.

If GStreamer is installed, configurations are also checked against its registry: elements, properties, types, ranges,
and whether the properties that knobs set may change while playing. With target= the registry is that of another
machine: gstreamer-1.22 (Debian 12), gstreamer-1.26 (Debian 13) and gstreamer-1.28 (Debian testing) come with this
package, and `tod-runner doctor registry=FILE` writes that of your vehicle. Maps, traces and tracks of pqos files are
read. If there are problems, all of them are reported and the verb ends with status 2. If DIR/.schemas, which your
editor uses, comes from another version of tod-runner, a warning is printed to standard error.

  tod-runner validate conf=my_vehicles                       your files, for example in CI
  tod-runner validate my_vehicles/vehicle/van.yaml           one of them, for example before a commit
  tod-runner validate conf=my_vehicles vehicle=van           one of your vehicles with your graphs and sources
  tod-runner validate vehicle=tum_q7 pqos.file=yard.csv      one configuration
  tod-runner validate conf=my_vehicles target=gstreamer-1.28 for a vehicle with that GStreamer
  tod-runner validate all=true                               everything that is packaged
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from functools import cache
from itertools import chain, product, repeat
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from runner import schema
from runner.configuration.build import PlanCheck
from runner.configuration.compose import compose
from runner.configuration.config import Configuration
from runner.configuration.files import (
    GROUPS,
    LAYOUT,
    bases_of,
    built_on,
    chosen_by,
    conf_directories,
    find_file,
    options,
    states,
)
from runner.configuration.overrides import choosable
from runner.configuration.yaml_file import label, load_file, load_node
from runner.configuration.yaml_file import read as read_yaml
from runner.core.model import ModelError
from runner.elements.check import check_plan
from runner.elements.description import Registry
from runner.elements.packages import missing_plugins, missing_recorders
from runner.errors import COMMAND_LINE, ArgumentError, ConfigError, MissingBindings, Problem, RunError, suggest
from runner.graph import Plan, may_lack_parameter_sets
from runner.system.files import file_problem
from runner.verbs import Arguments

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from runner.sound import SoundPlan
    from runner.voice import VoicePlan

FOLDERS = (*GROUPS, LAYOUT)  # of checked files
DATA = ("maps", "traces")  # folders for data that pqos files name; a bandwidth map may be YAML
CROSSED = ("vehicle", "graph", "source")  # groups whose files are combined with each other
# Packaged files of these groups are combined only with these choices, not with those of the command line; a link needs
# predictions whose rates it can follow.
STANDALONE: Mapping[str, tuple[str, ...]] = {"experiment": (), "link": ("pqos=constant",)}
ConfigReader = Callable[[Configuration], object]
READERS: dict[str, ConfigReader] = {  # by group, the reader of its part of the configuration, if not the vehicle
    "pqos": Configuration.pqos,
    "study": Configuration.study,
    "link": Configuration.link,
}
MOUNT = "validated"  # name under which a kind of camera is mounted
REFERENCE = re.compile(r"\$\{\s*(\w+)")
PER_WORKER = 10  # starting a worker takes as long as checking so many configurations
MOST_WORKERS = 8  # each takes 130 MB
ChosenFiles = tuple[tuple[str, str], ...]  # group and file


class ExperimentRun(NamedTuple):
    """One of the runs of an experiment: its location, and the overrides that it adds."""

    file: str
    path: str
    words: tuple[str, ...]

    def attributed(self, problem: Problem) -> Problem:
        """The problem; one of the command line is attributed to the run if the run added the word."""
        word = next((word for word in self.words if word.lstrip("+~").startswith(problem.path)), None)
        if problem.file != COMMAND_LINE or word is None:
            return problem
        return Problem(self.file, self.path, word, problem.rule)


class ValidationTask(NamedTuple):
    """A configuration to check: overrides, files chosen on top, and the run of an experiment among those."""

    overrides: tuple[str, ...]
    choices: ChosenFiles = ()
    run: ExperimentRun | None = None

    @property
    def words(self) -> tuple[str, ...]:
        places = {"cameras": f"+cameras@cameras.{MOUNT}"}
        chosen = (f"{places.get(group, group)}={name}" for group, name in self.choices)
        return (*self.overrides, *chosen, *(self.run.words if self.run else ()))

    @property
    def readers(self) -> Sequence[ConfigReader]:
        """The readers to apply to the configuration."""
        if not self.choices or "experiment" in dict(self.choices):
            return Configuration.pqos, Configuration.experiment, Configuration.link
        return [READERS.get(group, Configuration.setup) for group, _ in self.choices]


class Result(NamedTuple):
    """What was found in a configuration: problems, notes, and the runs of its experiment if there are no problems."""

    problems: list[Problem]
    notes: dict[str, None]
    runs: list[ExperimentRun]


def run(arguments: Arguments) -> int:
    everything, target = arguments.choice("all") == "true", arguments.values.get("target")
    if target:
        registry_of(target)
    files, configurations, notes = 0, 0, dict[str, None]()
    for conf, named in _directories(arguments).items():
        _warn_of_other_schemas(conf)
        directories = conf_directories(conf)
        found, checked = check_files(directories if everything else directories[:1], named)
        if found:
            raise ConfigError(found)
        results = _check_all(_Tasks(tuple(arguments.overrides), conf, everything, named).selected(), conf, target)
        if problems := [problem for result in results.values() for problem in result.problems]:
            raise ConfigError(problems)
        files, configurations = files + checked, configurations + len({task.words for task in results})
        notes |= {note: None for result in results.values() for note in result.notes}
    print(f"valid: {_counted(files, 'file')}, {_counted(configurations, 'configuration')}")
    print("\n".join(sorted(notes)), end="\n" if notes else "")
    return 0


def _warn_of_other_schemas(conf: Path | None) -> None:
    if conf is None:
        return
    from runner.configuration.editors import version_problem

    if problem := version_problem(conf):
        print(problem, file=sys.stderr)


def _counted(count: int, what: str) -> str:
    return f"{count} {what}{'' if count == 1 else 's'}"


# --- files ------------------------------------------------------------------------------------------------------------


def _directories(arguments: Arguments) -> dict[Path | None, list[Path] | None]:
    """Configuration directories, and the files in each that are checked; None: all of them."""
    if not arguments.words:
        return {arguments.conf: None}
    found: dict[Path | None, list[Path] | None] = {}
    for word in arguments.words:
        file = Path(word)
        if not _is_yaml(file.name):
            raise ArgumentError("", word, "must be NAME=VALUE, or a file that ends in .yaml or .yml")
        if why := file_problem(file):
            raise ArgumentError("", word, why)
        inside = [arguments.conf] if arguments.conf else [*file.parents, *file.absolute().parents]
        above = [conf for conf in inside if _inside(conf, file) and any((conf / folder).is_dir() for folder in FOLDERS)]
        if not above:
            rule = "is in no configuration directory: none above it has vehicle/, cameras/, ..."
            raise ArgumentError("", word, f"is not in {arguments.conf}" if arguments.conf else rule)
        conf = above[0]
        found.setdefault(conf, []).append(_inside(conf, file))  # type: ignore[union-attr, arg-type]
    return found


def _inside(conf: Path, file: Path) -> Path | None:
    """A file's path below a directory, as named or with all links followed; None: it is elsewhere."""
    for path, top in ((Path(os.path.abspath(file)), Path(os.path.abspath(conf))), (file.resolve(), conf.resolve())):
        if path.is_relative_to(top):
            return conf / path.relative_to(top)
    return None


def check_files(directories: Sequence[Path], named: Collection[Path] | None) -> tuple[list[Problem], int]:
    """Check the YAML files of directories, or some of them, against the schemas of their groups; and count them."""
    problems: list[Problem] = []
    count = 0
    for directory in directories:
        for path in _yaml_files(directory):
            if named is not None and path not in named:
                continue
            count += 1
            problems += check_file(path, path.relative_to(directory))
    return problems, count


def _yaml_files(directory: Path) -> Iterator[Path]:
    """YAML files, also those in linked folders, except those in data folders and hidden folders."""
    for folder, folders, names in os.walk(directory, followlinks=True):
        here = Path(folder)
        skipped = DATA if here == directory else ()
        folders[:] = sorted(
            name for name in folders if name[0] != "." and name not in skipped and not _leads_back(here / name)
        )
        yield from (here / name for name in sorted(names) if _is_yaml(name))


def _leads_back(folder: Path) -> bool:
    """Whether a folder is a link to one of those that lead to it: following it would not end."""
    if not folder.is_symlink():
        return False
    target = folder.resolve()
    return any(above.resolve().is_relative_to(target) for above in folder.absolute().parents)


def _is_yaml(name: str) -> bool:
    return not name.startswith(".") and name.lower().endswith((".yaml", ".yml"))


def check_file(path: Path, relative: Path) -> Iterator[Problem]:
    """Problems of one file. The folder determines its schema."""
    name, group = label(path), "/".join(relative.parts[:-1])
    if rule := _misplaced(group, relative):
        yield Problem(name, "", None, rule)
        return
    try:
        if group == LAYOUT:
            from runner.configuration.layout import layout_problems

            yield from layout_problems(path)
            return
        load_node(path)
        content = load_file(path)
    except ConfigError as error:
        yield from error.problems
        return
    inherits = bool(bases_of(path))
    for finding in schema.findings(content, {"": "config", "cameras": "camera"}.get(group, group)):
        if inherits and finding.found == "missing":
            continue  # a base file may provide it; the combinations show whether one does
        yield Problem(name, schema.dotted(finding.path), finding.found, finding.rule)


def _misplaced(group: str, relative: Path) -> str | None:
    """Why Hydra would not find a file; None if it would."""
    first = relative.parts[0]
    if group and group not in FOLDERS:
        nested = f"files must be directly in {first}/, not in subfolders" if first in FOLDERS else ""
        return f"would be ignored: {nested or f'no such group as {group}/{suggest(group, GROUPS)}'}"
    if group == LAYOUT:
        return _misplaced_layout(relative)
    if not group and relative.stem != "config":
        return f"would be ignored: must be in the folder of its group, one of {', '.join(GROUPS)}, or config.yaml"
    if relative.suffix != ".yaml":
        return f"would be ignored: Hydra reads {relative.stem}.yaml"
    if group and not choosable(relative.stem):
        return "could not be chosen: the name must be letters, digits, _ and -, and no number, true, false or null"
    return None


def _misplaced_layout(relative: Path) -> str | None:
    """Why the page of no operator would read a file; None if one would."""
    from runner.mqtt.messages import OPERATOR

    if relative.suffix != ".yaml":
        return f"would be ignored: the page reads {relative.stem}.yaml"
    return None if OPERATOR.fullmatch(relative.stem) else "would be ignored: no operator can have this name"


# --- composed configurations ------------------------------------------------------------------------------------------


class _Tasks:
    """The configurations to compose.

    named  only configurations that use one of these files are checked; None: all
    """

    def __init__(
        self, overrides: tuple[str, ...], user: Path | None, everything: bool, named: Collection[Path] | None
    ) -> None:
        self._overrides, self._everything, self._named = overrides, everything, named
        self._directories = conf_directories(user)
        searched = self._directories if everything else self._directories[:-1]
        fixed = _fixed_groups(overrides)
        self._files = {group: options(group, searched) for group in GROUPS if group not in fixed}
        words = (word.lstrip("+").partition("=") for word in overrides)
        chosen = ((key.lstrip("/").partition("@")[0], name) for key, _, name in words)
        self._given = [each for each in chosen if each[0] in GROUPS and each[1] in options(each[0], self._directories)]

    def selected(self) -> list[ValidationTask]:
        return [task for task in dict.fromkeys(self._all()) if self._is_selected(task) and self._is_served(task)]

    def _all(self) -> Iterator[ValidationTask]:
        """Single files before combinations; the same task may occur twice."""
        yield ValidationTask(self._overrides)
        for group, names in self._files.items():
            for name in names:
                yield self._of_one_file(group, name)
        crossed: list[Sequence[str | None]] = [self._files.get(group) or [None] for group in CROSSED]
        for combination in product(*crossed):
            chosen = zip(CROSSED, combination, strict=True)
            yield ValidationTask(self._overrides, tuple((group, name) for group, name in chosen if name))
        if self._everything:
            yield from self._reached()

    def _of_one_file(self, group: str, name: str) -> ValidationTask:
        """A file with the choices of the command line."""
        packaged = name not in options(group, self._directories[:-1])
        overrides = STANDALONE[group] if packaged and group in STANDALONE else self._overrides
        return ValidationTask(overrides, ((group, name),))

    def _reached(self) -> Iterator[ValidationTask]:
        """Files that refer to other groups or choose from them, with every choice of those."""
        for group, names in self._files.items():
            for name in names if group not in STANDALONE else ():
                with suppress(ConfigError):  # reported for the file alone
                    for other in _reaches(find_file(self._directories, group, name)):
                        for choice in self._files.get(other, ()):
                            yield ValidationTask(self._overrides, ((group, name), (other, choice)))

    def _is_selected(self, task: ValidationTask) -> bool:
        if self._named is None:
            return True
        chosen = (find_file(self._directories, group, name) for group, name in (*task.choices, *self._given))
        files = {file for path in chosen for file in built_on(path, self._directories)}
        return not files.isdisjoint(self._named) or (not task.choices and self._root in self._named)

    def _is_served(self, task: ValidationTask) -> bool:
        """Whether the source of a combination delivers what its graph passes on; what somebody chose is checked."""
        files = dict(self._given) | dict(task.choices)
        graph, source = (find_file(self._directories, group, files.get(group, "")) for group in ("graph", "source"))
        passes = task.choices and states(graph, self._directories, "passes")
        return not passes or states(source, self._directories, "encoded")

    @property
    def _root(self) -> Path:
        return find_file(self._directories, "", "config")


def _fixed_groups(words: Iterable[str]) -> set[str]:
    """Groups from which the command line chooses, or whose values it overrides: those apply to the chosen file only."""
    keys = {word.lstrip("+~").partition("=")[0].partition("@")[0].partition(".")[0].lstrip("/") for word in words}
    return keys | ({"vehicle"} if "cameras" in keys else set())


def _reaches(path: Path) -> set[str]:
    """Groups other than its own whose choice may affect a file: it refers to, chooses from or fills them.

    raises  ConfigError if it cannot be read
    """
    content, package = read_yaml(path)
    named = set(REFERENCE.findall(str(content)))
    named |= {key.split()[1].lstrip("/").partition("@")[0] for key, _ in chosen_by(path) if key.startswith("override ")}
    if package == "_global_":
        named |= set(content) if isinstance(content, dict) else set()
    elif package:
        named.add(package.partition(".")[0])
    return named.intersection(GROUPS) - {path.parent.name, "cameras"}


def _check_all(tasks: Sequence[ValidationTask], user: Path | None, target: str | None) -> dict[ValidationTask, Result]:
    """What was found in each configuration, and in the runs of experiments, in the order of the tasks.

    A file that is invalid alone is combined with no other, and the runs of an invalid experiment are not checked.
    raises  RunError if a worker process dies
    """
    from concurrent.futures import BrokenExecutor

    alone = [task for task in tasks if len(task.choices) < 2]
    try:
        with _Workers(user, target) as workers:
            found = workers.check(alone)
            broken = {choice for task in alone if found[task].problems for choice in task.choices}
            runs = {task: [task._replace(run=run) for run in found[task].runs] for task in alone}
            combined = [task for task in tasks if task not in found and broken.isdisjoint(task.choices)]
            found |= workers.check([*chain.from_iterable(runs.values()), *combined])
    except BrokenExecutor:
        raise RunError("a worker process ended without a result: it may have run out of memory") from None
    return {each: found[each] for task in tasks for each in (task, *runs.get(task, ())) if each in found}


class _Workers(ExitStack):
    """Checks configurations: in worker processes on all cores, once there are enough to be worth their start."""

    def __init__(self, user: Path | None, target: str | None) -> None:
        super().__init__()
        self._user, self._target = user, target
        self._pool: Executor | None = None

    def check(self, tasks: Sequence[ValidationTask]) -> dict[ValidationTask, Result]:
        self._pool = self._pool or self._open_pool(len(tasks))
        in_order = self._pool.map if self._pool else map
        return dict(zip(tasks, in_order(_check, tasks, repeat(self._user), repeat(self._target)), strict=True))

    def _open_pool(self, tasks: int) -> Executor | None:
        workers = min(len(os.sched_getaffinity(0)), tasks // PER_WORKER, MOST_WORKERS)
        if workers < 2:
            return None
        from runner.system.spawned import process_pool

        try:
            return self.enter_context(process_pool(workers))
        except OSError:  # no shared memory for its queue, as in some containers
            return None


def _check(task: ValidationTask, user: Path | None, target: str | None) -> Result:
    notes: dict[str, None] = {}
    runs: list[ExperimentRun] = []
    try:
        composed = compose(task.words, user)
        config = Configuration(composed, user, runnable=False, bags=True, check=_registry_check(notes, target))
        problems = _problems(config, task.readers)
        runs = [] if problems else list(_runs(task, composed.document, user))
    except ConfigError as error:
        problems = error.problems
    return Result([task.run.attributed(problem) for problem in problems] if task.run else problems, notes, runs)


def _runs(task: ValidationTask, document: Mapping[str, Any], user: Path | None) -> Iterator[ExperimentRun]:
    """The runs of the experiment that a task chooses."""
    experiment = dict(task.choices).get("experiment")
    if experiment and not task.run:
        file = label(find_file(conf_directories(user), "experiment", experiment))
        for name, words in (document.get("experiment", {}).get("runs") or {}).items():
            yield ExperimentRun(file, f"experiment.runs.{name}", tuple(words))


def _problems(config: Configuration, readers: Iterable[ConfigReader]) -> list[Problem]:
    problems = []
    for read in readers:
        try:
            read(config)
        except ConfigError as error:
            problems += error.problems
    return problems


def _registry_check(notes: dict[str, None], target: str | None) -> PlanCheck | None:
    """The check against a registry; anything it could not check goes to the notes."""
    try:
        registry = registry_of(target)
    except MissingBindings as error:
        notes[f"nothing was checked against the GStreamer registry: {error}"] = None
        return None

    def check(plan: Plan | SoundPlan | VoicePlan) -> list[ModelError]:
        records = missing_recorders(registry, plan) if isinstance(plan, Plan) else ()
        missing = (*missing_plugins(registry, plan), *records)
        notes.update({f"not checked: {sentence}": None for sentence in missing})
        if registry.origin:
            notes[f"checked against {registry.origin}"] = None
        problems = check_plan(registry, plan)
        if isinstance(plan, Plan) and not problems and target is None and may_lack_parameter_sets(plan):
            from runner.apply import parameter_set_notes

            notes.update(dict.fromkeys(parameter_set_notes(plan)))
        return problems

    return check


@cache
def registry_of(target: str | None) -> Registry:
    """The registry of a target, or of this machine.

    raises  ArgumentError for an unknown target, MissingBindings
    """
    if target is None:
        from runner.apply import LIVE

        return LIVE
    from runner.elements.dump import DumpedRegistry, read_dump

    dump = read_dump(target)
    try:
        from runner.apply import LIVE
    except MissingBindings:
        return DumpedRegistry(target, dump, lambda type_name, text: True)
    return DumpedRegistry(target, dump, LIVE.reads)
