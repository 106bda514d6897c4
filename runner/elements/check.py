"""Checks a plan against a registry of elements, to find errors before they show while driving."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import replace
from difflib import get_close_matches
from functools import lru_cache
from typing import TYPE_CHECKING

from runner.core.commands import KnobValue
from runner.core.model import Element, ModelError, Value
from runner.elements.description import SINK, SRC, Registry
from runner.elements.packages import PACKAGE_OF, missing_plugins, missing_recorders
from runner.elements.values import value_problem
from runner.errors import suggest
from runner.graph import Plan
from runner.turning import assignments, text

if TYPE_CHECKING:
    from runner.sound import SoundPlan
    from runner.voice import VoicePlan

PARTS = ("vehicle", "operator", "recording")  # of a plan


def check_plan(
    registry: Registry, plan: Plan | SoundPlan | VoicePlan, parts: Collection[str] = PARTS
) -> list[ModelError]:
    """Everything a registry does not allow: unknown elements and properties, wrong types and ranges, fixed knobs.

    Known elements that are missing are reported by `missing_plugins` and `missing_recorders`.

    parts  to check; the plugins of the others are not loaded: a decoder takes 30 MB of a vehicle's memory
    """
    if not isinstance(plan, Plan):
        return _check_sound(registry, plan, parts)
    elements = [
        ("vehicle", "source.elements", plan.source),
        ("vehicle", "graph.vehicle", plan.vehicle),
        ("operator", "graph.operator", plan.operator),
        ("vehicle", "graph.wire.vehicle", plan.wire_vehicle),
        ("operator", "graph.wire.operator", plan.wire_operator),
        ("recording", "recording.elements", plan.recorder),
    ]
    known = {*PACKAGE_OF, *plan.needs}
    found = [
        error
        for part, where, its in elements
        if part in parts
        for error in _check_elements(registry, its, where, known)
    ]
    if "vehicle" in parts:
        found += _check_knobs(registry, plan)
    return found or _check_links(registry, plan, parts)


def _check_sound(registry: Registry, plan: SoundPlan | VoicePlan, parts: Collection[str]) -> list[ModelError]:
    """The same of the vehicle's sound or the operator's voice, with keys below `sound` or `voice`."""
    known, sides = {*PACKAGE_OF, *plan.needs}, [side for side in plan.lists if side in parts]
    lists = [pair for side in sides for pair in plan.lists[side].items()]
    found = [error for where, its in lists for error in _check_elements(registry, its, where, known)]
    lines = {"vehicle": (*plan.source, *plan.vehicle), "operator": plan.operator}
    for side in () if found else sides:
        if not missing_plugins(registry, plan, [side]) and (message := registry.link_problem(lines[side])):
            found.append(ModelError(side, None, message))
    return found


def _check_elements(
    registry: Registry, elements: tuple[Element, ...], where: str, known: Collection[str]
) -> Iterator[ModelError]:
    """known  elements that may be missing"""
    for index, element in enumerate(elements):
        path = f"{where}[{index}]"
        if registry.find(element.factory) is None:
            if element.factory not in known:
                yield ModelError(f"{path}.element", repr(element.factory), _unknown(registry, element.factory))
            continue
        for direction, pad in ((SINK, element.sink), (SRC, element.src)):
            if pad and (problem := _pad_problem(registry, element.factory, direction, pad)):
                yield ModelError(f"{path}.pads.{direction}", repr(pad), problem)
        for key, value in element.properties.items():
            problem = _property_problem(registry, element.factory, key, value)
            if problem:
                yield ModelError(f"{path}.properties.{key}", _shown(value), problem, f"{path}.element")


def _unknown(registry: Registry, name: str) -> str:
    near = get_close_matches(name, registry.names(), 1)  # a list of all would have a thousand
    where = f" in {registry.name}" if registry.name else ""
    if near:
        return f"unknown element{where}{suggest(name, near)}"
    return f"unknown element{where}; if only the vehicle has it, `needs` beside the elements names its package"


def _check_knobs(registry: Registry, plan: Plan) -> Iterator[ModelError]:
    """Each knob's property must exist, be mutable while PLAYING and accept the knob's largest value."""
    camera = plan.camera
    factories = {element.name: element.factory for element in (*plan.source, *plan.vehicle)}
    stated = {each.name: f"source.elements[{place}].element" for place, each in enumerate(plan.source)}
    stated |= {element.name: f"graph.vehicle[{place}].element" for place, element in enumerate(plan.vehicle)}
    largest: dict[str, KnobValue] = {
        "sending": True,
        "roi": camera.full_roi,
        "size": (camera.width, camera.height),
        "bitrate": max(1, int(camera.rate_quality.b_full)),
    }
    for knob, value in largest.items():
        for index, (name, key, filled) in enumerate(assignments(camera, knob, value)):
            factory = factories[name]
            if registry.find(factory) is None:
                continue
            path = f"graph.knobs.{knob}[{index}]"
            rule = _property_problem(registry, factory, key, filled)
            if rule:
                yield ModelError(f"{path}.property", repr(key), rule, stated[name])
            elif not registry.properties(factory)[key].playing and (name, key) not in camera.graph.mutable:
                rule = f"{factory} does not declare {key} as mutable while playing; if it is, list it under mutable"
                yield ModelError(f"{path}.property", repr(key), rule, stated[name])


def _check_links(registry: Registry, plan: Plan, parts: Collection[str]) -> list[ModelError]:
    """Check that neighbouring elements can be linked."""
    errors: dict[str, ModelError] = {}
    for where, line in _lines(registry, plan, parts):
        if where not in errors and (message := registry.link_problem(line)):
            part = plan.operator if where == "graph.operator" else (*plan.source, *plan.vehicle)
            message += _misfit(registry, message, [(each.name, each.factory) for each in part])
            errors[where] = ModelError(where, None, message, *(f"{where}[{place}].name" for place in range(len(part))))
    return list(errors.values())


def _lines(registry: Registry, plan: Plan, parts: Collection[str]) -> Iterator[tuple[str, tuple[Element, ...]]]:
    """The plan's pipelines, except those with an element that the registry lacks.

    A source that ends in a filter becomes a line of its own, which many graphs share; the rest is another.
    """
    filtered = bool(plan.source) and plan.source[-1].factory == "capsfilter"
    rest = replace(plan, source=plan.source[-1:]) if filtered else plan
    sides = [side for side in ("vehicle", "operator") if side in parts]
    streams = not missing_plugins(registry, plan, sides)
    sends, receives = ("vehicle" in sides and streams), ("operator" in sides and streams)
    records = "recording" in parts and plan.recorder and not missing_recorders(registry, plan)
    if filtered and (sends or records):
        yield "graph.vehicle" if sends else "recording.elements", plan.source
    if sends:
        yield "graph.vehicle", (*rest.source, *rest.vehicle)
    if receives:
        yield "graph.operator", plan.operator
    if records:
        yield "recording.elements", rest.recorded("/dev/null")


def _misfit(registry: Registry, message: str, elements: Sequence[tuple[str, str]]) -> str:
    """Which media do not fit where two elements could not be linked, and what would; "" if that is not why."""
    factories, found = dict(elements), re.match(r"could not link (\S+) to ([^\s,]+)", message)
    if not found or not {*found.groups()} <= factories.keys():
        return ""
    names = list(factories)
    before = [factories[name] for name in reversed(names[: names.index(found[1]) + 1])]
    source = next((factory for factory in before if media(registry, factory, SRC)), None)
    sink = factories[found[2]]
    takes = media(registry, sink, SINK)
    gives = media(registry, source, SRC) if source else frozenset()
    if not gives or not takes or gives & takes:
        return ""
    fitting = [name for name in _like(registry, sink) if gives <= media(registry, name, SINK)]
    instead = f"; in place of {sink}: {', '.join(fitting)}, and what receives it at the other side" if fitting else ""
    return f": {source} gives {', '.join(sorted(gives))}, {sink} takes {', '.join(sorted(takes))}{instead}"


def media(registry: Registry, factory: str, direction: str) -> frozenset[str]:
    """Media types of an element's pads by their templates; none if it takes any."""
    found = registry.find(factory)
    pads = [pad.media for pad in found.pads if pad.direction == direction] if found else []
    return frozenset() if None in pads else frozenset(name for each in pads if each for name in each)


def _like(registry: Registry, factory: str) -> Iterable[str]:
    """Elements of the same class, those of the highest rank first."""
    found = registry.find(factory)
    return registry.alike(found.klass) if found else ()


@lru_cache(maxsize=None, typed=True)
def _property_problem(registry: Registry, factory: str, key: str, value: Value) -> str | None:
    """Why an element does not accept this value of this property; None if it does."""
    properties = registry.properties(factory)
    if key not in properties:
        return f"{factory} has no such property{suggest(key, properties)}"
    if not properties[key].writable:
        return f"{key} of {factory} is read-only"
    return value_problem(properties[key], value, registry.reads)


def _pad_problem(registry: Registry, factory: str, direction: str, pad: str) -> str | None:
    """Why an element cannot have a pad of this name in this direction; None if it can."""
    found = registry.find(factory)
    names = sorted(each.name for each in found.pads if each.direction == direction) if found else []
    if any(re.fullmatch(re.sub("%[ud]", "[0-9]+", name).replace("%s", ".+"), pad) for name in names):
        return None
    return f"{factory} has no such {direction} pad; expected one of {', '.join(names) or '(none)'}"


def _shown(value: Value) -> str:
    return repr(value) if isinstance(value, str) else text(value)
