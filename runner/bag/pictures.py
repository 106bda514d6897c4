"""Pictures of ROS messages: raw ones by their encoding, compressed ones by their first bytes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

SECOND_NS = 1_000_000_000
# By encoding (sensor_msgs/image_encodings.hpp), GStreamer's name of the format and bytes of a pixel.
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
}
ALIGNED = 4  # bytes: rows begin at multiples in GStreamer
MOST_PIXELS = 100_000_000  # of a compressed picture
JPEG, PNG = b"\xff\xd8", b"\x89PNG\r\n\x1a\n"
# Markers of JPEG (ITU-T T.81, table B.1): the frame headers, which contain the size, and standalone markers.
FRAMES = {*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC}
STANDALONE = {0x01, *range(0xD0, 0xD9)}


@dataclass(frozen=True, slots=True)
class Picture:
    """One picture of a bag.

    ns             capture time, ns since 1970: the stamp of its header
    stamped        whether it had a stamp; otherwise `ns` is the time of recording
    format         GStreamer's name of a raw format, or jpeg, or png
    width, height  px
    data           rows from the top, each padded to a multiple of four bytes; or the compressed file
    """

    ns: int
    format: str
    width: int
    height: int
    data: bytes
    stamped: bool = True

    def at(self, ns: int) -> Picture:
        """A copy with the time of recording, for a picture without a stamp."""
        return replace(self, ns=ns, stamped=False)

    @property
    def size(self) -> str:
        return f"{self.width}x{self.height}"


def read_image(message: Any) -> Picture:
    """A picture of a message sensor_msgs/Image.

    raises  ValueError with the rule that it breaks
    """
    width, height, step = int(message.width), int(message.height), int(message.step)
    form = image_format(message.encoding, width, height, step, message.is_bigendian, len(message.data))
    row = width * FORMATS[message.encoding][1]
    return Picture(stamp_ns(message), form, width, height, _padded(message.data[: step * height], height, row))


def image_format(encoding: str, width: int, height: int, step: int, big: bool, size: int) -> str:
    """GStreamer's name of the format of a raw picture.

    width, height  px
    step           bytes from one row to the next
    big            whether the bytes of a number are in big-endian order
    size           of the picture, bytes
    raises         ValueError with the rule that it breaks
    """
    if encoding not in FORMATS:
        raise ValueError(f"encoding {encoding!r} is not supported; expected one of {', '.join(FORMATS)}")
    form, pixel = FORMATS[encoding]
    row = width * pixel
    if not width or not height or step < row:
        raise ValueError(f"a picture of {width}x{height} with rows of {step} bytes, must be at least {max(1, row)}")
    if size < step * height:
        raise ValueError(f"a picture of {size} bytes, must have {step * height}: {height} rows of {step}")
    return "GRAY16_BE" if big and form == "GRAY16_LE" else form


def read_compressed(message: Any) -> Picture:
    """A picture of a message sensor_msgs/CompressedImage. Its bytes determine the type: `format` differs by writer.

    raises  ValueError with the rule that it breaks
    """
    data = bytes(message.data)
    return Picture(stamp_ns(message), *compressed_form(data, message.format), data)


def compressed_form(data: bytes, stated: str) -> tuple[str, int, int]:
    """jpeg or png, and width and height in px, by the first bytes of a compressed picture.

    data    enough bytes to contain its headers
    stated  its format by the message
    raises  ValueError with the rule that it breaks
    """
    if data.startswith(JPEG):
        form, (width, height) = "jpeg", _jpeg_size(data)
    elif data.startswith(PNG) and len(data) >= 24:
        form, width, height = "png", int.from_bytes(data[16:20], "big"), int.from_bytes(data[20:24], "big")
    else:
        raise ValueError(f"format {stated!r} is not supported; expected JPEG or PNG")
    if width * height > MOST_PIXELS:  # a few bytes may state a picture that fills the memory
        raise ValueError(f"a picture of {width}x{height}, must have at most {MOST_PIXELS} pixels")
    return form, width, height


def stamp_ns(message: Any) -> int:
    """Time of a message by its header, ns since 1970; 0: not set."""
    stamp = message.header.stamp
    return int(stamp.sec) * SECOND_NS + int(stamp.nanosec)


def _padded(data: Any, height: int, row: int) -> bytes:
    """Rows with GStreamer's padding in place of the message's."""
    import numpy as np

    rows = np.asarray(data, np.uint8).reshape(height, -1)
    stride = -(-row // ALIGNED) * ALIGNED
    if rows.shape[1] == stride:
        return rows.tobytes()
    padded = np.zeros((height, stride), np.uint8)
    padded[:, :row] = rows[:, :row]
    return padded.tobytes()


def _jpeg_size(data: bytes) -> tuple[int, int]:
    """Width and height from the frame header (ITU-T T.81, B.2.2)."""
    at = len(JPEG)
    while at + 9 <= len(data) and data[at] == 0xFF:
        marker = data[at + 1]
        if marker in FRAMES:
            return int.from_bytes(data[at + 7 : at + 9], "big"), int.from_bytes(data[at + 5 : at + 7], "big")
        fill = marker == 0xFF
        at += 1 if fill else 2 if marker in STANDALONE else 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    raise ValueError("a JPEG picture without frame header")
