"""The elements in front of a graph's own that drop pictures, and the knob `fps` that sets how many stay. Pure text.

Behind them the caps state the camera's own rate whatever is dropped, so that the encoder goes on as it is: another rate
in its caps would be a key picture. `videorate` is told that any number of pictures may come. While its output may be as
fast, it drops none, however unevenly they come.
"""

from __future__ import annotations

from dataclasses import replace

from runner.core.graph_settings import KnobTarget
from runner.core.model import Element, Graph

# A hyphen, which is not allowed in a graph, keeps their names apart from those of its elements.
DROPPING = "rate-dropping"
_LIMIT = "rate-limit"
EVERY = "1000000/1"  # Hz, more than any camera has
_STATED = "video/x-raw(ANY),framerate="


def with_rate_knob(graph: Graph) -> Graph:
    """The graph with the knob `fps`; the same if it passes pictures on."""
    if graph.passes:
        return graph
    elements = (
        Element("rate-any", "capssetter", {"caps": f"video/x-raw,framerate={EVERY}"}),
        # It begins to count with the first picture after a change of the rate, not with the start of the stream.
        Element(DROPPING, "videorate", {"drop-only": True, "skip-to-first": True}),
        Element(_LIMIT, "capsfilter", {"caps": f"{_STATED}{EVERY}"}),
        Element("rate-own", "capssetter", {"caps": "video/x-raw,framerate={framerate}"}),
    )
    fps = (KnobTarget(_LIMIT, "caps", f"{_STATED}{{fps}}"),)
    return replace(graph, vehicle=(*elements, *graph.vehicle), knobs={**graph.knobs, "fps": fps})
