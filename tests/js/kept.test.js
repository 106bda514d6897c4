/** What mode S keeps of the mode before. */

import assert from "node:assert/strict";
import { test } from "node:test";

import { Kept } from "../../runner/page/static/kept.js";

const state = (mode, kbps, scaling = 0.5) => ({ mode, cameras: { front: { kbps, scaling } } });
const words = (...states) => {
  const kept = new Kept();
  states.forEach((each) => kept.update(each));
  return kept.words("front", states.at(-1).cameras.front);
};

test("S keeps what A or C left until it is set", () => {
  assert.equal(words(state("collective", 900), state("single", 900)), "Kept from mode C: set it here.");
  assert.equal(words(state("automatic", 900), state("single", 900), state("single", 900)), "Kept from mode A: set it here.");
  assert.equal(words(state("automatic", 900), state("single", 900), state("single", 800)), "Set in mode S.");
  assert.equal(words(state("automatic", 900), state("single", 900), state("single", 900, 0.25)), "Set in mode S.");
});

test("back in S it is what the other mode left, not what was set in S before", () => {
  const there = [state("automatic", 900), state("single", 900), state("single", 500)];
  assert.equal(words(...there, state("collective", 300), state("single", 300)), "Kept from mode C: set it here.");
});

test("a page that is opened in mode S does not know", () => {
  assert.equal(words(state("single", 900)), "Set here, or kept from the mode before S.");
});
