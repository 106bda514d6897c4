"""The scenes that a camera saw: pictures of the clip that its source played, recognised in what was sent of them."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from itertools import chain
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from runner.core.model import Camera
from runner.drive.videos import FileTimes, Picture, Videos
from runner.rate_quality.metrics.interface import Luma

BLOCKS = 32  # along the shorter side of an image
KEPT_BYTES = 400_000_000  # of pictures of a clip, for each camera that is measured at the same time

Blocks = NDArray[np.float32]


def scenes(
    camera: Camera,
    videos: Videos,
    sent: Sequence[FileTimes],
    moments: Collection[int],
    clip: Path | None,
    size: tuple[int, int] | None = None,
) -> Iterator[tuple[int, Picture]]:
    """Moments and their scenes, in the order of capture. All scenes of a drive would not fit into memory.

    Those of a short clip do: it is decoded once for all of its repetitions.

    moments  capture times of pictures that were sent, ns
    clip     that the source played; None: the scenes are the pictures as sent
    size     to which pictures as sent are scaled; None: as they were coded
    """
    times = frozenset(moments)
    if not times:
        return
    if clip is None:
        yield from ((ns, picture) for ns, picture in videos.pictures(sent, size) if ns in times)
        return
    crop = camera.in_source
    window = np.s_[crop.y : crop.y + crop.height, crop.x : crop.x + crop.width]
    clipped = [_blocks(camera, Picture(luma[window], camera.full_roi))[0] for _, luma in _played(camera, videos, clip)]
    numbers: dict[int, int] = {}
    for ns, picture in videos.pictures(sent):
        if ns in times:
            blocks, where = _blocks(camera, picture)
            if blocks.size:  # a region smaller than a block is not recognised
                numbers[ns] = _nearest([each[where] for each in clipped], blocks)
    needed = set(numbers.values())
    if len(needed) * camera.width * camera.height <= KEPT_BYTES:
        kept = {n: luma[window] for n, (_, luma) in enumerate(_played(camera, videos, clip)) if n in needed}
        yield from ((ns, Picture(kept[number], camera.full_roi)) for ns, number in numbers.items())
        return
    repeated = chain.from_iterable(enumerate(_played(camera, videos, clip)) for _ in numbers)
    played, (_, luma) = next(repeated)
    for ns, number in numbers.items():
        while played != number:
            played, (_, luma) = next(repeated)
        yield ns, Picture(luma[window], camera.full_roi)


def _played(camera: Camera, videos: Videos, clip: Path) -> Iterator[tuple[int, Luma]]:
    return videos.decode(clip, camera.source_size, fitted=True)


def lookup(found: Iterator[tuple[int, Picture]]) -> Callable[[int], Picture | None]:
    """A function that returns the scene at a moment, None if it is missing; moments must not decrease."""
    current: tuple[int, Picture] | None = None

    def at(moment: int) -> Picture | None:
        nonlocal current
        while current is None or current[0] < moment:
            current = next(found, None)
            if current is None:
                return None
        return current[1] if current[0] == moment else None

    return at


def _blocks(camera: Camera, picture: Picture) -> tuple[Blocks, tuple[slice, slice]]:
    """The picture in blocks, enough to recognise it in a clip, and which of the full image's blocks they are."""
    import cv2

    side = max(1, min(camera.width, camera.height) // BLOCKS)
    region = picture.region
    columns = slice(-(-region.x // side), (region.x + region.width) // side)
    rows = slice(-(-region.y // side), (region.y + region.height) // side)
    wide, high = max(0, columns.stop - columns.start), max(0, rows.stop - rows.start)
    luma = picture.luma
    if luma.shape != (region.height, region.width):
        luma = cv2.resize(luma, (region.width, region.height), interpolation=cv2.INTER_LINEAR)  # type: ignore[assignment]
    top, left = rows.start * side - region.y, columns.start * side - region.x
    blocks = luma[top : top + high * side, left : left + wide * side].reshape(high, side, wide, side)
    small: Blocks = blocks.mean(axis=(1, 3), dtype=np.float32) if wide and high else np.empty((0, 0), np.float32)
    return small, (rows, columns)


def _nearest(candidates: Sequence[Blocks], blocks: Blocks) -> int:
    return int(np.argmin([np.square(candidate - blocks).sum() for candidate in candidates]))
