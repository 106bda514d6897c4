"""A camera's view of the street: one ray per pixel, fixed to the vehicle, traced on two levels.

Seen from above, every upright face covers a range of azimuths: per frame, `cover` sorts the nearest ones into a table
of azimuths. A ray then walks through the faces at its azimuth; if it misses them all, it hits the ground or the sky.
Rays are traced for every second pixel of every second row; between four that hit the same surface the place in the
texture is interpolated, at edges every pixel is traced.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from runner.clips import View
from runner.core.intrinsics import focal_px
from runner.core.mounting import Pose
from runner.synthetic.course import Array, plan_course
from runner.synthetic.faces import VISIBLE_M, stand_faces
from runner.synthetic.world import GROUND, LEVELS, RAILING, SKY, TREE, WALL, compiled, open_atlas

AZIMUTHS = 8192  # about a pixel of the sharpest usual view, 1920 over 90 degrees
LAYERS = 20  # faces kept per azimuth; farther ones are not visible
index = np.uintp  # tells the compiler that an index is not negative and does not count from the end
OWN_BODY = (((-0.95, -0.96, 0.3), (3.65, 0.96, 1.0)), ((-0.85, -0.8, 1.0), (2.3, 0.8, 1.68)))  # m, two corners each
GLOSS = 70  # light of the sky reflected in its paint, of 256
SOFT = 1.5  # levels per doubling of distance instead of 1: distant objects are blurred and do not flicker
SKY_M = 12.0  # height of the clouds, in metres of their texture


class Rays(NamedTuple):
    """Rays in the vehicle's frame, [row, column], for every second pixel and one more at the end.

    x, y     horizontal direction, unit length
    per_m    1 / distance at which it meets the ground; negative above the horizon
    azimuth  column in the table of azimuths
    level    mip level for the ground or the sky; -1 where the ray meets the vehicle itself
    """

    x: Array
    y: Array
    per_m: Array
    azimuth: Array
    level: Array


class Texels(NamedTuple):
    """An `Atlas` in the form that compiled code takes."""

    luma: Array
    u: Array
    v: Array
    base: Array
    log2_width: Array
    log2_height: Array
    per_m: Array


class Scene(NamedTuple):
    """Everything that a ray can hit in one frame; see `cover`, `Faces` and `Atlas`."""

    layers: Array
    planes: Array
    heights: Array
    textures: Array
    shades: Array
    boxes: Array
    eye: Array  # x, y, z in the world
    heading: Array  # cosine, sine
    atlas: Texels


def directions(view: View) -> Array:
    """Unit vector of every second pixel each way, [row, column, xyz] in the vehicle's axes (convention: `Pose`)."""
    yaw, pitch, roll = (math.radians(a) for a in (view.pose.yaw_deg, view.pose.pitch_deg, view.pose.roll_deg))
    forward = np.array([math.cos(yaw), math.sin(yaw), 0.0])
    right, down = np.array([math.sin(yaw), -math.cos(yaw), 0.0]), np.array([0.0, 0.0, -1.0])
    forward, down = (
        math.cos(pitch) * forward + math.sin(pitch) * down,
        math.cos(pitch) * down - math.sin(pitch) * forward,
    )
    right, down = math.cos(roll) * right + math.sin(roll) * down, math.cos(roll) * down - math.sin(roll) * right
    i = np.arange(0, view.width + 1, 2)[None, :] + 0.5 - view.width / 2
    j = np.arange(0, view.height + 1, 2)[:, None] + 0.5 - view.height / 2
    radius = np.hypot(i, j)
    angle = radius / focal_px(view.lens, view.fov_deg, view.width)
    if view.lens != "fisheye":
        angle = np.arctan(angle)
    aside = np.sin(angle) / radius
    unit: Array = np.cos(angle)[..., None] * forward + (aside * i)[..., None] * right + (aside * j)[..., None] * down
    return unit


