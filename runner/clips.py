"""Clips that a source renders before a run: the view of each camera, and where its clip is stored."""

from __future__ import annotations

import hashlib
import os
import struct
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

from runner.core.model import Camera, ModelError
from runner.core.mounting import Pose

RENDERER_VERSION = 3  # increment with every change to pictures or files
_DIGEST_BYTES = 32
_SEAL = struct.pack(">I4s", 8 + _DIGEST_BYTES, b"free")
_BLOCK_BYTES = 1 << 20
# A camera without a pose looks ahead from the height of a driver's eyes.
DRIVER = Pose(0.0, 0.0, 1.5, 0.0, 5.0, 0.0)


@dataclass(frozen=True, slots=True)
class View:
    """One camera's view of the drive.

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
            raise ModelError("fov_deg", f"{self.fov_deg:g}", rule, "lens")
        if self.pose.z_m <= 0 or self.fps <= 0:
            raise ModelError("pose.z_m", f"z_m {self.pose.z_m:g}, fps {self.fps}", "must be above 0")

    def frames(self, seconds: float) -> int:
        """Number of frames in a clip of that length."""
        return round(seconds * self.fps)


def view(camera: Camera) -> View:
    """A camera's view of the synthetic drive.

    raises  ModelError if it cannot be rendered
    """
    width, height = camera.source_size
    return View(width, height, camera.fps, camera.pose or DRIVER, camera.fov_deg, camera.lens)


def cache_directory() -> Path:
    """The user's cache (XDG Base Directory Specification)."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "tod-runner"


def clip_path(view: View, seconds: float, cache: Path) -> Path:
    """Path of a view's clip: the name is a digest of everything that affects its pictures."""
    digest = hashlib.sha256(repr((RENDERER_VERSION, view, float(seconds))).encode()).hexdigest()
    return cache / f"drive-{digest[:20]}.mp4"


def seal(path: Path) -> None:
    """End a finished MP4 file with its digest, in a box that players skip (ISO/IEC 14496-12, `free`).

    raises  OSError
    """
    digest = _digest(path, path.stat().st_size)
    with path.open("ab") as file:
        file.write(_SEAL + digest)


def is_whole(path: Path) -> bool:
    """Whether a file exists and is as it was sealed. An older run may have left it cut off, or the disk damaged it."""
    try:
        end = path.stat().st_size - len(_SEAL) - _DIGEST_BYTES
        with path.open("rb") as file:
            file.seek(max(0, end))
            return end > 0 and file.read() == _SEAL + _digest(path, end)
    except OSError:
        return False


def _digest(path: Path, end: int) -> bytes:
    """Of the bytes of a file before `end`."""
    digest = hashlib.blake2b(digest_size=_DIGEST_BYTES)
    with path.open("rb") as file:
        while block := file.read(min(_BLOCK_BYTES, end - file.tell())):
            digest.update(block)
    return digest.digest()


def rendered(camera: Camera) -> str | None:
    """Path of the camera's rendered clip; None if its source renders none, or it is missing or damaged in the cache."""
    if not camera.source.render:
        return None
    path = clip_path(view(camera), camera.source.render_s, cache_directory())
    return str(path) if is_whole(path) else None
