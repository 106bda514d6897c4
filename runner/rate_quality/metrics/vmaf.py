"""VMAF (Netflix) of luma, by an ffmpeg with libvmaf in a separate process to which the pictures are piped."""

from __future__ import annotations

import fcntl
import math
import os
import re
import select
import shutil
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import suppress
from fractions import Fraction
from functools import cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import msgspec
import numpy as np

from runner.errors import RunError, UserError, reason
from runner.rate_quality.metrics.interface import Luma, Mask, Metric, PictureSize, check
from runner.system.extras import how_to_install

TIMEOUT_S = 120.0  # even a busy machine scores a picture faster
PIPE_BYTES = 1 << 20  # the most that a user may request; fewer, larger writes
SMALLEST_PX = 32  # libvmaf crashes with 16; newer models need more and report it
GREY = 128  # chroma, which models of version 0 ignore
# Models of version 1 also score chroma, and banding (CAMBI) by the size of the encoding.
LATER_VERSION = re.compile(r"v[1-9]")
LOG, STDERR_FILE = "scores.json", "stderr"


class Tool(NamedTuple):
    """An ffmpeg that has libvmaf."""

    exe: str
    version: str


class Scores(NamedTuple):
    """The output of libvmaf: its version, and the score by number of the picture, from 0."""

    version: str
    by_picture: dict[int, float]


class VmafOfPicture(msgspec.Struct):
    vmaf: float


class LoggedPicture(msgspec.Struct):
    number: int = msgspec.field(name="frameNum")
    metrics: VmafOfPicture


class VmafLog(msgspec.Struct):
    """The parts of libvmaf's log that are read."""

    version: str
    pictures: list[LoggedPicture] = msgspec.field(name="frames")


READER = msgspec.json.Decoder(VmafLog)  # created once: msgspec 0.22 crashes if several threads create it


def metric(model: str) -> Metric:
    """VMAF with a model that is built into libvmaf.

    raises  UserError for an unknown model or one that needs more than luma, RunError without a tool
    """
    if not re.fullmatch(r"[\w.]+", model):
        raise UserError("", "vmaf_model", repr(model), "must be the name of a model, such as vmaf_v0.6.1")
    if LATER_VERSION.search(model):
        rule = (
            "scores chroma and the encoded size, which are not measured: choose one of version 0, such as vmaf_v0.6.1"
        )
        raise UserError("", "vmaf_model", repr(model), rule)
    tool = find_tool()
    return Metric(
        name="vmaf",
        label="VMAF",
        identity=f"vmaf of luma, {model}, 8 bit, libvmaf {libvmaf_version(tool, model)}, ffmpeg {tool.version}",
        bounds=(0.0, 100.0),
        tolerance=0.3,
        good=85.0,
        build=partial(meter, tool, model),
        smallest_px=SMALLEST_PX,
        every_frame=True,
        takes_mask=False,
    )


def meter(tool: Tool, model: str, size: PictureSize, fps: Fraction, stride: int, mask: Mask | None) -> VmafMeter:
    """Meter of one lane. It supports no mask, as the metric states."""
    return VmafMeter(tool, model, size, fps, stride)


# --- the tool -------------------------------------------------------------------------------------------------------


def find_tool() -> Tool:
    """The ffmpeg of TOD_FFMPEG, otherwise the first with libvmaf: that of imageio-ffmpeg or that on the PATH.

    raises  RunError if none has libvmaf; the one that TOD_FFMPEG names is never silently replaced by another
    """
    named = os.environ.get("TOD_FFMPEG")
    for name in [named] if named else _candidates():
        exe = os.path.abspath(shutil.which(name) or name)  # it will run in another directory
        if version := _version(exe):
            return Tool(exe, version)
    what = f"TOD_FFMPEG={named} is not an ffmpeg with libvmaf" if named else "VMAF needs an ffmpeg with libvmaf"
    raise RunError(f"{what}: {how_to_install('vmaf')}")


