/** Axes of the charts. */

import assert from "node:assert/strict";
import { test } from "node:test";

import { factorAxis, ticksWithin, timeAxis } from "../../runner/page/static/axes.js";

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

const PAPER = [{ scaling: [0.125, 0.25, 0.5] }, { scaling: [0.25, 0.375, 0.5] }, { scaling: [0.5, 1] }];

test("ticks are at the factors of the cameras, each once", () => {
  assert.deepEqual(factorAxis(PAPER, 0, 300).ticks, [0.125, 0.25, 0.375, 0.5, 1]);
  assert.deepEqual(factorAxis([], 0, 300), { range: [0, 1.05], ticks: [] });
});

test("labels do not overlap, however low the chart is, and the largest factor has one", () => {
  for (const high of [24, 36, 45, 60, 90, 200, 400])
    for (const cameras of [PAPER, PAPER.slice(0, 2), [{ scaling: [0.01, 0.25, 0.26, 0.3, 1] }]])
      for (const highest of [0.1, 1]) {
        const { range, ticks } = factorAxis(cameras, highest, high);
        const at = ticks.map((tick) => (tick / range[1]) * high);
        assert.ok(at.slice(1).every((each, i) => each - at[i] >= 18), `${high} px: ${ticks}`);
        assert.equal(ticks.at(-1), Math.max(...cameras.flatMap(({ scaling }) => scaling)));
        assert.ok(range[1] > highest);
      }
  assert.deepEqual(factorAxis(PAPER.slice(0, 2), 0, 45).ticks, [0.25, 0.5]);
});

test("an axis of rates has as many labels as fit, at least two", () => {
  assert.deepEqual([10, 36, 54, 200].map(ticksWithin), [2, 2, 3, 11]);
});
