import assert from "node:assert/strict";
import test from "node:test";

import { CELLS, CYCLE_MS, cellsOf, elapsed, read } from "../../runner/page/static/counter.js";

/** A picture of the counter: `cell` px wide, black and white as given, from `left` on, on a white page. */
function picture(ms, { cell = 4, left = 30.5, width = 320, height = 60, black = 30, white = 220, blur = 1, tilt = 0 } = {}) {
  const luma = new Uint8Array(width * height).fill(white);
  const cells = cellsOf(ms);
  for (let y = 15; y < 45; y++)
    for (let x = 0; x < width; x++) {
      const covered = [...Array(8 * blur).keys()].map((i) => cells[Math.floor((x + i / 8 - left - tilt * y) / cell)] ?? 0);
      luma[y * width + x] = white + ((black - white) * covered.reduce((a, b) => a + b, 0)) / covered.length;
    }
  return [luma, width, height, width];
}

for (const ms of [0, 1, 4711, CYCLE_MS - 1, 1795440849273])
  test(`${ms} ms are read back`, () => {
    assert.equal(cellsOf(ms).length, CELLS);
    assert.equal(read(...picture(ms)), ms % CYCLE_MS);
  });

for (const way of [{ cell: 2.7, left: 12.3 }, { cell: 6.1, width: 400 }, { black: 90, white: 150 }, { blur: 2 }, { tilt: 0.1 }])
  test(`a picture with ${JSON.stringify(way)} is read`, () => assert.equal(read(...picture(123456, way)), 123456));

test("no counter is read from a picture without one", () => {
  assert.equal(read(new Uint8Array(320 * 60).fill(100), 320, 60, 320), null);
  let seed = 1;
  const noise = Uint8Array.from({ length: 320 * 60 }, () => (seed = (seed * 48271) % 2147483647) & 0xff);
  assert.equal(read(noise, 320, 60, 320), null);
});

test("of two counters blended by one exposure, one or none is read", () => {
  for (let ms = 1000; ms < 1100; ms++) {
    const [one] = picture(ms);
    const [other, ...shape] = picture(ms + 17);
    assert.ok([null, ms, ms + 17].includes(read(one.map((y, i) => (y + other[i]) / 2), ...shape)));
  }
});

test("a counter that is cut off is not read", () => {
  assert.equal(read(...picture(5000, { left: -10 })), null);
});

test("elapsed time since the counter was shown", () => {
  assert.equal(elapsed(100, 250), 150);
  assert.equal(elapsed(CYCLE_MS - 50, 7 * CYCLE_MS + 100), 150);
});
