"""The statistics of drives as JSON; schemas/report.schema.json is made from the classes below. Pure."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from importlib.metadata import version
from typing import Annotated, Literal, NotRequired, TypedDict

import numpy as np

from runner.core.limits import Count, Limits, NonNegative, Share
from runner.drive.checks import ClaimCheck
from runner.drive.latency import Latency
from runner.drive.predictions import Worth
from runner.drive.seen_document import SeenDocument, seen_document
from runner.drive.series import LinkSeries, Series
from runner.drive.statistics import CameraStatistics, DriveStatistics
from runner.drive.uplink_statistics import UplinkDocument, UplinkStatistics

FORMAT_VERSION: Literal[1] = 1


class Latencies(TypedDict):
    """Percentiles of latencies, ms.

    bound  error bound of each for 95 % of the time; None in older logs, which did not measure it
    """

    median: Annotated[float, "the median"]
    p95: Annotated[float, "the 95th percentile"]
    p99: Annotated[float, "the 99th percentile"]
    bound: NonNegative | None


class Predictions(TypedDict):
    """What predictions were worth.

    bias, error  mean of ln(capacity / prediction) of the drive, and the standard deviation from it
    late_s       by how much changes were predicted too late, s; below 0: too early; None: it cannot be told
    """

    bias: float
    error: NonNegative
    late_s: float | None


class Link(TypedDict):
    """The limited link of an experiment, or a lane of it.

    min_kbps, max_kbps  its smallest and largest rate, kbit/s
    queue_p95_ms        95th percentile of a packet's wait, ms
    dropped             packets dropped
    """

    min_kbps: float
    max_kbps: float
    queue_p95_ms: float
    dropped: Count


class Quality(TypedDict):
    """Quality estimated by rate-quality models.

    mean          in units of the metric; a frozen picture keeps its estimate, whatever moved meanwhile: an upper bound,
                  to be read with frozen_share
    moving        mean over the time in which pictures moved
    frozen_share  of the time in which cameras should have been sent, but the picture stood still; None where arrivals
                  were not logged
    """

    metric: Annotated[str, "name of the metric"]
    mean: float | None
    moving: float | None
    frozen_share: Share | None


class CameraQuality(Quality):
    """Quality estimated by the camera's rate-quality model.

    mean, moving, frozen_share  as in `Quality`
    clamped  share of the time at bitrates outside the measured range of the model
    """

    clamped: float | None


Score = Annotated[float, Limits(most=1)]
Metric = Annotated[Literal["mssim"], "name of the metric"]


class Delivered(TypedDict):
    """Quality of the pictures that the operator saw, freezes included, as `tod-runner quality` measured it.

    mean, worst  over the cameras: the mean, and the worst camera's
    """

    metric: Metric
    mean: Score | None
    worst: Score | None


class CameraDelivered(TypedDict):
    """Measured quality of this camera's delivered pictures.

    mean         over the moments; None: none could be compared
    lowest       score of all moments
    moments      number of moments compared
    stale_share  of the moments, at which an older picture was shown instead of the one due
    against      what pictures were compared with: the scene, or the stream as sent, which hides encoder losses
    """

    metric: Metric
    mean: Score | None
    lowest: Score | None
    moments: Count
    stale_share: Share | None
    against: Literal["scene", "stream"]


class ModeInForce(TypedDict):
    """A mode that was in force.

    from_s  its start, s
    """

    from_s: float
    mode: Annotated[str, "name of the mode"]


class Claim(TypedDict):
    """A claim, compared with the drive.

    claim    what is claimed
    outcome  the result
    holds    None: the drive does not show it
    """

    claim: str
    outcome: str
    holds: bool | None


class FactorShare(TypedDict):
    """A factor in force.

    scaling  factor of the resolution; 0: off or paused
    share    of the time
    """

    scaling: Share
    share: Share


class SizeShare(TypedDict):
    """A size of the picture, px.

    share  of the time
    """

    width: Annotated[Count, "px"]
    height: Annotated[Count, "px"]
    share: Share


class FrozenPicture(TypedDict):
    """A freeze.

    t        its start, s since the beginning of the drive
    seconds  its duration
    """

    t: float
    seconds: NonNegative


class Freezes(TypedDict):
    """Pictures that stood still (W3C webrtc-stats, freezeCount).

    count               how many
    total_s, longest_s  duration of all and of the longest, s
    each                of them
    """

    count: Count
    total_s: NonNegative
    longest_s: NonNegative
    each: list[FrozenPicture]


class CameraDocument(TypedDict):
    """One camera of a drive.

    frames        received, or sent where no operator logged
    hz            frames a second while it should have been sent
    sending_s     time during which it should have been sent, s
    kbps, allocated_kbps, share  mean bitrate and mean allocated one, kbit/s; the first over the second
    factors       share of the time by factor, in ascending order
    sizes         share of the time by size of the picture
    latency_arrival_ms  from capture to arrival; None where arrivals were not logged
    latency_decode_ms   from capture to decode, of sampled frames; None where no operator logged
    freezes             None where arrivals were not logged
    lost, rebuilt       packets lost, receivers rebuilt; None where no operator logged
    damaged_share       of the frames, with visible damage from lost packets; None in older logs
    quality       None without a model
    delivered     None where it was not measured
    """

    name: Annotated[str, "name of the camera"]
    frames: Count
    hz: float | None
    sending_s: NonNegative
    kbps: float | None
    allocated_kbps: float | None
    share: float | None
    factors: list[FactorShare]
    sizes: list[SizeShare]
    latency_arrival_ms: Latencies | None
    latency_decode_ms: Latencies | None
    freezes: Freezes | None
    lost: int | None
    damaged_share: Share | None
    rebuilt: int | None
    quality: CameraQuality | None
    delivered: CameraDelivered | None


class DriveDocument(TypedDict):
    """One drive.

    label         name in the report
    path          directory that it was read from
    replayed      words of the replay that decided it, such as modes=steady; None: it was driven
    vehicle       that was driven
    began         start time, ISO 8601, UTC
    duration_s    length, s
    ended         by side, whether its log ended cleanly
    versions      by side, of what ran
    modes         that were in force
    rules         by mode, their names
    measured      what bitrates measure: what the operator received, or the vehicle sent; None: neither was logged
    kbps, allocated_kbps, share  mean total and mean allocated total, kbit/s; the first over the second
    predicted_min_kbps, predicted_max_kbps  the smallest and largest prediction, kbit/s
    predictions   None: nothing was predicted, or believed of the link, for long enough
    latency_arrival_ms, latency_decode_ms  from capture to arrival and to decode, all cameras
    freezes, frozen_s   number and duration of the freezes of all cameras, s
    lost, rebuilt       packets lost, receivers rebuilt
    damaged_share       of the frames, with visible damage from lost packets; None in older logs
    refused       requests
    link          None where it was not limited, or has lanes
    lanes         of the limited link, by name; absent where it has none
    uplinks       of the vehicle, by name; absent where it has one
    quality       mean of the cameras; None where there is no model, or models are of different metrics
    delivered     None where it was not measured
    seen          absent where it was not measured
    warnings      notes on the logs
    notes         on the figures
    checks        claims compared with the drive
    cameras       each of them
    """

    label: str
    path: str
    replayed: list[str] | None
    vehicle: str
    began: str
    duration_s: NonNegative
    ended: Mapping[str, bool]
    versions: Mapping[str, Mapping[str, str]]
    modes: list[ModeInForce]
    rules: Mapping[str, list[str]]
    measured: Annotated[str, Limits(among=("received", "sent"))] | None
    kbps: float | None
    allocated_kbps: float | None
    share: float | None
    predicted_min_kbps: float | None
    predicted_max_kbps: float | None
    predictions: Predictions | None
    latency_arrival_ms: Latencies | None
    latency_decode_ms: Latencies | None
    freezes: int | None
    frozen_s: float | None
    lost: int | None
    damaged_share: Share | None
    rebuilt: int | None
    refused: Count
    link: Link | None
    lanes: NotRequired[Mapping[str, Link]]
    uplinks: NotRequired[Mapping[str, UplinkDocument]]
    quality: Quality | None
    delivered: Delivered | None
    seen: NotRequired[SeenDocument]
    warnings: list[str]
    notes: list[str]
    checks: list[Claim]
    cameras: list[CameraDocument]


class Document(TypedDict):
    """Statistics of drives, written by `tod-runner report` as report.json.

    Bitrates are kbit/s, latencies ms, other times s; null: not known.

    version     of the format
    tod_runner  version of tod-runner that wrote it
    figures     their names, each a .png and a .pdf
    left_out    figures that the drives have no data for, and why
    drives      in the order given
    """

    version: Literal[1]
    tod_runner: str
    figures: list[str]
    left_out: list[str]
    drives: list[DriveDocument]


def to_json(
    drives: Sequence[DriveStatistics],
    checks: Mapping[str, Sequence[ClaimCheck]],
    figures: Sequence[str],
    left_out: Sequence[str],
) -> Document:
    """The document.

    checks  by label of a drive
    """
    return {
        "version": FORMAT_VERSION,
        "tod_runner": version("tod-runner"),
        "figures": list(figures),
        "left_out": list(left_out),
        "drives": [_drive(drive, checks.get(drive.series.label, ())) for drive in drives],
    }


def when(drive: Series) -> str:
    """When a drive began: ISO 8601, UTC."""
    return datetime.fromtimestamp(drive.began, UTC).isoformat(timespec="seconds").replace("+00:00", "Z")


def number(value: float | None, digits: int = 4) -> float | None:
    """Rounded; None if unknown."""
    return None if value is None or not math.isfinite(value) else rounded(value, digits)


def rounded(value: float, digits: int = 4) -> float:
    return round(float(value), digits)


def rules(drive: Series) -> dict[str, list[str]]:
    """By mode, the names of its rules."""
    return {mode: list(entries) for mode, entries in (drive.config.get("modes") or {}).items()}


def _drive(drive: DriveStatistics, checks: Sequence[ClaimCheck]) -> DriveDocument:
    series = drive.series
    lanes = {lane: _link(link) for lane, link in series.links.items()}
    document: DriveDocument = {
        "label": series.label,
        "path": series.path,
        "replayed": None if series.replayed is None else list(series.replayed),
        "vehicle": series.vehicle,
        "began": when(series),
        "duration_s": rounded(series.end, 3),
        "ended": dict(series.ended),
        "versions": {side: dict(each) for side, each in series.versions.items()},
        "modes": [{"from_s": rounded(t, 3), "mode": mode} for t, mode in series.modes],
        "rules": rules(series),
        "measured": series.measured or None,
        "kbps": number(drive.kbps, 1),
        "allocated_kbps": number(drive.allocated, 1),
        "share": number(drive.share),
        "predicted_min_kbps": number(drive.predicted_min, 1),
        "predicted_max_kbps": number(drive.predicted_max, 1),
        "predictions": None if drive.predictions is None else _predictions(drive.predictions),
        "latency_arrival_ms": _latency(drive.arrival),
        "latency_decode_ms": _latency(drive.decode),
        "freezes": drive.freezes,
        "frozen_s": number(drive.frozen_s, 3),
        "lost": drive.lost,
        "damaged_share": number(drive.damaged),
        "rebuilt": drive.rebuilt,
        "refused": series.refused,
        "link": lanes.pop("", None),
        "quality": {
            "metric": drive.metric,
            "mean": number(drive.quality, 5),
            "moving": number(drive.moving, 5),
            "frozen_share": number(drive.frozen),
        }
        if drive.metric
        else None,
        "delivered": None
        if math.isnan(drive.delivered)
        else {"metric": "mssim", "mean": number(drive.delivered, 5), "worst": number(drive.delivered_worst, 5)},
        "warnings": list(series.warnings),
        "notes": list(drive.notes),
        "checks": [{"claim": check.claim, "outcome": check.outcome, "holds": check.holds} for check in checks],
        "cameras": [_camera(camera) for camera in drive.cameras.values()],
    }
    if drive.seen:
        document["seen"] = seen_document(drive.seen)
    if lanes:
        document["lanes"] = lanes
    if drive.uplinks:
        document["uplinks"] = {name: _uplink(each) for name, each in drive.uplinks.items()}
    return document


def _uplink(uplink: UplinkStatistics) -> UplinkDocument:
    return {
        "allowed_kbps": number(uplink.allowed, 1),
        "received_kbps": number(uplink.received, 1),
        "share": number(uplink.share),
        "lost": number(uplink.lost),
        "twins": number(uplink.twins),
        "queue_p95_ms": number(uplink.queue_p95_ms, 2),
        "stalls": uplink.stalls,
        "stalled_s": rounded(uplink.stalled_s, 3),
        "longest_s": rounded(uplink.longest_s, 3),
        "came": uplink.came,
        "left": uplink.left,
    }


def _predictions(found: Worth) -> Predictions:
    return {"bias": rounded(found.bias, 3), "error": rounded(found.error, 3), "late_s": number(found.late_s, 3)}


def _latency(latency: Latency) -> Latencies | None:
    if math.isnan(latency.median):
        return None
    median, p95, p99 = (rounded(value, 2) for value in latency[:3])
    return {"median": median, "p95": p95, "p99": p99, "bound": number(latency.bound, 2)}


def _link(link: LinkSeries) -> Link:
    return {
        "min_kbps": rounded(np.min(link.kbps), 1),
        "max_kbps": rounded(np.max(link.kbps), 1),
        "queue_p95_ms": rounded(float(np.percentile(link.queue_ms, 95)), 2),
        "dropped": int(link.dropped[-1]),
    }


def _camera(camera: CameraStatistics) -> CameraDocument:
    freezes, quality, delivered = camera.freezes, camera.quality, camera.delivered
    return {
        "name": camera.name,
        "frames": camera.frames,
        "hz": number(camera.hz, 2),
        "sending_s": rounded(camera.sending_s, 3),
        "kbps": number(camera.kbps, 1),
        "allocated_kbps": number(camera.allocated, 1),
        "share": number(camera.share),
        "factors": [{"scaling": rounded(f), "share": rounded(share)} for f, share in camera.factors.items()],
        "sizes": [{"width": w, "height": h, "share": rounded(share)} for (w, h), share in camera.sizes.items()],
        "latency_arrival_ms": _latency(camera.arrival),
        "latency_decode_ms": _latency(camera.decode),
        "freezes": None
        if freezes is None
        else {
            "count": len(freezes),
            "total_s": rounded(sum(f.seconds for f in freezes), 3),
            "longest_s": rounded(max((f.seconds for f in freezes), default=0.0), 3),
            "each": [{"t": rounded(f.t, 3), "seconds": rounded(f.seconds, 3)} for f in freezes],
        },
        "lost": camera.lost,
        "damaged_share": number(camera.damaged),
        "rebuilt": camera.rebuilt,
        "quality": None
        if quality is None
        else {
            "metric": quality.metric,
            "mean": number(quality.mean, 5),
            "moving": number(quality.moving, 5),
            "frozen_share": number(camera.frozen),
            "clamped": number(quality.clamped),
        },
        "delivered": None
        if delivered is None
        else {
            "metric": "mssim",
            "mean": number(delivered.mean, 5),
            "lowest": number(min(delivered.mssim, default=None), 5),
            "moments": len(delivered.mssim),
            "stale_share": number(delivered.stale),
            "against": "scene" if delivered.clip else "stream",
        },
    }
