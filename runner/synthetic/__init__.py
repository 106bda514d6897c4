"""The `synthetic` source: a procedural drive, rendered once as one clip per camera and cached.

The street repeats after one lap, so the last frame of a clip is followed by its first. This module divides the work;
the street is in `world.py`, the picture in `picture.py`, the file in `gst/clip_writer.py`.
"""

from __future__ import annotations

import errno
import fcntl
import multiprocessing
import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path

from runner.clips import View, clip_path, is_whole, seal
from runner.core.model import Progress
from runner.system import signals
from runner.system.extras import how_to_install
from runner.system.files import put_in_place
from runner.system.spawned import WorkerContext

SHORTEST_S = 4
BYTES_PER_PIXEL = 0.15  # upper estimate of a clip's size, for the check of disk space
UNFINISHED = ".part"
REPORT_EVERY_S = 0.25  # of drive
CHECK_S = 0.25  # between checks for a signal, while workers compile or render
KILLED_S = 1.0  # a killed worker ends within this time, unless it is blocked in the kernel


def render(views: Sequence[View], seconds: float, cache: Path, progress: Progress) -> None:
    """Render the clips that are missing from the cache or damaged there, with one process per core.

    seconds   length of the drive, at least 4
    progress  called with the current step and the share of all pixels done, from 0 to 1 and never decreasing
    raises    ValueError, RuntimeError (numba is missing, GStreamer or a worker failed), OSError (disk)

    Unfinished files end in .part and are removed by the run, or by the next one if this one is killed.
    """
    if seconds < SHORTEST_S:
        raise ValueError(f"seconds: {seconds:g}: must be at least {SHORTEST_S}")
    cache.mkdir(parents=True, exist_ok=True)
    _refuse_in_unguarded_script()
    with _only_renderer(cache, progress):
        _remove_unfinished(cache)  # left by a killed run
        missing = [view for view in dict.fromkeys(views) if not is_whole(clip_path(view, seconds, cache))]
        for path in (clip_path(view, seconds, cache) for view in missing):
            if path.exists():
                progress(f"{path} is damaged, rendered again", 0.0)
        if missing:
            _need_numba()
            _need_space(missing, seconds, cache)
            try:
                _render_missing(missing, seconds, cache, progress)
            finally:
                _remove_unfinished(cache)
    progress("drive rendered", 1.0)


def _refuse_in_unguarded_script() -> None:
    """Raise RuntimeError in a worker that runs the caller's script again; it would wait for its parent's lock.

    Workers import that script (start method "spawn"). While they do, this private attribute is set; `multiprocessing`
    itself checks it for the same purpose, but only when the worker starts a process.
    """
    if getattr(multiprocessing.current_process(), "_inheriting", False):
        raise RuntimeError('a script that renders the synthetic drive needs `if __name__ == "__main__":`')


@contextmanager
def _only_renderer(cache: Path, progress: Progress) -> Iterator[None]:
    """Lock the cache: a second run waits for the first and uses its clips."""
    with (cache / "lock").open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            progress("waiting for another run to finish rendering", 0.0)
            fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def _remove_unfinished(cache: Path) -> None:
    for path in cache.glob(f"*{UNFINISHED}"):
        path.unlink()


def _need_numba() -> None:
    if find_spec("numba") is None:
        raise RuntimeError(f"the synthetic drive needs numba: {how_to_install('synthetic')}")


def _pixels(view: View, seconds: float) -> int:
    return view.width * view.height * view.frames(seconds)


def _need_space(views: Sequence[View], seconds: float, cache: Path) -> None:
    """Refuse to start if this would fill the disk."""
    from runner.synthetic.world import WORLD_BYTES

    need = BYTES_PER_PIXEL * sum(_pixels(view, seconds) for view in views) + WORLD_BYTES
    free = shutil.disk_usage(cache).free
    if free < need:
        found = f"rendering the drive needs about {need / 1e6:.0f} MB, {free / 1e6:.0f} MB are free"
        raise OSError(errno.ENOSPC, found, str(cache))


def _render_missing(views: Sequence[View], seconds: float, cache: Path, progress: Progress) -> None:
    """Build the world, then let the workers render the views, the largest first."""
    from runner.synthetic.world import build_world

    progress("building the street", 0.0)
    world = cache / f"world{UNFINISHED}"
    build_world(seconds, world)
    ordered = sorted(views, key=lambda view: -_pixels(view, seconds))
    _distribute(ordered, seconds, cache, world, progress)


def _distribute(views: Sequence[View], seconds: float, cache: Path, world: Path, progress: Progress) -> None:
    """Hand views to workers and sum up their reports; the workers have ended when this returns or raises."""
    total = sum(_pixels(view, seconds) for view in views)
    waiting = list(views)
    done = clips = 0
    workers = dict(_start_worker(seconds, cache, world) for _ in range(min(os.cpu_count() or 1, len(views))))
    try:
        for pipe in workers:
            pipe.send(waiting.pop(0))
        while clips < len(views):
            ready = wait(list(workers), CHECK_S)
            signals.check()
            for pipe in (pipe for pipe in workers if pipe in ready):
                report = _receive(pipe, workers[pipe])
                if isinstance(report, int):
                    done += report
                else:
                    clips += 1
                    if waiting:
                        pipe.send(waiting.pop(0))
                progress("rendering the drive, once", min(done / total, 1.0))
    finally:
        for pipe, worker in workers.items():
            worker.kill()
            pipe.close()
        for worker in workers.values():
            worker.join(KILLED_S)


def _start_worker(seconds: float, cache: Path, world: Path) -> tuple[Connection, BaseProcess]:
    context = WorkerContext()
    ours, theirs = context.Pipe()
    worker = context.Process(target=_work, args=(theirs, seconds, cache, world), daemon=True)
    worker.start()
    theirs.close()
    return ours, worker


def _receive(pipe: Connection, worker: BaseProcess) -> int | None:
    """Pixels done since the last report, or None for a finished clip."""
    try:
        report = pipe.recv()
    except (EOFError, ConnectionResetError):
        worker.join(KILLED_S)
        raise RuntimeError(f"rendering the drive: a worker died with exit code {worker.exitcode}") from None
    if isinstance(report, str):
        raise RuntimeError(f"rendering the drive: {report}")
    return int(report) if report is not None else None


def _work(pipe: Connection, seconds: float, cache: Path, world: Path) -> None:
    """A worker's main loop: receives views, sends reports."""
    while True:
        try:
            view = pipe.recv()
        except EOFError:
            return
        try:
            _render_clip(view, seconds, cache, world, pipe.send)
        except BrokenPipeError:
            return  # the parent has ended
        except Exception as error:
            pipe.send(f"{type(error).__name__}: {error}")
            return
        pipe.send(None)


def _render_clip(view: View, seconds: float, cache: Path, world: Path, report: Callable[[int], None]) -> None:
    """Render to a temporary file first: a clip is complete or does not exist."""
    from runner.apply import write_clip
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
    seal(unfinished)
    put_in_place(unfinished, clip)
