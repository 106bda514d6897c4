"""The textures of the street of the synthetic drive: what it looks like along its course."""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeVar, cast

import numpy as np
from numba import njit

from runner.synthetic.course import Array, Course, plan_course

F = TypeVar("F", bound=Callable[..., Any])

PARKING_D, ROAD_D, PAVEMENT_D, WALL_D = 3.1, 5.1, 6.6, 7.7  # where parking begins (left only), and where each ends
SUN_SLOPE = 1.8
LEVELS = 8  # mip levels of each texture; its sides are at least 2**LEVELS texels
WORLD_BYTES = 145e6

GROUND, WALL, SKY, TREE, LAMP, RAILING, VAN, VAN_END, RED, RED_END, BLUE, BLUE_END, HEDGE = range(13)
LOG2_SIZE = ((13, 12), (14, 11), (11, 11), (9, 9), (8, 9), (8, 8), *[(9, 8), (8, 8)] * 3, (10, 8))
# Texture of the side, length, width, height
BOXES = ((VAN, 5.0, 1.9, 2.35), (RED, 4.3, 1.8, 1.55), (BLUE, 4.5, 1.8, 1.5))


def compiled(function: F) -> F:
    """Compile with numba; the machine code is cached on disk for the next run."""
    return cast(F, njit(cache=True, fastmath=True, nogil=True)(function))


# --- textures -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Atlas:
    """All textures with their mip levels in one array; chroma has the same layout at half the size each way.

    A luma of 0 is transparent. Rows of upright textures count from the ground up.
    """

    luma: Array
    u: Array
    v: Array
    base: Array  # [texture, level] -> first texel
    log2_width: Array  # [texture]
    log2_height: Array
    per_m: Array  # [texture]


