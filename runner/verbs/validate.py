"""usage: tod-runner validate [OVERRIDE ...] [conf=DIR]

Check every file of the configuration against its schema, then every combination of vehicle, modes, graph and source:
it must compose and compile. Where GStreamer is installed, also against its registry: elements, properties, types,
ranges, and whether what a knob turns may change while playing. Maps, traces and tracks of pqos files are read. Ends
with status 2 and all problems at once.

  tod-runner validate                          the packaged files
  tod-runner validate conf=my_vehicles         yours too, the step for your CI
  tod-runner validate vehicle=tum_q7           one vehicle with everything else
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from itertools import product, repeat
from pathlib import Path
from typing import NamedTuple

import yaml

from runner import schema
from runner.compose import GROUPS, conf_directories, label, load_file, options, yaml_problem
from runner.config import Check, composed, load, load_experiment, load_run, load_study
from runner.errors import ConfigError, Problem
from runner.graph import Plan
from runner.model import ModelError
from runner.verbs import Arguments

DATA = ("maps", "traces")  # folders for what pqos files name; a bandwidth map may be YAML
COMBINED = ("vehicle", "modes", "graph", "source")
SINGLE: dict[str, Callable[..., object]] = {
    "pqos": load_run,
    "recording": load,
    "study": load_study,
    "link": load_experiment,
    "experiment": load_experiment,
}


def run(arguments: Arguments) -> int:
    directories = conf_directories(arguments.conf)
    found, files = check_files(directories)
    if found:
        raise ConfigError(found)
    combinations = [Task(load, words) for words in _combinations(arguments, directories)]
    tasks = [*combinations, *_single_choices(arguments, directories)]
    with ProcessPoolExecutor(min(os.cpu_count() or 1, len(tasks))) as pool:
        chunk = max(1, len(tasks) // (8 * (os.cpu_count() or 1)))
        results = list(pool.map(_check, tasks, repeat(arguments.conf), chunksize=chunk))
    problems = [problem for result in results for problem in result.problems]
    if problems:
        raise ConfigError(problems)
    notes = dict.fromkeys(note for result in results for note in result.notes)
    print(f"{files} files and {len(combinations)} combinations of {', '.join(COMBINED)} are valid")
    print("\n".join(notes), end="\n" if notes else "")
    return 0


def check_files(directories: Sequence[Path]) -> tuple[list[Problem], int]:
    """Every YAML file of some configuration directories against the schema of its group; and how many there are."""
    problems: list[Problem] = []
    count = 0
    for directory in directories:
        for path in sorted(directory.rglob("*.yaml")):
            if path.relative_to(directory).parts[0] in DATA:
                continue
            count += 1
            problems += check_file(path, path.relative_to(directory), label(path, directories))
    return problems, count


def check_file(path: Path, relative: Path, name: str) -> Iterator[Problem]:
    """Problems of one file. The folder says which schema it follows."""
    group = relative.parts[0] if len(relative.parts) > 1 else relative.stem
    kind = {"cameras": "camera"}.get(group, group)
    if kind not in (*GROUPS, "camera", "config"):
        folders = ", ".join(f"{group}/" for group in GROUPS)
        yield Problem(name, "", None, f"belongs to no group, the groups are {folders}")
        return
    try:
        content = load_file(path)
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        yield yaml_problem(error, name)
        return
    bases = content.get("defaults") if isinstance(content, dict) else None
    inherits = any(isinstance(base, str) and base != "_self_" for base in bases or ())
    for finding in schema.findings(content, kind):
        if inherits and finding.found == "missing":
            continue  # a file that it builds on may have it; the combinations show whether
        yield Problem(name, schema.dotted(finding.path), finding.found, finding.rule)


class Task(NamedTuple):
    """Overrides to try, and what composes them: one of the functions of runner.config, called with `runnable=False`."""

    compose: Callable[..., object]
    overrides: list[str]


@dataclass(frozen=True, slots=True)
class Checked:
    problems: list[Problem]
    notes: list[str]


def _combinations(arguments: Arguments, directories: Sequence[Path]) -> Iterator[list[str]]:
    """Overrides for each combination; a choice on the command line narrows its axis."""
    axes: list[list[list[str]]] = [[arguments.overrides]]
    for group in COMBINED:
        words = [[f"{group}={option}"] for option in options(group, directories)]
        axes.append([[]] if _chosen(arguments, group) else words)
    for parts in product(*axes):
        yield [word for part in parts for word in part]


def _single_choices(arguments: Arguments, directories: Sequence[Path]) -> Iterator[Task]:
    """Each file of the groups that are not combined: maps and traces are read, experiments with all their runs."""
    yield Task(load_run, arguments.overrides)
    for group, compose in SINGLE.items():
        if _chosen(arguments, group):
            continue
        for option in options(group, directories):
            words = [*arguments.overrides, f"{group}={option}"]
            yield Task(compose, words)
            if group == "experiment":
                yield from (Task(load_run, [*words, *added]) for added in _runs(words, arguments.conf))


def _chosen(arguments: Arguments, group: str) -> bool:
    """Whether the command line chooses a file of a group."""
    return any(word.lstrip("+").partition("=")[0] == group for word in arguments.overrides)


def _runs(overrides: list[str], user: Path | None) -> list[list[str]]:
    """What the runs of an experiment add; nothing where it cannot be composed, which is told elsewhere."""
    try:
        section = composed(overrides, user).document.get("experiment")
    except ConfigError:
        return []
    runs = section.get("runs") if isinstance(section, dict) else None
    added = runs.values() if isinstance(runs, dict) else ()
    return [[], *(words for words in added if isinstance(words, list) and all(isinstance(w, str) for w in words))]


def _check(task: Task, user: Path | None) -> Checked:
    notes: list[str] = []
    try:
        task.compose(task.overrides, user, runnable=False, check=_registry_check(notes))
    except ConfigError as error:
        return Checked(error.problems, [])
    return Checked([], notes)


def _registry_check(notes: list[str]) -> Check | None:
    """The check against GStreamer's registry; what it could not look at goes to the notes."""
    try:
        from runner.apply import check_plan, missing_plugins, missing_recorders
    except ImportError:
        notes.append("nothing was checked against the GStreamer registry: its Python bindings are not installed")
        return None

    def check(plan: Plan) -> list[ModelError]:
        notes.extend(f"not checked: {sentence}" for sentence in (*missing_plugins(plan), *missing_recorders(plan)))
        return check_plan(plan)

    return check
