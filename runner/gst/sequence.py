"""Reads the format of a clip before it is measured."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

from gi.repository import GLib, Gst, GstPbutils

from runner.errors import ArgumentError
from runner.gst.caps import structure
from runner.system.files import file_problem

TIMEOUT_S = 20
# Caps of lossless codecs, as far as caps alone show it.
LOSSLESS = ("video/x-raw", "video/x-huffyuv", "video/x-ffv", "video/x-ffvhuff", "video/x-utvideo", "image/png")


@dataclass(frozen=True, slots=True)
class Form:
    """Format of a clip.

    width, height  px
    fps            frames per second, as stated by the container
    codec          as GStreamer describes it
    lossless       whether the codec keeps every sample
    """

    width: int
    height: int
    fps: Fraction
    codec: str
    lossless: bool


def discover(path: Path, where: str) -> Form:
    """Read the format from the beginning of a clip.

    where   the argument that names it, for messages
    raises  UserError if it is not a readable video
    """
    if not path.is_file():
        raise ArgumentError(where, path, file_problem(path))
    if path.stat().st_size == 0:
        raise ArgumentError(where, path, "the file is empty")
    discoverer = GstPbutils.Discoverer.new(TIMEOUT_S * Gst.SECOND)
    try:
        info = discoverer.discover_uri(path.resolve().as_uri())
    except GLib.Error as error:
        raise ArgumentError(where, path, f"cannot be read as video: {error.message}") from None
    streams = info.get_video_streams()
    if not streams:
        raise ArgumentError(where, path, "has no video")
    stream = streams[0]
    if stream.get_framerate_num() <= 0:
        raise ArgumentError(where, path, "has no frame rate")
    caps = stream.get_caps()
    return Form(
        width=stream.get_width(),
        height=stream.get_height(),
        fps=Fraction(stream.get_framerate_num(), stream.get_framerate_denom()),
        codec=str(GstPbutils.pb_utils_get_codec_description(caps)),
        lossless=structure(caps).get_name() in LOSSLESS,
    )
