"""Rules of older versions: drives that were logged with them, and whoever still names them, get their successor."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from runner.core.rules import follow_link

Calls = Sequence[Mapping[str, Mapping[str, Any]]]

REPLACED = ("cap_at_lower_bound", "cap_by_link", "fade_when_stale")
SUCCESSOR = follow_link.__name__


def with_successors(config: Mapping[str, Any]) -> tuple[dict[str, Any], list[str]]:
    """The configuration of a drive with `follow_link` in place of what it replaced, and the names found."""
    modes = {mode: list(calls) for mode, calls in config.get("modes", {}).items()}
    found = {name for calls in modes.values() for call in calls for name in call if name in REPLACED}
    if not found:
        return dict(config), []
    return {**config, "modes": {mode: _followed(calls) for mode, calls in modes.items()}}, sorted(found)


def _followed(calls: Calls) -> list[Mapping[str, Any]]:
    old = {name: parameters for call in calls for name, parameters in call.items() if name in REPLACED}
    if not old:
        return list(calls)
    cap, fade = old.get("cap_by_link"), old.get("fade_when_stale", {})
    parameters = {"after_s": cap["alone_after_s"]} if cap and "alone_after_s" in cap else {}
    parameters |= fade
    if cap is None:
        parameters |= {"reports": "ignored", "start": 1}
    else:
        parameters |= {"reserve_kbps": cap.get("reserve_kbps", 0), "start": cap.get("start", 1)}
    first = next(index for index, call in enumerate(calls) if old.keys() & call.keys())
    kept = [call for call in calls if not old.keys() & call.keys()]
    return [*kept[:first], {SUCCESSOR: parameters}, *kept[first:]]
