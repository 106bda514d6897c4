"""usage: tod-runner record [OVERRIDE ...] output=DIR [duration_s=N]

Records each camera losslessly: the frames as its source delivers them, at native size, before crop and scale, to
DIR/CAMERA.mkv, and a description to DIR/recording.json. Nothing is streamed. Ends after duration_s, or with Ctrl-C;
either way the files are complete. A file gets its name only when it is complete; until then, or if its camera fails, it
is .CAMERA.mkv.part. Nothing is overwritten. Frames that are missing because the encoder or the disk was too slow are
counted and reported. A bag is read as fast as the encoder accepts it: once, or repeatedly up to duration_s.
recording=NAME chooses the encoder, a file of conf/recording/.

Before the start the disk must have room for the raw frames (width x height x 1.5 bytes x fps) times of_raw of
conf/recording/, for duration_s, or 60 s if it is not given, plus a margin of 64 MB and two seconds of raw frames. A
recording that reaches the margin ends early, with status 1.

  tod-runner record vehicle=tum_q7 source=v4l2 output=recordings/monday duration_s=60
  tod-runner record vehicle=delivery_robot source=synthetic output=/tmp/rec duration_s=10
  tod-runner record source=v4l2 recording=ffv1 '~cameras.rear_center' output=rec    smaller files, one camera fewer
"""

from __future__ import annotations

import shutil
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from runner.configuration.config import configuration
from runner.core.model import Camera, Vehicle, plain
from runner.errors import ArgumentError, RunError
from runner.plans import as_offered, compile_plans, render_missing
from runner.rate_quality import recordings
from runner.settings import Setup
from runner.system.signals import Stop, stopping
from runner.verbs import Arguments
from runner.verbs.screen import forgiving, progress_bar, say, streaming

if TYPE_CHECKING:
    from runner.apply import Recorded, RecordingSide

SAMPLE_S = 0.25
SHOW_S = 1.0  # between two lines of figures, if no bar shows the progress
Show = Callable[[Mapping[str, "Recorded"]], None]


def run(arguments: Arguments) -> int:
    duration, directory = _duration(arguments), _directory(arguments)
    apply = streaming()
    config = configuration(arguments.overrides, arguments.conf, site=arguments.site, check=apply.check_plan)
    setup = as_offered(config.setup(), say)
    vehicle = setup.vehicle
    _check_sources(vehicle)
    recordings.make_directory(directory)
    with progress_bar() as progress:
        render_missing(vehicle, progress)
    plans = compile_plans(setup)
    apply.check_recorders(plans)
    recordings.check_space(directory, vehicle.cameras.values(), setup.recording, duration)
    files = recordings.claim_files(directory, vehicle.cameras)
    # Encoders and disks take their time to finish; a second signal does not wait for them.
    with stopping(limit_s=None) as stop, _shown(vehicle, files, duration) as show:
        session = _Session(setup, directory, duration, stop)
        try:
            side = apply.RecordingSide(plans, files, duration)
            try:
                session.watch(side, show)
            finally:
                side.stop()
        finally:
            recordings.remove_empty(files.values())
    session.conclude(config.document)
    return session.status()


