/** Bands of tiles, and the heights and boxes of their pictures. */

import assert from "node:assert/strict";
import { test } from "node:test";

import { bandsOf, boxesOf, heightsOf, narrowBands, spreadBands } from "../../runner/page/static/layout.js";

const GAP = 8;
const CHROME = 66;
const camera = (name, width = 1920, height = 1080) => ({ name, width, height });
const cameras = (...names) => names.map((name) => camera(name));
const at = (row, column, row_span = 1, column_span = 1) => ({ row, column, row_span, column_span });
const names = (bands) => bands.map(({ tiles }) => tiles.map((tile) => tile.camera.name));
const where = (bands) => bands.map(({ tiles }) => tiles.map(({ camera: { name }, row, column }) => [name, row, column]));

test("the box of a portrait picture is square, in a row and in a grid", () => {
  const portrait = camera("mirror", 720, 1280);
  const [row] = bandsOf([portrait], {});
  assert.deepEqual(boxesOf(row, 300, 1000, CHROME).boxes, [{ width: 300, height: 300 }]);
  const [grid] = bandsOf([portrait], { mirror: at(0, 0, 2, 1) });
  const [{ width, height }] = boxesOf(grid, 100, 1000, CHROME).boxes;
  assert.equal(width, height);
});

test("places give rows and their order, whatever the order of the cameras", () => {
  const places = { rear: at(2, 1), right: at(1, 3), left: at(1, 1), center: at(1, 2) };
  assert.deepEqual(names(bandsOf(cameras("rear", "right", "left", "center"), places)), [["left", "center", "right"], ["rear"]]);
});

test("cameras without a place fill a square", () => {
  assert.deepEqual(names(bandsOf(cameras("a", "b", "c", "d", "e"), {})), [["a", "b", "c"], ["d", "e"]]);
});

test("cameras without a place follow in rows as long as the longest row with places", () => {
  const bands = bandsOf(cameras("x", "y", "z", "u", "a", "b", "c"), { a: at(1, 1), b: at(1, 2), c: at(1, 3) });
  assert.deepEqual(names(bands), [["a", "b", "c"], ["x", "y", "z"], ["u"]]);
});

test("no cameras, no bands", () => {
  assert.deepEqual(bandsOf([], {}), []);
  assert.deepEqual(heightsOf([], 1000, 500, CHROME), []);
});

test("rows that a picture joins form one band, and empty rows and columns take no space", () => {
  const places = { a: at(1, 2, 2, 2), b: at(1, 5), c: at(2, 5), d: at(7, 0), e: at(7, 9) };
  const bands = bandsOf(cameras("a", "b", "c", "d", "e"), places);
  assert.deepEqual(where(bands), [[["a", 0, 0], ["b", 0, 2], ["c", 1, 2]], [["d", 0, 0], ["e", 0, 1]]]);
  assert.deepEqual(bands.map(({ rows, columns, grid }) => [rows, columns, grid]), [[2, 3, true], [1, 2, false]]);
});

test("bands that overlap in a chain are one", () => {
  const bands = bandsOf(cameras("a", "b", "c"), { a: at(0, 0, 2), b: at(1, 1, 2), c: at(2, 0, 2) });
  assert.deepEqual(bands.map(({ rows }) => rows), [4]);
});

const SPREAD = [
  [["a"], 1270, 880, [["a"]]],
  [["a", "b"], 900, 880, [["a"], ["b"]]],
  [["a", "b"], 1270, 880, [["a", "b"]]],
  [["a", "b", "c"], 1270, 880, [["b"], ["a", "c"]]], // the middle one above its neighbours
  [["a", "b", "c"], 1270, 300, [["a", "b", "c"]]],
  [["a", "b", "c", "d", "e"], 1270, 880, [["a", "b", "c"], ["d", "e"]]],
];
for (const [all, width, height, rows] of /** @type {any[]} */ (SPREAD))
  test(`a row of ${all.length} uses an area of ${width}×${height}`, () => {
    const row = bandsOf(cameras(...all), Object.fromEntries(all.map((name, column) => [name, at(0, column)])));
    assert.deepEqual(names(spreadBands(row, width, height, CHROME)), rows);
  });

test("a row of one picture is joined with the next where most of the width is left", () => {
  const places = { front: at(0, 0), rear: at(1, 0), left: at(2, 0), top: at(2, 1), right: at(2, 2) };
  const bands = bandsOf(cameras(...Object.keys(places)), places);
  assert.deepEqual(names(spreadBands(bands, 940, 660, CHROME)), [["front", "rear"], ["left", "top", "right"]]);
});

test("rows that fill an area, and grids, stay as they are", () => {
  const full = Object.fromEntries([..."abc", ..."de", ..."fgh"].map((name, i) => [name, at(i < 3 ? 0 : i < 5 ? 1 : 2, i)]));
  const grid = { a: at(0, 0, 2), b: at(0, 1), c: at(1, 1) };
  for (const places of [full, grid]) {
    const bands = bandsOf(cameras(...Object.keys(places)), places);
    assert.deepEqual(spreadBands(bands, 1270, 880, CHROME), bands);
  }
});

