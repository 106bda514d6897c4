"""usage: tod-runner export DRIVE [format=mcap] [output=FILE.mcap] [key_interval_s=N]
       tod-runner export DRIVE format=rosbag2 [output=DIR] [key_interval_s=N]

Exports a drive as MCAP, for Foxglove and any other MCAP reader, or as a ROS 2 bag. DRIVE is a directory that log=DIR
wrote; all of its logs (vehicle, operator, link) are exported to DRIVE/drive.mcap, or DRIVE/rosbag2, unless output=
names another path.

  /position               foxglove.LocationFix
  /CAMERA/video           foxglove.CompressedVideo, as sent, at capture times (drives with log.video=true)
  /CAMERA/video_received  the same, as received
  /sound_received         foxglove.CompressedAudio, Opus, at capture times (drives with log.sound=true)
  /notes                  foxglove.Log
  /events/..., /decision, /telemetry, /operator/state, /operator/sample, /link    JSON with its schema

In a ROS 2 bag positions are sensor_msgs/NavSatFix, sound is audio_common_msgs/AudioDataStamped, one Opus packet per
message, video is sensor_msgs/CompressedImage, one access unit per message in
the format h264 or h265, and everything else is std_msgs/String with the line of JSON.

Video is exported as it was sent, mostly with one key frame, its first. Players that seek, such as Foxglove, need more:
with key_interval_s=1 pictures are decoded and encoded again in H.264, with a key frame every second. Exports
of either format are read by source=bag.

  tod-runner demo log=monday log.video=true
  tod-runner export monday
  tod-runner export monday format=rosbag2
  tod-runner export monday output=monday.mcap key_interval_s=1
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

from runner.drive.captures import ReadVideo
from runner.drive.read import Drive, read_drive
from runner.errors import ArgumentError, RunError, UserError, os_errors_as
from runner.records.lines import VideoBegan
from runner.system import signals
from runner.system.files import unfinished, unfinished_directory
from runner.verbs import Arguments
from runner.verbs.screen import progress_bar, streaming

OUTPUTS = {"mcap": "drive.mcap", "rosbag2": "rosbag2"}  # by format, the default path in the drive's directory
QUIET_S = 2.0  # a shorter export shows no progress


def run(arguments: Arguments) -> int:
    form = arguments.choice("format")
    if len(arguments.words) != 1:
        found = " ".join(arguments.words) or None
        raise ArgumentError("", found, "must name one drive: a directory that log= wrote")
    directory = Path(arguments.words[0])
    output = arguments.path("output") or directory / OUTPUTS[form]
    if os.path.lexists(output):
        raise ArgumentError("output", output, "already exists; remove it, or choose another path with output=")
    drive = read_drive(directory)
    for warning in drive.warnings:
        print(warning, file=sys.stderr)
    has_video = any(True for side in drive.sides.values() for _ in side.of(VideoBegan))
    read_video = _reader(arguments) if has_video else _no_video
    with _delayed_progress(f"{output}") as progress:
        count = WRITERS[form](drive, output, read_video, _warn, progress)
    size = sum(path.stat().st_size for path in (output.iterdir() if output.is_dir() else [output]))
    print(f"{output}: {count} messages, {size / 1e6:.1f} MB")
    return 0


def _write_mcap(drive: Drive, output: Path, *more: Any) -> int:
    from runner.drive.mcap import write_mcap

    with _new_file(output) as file:
        return write_mcap(drive, file, *more)


def _write_rosbag2(drive: Drive, output: Path, *more: Any) -> int:
    from runner.drive.rosbag2 import write_rosbag2

    with os_errors_as(_output_error(output)), unfinished_directory(output) as part:
        return write_rosbag2(drive, part, *more)


WRITERS = {"mcap": _write_mcap, "rosbag2": _write_rosbag2}


def _reader(arguments: Arguments) -> ReadVideo:
    """What reads the video: as it was sent, or encoded again."""
    apply, interval_s = streaming(), arguments.number("key_interval_s")
    as_sent: ReadVideo = apply.read_video
    if interval_s is None:
        return as_sent
    if interval_s == 0:
        raise ArgumentError("key_interval_s", repr(arguments.values["key_interval_s"]), "must be above 0")
    _warn(f"video is encoded again, with a key frame every {interval_s:g} s: it is not what was sent")
    return lambda path: apply.read_again(path, interval_s, _warn)


def _warn(what: str) -> None:
    print(what, file=sys.stderr)


def _no_video(_path: Path) -> Iterator[Any]:
    return iter(())


@contextmanager
def _new_file(path: Path) -> Iterator[BinaryIO]:
    """A new file, which appears only when it is complete."""
    with os_errors_as(lambda why: RunError(f"{path}: {why}")), unfinished(path) as part:
        with os_errors_as(_output_error(path)):
            file = part.open("xb")
        with file:
            yield file


def _output_error(path: Path) -> Callable[[str], UserError]:
    return partial(ArgumentError, "output", path)


@contextmanager
def _delayed_progress(what: str) -> Iterator[Callable[[float], None]]:
    """Progress of long work, shown once it has lasted `QUIET_S`."""
    began = time.monotonic()
    with progress_bar() as show:

        def progress(done: float) -> None:
            signals.check()
            if time.monotonic() - began > QUIET_S:
                show(what, done)

        yield progress
