/** Rows of tiles and the heights of their pictures. */

import assert from "node:assert/strict";
import { test } from "node:test";

import { heightsOf, rowsOf } from "../../runner/page/static/layout.js";

const GAP = 8;
const CHROME = 66;
const camera = (name, place = null, width = 1920, height = 1080) => ({ name, place, width, height });
const names = (rows) => rows.map((row) => row.map((each) => each.camera.name));

test("places give rows and their order, whatever the order of the cameras", () => {
  const cameras = [
    camera("rear", { row: 2, column: 1 }), camera("right", { row: 1, column: 3 }),
    camera("left", { row: 1, column: 1 }), camera("center", { row: 1, column: 2 }),
  ];
  assert.deepEqual(names(rowsOf(cameras)), [["left", "center", "right"], ["rear"]]);
});

test("cameras without a place fill a square", () => {
  assert.deepEqual(names(rowsOf(["a", "b", "c", "d", "e"].map((name) => camera(name)))), [["a", "b", "c"], ["d", "e"]]);
});

test("cameras without a place follow in rows as long as the longest that has places", () => {
  const placed = [camera("a", { row: 1, column: 1 }), camera("b", { row: 1, column: 2 }), camera("c", { row: 1, column: 3 })];
  const rows = rowsOf([camera("x"), camera("y"), camera("z"), camera("u"), ...placed]);
  assert.deepEqual(names(rows), [["a", "b", "c"], ["x", "y", "z"], ["u"]]);
});

test("no cameras, no rows", () => {
  assert.deepEqual(rowsOf([]), []);
  assert.deepEqual(heightsOf([], 1000, 500, CHROME), []);
});

/** Rows of some lengths of 16:9 pictures in an area: neither too wide nor too high. */
function checked(lengths, width, height) {
  const rows = lengths.map((count, row) => Array.from({ length: count }, (_, i) => ({ camera: camera(`${row}-${i}`) })));
  const heights = heightsOf(rows, width, height, CHROME);
  for (const [i, count] of lengths.entries()) assert.ok(heights[i] * count * (16 / 9) + (count - 1) * GAP <= width + 1e-6);
  const all = heights.reduce((sum, each) => sum + each + CHROME, (lengths.length - 1) * GAP);
  assert.ok(all <= height, `${all} of ${height}`);
  return heights;
}

test("equal rows share a low area equally", () => assert.deepEqual(checked([3, 3], 1900, 500), [180, 180]));

test("a row that the width limits leaves its height to the others, up to 1.25 of it", () => {
  assert.deepEqual(checked([6, 1], 1200, 600), [108, 135]);
});

test("where the area is high enough every row is as wide as it may be", () => {
  assert.deepEqual(checked([6, 1], 1200, 1000), [108, 675]);
});

test("a single wide picture fills the width", () => assert.deepEqual(checked([1], 1600, 2000), [900]));

test("pictures never vanish, however small the area is", () => {
  assert.deepEqual(heightsOf([[{ camera: camera("a") }], [{ camera: camera("b") }]], 800, 100, CHROME), [24, 24]);
});
