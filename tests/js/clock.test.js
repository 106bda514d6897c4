/** The station's clock as the page sees it: accurate to within its bound, even after a clock change. */

import assert from "node:assert/strict";
import { test } from "node:test";

import { Clock, now } from "../../runner/page/static/clock.js";
import { latency } from "../../runner/page/static/format.js";

/** An echo that took `delay` ms, most of it one way, from a station whose clock is ahead by `ahead` ms. */
const echo = (clock, delay, ahead, share = 0.5) => {
  const sent = now() - delay;
  clock.onEcho(sent, sent + delay * share + ahead);
};

test("before the first echo nothing is known", () => assert.equal(new Clock().bound, Infinity));

test("the offset is accurate to within its bound, whatever the delays", () => {
  const clock = new Clock();
  for (const [delay, share] of [[80, 1], [10, 0], [300, 0.2], [12, 1], [40, 0.5]]) {
    echo(clock, delay, 3700, share);
    assert.ok(Math.abs(clock.offset - 3700) <= clock.bound + 1, `${clock.offset} ± ${clock.bound}`);
  }
  assert.ok(clock.bound <= 12);
});

test("echoes from before a clock change do not count", () => {
  const clock = new Clock();
  for (let i = 0; i < 5; i++) echo(clock, 4, 0);
  echo(clock, 30, 3000);
  assert.ok(Math.abs(clock.offset - 3000) <= clock.bound + 1, `${clock.offset} ± ${clock.bound}`);
});

test("a latency states its error bound, or that it is unknown", () => {
  assert.equal(latency(48.4, 5.2), "48 ± 6 ms");
  for (const unknown of [[NaN, 1], [48, NaN], [48, Infinity], [null, 1], [undefined, undefined]]) assert.equal(latency(...unknown), "– ms");
});