def cast_rays(view: View, ground_per_m: float, sky_per_m: float) -> Rays:
    """The rays, which are the same in every frame; *_per_m are texels of level 0."""
    x, y, z = np.moveaxis(directions(view), -1, 0)
    own = hits_own_body(view.pose, x, y, z) if view.lens == "fisheye" else np.zeros(x.shape, bool)
    flat = np.maximum(np.hypot(x, y), 1e-5)
    x, y, per_m = x / flat, y / flat, -z / flat / view.pose.z_m
    per_m = np.where(np.abs(per_m) < 1e-5, -1e-5, per_m)
    azimuth = np.floor(np.arctan2(y, x) / (2 * math.pi) * AZIMUTHS).astype(np.int32) % AZIMUTHS
    texels = np.where(per_m > 0, ground_per_m, sky_per_m * SKY_M / view.pose.z_m) / np.abs(per_m)
    plane = np.stack([x * texels, y * texels])
    steps = [np.hypot(*np.gradient(plane, 2.0, axis=axis)) for axis in (1, 2)]
    # Between the sides of a pixel's footprint: the longer one blurs the road ahead, the shorter one makes it flicker.
    size = np.maximum(*steps) ** 0.85 * np.minimum(*steps) ** 0.15
    level = np.clip(np.floor(SOFT * np.log2(np.maximum(size, 1e-3)) + 0.85), 0, LEVELS - 1).astype(np.int32)
    level = np.where(own, -1, level).astype(np.int32)
    x, y, per_m = (np.ascontiguousarray(a, np.float32) for a in (x, y, per_m))
    return Rays(x, y, per_m, azimuth, level)


def hits_own_body(pose: Pose, x: Array, y: Array, z: Array) -> Array:
    """Which rays of a camera outside the vehicle hit the vehicle: a box for the body, one for the cabin."""
    eye, hit = (pose.x_m, pose.y_m, pose.z_m), np.zeros(x.shape, bool)
    for low, high in OWN_BODY:
        if all(a < b < c for a, b, c in zip(low, eye, high, strict=True)):
            continue
        enter, leave = np.zeros(x.shape), np.full(x.shape, np.inf)
        for along, a, b, c in zip((x, y, z), low, eye, high, strict=True):
            ray = np.where(np.abs(along) < 1e-9, 1e-9, along)
            first, second = (a - b) / ray, (c - b) / ray
            enter, leave = np.maximum(enter, np.minimum(first, second)), np.minimum(leave, np.maximum(first, second))
        hit |= enter < leave
    return hit


