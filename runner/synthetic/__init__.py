"""The `synthetic` source: a procedural drive, rendered once into a cache as one clip per camera.

The street repeats after one lap, so the last frame of a clip is followed by its first. This module holds what needs
neither numba nor GStreamer: what a camera sees, where its clip lies, who renders it. The street is in
`world.py`, the picture in `picture.py`, the file in `gst/clip_writer.py`.
"""

from __future__ import annotations

import errno
import fcntl
import hashlib
import multiprocessing
import os
import shutil
import signal
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from fractions import Fraction
from importlib.util import find_spec
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path

from runner.model import ModelError, Pose, Progress

RENDERER_VERSION = 2  # raise it with every change that changes pictures or files
SHORTEST_S = 4
BYTES_PER_PIXEL = 0.15  # upper estimate of a clip's size, for the check of the disk
UNFINISHED = ".part"
REPORT_EVERY_S = 0.25  # of drive


@dataclass(frozen=True, slots=True)
class View:
    """What one camera sees of the drive.

    width, height  px, even
    fov_deg        horizontal field of view; below 180 for a pinhole
    lens           "pinhole" or "fisheye" (equidistant, fills the whole picture)
    """

    width: int
    height: int
    fps: Fraction
    pose: Pose
    fov_deg: float
    lens: str

    def __post_init__(self) -> None:
        if self.lens not in ("pinhole", "fisheye"):
            raise ModelError("lens", repr(self.lens), "must be pinhole or fisheye")
        if self.width % 2 or self.height % 2 or min(self.width, self.height) < 16:
            raise ModelError("size", f"{self.width}x{self.height}", "both sides must be even and at least 16 px")
        if not 0 < self.fov_deg <= (360 if self.lens == "fisheye" else 170):
            rule = "must lie in ]0, 170] for a pinhole, ]0, 360] for a fisheye"
            raise ModelError("fov_deg", f"{self.fov_deg:g}", rule)
        if self.pose.z_m <= 0 or self.fps <= 0:
            raise ModelError("pose.z_m", f"z_m {self.pose.z_m:g}, fps {self.fps}", "must be above 0")

    def frames(self, seconds: float) -> int:
        """Number of frames of a clip of that many seconds."""
        return round(seconds * self.fps)


def clip_path(view: View, seconds: float, cache: Path) -> Path:
    """Where the clip of a view lies: its name is a digest of everything that its pictures depend on."""
    digest = hashlib.sha256(repr((RENDERER_VERSION, view, float(seconds))).encode()).hexdigest()
    return cache / f"drive-{digest[:20]}.mp4"


def render(views: Sequence[View], seconds: float, cache: Path, progress: Progress) -> None:
    """Render the clips that the cache does not hold yet, one process per core.

    seconds   length of the drive, at least 4
    progress  called with what is being done and the share of all pixels done, from 0 to 1 and never falling
    raises    ValueError, RuntimeError (numba is missing, GStreamer or a worker failed), OSError (disk)

    Unfinished files end in .part and go with the run, or with the next one if this one is killed.
    """
    if seconds < SHORTEST_S:
        raise ValueError(f"seconds: {seconds:g}: must be at least {SHORTEST_S}")
    cache.mkdir(parents=True, exist_ok=True)
    with _only_renderer(cache, progress):
        _remove_unfinished(cache)  # of a run that was killed
        missing = [view for view in dict.fromkeys(views) if not clip_path(view, seconds, cache).exists()]
        if missing:
            _need_numba()
            _need_space(missing, seconds, cache)
            try:
                _render_missing(missing, seconds, cache, progress)
            finally:
                _remove_unfinished(cache)
    progress("drive rendered", 1.0)


@contextmanager
def _only_renderer(cache: Path, progress: Progress) -> Iterator[None]:
    """Hold the cache: a second run waits for the first and then finds its clips."""
    with (cache / "lock").open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            progress("waiting for another run that renders", 0.0)
            fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def _remove_unfinished(cache: Path) -> None:
    for path in cache.glob(f"*{UNFINISHED}"):
        path.unlink()


def _need_numba() -> None:
    if find_spec("numba") is None:
        raise RuntimeError("the synthetic drive needs numba: pip install 'tod-runner[synthetic]'")


