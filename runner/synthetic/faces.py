"""What stands along the street of the synthetic drive: upright faces of houses, plants, lamps and parked cars."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from runner.synthetic.course import Array, Course
from runner.synthetic.world import (
    BOXES,
    HEDGE,
    LAMP,
    PARKING_D,
    RAILING,
    ROAD_D,
    TREE,
    WALL,
    WALL_D,
    arc_lengths,
    plan_houses,
)

HEDGE_D, TREE_D = 6.8, 6.0
VISIBLE_M = 140.0  # the street repeats up to this distance
SUN = np.array([0.5, -0.87])  # horizontal direction to the sun


@dataclass(frozen=True)
class Faces:
    """Upright rectangles from a to b, standing on the ground; walls come first.

    ends     [face, (ax, ay, bx, by)]
    along_m  where the face begins in its texture
    shade    256 is the texture's own brightness
    box      number of the box that the face belongs to, -1 for none
    """

    ends: Array
    along_m: Array
    height_m: Array
    texture: Array
    shade: Array
    box: Array


def stand_faces(course: Course) -> Faces:
    """Walls, trees, lamps and parked cars of as many laps as can be seen from one."""
    rows = [*wall_faces(course, 1), *wall_faces(course, -1), *things_beside(course)]
    one = np.array(rows, np.float64)
    reach = math.ceil(VISIBLE_M / course.period_m)
    laps = []
    for number, lap in enumerate(range(-reach, reach + 2)):
        moved = one.copy()
        moved[:, [0, 2]] += lap * course.period_m
        moved[:, 8] = np.where(one[:, 8] < 0, -1, one[:, 8] + 1000 * number)
        laps.append(moved)
    faces = np.concatenate(laps)
    faces = faces[np.argsort(faces[:, 6] != WALL, kind="stable")]
    return Faces(
        faces[:, :4],
        faces[:, 4],
        faces[:, 5].astype(np.float32),
        faces[:, 6].astype(np.int32),
        faces[:, 7].astype(np.int32),
        faces[:, 8].astype(np.int32),
    )


FaceRow = tuple[float, ...]  # ax, ay, bx, by, along_m, height_m, texture, shade, box


def face(
    a: tuple[float, float], b: tuple[float, float], along: float, height: float, texture: int, box: int
) -> FaceRow:
    """One face, lit by the sun if its right-hand side (seen from a to b) faces it."""
    direction = np.array([b[1] - a[1], a[0] - b[0]]) / max(math.dist(a, b), 1e-9)
    light = 256 * (0.86 + 0.16 * max(0.0, float(direction @ SUN)))
    return (*a, *b, along, height, texture, light, box)


def wall_faces(course: Course, side: int) -> list[FaceRow]:
    """Fronts of one side of the street, in pieces of equal length, so that no window is stretched in a bend."""
    house, _, heights = plan_houses(course)
    x, y = course.beside(side * WALL_D)
    lengths = arc_lengths(x, y)
    at = np.linspace(0, lengths[-1], len(house) + 1)
    points = list(zip(np.interp(at, lengths, x).tolist(), np.interp(at, lengths, y).tolist(), strict=True))
    step = course.length_m / len(house)
    rows: list[FaceRow] = []
    for k, (a, b) in enumerate(pairwise(points)):
        from_left = k if side > 0 else (k + len(house) // 2) % len(house)
        height = float(heights[house[from_left]])
        lit = face(a, b, 0, 0, 0, 0)[7] if side > 0 else face(b, a, 0, 0, 0, 0)[7]
        rows.append((*a, *b, from_left * step, height, WALL, lit, -1))
    return rows


def things_beside(course: Course) -> list[FaceRow]:
    """Hedges, railings, trees and lamps on the pavement, cars and vans in some of the parking bays of 6 m."""
    random = np.random.default_rng(3)
    rows: list[FaceRow] = []
    for bay in range(int(course.length_m / 6)):
        for side in (-1, 1):
            s = 6 * bay + 3.05
            crossing = abs(s - 0.5 * course.length_m - 4.5) < 5
            rows += strip(course, 6 * bay, side * HEDGE_D, HEDGE, 1.0)
            if not crossing:
                rows += strip(course, 6 * bay + 0.7, ROAD_D + 0.3 if side > 0 else -PARKING_D - 0.3, RAILING, 1.0)
            if side > 0 and random.random() < 0.5 and not crossing:
                rows += parked(course, s, 4.15, bay, BOXES[(bay + bay // 3) % len(BOXES)])
            if side > 0 or bay % 2 == 0:
                rows += upright(course, s - 3, side * TREE_D, *((LAMP, 3.5, 7) if bay % 3 == 2 else (TREE, 5.8, 5.8)))
    return rows


def at_offset(course: Course, s: float, d: float) -> tuple[float, float, float]:
    """Point beside the course, and the direction of the course there."""
    x, y, psi = (float(np.interp(s, course.s, values)) for values in (course.x, course.y, course.psi))
    return x - d * math.sin(psi), y + d * math.cos(psi), psi


def parked(course: Course, s: float, d: float, box: int, kind: tuple[int, float, float, float]) -> list[FaceRow]:
    """The four sides of a box, anticlockwise, so that each one's right-hand side faces outward."""
    texture, length, width, height = kind
    x, y, psi = at_offset(course, s, d)
    forward = np.array([math.cos(psi), math.sin(psi)])
    left = np.array([-forward[1], forward[0]])
    corners = [
        tuple((np.array([x, y]) + i * length / 2 * forward + j * width / 2 * left).tolist())
        for i, j in ((-1, -1), (1, -1), (1, 1), (-1, 1))
    ]
    return [face(corners[k], corners[(k + 1) % 4], 0, height, texture + k % 2, box) for k in range(4)]


def strip(course: Course, s: float, d: float, texture: int, height: float) -> list[FaceRow]:
    """Hedge of a front garden or railing at the kerb, 4.5 m long, in pieces that follow the bend."""
    ends = [at_offset(course, s + 1.5 * piece, d)[:2] for piece in range(4)]
    if d < 0:
        ends.reverse()  # its right-hand side is the street's
    return [face(a, b, s + 1.5 * piece, height, texture, -1) for piece, (a, b) in enumerate(pairwise(ends))]


def upright(course: Course, s: float, d: float, texture: int, width: float, height: float) -> list[FaceRow]:
    """Two crossed cut-outs, which look like a tree or a lamp from every side."""
    x, y, psi = at_offset(course, s, d)
    rows: list[FaceRow] = []
    for turn in (0.6, 0.6 + math.pi / 2):
        dx, dy = width / 2 * math.cos(psi + turn), width / 2 * math.sin(psi + turn)
        rows.append((x - dx, y - dy, x + dx, y + dy, 0.0, height - 0.01, float(texture), 240.0, -1.0))
    return rows