def pictures(view: View, seconds: float, world: Path) -> Iterator[bytes]:
    """All frames of a clip as I420."""
    course = plan_course(seconds)
    atlas, faces = open_atlas(course, world, "r"), stand_faces(course)
    texels = Texels(*(np.asarray(getattr(atlas, name)) for name in Texels._fields))
    rays = cast_rays(view, float(atlas.per_m[GROUND]), float(atlas.per_m[SKY]))
    turn = (np.arange(AZIMUTHS) + 0.5) * (2 * math.pi / AZIMUTHS)
    compass = np.stack([np.cos(turn), np.sin(turn)]).astype(np.float32)
    layers, distance = np.empty((AZIMUTHS, LAYERS), np.int32), np.empty((AZIMUTHS, LAYERS), np.float32)
    planes = np.empty((len(faces.box), 4), np.float32)
    count = view.width * view.height
    picture = np.empty(count * 3 // 2, np.uint8)
    luma = picture[:count].reshape(view.height, view.width)
    chroma = picture[count:].reshape(2, view.height // 2, view.width // 2)
    mount, frames = view.pose, view.frames(seconds)
    for frame in range(frames):
        x, y, heading = course.at(frame / frames)
        cos, sin = math.cos(heading), math.sin(heading)
        eye = np.array([x + cos * mount.x_m - sin * mount.y_m, y + sin * mount.x_m + cos * mount.y_m, mount.z_m])
        pixel = 0.8 / focal_px(view.lens, view.fov_deg, view.width)
        cover(
            layers, distance, planes, faces.ends, faces.along_m, faces.texture,
            eye, cos, sin, compass, pixel, atlas.per_m,
        )  # fmt: skip
        scene = Scene(
            layers, planes, faces.height_m, faces.texture, faces.shade, faces.box,
            eye.astype(np.float32), np.array([cos, sin], np.float32), texels,
        )  # fmt: skip
        draw(luma, chroma[0], chroma[1], rays, scene)
        yield picture.tobytes()


@compiled
def cover(
    layers: Array, distance: Array, planes: Array, ends: Array, along: Array, texture: Array,
    eye: Array, cos: float, sin: float, compass: Array, pixel: float, per_m: Array,
) -> None:  # fmt: skip
    """For each azimuth, the faces that it meets, nearest first, as face * 16 + mip level; -1 ends the list.

    distance  buffer for the distances of the same faces
    planes    out: [face, (nx, ny, tx, ty)]: a ray r meets the face at distance 1 / (n . r), and the place in the
              texture is t . r times that distance
    pixel     radians that a pixel covers
    """
    layers[:] = -1
    for f in range(len(ends)):
        ax, ay, bx, by = ends[f, 0] - eye[0], ends[f, 1] - eye[1], ends[f, 2] - eye[0], ends[f, 3] - eye[1]
        if max(abs(ax), abs(ay)) > VISIBLE_M:
            continue
        ax, ay, bx, by = cos * ax + sin * ay, cos * ay - sin * ax, cos * bx + sin * by, cos * by - sin * bx
        length = math.hypot(bx - ax, by - ay)
        tx, ty = (bx - ax) / length, (by - ay) / length
        away = ay * tx - ax * ty  # signed distance of the face's line from the eye
        if abs(away) < 0.02:
            continue
        start = along[f] - (tx * ax + ty * ay)
        nx, ny = -ty / away, tx / away
        planes[f, 0], planes[f, 1] = nx, ny
        planes[f, 2], planes[f, 3] = tx + start * nx, ty + start * ny
        first, last = math.atan2(ay, ax), math.atan2(by, bx)
        if away > 0:
            first, last = last, first
        if last < first:
            last += 2 * math.pi
        begin = math.ceil(first / (2 * math.pi) * AZIMUTHS - 0.5)
        end = math.ceil(last / (2 * math.pi) * AZIMUTHS - 0.5)
        for column in range(begin, end):
            k = column % AZIMUTHS
            near = nx * compass[0, k] + ny * compass[1, k]
            if near < 0.004:
                continue
            far = 1 / near
            slot = LAYERS
            while slot > 0 and (layers[k, slot - 1] < 0 or distance[k, slot - 1] > far):
                slot -= 1
            behind_wall = slot > 0 and texture[layers[k, slot - 1] >> 4] == WALL != texture[f]
            if slot == LAYERS or behind_wall:  # everything is lower than any wall
                continue
            for s in range(LAYERS - 1, slot, -1):
                layers[k, s], distance[k, s] = layers[k, s - 1], distance[k, s - 1]
            upright = far * pixel * per_m[texture[f]]
            slanted = min(far * near * near * far / max(abs(away) * near, 0.05), 8.0)
            level = int(min(max(SOFT * math.log2(upright * slanted) + 1.0, 0.0), LEVELS - 1.0))
            layers[k, slot], distance[k, slot] = f * 16 + level, far


@compiled
def draw(luma: Array, chroma_u: Array, chroma_v: Array, rays: Rays, scene: Scene) -> None:
    """Fill one picture, block by block of 2x2 pixels between four traced rays."""
    rows, columns = chroma_u.shape
    hits = np.empty((2, 3, columns + 1), np.int32)  # above and below the current row of blocks, in turn
    edges, single = np.empty(columns, np.int32), np.empty((3, 4 * columns), np.int32)
    slopes, tables = np.empty((3, 4 * columns), np.float32), np.empty((2, 4 * columns), np.int32)
    trace(rays.x[0], rays.y[0], rays.per_m[0], rays.azimuth[0], rays.level[0], scene, hits[0])
    for j in range(rows):
        n, pair = j + 1, luma[2 * j : 2 * j + 2]
        trace(rays.x[n], rays.y[n], rays.per_m[n], rays.azimuth[n], rays.level[n], scene, hits[n & 1])
        count = fill_blocks(hits, j & 1, scene.atlas, pair, chroma_u[j], chroma_v[j], edges)
        cast_between(rays, j, edges[:count], slopes, tables)
        x, y, per_m = slopes[0, : 4 * count], slopes[1, : 4 * count], slopes[2, : 4 * count]
        trace(x, y, per_m, tables[0, : 4 * count], tables[1, : 4 * count], scene, single)
        fill_edges(edges[:count], single, scene.atlas, pair)


@compiled
def trace(x: Array, y: Array, per_m: Array, azimuth: Array, level: Array, scene: Scene, hits: Array) -> None:
    """What each ray of a row hits.

    level  for the ground and the sky
    hits   out: [surface, place along, place up][ray]; surface is (texture, mip level, light) in one number, the place
           is in 1/256 texels of that level
    """
    layers, planes, heights, textures = scene.layers, scene.planes, scene.heights, scene.textures
    shades, boxes, texels, base = scene.shades, scene.boxes, scene.atlas.luma, scene.atlas.base
    log2_width, log2_height = scene.atlas.log2_width, scene.atlas.log2_height
    fine, one, clouds = scene.atlas.per_m * np.float32(256), np.float32(1), np.float32(-SKY_M) / scene.eye[2]
    eye_x, eye_y, eye_z, cos, sin = scene.eye[0], scene.eye[1], scene.eye[2], scene.heading[0], scene.heading[1]
    texture: Any  # to the types of NumPy 2.5, a number of 32 bits can neither be shifted nor become an int
    mip: Any
    along: Any
    up: Any
    surface: Any
    for i in range(len(x)):
        before, surface = np.int32(-1), np.int32(-1)
        for slot in range(LAYERS):
            entry = layers[index(azimuth[i]), index(slot)]
            if entry < 0 or level[i] < 0:
                break
            f, mip = index(entry >> 4), entry & 15
            away = one / (planes[f, 0] * x[i] + planes[f, 1] * y[i])
            z, box, top = eye_z * (one - away * per_m[i]), boxes[f], heights[f]
            roof = box >= 0 and box == before and z < top  # over the near side, under the top of the far one
            before = box
            if z < 0 and not roof:
                break
            if z > top:
                continue
            texture = textures[f]
            scale = fine[index(texture)] / np.float32(1 << mip)
            along = np.int32(away * (planes[f, 2] * x[i] + planes[f, 3] * y[i]) * scale)
            up = np.int32((top * np.float32(0.97) if roof else z) * scale)
            if TREE <= texture <= RAILING:
                width, height = log2_width[texture] - mip, log2_height[texture] - mip
                row = ((up >> 8) & ((1 << height) - 1)) << width
                if texels[index(base[texture, mip] + row + ((along >> 8) & ((1 << width) - 1)))] == 0:
                    continue
            hits[1, i], hits[2, i] = along - 128, max(up - 128, 0)
            surface = ((texture * 16 + mip) << 9) + (270 if roof else shades[f])
            break
        if surface < 0:
            own = level[i] < 0
            scale = -abs(one / per_m[i]) if own else one / per_m[i]  # its paint mirrors the sky
            ahead, left = (cos * x[i] - sin * y[i]) * scale, (sin * x[i] + cos * y[i]) * scale
            if scale > 0:
                texture, ahead, left = np.int32(GROUND), ahead + eye_x, left + eye_y
            else:
                texture, ahead, left = np.int32(SKY), ahead * clouds, left * clouds
            mip = np.int32(4) if own else level[i]
            scale = fine[texture] / np.float32(1 << mip)
            surface = ((texture * 16 + mip) << 9) + (GLOSS if own else 256)
            hits[1, i], hits[2, i] = np.int32(ahead * scale) - 128, np.int32(left * scale) - 128
        hits[0, i] = surface


@compiled
def fill_blocks(
    hits: Array, top: int, atlas: Texels, luma: Array, chroma_u: Array, chroma_v: Array, edges: Array
) -> int:
    """Fill the blocks whose corners are all on one surface; of the others, only the chroma that their own ray hit.

    hits     of two rows, `top` is the index of the upper one
    luma     out: two rows of pixels
    edges    out: columns of the other blocks
    returns  how many those are
    """
    texels, texels_u, texels_v, bases = atlas.luma, atlas.u, atlas.v, atlas.base
    log2_width, log2_height = atlas.log2_width, atlas.log2_height
    low, count = 1 - top, 0
    for i in range(len(chroma_u)):
        surface, u, v = hits[top, 0, i], hits[top, 1, i], hits[top, 2, i]
        texture, level, shade = surface >> 13, (surface >> 9) & 15, surface & 511
        width, height = log2_width[texture] - level, log2_height[texture] - level
        across, upward, base = (1 << width) - 1, (1 << height) - 1, bases[texture, level]
        at = (base >> 2) + (((v >> 9) & (upward >> 1)) << (width - 1)) + ((u >> 9) & (across >> 1))
        chroma_u[i] = 128 + (((texels_u[at] - 128) * shade) >> 8)
        chroma_v[i] = 128 + (((texels_v[at] - 128) * shade) >> 8)
        same = surface == hits[top, 0, i + 1] and surface == hits[low, 0, i] and surface == hits[low, 0, i + 1]
        # If far apart on one surface, the texture repeats in between, or another part of it is in front.
        near = abs(u - hits[low, 1, i + 1]) + abs(hits[top, 1, i + 1] - hits[low, 1, i]) < 6144
        if not (same and near) or TREE <= texture <= RAILING:
            edges[count] = i
            count += 1
            continue
        for corner in range(4):
            row, column = top ^ (corner >> 1), i + (corner & 1)
            pu, pv = (u + hits[row, 1, column]) >> 1, (v + hits[row, 2, column]) >> 1
            x0, x1, row0 = (pu >> 8) & across, ((pu >> 8) + 1) & across, base + (((pv >> 8) & upward) << width)
            row1, wx, wy = base + ((((pv >> 8) + 1) & upward) << width), pu & 255, pv & 255
            upper = texels[index(row0 + x0)] * (256 - wx) + texels[index(row0 + x1)] * wx
            lower = texels[index(row1 + x0)] * (256 - wx) + texels[index(row1 + x1)] * wx
            value = (upper * (256 - wy) + lower * wy) >> 16
            luma[corner >> 1, 2 * i + (corner & 1)] = min(16 + (((value - 16) * shade) >> 8), 235)
    return count


@compiled
def cast_between(rays: Rays, j: int, edges: Array, slopes: Array, tables: Array) -> None:
    """The rays of all four pixels of some blocks in row j; out: x, y, per_m and azimuth, level."""
    half = np.float32(0.5)
    for n in range(len(edges)):
        i = edges[n]
        for corner in range(4):
            k, row, column = 4 * n + corner, j + (corner >> 1), i + (corner & 1)
            slopes[0, k] = (rays.x[j, i] + rays.x[row, column]) * half
            slopes[1, k] = (rays.y[j, i] + rays.y[row, column]) * half
            per_m = (rays.per_m[j, i] + rays.per_m[row, column]) * half
            slopes[2, k] = per_m if abs(per_m) > np.float32(1e-5) else np.float32(-1e-5)
            apart = ((rays.azimuth[row, column] - rays.azimuth[j, i] + AZIMUTHS // 2) & (AZIMUTHS - 1)) - AZIMUTHS // 2
            tables[0, k] = (rays.azimuth[j, i] + (apart >> 1)) & (AZIMUTHS - 1)
            tables[1, k] = rays.level[j, i]


@compiled
def fill_edges(edges: Array, hits: Array, atlas: Texels, luma: Array) -> None:
    """Fill all four pixels of some blocks; at the edge of a cut-out only the nearest texel counts."""
    texels, bases, log2_width, log2_height = atlas.luma, atlas.base, atlas.log2_width, atlas.log2_height
    for n in range(len(edges)):
        for corner in range(4):
            surface, u, v = hits[0, 4 * n + corner], hits[1, 4 * n + corner], hits[2, 4 * n + corner]
            texture, level, shade = surface >> 13, (surface >> 9) & 15, surface & 511
            width, base = log2_width[texture] - level, bases[texture, level]
            across, upward = (1 << width) - 1, (1 << (log2_height[texture] - level)) - 1
            x0, x1, row0 = (u >> 8) & across, ((u >> 8) + 1) & across, base + (((v >> 8) & upward) << width)
            row1, wx, wy = base + ((((v >> 8) + 1) & upward) << width), u & 255, v & 255
            p, q = texels[index(row0 + x0)], texels[index(row0 + x1)]
            r, s = texels[index(row1 + x0)], texels[index(row1 + x1)]
            if min(p, q, r, s) == 0:
                wx, wy = (wx + 128) & 256, (wy + 128) & 256
            value = ((p * (256 - wx) + q * wx) * (256 - wy) + (r * (256 - wx) + s * wx) * wy) >> 16
            luma[corner >> 1, 2 * edges[n] + (corner & 1)] = min(16 + (((value - 16) * shade) >> 8), 235)
