"""Reads the format of a clip before it is measured."""

from __future__ import annotations

from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path

from gi.repository import GLib, Gst, GstPbutils

from runner.colour_range import to_limited_range
from runner.errors import ArgumentError
from runner.graph import Plan
from runner.gst.caps import structure
from runner.gst.clip_range import full_range
from runner.system.files import file_problem

TIMEOUT_S = 20
# Caps of lossless codecs, as far as caps alone show it.
LOSSLESS = ("video/x-raw", "video/x-huffyuv", "video/x-ffv", "video/x-ffvhuff", "video/x-utvideo", "image/png")


@dataclass(frozen=True, slots=True)
class Form:
    """Format of a clip.

    width, height  px, upright
    fps            frames per second, as stated by the container
    codec          as GStreamer describes it
    lossless       whether the codec keeps every sample
    colorimetry    of a full-range clip once it is converted to limited range; "" for any other clip
    """

    width: int
    height: int
    fps: Fraction
    codec: str
    lossless: bool
    colorimetry: str = ""


def with_clip_range(plan: Plan) -> Plan:
    """The plan of a camera, with the elements that convert its clip if that has full range."""
    clip = next((Path(str(e.properties["location"])) for e in plan.source if e.factory == "filesrc"), None)
    at = next((n for n, e in enumerate(plan.source, 1) if e.factory == "decodebin"), None)
    if clip is None or at is None:
        return plan
    try:
        added = to_limited_range(discover(clip, "clip").colorimetry)
    except ArgumentError:  # reported when it is played
        return plan
    return replace(plan, source=(*plan.source[:at], *added, *plan.source[at:]))


def discover(path: Path, where: str) -> Form:
    """Read the format from the beginning of a clip.

    where   the argument that names it, for messages
    raises  UserError if it is not a readable video
    """
    if why := file_problem(path):
        raise ArgumentError(where, path, why)
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
    sides = stream.get_width(), stream.get_height()
    width, height = reversed(sides) if _is_on_its_side(stream) else sides
    return Form(
        width=width,
        height=height,
        fps=Fraction(stream.get_framerate_num(), stream.get_framerate_denom()),
        codec=str(GstPbutils.pb_utils_get_codec_description(caps)),
        lossless=structure(caps).get_name() in LOSSLESS,
        colorimetry=full_range(str(path), caps),
    )


def _is_on_its_side(stream: GstPbutils.DiscovererStreamInfo) -> bool:
    """Whether the display matrix of a phone's clip turns it by a quarter."""
    tags = stream.get_tags()
    found, orientation = tags.get_string(Gst.TAG_IMAGE_ORIENTATION) if tags else (False, None)
    return bool(found and str(orientation).endswith(("90", "270")))
