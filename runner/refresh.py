"""Graphs whose encoder begins a refresh wave only when it is asked for one, so that a rule may set how often."""

from __future__ import annotations

from dataclasses import replace

from runner.core.model import Graph


def with_asked_waves(graph: Graph) -> Graph:
    """The graph with waves that are asked for; the same if its encoder makes none, or states no interval of them.

    What waits for a wave then waits for the longest interval. If there may be none, none is stated: nothing waits.
    """
    settings = graph.settings
    waves = any(e.factory == "x264enc" and e.properties.get("intra-refresh") is True for e in graph.vehicle)
    if not waves or settings.key_interval_s is None:
        return graph
    longest = max(settings.key_interval_s, settings.longest_wave_s) if settings.longest_wave_s else None
    return replace(graph, settings=replace(settings, key_interval_s=longest, shortest_wave_s=settings.key_interval_s))