def _pixels(view: View, seconds: float) -> int:
    return view.width * view.height * view.frames(seconds)


def _need_space(views: Sequence[View], seconds: float, cache: Path) -> None:
    """Refuse to start what would fill the disk."""
    from runner.synthetic.world import WORLD_BYTES

    need = BYTES_PER_PIXEL * sum(_pixels(view, seconds) for view in views) + WORLD_BYTES
    free = shutil.disk_usage(cache).free
    if free < need:
        found = f"rendering the drive needs about {need / 1e6:.0f} MB, {free / 1e6:.0f} MB are free"
        raise OSError(errno.ENOSPC, found, str(cache))


def _render_missing(views: Sequence[View], seconds: float, cache: Path, progress: Progress) -> None:
    """Build the world, then let the workers take one view after the other, the largest first."""
    from runner.synthetic.world import build_world

    progress("building the street", 0.0)
    world = cache / f"world{UNFINISHED}"
    build_world(seconds, world)
    ordered = sorted(views, key=lambda view: -_pixels(view, seconds))
    _share_out(ordered, seconds, cache, world, progress)


def _share_out(views: Sequence[View], seconds: float, cache: Path, world: Path, progress: Progress) -> None:
    """Hand views to workers and add up what they report; they are gone when this returns or raises."""
    total = sum(_pixels(view, seconds) for view in views)
    waiting = list(views)
    done = clips = 0
    workers = dict(_start_worker(seconds, cache, world) for _ in range(min(os.cpu_count() or 1, len(views))))
    try:
        for pipe in workers:
            pipe.send(waiting.pop(0))
        while clips < len(views):
            ready = wait(list(workers))
            for pipe in (pipe for pipe in workers if pipe in ready):
                report = _receive(pipe, workers[pipe])
                if isinstance(report, int):
                    done += report
                else:
                    clips += 1
                    if waiting:
                        pipe.send(waiting.pop(0))
                progress(f"rendering the drive, {clips} of {len(views)} clips", min(done / total, 1.0))
    finally:
        for pipe, worker in workers.items():
            worker.terminate()
            worker.join()
            pipe.close()


def _start_worker(seconds: float, cache: Path, world: Path) -> tuple[Connection, BaseProcess]:
    """A fresh interpreter: a fork of a process that has used GStreamer or threads may hang."""
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    worker = context.Process(target=_work, args=(theirs, seconds, cache, world), daemon=True)
    worker.start()
    theirs.close()
    return ours, worker


def _receive(pipe: Connection, worker: BaseProcess) -> int | None:
    """Pixels done since the last report, or None for a finished clip."""
    try:
        report = pipe.recv()
    except EOFError:
        worker.join()
        raise RuntimeError(f"rendering the drive: a worker died with exit code {worker.exitcode}") from None
    if isinstance(report, str):
        raise RuntimeError(f"rendering the drive: {report}")
    return int(report) if report is not None else None


def _work(pipe: Connection, seconds: float, cache: Path, world: Path) -> None:
    """A worker's life: views in, reports out; Ctrl-C is the parent's to answer, who then ends the worker."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    while True:
        try:
            view = pipe.recv()
        except EOFError:
            return
        try:
            _render_clip(view, seconds, cache, world, pipe.send)
        except BrokenPipeError:
            return  # the parent is gone
        except Exception as error:
            pipe.send(f"{type(error).__name__}: {error}")
            return
        pipe.send(None)


def _render_clip(view: View, seconds: float, cache: Path, world: Path, report: Callable[[int], None]) -> None:
    """Render into a file beside the clip and rename it: a clip is there in full or not at all."""
    from runner.gst.clip_writer import write_clip
    from runner.synthetic.picture import pictures

    clip = clip_path(view, seconds, cache)
    unfinished = clip.with_name(clip.name + UNFINISHED)
    every = max(1, round(REPORT_EVERY_S * view.fps))

    def counted() -> Iterator[bytes]:
        for number, picture in enumerate(pictures(view, seconds, world), 1):
            yield picture
            if number % every == 0 or number == view.frames(seconds):
                report(view.width * view.height * ((number - 1) % every + 1))

    write_clip(unfinished, counted(), view.width, view.height, view.fps)
    unfinished.replace(clip)
