"""Statistics as rows of text, the same in the terminal and on the page. Pure."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from runner.drive.latency import Latency
from runner.drive.seen_file import SeenCamera, SeenDrive
from runner.drive.statistics import CameraStatistics, DriveStatistics
from runner.drive.uplink_statistics import UplinkStatistics

TableRow = tuple[str, ...]
VERDICTS: Mapping[bool | None, str] = {True: "yes", False: "no", None: "-"}
NOTHING = "-"
LEGEND = (
    "Arrival and decode: latency since capture; ±: error bound of the comparison of both clocks."
    " Share: kbit/s over allocated. Freezes as W3C webrtc-stats counts them: gaps of 3 times the mean of the last 30,"
    " or of the mean and 150 ms, whichever is longer. Damaged: frames whose picture shows that packets were lost."
    " Quality is estimated from the bitrate: a frozen picture keeps its last estimate, so read it together with the"
    " share of time frozen. Delivered: MSSIM of the displayed picture, twice a second, against the scene at that time;"
    " for sources that play no clip, against the stream as sent."
)
UPLINKS = (
    "Share: of the packets that arrived, copies included. Lost alone: what this uplink without the others would have"
    " lost. Copies: packets that had already arrived by another. Received is counted with packet headers."
)
SEEN = (
    "The picture on the screen against the scene at its capture, twice a second, at px of the screen, black where"
    " nothing was sent; the screen: cameras by area. Age: since capture. Frozen: none came although one was due. Late:"
    " too old when it came. Optimum: MSSIM of the best static allocation of the same bits, by the cameras' own models."
)
METRICS = {"mssim": ("MSSIM", 3), "vmaf": ("VMAF", 0)}  # label, digits
SIZES = 3  # number of picture sizes listed, those received longest


def camera_rows(drive: DriveStatistics) -> tuple[TableRow, list[TableRow]]:
    """Headings, and a row for each camera."""
    kind = f"{drive.metric.upper() if drive.metric else 'quality'}\nestimated"
    headings: TableRow = ("camera", "frames", "Hz", "kbit/s", "allocated", "share", "factor: time", "sizes px")
    bound = next((_bound(camera.arrival) for camera in drive.cameras.values()), "")  # of all: they share two clocks
    headings += (f"arrival, ms{bound}\n50 / 95 / 99 %", "decode, ms\n50 / 95 / 99 %")
    headings += ("freezes", "frozen s", "longest s", "lost\ndamaged", "rebuilt", f"{kind}\ndelivered")
    headings += ("time\nfrozen",)
    return headings, [_camera(camera) for camera in drive.cameras.values()]


def drive_rows(drives: Sequence[DriveStatistics]) -> tuple[TableRow, list[TableRow]]:
    """Headings, and a row for each drive."""
    headings = (
        "drive",
        "s",
        "allocated kbit/s",
        "MSSIM delivered, worst camera",
        "quality estimated",
        "time frozen",
        "latency ms (median, p95, p99)",
        "freezes",
        "frozen s",
        "lost packets",
        "damaged",
    )
    return (*headings, "of allocated", "mean kbit/s"), [_drive(drive) for drive in drives]


def uplink_rows(drive: DriveStatistics) -> tuple[TableRow, list[TableRow]]:
    """Headings, and a row for each uplink."""
    headings: TableRow = ("uplink", "allowed kbit/s", "received kbit/s", "share", "lost alone", "copies")
    headings += ("queue ms, p95", "stalls", "stalled s", "longest s", "cameras\ncame", "cameras\nleft")
    return headings, [_uplink(name, each) for name, each in drive.uplinks.items()]


def seen_rows(seen: SeenDrive) -> tuple[TableRow, list[TableRow]]:
    """Headings, a row for each camera, and one for the whole screen."""
    headings: TableRow = ("camera", *(f"{METRICS[name][0]}\nmean / 5 % / worst" for name in seen.metrics))
    headings += ("age ms\nmean / 95 %", "frozen", "late", "optimum")
    best = seen.optimum
    rows = [
        (name, *_seen(camera, seen.metrics), *_age(camera), shown(best.cameras.get(name) if best else None, 3))
        for name, camera in seen.cameras.items()
    ]
    screen: TableRow = ("screen", *_seen(seen, seen.metrics), *[""] * 3, shown(best.mssim if best else None, 3))
    return headings, [*rows, screen]


def _seen(of: SeenCamera | SeenDrive, metrics: Mapping[str, str]) -> TableRow:
    found = ((of.summary(name), METRICS[name][1]) for name in metrics)
    return tuple(
        " / ".join(shown(each, digits) for each in (its.mean, its.p5, its.worst)) if its else NOTHING
        for its, digits in found
    )


def _age(camera: SeenCamera) -> TableRow:
    age = camera.age
    if age is None:
        return (NOTHING,) * 3
    return f"{age.mean_ms:.0f} / {age.p95_ms:.0f}", f"{age.frozen:.1%}", f"{age.late:.1%}"


def _uplink(name: str, uplink: UplinkStatistics) -> TableRow:
    return (
        name,
        shown(uplink.allowed),
        shown(uplink.received),
        percent(uplink.share),
        NOTHING if math.isnan(uplink.lost) else f"{uplink.lost:.1%}",
        percent(uplink.twins),
        shown(uplink.queue_p95_ms),
        str(uplink.stalls),
        shown(uplink.stalled_s, 1),
        shown(uplink.longest_s, 1),
        str(uplink.came),
        str(uplink.left),
    )


def _camera(camera: CameraStatistics) -> TableRow:
    frozen = [freeze.seconds for freeze in camera.freezes or ()]
    known = camera.freezes is not None
    longest = sorted(camera.sizes, key=lambda size: -camera.sizes[size])[:SIZES]
    return (
        camera.name,
        str(camera.frames),
        shown(camera.hz, 1),
        shown(camera.kbps),
        shown(camera.allocated),
        percent(camera.share),
        "\n".join(f"{f:g}: {share:.0%}" if f else f"off: {share:.0%}" for f, share in camera.factors.items()),
        "\n".join(f"{width}x{height}" for width, height in sorted(longest)) or NOTHING,  # increasing, like the factors
        _latency(camera.arrival),
        _latency(camera.decode),
        counted(len(frozen) if known else None),
        shown(sum(frozen), 2) if known else NOTHING,
        shown(max(frozen), 2) if frozen else NOTHING,
        f"{counted(camera.lost)}\n{percent(camera.damaged)}",
        counted(camera.rebuilt),
        "\n".join(shown(quality.mean if quality else None, 3) for quality in (camera.quality, camera.delivered)),
        percent(camera.frozen),
    )


def _drive(drive: DriveStatistics) -> TableRow:
    arrived = drive.decode if math.isnan(drive.arrival.median) else drive.arrival
    return (
        drive.series.label,
        shown(drive.series.end, 1),
        shown(drive.allocated),
        NOTHING if math.isnan(drive.delivered) else f"{drive.delivered:.3f}, {drive.delivered_worst:.3f}",
        f"{shown(drive.quality, 3)} {drive.metric.upper()}{_basis(drive)}" if drive.metric else NOTHING,
        percent(drive.frozen),
        _latency(arrived) + _bound(arrived),
        counted(drive.freezes),
        shown(drive.frozen_s, 2),
        counted(drive.lost),
        percent(drive.damaged),
        percent(drive.share),
        shown(drive.kbps),
    )


def _basis(drive: DriveStatistics) -> str:
    return "" if drive.series.measured else ", as allocated"


def _latency(latency: Latency) -> str:
    if math.isnan(latency.median):
        return NOTHING
    return " / ".join(shown(value) for value in (latency.median, latency.p95, latency.p99))


def _bound(latency: Latency) -> str:
    return "" if math.isnan(latency.bound) else f" ± {shown(latency.bound, 0 if latency.bound >= 10 else 1)}"


def shown(value: float | None, digits: int = 0) -> str:
    """A number; "-" if unknown."""
    return NOTHING if value is None or math.isnan(value) else f"{value:.{digits}f}"


def percent(value: float) -> str:
    return NOTHING if math.isnan(value) else f"{value:.0%}"


def counted(value: int | None) -> str:
    return NOTHING if value is None else str(value)