def _candidates() -> Iterator[str]:
    # The module raises RuntimeError if its wheel came without a binary.
    with suppress(ModuleNotFoundError, RuntimeError):
        import imageio_ffmpeg

        yield imageio_ffmpeg.get_ffmpeg_exe()
    yield "ffmpeg"


@cache
def _version(exe: str) -> str:
    """Version of an ffmpeg with libvmaf; empty for anything else."""
    try:
        texts = [
            subprocess.run(
                [exe, "-hide_banner", option],
                check=False,
                capture_output=True,
                text=True,
                errors="replace",
                timeout=TIMEOUT_S,
            ).stdout
            for option in ("-filters", "-version")
        ]
    except (OSError, subprocess.TimeoutExpired):
        return ""
    found = re.match(r"ffmpeg version (\S+)", texts[1])
    return found[1] if found and re.search(r"^.{4,6}libvmaf +VV->V", texts[0], re.MULTILINE) else ""


@cache
def libvmaf_version(tool: Tool, model: str) -> str:
    """Version of libvmaf, found by scoring one picture, which also proves that the model exists.

    raises  UserError for an unknown model, RunError if scoring fails for another reason
    """
    grey = np.full((360, 640), GREY, np.uint8)  # large enough for every model
    probe = VmafMeter(tool, model, (640, 360), Fraction(1), 1)
    try:
        probe.add(0, grey, grey)
        probe.close()
    except RunError as error:
        if "could not load libvmaf model" in str(error):
            raise UserError("", "vmaf_model", repr(model), "libvmaf has no such model built in") from None
        raise
    finally:
        probe.close()
    return probe.version


def command(exe: str, inputs: Sequence[Sequence[str]], model: str, stride: int) -> list[str]:
    """Score the first input against the second, into a log in the working directory.

    inputs  for each raw video its options, ending in -i and its location
    """
    options = f"model=version={model}:n_threads=1:n_subsample={stride}:log_fmt=json:log_path={LOG}"
    raw = [word for words in inputs for word in ("-f", "rawvideo", "-threads", "1", *words)]
    return [exe, "-nostdin", "-v", "error", *raw, "-lavfi", f"[0:v][1:v]libvmaf={options}", "-f", "null", "-"]


def picture_format(size: PictureSize, pixel_format: str, fps: Fraction) -> list[str]:
    """Options of a raw video."""
    return ["-pix_fmt", pixel_format, "-s", f"{size[0]}x{size[1]}", "-r", f"{fps.numerator}/{fps.denominator}"]


def read_log(directory: Path, status: int) -> Scores:
    """The output of libvmaf. Raises RunError if there is none: ffmpeg may fail with status 0."""
    if status:
        raise ffmpeg_error(directory, status)
    try:
        log = READER.decode((directory / LOG).read_bytes())
        return Scores(log.version, {picture.number: picture.metrics.vmaf for picture in log.pictures})
    except (OSError, msgspec.ValidationError, msgspec.DecodeError):
        raise ffmpeg_error(directory, status) from None


def ffmpeg_error(directory: Path, status: int) -> RunError:
    """The error for an unexpected end of ffmpeg, with its first message: later ones do not name the cause."""
    lines = (directory / STDERR_FILE).read_text(errors="replace").strip().splitlines()
    why = re.sub(r"^\[[^]]*\] ", "", lines[0]) if lines else f"status {status}"
    return RunError(f"ffmpeg failed to score VMAF: {why}")


# --- a lane ---------------------------------------------------------------------------------------------------------


