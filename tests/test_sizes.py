"""A class, a module and a line stay small enough to be read at a glance."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

CHECKOUT = Path(__file__).resolve().parents[1]
LIMITS = {
    "lines of a module": 500,
    "lines of a class": 350,
    "methods": 25,
    "methods in JS": 30,
    "longest line in JS": 140,
}
METHOD = re.compile(r"^  (?:static )?(?:async )?(?:get |set )?#?\w+\(.*\) \{", re.MULTILINE)
CLASS = re.compile(r"^(?:export )?class (\w+)(.*?)^}", re.MULTILINE | re.DOTALL)


def python_sizes(path: str, text: str) -> Iterator[tuple[str, str, int]]:
    yield path, "lines of a module", len(text.splitlines())
    for found in ast.walk(ast.parse(text)):
        if isinstance(found, ast.ClassDef):
            yield f"{path} {found.name}", "lines of a class", (found.end_lineno or 0) - found.lineno + 1
            methods = [each for each in found.body if isinstance(each, ast.FunctionDef | ast.AsyncFunctionDef)]
            yield f"{path} {found.name}", "methods", len(methods)


def script_sizes(path: str, text: str) -> Iterator[tuple[str, str, int]]:
    yield path, "longest line in JS", max(map(len, text.splitlines()))
    for name, body in CLASS.findall(text):
        yield f"{path} {name}", "methods in JS", len(METHOD.findall(body))


def test_classes_modules_and_lines_are_small() -> None:
    files = [*CHECKOUT.glob("runner/**/*.py"), *CHECKOUT.glob("runner/**/static/*.js")]
    found: dict[str, int] = {}
    for file in files:
        sizes = python_sizes if file.suffix == ".py" else script_sizes
        for name, what, size in sizes(str(file.relative_to(CHECKOUT)), file.read_text()):
            if size > LIMITS[what]:
                found[f"{name}: {what}"] = size
    assert found == {}
