"""Two hundred single mutations of packaged files, made from a seed, and what `validate` says of each.

Graphs and modes are mutated as they were before they inherited from each other. A mutation changes a key, the type of a
value, a number, a name, an element, a property or the order of a list. Not each one is a mistake.
"""

from __future__ import annotations

import copy
import random
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import yaml
from broken import text_of

COUNT, SEED = 200, 6
GROUPS = ("cameras", "experiment", "graph", "link", "modes", "pqos", "recording", "source", "study", "vehicle")
Steps = tuple[str | int, ...]


class Mutation(NamedTuple):
    """What was changed where, and the text of the file."""

    file: str
    what: str
    text: str

    @property
    def name(self) -> str:
        return f"{self.file}: {self.what}"


def mutations(packaged: Path) -> list[Mutation]:
    """The same mutations each time, each a different one."""
    chance = random.Random(SEED)
    files = [f"{group}/{path.stem}" for group in GROUPS for path in sorted((packaged / group).glob("*.yaml"))]
    made: dict[str, Mutation] = {}
    while len(made) < COUNT:
        mutation = _mutation(chance, packaged, chance.choice(files))
        if mutation:
            made.setdefault(mutation.name, mutation)
    return list(made.values())


def _mutation(chance: random.Random, packaged: Path, file: str) -> Mutation | None:
    text = text_of(packaged, file)
    document = yaml.safe_load(text)
    kind = chance.choice(list(KINDS))
    changes = [change for steps in _paths(document) if (change := KINDS[kind](chance, document, steps))]
    if not changes:
        return None
    steps, changed = chance.choice(changes)
    what = f"{kind} at {'.'.join(map(str, steps))}"
    headers = [line for line in text.splitlines()[:1] if line.startswith("# @package")]
    return Mutation(file, what, "\n".join([*headers, yaml.safe_dump(changed, sort_keys=False)]))


def _paths(value: Any, steps: Steps = ()) -> Iterator[Steps]:
    entries = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, inner in entries:
        yield (*steps, key)
        yield from _paths(inner, (*steps, key))


Changed = tuple[Steps, Any]


def _value(document: Any, steps: Steps) -> Any:
    for step in steps:
        document = document[step]
    return document


def _replaced(document: Any, steps: Steps, value: Any) -> Changed:
    changed = copy.deepcopy(document)
    _value(changed, steps[:-1])[steps[-1]] = value
    return steps, changed


def _key(_chance: random.Random, document: Any, steps: Steps) -> Changed | None:
    if not isinstance(steps[-1], str):
        return None
    changed = copy.deepcopy(document)
    above = _value(changed, steps[:-1])
    renamed = {f"{key}x" if key == steps[-1] else key: value for key, value in above.items()}
    above.clear()
    above.update(renamed)
    return steps, changed


def _type(chance: random.Random, document: Any, steps: Steps) -> Changed:
    others = [
        value for value in ("text", 7, True, None, [1], {"a": 1}) if type(value) is not type(_value(document, steps))
    ]
    return _replaced(document, steps, chance.choice(others))


def _number(chance: random.Random, document: Any, steps: Steps) -> Changed | None:
    value = _value(document, steps)
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    return _replaced(document, steps, chance.choice((-value - 1, 0, value + 0.5, value * 1000)))


def _text(key: str) -> Callable[[random.Random, Any, Steps], Changed | None]:
    """Drop one letter of a key's value."""

    def change(_chance: random.Random, document: Any, steps: Steps) -> Changed | None:
        value = _value(document, steps)
        if not isinstance(value, str) or len(value) < 3 or key not in ("", steps[-1]):
            return None
        return _replaced(document, steps, value[:-2] + value[-1])

    return change


def _order(chance: random.Random, document: Any, steps: Steps) -> Changed | None:
    value = _value(document, steps)
    if not isinstance(value, list) or len(value) < 2:
        return None
    first = chance.randrange(len(value) - 1)
    swapped = [*value[:first], value[first + 1], value[first], *value[first + 2 :]]
    return _replaced(document, steps, swapped)


KINDS: dict[str, Callable[[random.Random, Any, Steps], Changed | None]] = {
    "key": _key,
    "type": _type,
    "number": _number,
    "text": _text(""),
    "name": _text("name"),
    "element": _text("element"),
    "property": _text("property"),
    "order": _order,
}
