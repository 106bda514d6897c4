"""Modes of drives that were logged by older versions: rules that have a successor, and lists in place of mappings."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import count
from typing import Any

from runner.core.rules import follow_link

REPLACED = ("cap_at_lower_bound", "cap_by_link", "fade_when_stale")
SUCCESSOR = follow_link.__name__


def with_successors(config: Mapping[str, Any]) -> tuple[dict[str, Any], list[str]]:
    """The configuration of a drive, not yet checked, with `follow_link` in place of what it replaced; names found.

    Lists of rules become mappings.
    """
    modes = config.get("modes")
    if not isinstance(modes, Mapping):
        return dict(config), []
    found = {name for calls in modes.values() for name in _replaced(calls)}
    return {**config, "modes": {mode: _named(_followed(calls)) for mode, calls in modes.items()}}, sorted(found)


def _named(calls: Any) -> Any:
    """A list of rules as a mapping, in which the second of a rule gets a name of its own: hold_upscaling_2."""
    if not isinstance(calls, list) or not all(isinstance(call, Mapping) for call in calls):
        return calls
    entries: dict[str, Any] = {}
    for rule, parameters in (each for call in calls for each in call.items()):
        if rule in entries and isinstance(parameters, Mapping):
            number = next(n for n in count(2) if f"{rule}_{n}" not in entries)
            entries[f"{rule}_{number}"] = {"rule": rule, **parameters}
        else:
            entries[rule] = parameters
    return entries


def _replaced(calls: Any) -> dict[str, Mapping[str, Any]]:
    """Parameters of the replaced rules that a list calls."""
    named = (
        [each for call in calls if isinstance(call, Mapping) for each in call.items()]
        if isinstance(calls, list)
        else []
    )
    return {name: own if isinstance(own, Mapping) else {} for name, own in named if name in REPLACED}


def _followed(calls: Any) -> Any:
    if not (old := _replaced(calls)):
        return calls
    cap = old.get("cap_by_link")
    parameters: dict[str, Any] = {"reports": "ignored"} if cap is None else {"reserve_kbps": cap.get("reserve_kbps", 0)}
    parameters |= {"start": 1 if cap is None else cap.get("start", 1)}
    if cap and "alone_after_s" in cap:
        parameters["after_s"] = cap["alone_after_s"]
    parameters |= old.get("fade_when_stale", {})
    is_old = [isinstance(call, Mapping) and not old.keys().isdisjoint(call) for call in calls]
    first = is_old.index(True)
    kept = [call for call, drops in zip(calls, is_old, strict=True) if not drops]
    return [*kept[:first], {SUCCESSOR: parameters}, *kept[first:]]
