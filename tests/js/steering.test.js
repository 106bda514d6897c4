/** The steering angle at the capture time of a picture. */

import assert from "node:assert/strict";
import { test } from "node:test";

import { Steering } from "../../runner/page/static/steering.js";

function reported(...pairs) {
  const steering = new Steering();
  for (const [at, rad] of pairs) steering.onReport(at, rad);
  return steering;
}

const TABLE = [
  ["nothing reported", [], 1000, null],
  ["before the first report", [[1000, 0.1]], 999, null],
  ["at a report", [[1000, 0.1]], 1000, 0.1],
  ["300 ms after the last", [[1000, 0.1]], 1300, 0.1],
  ["older than 300 ms", [[1000, 0.1]], 1301, null],
  ["between two", [[1000, 0.1], [1100, 0.3]], 1025, 0.15],
  ["after a gap, as long as the last one is valid", [[1000, 0.1], [1500, 0.3]], 1200, 0.1],
  ["in a gap", [[1000, 0.1], [1500, 0.3]], 1400, null],
  ["of a picture whose capture time is unknown", [[1000, 0.1], [1100, 0.3]], NaN, null],
  ["reported again for the same time", [[1000, 0.1], [1000, 0.3]], 1000, 0.3],
  ["after the clock was set back", [[9000, 0.1], [1000, 0.3]], 1100, 0.3],
  ["kept for pictures that come late", [[1000, 0.1], [2000, 0.2], [5900, 0.3]], 1000, 0.1],
  ["forgotten", [[1000, 0.1], [6000, 0.2]], 1000, null],
];
for (const [what, pairs, captured, expected] of TABLE)
  test(`angle ${what}`, () => {
    const found = reported(...pairs).angleAt(captured);
    if (expected === null) assert.equal(found, null);
    else assert.ok(Math.abs((found ?? NaN) - expected) < 1e-12, `${found}, not ${expected}`);
  });

test("the newest report is shown for a second, with the gear", () => {
  const steering = reported([1000, 0.1]);
  steering.onReport(1100, -0.2, "R");
  const newest = { at: 1100, rad: -0.2, gear: "R" };
  assert.deepEqual([steering.newest(1100), steering.newest(2100), steering.newest(2101)], [newest, newest, null]);
  assert.equal(reported().newest(1000), null);
});
