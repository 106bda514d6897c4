"""A recorded sequence of a camera, analysed once for length and complexity."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from fractions import Fraction
from pathlib import Path
from typing import Any

from runner.colour_range import to_limited_range
from runner.core.model import DEPTH_M, BagTopic, Camera, ModelError
from runner.errors import ArgumentError, RunError
from runner.graph import COLORIMETRY, launch
from runner.h264.access_unit import stated_region
from runner.lanes import BAG, FRAMES, LaneSet
from runner.rate_quality.cache import Cache, digest, file_digest
from runner.rate_quality.recordings import INDEX
from runner.settings import WHOLE

SURVEY_VERSION = 2
FEWEST_FRAMES = 25
VIDEO = ".ts"  # suffix of the video that a drive keeps
LOSSY = ("jpeg", "h264", "h265")  # formats of pictures in bags
ARGUMENT = "sequence"  # of the command line, for messages
Footage = Path | BagTopic  # a clip, or pictures of a bag


@dataclass(frozen=True, slots=True)
class Sequence:
    """A clip, or the pictures of a bag, and its properties.

    sha256         of the file, or of the files of a bag
    width, height  px
    fps            frames per second
    lossless       whether its codec keeps every sample
    topic          of the bag; "" for a clip
    depth_m        of the bag, see `BagTopic`, unless it is the usual one; None, too, for a clip
    colorimetry    of a full-range clip, in limited range; "" for any other one
    si, ti         spatial and temporal information, the maximum over all frames (ITU-T P.910); si_mean, ti_mean: mean
    """

    path: str
    sha256: str
    width: int
    height: int
    fps: Fraction
    codec: str
    lossless: bool
    frames: int
    si: float
    ti: float
    si_mean: float
    ti_mean: float
    topic: str = ""
    depth_m: float | None = None
    colorimetry: str = ""

    @property
    def bag(self) -> BagTopic | None:
        return BagTopic(self.path, self.topic, self.depth_m or DEPTH_M) if self.topic else None

    @property
    def identity(self) -> tuple[object, ...]:
        """What determines its pictures."""
        return _identity(self.sha256, asdict(self))

    @property
    def decode(self) -> str:
        """The pipeline that decodes its frames."""
        return decoding(self.bag or Path(self.path), self.fps, self.colorimetry)


def decoding(footage: Footage, fps: Fraction, colorimetry: str = "") -> str:
    """The GStreamer pipeline that decodes a clip, or the pictures of a bag, to I420 frames at a constant rate.

    These are the pictures that conf/source/file.yaml and bag.yaml send, before they are fitted to the camera's size.

    colorimetry  see `Sequence`
    """
    rate = f"video/x-raw,framerate={fps.numerator}/{fps.denominator}"
    upright = "videoconvert ! videoflip video-direction=auto"
    parts = [launch(to_limited_range(colorimetry)), upright, f"video/x-raw,format=I420,{COLORIMETRY}"]
    raw = " ! ".join(filter(None, parts))
    if isinstance(footage, BagTopic):
        begin = f"appsrc name={BAG} format=time max-buffers=2"
    else:
        quoted = str(footage).replace("\\", "\\\\").replace('"', '\\"')
        begin = f'filesrc location="{quoted}"'
    return f"{begin} ! decodebin force-sw-decoders=true ! {raw} ! videorate skip-to-first=true ! {rate}"


def survey(footage: Footage, cache: Cache, on_note: Callable[[str], None]) -> Sequence:
    """Analyse a clip, or the pictures of a bag.

    on_note  called with a line when the analysis starts, since it takes a while
    raises   UserError if it cannot be used
    """
    whole: Footage
    if isinstance(footage, BagTopic):
        path, properties = Path(footage.path), _bag_form(footage)
        whole = replace(footage, path=str(path.resolve()))
    else:
        path, properties, whole = footage, _clip_form(footage), footage.resolve()
    sha256 = file_digest(path)
    key = digest("survey", SURVEY_VERSION, *_identity(sha256, properties))
    known = cache.load(key)
    if known is None:
        on_note(f"analysing {path} {properties.get('topic', '')}".rstrip())
        known = _analyse(
            whole, decoding(whole, properties["fps"], properties.get("colorimetry", "")), properties["fps"]
        )
        cache.store(key, known)
    sequence = Sequence(path=str(path.resolve()), sha256=sha256, **properties, **known)
    if sequence.frames < FEWEST_FRAMES:
        found = f"{path}: {sequence.frames} frames"
        raise ArgumentError(ARGUMENT, found, f"is too short, at least {FEWEST_FRAMES} are needed")
    return sequence


def _identity(sha256: str, form: Mapping[str, Any]) -> tuple[object, ...]:
    return tuple(filter(None, [sha256, form.get("topic"), form.get("depth_m")]))


def _clip_form(path: Path) -> dict[str, Any]:
    from runner.apply import discover

    if path.suffix == VIDEO and _is_cropped(path):
        rule = "shows only what a driver saw at times: whole pictures are needed, as `tod-runner record` keeps them"
        raise ArgumentError(ARGUMENT, path, rule)
    form = discover(path, ARGUMENT)
    return asdict(form) | {"lossless": form.lossless or _is_recording(path)}


def _is_cropped(path: Path) -> bool:
    """Whether a picture in a drive's video says that it shows a part of the image only."""
    from runner.apply import read_video

    with suppress(RunError):  # a file that cannot be read is reported by who decodes it
        return any(unit.codec == "h264" and stated_region(unit.data) is not None for unit in read_video(path))
    return False


