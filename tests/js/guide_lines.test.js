import assert from "node:assert/strict";
import { test } from "node:test";

import { withoutStraight } from "../../runner/page/static/guide_lines.js";

test("a straight line keeps its ends", () => {
  const points = Array.from({ length: 60 }, (_, i) => ({ x: 3 * i, y: 7 - 2 * i }));
  assert.deepEqual(withoutStraight(points), [points[0], points[59]]);
});

test("a curve stays within a tenth of a pixel of its points", () => {
  const points = Array.from({ length: 90 }, (_, i) => ({ x: 500 * Math.cos(i / 60), y: 300 * Math.sin(i / 60) }));
  const kept = withoutStraight(points);
  assert.ok(kept.length > 5 && kept.length < 60, `${kept.length}`);
  for (const point of points) {
    const after = kept.findIndex(({ x }) => x <= point.x);
    const [a, b] = [kept[Math.max(0, after - 1)], kept[Math.max(1, after)]];
    const apart = Math.abs((point.x - a.x) * (b.y - a.y) - (point.y - a.y) * (b.x - a.x)) / Math.hypot(b.x - a.x, b.y - a.y);
    assert.ok(apart < 0.1, `${apart}`);
  }
});

test("a corner, points that coincide, and short lines are kept", () => {
  const corner = [{ x: 0, y: 0 }, { x: 5, y: 0 }, { x: 5, y: 5 }];
  assert.deepEqual(withoutStraight(corner), corner);
  assert.deepEqual(withoutStraight(corner.slice(0, 1)), corner.slice(0, 1));
  assert.deepEqual(withoutStraight([]), []);
  const closed = [{ x: 0, y: 0 }, { x: 9, y: 0 }, { x: 0, y: 0 }];
  assert.deepEqual(withoutStraight(closed), closed);
});
