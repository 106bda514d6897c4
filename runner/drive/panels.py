"""Which cameras share a panel of a figure."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

DOWN_DEG = 25.0  # a camera pitched down by this much is a top view, as on the operator's page
PANEL_CAMERAS = 4  # number of curves distinguishable in one panel; more are split if the mounting gives no groups


class Panel(NamedTuple):
    """Cameras that are drawn into one panel."""

    title: str
    cameras: tuple[str, ...]


def panels(cameras: Mapping[str, Any]) -> tuple[Panel, ...]:
    """Split cameras into panels: those that look along the road, and those pitched down at the surroundings.

    cameras  the configuration's, with `pose` and `place` if they are mounted
    returns  one or two panels, cameras in the configuration's order

    On the paper's vehicle these are the front- and rear-mounted ones and the top views, as in its figures. If pitch
    makes no difference, up to four cameras share one panel; more are split in half, in the order of their tiles.
    """
    down = [name for name, camera in cameras.items() if (camera.get("pose") or {}).get("pitch_deg", 0) >= DOWN_DEG]
    along = [name for name in cameras if name not in down]
    if down and along:
        return _panel(along), _panel(down)
    if len(cameras) <= PANEL_CAMERAS:
        return (_panel(cameras),)
    tiles = sorted(cameras, key=lambda name: _tile(cameras[name]))
    half = (len(tiles) + 1) // 2
    return _panel(tiles[:half]), _panel(tiles[half:])


def _tile(camera: Mapping[str, Any]) -> tuple[int, int]:
    place = camera.get("place") or {}
    return place.get("row", 0), place.get("column", 0)


def _panel(names: Iterable[str]) -> Panel:
    """Named after the prefixes of the cameras' names, or after its only camera."""
    cameras = tuple(names)
    if len(cameras) == 1:
        return Panel(cameras[0], cameras)
    kinds = list(dict.fromkeys(name.partition("_")[0] for name in cameras))
    return Panel(" and ".join([", ".join(kinds[:-1]), kinds[-1]] if kinds[1:] else kinds).capitalize(), cameras)
