/** Ages of pictures, their parts, and the skew between cameras. */

import assert from "node:assert/strict";
import { test } from "node:test";

import { mostOf, ageOf, skewOf, worstOf } from "../../runner/page/static/ages.js";

const picture = (captured, ...later) => [captured, ...later];

test("without a picture all ages are unknown", () => {
  assert.deepEqual(ageOf([]), { age_ms: null, parts_ms: { page: null, decode: null, draw: null } });
});

test("an age is the sum of its parts", () => {
  const pictures = [0, 1, 2].map((n) => picture(1000 * n, 1000 * n + 40, 1000 * n + 42, 1000 * n + 50, 1000 * n + 61));
  assert.deepEqual(ageOf(pictures), { age_ms: 61, parts_ms: { page: 2, decode: 8, draw: 11 } });
});

test("one slow picture does not change the median, and old ones drop out", () => {
  const quick = Array.from({ length: 15 }, () => picture(0, 10, 11, 12, 13));
  assert.equal(ageOf([...quick, picture(0, 10, 11, 12, 400)]).age_ms, 13);
  assert.equal(ageOf([picture(0, 1, 2, 3, 900), ...quick]).age_ms, 13);
});

test("an age within the clock error is shown as 0, not as negative", () => {
  assert.equal(ageOf([picture(10, 5, 6, 7, 8)]).age_ms, 0);
});

test("an age that no clock error explains is unknown: a clock was set", () => {
  const early = (by) => [picture(1000 + by, 1000, 1000, 1000, 1000)];
  assert.equal(ageOf(early(14), 10).age_ms, 0);
  assert.equal(ageOf(early(16), 10).age_ms, null);
});

test("with an unknown capture time the parts on the page remain", () => {
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

const age = (age_ms, bound_ms = 5) => ({ age_ms, bound_ms });
const worst = (ages, statuses, late_ms) => worstOf(Object.entries(ages).map(([camera, of]) => ({ camera, status: statuses[camera], ...of })), late_ms);
const live = (...names) => Object.fromEntries(names.map((name) => [name, "live"]));

test("the worst latency includes the error bound of the clocks", () => {
  const ages = { front: age(90, 5), rear: age(80, 30) };
  assert.deepEqual(worst(ages, live("front", "rear"), 200), { camera: "rear", age_ms: 80, bound_ms: 30, level: "fine" });
});

test("its level depends on the limit; exactly at the limit a picture is not late", () => {
  const level = (age_ms) => worst({ front: age(age_ms, 10) }, live("front"), 200).level;
  assert.deepEqual([140, 141, 190, 191].map(level), ["fine", "near", "near", "late"]);
});

test("late and damaged pictures move, frozen and lost ones have no latency", () => {
  const ages = { front: age(10), rear: age(40), left: age(9000), right: age(8000) };
  const statuses = { front: "damaged", rear: "late", left: "frozen", right: "lost" };
  assert.equal(worst(ages, statuses, 200).camera, "rear");
  assert.deepEqual(worst(ages, { ...statuses, front: "off", rear: "synchronising" }, 200), { camera: null, age_ms: null, bound_ms: null, level: "none" });
});

test("of one camera's pictures on the page and in a monitor, the older one counts", () => {
  const pictures = [["front", 20], ["front (monitor)", 180]].map(([camera, age_ms]) => ({ camera, status: "live", age_ms, bound_ms: 5 }));
  assert.deepEqual(worstOf(pictures, 200), { camera: "front (monitor)", age_ms: 180, bound_ms: 5, level: "near" });
});

test("a late picture is shown and marked, although the median is below the limit", () => {
  const ages = { front: age(90), rear: age(30) };
  assert.deepEqual(worst(ages, { front: "live", rear: "late" }, 200), { camera: "rear", age_ms: 30, bound_ms: 5, level: "late" });
});

test("an age follows within half a second, whatever the frame rate", () => {
  const drawn = (time, age_ms) => picture(time - age_ms, 0, 0, 0, time);
  const steps = (interval) => [...Array.from({ length: 40 }, (_, n) => drawn(n * interval, 30)), ...Array.from({ length: 1 + Math.floor(250 / interval) }, (_, n) => drawn((40 + n) * interval, 280))];
  for (const interval of [25, 66, 100, 200]) assert.equal(ageOf(steps(interval)).age_ms, 280, `${interval} ms`);
});

test("one unknown age makes the worst one unknown", () => {
  for (const unknown of [age(null), age(50, NaN), age(50, Infinity)])
    assert.deepEqual(worst({ front: age(10), rear: unknown }, live("front", "rear"), 200), { camera: "rear", age_ms: null, bound_ms: null, level: "unknown" });
});

test("a latency arises mostly where more than half of it does", () => {
  const parts = { capture: 5, encode: 200, link: 20, buffer: 30, page: 2, decode: 4, draw: 8 };
  assert.equal(mostOf(parts), "encode");
  assert.equal(mostOf({ ...parts, encode: 10 }), "link"); // the wait for packets counts as the link's
  assert.equal(mostOf({ ...parts, encode: 60 }), "");
  assert.equal(mostOf({}), "");
  assert.equal(mostOf({ encode: null, link: null, draw: 90 }), "draw");
});
