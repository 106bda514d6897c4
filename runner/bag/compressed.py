"""Compressed pictures and video: their type and size, and whether they are whole, by their bytes. Pure."""

from __future__ import annotations

import re
import zlib
from mmap import mmap

from runner.h264.access_unit import starts
from runner.h264.size import picture_size

MOST_PIXELS = 100_000_000  # of a compressed picture
JPEG, PNG = b"\xff\xd8", b"\x89PNG\r\n\x1a\n"
# Markers of JPEG (ITU-T T.81, table B.1): the frame headers, which contain the size, and standalone markers.
FRAMES = {*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC}
STANDALONE = {0x01, *range(0xD0, 0xD9)}
SCAN, END = 0xDA, b"\xff\xd9"
START_CODES = (b"\0\0\1", b"\0\0\0\1")  # of Annex B
BAYER = ("rggb", "bggr", "gbrg", "grbg")
# image_transport of ROS 1 compresses a Bayer pattern as if it were grey, and names no target.
MOSAIC = re.compile(rf"bayer_({'|'.join(BAYER)})8; (?:jpeg|png) compressed ?")
DISTANCES = ("16UC1", "32FC1")  # encodings: in mm and in m
CODECS = {"264": "h264", "avc": "h264", "265": "h265", "hevc": "h265"}  # by parts of the names that writers give


def compressed_form(data: bytes | mmap, stated: str) -> tuple[str, int, int]:
    """jpeg or png, and width and height in px, of a whole compressed picture; with a Bayer pattern like jpeg-rggb.

    stated  its format by the message
    raises  ValueError with the rule that it breaks
    """
    if not len(data):
        raise ValueError("an empty picture")
    if stated.partition(";")[0] in DISTANCES:  # whose upper eight bits are black
        raise ValueError(f"compressed distances, {stated!r}, are not supported; expected the topic of the raw ones")
    if data[: len(JPEG)] == JPEG:
        form, (width, height) = "jpeg", _jpeg_size(data)
    elif data[: len(PNG)] == PNG:
        form, (width, height) = "png", (int.from_bytes(data[at : at + 4], "big") for at in (16, 20))
    else:
        raise ValueError(f"format {stated!r} is not supported; expected JPEG or PNG")
    if width * height > MOST_PIXELS:  # a few bytes may state a picture that fills the memory
        raise ValueError(f"a picture of {width}x{height}, must have at most {MOST_PIXELS} pixels")
    if not width * height or (form == "png" and not _is_whole_png(data)):
        raise ValueError(f"a {form.upper()} picture that is cut off or damaged")
    pattern = MOSAIC.fullmatch(stated)
    return f"{form}-{pattern[1]}" if pattern else form, width, height


def video_form(data: bytes, stated: str) -> tuple[str, tuple[int, int], bool] | None:
    """Codec, width and height in px, and whether decoding can start here, of an access unit; None: it is none.

    stated  its format by the message
    raises  ValueError with the rule that it breaks
    """
    name = stated.lower()
    codec = next((codec for part, codec in CODECS.items() if part in name), None)
    if codec is None and not data.startswith(START_CODES):
        return None
    if codec is None:
        raise ValueError(f"format {stated!r} is not supported; expected h264 or h265")
    if not data.startswith(START_CODES):
        what = f"a picture of {codec} that begins with {data[:4].hex(' ')}" if data else "an empty picture"
        raise ValueError(f"{what}, must begin with a start code (Annex B)")
    key, recovery = starts(data, codec)
    return codec, picture_size(data, codec) or (0, 0), key or recovery is not None


def _jpeg_size(data: bytes | mmap) -> tuple[int, int]:
    """Width and height from the frame header (ITU-T T.81, B.2.2), of a picture that has a scan and an end."""
    at, size = len(JPEG), None
    while at + 4 <= len(data) and data[at] == 0xFF:
        marker = data[at + 1]
        if marker == SCAN:
            break
        if marker in FRAMES and at + 9 <= len(data):
            size = int.from_bytes(data[at + 7 : at + 9], "big"), int.from_bytes(data[at + 5 : at + 7], "big")
        fill = marker == 0xFF
        at += 1 if fill else 2 if marker in STANDALONE else 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    if size is None:
        raise ValueError("a JPEG picture without frame header")
    if at + 4 > len(data) or data[at : at + 2] != bytes((0xFF, SCAN)) or data.rfind(END) < at:
        raise ValueError("a JPEG picture that is cut off or damaged")
    return size


def _is_whole_png(data: bytes | mmap) -> bool:
    """Whether all parts of a PNG picture are there and undamaged: GStreamer's decoder ends at others."""
    at = len(PNG)
    while at + 12 <= len(data):
        end = at + 12 + int.from_bytes(data[at : at + 4], "big")
        if end > len(data) or zlib.crc32(data[at + 4 : end - 4]) != int.from_bytes(data[end - 4 : end], "big"):
            return False
        if data[at + 4 : at + 8] == b"IEND":
            return True
        at = end
    return False
