/** Zoomed and moved regions, and their aspect ratio. */

import assert from "node:assert/strict";
import { test } from "node:test";

import { inside, moved, withAspect, zoomed } from "../../runner/page/static/region.js";

const FULL = { width: 1920, height: 1080 };
const WHOLE = { x: 0, y: 0, ...FULL };
const PART = { x: 480, y: 270, width: 960, height: 540 };

test("a region is in whole px, inside the image and not too small", () => {
  assert.deepEqual(inside({ x: -5.4, y: 1079.6, width: 3, height: 100.4 }, FULL), { x: 0, y: 980, width: 16, height: 100 });
  assert.deepEqual(inside({ x: 100, y: 100, width: 5000, height: 200 }, FULL), { x: 0, y: 100, width: 1920, height: 200 });
});

test("zooming in keeps the point under the pointer", () => {
  assert.deepEqual(zoomed(WHOLE, { x: 960, y: 540 }, 0.5, FULL), PART);
  assert.deepEqual(zoomed(WHOLE, { x: 0, y: 1080 }, 0.5, FULL), { x: 0, y: 540, width: 960, height: 540 });
  assert.deepEqual(zoomed(PART, { x: 720, y: 406 }, 0.5, FULL), { x: 600, y: 338, width: 480, height: 270 }); // a quarter of the way
});

test("the point stays to within half a px, although regions are in whole px", () => {
  const share = (at, from, length) => (at - from) / length;
  for (let factor = 0.5; factor < 1.4; factor += 0.013) {
    const part = { x: 481, y: 273, width: 641, height: 361 };
    const point = { x: 481 + 641 * 0.93, y: 273 + 361 * 0.87 };
    const { x, y, width, height } = zoomed(part, point, factor, FULL);
    assert.ok(Math.abs(x + share(point.x, part.x, part.width) * width - point.x) <= 0.5 + 1e-9, `${factor}`);
    assert.ok(Math.abs(y + share(point.y, part.y, part.height) * height - point.y) <= 0.5 + 1e-9, `${factor}`);
  }
});

test("zooming out ends at the full image, whatever the aspect ratio", () => {
  assert.deepEqual(zoomed(PART, { x: 480, y: 270 }, 2, FULL), WHOLE);
  assert.deepEqual(zoomed({ x: 0, y: 0, width: 400, height: 540 }, { x: 0, y: 0 }, 3, FULL), { x: 0, y: 0, width: 1200, height: 1080 });
  assert.deepEqual(zoomed({ x: 0, y: 0, width: 1200, height: 1080 }, { x: 0, y: 0 }, 3, FULL), WHOLE);
});

test("a region is at least 16 px, and keeps its aspect ratio there", () => {
  assert.deepEqual(zoomed(PART, { x: 480, y: 270 }, 1e-3, FULL), { x: 480, y: 270, width: 28, height: 16 });
});

test("a point outside the region counts as on its edge", () => {
  assert.deepEqual(zoomed(PART, { x: 0, y: 0 }, 0.5, FULL), { x: 480, y: 270, width: 480, height: 270 });
});

test("a region is moved up to the edges of the image", () => {
  assert.deepEqual(moved(PART, { x: 100, y: -50 }, FULL), { ...PART, x: 580, y: 220 });
  assert.deepEqual(moved(PART, { x: 5000, y: -5000 }, FULL), { ...PART, x: 960, y: 0 });
});

test("a locked aspect ratio keeps the corner where the drag began", () => {
  const dragged = { x: 100, y: 100, width: 400, height: 400 };
  assert.deepEqual(withAspect(dragged, 2, { right: true, down: true }), { x: 100, y: 100, width: 400, height: 200 });
  assert.deepEqual(withAspect(dragged, 2, { right: false, down: false }), { x: 100, y: 300, width: 400, height: 200 });
  assert.deepEqual(withAspect({ ...dragged, width: 100 }, 0.5, { right: false, down: true }), { x: 100, y: 100, width: 100, height: 200 });
  assert.deepEqual(withAspect({ x: 0, y: 0, width: 1, height: 1 }, 2, { right: true, down: true }), { x: 0, y: 0, width: 32, height: 16 });
});
