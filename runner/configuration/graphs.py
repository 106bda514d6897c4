"""Builds graphs, sources and recordings from plain data that their schemas accept."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields, replace
from typing import Any

from runner.configuration.origin import GRAPH_PARTS
from runner.core.graph_settings import GraphSettings, KnobCommand, KnobTarget
from runner.core.model import Element, Graph, ModelError, Source
from runner.graph import places_pictures
from runner.settings import Recording

MOUNT_KEYS = ("device", "address", "clip", "bag", "topic")
GRAPH_STRUCTURE = (
    *("defaults", "transport", "verified", "passes", "key_frame", "vehicle", "operator", "wire", "knobs", "mutable"),
    *("effort", "efforts", "needs"),
)
GRAPH_SETTINGS = [part.name for part in fields(GraphSettings)]
ONLY_EFFORT = "medium"  # of graphs without `efforts`


def elements(data: Sequence[Mapping[str, Any]] | None) -> tuple[Element, ...]:
    return tuple(Element(e["name"], e["element"], e.get("properties") or {}, **e.get("pads") or {}) for e in data or ())


def _effort(data: Mapping[str, Any]) -> dict[str, Any]:
    """Settings for a graph's `effort`, by key; None for an element's own default."""
    efforts: Mapping[str, Mapping[str, Any]] = data.get("efforts") or {}
    elements = str(data["vehicle"])
    is_used = any(f"{{{key}}}" in elements for values in efforts.values() for key in values)
    known = list(efforts) if is_used else [ONLY_EFFORT]
    effort = data.get("effort", ONLY_EFFORT)
    if effort not in known:
        expected = f"one of {', '.join(known)}" if known[1:] else known[0]
        stated = ["efforts"] if is_used else []
        raise ModelError("effort", effort, f"must be {expected}, which this graph's encoder supports", *stated)
    return dict(efforts.get(effort, {}))


def read_graph(data: Mapping[str, Any]) -> Graph:
    for key, side in GRAPH_PARTS.items():
        if key in data:
            raise ModelError(key, None, f"is unused; include it in {side} as ${{..{key}}}")
    wire, knobs = data.get("wire") or {}, data["knobs"]
    named = {key: value for key, value in data.items() if key not in GRAPH_STRUCTURE} | _effort(data)
    graph = Graph(
        transport=data["transport"],
        vehicle=elements(data["vehicle"]),
        operator=elements(data["operator"]),
        wire_vehicle=elements(wire.get("vehicle")),
        wire_operator=elements(wire.get("operator")),
        knobs={
            knob: tuple(KnobTarget(**its) for its in targets if "element" in its) for knob, targets in knobs.items()
        },
        settings=GraphSettings(**given(named, GRAPH_SETTINGS)),
        placeholders=named,
        command=_command(knobs["bitrate"]),
        mutable=tuple((entry["element"], entry["property"]) for entry in data.get("mutable") or ()),
        **given(data, ("verified", "passes", "key_frame", "needs")),
    )
    return replace(graph, places=places_pictures(graph))


def _command(targets: Sequence[Mapping[str, Any]]) -> KnobCommand | None:
    """The command among the targets of a knob."""
    found = [dict(its) for its in targets if "command" in its]
    if len(found) > 1:
        raise ModelError("knobs.bitrate", f"{len(found)} commands", "one command sets the bitrate")
    command = KnobCommand(tuple(found[0].pop("command")), **found[0]) if found else None
    if command and command.with_bitrate(1) == list(command.words):
        raise ModelError("knobs.bitrate", list(command.words), "one word of the command must have {kbps} or {bps}")
    return command


def read_source(data: Mapping[str, Any]) -> Source:
    render = data.get("render")
    return Source(
        elements=elements(data["elements"]),
        encoded={codec: elements(its) for codec, its in (data.get("encoded") or {}).items()},
        settings={key: data[key] for key in MOUNT_KEYS if data.get(key) is not None},
        capture=data.get("capture") or {},
        plays_bags="bag" in data,
        subscribes=data.get("ros", False),
        **given(data, ("loop", "frozen_s", "repeated_s", "depth_m", "credentials", "medium", "first_reply_s")),
        needs=data.get("needs") or {},
        **({"render": render["drive"], "render_s": render["seconds"]} if render else {}),
        stand_in=elements(data.get("stand_in")),
    )


def read_recording(data: Mapping[str, Any]) -> Recording:
    return Recording(data["codec"], data["of_raw"], elements(data["elements"]), data.get("needs") or {})


def given(data: Mapping[str, Any], keys: Iterable[str]) -> dict[str, Any]:
    """The given keys among `keys`; the model has defaults for the others."""
    return {key: data[key] for key in keys if key in data}
