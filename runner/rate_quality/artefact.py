"""The output of a measurement: the model file, the camera YAML that links to it, and how to read them back."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from fractions import Fraction
from importlib.metadata import version
from pathlib import Path
from statistics import fmean
from typing import Annotated, Any, Literal, NotRequired, TypedDict, cast

from runner.core.limits import Limits, NonNegative
from runner.core.model import Camera, plain
from runner.errors import UserError, reason
from runner.rate_quality.cache import digest
from runner.rate_quality.choice import Choice, ShownChoice
from runner.rate_quality.curves import Crossing, Ladder, Point
from runner.rate_quality.metrics import NAMES
from runner.rate_quality.rates import RatePoint, Rates
from runner.rate_quality.sequence import Sequence as Clip

FORMAT_VERSION: Literal[1] = 1
SCHEMA = "rate_quality"
MARK = "Measured by `tod-runner model`"  # in each camera YAML written by this module


@dataclass(frozen=True, slots=True)
class Measured:
    """Everything known about one model.

    name      of the model and its files
    camera    as it is mounted, or the first one of a pool
    clips     by camera, the clip measured on
    masks     by camera, digest of its mask
    encoder   the encoder's fragment of the live graph as text, and versions of the software that ran it
    metrics   by name, identity
    labels    by name, label of an axis
    plan      full or adaptive
    stride    every stride-th frame was scored
    notes     about the sequences
    rates     quality with fewer pictures a second; empty: not measured
    """

    name: str
    camera: Camera
    clips: Mapping[str, Clip]
    masks: Mapping[str, str]
    encoder: Mapping[str, Any]
    metrics: Mapping[str, str]
    labels: Mapping[str, str]
    metric: str
    sign: int
    good: float
    plan: str
    stride: int
    points: Sequence[Point]
    choice: Choice
    notes: Sequence[str]
    rates: Rates = field(default_factory=dict)

    @property
    def warnings(self) -> list[str]:
        return [*self.notes, *self.choice.warnings]


Factor = Annotated[float, Limits(above=0, most=1), "of the resolution"]


class ClipDocument(TypedDict):
    """A clip.

    file       its name
    topic      of the pictures, if the file is a bag
    depth_m    distance that is white in its pictures of distances, m, if it is not 20
    colorimetry  as GStreamer names it, to which a full-range clip was converted
    sha256     of the file
    width, height  of its pictures, px
    fps        frames a second
    codec      of the clip
    lossless   whether that codec is; otherwise the clip was already compressed
    frames     their number
    si, ti     spatial and temporal information, largest of all frames (ITU-T P.910)
    si_mean, ti_mean  the same, mean over the frames
    """

    file: str
    topic: NotRequired[str]
    depth_m: NotRequired[float]
    colorimetry: NotRequired[str]
    sha256: str
    width: float
    height: float
    fps: float
    codec: str
    lossless: bool
    frames: int
    si: float
    ti: float
    si_mean: float
    ti_mean: float


class EncoderDocument(TypedDict):
    """What encoded and decoded.

    graph     the live graph from crop to decoder, at the first factor and bitrate
    versions  by element, of its plugin
    """

    graph: str
    versions: Mapping[str, str]


class PointDocument(TypedDict):
    """One encoding; each metric adds its mean over the scored frames under its own name.

    target_kbps  bitrate that the encoder was given, kbit/s
    actual_kbps  actual bitrate, kbit/s
    second_kbps  the same in the second in which it was highest; older models lack it
    encode_ms    processor time of the encoder for each frame, ms
    psnr         of luma, dB
    mssim        of luma (Wang 2004)
    vmaf         higher is better
    brisque      lower is better
    shown        the deciding metric of the picture as a screen shows it, by the factor of the image's size
    """

    scaling: Factor
    target_kbps: Annotated[int, Limits(1)]
    actual_kbps: NonNegative
    second_kbps: NotRequired[NonNegative]
    encode_ms: NonNegative
    psnr: NotRequired[float]
    mssim: NotRequired[float]
    vmaf: NotRequired[float]
    brisque: NotRequired[float]
    shown: NotRequired[Mapping[str, float]]


class CrossingDocument(TypedDict):
    """A crossing.

    lower, upper  smaller and larger factor
    kbps          its bitrate, kbit/s
    low, high     5th and 95th percentile over resampled time blocks of the sequence, kbit/s
    """

    lower: Factor
    upper: Factor
    kbps: float
    low: float
    high: float


class LadderDocument(TypedDict):
    """A choice.

    b_min_kbps   lower bounds, kbit/s
    regret_max   most quality lost against the best of all factors
    regret_mean  the same on average over log bitrate
    """

    scaling: Annotated[list[Factor], "factors"]
    b_min_kbps: list[float]
    regret_max: float
    regret_mean: float


class DroppedDocument(TypedDict):
    """A factor that is not worth using.

    reason  why
    """

    scaling: Factor
    reason: str


class RateDocument(TypedDict):
    """Fewer pictures a second at the same bitrates.

    fps        pictures a second
    kbps       bitrates, kbit/s, at which all rates are compared
    delivered  by bitrate, quality of the pictures that were sent, each compared with itself
    held       likewise, at each picture of the source, of the last one that was sent, without latency
    """

    fps: float
    kbps: list[int]
    delivered: list[float]
    held: list[float]


class CoresDocument(TypedDict):
    """Processor time of a factor.

    cores  share of a core, the most of all bitrates
    """

    scaling: Factor
    cores: float


class Document(TypedDict):
    """What `tod-runner model` has measured for a camera: every point, the factors that were chosen, and why.

    version      of the format
    tod_runner   version of tod-runner that measured
    name         of the model
    content      digest of sequences, masks and encoder: models with equal digests were measured on the same ones
    sequences    by camera, the clip that was measured on
    masks        by camera, SHA-256 of the mask that excludes part of its picture
    metric       that chose
    metrics      by name, how exactly it is computed
    plan         which encodings were made
    metric_every  one frame in this many was scored
    points       every encoding, by factor and target
    scaling      factors that are worth using, in ascending order
    b_min_kbps   bitrates from which each is used, kbit/s
    b_full_kbps  bitrate at which the quality is b_full_quality, or the largest measured, kbit/s
    b_full_quality  that b_full was chosen for, in units of the metric
    crossings    where the larger of two factors begins to look better
    regret       the best choice for each number of factors
    dropped      factors that are not worth using
    cores        what the encoder needs at the sequence's frame rate
    rates        quality with fewer pictures a second, if it was measured
    warnings     notes on using the model
    """

    version: Literal[1]
    tod_runner: str
    name: str
    content: str
    sequences: Annotated[Mapping[str, ClipDocument], Limits(1)]
    masks: Mapping[str, str]
    encoder: EncoderDocument
    metric: Annotated[str, Limits(among=NAMES)]
    metrics: Annotated[Mapping[str, str], Limits(1)]
    plan: Annotated[str, Limits(among=("adaptive", "full"))]
    metric_every: Annotated[int, Limits(1)]
    points: list[PointDocument]
    scaling: list[Factor]
    b_min_kbps: list[Annotated[int, Limits(0)]]
    b_full_kbps: Annotated[int, Limits(1)]
    b_full_quality: float
    crossings: list[CrossingDocument]
    regret: list[LadderDocument]
    dropped: list[DroppedDocument]
    cores: list[CoresDocument]
    rates: NotRequired[list[RateDocument]]
    warnings: list[str]


def to_json(measured: Measured) -> Document:
    """The model file; schemas/rate_quality.schema.json is made from these classes."""
    choice = measured.choice
    sequences = {name: _clip_to_json(clip) for name, clip in measured.clips.items()}
    document: Document = {
        "version": FORMAT_VERSION,
        "tod_runner": version("tod-runner"),
        "name": measured.name,
        "content": digest(
            ["".join(map(str, clip.identity)) for clip in measured.clips.values()], measured.encoder, measured.masks
        ),
        "sequences": sequences,
        "masks": dict(measured.masks),
        "encoder": cast(EncoderDocument, dict(measured.encoder)),
        "metric": measured.metric,
        "metrics": dict(measured.metrics),
        "plan": measured.plan,
        "metric_every": measured.stride,
        "points": [_point_to_json(p) for p in sorted(measured.points, key=lambda p: (p.scaling, p.target_kbps))],
        "scaling": [plain(factor) for factor in choice.scaling],
        "b_min_kbps": list(choice.b_min),
        "b_full_kbps": choice.b_full,
        "b_full_quality": measured.good,
        "crossings": [_crossing_to_json(crossing) for crossing in choice.crossings],
        "regret": [_ladder_to_json(ladder) for ladder in choice.table],
        "dropped": [{"scaling": plain(factor), "reason": reason} for factor, reason in choice.dropped.items()],
        "cores": [{"scaling": plain(factor), "cores": round(share, 4)} for factor, share in choice.cores.items()],
        "warnings": measured.warnings,
    }
    if measured.rates:
        document["rates"] = [_rate_to_json(fps, points) for fps, points in measured.rates.items()]
    return document


def to_yaml(measured: Measured) -> str:
    """A camera's file for conf/cameras/."""
    camera, choice = measured.camera, measured.choice
    lines = [
        "# yaml-language-server: $schema=../../schemas/camera.schema.json",
        f"# {MARK} on {', '.join(Path(clip.path).name for clip in measured.clips.values())},"
        f" plan {measured.plan}, by {measured.metric}.",
        *(f"# {warning}" for warning in measured.warnings),
        f"width_px: {camera.width}",
        f"height_px: {camera.height}",
        f"fps: {plain(camera.fps)}",
        f"lens: {camera.lens}",
        f"fov_deg: {camera.fov_deg:g}",
    ]
    if camera.native:
        width, height = camera.native
        left, top = camera.in_source.x, camera.in_source.y
        lines.append(f"native: {{width_px: {width}, height_px: {height}, left_px: {left}, top_px: {top}}}")
    lines += [
        "rate_quality:",
        f"  scaling:    {[plain(factor) for factor in choice.scaling]}",
        f"  b_min_kbps: {list(choice.b_min)}",
        f"  b_full_kbps: {choice.b_full}",
        *([f"  quality: {[list(point) for point in choice.quality]}"] if choice.quality else []),
        *(["  shown:   # the same for screens that show fewer pixels"] if choice.shown else []),
        *(line for scale, its in choice.shown.items() for line in _shown_to_yaml(scale, its)),
        *(["  rates:   # fewer pictures a second at the same bitrates"] if measured.rates else []),
        *(line for fps, points in measured.rates.items() for line in _rate_to_yaml(fps, points)),
        f"  model: {measured.name}.model.json   # the curves, beside this file",
    ]
    return "\n".join(lines) + "\n"


