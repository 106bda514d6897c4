/** The ground around the vehicle: what hides it, which picture is used where, and its placement on the screen. */

import assert from "node:assert/strict";
import { test } from "node:test";

import { apart, crosses, groundOf, groundPlacement, latticeOf, outline, sharesOf, sightOf, trianglesOf } from "../../runner/page/static/ground.js";

const CAR = { wheelbase_m: 2.9, track_m: 1.6, width_m: 2, front_m: 4, rear_m: 1 };
const NATIVE = { width: 1280, height: 800, left: 0, top: 0 };
const FULL = { x: 0, y: 0, width: 1280, height: 800 };
const camera = (x_m, y_m, z_m, yaw_deg, pitch_deg) =>
  ({ pose: { x_m, y_m, z_m, yaw_deg, pitch_deg, roll_deg: 0 }, fov_deg: 180, lens: /** @type {const} */ ("fisheye"), native: NATIVE });
const AROUND = [camera(4.1, 0, 0.9, 0, 35), camera(2, 1.1, 1.1, 90, 35), camera(2, -1.1, 1.1, -90, 35), camera(-1.1, 0, 0.9, 180, 35)];
const place = (x, y) => ({ x, y, z: 0 });
const near = (found, expected, within = 1e-9) => assert.ok(Math.abs(found - expected) < within, `${found}, not ${expected}`);

test("9 m on every side of the vehicle are shown, in cells of at most 0.3 m", () => {
  const { extent, width, height } = groundOf(CAR);
  assert.deepEqual([extent, width, height], [{ rear: -10, front: 13, right: -10, left: 10 }, 20, 23]);
  const { places, columns, rows } = latticeOf(extent);
  assert.equal(places.length, columns * rows);
  assert.deepEqual([places[0], places[places.length - 1]], [place(-10, -10), place(13, 10)]);
  for (const [from, to, key] of /** @type {[number, number, "x"|"y"][]} */ ([[0, 1, "y"], [0, columns, "x"]])) {
    const step = places[to][key] - places[from][key];
    assert.ok(step > 0.29 && step < 0.3 + 1e-9, `${step}`);
  }
});

const BODY = outline(CAR);
const LINES = [
  ["through the vehicle", place(5, 0), place(-2, 0), true],
  ["past its side", place(5, 1.5), place(-2, 1.5), false],
  ["along its side", place(5, 1), place(-2, 1), false],
  ["that ends before it", place(6, 0), place(4.5, 0), false],
  ["that ends at its front", place(6, 0), place(4, 0), false],
  ["over a corner", place(5, 0), place(3, 2), false],
  ["through a corner", place(4.5, 0), place(3, 1.2), true],
  ["inside it", place(1, 0), place(1, 0), true],
  ["out of it", place(1, 0), place(9, 0), true],
];
for (const [what, a, b, expected] of /** @type {[string, any, any, boolean][]} */ (LINES))
  test(`a line ${what} ${expected ? "crosses" : "does not cross"} the outline`, () => {
    assert.equal(crosses(a, b, BODY), expected);
    assert.equal(crosses(b, a, BODY), expected);
  });

test("the vehicle hides what is behind it from a camera on its outside, and nothing from one above it", () => {
  const places = [place(9, 0), place(-5, 0), place(-5, 4)];
  assert.deepEqual(sightOf(AROUND[0], CAR, places).near.map((each) => each > 0), [true, false, false]);
  assert.deepEqual(sightOf(camera(2, 0, 2.5, 0, 60), CAR, places).near.map((each) => each > 0), [true, true, true]);
});

/** Shares of the four cameras at places. */
const sharesAt = (places, regions = AROUND.map(() => FULL)) => {
  const shares = sharesOf(AROUND.map((each) => sightOf(each, CAR, places)), regions);
  return places.map((_, i) => shares.map((each) => each[i]));
};

