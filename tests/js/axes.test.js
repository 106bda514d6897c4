/** Axes of the charts. */

import assert from "node:assert/strict";
import { test } from "node:test";

import { factorTicks, timeAxis } from "../../runner/page/static/axes.js";

test("the time axis grows with the drive up to five minutes, and never cuts off data", () => {
  const spans = [0, 10, 30, 31, 100, 170, 299, 300, 4000].map((lasted) => -timeAxis(lasted).range[0]);
  assert.deepEqual(spans, [30, 30, 30, 60, 120, 180, 300, 300, 300]);
});

test("its ticks are whole seconds that end at now, between three and five intervals", () => {
  for (const lasted of [1, 40, 90, 150, 200, 280]) {
    const { range, dtick } = timeAxis(lasted);
    assert.equal(range[1], 0);
    assert.ok(Number.isInteger(dtick));
    const intervals = -range[0] / dtick;
    assert.ok(Number.isInteger(intervals) && intervals >= 3 && intervals <= 5, `${lasted} s: ${intervals}`);
  }
});

test("ticks are at the factors of the cameras, each once", () => {
  const paper = [{ scaling: [0.125, 0.25, 0.5] }, { scaling: [0.25, 0.375, 0.5] }, { scaling: [0.5, 1] }];
  assert.deepEqual(factorTicks(paper), [0.125, 0.25, 0.375, 0.5, 1]);
  assert.deepEqual(factorTicks([]), []);
});

test("labels do not overlap: of two close factors the lower one is labelled", () => {
  assert.deepEqual(factorTicks([{ scaling: [0.01, 0.25, 0.26, 0.3, 1] }]), [0.01, 0.25, 0.3, 1]);
});
