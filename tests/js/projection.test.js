/** Where places around the vehicle appear in a camera's image, checked against values computed by hand. */

import assert from "node:assert/strict";
import { test } from "node:test";

import { projection } from "../../runner/page/static/projection.js";

const NATIVE = { width: 1920, height: 1040, left: 0, top: 0 };
const POSE = { x_m: 2, y_m: 0, z_m: 1.5, yaw_deg: 0, pitch_deg: 0, roll_deg: 0 };
const camera = (pose = {}, { fov_deg = 90, lens = "pinhole", native = {} } = {}) =>
  projection({ pose: { ...POSE, ...pose }, fov_deg, lens: /** @type {any} */ (lens), native: { ...NATIVE, ...native } });
const near = (found, x, y) => assert.ok(found && Math.hypot(found.x - x, found.y - y) < 1e-6, `${JSON.stringify(found)}, not ${x}, ${y}`);
const place = (x, y, z = 0) => ({ x, y, z });

// A pinhole of 90 degrees: 960 px are one unit of tangent.
const PINHOLE = [
  ["on the axis", {}, place(12, 0, 1.5), 960, 520],
  ["10 m ahead on the ground", {}, place(12, 0), 960, 520 + 960 * 0.15],
  ["1 m to the left of it", {}, place(12, 1), 960 - 96, 520 + 144],
  ["at the rim", {}, place(12, 10, 1.5), 0, 520],
  ["seen by a camera that looks left", { yaw_deg: 90 }, place(3, 10), 960 + 96, 520 + 144],
  ["seen by a camera that looks back", { x_m: -1, yaw_deg: 180 }, place(-11, 1), 960 + 96, 520 + 144],
  ["on the axis of one that looks down by 45 degrees", { pitch_deg: 45 }, place(3.5, 0), 960, 520],
  ["straight on, seen by it", { pitch_deg: 45 }, place(12, 0, 1.5), 960, 520 - 960],
  ["to the right, of a camera that lies on its right side", { roll_deg: 90 }, place(12, -1, 1.5), 960, 520 - 96],
  ["above, of a camera that lies on its right side", { roll_deg: 90 }, place(12, 0, 2.5), 960 - 96, 520],
];
for (const [what, pose, where, x, y] of PINHOLE) test(`pinhole: ${what}`, () => near(camera(pose)(where), x, y));

// A fisheye of 180 degrees: 960 px are a quarter turn.
const FISHEYE = [
  ["on the axis", {}, place(12, 0, 1.5), 960, 520],
  ["a quarter turn to the left", {}, place(2, 7, 1.5), 0, 520],
  ["45 degrees to the right", {}, place(5, -3, 1.5), 960 + 480, 520],
  ["straight below", {}, place(2, 0), 960, 520 + 960],
  ["30 degrees behind the left", {}, place(2 - 1, Math.sqrt(3), 1.5), 960 - (120 / 90) * 960, 520],
  ["straight below one that looks down by 45 degrees", { pitch_deg: 45 }, place(2, 0), 960, 520 + 480],
  ["60 degrees to the left and up", {}, place(3, Math.sqrt(1.5), 1.5 + Math.sqrt(1.5)), 960 - 640 * Math.SQRT1_2, 520 - 640 * Math.SQRT1_2],
];
for (const [what, pose, where, x, y] of FISHEYE) test(`fisheye: ${what}`, () => near(camera(pose, { fov_deg: 180, lens: "fisheye" })(where), x, y));

test("the full image begins where it is cut out of the native one, whose width the field of view spans", () => {
  const cropped = camera({}, { native: { width: 1920, height: 1080, left: 100, top: 40 } });
  near(cropped(place(12, 1)), 960 - 96 - 100, 540 + 144 - 40);
});

test("places behind the camera have no image", () => {
  for (const where of [place(-5, 0), place(-5, 3), place(2, 4), place(2, 0)]) assert.equal(camera()(where), null);
  const fisheye = camera({}, { fov_deg: 200, lens: "fisheye" });
  assert.equal(fisheye(place(-5, 0, 1.5)), null);
  assert.equal(fisheye(place(-5, 0.5, 1.5)), null);
  assert.notEqual(fisheye(place(-1, 3)), null);
});