class VmafMeter:
    """Pipes pictures to a process and reads the scores from its log.

    No call waits forever: whichever pipe has room is written to, the end of the process is noticed immediately, and a
    stalled one is abandoned after `TIMEOUT_S`.
    """

    version = ""  # of libvmaf, known at the end

    def __init__(self, tool: Tool, model: str, size: PictureSize, fps: Fraction, stride: int) -> None:
        self._size = size
        self._frames: list[int] = []
        self._intact = True  # no picture was written only in part
        self._scores: dict[int, float] | None = None
        luma, chroma = math.prod(size), 2 * math.prod((side + 1) // 2 for side in size)
        self._pictures = [np.full(luma + chroma, GREY, np.uint8) for _ in range(2)]
        self._pipes: list[int] = []
        self._directory = TemporaryDirectory(prefix="tod-vmaf-", ignore_cleanup_errors=True)
        self._path = Path(self._directory.name)
        try:
            self._process = self._start(tool.exe, model, picture_format(size, "yuv420p", fps), stride)
        except OSError as error:
            self._free()
            raise RunError(f"{tool.exe}: cannot be started: {reason(error)}") from None

    def _start(self, exe: str, model: str, layout: list[str], stride: int) -> subprocess.Popen[bytes]:
        """The process, and the pipes into it: first for the scored picture, then for its reference."""
        theirs: list[int] = []
        try:
            for _ in range(2):
                read, write = os.pipe()
                theirs.append(read)
                self._pipes.append(write)
                os.set_blocking(write, False)
                # Unsupported on some systems, and refused if this user's pipes already use too much memory.
                with suppress(OSError, AttributeError):
                    fcntl.fcntl(write, fcntl.F_SETPIPE_SZ, PIPE_BYTES)
            words = command(exe, [[*layout, "-i", f"pipe:{pipe}"] for pipe in theirs], model, stride)
            with (self._path / STDERR_FILE).open("wb") as stderr:
                return subprocess.Popen(
                    words,
                    cwd=self._path,
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.DEVNULL,
                    stderr=stderr,
                    pass_fds=theirs,
                )
        finally:
            for pipe in theirs:
                os.close(pipe)

    def add(self, frame: int, reference: Luma, picture: Luma) -> None:
        check(self._size, reference, picture)
        if self._scores is not None or not self._intact:
            raise ValueError("this meter has ended")
        for whole, luma in zip(self._pictures, (picture, reference), strict=True):
            whole[: luma.size] = luma.ravel()
        self._frames.append(frame)
        self._intact = False
        try:
            self._write()
        except BrokenPipeError:
            raise ffmpeg_error(self._path, self._wait()) from None
        self._intact = True

    def _write(self) -> None:
        """One picture into each pipe. Raises BrokenPipeError when the process has ended, RunError when it stalls."""
        left = {pipe: picture.data for pipe, picture in zip(self._pipes, self._pictures, strict=True)}
        room = select.poll()
        for pipe in left:
            room.register(pipe, select.POLLOUT)
        while left:
            ready = room.poll(TIMEOUT_S * 1000)
            if not ready:
                raise RunError(f"ffmpeg has accepted no picture for {TIMEOUT_S:g} s")
            for pipe, _ in ready:
                left[pipe] = left[pipe][os.write(pipe, left[pipe]) :]
                if not left[pipe]:
                    room.unregister(pipe)
                    del left[pipe]

    def close(self) -> dict[int, float]:
        if self._scores is None:
            self._scores = {}  # a failure is raised once
            try:
                if self._frames and self._intact:
                    self._scores = self._finish()
            finally:
                self._process.kill()
                self._process.wait()
                self._free()
        return self._scores

    def _finish(self) -> dict[int, float]:
        """Let the process score the remaining pictures, and read its results."""
        self._close_pipes()
        scores = read_log(self._path, self._wait())
        self.version = scores.version
        return {self._frames[number]: score for number, score in scores.by_picture.items()}

    def _wait(self) -> int:
        """Exit status of the process, which is about to end."""
        try:
            return self._process.wait(TIMEOUT_S)
        except subprocess.TimeoutExpired:
            raise RunError(f"ffmpeg has not ended for {TIMEOUT_S:g} s") from None

    def _close_pipes(self) -> None:
        while self._pipes:
            os.close(self._pipes.pop())

    def _free(self) -> None:
        self._close_pipes()
        self._directory.cleanup()