def _shown_to_yaml(scale: Fraction, its: ShownChoice) -> list[str]:
    return [
        f"    - scale: {plain(scale)}",
        f"      scaling: {[plain(each) for each in its.scaling]}",
        f"      b_min_kbps: {list(its.b_min)}",
        *([f"      quality: {[list(point) for point in its.quality]}"] if its.quality else []),
    ]


def _rate_to_yaml(fps: Fraction, points: Sequence[RatePoint]) -> list[str]:
    return [
        f"    - fps: {plain(fps)}",
        f"      delivered: {[[point.kbps, round(point.delivered, 4)] for point in points]}   # a picture that is sent",
        f"      held: {[[point.kbps, round(point.held, 4)] for point in points]}   # what is shown until the next one",
    ]


def read_model(path: Path) -> dict[str, Any]:
    """A model file.

    raises  UserError with its first problem
    """
    from runner import schema

    def wrong(rule: str, where: str = "", found: str | None = None) -> UserError:
        return UserError(str(path), where, found, rule)

    try:
        document = schema.read_json(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise wrong(reason(error)) from None
    except ValueError as error:
        raise wrong(f"is not a model file: {error}") from None
    if isinstance(document, dict) and document.get("version", FORMAT_VERSION) != FORMAT_VERSION:
        raise wrong(f"is of version {document['version']}, this tod-runner reads {FORMAT_VERSION}")
    found = schema.findings(document, SCHEMA)
    if found:
        raise wrong(found[0].rule, schema.dotted(found[0].path), found[0].found)
    return dict(document)


def dumps(document: Mapping[str, Any]) -> bytes:
    """JSON for human readers: one point per line."""
    parts = []
    for key, value in document.items():
        rows = isinstance(value, list) and value and isinstance(value[0], dict)
        text = "[\n" + ",\n".join(f"    {json.dumps(row)}" for row in value) + "\n  ]" if rows else json.dumps(value)
        parts.append(f"  {json.dumps(key)}: {text}")
    return ("{\n" + ",\n".join(parts) + "\n}\n").encode()


def _clip_to_json(clip: Clip) -> ClipDocument:
    properties = {key: value for key, value in asdict(clip).items() if key != "path" and value not in ("", None)}
    rounded = {key: round(value, 3) for key, value in properties.items() if key.startswith(("si", "ti"))}
    found = {"file": Path(clip.path).name, **properties, "fps": plain(Fraction(clip.fps)), **rounded}
    return cast(ClipDocument, found)


def _point_to_json(point: Point) -> PointDocument:
    means = {name: round(fmean(values), 6) for name, values in point.scores.items()}
    shown = {name.partition("@")[2]: mean for name, mean in means.items() if "@" in name}
    scores = {name: mean for name, mean in means.items() if "@" not in name} | ({"shown": shown} if shown else {})
    return {
        "scaling": plain(point.scaling),
        "target_kbps": point.target_kbps,
        "actual_kbps": round(point.actual_kbps, 2),
        "second_kbps": round(point.second_kbps, 2),
        "encode_ms": round(point.encode_ms, 4),
        **cast(PointDocument, scores),
    }


def _rate_to_json(fps: Fraction, points: Sequence[RatePoint]) -> RateDocument:
    return {
        "fps": plain(fps),
        "kbps": [point.kbps for point in points],
        "delivered": [round(point.delivered, 6) for point in points],
        "held": [round(point.held, 6) for point in points],
    }


def _crossing_to_json(crossing: Crossing) -> CrossingDocument:
    kbps, low, high = (round(of, 1) for of in (crossing.kbps, crossing.low, crossing.high))
    return {"lower": plain(crossing.lower), "upper": plain(crossing.upper), "kbps": kbps, "low": low, "high": high}


def _ladder_to_json(ladder: Ladder) -> LadderDocument:
    return {
        "scaling": [plain(factor) for factor in ladder.scaling],
        "b_min_kbps": [0, *(round(bound, 1) for bound in ladder.bounds)],
        "regret_max": ladder.regret_max,
        "regret_mean": ladder.regret_mean,
    }
