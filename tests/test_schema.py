"""The schemas are closed and describe every key; findings are worded for people."""

from __future__ import annotations

import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from helpers import CONF
from jsonschema import Draft202012Validator

from runner.configuration.files import GROUPS
from runner.configuration.yaml_file import load_file
from runner.resources import directory
from runner.schema import Finding, dotted, findings, schema_document, schema_names, shown


def parts(schema: Any, path: str = "") -> Iterator[tuple[str, dict[str, Any]]]:
    """Every schema inside a schema, with its path."""
    if isinstance(schema, list):
        for index, inner in enumerate(schema):
            yield from parts(inner, f"{path}[{index}]")
    elif isinstance(schema, dict):
        yield path, schema
        for key, inner in schema.items():
            if key not in ("const", "enum", "default", "examples"):
                yield from parts(inner, f"{path}/{key}")


@pytest.mark.parametrize("name", schema_names())
def test_schemas_are_schemas(name: str) -> None:
    Draft202012Validator.check_schema(schema_document(name))


@pytest.mark.parametrize("name", schema_names())
def test_every_property_is_described_and_objects_are_closed(name: str) -> None:
    for path, part in parts(schema_document(name)):
        if (
            "/if" in path
            or "/then" in path
            or "/else" in path
            or "without_map" in path
            or (not path and name in ("event", "drive", "pqos"))
        ):
            continue  # conditions on keys that are described elsewhere
        if part.get("type") == "object" and "properties" in part:
            assert part.get("additionalProperties", True) is not True, path
        if isinstance(part.get("properties"), dict) and not path.endswith("properties"):
            for key, value in part["properties"].items():
                assert "$ref" in value or value.get("description") or "const" in value, f"{path}: {key}"


def test_no_description_is_written_twice() -> None:
    by_hand = [name for name in schema_names() if "$comment" not in schema_document(name)]
    texts = [
        part["description"]
        for name in by_hand
        for _, part in parts(schema_document(name))
        if isinstance(part.get("description"), str)
    ]
    assert [text for text, count in Counter(texts).items() if count > 1] == []


def test_generated_files_are_those_of_their_classes() -> None:
    words = [sys.executable, directory("schemas").parent / "scripts" / "schemas"]
    differing = subprocess.run(words, capture_output=True, text=True, check=True, timeout=60).stdout
    assert differing == "", "run make generated"


def test_references_resolve_where_the_files_stand() -> None:
    """check-jsonschema and editors follow relative references from the file, without a network."""
    check = Path(sys.executable).with_name("check-jsonschema")
    files = {"vehicle": "vehicle/tum_q7", "graph": "graph/h264_srt", "modes": "modes/steady", "config": "config"}
    for schema, file in files.items():
        words = [check, "--schemafile", directory("schemas") / f"{schema}.schema.json", CONF / f"{file}.yaml"]
        assert subprocess.run(words, capture_output=True, text=True, check=False, timeout=60).returncode == 0, schema


@pytest.mark.parametrize("path", sorted(CONF.rglob("*.yaml")), ids=lambda path: str(path.relative_to(CONF)))
def test_packaged_files_follow_their_schema_and_name_it(path: Any) -> None:
    group = path.parent.name if path.parent != CONF else "config"
    if group not in (*GROUPS, "config"):
        return
    schema = {"cameras": "camera"}.get(group, group)
    assert findings(load_file(path), schema) == []
    up = "../" * len(path.relative_to(CONF).parts)
    modeline = f"# yaml-language-server: $schema={up}schemas/{schema}.schema.json"
    assert modeline in path.read_text().splitlines()[:2]
    assert (path.parent / up / "schemas" / f"{schema}.schema.json").is_file()


CAMERA = {
    "width_px": 1280,
    "height_px": 800,
    "fps": 30,
    "rate_quality": {"scaling": [0.5], "b_min_kbps": [0], "b_full_kbps": 100},
}


@pytest.mark.parametrize(
    "changes, found",
    [
        ({}, []),
        ({"fps": 29.97}, []),
        ({"fps": "30"}, ["fps: '30': must be a number"]),
        ({"fps": None}, ["fps: null: must be a number"]),
        ({"fps": 0}, ["fps: 0: must be above 0"]),
        ({"fps": float("nan")}, ["fps: nan: must be a finite number"]),
        ({"fps": float("inf")}, ["fps: inf: must be a finite number"]),
        ({"fps": 1001}, ["fps: 1001: must be at most 1000"]),
        ({"width_px": 15}, ["width_px: 15: must be at least 16"]),
        ({"width_px": 20.5}, ["width_px: 20.5: must be a whole number"]),
        ({"width_px": True}, ["width_px: true: must be a whole number"]),
        ({"lens": True}, ["lens: true: must be one of pinhole, fisheye"]),
        ({"lens": "fishey"}, ["lens: 'fishey': must be one of pinhole, fisheye, did you mean fisheye?"]),
        ({"fpss": 3}, ["fpss: unknown key, did you mean fps?"]),
        ({True: 3}, ["True: a key must be text, quote it"]),
        ({"rate_quality": []}, ["rate_quality: []: must be a mapping"]),
        ({"rate_quality": {}}, [f"rate_quality.{k}: missing: must be given" for k in CAMERA["rate_quality"]]),  # type: ignore[attr-defined]
        (
            {"rate_quality": {"scaling": [], "b_min_kbps": 0, "b_full_kbps": "x" * 90}},
            [
                f"rate_quality.b_full_kbps: '{'x' * 76}...: must be a number",
                "rate_quality.b_min_kbps: 0: must be a list",
                "rate_quality.scaling: []: must not be empty",
            ],
        ),
    ],
)
def test_findings(changes: dict[str, Any], found: list[str]) -> None:
    reported = findings(CAMERA | changes, "camera")
    assert [": ".join(filter(None, (dotted(f.path), f.found, f.rule))) for f in reported] == found


def test_a_misspelt_key_is_one_mistake() -> None:
    misspelt = {"heigth_px" if key == "height_px" else key: value for key, value in CAMERA.items()}
    assert findings(misspelt, "camera") == [Finding(("heigth_px",), None, "unknown key, did you mean height_px?")]


@pytest.mark.parametrize(
    "element, problem",
    [
        ({"name": "a b", "element": "x"}, "name: 'a b': must be letters, digits and _ only"),
        ({"name": True, "element": "x"}, 'name: true: must be text, quote it: "on" or "off"'),
        ({"name": "a", "element": "x", "properties": {"y": [1]}}, "must be text or a number or true or false"),
    ],
)
def test_findings_in_elements(element: dict[str, Any], problem: str) -> None:
    (finding,) = findings(element, "element")
    assert f"{dotted(finding.path)}: {finding.found}: {finding.rule}".endswith(problem)


def test_paths_and_values_as_people_write_them() -> None:
    assert dotted(("cameras", "rear", "rate_quality", "scaling", 2)) == "cameras.rear.rate_quality.scaling[2]"
    assert shown({"a": ["ü", None]}) == '{"a": ["ü", null]}'
    assert shown("it's") == '"it\'s"'
