"""Checks documents against the JSON Schemas in schemas/ and reports problems in plain language.

Two libraries share the work: jsonschema-rs checks validity, a hundred times faster than jsonschema, which lists the
errors of an invalid document.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from itertools import chain, groupby, islice
from typing import TYPE_CHECKING, Any

from runner.errors import suggest
from runner.resources import directory

if TYPE_CHECKING:
    from jsonschema import Draft202012Validator
    from jsonschema.exceptions import ValidationError

Path = tuple[str | int, ...]
DEEPEST_JSON = 32  # levels; a composed configuration has ten
MAX_ERRORS = 50  # explained per message or line; each takes time
LONGEST_SHOWN = 80  # characters of a value in a message
_BASE = "json-schema:///"
NOT_CONFIGURATION = ("control", "drive", "event", "layout", "rate_quality", "report")  # schemas of other documents
LONGEST_WHOLE = 300  # digits; the number must fit into a float

_TYPES = {
    "integer": "a whole number",
    "number": "a number",
    "string": "text",
    "boolean": "true or false",
    "object": "a mapping",
    "array": "a list",
    "null": "null",
}
NETWORK_RULE = "must be true, false, or a network such as 10.9.0.0/24"
_PATTERNS = {
    "^[A-Za-z0-9_-]+$": "must be letters, digits, _ and - only",
    "^(axis[0-9]{1,2}[+-]|hat[0-9]{1,2}-(up|down|left|right))$": "must be a number, or like axis6- or hat9-left",
    "^[0-9a-fA-F.:]+/[0-9]{1,3}$": NETWORK_RULE,
    "^[A-Za-z0-9_]+$": "must be letters, digits and _ only",
    r"^\$\{[^{}]+\}$": "must be a mapping",  # or an interpolation instead
}


@dataclass(frozen=True, slots=True)
class Finding:
    """A violated rule and its place in the document; `found` is None if the path already shows it."""

    path: Path
    found: str | None
    rule: str

    @property
    def meant(self) -> Path:
        """The path that was probably meant if a key is misspelt; otherwise its own."""
        _, misspelt, key = self.rule.rpartition("did you mean ")
        return (*self.path[:-1], key.rstrip("?")) if misspelt and self.found is None else self.path


def findings(document: Any, schema: str) -> list[Finding]:
    """All problems of a document, in document order; empty: it is valid.

    schema  name of a file in schemas/ without its extension
    """
    odd = list(_unrepresentable(document, ()))
    seen = {f.path for f in odd}
    errors = _errors_in_order(f"{schema}.schema.json", document, may_fail=bool(odd))
    found = _without_misspelt(chain.from_iterable(map(_explain, errors)))
    return odd + [f for f in found if not any(f.path[: len(path)] == path for path in seen)]


def dotted(path: Path) -> str:
    """A path in the usual notation: cameras.front_left.rate_quality.scaling[2]."""
    text = "".join(f".{part}" if not isinstance(part, int) or isinstance(part, bool) else f"[{part}]" for part in path)
    return text.removeprefix(".")


def shown(value: Any) -> str:
    """A value as written in YAML, shortened if it is long."""
    return shortened(repr(value) if isinstance(value, str) else json.dumps(value, ensure_ascii=False, default=str))


def shortened(text: str) -> str:
    return text if len(text) <= LONGEST_SHOWN else text[: LONGEST_SHOWN - 3] + "..."


@cache
def _compiled(reference: str) -> Any:
    """The jsonschema-rs validator for a reference; it needs a base for relative references."""
    from jsonschema_rs import Draft202012Validator

    return Draft202012Validator({"$ref": f"{_BASE}{reference}"}, registry=_compiled_registry())


@cache
def _compiled_registry() -> Any:
    from jsonschema_rs import Registry

    return Registry([(f"{_BASE}{name}.schema.json", schema_document(name)) for name in schema_names()])


def _is_valid(reference: str, document: Any) -> bool:
    try:
        return bool(_compiled(reference).is_valid(document))
    except ValueError:  # not JSON: a key that is not text, or nested too deeply
        return False


def _errors(reference: str, document: Any) -> Iterator[ValidationError]:
    if not _is_valid(reference, document):
        yield from _validator(reference).iter_errors(document)


@cache
def _validator(reference: str) -> Draft202012Validator:
    return _draft()({"$ref": reference}, registry=_registry())


@cache
def _draft() -> type[Draft202012Validator]:
    """JSON Schema 2020-12 with the patterns of ECMA-262: $ matches only the end, not before a trailing newline."""
    from jsonschema import Draft202012Validator
    from jsonschema.exceptions import ValidationError
    from jsonschema.validators import extend

    def pattern(_validator: Any, wanted: str, value: Any, _schema: Any) -> Iterator[ValidationError]:
        if isinstance(value, str) and not re.search(re.sub(r"\$$", r"\\Z", wanted), value):
            yield ValidationError(f"{value!r} does not match {wanted!r}")

    draft: type[Draft202012Validator] = extend(Draft202012Validator, {"pattern": pattern})  # type: ignore[no-untyped-call]
    return draft


def referred(reference: str, schema: str) -> tuple[Any, str]:
    """The target of a reference in a schema, and the name of the schema that holds it."""
    file, _, pointer = reference.partition("#")
    home = file.removesuffix(".schema.json") or schema
    found: Any = schema_document(home)
    for step in pointer.split("/")[1:]:
        found = found[step]
    return found, home


def read_json(text: str | bytes) -> Any:
    """Parse untrusted JSON; numbers must be finite: NaN, Infinity and 1e999 are rejected.

    raises  ValueError, also if it is nested deeper than any of our messages
    """
    try:
        document = json.loads(text, parse_constant=_no_number, parse_float=_finite, parse_int=_whole)
    except RecursionError:
        raise ValueError("nested too deeply") from None
    brackets = text.count("[") + text.count("{") if isinstance(text, str) else text.count(b"[") + text.count(b"{")
    if brackets > DEEPEST_JSON and _depth(document) > DEEPEST_JSON:
        raise ValueError("nested too deeply")
    return document


def _depth(document: Any) -> int:
    """Levels of lists and mappings, counted level by level."""
    depth, level = 0, [document]
    while level := [inner for inner in level if isinstance(inner, dict | list)]:
        depth += 1
        level = [part for inner in level for part in (inner.values() if isinstance(inner, dict) else inner)]
    return depth


def _no_number(text: str) -> float:
    raise ValueError(f"{text} is not a number")


def _finite(text: str) -> float:
    number = float(text)
    if not math.isfinite(number):
        raise ValueError(f"{text} is too large")
    return number


def _whole(text: str) -> int:
    if len(text) > LONGEST_WHOLE:
        raise ValueError(f"{text[:20]}... is too large")
    return int(text)


def event_problem(document: Any) -> str | None:
    """The problems of an event in JSON, in one line; None if it is valid."""
    if not isinstance(document, dict):
        return f"{shown(document)}: must be a mapping with t and event"
    name = document.get("event")
    if name is None:
        return "event: missing: must be given"
    if name not in event_names():
        return f"event: {shown(name)}: unknown event{suggest(str(name), event_names())}"
    return _in_one_line(f"event.schema.json#/$defs/{name}", document)


def log_problem(document: Mapping[str, Any]) -> str | None:
    """The problems of a line of a drive log that is not an event, in one line; None if it is valid."""
    kind = document["log"]
    if kind not in log_kinds():
        return f"log: {shown(kind)}: unknown kind of line{suggest(str(kind), log_kinds())}"
    return _in_one_line(f"drive.schema.json#/$defs/{kind}", document)


def message_problem(kind: str, document: Any) -> str | None:
    """The problems of a message from the vehicle, in one line; None if it is valid."""
    return _in_one_line(f"control.schema.json#/$defs/{kind}", document)


def places_problem(document: Any) -> str | None:
    """The problems of places of tiles by camera, in one line; None if they are valid."""
    return _in_one_line("layout.schema.json#/$defs/places", document)


def drive_places_problem(document: Any) -> str | None:
    """The problems of cameras by place in the Drive view, in one line; None if they are valid."""
    return _in_one_line("layout.schema.json#/$defs/drive", document)


@cache
def log_kinds() -> tuple[str, ...]:
    return tuple(schema_document("drive")["properties"]["log"]["enum"])


@cache
def event_names() -> tuple[str, ...]:
    return tuple(schema_document("event")["properties"]["event"]["enum"])


def schema_names() -> list[str]:
    return sorted(path.name.removesuffix(".schema.json") for path in directory("schemas").glob("*.schema.json"))


@cache
def schema_document(name: str) -> dict[str, Any]:
    text = directory("schemas").joinpath(f"{name}.schema.json").read_text(encoding="utf-8")
    document: dict[str, Any] = json.loads(text)
    return document


@cache
def _registry() -> Any:
    from referencing import Registry
    from referencing.jsonschema import DRAFT202012

    def resource(name: str) -> Any:
        # With $schema, jsonschema would switch to its own class instead of `_draft`.
        content = {key: value for key, value in schema_document(name).items() if key != "$schema"}
        return DRAFT202012.create_resource(content)

    return Registry().with_resources((f"{name}.schema.json", resource(name)) for name in schema_names())


def _errors_in_order(reference: str, document: Any, *, may_fail: bool) -> list[ValidationError]:
    try:
        return sorted(_errors(reference, document), key=lambda error: [str(part) for part in error.absolute_path])
    except TypeError:  # jsonschema matches a key that is not text with a pattern
        if not may_fail:
            raise
        return []


@cache
def _whole_numbers() -> frozenset[str]:
    """Names of the keys of a configuration whose values are whole numbers, or lists of them."""
    return _keys_of("integer") - _keys_of("number")


def _keys_of(kind: str) -> frozenset[str]:
    """Names of the keys of a configuration with values of a type, or lists of them."""
    names = set[str]()

    def collect(schema: Any) -> None:
        for part in schema.values() if isinstance(schema, dict) else schema if isinstance(schema, list) else ():
            collect(part)
        properties = schema.get("properties") if isinstance(schema, dict) else None
        for name, its in properties.items() if isinstance(properties, dict) else ():
            inner = its.get("items") if isinstance(its, dict) else None
            types = [each.get("type") for each in (its, inner) if isinstance(each, dict)]
            if any(kind in (found if isinstance(found, list) else [found]) for found in types):
                names.add(name)

    for name in schema_names():
        if name not in NOT_CONFIGURATION:
            collect(schema_document(name))
    return frozenset(names)


def _unrepresentable(value: Any, path: Path) -> Iterator[Finding]:
    """Problems that YAML allows but JSON Schema does not see.

    Keys that are not text, numbers that are not finite, and 1920.0 in place of a whole number.
    """
    if isinstance(value, dict):
        for key, inner in value.items():
            if isinstance(key, str):
                yield from _unrepresentable(inner, (*path, key))
            else:
                yield Finding((*path, key), None, "a key must be text, quote it")
    elif isinstance(value, list):
        for index, inner in enumerate(value):
            yield from _unrepresentable(inner, (*path, index))
    elif isinstance(value, float) and not math.isfinite(value):
        yield Finding(path, f"{value}", "must be a finite number")
    elif isinstance(value, float) and value.is_integer() and _is_whole(path):
        yield Finding(path, f"{value}", "must be written without a decimal point")
    elif isinstance(value, int) and abs(value) >= 10**LONGEST_WHOLE:
        yield Finding(path, None, f"must have at most {LONGEST_WHOLE} digits")


def _is_whole(path: Path) -> bool:
    """Whether a value, or the list or mapping that contains it, has the key of whole numbers."""
    keys = [part for part in path if isinstance(part, str)]
    return keys[-1:] != [] and (keys[-1] in _whole_numbers() or keys[-3:-1] == ["capture", "controls"])


def _in_one_line(reference: str, document: Any) -> str | None:
    """The problems of a document, of limited number and length since it may be hostile; None if it is valid."""
    findings = chain.from_iterable(map(_explain, _errors(reference, document)))
    found = _without_misspelt(islice(findings, MAX_ERRORS))
    texts = []
    for (rule, _), group in groupby(found, key=lambda f: (f.rule, f.found and f.path)):  # unknown keys share a sentence
        alike = list(group)
        paths = ", ".join(shortened(dotted(f.path)) for f in alike)
        texts.append(": ".join(filter(None, (paths, alike[0].found, rule))))
    return "; ".join(texts) if found else None


def _without_misspelt(findings: Iterable[Finding]) -> list[Finding]:
    found = list(dict.fromkeys(findings))
    # A misspelt key is one mistake, not an unknown key and a missing one.
    meant = {f.meant for f in found if f.found != "missing"}
    return [f for f in found if not (f.found == "missing" and f.path in meant)]


def _explain(error: Any) -> Iterator[Finding]:
    path, value = tuple(error.absolute_path), error.instance
    limit, parent = error.validator_value, error.schema
    match error.validator:
        case "additionalProperties":
            known, patterns = parent.get("properties", {}), parent.get("patternProperties", {})
            for key in value:
                if key not in known and not any(re.search(pattern, str(key)) for pattern in patterns):
                    yield Finding((*path, key), None, f"unknown key{suggest(str(key), known)}")
        case "required":
            for key in limit:
                if key not in value:
                    yield Finding((*path, key), "missing", "must be given")
        case "anyOf":
            # Explain the alternative whose type matches.
            meant = [inner for inner in error.context if inner.validator != "type"]
            yield from _explain((meant or error.context)[0])
        case "propertyNames" | "not" | "if":
            yield Finding(path, shown(value), error.message)
        case _:
            yield Finding(path, shown(value), _rule(str(error.validator), limit, value, parent))


def _rule(keyword: str, limit: Any, value: Any, schema: Mapping[str, Any]) -> str:  # noqa: PLR0911
    match keyword:
        case "type":
            if isinstance(value, list) and "$comment" in schema:
                return str(schema["$comment"])
            names = [_TYPES[name] for name in ([limit] if isinstance(limit, str) else limit)]
            # YAML reads a bare on, off, yes or no as true or false.
            quote = ', quote it: "on" or "off"' if isinstance(value, bool) and limit == "string" else ""
            return f"must be {' or '.join(names)}{quote}"
        case "minimum":
            return f"must be at least {limit}"
        case "maximum":
            return f"must be at most {limit}"
        case "exclusiveMinimum":
            return f"must be above {limit}"
        case "enum":
            options = ["null" if option is None else str(option) for option in limit]
            hint = suggest(value, options) if isinstance(value, str) else ""
            return f"must be one of {', '.join(options)}" + (hint if "did you mean" in hint else "")
        case "const":
            return f"must be {shown(limit)}"
        case "minItems" | "minLength" | "minProperties":
            return "must not be empty" if limit == 1 else f"must have at least {limit} entries"
        case "maxProperties":
            return "must have one entry" if limit == 1 else f"must have at most {limit} entries"
        case "pattern":
            return _PATTERNS.get(limit) or str(schema.get("description", f"must match {limit}"))
        case _:
            return f"breaks {keyword} {shown(limit)}"