class _Session:
    """One recording from start to end: names files when they are complete, and records why it ends."""

    def __init__(self, setup: Setup, directory: Path, duration_s: float | None, stop: Stop) -> None:
        self._vehicle, self._codec = setup.vehicle, setup.recording.codec
        self._directory, self._duration_s, self._stop = directory, duration_s, stop
        self._ended: dict[str, Recorded] = {}
        self._finishing = False  # ending before the requested time
        self._kept: set[str] = set()  # cameras whose files are complete and have their names
        self._problems: list[str] = []
        self._losing: set[str] = set()
        self._margin = recordings.margin(setup.vehicle.cameras.values())

    def watch(self, side: RecordingSide, show: Show) -> None:
        """Run until every camera has ended."""
        while len(self._ended) < len(self._vehicle.cameras):
            if self._finishing:
                time.sleep(SAMPLE_S)
            elif self._stop.wait(SAMPLE_S):
                say("finishing the files")
            samples = side.sample()
            show(samples)
            for name, recorded in samples.items():
                self._take(name, recorded)
            if not self._finishing and (self._stop.is_set() or self._is_full()):
                self._finishing = True
                side.finish()

    def _take(self, name: str, recorded: Recorded) -> None:
        if recorded.missing and name not in self._losing:
            self._losing.add(name)
            say(f"{name}: frames are missing")
        if name in self._ended or recorded.stage.value == "recording":
            return
        self._ended[name] = recorded
        unfinished = recordings.part(self._directory, name)
        if recorded.stage.value == "failed":
            before = f"; what was recorded until then is in {unfinished}" if unfinished.stat().st_size else ""
            self._fail(f"{name}: {recorded.failure}{before}")
            return
        try:
            recordings.keep(self._directory, name)
        except RunError as error:  # the other cameras continue
            self._fail(f"{name}: {error}")
            return
        self._kept.add(name)
        self._check_length(name, recorded)

    def _check_length(self, name: str, recorded: Recorded) -> None:
        """Check that a camera was recorded for the requested time."""
        requested_s = self._duration_s
        if requested_s is not None and not self._finishing and recorded.seconds < requested_s - SAMPLE_S:
            self._fail(f"{name}: its source ended after {recorded.seconds:.1f} of {requested_s:g} s")

    def _is_full(self) -> bool:
        free = shutil.disk_usage(self._directory).free
        if free >= self._margin:
            return False
        left = f"{recordings.gigabytes(free)} left, {recordings.gigabytes(self._margin)} are kept free"
        self._fail(f"{self._directory}: {left}: the recording ends early")
        return True

    def _fail(self, what: str) -> None:
        self._problems.append(what)
        say(what)

    def conclude(self, configuration: Mapping[str, Any]) -> None:
        """Report the results and write them to a file next to the videos."""
        cameras = {name: self._entry(self._vehicle.cameras[name], self._ended[name]) for name in self._vehicle.cameras}
        if self._kept:
            document = {
                "tod_runner": version("tod-runner"),
                "vehicle": self._vehicle.name,
                "codec": self._codec,
                "cameras": cameras,
                "configuration": configuration,
            }
            recordings.write_index(self._directory, document)
        kept = [name for name in cameras if name in self._kept]
        out, err = forgiving(sys.stdout), forgiving(sys.stderr)  # a closed pipe leaves the status as it is
        for name in kept:
            print(self._line(name, cameras[name]), file=out)
        for name in kept:
            for warning in _warnings(self._ended[name]):
                print(f"{name}: {warning}", file=err)

    def _entry(self, camera: Camera, recorded: Recorded) -> dict[str, Any]:
        kept = camera.name in self._kept
        path = (recordings.final if kept else recordings.part)(self._directory, camera.name)
        if not path.exists():
            return {"failed": recorded.failure}
        entry: dict[str, Any] = {
            "file": path.name,
            "bytes": path.stat().st_size,
            "width_px": recorded.width,
            "height_px": recorded.height,
            "fps": plain(camera.fps),
            "frames": recorded.frames,
            "seconds": round(recorded.seconds, 6),
            "missing_frames": recorded.missing,
            "overruns": recorded.overruns,
            "repeated_frames": recorded.repeated,
            "left_out_frames": recorded.left_out,
            "began": round(recorded.began, 3),
        }
        return entry if kept else {"failed": recorded.failure or "not named", **entry}

    def _line(self, name: str, entry: Mapping[str, Any]) -> str:
        size = f"{entry['width_px']}x{entry['height_px']} at {entry['fps']:g} Hz"
        amount = f"{entry['frames']} frames in {entry['seconds']:.2f} s, {entry['bytes'] / 1e6:.1f} MB"
        return f"{name}: {recordings.final(self._directory, name)}: {size}, {amount}"

    def status(self) -> int:
        return 1 if self._problems else self._stop.status


def _warnings(recorded: Recorded) -> Iterator[str]:
    """Warnings for users who expect the file to be complete."""
    if recorded.missing:
        of = recorded.frames + recorded.missing
        why = ", the encoder or the disk was too slow" if recorded.overruns else ""
        yield f"WARNING: {recorded.missing} of {of} frames are missing{why}"
    if recorded.repeated or recorded.left_out:
        rate = "to keep the camera's fps"
        yield f"WARNING: its source repeated {recorded.repeated} frames and left out {recorded.left_out} {rate}"


def _duration(arguments: Arguments) -> float | None:
    duration = arguments.number("duration_s")
    if duration == 0:
        raise ArgumentError("duration_s", repr(arguments.values["duration_s"]), "must be above 0")
    return duration


def _directory(arguments: Arguments) -> Path:
    if not arguments.values.get("output"):
        raise ArgumentError("output", "missing", "must be given: output=DIR, a directory for the files")
    return Path(arguments.values["output"])


def _check_sources(vehicle: Vehicle) -> None:
    """Check that every source produces frames on its own.

    raises  UserError
    """
    subscribed = [camera.name for camera in vehicle.cameras.values() if camera.source.subscribes]
    if subscribed:
        rule = "`record` does not subscribe to topics; record a bag with ROS, and choose source=bag"
        raise ArgumentError("source", ", ".join(subscribed), rule)
    pushed = [
        c.name for c in vehicle.cameras.values() if c.source.stand_in and not (c.source.render or c.source.plays_bags)
    ]
    if pushed:
        rule = "its frames must be pushed by a Python program; choose another source"
        raise ArgumentError("source", ", ".join(pushed), rule)
    if vehicle.fixed:
        rule = "these cameras are passed on as they encode; record their raw pictures with another graph"
        raise ArgumentError("graph", ", ".join(sorted(vehicle.fixed)), rule)


@contextmanager
def _shown(vehicle: Vehicle, files: Mapping[str, Path], duration_s: float | None) -> Iterator[Show]:
    """Progress of the recording: bars if its length is known, otherwise figures once a second."""
    if duration_s is not None:
        with progress_bar(interrupts=False) as progress:  # a signal ends the recording in order

            def show_share(samples: Mapping[str, Recorded]) -> None:
                for name, recorded in samples.items():
                    progress(name, min(1.0, recorded.seconds / duration_s))

            yield show_share
        return
    last = 0.0

    def show_figures(samples: Mapping[str, Recorded]) -> None:
        nonlocal last
        if time.monotonic() - last >= SHOW_S:
            last = time.monotonic()
            say("; ".join(_figures(name, recorded, files[name]) for name, recorded in samples.items()))

    yield show_figures


def _figures(name: str, recorded: Recorded, file: Path) -> str:
    size = file.stat().st_size / 1e6 if file.exists() else 0
    missing = f", {recorded.missing} missing" if recorded.missing else ""
    return f"{name} {recorded.frames} frames{missing}, {recorded.seconds:.0f} s, {size:.0f} MB"
