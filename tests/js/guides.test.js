/** Guide lines on the ground: the vehicle's width, distances, and the paths of its wheels. */

import assert from "node:assert/strict";
import { test } from "node:test";

import { imageOf, isGuided, nextChoice, pathGuides, straightGuides } from "../../runner/page/static/guides.js";

const CAR = { wheelbase_m: 3, track_m: 1.6, width_m: 2, front_m: 3.9, rear_m: 1.1 };
const ends = ({ places }) => [places[0], places[places.length - 1]];
const near = (found, x, y) => assert.ok(Math.hypot(found.x - x, found.y - y) < 1e-9, `${found.x}, ${found.y}, not ${x}, ${y}`);

test("the sides extend 15 m from both ends of the vehicle", () => {
  const widths = straightGuides(CAR).filter(({ kind }) => kind === "width");
  const expected = [[3.9, 1, 18.9, 1], [3.9, -1, 18.9, -1], [-1.1, 1, -16.1, 1], [-1.1, -1, -16.1, -1]];
  assert.equal(widths.length, expected.length);
  for (const [i, [x0, y0, x1, y1]] of expected.entries()) {
    near(ends(widths[i])[0], x0, y0);
    near(ends(widths[i])[1], x1, y1);
  }
});

test("distances count from the ends of the vehicle, and are as wide as it is", () => {
  const distances = straightGuides(CAR).filter(({ kind }) => kind === "distance");
  assert.deepEqual(distances.map(({ metres }) => metres), [1, 2, 5, 10, 15, 1, 2, 5, 10, 15]);
  for (const { metres, places } of distances.slice(0, 5)) for (const { x } of places) assert.equal(x, 3.9 + metres);
  for (const { metres, places } of distances.slice(5)) for (const { x } of places) assert.equal(x, -1.1 - metres);
  for (const line of distances) assert.deepEqual(ends(line).map(({ y }) => y), [1, -1]);
});

test("without steering the wheels go straight ahead", () => {
  const paths = pathGuides(CAR, 0);
  const expected = [[3.9, 0.8, 18.9, 0.8], [3.9, -0.8, 18.9, -0.8], [-1.1, 0.8, -16.1, 0.8], [-1.1, -0.8, -16.1, -0.8]];
  for (const [i, [x0, y0, x1, y1]] of expected.entries()) {
    near(ends(paths[i])[0], x0, y0);
    near(ends(paths[i])[1], x1, y1);
  }
});

for (const rad of [0.1, -0.1, 0.3, -0.3])
  test(`every wheel turns about the centre on the line of the rear axle, at ${rad}`, () => {
    const centre = 3 / Math.tan(rad); // to the left
    const wheels = [[3, 0.8], [3, -0.8], [0, 0.8], [0, -0.8]];
    for (const [i, { places }] of pathGuides(CAR, rad).entries()) {
      const radius = Math.hypot(wheels[i][0], wheels[i][1] - centre);
      for (const { x, y } of places) assert.ok(Math.abs(Math.hypot(x, y - centre) - radius) < 1e-9);
      const [first, last] = ends({ places });
      assert.ok(Math.sign(last.y - first.y) === Math.sign(rad), "to the side that the wheels point to");
      assert.ok(i < 2 ? last.x > first.x : last.x < first.x);
    }
  });

test("a path ends after a quarter turn", () => {
  const [left] = pathGuides({ ...CAR, front_m: 3 }, Math.atan(3 / 5)); // 5 m to the centre
  near(ends(left)[0], 3, 0.8);
  near(ends(left)[1], 4.2, 8); // (3, 0.8 - 5) turned by 90 degrees about (0, 5)
});

test("with next to no steering the wheels go straight ahead", () => {
  const straight = pathGuides(CAR, 0);
  for (const [i, { places }] of pathGuides(CAR, 1e-9).entries())
    for (const [j, { x, y }] of places.entries()) assert.ok(Math.hypot(x - straight[i].places[j].x, y - straight[i].places[j].y) < 1e-6);
});

test("a line breaks where it has no image", () => {
  const toImage = ({ x }) => (x === 3 ? null : { x, y: 0 });
  const line = [0, 1, 2, 3, 4, 5].map((x) => ({ x, y: 0, z: 0 }));
  assert.deepEqual(imageOf(line, toImage).map((piece) => piece.map(({ x }) => x)), [[0, 1, 2], [4, 5]]);
  assert.deepEqual(imageOf(line.slice(2, 4), toImage), [], "one point is no line");
});

const CALIBRATED = { pose: {}, calibrated: true };
const ESTIMATED = { pose: {}, calibrated: false };
const NOWHERE = { pose: null, calibrated: true };

test("without a choice only calibrated cameras have guides, and none without a pose", () => {
  const shown = (choice) => [CALIBRATED, ESTIMATED, NOWHERE].map((camera) => isGuided(camera, choice));
  assert.deepEqual(shown("calibrated"), [true, false, false]);
  assert.deepEqual(shown("all"), [true, true, false]);
  assert.deepEqual(shown("none"), [false, false, false]);
});

test("each choice shows different guides from the one before", () => {
  const steps = (cameras) => ["calibrated", "all", "none"].map((choice) => nextChoice(cameras, /** @type {any} */ (choice)));
  assert.deepEqual(steps([CALIBRATED, ESTIMATED]), ["all", "none", "calibrated"]);
  assert.deepEqual(steps([CALIBRATED]), ["none", "none", "calibrated"]);
  assert.deepEqual(steps([ESTIMATED]), ["all", "none", "all"]);
  assert.deepEqual(steps([NOWHERE]), ["calibrated", "all", "none"], "nothing to choose");
});
