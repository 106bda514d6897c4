/** A straightened fisheye image, checked against values computed by hand. */

import assert from "node:assert/strict";
import { test } from "node:test";

import { projection, sightline } from "../../runner/page/static/projection.js";
import { canStraighten, straightMesh, straightOptics } from "../../runner/page/static/straight.js";

const NATIVE = { width: 1280, height: 800, left: 0, top: 0 };
const POSE = { x_m: 2, y_m: 0, z_m: 1, yaw_deg: 0, pitch_deg: 0, roll_deg: 0 };
const FISHEYE = { pose: POSE, fov_deg: 180, lens: /** @type {const} */ ("fisheye"), native: NATIVE, width: 1280, height: 800 };
const near = (found, expected, within = 1e-6) => {
  for (const key of Object.keys(expected)) assert.ok(Math.abs(found[key] - expected[key]) < within, `${key}: ${found[key]}, not ${expected[key]}`);
};

test("a pinhole of 90 degrees looks along its axis, and 45 degrees to both sides", () => {
  const seen = sightline({ ...FISHEYE, lens: "pinhole", fov_deg: 90 });
  near(seen({ x: 640, y: 400 }), { x: 3, y: 0, z: 1 });
  near(seen({ x: 0, y: 400 }), { x: 3, y: 1, z: 1 });
  near(seen({ x: 1280, y: 720 }), { x: 3, y: -1, z: 0.5 });
});

test("a crop and a turned camera are taken into account", () => {
  const cropped = sightline({ pose: { ...POSE, yaw_deg: 90 }, fov_deg: 90, lens: "pinhole", native: { ...NATIVE, left: 40, top: 100 } });
  near(cropped({ x: 600, y: 300 }), { x: 2, y: 1, z: 1 });
  near(cropped({ x: 1240, y: 300 }), { x: 3, y: 1, z: 1 });
});

test("the straightened image spans at most 100 degrees, and keeps the middle", () => {
  assert.equal(straightOptics(FISHEYE).fov_deg, 100);
  assert.equal(straightOptics({ ...FISHEYE, fov_deg: 80 }).fov_deg, 80);
  const { places, points } = straightMesh(FISHEYE);
  const at = (x, y) => points[places.findIndex((place) => Math.abs(place.x - x) < 1e-9 && Math.abs(place.y - y) < 1e-9)];
  near(at(640, 400), { x: 640, y: 400 });
  near(at(1280, 400), { x: 640 + (50 / 90) * 640, y: 400 }); // equal angles take equal numbers of px
  const down = Math.atan((400 / 640) * Math.tan((50 * Math.PI) / 180));
  near(at(640, 800), { x: 640, y: 400 + (down / (Math.PI / 2)) * 640 });
});

test("between vertices the image has an error below 0.2 px", () => {
  const { places, points } = straightMesh(FISHEYE);
  const exact = (place) => projection(FISHEYE)(sightline(straightOptics(FISHEYE))(place));
  for (let i = 0; i + 1 < places.length; i += 7) {
    if (places[i + 1].x < places[i].x) continue;
    const [a, b] = [points[i], points[i + 1]];
    assert.ok(a && b);
    near({ x: (a.x + b.x) / 2, y: (a.y + b.y) / 2 }, exact({ x: (places[i].x + places[i + 1].x) / 2, y: places[i].y }) ?? {}, 0.2);
  }
});

test("the camera's pose does not affect the straightened image", () => {
  const moved = straightMesh({ ...FISHEYE, pose: { ...POSE, x_m: -1, yaw_deg: 130, pitch_deg: 35, roll_deg: 4 } });
  const unknown = straightMesh({ ...FISHEYE, pose: null });
  for (const mesh of [moved, unknown]) for (const [i, point] of straightMesh(FISHEYE).points.entries()) near(mesh.points[i], { ...point }, 1e-6);
});

test("only a fisheye is straightened", () => {
  assert.equal(canStraighten(FISHEYE), true);
  assert.equal(canStraighten({ lens: "pinhole" }), false);
});
