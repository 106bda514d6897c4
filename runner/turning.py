"""What the knobs of a camera's graph set when they are turned: properties of its elements. Pure."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import replace
from fractions import Fraction
from functools import lru_cache

from runner.core.commands import KnobValue
from runner.core.graph_settings import NEVER_S, GraphSettings
from runner.core.model import PLACEHOLDER, Camera, Element, Graph, ModelError, Roi, Value
from runner.dropping import EVERY

# Encoders whose rate control goes by the frame rate of their caps, not by the time between pictures: see `assignments`.
_COUNT_FRAMES = ("x264enc", "x265enc")
# Encoders whose rate control makes up for time without pictures, by pictures that are too large.
_SAVE_UP = ("openh264enc",)
Assignment = tuple[str, str, Value]  # element, property, value


def assignments(camera: Camera, knob: str, value: KnobValue, pace: float = 1.0) -> list[Assignment]:
    """The element properties that turning a knob to a value sets, in the order of the graph.

    pace    the camera's frame rate as a multiple of the one that arrives: so much more is asked of an encoder that
            counts frames. The length of its buffer stays, since it counts that in frames too
    raises  ModelError if the type of the value does not fit the knob
    """
    if knob in ("uplinks", "wave_s"):  # which carry the camera, and when waves are asked for, is no element's property
        return []
    of_time, of_frames = _quantities(camera, value), _quantities(camera, value, pace)
    count_frames = {element.name for element in camera.graph.vehicle if element.factory in _COUNT_FRAMES}
    turned: list[Assignment] = []
    for target in camera.graph.knobs[knob]:
        quantities = of_frames if target.element in count_frames else of_time
        turned.append((target.element, target.property, _turned(knob, target.value, quantities)))
    return turned


def _turned(knob: str, wanted: str, quantities: Mapping[str, Value]) -> Value:
    """What a knob sets: the quantity of that name, or a text with quantities in place of {placeholders}."""
    names = PLACEHOLDER.findall(wanted)
    if not quantities.keys() >= set(names or [wanted]):
        raise ModelError(f"graph.knobs.{knob}", repr(wanted), f"{knob} offers {', '.join(quantities)}")
    return PLACEHOLDER.sub(lambda match: text(quantities[match[1]]), wanted) if names else quantities[wanted]


def is_restarted_after_gaps(graph: Graph) -> bool:
    """Whether the encoder must begin anew after a time without pictures, and does so with new caps."""
    saves_up = any(element.factory in _SAVE_UP for element in graph.vehicle)
    return saves_up and {target.property for target in graph.knobs["size"]} == {"caps"}


def turn_elements(
    camera: Camera, elements: Iterable[Element], knobs: Mapping[str, KnobValue], pace: float = 1.0
) -> tuple[Element, ...]:
    """Elements of a camera with these knobs turned; settings of other elements are ignored. pace: see `assignments`."""
    by_element: dict[str, dict[str, Value]] = {}
    for knob, value in knobs.items():
        for name, key, filled in assignments(camera, knob, value, pace):
            by_element.setdefault(name, {})[key] = filled
    return tuple(replace(e, properties={**e.properties, **by_element.get(e.name, {})}) for e in elements)


def _quantities(camera: Camera, value: KnobValue, pace: float = 1.0) -> dict[str, Value]:
    """The quantities that a knob's value offers to its targets, by their names in the YAML."""
    if isinstance(value, bool):
        return {"on": value, "off": not value}
    if isinstance(value, int):
        bps = round(1000 * value * pace)
        of_frames = per_frame_rate(camera.graph.settings, camera.fps)
        rate: dict[str, Value] = {"kbps": max(1, round(bps / 1000)), "bps": bps}
        return {**rate, "controls": camera.capture.controls_text, **of_frames, **_buffer(of_frames, value)}
    if isinstance(value, Fraction):
        return {"fps": EVERY if value >= camera.fps else f"{value.numerator}/{value.denominator}"}
    if isinstance(value, Roi):
        # The crop element sees the native picture; an ROI is relative to the full image inside it.
        native_width, native_height = camera.source_size
        full = camera.in_source
        left, top = full.x + value.x, full.y + value.y
        right, bottom = native_width - left - value.width, native_height - top - value.height
        return {"left": left, "right": right, "top": top, "bottom": bottom}
    return dict(zip(("width", "height"), value, strict=True))


def _buffer(of_frames: Mapping[str, int], kbps: int) -> dict[str, Value]:
    """Length of the rate control's buffer, ms, if the graph states it in frames.

    At least 1 kbit: x264 rounds down to whole kbit, and treats 0 as unlimited.
    """
    return {"vbv_ms": max(of_frames["vbv_ms"], math.ceil(1000 / kbps))} if "vbv_ms" in of_frames else {}


@lru_cache  # needed several times for each new bitrate
def per_frame_rate(settings: GraphSettings, fps: Fraction) -> Mapping[str, int]:
    """The placeholders that settings of a graph fill at a frame rate."""
    seconds, frames = settings.key_interval_s, settings.vbv_frames
    if settings.shortest_wave_s is not None:
        seconds = NEVER_S
    values = {} if seconds is None else {"key_interval_frames": seconds * fps}
    values |= {} if frames is None else {"vbv_ms": 1000 * frames / fps}
    return {name: max(1, round(value)) for name, value in values.items()}


def text(value: Value) -> str:
    """A property's value as GStreamer reads it."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float):
        # 0.1 stays 0.1, 90000.0 becomes 90000
        exact = Fraction(str(value))
        return str(exact.numerator) if exact.denominator == 1 else str(value)
    return str(value)
