"""docs/cameras.md: its tables are those of the schemas, and the defaults that the schemas name are the real ones."""

from __future__ import annotations

from dataclasses import fields
from importlib.machinery import SourceFileLoader
from importlib.util import module_from_spec, spec_from_loader
from types import ModuleType
from typing import Any

import pytest
from helpers import UserConf

from runner.configuration.config import configuration
from runner.core.model import Camera
from runner.resources import directory
from runner.schema import findings

CHECKOUT = directory("schemas").parent


@pytest.fixture(scope="module")
def key_tables() -> ModuleType:
    loader = SourceFileLoader("key_tables", str(CHECKOUT / "scripts" / "key-tables"))
    spec = spec_from_loader(loader.name, loader)
    assert spec
    module = module_from_spec(spec)
    loader.exec_module(module)
    return module


def test_the_page_has_every_key(key_tables: ModuleType) -> None:
    text = key_tables.PAGE.read_text()
    assert text == key_tables.page(text), "run scripts/key-tables --write"
    found = key_tables.tables()
    assert len(found["kind"]) > 10 and len(found["place"]) > 15
    assert all(key.meaning and key.example for keys in found.values() for key in keys)


MINIMAL = """\
# @package _global_
name: van
cameras:
  a:
    width_px: 640
    height_px: 480
    fps: 30
    native: {width_px: 1280, height_px: 960}
    place: {row: 0, column: 0}
    pose: {x_m: 1.0, y_m: 0.5, z_m: 1.5, yaw_deg: 20}
    rate_quality: {scaling: [1.0], b_min_kbps: [0], b_full_kbps: 1000}
"""


@pytest.mark.slow
def test_a_default_given_changes_nothing_and_another_value_does(key_tables: ModuleType, conf: UserConf) -> None:
    conf.write("vehicle/van.yaml", MINIMAL)

    def camera(*words: str) -> dict[str, Any]:
        found = configuration(["vehicle=van", "source=test", *words], conf.path).vehicle().cameras["a"]
        return {each.name: getattr(found, each.name) for each in fields(Camera)}

    minimal = camera()
    others: dict[str, Any] = {"lens": "fisheye", "calibrated": "true", "redundant": "true"}
    stated = [key for keys in key_tables.tables().values() for key in keys if key.default.startswith("`")]
    assert len(stated) == 12
    for key in stated:
        assert camera(f"cameras.a.{key.path}={key.default.strip('`')}") == minimal, key.path
        assert camera(f"cameras.a.{key.path}={others.get(key.path, 5)}") != minimal, key.path


def test_every_example_is_valid(key_tables: ModuleType) -> None:
    """All examples of a kind together are a file of conf/cameras/, and so those of a place in conf/vehicle/."""
    import yaml

    documents: dict[str, dict[str, Any]] = {"kind": {}, "place": {}, "dimensions": {}}
    for name, keys in key_tables.tables().items():
        for key in keys:
            above, node = key.path.split("."), documents[name]
            for step in above[:-1]:
                node = node.setdefault(step, {})
            node[above[-1]] = yaml.safe_load(key.example)
    assert findings(documents["kind"], "camera") == []
    assert findings({"name": "van", **documents["dimensions"], "cameras": {"a": documents["place"]}}, "vehicle") == []
