"""The difference between the decision and the values commanded so far, as commands to `apply`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

from runner.core.decision import Decision, Setting
from runner.core.model import Roi, plain

Size = tuple[int, int]
KnobValue = bool | int | Fraction | Roi | Size | tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Command:
    """Turn one knob of one camera. Commands of a camera that arrive together take effect between the same two frames.

    value  sending: bool; roi: Roi in px of the full image; size: (width, height) in px; bitrate: whole kbit/s, >= 1;
           uplinks: names of those that carry it; fps: Hz, each n-th picture of the camera;
           wave_s: time between two refresh waves
    """

    camera: str
    knob: str
    value: KnobValue

    def to_json(self) -> dict[str, Any]:
        value: Any = self.value
        if isinstance(value, Roi):
            value = value.to_json()
        elif self.knob == "size":
            value = {"width": value[0], "height": value[1]}
        elif isinstance(value, Fraction):
            value = plain(value)
        return {"camera": self.camera, "knob": self.knob, "value": value}


KnobValues = Mapping[str, KnobValue]  # value by knob, of one camera


def wanted(setting: Setting) -> KnobValues:
    """Knob values of a camera for a setting. While nothing is sent, the other knobs keep their values."""
    if not setting.sending:
        return {"sending": False}
    size = (setting.width, setting.height)
    values: dict[str, KnobValue] = {"sending": True, "roi": setting.roi, "size": size, "bitrate": setting.kbps}
    if setting.fps is not None:
        values["fps"] = setting.fps
    if setting.wave_s is not None:
        values["wave_s"] = setting.wave_s
    if setting.uplinks:
        values["uplinks"] = setting.uplinks
    return values


def difference(decision: Decision, commanded: Mapping[str, KnobValues]) -> list[Command]:
    """Commands that take every camera's knobs from the values last commanded to those of the decision."""
    commands = []
    for name, setting in decision.settings.items():
        now, values = commanded.get(name, {}), wanted(setting)
        if values == now:
            continue
        for knob, value in values.items():
            last = now.get(knob)
            # Most values are the same object as commanded; comparing regions field by field is slow.
            if last is not value and last != value:
                commands.append(Command(name, knob, value))
    return commands


def after(commanded: Mapping[str, KnobValues], commands: list[Command]) -> Mapping[str, KnobValues]:
    """The commanded knob values after these commands."""
    if not commands:
        return commanded
    turned: dict[str, dict[str, KnobValue]] = {}
    for command in commands:
        turned.setdefault(command.camera, {})[command.knob] = command.value
    return {**commanded, **{name: {**commanded.get(name, {}), **knobs} for name, knobs in turned.items()}}
