/** Ages of pictures, their parts, and the skew between cameras. */

import assert from "node:assert/strict";
import { test } from "node:test";

import { ageOf, skewOf } from "../../runner/page/static/ages.js";

const picture = (captured, ...later) => [captured, ...later];

test("without a picture nothing is known", () => {
  assert.deepEqual(ageOf([]), { age_ms: null, parts_ms: { page: null, decode: null, draw: null } });
});

test("an age is the sum of its parts", () => {
  const pictures = [0, 1, 2].map((n) => picture(1000 * n, 1000 * n + 40, 1000 * n + 42, 1000 * n + 50, 1000 * n + 61));
  assert.deepEqual(ageOf(pictures), { age_ms: 61, parts_ms: { page: 2, decode: 8, draw: 11 } });
});

test("one slow picture does not change the median, and old ones are forgotten", () => {
  const quick = Array.from({ length: 15 }, () => picture(0, 10, 11, 12, 13));
  assert.equal(ageOf([...quick, picture(0, 10, 11, 12, 400)]).age_ms, 13);
  assert.equal(ageOf([picture(0, 1, 2, 3, 900), ...quick]).age_ms, 13);
});

test("an age below what the clocks can tell is shown as 0, not as negative", () => {
  assert.equal(ageOf([picture(10, 5, 6, 7, 8)]).age_ms, 0);
});

test("a capture time that is unknown leaves the parts on the page", () => {
  assert.deepEqual(ageOf([picture(NaN, 10, 12, 15, 20)]), { age_ms: null, parts_ms: { page: 2, decode: 3, draw: 5 } });
});

test("the skew is between moving pictures only", () => {
  const shown = [
    { status: "live", captured: 1000 },
    { status: "late", captured: 940 },
    { status: "frozen", captured: 100 },
    { status: "live", captured: NaN },
  ];
  assert.equal(skewOf(shown), 60);
  assert.equal(skewOf(shown.slice(0, 1)), null);
});
