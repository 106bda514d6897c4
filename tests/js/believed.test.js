/** What is believed of the link, in words. */

import assert from "node:assert/strict";
import { test } from "node:test";

import { believedWords, furtherReasons } from "../../runner/page/static/believed.js";

const KNOWN = { kbps: 2431, deviation: 0.1, margin: 0.11, bias: -0.18, error: 0.06, gain: 0.31, policer_kbps: null };
const LINK = "Link: about 2400 kbit/s, 10 % kept free.";
const words = (more) => believedWords({ ...KNOWN, ...more });

test("a driver reads what the link carries, and what predictions are worth", () => {
  assert.equal(words({}), `${LINK} Predictions here are 20 % too high, changes come true to 30 %.`);
});

test("nothing is said while too little is known", () => {
  assert.equal(believedWords(undefined), "");
  assert.equal(words({ deviation: 0.35, bias: null, error: null, gain: null }), "");
  assert.equal(words({ bias: null, error: null, gain: 0.3 }), LINK);
  assert.equal(words({ gain: null }), `${LINK} Predictions here are 20 % too high.`);
});

for (const [bias, error, level] of [
  [0.02, 0.04, "right"],
  [-0.02, 0.26, "right ± 25 %"],
  [0.36, 0.12, "30 % too low ± 10 %"],
  [-0.405, 0.05, "50 % too high"],
  [-1.96, 0.3, "7 times too high ± 30 %"],
]) test(`${level}: ${bias} and ${error}`, () => assert.equal(words({ bias, error, gain: null }), `${LINK} Predictions here are ${level}.`));

for (const [gain, comes] of [[0.97, "come true"], [0.5, "come true to 50 %"], [0.1, "do not come true"]]) {
  test(`changes ${comes}`, () => assert.equal(words({ gain }), `${LINK} Predictions here are 20 % too high, changes ${comes}.`));
}

test("a policer is named", () => {
  assert.equal(words({ policer_kbps: 2049, bias: null }), "Link: drops what exceeds 2000 kbit/s.");
});

test("a reason that these words state is not stated twice", () => {
  const reasons = ["total 3000 -> 2100: capacity of the link, believed to be 2431", "total 2100 -> 0: night"];
  assert.deepEqual(furtherReasons(reasons, words({})), reasons.slice(1));
  assert.deepEqual(furtherReasons(reasons, words({ deviation: 0.4 })), reasons);
});