def _bag_form(footage: BagTopic) -> dict[str, Any]:
    from runner.bag import Bag

    try:
        with Bag(Path(footage.path)) as bag:
            form = bag.form(footage.topic)
    except ModelError as error:
        raise ArgumentError(ARGUMENT, str(error.found), error.rule) from None
    size = {"width": form.width, "height": form.height, "fps": form.fps}
    shown = {"topic": footage.topic, "depth_m": None if footage.depth_m == DEPTH_M else footage.depth_m}
    return {**size, "codec": form.format, "lossless": form.format not in LOSSY, **shown}


def _is_recording(path: Path) -> bool:
    """Whether `tod-runner record` or a drive made the clip, which is lossless with any codec."""
    if f"{WHOLE}." in path.name:
        return True
    try:
        cameras = json.loads(path.with_name(INDEX).read_text(encoding="utf-8"))["cameras"]
        return path.name in {camera.get("file") for camera in cameras.values()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return False


def _analyse(footage: Footage, decode: str, fps: Fraction) -> dict[str, Any]:
    from runner.apply import run_lanes
    from runner.rate_quality.siti import SiTi

    found = SiTi()
    line = f"{decode} ! identity name={FRAMES} ! fakesink sync=false"
    bag = footage if isinstance(footage, BagTopic) else None
    try:
        run_lanes(LaneSet(line, fps, (), bag), lambda _, luma: found.add(luma), lambda *_: None, lambda _: None)
    except RunError as error:
        raise ArgumentError("sequence", _named(footage), f"cannot be decoded to its end: {error}") from None
    means = {"si_mean": found.si_mean, "ti_mean": found.ti_mean}
    return {"frames": len(found.si), "si": found.si_max, "ti": found.ti_max, **means}


def _named(footage: Footage) -> str:
    return f"{footage.path}: {footage.topic}" if isinstance(footage, BagTopic) else repr(str(footage))


def as_recorded(camera: Camera, sequence: Sequence) -> tuple[Camera, str]:
    """A camera at the size and rate of a sequence, and a note on what that means for its bitrates, or ""."""
    size = (sequence.width, sequence.height)
    if size == camera.source_size:
        recorded = replace(camera, fps=sequence.fps)
    else:
        recorded = replace(camera, width=size[0], height=size[1], native=None, crop=None, fps=sequence.fps)
    form, own = (f"{c.width}x{c.height} at {float(c.fps):g} Hz" for c in (recorded, camera))
    if form == own:
        return recorded, ""
    return recorded, f"the sequence is {form}, the camera {own}: the bitrates are those of the sequence"
