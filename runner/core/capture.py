"""What is requested of a V4L2 camera, and how GStreamer writes it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from fractions import Fraction

# Caps of encoded formats that a camera delivers; raw formats are named directly.
_ENCODED = {"mjpeg": "image/jpeg", "h264": "video/x-h264", "h265": "video/x-h265"}


@dataclass(frozen=True, slots=True)
class Capture:
    """Format requested from a V4L2 camera; None leaves the choice to the camera.

    format    mjpeg, h264, h265, raw, or the name of a raw format in GStreamer such as YUY2
    width     px, of the captured picture
    height    px
    fps       Hz
    controls  V4L2 controls by name, set when the device is opened, as `v4l2-ctl --list-ctrls` shows them
    """

    format: str | None = None
    width: int | None = None
    height: int | None = None
    fps: Fraction | None = None
    controls: Mapping[str, int] = field(default_factory=dict)

    @property
    def caps(self) -> str | None:
        """Caps requested from the camera; None: any."""
        if self.format is None:
            return None
        caps = [_ENCODED.get(self.format, "video/x-raw")]
        caps += [f"format={self.format}"] if self.format not in (*_ENCODED, "raw") else []
        caps += [f"width={self.width}"] if self.width else []
        caps += [f"height={self.height}"] if self.height else []
        caps += [f"framerate={self.fps.numerator}/{self.fps.denominator}"] if self.fps else []
        return ",".join(caps)

    @property
    def controls_text(self) -> str:
        """Its controls as the serialized structure that v4l2src takes."""
        return ",".join(["controls", *(f"{name}={value}" for name, value in self.controls.items())])
