"""Pictures of messages: raw ones by their encoding, compressed ones by their first bytes, video by access units."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Protocol

from runner.bag.compressed import BAYER, DISTANCES, compressed_form, video_form
from runner.core.model import DEPTH_M
from runner.system.clocks import SECOND_NS

# By encoding (sensor_msgs/image_encodings.hpp), GStreamer's name of the format and bytes of a pixel in the first plane.
FORMATS = {
    "mono8": ("GRAY8", 1),
    "mono16": ("GRAY16_LE", 2),
    "rgb8": ("RGB", 3),
    "bgr8": ("BGR", 3),
    "rgba8": ("RGBA", 4),
    "bgra8": ("BGRA", 4),
    "yuv422": ("UYVY", 2),
    "uyvy": ("UYVY", 2),
    "yuv422_yuy2": ("YUY2", 2),
    "yuyv": ("YUY2", 2),
    "nv12": ("NV12", 1),
    "nv21": ("NV21", 1),
    "8UC1": ("GRAY8", 1),
    "8UC3": ("BGR", 3),  # as OpenCV, which names it, orders colours
    "8UC4": ("BGRA", 4),
    **{f"bayer_{pattern}8": (pattern, 1) for pattern in BAYER},
}
DEPTHS = dict(zip(DISTANCES, (("mono8", 2), ("mono8", 4)), strict=True))  # as in `WIDE`
# Encodings that GStreamer lacks: the one of 8 bits that they are reduced to, and bytes of a pixel.
WIDE = {
    **DEPTHS,
    **{f"{colours}16": (f"{colours}8", 2 * len(colours)) for colours in ("rgb", "bgr", "rgba", "bgra")},
    **{f"bayer_{pattern}16": (f"bayer_{pattern}8", 2) for pattern in BAYER},
}
ENCODINGS = (*FORMATS, *WIDE)
SUBSAMPLED = ("NV12", "NV21")  # a second plane, of half as many rows as long as those of the first one
ALIGNED = 4  # bytes: rows begin at multiples in GStreamer


class RawForm(Protocol):
    """What a raw picture states about its bytes, as sensor_msgs/Image does.

    step  bytes from one row to the next

    `is_bigendian` may be missing: foxglove.RawImage has none.
    """

    encoding: str
    width: int
    height: int
    step: int


@dataclass(frozen=True, slots=True)
class Picture:
    """One picture of a bag.

    ns             capture time, ns since 1970: the stamp of its header
    stamped        whether it had a stamp; otherwise `ns` is the time of recording
    format         GStreamer's name of a raw format or of a Bayer pattern, or jpeg, png, h264, h265, or as jpeg-rggb
    width, height  px; of video 0 where the unit does not state them
    data           rows from the top, each padded to a multiple of four bytes; or the compressed file, or an access unit
    key            whether it can be decoded without the pictures before it
    """

    ns: int
    format: str
    width: int
    height: int
    data: bytes
    stamped: bool = True
    key: bool = True

    def at(self, ns: int) -> Picture:
        """A copy with the time of recording, for a picture without a stamp."""
        return replace(self, ns=ns, stamped=False)

    @property
    def size(self) -> str:
        return f"{self.width}x{self.height}"


@dataclass(frozen=True, slots=True)
class BadPicture:
    """A message whose picture cannot be shown. number: of the picture in its topic, from 1"""

    number: int
    why: str


def read_image(message: Any, depth_m: float = DEPTH_M) -> Picture:
    """A picture of a message sensor_msgs/Image or foxglove.RawImage.

    depth_m  distance that is white in a picture of distances
    raises   ValueError with the rule that it breaks
    """
    form = image_format(message, len(message.data))
    data: bytes = packed_rows(message, message.data, depth_m).tobytes()
    return Picture(stamp_ns(message), form, int(message.width), int(message.height), data)


def read_compressed(message: Any, _depth_m: float = DEPTH_M) -> Picture:
    """A picture of sensor_msgs/CompressedImage, foxglove.CompressedImage or CompressedVideo, or FFMPEGPacket.

    Its bytes determine the type, except which video it is: `format` differs by writer.

    raises  ValueError with the rule that it breaks
    """
    data = bytes(message.data)
    stated = message.format if hasattr(message, "format") else message.encoding
    if video := video_form(data, stated):
        codec, size, key = video
        return Picture(stamp_ns(message), codec, *size, data, key=key)
    return Picture(stamp_ns(message), *compressed_form(data, stated), data)


def bayer_pattern(form: str) -> str:
    """The Bayer pattern of a format of `Picture`, such as rggb or jpeg-rggb; "" if it has none."""
    pattern = form.rpartition("-")[2]
    return pattern if pattern in BAYER else ""


def image_format(form: RawForm, size: int) -> str:
    """GStreamer's name of the format of a raw picture, or of what it is reduced to; see `packed_rows`.

    size    of the picture, bytes
    raises  ValueError with the rule that it breaks
    """
    wide = WIDE.get(form.encoding)
    if not wide and form.encoding not in FORMATS:
        raise ValueError(f"encoding {form.encoding!r} is not supported; expected one of {', '.join(ENCODINGS)}")
    name, pixel = FORMATS[wide[0] if wide else form.encoding]
    row = form.width * (wide[1] if wide else pixel)
    if form.width <= 0 or form.height <= 0 or form.step < row:
        found = f"a picture of {form.width}x{form.height} with rows of {form.step} bytes"
        raise ValueError(f"{found}, must be at least {max(1, row)}")
    rows = _row_count(form)
    if size < form.step * rows:
        raise ValueError(f"a picture of {size} bytes, must have {form.step * rows}: {rows} rows of {form.step}")
    if name in SUBSAMPLED and (form.width % 2 or form.height % 2):
        raise ValueError(f"a picture of {form.width}x{form.height} in {form.encoding}, must have even sizes")
    return "GRAY16_BE" if _is_big(form) and name == "GRAY16_LE" else name


def must_be_packed(form: RawForm) -> bool:
    """Whether GStreamer cannot read the rows as they are: `packed_rows` makes those that it can."""
    is_bayer = form.encoding in FORMATS and FORMATS[form.encoding][0] in BAYER  # its element knows one layout only
    return form.encoding in WIDE or (is_bayer and form.step != _stride(form.width))


def packed_rows(form: RawForm, data: Any, depth_m: float) -> Any:
    """The rows of a picture as GStreamer pads them, with 8 bits for each colour where it knows no more.

    Of wide colours and Bayer patterns the upper eight bits remain. Distances become grey, white from depth_m on; an
    unknown one is black.

    data     bytes of at least all rows
    returns  rows x bytes of a row
    """
    import numpy as np

    count = _row_count(form)
    rows = np.frombuffer(data, np.uint8)[: form.step * count].reshape(count, form.step)
    narrow, pixel = WIDE.get(form.encoding, (form.encoding, FORMATS.get(form.encoding, ("", 0))[1]))
    rows = rows[:, : form.width * pixel]
    if form.encoding in DEPTHS:
        rows = _grey(np.ascontiguousarray(rows), pixel, _is_big(form), depth_m)
    elif form.encoding in WIDE:
        rows = rows[:, 0 if _is_big(form) else 1 :: 2]
    stride = _stride(form.width * FORMATS[narrow][1])
    return np.pad(rows, ((0, 0), (0, stride - rows.shape[1]))) if stride > rows.shape[1] else rows


def _grey(rows: Any, pixel: int, big: bool, depth_m: float) -> Any:
    """Distances, integers in mm or floating-point numbers in m, as grey."""
    import numpy as np

    number, white = ("u2", 1000 * depth_m) if pixel == 2 else ("f4", depth_m)
    distances = rows.view(np.dtype(number).newbyteorder(">" if big else "<")).astype(np.float32)
    known = np.nan_to_num(distances, nan=0, posinf=0, neginf=0)
    return np.clip(known * np.float32(255 / white), 0, 255).astype(np.uint8)


def _row_count(form: RawForm) -> int:
    """Rows of all planes."""
    planar = form.encoding in FORMATS and FORMATS[form.encoding][0] in SUBSAMPLED
    return form.height + (form.height // 2 if planar else 0)


def _stride(row: int) -> int:
    return -(-row // ALIGNED) * ALIGNED


def _is_big(form: RawForm) -> bool:
    return bool(getattr(form, "is_bigendian", False))


def stamp_ns(message: Any) -> int:
    """Time of a message by its header, ns since 1970; 0: not set."""
    stamp = message.header.stamp if hasattr(message, "header") else message.timestamp
    return int(stamp.sec) * SECOND_NS + int(stamp.nanosec if hasattr(stamp, "nanosec") else stamp.nsec)