test("each camera shows what is in front of it", () => {
  const found = sharesAt([place(8, 0), place(2, 5), place(2, -5), place(-5, 0)]);
  for (const [i, shares] of found.entries()) near(shares[i], 1, 1e-3);
});

test("the shares add up to 1 everywhere except directly below a camera", () => {
  const { places } = latticeOf(groundOf(CAR).extent);
  const outside = places.filter(({ x, y }) => !(x >= -1.2 && x <= 4.2 && Math.abs(y) <= 1.2));
  const dark = sharesAt(outside).filter((shares) => Math.abs(shares.reduce((a, b) => a + b) - 1) > 1e-6);
  assert.equal(dark.length, 0, `${dark.length} of ${outside.length} places`);
});

test("between two cameras the shares blend without a jump", () => {
  const arc = Array.from({ length: 181 }, (_, i) => place(3 + 7 * Math.cos((i * Math.PI) / 360), 7 * Math.sin((i * Math.PI) / 360)));
  const shares = sharesAt(arc);
  near(shares[0][0], 1, 1e-3);
  near(shares[180][1], 1, 1e-3);
  for (const [i, each] of shares.slice(1).entries()) for (const k of [0, 1]) assert.ok(Math.abs(each[k] - shares[i][k]) < 0.1, `${i}: ${shares[i]} ${each}`);
});

test("ground outside a camera's region is shown by another camera that sees it, or by none", () => {
  const [ahead, between] = [place(8, 0), place(8, 5)];
  const lower = { x: 0, y: 700, width: 1280, height: 100 };
  const [whole, cut] = [sharesAt([ahead, between]), sharesAt([ahead, between], [lower, FULL, FULL, FULL])];
  assert.ok(whole[0][0] > 0.99 && whole[1][0] > 0);
  assert.deepEqual([cut[0].every((share) => share === 0), cut[1][0]], [true, 0]);
  near(cut[1][1], 1, 1e-6);
});

test("a triangle with a corner without an image, or without any share, is not drawn", () => {
  const [point, ones] = [{ x: 1, y: 1 }, new Float32Array(6).fill(1)];
  assert.deepEqual([...trianglesOf(2, 2, [point, point, point, point], ones)], [0, 1, 2, 1, 3, 2]);
  assert.deepEqual([...trianglesOf(2, 2, [point, point, point, null], ones)], [0, 1, 2]);
  assert.deepEqual([...trianglesOf(3, 2, [null, point, point, point, point, point], ones)], [1, 4, 3, 1, 2, 4, 2, 5, 4]);
  assert.deepEqual([...trianglesOf(2, 2, [point, point, point, point], Float32Array.of(0.2, 0, 0, 0))], [0, 1, 2]);
});

test("the front is up, the left at the left, and the scale is the same in both directions", () => {
  const wide = groundPlacement({ width: 1000, height: 460 }, CAR);
  near(wide.px_per_m, 20);
  near(wide.x, 500);
  near(wide.y, 13 * 20, 1e-9); // the front end of the ground is 13 m ahead of the rear axle, at the top
  const high = groundPlacement({ width: 400, height: 1000 }, CAR);
  near(high.px_per_m, 20);
  near(high.y, 500 + 1.5 * 20, 1e-9); // the ground's middle is 1.5 m ahead
});

test("labels are moved apart, and stay inside", () => {
  const label = (x, y) => ({ x, y, width: 100, height: 20 });
  const at = (boxes, height = 300) => apart(boxes, height).map(({ x, y }) => [x, y]);
  assert.deepEqual(at([label(0, 10), label(200, 12), label(50, 15)]), [[0, 10], [200, 12], [50, 31]]);
  assert.deepEqual(at([label(0, 0), label(0, 0), label(0, 0)]), [[0, 0], [0, 21], [0, 42]]);
  assert.deepEqual(at([label(0, 270), label(0, 275)]), [[0, 259], [0, 280]]);
});