/** Rows of some lengths of 16:9 pictures in an area: neither too wide nor too high. */
function checked(lengths, width, height) {
  const all = lengths.flatMap((count, row) => Array.from({ length: count }, (_, i) => ({ name: `${row}-${i}`, place: at(row, i) })));
  const bands = bandsOf(all.map(({ name }) => camera(name)), Object.fromEntries(all.map(({ name, place }) => [name, place])));
  const heights = heightsOf(bands, width, height, CHROME);
  for (const [i, count] of lengths.entries()) assert.ok(heights[i] * count * (16 / 9) + (count - 1) * GAP <= width + 1e-6);
  const total = heights.reduce((sum, each) => sum + each + CHROME, (lengths.length - 1) * GAP);
  assert.ok(total <= height, `${total} of ${height}`);
  return heights;
}

test("equal rows share a low area equally", () => assert.deepEqual(checked([3, 3], 1900, 500), [180, 180]));

test("a row that the width limits leaves its height to the others, up to 1.25 of it", () => {
  assert.deepEqual(checked([6, 1], 1200, 600), [108, 135]);
});

test("if the area is high enough, every row is as wide as possible", () => {
  assert.deepEqual(checked([6, 1], 1200, 1000), [108, 675]);
});

test("a single wide picture fills the width", () => assert.deepEqual(checked([1], 1600, 2000), [900]));

test("pictures never vanish, however small the area", () => {
  const bands = bandsOf(cameras("a", "b"), { a: at(0, 0), b: at(1, 0) });
  assert.deepEqual(heightsOf(bands, 800, 100, CHROME), [24, 24]);
});

const AREAS = [[1600, 1000], [1600, 500], [700, 1200], [500, 420]];
const LAYOUTS = {
  "a large picture next to two": { a: at(0, 0, 2, 2), b: at(0, 2), c: at(1, 2) },
  "with a row below": { a: at(0, 0, 2, 2), b: at(0, 2), c: at(1, 2), d: at(2, 0), e: at(2, 1) },
  "a wide one above": { a: at(0, 0, 1, 3), b: at(1, 0), c: at(1, 1), d: at(1, 2) },
  "a pinwheel": { a: at(0, 0, 1, 2), b: at(0, 2, 2, 1), c: at(2, 1, 1, 2), d: at(1, 0, 2, 1), e: at(1, 1) },
};
for (const [words, places] of Object.entries(LAYOUTS))
  for (const [width, height] of AREAS)
    test(`${words} in ${width}x${height}: everything is inside, and every span is as long as what it spans`, () => {
      const bands = bandsOf(Object.keys(places).map((name, i) => camera(name, 1920, i % 2 ? 1080 : 1200)), places);
      const heights = heightsOf(bands, width, height, CHROME);
      const used = bands.reduce((sum, { rows }, i) => sum + rows * (heights[i] + CHROME) + (rows - 1) * GAP, (bands.length - 1) * GAP);
      assert.ok(used <= height, `${used} of ${height}`);
      for (const [i, band] of bands.entries()) {
        const { column, boxes } = boxesOf(band, heights[i], width, CHROME);
        assert.equal(column > 0, band.grid);
        for (const [j, tile] of band.tiles.entries()) {
          assert.equal(boxes[j].height + CHROME, tile.row_span * (heights[i] + CHROME) + (tile.row_span - 1) * GAP);
          if (band.grid) assert.equal(boxes[j].width, tile.column_span * column + (tile.column_span - 1) * GAP);
        }
        if (band.grid) assert.ok(band.columns * column + (band.columns - 1) * GAP <= width);
      }
    });

test("a picture that spans two rows and columns is twice as large, and fills the width where there is room", () => {
  const [band] = bandsOf(cameras("a", "b", "c"), { a: at(0, 0, 2, 2), b: at(0, 2), c: at(1, 2) });
  const [height] = heightsOf([band], 1816, 2000, 0);
  const { column, boxes } = boxesOf(band, height, 1816, 0);
  assert.equal(column, 600);
  assert.deepEqual(boxes[0], { width: 1208, height: 2 * height + GAP });
  assert.ok(Math.abs(boxes[1].width / boxes[1].height - 16 / 9) < 0.02);
});

test("a narrow page has as many tiles in a row as can be read, in the order of the layout, as wide as it is", () => {
  const bands = bandsOf(cameras("rear", "left", "right", "top"), { left: at(0, 0), right: at(0, 1), rear: at(1, 0, 1, 2) });
  assert.deepEqual(names(narrowBands(bands, 396)), [["left"], ["right"], ["rear"], ["top"]]);
  assert.deepEqual(names(narrowBands(bands, 899)), [["left", "right"], ["rear", "top"]]);
  const one = narrowBands(bands, 396);
  assert.deepEqual(heightsOf(one, 396, Infinity, CHROME), [222, 222, 222, 222]);
});
