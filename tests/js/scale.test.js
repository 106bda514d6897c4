/** The slider's arithmetic: equal steps are equal ratios, and requests are throttled. */

import assert from "node:assert/strict";
import { test } from "node:test";

import { STEPS, throttle, toKbps, toStep } from "../../runner/page/static/scale.js";

test("the slider runs from a 200th of the maximum to the maximum", () => {
  assert.equal(toKbps(STEPS, 6000), 6000);
  assert.equal(toKbps(0, 6000), 30);
  assert.equal(toKbps(STEPS / 2, 6000), 424); // the geometric middle
});

test("a bitrate is never below 1 kbit/s", () => assert.equal(toKbps(0, 1), 1));

test("bitrates outside the slider's range are at its ends", () => {
  assert.equal(toStep(1, 6000), 0);
  assert.equal(toStep(9000, 6000), STEPS);
});

test("a step survives the round trip to a bitrate, to within rounding", () => {
  for (let step = 0; step <= STEPS; step++) assert.ok(Math.abs(toStep(toKbps(step, 40000), 40000) - step) <= 1, `${step}`);
});

test("a higher step is never a lower bitrate", () => {
  for (let step = 1; step <= STEPS; step++) assert.ok(toKbps(step, 6000) >= toKbps(step - 1, 6000));
});

test("throttling sends the first value immediately, then at intervals, and always the last one", (context) => {
  const due = [];
  context.mock.method(globalThis, "setTimeout", (call, ms) => due.push([call, ms]));
  const sent = [];
  const wish = throttle((value) => sent.push(value), 200);
  const elapse = () => {
    const [call, ms] = due.shift();
    assert.equal(ms, 200);
    call();
  };
  wish(1);
  assert.deepEqual(sent, [1]);
  wish(2);
  wish(3);
  assert.deepEqual(sent, [1]);
  elapse();
  assert.deepEqual(sent, [1, 3]);
  elapse();
  assert.deepEqual([sent, due], [[1, 3], []]);
  wish(4);
  assert.deepEqual(sent, [1, 3, 4]);
});