def open_atlas(course: Course, file: Path, mode: Literal["r", "w+"]) -> Atlas:
    """Map the file with the textures into memory, for reading or as a new one."""
    sizes = np.array(LOG2_SIZE)
    sizes[GROUND, 0], sizes[WALL, 0] = course.log2_columns, course.log2_columns + 1
    areas = [1 << (w + h - 2 * level) for w, h in sizes for level in range(LEVELS)]
    starts = np.concatenate([[0], np.cumsum([max(4, area) for area in areas])])
    total = int(starts[-1])
    texels = np.memmap(file, np.uint8, mode, shape=(total + total // 2,))
    luma, u, v = texels[:total], texels[total : total * 5 // 4], texels[total * 5 // 4 :]
    per_m = np.array([1 / course.period_m, 2 / course.length_m, 24.0, 88, 73, 102.4, *[100] * 7])
    per_m[:2] *= 1 << course.log2_columns
    base = starts[:-1].reshape(len(sizes), LEVELS)
    return Atlas(luma, u, v, base, sizes[:, 0], sizes[:, 1], per_m.astype(np.float32))


def level_of(atlas: Atlas, texture: int, level: int) -> tuple[Array, Array, Array]:
    """Luma, U and V of one mip level as pictures."""
    width, height = (1 << int(log2[texture] - level) for log2 in (atlas.log2_width, atlas.log2_height))
    start = int(atlas.base[texture, level])
    whole, half = slice(start, start + width * height), slice(start // 4, (start + width * height) // 4)
    return (
        atlas.luma[whole].reshape(height, width),
        atlas.u[half].reshape(height // 2, width // 2),
        atlas.v[half].reshape(height // 2, width // 2),
    )


def build_world(seconds: float, file: Path) -> None:
    """Draw all textures of the drive into a file that the workers share."""
    course = plan_course(seconds)
    atlas = open_atlas(course, file, "w+")
    noise = np.stack([fractal_noise(1024), fractal_noise(1024, 24)[::-1, ::-1]])
    houses = plan_houses(course)
    shading = height_along(course, houses)
    tables = (course.x, course.y, np.cos(course.psi), np.sin(course.psi), np.gradient(course.psi, course.s))

    def ground() -> None:
        draw_ground(*level_of(atlas, GROUND, 0), noise, course.period_m, course.length_m, *tables, shading)
        shrink(atlas, GROUND)

    def upright() -> None:
        draw_facade(*level_of(atlas, WALL, 0), noise, 1 / float(atlas.per_m[WALL]), *houses)
        draw_sky(level_of(atlas, SKY, 0), noise[1])
        draw_things(atlas, *noise)
        for texture in range(WALL, len(LOG2_SIZE)):
            shrink(atlas, texture)

    with ThreadPoolExecutor() as pool:  # compiled code runs in parallel
        for half in [pool.submit(ground), pool.submit(upright)]:
            half.result()


def shrink(atlas: Atlas, texture: int) -> None:
    """Fill the mip levels; a texel is opaque when at least two of its four are."""
    for level in range(1, LEVELS):
        for from_, to in zip(level_of(atlas, texture, level - 1), level_of(atlas, texture, level), strict=True):
            halve(np.ascontiguousarray(from_), to)


@compiled
def halve(picture: Array, smaller: Array) -> None:
    """Mean of each 2x2 texels, of the opaque ones only."""
    for j in range(smaller.shape[0]):
        for i in range(smaller.shape[1]):
            total = opaque = 0
            for texel in (
                picture[2 * j, 2 * i],
                picture[2 * j, 2 * i + 1],
                picture[2 * j + 1, 2 * i],
                picture[2 * j + 1, 2 * i + 1],
            ):
                total += int(texel)
                opaque += int(texel > 0)
            smaller[j, i] = total // opaque if opaque >= 2 else 0


def fractal_noise(size: int, finest: float = 2) -> Array:
    """Tile of noise with equal contrast in each octave, like stone and plants; mean 0, standard deviation 1.

    finest  texels of the shortest wave in it
    """
    frequency = np.hypot(np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size)[None, :])
    frequency[(frequency == 0) | (frequency > 1 / finest)] = np.inf
    white = np.random.default_rng(7).standard_normal((size, size))
    tile = np.fft.irfft2(np.fft.rfft2(white) / frequency, (size, size))
    scaled: Array = (tile / tile.std()).astype(np.float32)
    return scaled


@compiled
def chance(a: int, b: int) -> float:
    """A pseudorandom number in [0, 1) that depends only on a and b."""
    h = (a * 374761393 + b * 668265263 + 1274126177) & 0xFFFFFFFF
    h = ((h ^ (h >> 13)) * 1274126177) & 0xFFFFFFFF
    return ((h ^ (h >> 16)) & 0xFFFF) / 65536.0


@compiled
def put(luma: Array, u: Array, v: Array, j: int, i: int, y: float, blue: float, red: float) -> None:
    """Write one texel; its chroma (offsets from grey) counts where both coordinates are even."""
    luma[j, i] = np.uint8(min(max(y, 16.0), 235.0))
    if j % 2 == 0 and i % 2 == 0:
        u[j // 2, i // 2] = np.uint8(128.0 + blue)
        v[j // 2, i // 2] = np.uint8(128.0 + red)


@compiled
def draw_ground(
    luma: Array, u: Array, v: Array, noise: Array, period: float, length: float,
    xs: Array, ys: Array, cosines: Array, sines: Array, bends: Array, walls: Array,
) -> None:  # fmt: skip
    """Road, kerb, pavement and grass, seen from above; row 0 is y = 0 and the texture repeats both ways.

    xs ... bends  the course: position, direction and curvature at equal arc lengths
    walls         height of the houses on the right at the same places: their shadow falls on the street
    """
    rows, columns = luma.shape
    texel, samples = period / columns, len(xs) - 1
    step = length / samples
    below = np.searchsorted(xs, np.arange(columns) * texel)  # the sample at the same x
    for j in range(rows):
        nearest = -1
        for i in range(columns):
            x = i * texel
            if nearest < 0:
                nearest = below[i]
            s = d = 0.0
            for _ in range(3):
                lap, k = nearest // samples, nearest % samples
                dx, dy = x - xs[k] - lap * period, j * texel - ys[k]
                dy -= math.floor(dy / (rows * texel) + 0.5) * rows * texel
                along, d = dx * cosines[k] + dy * sines[k], dy * cosines[k] - dx * sines[k]
                if abs(d) > 12.0:
                    break
                s = nearest * step + along
                farther = math.floor(along / (1.0 - bends[k] * d) / step + 0.5)
                if farther == 0:
                    break
                nearest += farther
            if abs(d) > WALL_D + 0.6:
                nearest = -1
                put(luma, u, v, j, i, 80.0, -8.0, -5.0)
                continue
            fine, coarse = noise[0, j & 1023, i & 1023], noise[1, (j >> 1) & 1023, (i >> 1) & 1023]
            y, blue, red = surface(s % length, d, length, fine, coarse, chance(i, j) - 0.5)
            shadow = (WALL_D + d) / 0.87 * SUN_SLOPE - walls[nearest % samples]
            y = 16.0 + (y - 16.0) * (0.68 + 0.32 * min(max(shadow / 0.4 + 0.5, 0.0), 1.0))
            put(luma, u, v, j, i, y, blue, red)


@compiled
def surface(s: float, d: float, length: float, fine: float, coarse: float, grain: float) -> tuple[float, float, float]:
    """Luma, blue and red difference of the ground at arc length s and offset d."""
    a = abs(d)
    worn = 0.7 + 0.3 * min(max(0.9 + fine * 0.6, 0.0), 1.0)
    road = ROAD_D if d > 0 else PARKING_D
    kerb = road + 0.2
    if a < road:
        y = 92.0 + 2.5 * fine + 3.0 * coarse + 6.0 * grain - 4.0 * math.cos((a - 1.4) * 4.2) * (a < 2.8)
        crossing = 3.0 < s - 0.5 * length < 6.0 and a < PARKING_D and d % 1.0 < 0.5
        dash = a < 0.08 and s % 6.0 < 3.0
        bay = d > 0 and (abs(a - PARKING_D) < 0.06 or (a > PARKING_D and s % 6.0 < 0.1))
        if crossing or dash or bay:
            return 205.0 * worn + 12.0 * grain, 0.0, 0.0
        if d > PARKING_D:  # cobbles
            row = int(s / 0.16)
            across = d / 0.22 + 0.5 * (row & 1)
            joint = 40.0 if s / 0.16 % 1.0 < 0.14 or across % 1.0 < 0.1 else 0.0
            return 84.0 + 46.0 * chance(row, int(across)) + 9.0 * fine - joint, 0.0, 2.0
        patch = 9.0 if chance(int(s / 5.0), int(d + 9.0) // 3) > 0.8 else 0.0
        return y - patch, 1.0, -1.0
    if a < kerb:
        joint = 35.0 if s % 1.0 < 0.02 else 0.0
        return 158.0 + 6.0 * fine + 10.0 * grain - joint, -2.0, 1.0
    if a < PAVEMENT_D:
        across, along = (a - kerb) / 0.4, s / 0.4
        joint = 45.0 if across % 1.0 < 0.035 or along % 1.0 < 0.035 else 0.0
        tone = 22.0 * chance(int(across) + 5000 * int(d > 0), int(along)) - 11.0
        return 132.0 + tone + 9.0 * fine + 4.0 * coarse + 14.0 * grain - joint, -3.0, 2.0
    return 82.0 + 11.0 * fine + 8.0 * coarse + 20.0 * grain, -17.0 - 3.0 * fine, -12.0 + 3.0 * coarse


Houses = tuple[Array, Array, Array]  # index of the house at each metre of wall; its first metre; its height


def plan_houses(course: Course) -> Houses:
    """Split the left side of the street, in pieces of about 1 m, into houses 8 to 14 m wide and 2 or 3 floors high.

    The houses on the right are the same, offset by half a lap.
    """
    pieces = round(course.length_m)
    random = np.random.default_rng(20)
    starts = [0]
    while pieces - starts[-1] > 14:
        starts.append(starts[-1] + int(random.integers(8, min(14, pieces - starts[-1] - 7) + 1)))
    house = np.searchsorted(starts, np.arange(pieces), side="right") - 1
    return house, np.array([*starts, pieces]), 3.2 * random.integers(2, 4, len(starts)) + 0.9


def height_along(course: Course, houses: Houses) -> Array:
    """Height of the right wall beside each sample of the course."""
    house, _, heights = houses
    wall = arc_lengths(*course.beside(-WALL_D))
    piece = np.minimum((wall / wall[-1] * len(house)).astype(int), len(house) - 1)
    along: Array = heights[house[(piece + len(house) // 2) % len(house)]]
    return along


def arc_lengths(x: Array, y: Array) -> Array:
    """Length of a line from its start to each of its points."""
    return np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(x), np.diff(y)))])


@compiled
def draw_facade(
    luma: Array, u: Array, v: Array, noise: Array, texel: float, house: Array, starts: Array, heights: Array
) -> None:
    """Fronts of the houses of one side of the street; columns run along the street, rows up from the ground."""
    rows, columns = luma.shape
    piece = texel * columns / len(house)
    for j in range(rows):
        for i in range(columns):
            h = house[int(i * texel / piece)]
            x, width = i * texel - starts[h] * piece, (starts[h + 1] - starts[h]) * piece
            fine, coarse = noise[0, j & 1023, i & 1023], noise[1, (j >> 1) & 1023, (i >> 1) & 1023]
            grain = chance(i, j) - 0.5
            y, blue, red = front(x, j * texel, width, heights[h], h, fine, coarse)
            put(luma, u, v, j, i, y + 16.0 * grain, blue, red)


@compiled
def front(  # noqa: PLR0911  one for each thing that a front is made of
    x: float, z: float, width: float, height: float, h: int, fine: float, coarse: float
) -> tuple[float, float, float]:
    """Luma, blue and red difference of house number h at x from its edge and height z."""
    count = int(width / 2.4)
    pitch, floor = width / count, int(z / 3.2)
    column = int(x / pitch)
    across, up = abs(x - (column + 0.5) * pitch), z - 3.2 * floor
    luck = chance(h * 64 + column, floor + 7)
    if height - z < 0.5 or x < 0.12:  # eaves and downpipe
        return 78.0 + 4.0 * fine, 0.0, 3.0
    door = floor == 0 and column == h % count
    bottom, top = (0.0, 2.3) if door else (0.95, 2.55)
    if floor * 3.2 < height - 3.0 and across < 0.62 and bottom < up < top:
        if across > 0.54 or not bottom + 0.09 < up < top - 0.08 or (across < 0.035 and not door):
            return 206.0 + 4.0 * fine, 0.0, 0.0
        if door:
            return 70.0 + 8.0 * fine + 12.0 * (across % 0.2 < 0.02), 6.0 - 22.0 * luck, 14.0 * luck
        if luck > 0.55 and across > 0.28:  # curtain
            return 150.0 + 22.0 * math.cos(across * 70.0), -4.0, 2.0
        return 38.0 + 26.0 * (up - 0.95) + 34.0 * luck + 7.0 * coarse, 9.0, -5.0
    if not door and 0.82 < up < 0.95 and across < 0.72:  # sill
        return 188.0 + 5.0 * fine, -1.0, 1.0
    if floor > 0 and up < 0.14:
        return 176.0 + 5.0 * fine, -3.0, 2.0
    shade = 8.0 * fine + 5.0 * coarse - 22.0 * math.exp(-2.0 * z) - 26.0 * (z < 0.6)
    tint = chance(h, 3)
    if h % 4:  # brick
        row = int(z / 0.085)
        along = x / 0.26 + 0.5 * (row & 1)
        if z / 0.085 % 1.0 < 0.15 or along % 1.0 < 0.06:
            return 146.0 + shade, -4.0, 5.0
        return 92.0 + 26.0 * chance(row, int(along) + 977 * h) + 30.0 * tint + shade, -12.0, 20.0 + 8.0 * tint
    return 138.0 + 52.0 * tint + shade, -4.0 - 18.0 * chance(h, 4), 2.0 + 9.0 * chance(h, 5)


def draw_sky(planes: tuple[Array, Array, Array], noise: Array) -> None:
    """Clouds on a plane far above, seen from below."""
    luma, u, v = planes
    smooth = np.clip(noise[np.ix_(np.arange(2048) // 2, np.arange(2048) // 2)] * 0.6 + 0.1, 0, 1)
    luma[:] = 158 + 60 * smooth
    u[:] = (146 - 16 * smooth)[::2, ::2]
    v[:] = (114 + 13 * smooth)[::2, ::2]


def draw_things(atlas: Atlas, noise: Array, soft: Array) -> None:
    """Tree, lamp and parked cars."""
    z, x = np.mgrid[:512, :512] / 73.0
    luma, u, v = level_of(atlas, TREE, 0)
    crown = np.hypot((x - 3.5) / 1.1, z - 4.7) + 0.35 * soft[:512, :512] + 0.15 * noise[:512, :512] < 2.0
    trunk = (np.abs(x - 3.5) < 0.16 - 0.02 * z) & (z < 4)
    leaves = 78 + 14 * noise[256:768, 256:768] + 6 * soft[256:768, 256:768] + 7 * (z - 3)
    luma[:] = np.where(crown, np.clip(leaves, 20, 200), np.where(trunk, 62 + 10 * noise[:512, 512:], 0))
    green = (z > 2.2)[::2, ::2]  # also for transparent texels: chroma is coarser than the edge of the leaves
    u[:], v[:] = np.where(green, 108, 124), np.where(green, 117, 134)
    luma, u, v = level_of(atlas, LAMP, 0)
    x, z = x[:, :256] - 1.75, z[:, :256]
    head = (np.abs(x) < 0.9) & (np.abs(z - 5.9) < 0.08)
    luma[:] = np.where((np.abs(x) < 0.07) & (z < 5.9), 84 - 240 * x, np.where(head, 150, 0))
    u[:] = v[:] = 128
    luma, u, v = level_of(atlas, RAILING, 0)
    z, x = np.mgrid[:256, :256] / 102.4
    bars = ((x % 0.125 < 0.035) & (z < 1)) | (np.abs(z - 0.97) < 0.03) | (np.abs(z - 0.12) < 0.03)
    luma[:] = np.where(bars, 58 + 30 * (x % 0.125 < 0.015), 0)
    u[:] = v[:] = 128
    luma, u, v = level_of(atlas, HEDGE, 0)
    luma[:] = np.clip(74 + 24 * noise[:256] + 14 * np.mgrid[:256, :1024][0] / 100, 20, 200)
    u[:], v[:] = 110, 118
    for (texture, length, width, height), paint in zip(
        BOXES, ((208, 128, 128), (90, 118, 172), (72, 146, 118)), strict=True
    ):
        draw_box(level_of(atlas, texture, 0), length, height, paint, noise)
        draw_box(level_of(atlas, texture + 1, 0), width, height, paint, noise)


def draw_box(
    planes: tuple[Array, Array, Array], length: float, height: float, paint: tuple[int, int, int], noise: Array
) -> None:
    """Side or end of a parked car: windows, wheels, lamps, a seam for each door."""
    luma, u, v = planes
    z, x = np.mgrid[: luma.shape[0], : luma.shape[1]] / 100.0
    side = length > 3
    middle, wheel = np.abs(x - length / 2), length / 2 - 0.85
    glass = (np.abs(z - 0.76 * height) < 0.15 * height) & (middle < length / 2 - 0.15 - 0.5 * (z - 0.6 * height))
    if side:
        glass &= np.abs((x - 0.5) % 1.15 - 0.05) > 0.05
    wheels = (np.hypot(middle - wheel, z - 0.32) < 0.33) & side
    hubs = (np.hypot(middle - wheel, z - 0.32) < 0.19) & side
    lamps = (middle > length / 2 - (0.12 if side else 0.3)) & (np.abs(z - 0.5 * height) < 0.1)
    seam = side & (np.abs((x - 0.5) % 1.15 - 0.05) < 0.012) & (z < 0.6 * height)
    shine = paint[0] + 26 * (z / height - 0.5) + 1.5 * noise[: luma.shape[0], : luma.shape[1]] - 40 * seam
    body = np.where(z < 0.22, 34, np.where(glass, 44 + 30 * z / height, np.where(lamps, 170, shine)))
    luma[:] = np.clip(np.where(hubs, 150, np.where(wheels, 30, body)), 16, 235)
    grey = (glass | wheels | (z < 0.22))[::2, ::2]
    u[:], v[:] = np.where(grey, 128, paint[1]), np.where(grey, 128, paint[2])
