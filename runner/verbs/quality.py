"""usage: tod-runner quality DRIVE [DRIVE ...] [view=LOG [kernel=cubic]]

Measures the quality of what the operator saw: twice a second, the displayed picture is compared with the scene that the
camera saw at that time (MSSIM of luma at the camera's full size). Freezes, delay and damage lower the score. Needs
drives with log.video=true on both sides. With a source that plays a clip (synthetic, file) the scene is the picture of
the clip; otherwise it is the stream as sent, and losses in the encoder are not included. Pictures that were cropped to
what the driver saw are left out.

Writes the score at each of these times to DRIVE/quality.json, which `report` shows.

With view= it measures what was on the screen: of each camera the part that windows showed, at px of the screen, with
black where nothing was sent. A picture is compared with the scene at its capture (MSSIM, and VMAF if an ffmpeg has it);
cameras are weighted by their area on the screen. The age of pictures, and the time in which they were frozen or late,
are figures of their own. LOG states what windows showed, in events view_reported: the drive itself, or the log of
another one, whose time also counts from its beginning. Writes DRIVE/seen.json, which `report` shows. kernel= is how the
page enlarges pictures: linear, or cubic as it does with a GPU.

  tod-runner demo log=monday log.video=true duration_s=60
  tod-runner quality monday
  tod-runner quality monday view=monday
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, TypeVar, cast

from runner.errors import RunError, UserError
from runner.system import signals
from runner.verbs import Arguments
from runner.verbs.screen import progress_bar, streaming

if TYPE_CHECKING:
    from runner.core.model import Camera
    from runner.drive.quality_file import DeliveredQuality
    from runner.drive.read import Drive
    from runner.drive.seen_file import Optimum, SeenCamera, SeenDrive
    from runner.drive.videos import Videos
    from runner.drive.views import Views
    from runner.graph import Plan
    from runner.rate_quality.metrics import Metric
    from runner.rate_quality.screen import Kernel
    from runner.settings import Setup

SIDES = ("vehicle", "operator")
SEEN = "view={} scores what was seen"
UNKNOWN = "–"
T = TypeVar("T")


def run(arguments: Arguments) -> int:
    view = arguments.path("view")
    for word in arguments.words:
        if view:
            _measure_seen(Path(word), view, cast("Kernel", arguments.choice("kernel")))
        else:
            _measure_drive(Path(word))
    return 0


class _Recorded(NamedTuple):
    """A drive, its configuration, the clips that its sources played, and its video."""

    drive: Drive
    setup: Setup
    clips: Mapping[str, Path]
    videos: Videos

    @property
    def cameras(self) -> Mapping[str, Camera]:
        return self.setup.vehicle.cameras


def _measure_drive(path: Path) -> None:
    from runner.drive.delivered import cropped_by_view, measure
    from runner.drive.quality_file import DOCUMENT, to_json
    from runner.rate_quality.artefact import dumps
    from runner.system.files import write_whole

    drive, setup, clips, videos = recorded = _recorded(path)
    found = _with_progress(path, lambda progress: measure(drive, videos, setup.vehicle.cameras, clips, progress, _warn))
    cropped = ", ".join(cropped_by_view(drive))
    if cropped and found and not any(quality.mssim for quality in found.values()):
        rule = f"only what the driver saw was sent of {cropped}, and whole pictures are needed: {SEEN.format(path)}"
        raise UserError(str(path), "", None, rule)
    _check(recorded, {name: (bool(each.mssim), each.clip) for name, each in found.items()})
    if cropped:
        _warn(f"{path}: pictures cropped to what the driver saw are left out ({cropped}): {SEEN.format(path)}")
    write_whole(path / DOCUMENT, dumps(to_json(found)))
    _show(path, found)


def _measure_seen(path: Path, view: Path, kernel: Kernel) -> None:
    from runner.drive.seen_file import DOCUMENT, SeenDrive, to_json
    from runner.drive.seen_quality import Looks, measure_seen
    from runner.drive.views import read_views
    from runner.rate_quality.artefact import dumps
    from runner.system.files import write_whole

    warnings: list[str] = []
    views = read_views(view, warnings)
    drive, setup, clips, videos = recorded = _recorded(path)
    for warning in warnings if views.path.parent.resolve() != path.resolve() else ():
        _warn(warning)
    views.check(recorded.cameras)
    looks = Looks(views, _metrics(), setup.page.late_ms, kernel)
    found = _with_progress(
        path, lambda progress: measure_seen(drive, videos, recorded.cameras, clips, looks, progress, _warn)
    )
    _check(recorded, {name: (any(map(_is_known, each.scores.values())), each.scene) for name, each in found.items()})
    identities = {metric.name: metric.identity for metric in looks.metrics}
    seen = SeenDrive(str(view), identities, found, _optimum(recorded, views, found), kernel=kernel)
    write_whole(path / DOCUMENT, dumps(to_json(seen)))
    _show_seen(path, seen)


def _is_known(scores: tuple[float | None, ...]) -> bool:
    return any(score is not None for score in scores)


def _with_progress(path: Path, measured: Callable[[Callable[[float], None]], T]) -> T:
    with progress_bar() as progress:

        def on_progress(share: float) -> None:
            signals.check()
            progress(str(path), share)

        return measured(on_progress)


def _check(recorded: _Recorded, found: Mapping[str, tuple[bool, bool]]) -> None:
    """Check that something was measured: by camera, whether there are scores, and whether its scene was known.

    raises  UserError
    """
    path = str(recorded.drive.path)
    if not found:
        raise UserError(path, "", None, "no camera's video was kept on both sides: drive with log.video=true")
    if not any(scored for scored, _ in found.values()):
        raise UserError(
            path, "", None, "nothing can be compared: no capture times were logged, or the videos lack their pictures"
        )
    if recorded.clips and len({scene for _, scene in found.values()}) > 1:
        _warn(f"{path}: the clips of some cameras are missing: these are compared with the stream as sent")


def _warn(what: str) -> None:
    print(what, file=sys.stderr)


def _recorded(path: Path) -> _Recorded:
    """The drive in a directory. Clips of full range are left out: they were converted before they were sent.

    raises  UserError if it cannot be read, or lacks a side
    """
    from runner.configuration.config import configuration
    from runner.drive.read import read_drive
    from runner.drive.videos import Videos
    from runner.plans import compile_plans

    drive = read_drive(path)
    for warning in drive.warnings:
        _warn(warning)
    missing = [side for side in SIDES if side not in drive.sides]
    if missing:
        raise UserError(str(drive.path), "", None, f"no log of the {' and the '.join(missing)}: both sides are needed")
    began = drive.sides["vehicle"].began
    setup = configuration([], base=(dict(began.config), f"{drive.path}: config"), runnable=False).setup()
    apply = streaming()
    clips = {
        plan.camera.name: Path(str(plan.source[0].properties["location"]))
        for plan in compile_plans(setup)
        if _fits(plan)
    }
    known = {
        name: clip for name, clip in clips.items() if clip.is_file() and not apply.discover(clip, "clip").colorimetry
    }
    return _Recorded(drive, setup, known, Videos(path, apply.read_video, apply.decode_video))


def _fits(plan: Plan) -> bool:
    """Whether a source plays a clip that it fits to the camera's size as `decode_video` does."""
    rendered, fitted = plan.camera.source.render, any(each.factory == "aspectratiocrop" for each in plan.source)
    return plan.loops and bool(rendered or (fitted and plan.source[0].factory == "filesrc"))


