"""Elements that bring full-range pictures to limited range."""

from __future__ import annotations

from runner.core.model import Element, Value

# From luma 0..255 to 16..235, chroma accordingly; videobalance computes 16 + (y - 16) * contrast + 255 * brightness.
_TO_LIMITED: dict[str, Value] = {
    "contrast": 219 / 255,
    "brightness": 16 * 219 / 255**2,
    "saturation": 224 / 255,
}


def to_limited_range(colorimetry: str) -> tuple[Element, ...]:
    """Elements behind the decoder of a full-range clip, whose names cannot be those of a graph.

    colorimetry  in limited range: videoconvert, which mistakes the range, only sees the result; "": none are needed
    """
    if not colorimetry:
        return ()
    return (
        Element("range-stated", "capssetter", {"caps": f"video/x-raw,colorimetry=(string){colorimetry}"}),
        Element("range-format", "videoconvert", {}),  # videobalance has 8 bits
        Element("range-limited", "videobalance", _TO_LIMITED),
    )
