/** A layout that is being edited: tiles move and grow, and never cover each other. */

import assert from "node:assert/strict";
import { test } from "node:test";

import { completed, moved, resized, sizeOf } from "../../runner/page/static/editing.js";
import { gridOf } from "../../runner/page/static/layout.js";

const at = (row, column, row_span = 1, column_span = 1) => ({ row, column, row_span, column_span });
const cameras = (...names) => names.map((name) => ({ name, width: 1920, height: 1080 }));
const DRAFT = { a: at(0, 0), b: at(0, 1), c: at(0, 2), d: at(1, 1) };

test("unused rows and columns are left out, and cameras without a place follow below", () => {
  const places = { a: at(2, 3, 1, 2), b: at(7, 0), c: null };
  assert.deepEqual(completed(cameras("a", "b", "c", "d"), places), { a: at(0, 1, 1, 2), b: at(1, 0), c: at(2, 0), d: at(2, 1) });
  assert.deepEqual(completed(cameras("a", "b", "c", "d", "e"), {}), { a: at(0, 0), b: at(0, 1), c: at(0, 2), d: at(1, 0), e: at(1, 1) });
  assert.deepEqual(completed([], {}), {});
});

test("a tile that lands on another one swaps with it", () => {
  assert.deepEqual(moved(DRAFT, "a", 0, 2), { ...DRAFT, a: at(0, 2), c: at(0, 0) });
});

test("a tile that lands on a free cell leaves the others alone", () => {
  assert.deepEqual(moved(DRAFT, "a", 1, 0), { ...DRAFT, a: at(1, 0) });
});

test("a tile too large to swap with the other one moves it down", () => {
  const draft = { a: at(0, 0, 2, 2), b: at(0, 2), c: at(1, 2) };
  assert.deepEqual(moved(draft, "a", 0, 1), { a: at(0, 1, 2, 2), b: at(2, 2), c: at(3, 2) });
});

test("a tile that grows moves down what it covers, and no more", () => {
  assert.deepEqual(resized(DRAFT, "b", 1, 2), { ...DRAFT, b: at(0, 1, 1, 2), c: at(1, 2) });
  assert.deepEqual(resized(DRAFT, "b", 2, 1), { ...DRAFT, b: at(0, 1, 2, 1), d: at(2, 1) });
});

test("nothing leaves the grid or shrinks to nothing", () => {
  assert.deepEqual(moved(DRAFT, "a", -3, -1), DRAFT);
  assert.deepEqual(resized(DRAFT, "a", 0, -2), DRAFT);
  assert.equal(resized({ a: at(0, 0) }, "a", 99, 99).a.row_span, 12);
  assert.equal(moved({ a: at(0, 0) }, "a", 1e9, 0).a.row, 40);
});

test("the grid of a draft has a free row and column", () => {
  const { rows, columns, grid, tiles } = gridOf(cameras("a", "b", "c", "d"), DRAFT);
  assert.deepEqual([rows, columns, grid], [3, 4, true]);
  assert.deepEqual(tiles.map(({ camera: { name }, row, column }) => [name, row, column]), [["a", 0, 0], ["b", 0, 1], ["c", 0, 2], ["d", 1, 1]]);
  assert.deepEqual(sizeOf(DRAFT), { rows: 2, columns: 3 });
  assert.deepEqual(sizeOf({}), { rows: 0, columns: 0 });
});

const meet = (a, b, side) => a[side] < b[side] + b[`${side}_span`] && b[side] < a[side] + a[`${side}_span`];

test("whatever the edits, no tile covers another one, and no other tile changes its size", () => {
  let seed = 7;
  const chance = (count) => (seed = (seed * 48271) % 2147483647) % count; // Park and Miller, 1988
  let draft = completed(cameras("a", "b", "c", "d", "e", "f", "g", "h"), {});
  for (let step = 0; step < 3000; step++) {
    const name = "abcdefgh"[chance(8)];
    const before = draft;
    draft = chance(2) ? moved(draft, name, chance(6), chance(6)) : resized(draft, name, 1 + chance(3), 1 + chance(3));
    assert.deepEqual(Object.keys(draft), Object.keys(before));
    for (const [one, own] of Object.entries(draft)) {
      if (one !== name) assert.deepEqual([own.row_span, own.column_span], [before[one].row_span, before[one].column_span]);
      for (const [other, its] of Object.entries(draft)) assert.ok(one >= other || !meet(own, its, "row") || !meet(own, its, "column"), `${one} and ${other} in step ${step}`);
    }
    if (step % 50 === 0) draft = completed(cameras(..."abcdefgh"), draft);
  }
});