def _metrics() -> list[Metric]:
    """MSSIM, and VMAF if a tool has it."""
    from runner.rate_quality.metrics import find_metric

    try:
        return [find_metric("mssim"), find_metric("vmaf")]
    except RunError as error:
        _warn(f"VMAF is not measured: {error}")
        return [find_metric("mssim")]


def _optimum(recorded: _Recorded, views: Views, found: Mapping[str, SeenCamera]) -> Optimum | None:
    """In the view that was longest in force, for the total that was sent on the mean."""
    from runner.drive.optimum import static_optimum
    from runner.drive.series import series
    from runner.drive.statistics import statistics

    moments = sorted({t for camera in found.values() for t in camera.t})
    numbers = Counter(views.number_at(t) for t in moments)
    if not numbers:
        return None
    kbps = statistics(series(recorded.drive)).kbps
    return static_optimum(recorded.cameras, views.views[numbers.most_common(1)[0][0]], kbps)


# --- tables -----------------------------------------------------------------------------------------------------------


def _show(path: Path, found: Mapping[str, DeliveredQuality]) -> None:
    from statistics import fmean

    rows = []
    for name, quality in found.items():
        scores = quality.mssim
        figures = (f"{quality.mean:.4f}", f"{min(scores):.4f}") if scores else (UNKNOWN, UNKNOWN)
        against = "the scene" if quality.clip else "the stream as sent"
        rows.append((name, *figures, str(len(scores)), f"{100 * quality.stale:.1f} %", against))
    _print_table(path, ("camera", "MSSIM", "lowest", "moments", "older picture", "against"), rows)
    means = [quality.mean for quality in found.values() if quality.mean is not None]
    if means:
        print(f"mean {fmean(means):.4f}, worst camera {min(means):.4f}")


def _show_seen(path: Path, seen: SeenDrive) -> None:
    from runner.drive.tables import seen_rows

    _print_table(path, *seen_rows(seen))
    if unknown := [name for name, camera in seen.cameras.items() if not camera.scene]:
        lost = "what the encoder lost, and what was not sent, is not included"
        print(f"{', '.join(unknown)} compared with the stream as sent: {lost}")
    if seen.optimum:
        print(f"optimum: the best static allocation of {seen.optimum.kbps:.0f} kbit/s by the cameras' own models")


def _print_table(path: Path, headings: Sequence[str], rows: Sequence[tuple[str, ...]]) -> None:
    from rich import box
    from rich.console import Console
    from rich.table import Table

    from runner.verbs.report_table import WIDE

    table = Table(title=str(path), title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False)
    for heading in headings:
        table.add_column(heading, justify="left" if heading in ("camera", "against") else "right", no_wrap=True)
    for row in rows:
        table.add_row(*row)
    Console(width=None if sys.stdout.isatty() else WIDE).print(table)
