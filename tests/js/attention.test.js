/** An operator whose attention lapses is warned, and informed on return. */

import assert from "node:assert/strict";
import { test } from "node:test";

import { Attention } from "../../runner/page/static/attention.js";

const HERE = { hidden: false, focused: true };

test("an attentive operator gets no message", () => {
  const attention = new Attention();
  assert.equal(attention.update(HERE, 0), null);
  assert.equal(attention.update(HERE, 60_000), null);
  assert.equal(attention.warning, null);
});

test("loss of focus is warned of immediately, and its duration reported on return", () => {
  const attention = new Attention();
  assert.equal(attention.update({ hidden: false, focused: false }, 1000), null);
  assert.equal(attention.warning, "OUT OF FOCUS: keys do not reach this page; click it");
  assert.equal(attention.update(HERE, 4100), "No key reached this page for 3 s");
  assert.equal(attention.warning, null);
});

test("a hidden page reports only on return", () => {
  const attention = new Attention();
  attention.update({ hidden: false, focused: false }, 1000);
  attention.update({ hidden: true, focused: false }, 1100);
  assert.equal(attention.warning, null);
  assert.equal(attention.update({ hidden: false, focused: false }, 9000), null);
  assert.equal(attention.update(HERE, 11_000), "This page was hidden for 10 s: check every picture");
});

test("an absence counts from its own start, and a very short one is ignored", () => {
  const attention = new Attention();
  attention.update({ hidden: true, focused: true }, 0);
  attention.update(HERE, 5000);
  attention.update({ hidden: false, focused: false }, 6000);
  assert.equal(attention.update(HERE, 6400), null);
  attention.update({ hidden: false, focused: false }, 7000);
  assert.equal(attention.update(HERE, 7600), "No key reached this page for 1 s");
});

test("focus in another window of the page raises no warning, but hidden pictures are reported", () => {
  const attention = new Attention();
  attention.update({ hidden: false, focused: false, elsewhere: true }, 0);
  assert.equal(attention.state, "unfocused");
  assert.equal(attention.warning, null);
  assert.equal(attention.update(HERE, 9000), null);
  attention.update({ hidden: false, focused: false, elsewhere: false }, 10_000);
  assert.match(attention.warning ?? "", /OUT OF FOCUS/);
  assert.equal(attention.update({ hidden: false, focused: false, elsewhere: true }, 12_000), "No key reached this page for 2 s");
  attention.update({ hidden: true, focused: false, elsewhere: true }, 13_000);
  assert.equal(attention.update({ hidden: false, focused: false, elsewhere: true }, 16_000), "This page was hidden for 3 s: check every picture");
});

const STATES = [
  [{ hidden: false, focused: true }, "watching", null],
  [{ hidden: false, focused: false }, "unfocused", /OUT OF FOCUS/],
  [{ hidden: false, focused: true, slow: true }, "slow", /SLOW/],
  [{ hidden: false, focused: false, slow: true }, "slow", /^OUT OF FOCUS.* · SLOW/],
  [{ hidden: false, focused: false, elsewhere: true, slow: true }, "slow", /^SLOW/],
  [{ hidden: false, focused: true, covered: true }, "watching", /HIDDEN: another window/],
  [{ hidden: true, focused: true, covered: true }, "hidden", null],
  [{ hidden: true, focused: true }, "hidden", null],
  [{ hidden: true, focused: false, slow: true }, "hidden", null],
];
for (const [page, state, warning] of STATES)
  test(`the worst state is reported, with a warning if the page is visible: ${JSON.stringify(page)}`, () => {
    const attention = new Attention();
    attention.update(/** @type {any} */ (page), 0);
    assert.equal(attention.state, state);
    if (warning) assert.match(attention.warning ?? "", /** @type {RegExp} */ (warning));
    else assert.equal(attention.warning, null);
  });
